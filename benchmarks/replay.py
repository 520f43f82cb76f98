"""What experience replay gives the RNN: open-loop simulations after one pass, one-step skill, cost.

python benchmarks/replay.py LOGS        a folder with blueboat; writes docs/benchmarks/replay.md

The settings were chosen on seeds 5 and 11 of the simulator, and on the first halves of the recorded logs.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from accuracy import configuration, free_run, halves, recorded
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from pages import publish
from timing import in_turn, ratio, table
from truths import NOMINAL, boats

from usvlearn import RNN, Persistence, rollout
from usvlearn.core.samples import Sample, masks
from usvlearn.engine.rollouts import tensors

SEED, SEEDS = 77, range(3)  # of the simulated boats; of the initial weights
PASSES = (1, 5, 20)
AIM = 1.15  # times the open-loop error after the last of them
CHOSEN = "chosen"
ROWS = {  # what differs from the chosen settings
    CHOSEN: {},
    "loss one step ahead": {"unroll": 1},
}


OPENING = """\
# Experience replay

Measured by `python benchmarks/replay.py LOGS`. The settings were chosen on seeds 5 and 11 of the simulator, and on the
first halves of the recorded logs. Open-loop simulation: MAE from commands alone, parameters frozen, on runs that were
not learned. Skill: 1 − MAE/MAE(persistence), one step of 0.4 s ahead, in the first pass, and in the later runs with
learning going on. Simulated boats: three each of seed 77, of which 3 h are learned, and 1 h is predicted. BlueBoat: the
first half of the runs is learned, the second predicted. Means over {seeds} initial weights. Cost: time of a step over
that of `rnn`, measured in turn on one core.

Chosen (`configs/estimator/rnn_replay.yaml`): {replay_size} samples kept, {replay_steps} learned again after each new
one, `unroll` {unroll}. The other row with replay has the loss of one step."""


class Boat(NamedTuple):
    """What a boat is learned from, and what is predicted after that."""

    surge_max: float  # m/s
    before: Sequence[Sample]
    after: Sequence[Sample]


class Found(NamedTuple):
    """Errors of one network on one boat."""

    free: float  # m/s, MAE of open-loop simulations over the later runs, parameters frozen
    first: float  # skill one step ahead in the first pass
    later: float  # and in the later runs, going on learning


@cache
def settings(name: str) -> dict[str, Any]:
    """The arguments of a file of `configs/estimator`."""
    with initialize_config_dir(str(Path(__file__).parents[1] / "configs"), version_base="1.3"):
        found = instantiate(
            compose("train", [f"+estimator@more={name}"]).more, _convert_="all", _target_="builtins.dict"
        )
    del found["surge_max"], found["seed"]
    return found


def fleet(logs: Path) -> dict[str, list[Boat]]:
    """The boats by name."""
    found = {}
    for plant in ("heron", "otter"):
        top, seasons = NOMINAL[plant][1], boats(plant, SEED)
        found[f"{plant}, simulated"] = [Boat(top, as_tensors(x.learned), as_tensors(x.later)) for x in seasons]
    log = recorded(logs, "blueboat")
    return found | {"blueboat": [Boat(configuration(log.overrides).vehicle.surge_max, *halves(log))]}


def as_tensors(runs: Sequence[Sample]) -> list[Sample]:
    return [tensors(run, torch.float64) for run in runs]


def online(estimator: Any, state: Any, runs: Sequence[Sample]) -> tuple[Any, float]:
    """The state after runs, and the MAE one step ahead, m/s."""
    errors = []
    for samples in runs:
        state, surge, _ = rollout(estimator, state, samples)
        errors.append((surge - samples.surge).abs()[masks(samples).learns])
    return state, float(torch.cat(errors).mean())


@cache
def persistence(runs: tuple[Sample, ...]) -> float:
    """Its MAE one step ahead, m/s."""
    return online(Persistence(), Persistence().init(runs[0].surge.shape[1:]), runs)[1]


def judged(boat: Boat, passes: Sequence[int], given: dict[str, Any]) -> list[Found]:
    """Errors of a network after each number of passes, the mean over initial weights."""
    found = []
    for seed in SEEDS:
        rnn = RNN(surge_max=boat.surge_max, seed=seed, **given)
        state, skills, own = rnn.init(boat.before[0].surge.shape[1:]), [], []
        for number in range(1, max(passes) + 1):
            state, error = online(rnn, state, boat.before)
            skills.append(1 - error / mae(boat.before))
            if number in passes:
                later = 1 - online(rnn, state, boat.after)[1] / mae(boat.after)
                own.append(Found(float(free_run(rnn, state, boat.after)[0]), skills[0], later))
        found.append(own)
    return [Found(*each) for each in np.mean(found, 0).tolist()]


def mae(runs: Sequence[Sample]) -> float:
    return persistence(tuple(runs))


def cost(boat: Boat, rows: dict[str, dict[str, Any]]) -> dict[str, float]:
    """The time of a step of each, over that of the first, measured in turn."""
    networks = {name: RNN(surge_max=boat.surge_max, **given) for name, given in rows.items()}

    def streamed(rnn: RNN) -> None:
        online(rnn, rnn.init(), boat.before[:6])

    spent = in_turn({name: partial(streamed, rnn) for name, rnn in networks.items()}, repeats=9)
    return {name: ratio(each, spent[next(iter(rows))]) for name, each in spent.items()}


@torch.no_grad()
def main() -> None:
    torch.set_num_threads(1)
    fleets = fleet(Path(sys.argv[1]))
    present, chosen = settings("rnn"), settings("rnn_replay")
    once = {"two steps ahead, 1 pass": present | {"unroll": 2}}
    once |= {f"replay, {name}": chosen | more for name, more in ROWS.items()}
    after = {f"rnn, {n} pass{'es' * (n > 1)}": n for n in PASSES}
    first, *_, last = after
    costs = cost(fleets["heron, simulated"][0], {first: present, **once})
    text = OPENING.format(**chosen, seeds=len(SEEDS)).splitlines()
    for name, some in fleets.items():
        found: dict[str, list[Found]] = {row: [] for row in (*after, *once)}
        for boat in some:
            for row, each in zip(after, judged(boat, PASSES, present), strict=True):
                found[row].append(each)
            for row, given in once.items():
                found[row] += judged(boat, (1,), given)
        means = {row: Found(*map(statistics.fmean, zip(*each, strict=True))) for row, each in found.items()}
        ratios = {row: each.free / means[last].free for row, each in means.items()}
        rows = [
            [row, f"{each.free:.3f}", f"{ratios[row]:.2f}", f"{each.first:.3f}", f"{each.later:.3f}",
             f"{costs.get(row, 1.0):.1f}"]
            for row, each in means.items()
        ]  # fmt: skip
        head = [
            "",
            "open-loop simulation, m/s",
            f"over {PASSES[-1]} passes",
            "skill, first pass",
            "skill, later",
            "cost of a step",
        ]
        reached = ratios[f"replay, {CHOSEN}"]
        verdict = (
            f"Aim: at most {AIM} times the open-loop simulation of {last}. {'Reached' if reached <= AIM else 'Missed'}"
        )
        text += ["", f"## {name}", "", *table(head, rows), "", f"{verdict}: {reached:.2f}."]
    publish(__file__, text)


if __name__ == "__main__":
    main()
