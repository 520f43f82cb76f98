"""What three ways of tuning find at one budget, and how soon the gradient reaches what the grid found.

python benchmarks/tuning.py        writes docs/benchmarks/tuning.md; needs the extra tune
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import torch
from accuracy import configuration, fleet_of
from hydra.utils import instantiate
from omegaconf import OmegaConf
from pages import publish

from usvlearn.sweeps.tuning import tune as tuning

SEASON = ("data.n=8", "data.hours=0.5", "data.seed=2021", "data.mission_minutes=10")
MEMBERS = ("aid", "sift_map", "rnn", "joint", "arx")
WAYS = {
    "grid": ("grid",),
    "gradient": ("learn",),
    "Optuna": ("search",),
}


def rows(member: str) -> Iterator[str]:
    """The default and each way's best; the default is the same for all, and judged apart."""
    goal = None
    for label, (way, *more) in WAYS.items():
        cfg = configuration((*SEASON, f"{way}={member}", *more))
        asked = tuning.request(OmegaConf.to_container(cfg, resolve=True), instantiate)
        began = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            found, used, _ = tuning.run(asked, fleet_of(SEASON), Path(folder))
        seconds = time.perf_counter() - began
        maes = [each.mae for each in found]
        best = found[maes.index(min(maes))]
        if goal is None:
            goal = best.mae
            yield f"| {member} | default | {maes[0]:.6f} | 0 | | | |"
        # Of the gradient each evaluation that is listed is a pass, and a pass costs its share of what was used.
        reached = next((k for k, mae in enumerate(maes) if mae <= goal), None)
        if label == "gradient":
            worth, reached = used / len(found), None if reached is None else reached + 1
        else:
            worth = used / max(1, len(found) - 1)
        when = "never" if reached is None else f"{reached * worth:.0f}"
        setting = ", ".join(f"{path.rpartition('.')[2]} {value:.4g}" for path, value in best.setting.items())
        yield f"| {member} | {label} | {best.mae:.6f} | {used} | {when} | {seconds:.0f} | {setting} |"
        print(member, label, best.mae, used, when, round(seconds), flush=True)


def main() -> None:
    torch.set_num_threads(1)
    text = [
        "# Three ways of tuning compared",
        "",
        "Measured by `python benchmarks/tuning.py`: MAE one step ahead, m/s, mean over the boats of a tuning season,",
        f"`{' '.join(SEASON)}`,",
        "at a budget of 64 evaluations beside the default's own. An evaluation is the arithmetic of one replay of it;",
        "`reached` says after how many of them the error is no larger than the",
        "grid's best. The grid and Optuna judge many settings in one pass, as batch elements; a pass of the gradient "
        "waits for",
        "the one before, so that at equal arithmetic it takes longer.",
        "",
        "| member | way | MAE, m/s | evaluations | reached | s | setting |",
        "|---|---|---:|---:|---:|---:|---|",
        *(row for member in MEMBERS for row in rows(member)),
        "",
    ]
    publish(__file__, text)


if __name__ == "__main__":
    main()
