"""Speed of the kernels on a GPU, and how far they are from those on the CPU: python benchmarks/lanes.py

It writes docs/benchmarks/lanes.md, in 5 minutes of one GPU. It needs the extra cuda.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from pages import publish, table

from usvlearn.composition.configuration import compose_train, ensemble_of, instantiate
from usvlearn.core.protocol import spec_of
from usvlearn.core.samples import Inputs, Sample, tree_map
from usvlearn.engine.backend import arrays_of
from usvlearn.engine.lanes import Lanes
from usvlearn.engine.program import program_for
from usvlearn.engine.run import prepared, roll
from usvlearn.sweeps.tuning.batches import spread

# Which number each lane has of its own, and its range.
TUNED = {
    "aid": ("gain", 0.01, 100.0), "rls": ("forgetting", 0.98, 0.9999), "sift_map": ("memory", 0.5, 1000.0),
    "dynamic_rls": ("estimator.memory", 0.5, 1000.0), "rnn": ("rate", 1e-5, 1e-2), "arx": ("walk", 1e-6, 1e-2),
    "joint_quick": ("disturbance", 0.01, 1000.0), "joint": ("disturbance", 0.01, 1000.0),
}  # fmt: skip
FLOATS = {"aid": ("float64", "float32"), "joint_quick": ("float64", "float32")}
FEW, MANY, CHECKED, CHECK_STEPS = 1024, 65_536, 3, 128
HOURS, DT, LONGEST, SECONDS = 30.0, 0.4, 20_000, 1.0  # of the whole sweep; s of a step; steps of the log; s of a timing
ENSEMBLE = {"ensemble, no forecasts": ("forecasts=null",), "ensemble": ()}


class Row(NamedTuple):
    """What was measured of one estimator in one data type."""

    difference: float  # m/s, the largest of the predictions of CHECK_STEPS steps
    rates: dict[int, float]  # lane-steps a second by number of lanes


def log(steps: int) -> Sample:
    """A boat under commands that are held and change, with noise, a gap and a few samples that are missing."""
    rng = np.random.default_rng(0)
    levels = np.repeat(rng.uniform(0.0, 1.0, (steps // 40 + 1, 2)), 40, 0)[:steps]
    rate, noise, surge, speed = (
        0.4 * (levels[:, 0] - levels[:, 1]),
        rng.standard_normal((steps, 2)),
        np.empty(steps),
        0.0,
    )
    for k in range(steps):
        speed += DT / 28.0 * (52.0 * levels[k].mean() - 4.0 * abs(speed) * speed - 6.0 * speed + noise[k, 0])
        surge[k] = speed + 0.02 * noise[k, 1]
    lengths, measured = np.full(steps, DT), np.ones(steps, bool)
    lengths[::4000], measured[700::997] = 0.0, False
    return Sample(Inputs(*levels.T.copy(), np.cumsum(DT * rate), rate, lengths), surge, np.ones(steps, bool), measured)


def made(name: str, lanes: int, dtype: torch.dtype):
    """An estimator with a number that differs by lane, and its description and state."""
    if name in ENSEMBLE:
        estimator = ensemble_of(compose_train(list(ENSEMBLE[name])))
    else:
        estimator = instantiate(compose_train([f"+estimator@probe={name}"]).probe)
        path, low, high = TUNED[name]
        values = np.geomspace(low, high, lanes)
        estimator = spread(estimator, [{path: value} for value in values.tolist()])
    with torch.no_grad():
        return spec_of(estimator.to(dtype)), arrays_of(estimator.init((lanes, 1)))


def wide(samples: Sample, lanes: int, steps: int, dtype: str) -> Sample:
    """The first steps, the same for all lanes."""
    some = tree_map(lambda x: x[:steps].astype(dtype) if x.dtype != bool else x[:steps], samples)
    return tree_map(lambda x: np.broadcast_to(x[:, None, None], (steps, lanes, 1)), some)


def measured(name: str, dtype: str, samples: Sample, counts: tuple[int, ...]) -> Row:
    """Compare with the CPU, then time more and more lanes."""
    few, kind = wide(samples, CHECKED, CHECK_STEPS, dtype), getattr(torch, dtype)
    description, leaves = made(name, CHECKED, kind)
    result = roll(description, leaves, few, device="cuda")
    expected = roll(description, leaves, few).predictions
    assert np.array_equal(np.isnan(result.predictions), np.isnan(expected)), f"{name}: NaN at other steps"
    difference = float(np.nanmax(np.abs(result.predictions - expected)))
    rates: dict[int, float] = {}
    for count in counts:
        description, leaves = made(name, count, kind)
        plan = program_for(description, (count, 1), np.dtype(dtype))
        lanes, launches = Lanes(plan, plan.pack(leaves)), 0
        batch = wide(samples, count, lanes.steps, dtype)
        lanes.run(*prepared(batch, plan), False)
        began = time.perf_counter()
        while launches < 2 or time.perf_counter() < began + SECONDS:
            lanes.run(*prepared(batch, plan), False)
            launches += 1
        rates[count] = count * lanes.steps * launches / (time.perf_counter() - began)
    return Row(difference, rates)


def command(folder: str) -> tuple[float, float]:
    """The wall time of a whole sweep of AID by the command line, s, and that of its replays."""
    given = ["grid=aid", "tuning.device=cuda", f"tuning.evaluations={MANY}", "tuning.rounds=1", f"data.hours={HOURS}"]
    whole, began = [sys.executable, "-m", "usvlearn", "train", *given, f"hydra.run.dir={folder}"], time.perf_counter()
    done = subprocess.run(whole, cwd=Path(__file__).parents[1], capture_output=True, text=True, check=False)
    print(done.stdout[-3000:], done.stderr[-3000:], flush=True)
    taken = time.perf_counter() - began
    return taken, json.loads(Path(folder, "tuning.json").read_text())["seconds"]


def rows(names: list[str], counts: tuple[int, ...], samples: Sample) -> dict[tuple[str, str], Row]:
    """What was measured of each; a fault of one is printed, and the others go on."""
    table = {}
    for name in names:
        for dtype in FLOATS.get(name, ("float64",)):
            try:
                most = tuple(min(count, 8192) if name in ENSEMBLE else count for count in counts)
                table[name, dtype] = row = measured(name, dtype, samples, most)
                print(name, dtype, *row, flush=True)
            except Exception as error:
                print(name, dtype, type(error).__name__, str(error)[-1500:], flush=True)
    return table


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", default=[*TUNED, *ENSEMBLE])
    parser.add_argument("--only", action="store_true", help="print what is measured; write no page, run no command")
    parser.add_argument("--lanes", type=int, nargs="*", default=[FEW, MANY])
    options = parser.parse_args()
    table = rows(options.names, tuple(options.lanes), log(LONGEST))
    if options.only:
        return
    with tempfile.TemporaryDirectory() as folder:
        taken = [command(f"{folder}/{k}") for k in range(2)]
    publish(__file__, page(table, tuple(options.lanes), taken))


def page(results: dict[tuple[str, str], Row], counts: tuple[int, ...], taken: list[tuple[float, float]]) -> str:
    whole = MANY * HOURS * 3600 / DT
    lanes = [f"{count:,} lanes" for count in counts]
    head = ["G lane-steps/s", *lanes, "65,536 settings × 30 h", "largest difference"]
    body = [
        [name if dtype == "float64" else f"{name}, {dtype}", *(f"{rate / 1e9:.2g}" for rate in row.rates.values()),
         f"{whole / list(row.rates.values())[-1]:.3g} s", f"{row.difference:.0e} m/s"]
        for (name, dtype), row in results.items()
    ]  # fmt: skip
    return f"""# Sweeps on a GPU

Measured by `python benchmarks/lanes.py` on one {torch.cuda.get_device_name()}. A lane is a boat with a
setting; a lane-step is one step of it, learned. Ensembles have 8,192 lanes at most. The difference is that from the
CPU's predictions over {CHECK_STEPS} steps. Machine code is kept, so it is compiled once.

{chr(10).join(table(head, body))}

`usvlearn train grid=aid tuning.device=cuda tuning.evaluations=65536 tuning.rounds=1 data.hours=30` takes
{taken[0][0]:.0f} s with data, checks and files, and {taken[1][0]:.0f} s again; of these {taken[1][1]:.0f} s are the
replays.
"""


if __name__ == "__main__":
    main()
