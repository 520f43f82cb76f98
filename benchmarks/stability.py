"""What it costs an RNN to stay contracting: online and open-loop error by constraint.

python benchmarks/stability.py [BLUEBOAT_LOGS]        writes docs/benchmarks/stability.md

Five seeds (missions, noise, initial weights) of one simulated Heron, as batch elements. A row's learning rate is the
best of RATES by the open-loop error on another season of the boat (TUNING); what is reported was not used for it.
"""

import math
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import torch
import yaml
from pages import publish

from certify.training.conditions import rate as contraction_rate
from usvlearn import RNN, rollout
from usvlearn.core.samples import Sample, tree_map
from usvlearn.estimators.rnn.layer import RNNState
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.read import read_recordings
from usvlearn.logs.recordings import align_fleet
from usvlearn.simulate.fleet import fleet as simulated
from usvlearn.simulate.sensors import Sensors

ROWS = {
    "none": {"stability": "none"},
    "penalty, η = 0.1": {"stability": "penalty", "penalty": 0.1},
    "penalty, η = 0.01": {"stability": "penalty", "penalty": 0.01},
    "penalty, η = 0.001": {"stability": "penalty", "penalty": 0.001},
    "simple": {"condition": "simple"},
    "simple, best gauge": {"condition": "simple", "gauge": "best"},
    "gershgorin": {"condition": "gershgorin"},
    "gershgorin, best gauge": {"condition": "gershgorin", "gauge": "best"},
    "lmi": {"condition": "lmi"},
    "tight": {"condition": "tight"},
    "interval": {"condition": "interval"},
}
# The paper's start and Adam: each condition from the same random weights, which a start at persistence would not be.
PAPER = {"initial": "random", "rate_ratio": (1.0,) * 5, "momentum": 0.9, "clip": None}
RATES = torch.tensor([3e-4, 1e-3, 3e-3, 1e-2], dtype=torch.float64)
PASSES = {0.2: 5, 0.4: 5, 1.0: 10}  # by step, s: more where there are fewer samples
SEEDS, HOURS, TEST_MISSIONS = 5, 2.5, 3
TUNING, REPORTED = 100, 200  # seeds of the simulation
SENSORS = Sensors(lost_share=0.0, outages_per_hour=0.0)


class Trial(NamedTuple):
    """What a row comes to, per rate and seed."""

    online: torch.Tensor  # (rates, seeds) m/s, MAE one step ahead in the first pass
    free: torch.Tensor  # (rates, seeds) m/s, MAE of open-loop simulations over whole missions
    K: torch.Tensor  # (rates, seeds) at the end


def missions(seed: int, dt: float) -> list[Sample]:
    """One boat's season, five times over with other missions and noise: samples `(time, seeds)` per mission."""
    logs = simulated(
        SEEDS, spread=0.0, drift=0.0, hours=HOURS, mission_minutes=15.0, seed=seed, current=0.0,
        aborted_share=0.0, paused_share=0.0, sensors=SENSORS,
    )  # fmt: skip
    return tensors(align_fleet(logs, dt=dt))


def blueboat(path: str) -> list[Sample]:
    data = yaml.safe_load(Path("configs/data/blueboat.yaml").read_text())["data"]
    reader = Table(**{key: value for key, value in data["reader"].items() if key != "_target_"})
    return tensors(align_fleet(read_recordings(path, reader, data["channels"]), dt=0.4))


def tensors(fleet) -> list[Sample]:
    return [tree_map(torch.from_numpy, run.samples) for run in fleet.runs]


def elements(samples: Sample, rates: int) -> Sample:
    """`(time, seeds)` as `(time, rates, seeds)`."""
    return tree_map(lambda x: x[:, None].expand(-1, rates, -1), samples)


def trial(
    settings: dict, rates: torch.Tensor, learn: list[Sample], test: list[Sample], surge_max: float, passes: int
) -> Trial:
    """Learn missions in order, so many times, then run free over the test missions from commands alone."""
    seeds = learn[0].surge.shape[1]
    settings = {**PAPER, **settings, "surge_max": surge_max, "rate": rates[:, None]}
    rnns = [RNN(seed=seed, **settings) for seed in range(seeds)]
    states = [rnn.init((len(rates), 1)) for rnn in rnns]
    state: RNNState = tree_map(lambda *leaves: torch.cat(leaves, 1), *states)
    errors = []
    with torch.no_grad():
        for number in range(passes):
            for samples in learn:
                state, surge, _ = rollout(rnns[0], state, elements(samples, len(rates)))
                if number == 0:
                    errors.append((surge - samples.surge[:, None]).abs())
        free = []
        for samples in test:
            unseen = samples._replace(measured=torch.zeros_like(samples.measured))
            _, surge, _ = rollout(rnns[0], state, elements(unseen, len(rates)))
            free.append((surge - samples.surge[:, None]).abs())
    online, free = (torch.cat(each).nanmean(0) for each in (errors, free))
    return Trial(online, free, contraction_rate(state.weights.a, state.weights.w1))


def references(learn: list[Sample], test: list[Sample]) -> tuple[float, float]:
    """MAE of persistence over what is learned online, and of the mean speed over the test missions, m/s."""
    online = torch.cat([(x.surge[1:] - x.surge[:-1]).abs() for x in learn]).nanmean()
    mean = torch.cat([x.surge for x in learn]).nanmean(0)
    free = torch.cat([(x.surge - mean).abs() for x in test]).nanmean()
    return float(online), float(free)


def table(title: str, rows: Iterable[tuple[str, float, Trial]], reference: tuple[float, float]) -> list[str]:
    rows = list(rows)
    base = float(rows[0][2].free.mean())
    lines = [
        title,
        "",
        "| constraint | rate | online MAE, m/s | open-loop MAE, m/s | its range over seeds | / none | K at the end |",
        "|---|" + "---:|" * 6,
    ]
    for name, rate, found in rows:
        free, K = found.free.flatten(), found.K
        lines.append(
            f"| {name} | {rate:g} | {found.online.mean():.4f} | {free.mean():.4f} | {free.min():.4f} … {free.max():.4f}"
            f" | {free.mean() / base:.2f} | {K.min():.3g} … {K.max():.3g} |"
        )
    lines.append(
        f"| *persistence; mean speed* | | {reference[0]:.4f} | {reference[1]:.4f} | | {reference[1] / base:.2f} | |"
    )
    return [*lines, ""]


def main(arguments: list[str]) -> None:
    torch.set_num_threads(1)
    report = [*__doc__.strip().splitlines()[4:], ""]
    chosen: dict[str, float] = {}
    for dt, passes in PASSES.items():
        tuning, reported = missions(TUNING, dt), missions(REPORTED, dt)
        split = len(reported) - TEST_MISSIONS
        rows = []
        for name, settings in ROWS.items():
            tuned = trial(settings, RATES, tuning[:split], tuning[split:], 2.74, passes).free.mean(1)
            best = RATES[tuned.nan_to_num(math.inf).argmin()]
            found = trial(settings, best[None], reported[:split], reported[split:], 2.74, passes)
            rows.append((name, float(best), found))
            if dt == 0.4:
                chosen[name] = float(best)
            print(dt, name, float(best), float(found.online.mean()), float(found.free.mean()), flush=True)
        title = f"## Simulated Heron, dt = {dt:g} s: {split} missions of 15 min learned {passes} times, 3 run free"
        report += table(title, rows, references(reported[:split], reported[split:]))
    if arguments:
        runs = [tree_map(lambda x: x.expand(-1, SEEDS), run) for run in blueboat(arguments[0])]
        learn, test = runs[:6], runs[6:]
        rows = [
            (name, chosen[name], trial(settings, torch.tensor([chosen[name]]).double(), learn, test, 3.5, 5))
            for name, settings in ROWS.items()
        ]
        title = "## BlueBoat, dt = 0.4 s: first 6 runs learned 5 times, later 6 run free; rates of the simulation"
        report += table(title, rows, references(learn, test))
    publish(__file__, ["# The cost of contraction while learning", "", *report])


if __name__ == "__main__":
    main(sys.argv[1:])
