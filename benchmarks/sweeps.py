"""What a sweep costs: jobs in two processes in place of plain replays.

python benchmarks/sweeps.py        writes docs/benchmarks/sweeps.md

The script needs the extra sweep, and minutes of an idle machine with two cores.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pages import publish
from timing import machine, table

ROOT = Path(__file__).resolve().parents[1]
NEURONS, UNROLLS, SEEDS = (4, 8, 10, 12, 16, 20, 30, 40), (1, 2), 3
LENGTHS = (1, 10)  # h of the sweep of 48 jobs


def sweep(folder: Path, *arguments: str) -> tuple[float, list[float]]:
    """Seconds of a sweep's command, and of each of its jobs, as its results say."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(ROOT / "train.py"), "-m", *arguments, f"hydra.sweep.dir={folder}"]
    began = time.perf_counter()
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    seconds = time.perf_counter() - began
    return seconds, [json.loads(path.read_text())["seconds"] for path in folder.glob("*/results.json")]


def jobs(folder: Path) -> list[str]:
    """A sweep of 48 jobs in two processes against the same jobs' own time."""
    settings = (
        f"estimators.rnn.neurons={','.join(map(str, NEURONS))}",
        f"estimators.rnn.unroll={','.join(map(str, UNROLLS))}",
    )
    rows = []
    for hours in LENGTHS:
        whole, spent = sweep(
            folder / f"{hours}", *settings, f"seeds={SEEDS}", f"data.hours={hours}", "hydra/launcher=joblib",
            "hydra.launcher.n_jobs=2",
        )  # fmt: skip
        rows.append(
            [f"{hours} h", f"{whole:.0f}", f"{sum(spent) / 2:.0f}", f"{100 * (2 * whole / sum(spent) - 1):.0f} %"]
        )
    count = len(NEURONS) * len(UNROLLS) * SEEDS
    return [
        f"## A sweep of {count} jobs in two processes",
        "",
        f"`{' '.join(settings)} seeds={SEEDS}`",
        "with joblib. A job's own time is from reading to scoring, `seconds` in its results; the rest is the start of",
        "the processes, the composition of each job's settings by Hydra, and the leaderboard.",
        "",
        *table(["season", "the command, s", "jobs' own time over two, s", "overhead"], rows),
        "",
    ]


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        text = ["# Time of sweeps", "", f"Measured by `python benchmarks/sweeps.py` on: {machine()}.", ""]
        publish(__file__, [*text, *jobs(Path(name))])


if __name__ == "__main__":
    main()
