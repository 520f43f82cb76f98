"""Compares batch methods, which fit all runs at once, with members that learn online: open-loop simulations, forecasts.

python benchmarks/batch.py LOGS        writes docs/benchmarks/batch.md

LOGS is a folder with blueboat, vtec and dalian. The script needs the extra bench, and 15 min of one core.

The peers of `benchmarks/peers` and `usvlearn fit` are told all of the first half of a boat's runs at once. Ours learn
it once, online.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import accuracy
import numpy as np
import seasons
import torch
from pages import publish, table
from peers import gru, narmax, physics, state_space
from peers.batch import HORIZONS, Fitted, Held, Targets, errors, free_run_errors, targets
from seasons import DT, Halves, free_run_mae, simulations

from usvlearn import Ensemble, rollout
from usvlearn.core.samples import Sample, masks, tree_map
from usvlearn.engine.rollouts import simulate, tensors
from usvlearn.model.fit.fitted import fit_boat
from usvlearn.model.fit.logs import DT as FINE

REAL, PLANTS, SEED = ("blueboat", "vtec", "dalian"), ("heron", "otter"), 77
FIT, BATCH = "usvlearn fit", "batch output error"
PEERS = {
    "SysIdentPy, polynomial NARMAX": narmax,
    "jax-sysid, recurrent state space": state_space,
    "GRU, torch": gru,
    BATCH: physics,
}
OURS = ("joint", "joint_quick", "arx", "joint_averaged", "rnn", "rnn_replay", "ensemble")
REPLAY = "+estimator@estimators.rnn_replay=rnn_replay"  # it has rows, and no weight in the ensemble
OPENING = """\
# Batch identification beside online learning

Measured by `python benchmarks/batch.py LOGS` in {:.0f} min of one core. Each peer is told all of the
first half of a boat's runs at once (of a simulated boat, seed 77: 3 h), and chooses its settings on the last
20 % of them, by the mean over the horizons and the open-loop simulation of MAE/MAE(persistence). Ours have seen these
runs once, online. All is measured on the second half (of a simulated boat: the next hour), over the steps
whose speed was measured. The sweeps are small, so that the whole stays below 15 min; each file of
`benchmarks/peers` states its own.

## Open-loop simulation, parameters frozen: MAE, m/s

From the inputs, and the measured speed with which each segment starts. `usvlearn fit` learns on its own grid
of 0.1 s. The first half of the Dalian boat has 414 measured steps there; the command refuses less than 600. The
VTec goes straight in its first half and turns in its second. The fit percentage is 100 (1 − |v − v̂| / |v − mean
v|); a published fit by nlgreyest of the BlueBoat has 67.8% in sample."""
FORECASTS = """\
1 − MAE/MAE(persistence over that horizon), from every fifth step on, told the inputs that came; – where no
segment is that long. Peers are frozen; their state follows the measured speeds up to the origin. Ours go on
learning up to the origin."""
Skills = dict[int, float]  # by horizon, steps


class Log(NamedTuple):
    """A boat's runs, and how its ensemble is made."""

    name: str
    runs: Halves
    whole: Halves | None  # all runs, to learn from and to simulate
    mass: float  # kg
    top: float  # m/s, top speed as a user states it
    overrides: tuple[str, ...]  # of configs/train.yaml


class Row(NamedTuple):
    """What one method reached on one boat."""

    free: float  # m/s, MAE of the open-loop simulation
    skills: Skills
    setting: str = ""
    seconds: float = 0.0  # of the processor, for training
    percentages: tuple[float, ...] = ()  # of the fit: of the later runs, and of all runs in sample; NaN: not measured


def recorded(folder: Path, name: str) -> Log:
    """A recorded boat: the halves of its runs, or of its only run."""
    given = (f"data={name}", f"data.path={folder / name}")
    grids = [accuracy.fleet_of((*given, *more)) for more in ((), (f"align.dt={FINE}",))]
    vehicle = accuracy.configuration(given).vehicle
    return Log(name, seasons.halves(*grids), seasons.whole(*grids), vehicle.mass, vehicle.surge_max, (*given, REPLAY))


def simulated(plant: str, seed: int = SEED) -> Log:
    """A simulated boat: 3 h to learn from, and the hour after them."""
    (runs,), (mass, top) = seasons.season(plant, seed, 1).values(), seasons.NOMINAL[plant]
    given = (f"data.plant={plant}", f"vehicle.mass={mass}", f"vehicle.surge_max={top}", REPLAY)
    return Log(plant, runs, None, mass, top, given)


def skills(pairs: Mapping[int, tuple[float, float]]) -> Skills:
    """1 − MAE/MAE(persistence) by horizon."""
    return {h: 1 - mae / held for h, (mae, held) in pairs.items()}


def peer_row(module, log: Log) -> Row | None:
    """A batch peer; None if its library is not installed."""
    try:
        fitted: Fitted = module.fit(log.runs.learned, log.top)
    except ModuleNotFoundError as error:
        print(error, file=sys.stderr)
        return None
    skill = skills(errors(log.runs.later, [fitted.model.forecast(run) for run in log.runs.later]))
    return Row(free_run_errors(fitted.model, log.runs.later)[0], skill, fitted.setting, fitted.seconds)


def percentage(predictions: Sequence[np.ndarray], runs: Sequence[Sample]) -> float:
    """The fit percentage 100 (1 − |v − v̂| / |v − mean v|) over all steps whose speed was measured."""
    use = np.concatenate([masks(run).learns for run in runs])
    predicted, true = np.concatenate(predictions)[use], np.concatenate([run.surge for run in runs])[use]
    return float(100 * (1 - np.linalg.norm(true - predicted) / np.linalg.norm(true - true.mean())))


def fit_row(log: Log) -> Row:
    """`usvlearn fit`."""
    began, pairs = time.process_time(), []
    for runs in (log.runs, log.whole):
        if runs is not None:
            fitted = fit_boat(log.name, runs.rows, log.mass, log.top)
            pairs.append((simulations(fitted.fit, runs), runs.later, fitted.chosen, time.process_time() - began))
    simulated, later, terms, seconds = pairs[0]
    shares = (*(percentage(*each[:2]) for each in pairs), math.nan)[:2]
    return Row(free_run_mae(simulated, later), {}, terms, seconds, shares)


@torch.no_grad()
def ours_by_free_run(log: Log) -> dict[str, float]:
    """MAE, m/s, of the open-loop simulations of the later runs; what was learned on the others stays as it is."""
    model = accuracy.ensemble(log.overrides)
    before, after = ([tensors(run, torch.float64) for run in runs] for runs in (log.runs.learned, log.runs.later))
    errors = accuracy.free_run(model, accuracy.learned(model, before), after)
    return {name: float(errors[model.names.index(name)]) for name in OURS}


@torch.no_grad()
def online_forecasts(
    model: Ensemble, learned: Sequence[Sample], later: Sequence[Sample], horizons: Sequence[int] = HORIZONS
) -> list[np.ndarray]:
    """Of each later run, which is learned online meanwhile, forecasts `(horizons, origins, columns)`, m/s."""
    state, forecasts = accuracy.learned(model, [tensors(run, torch.float64) for run in learned]), []
    for run in later:
        aim = targets(run, horizons)
        state, _, states = rollout(model, state, tensors(run, torch.float64), record=lambda state: state)
        at_origins = tree_map(lambda leaf, o=aim.origins: leaf[o].contiguous(), states)
        forecasts.append(free_from(model, at_origins, run, aim, max(horizons))[np.array(horizons) - 1])
    return forecasts


def ours_by_horizon(log: Log) -> dict[str, Skills]:
    """Skill of our own forecasts of the later runs, by name and horizon."""
    model = accuracy.ensemble(log.overrides)
    forecasts = online_forecasts(model, log.runs.learned, log.runs.later)
    columns = {name: model.names.index(name) for name in OURS}
    return {name: skills(errors(log.runs.later, [each[..., k].T for each in forecasts])) for name, k in columns.items()}


def free_from(model: Ensemble, states, run: Sample, aim: Targets, longest: int) -> np.ndarray:
    """Predictions `(time, origins, columns)`, m/s, of open-loop simulations from all origins; a row without a step is
    held.
    """
    rows = aim.origins + np.arange(1, longest + 1)[:, None]
    inside, rows = rows < len(run.surge), rows.clip(max=len(run.surge) - 1)
    ahead = tree_map(lambda x: x[rows], run)
    blind = ahead._replace(
        surge=np.full(rows.shape, np.nan), fresh=masks(run).steps[rows] & inside, measured=np.zeros(rows.shape, bool)
    )
    return simulate(model, states, tensors(blind, torch.float64), ["predictions"])[2]["predictions"].numpy()


def rows(log: Log) -> dict[str, Row | None]:
    """Every method on a boat."""
    table: dict[str, Row | None] = {"persistence": Row(free_run_errors(Held(), log.runs.later)[1], {})}
    for label, module in PEERS.items():
        table[label] = peer_row(module, log)
        print(log.name, label, table[label], flush=True)
    table[FIT] = fit_row(log)
    ahead, free = ours_by_horizon(log), ours_by_free_run(log)
    for name in OURS:
        table[f"ours: {name}"] = Row(free[name], ahead[name])
        print(log.name, name, table[f"ours: {name}"], flush=True)
    return table


def shown(value: float | None, digits: int) -> str:
    if value is None:
        return "not installed"
    return f"{round(value, digits) + 0.0:.{digits}f}" if np.isfinite(value) else "–"


def page(boats: Mapping[str, Mapping[str, Row | None]], minutes: float) -> list[str]:
    """The page, from the rows of every boat."""
    free = [
        [name, *(shown(each[name] and each[name].free, 3) for each in boats.values())]
        for name in next(iter(boats.values()))
    ]
    for k, part in enumerate(("second half", "all in sample")):
        shares = (each[FIT].percentages[k] for each in boats.values())
        free.append([f"fit percentage of {FIT}, {part}", *(f"{x:.1f}%" if math.isfinite(x) else "–" for x in shares)])
    text = [OPENING.format(minutes), "", *table(["", *boats], free), "", "## Forecasts: skill", "", FORECASTS]
    for boat, each in boats.items():
        ahead = {name: row for name, row in each.items() if row is None or row.skills}
        lines = [[name, *(shown(row and row.skills[h], 2) for h in HORIZONS)] for name, row in ahead.items()]
        text += ["", *table([boat, *(f"{h * DT:.1f} s" for h in HORIZONS)], lines)]
    chosen = [
        [boat, name, row.setting, f"{row.seconds:.0f}"]
        for boat, each in boats.items()
        for name, row in each.items()
        if row and row.setting
    ]
    text += ["", "## Settings that were chosen, and seconds of the processor for all training", ""]
    return [*text, *table(["boat", "peer", "setting", "s"], chosen)]


def main() -> None:
    torch.set_num_threads(1)
    began, folder = time.process_time(), Path(sys.argv[1])
    logs = [*(recorded(folder, name) for name in REAL), *map(simulated, PLANTS)]
    boats = {log.name: rows(log) for log in logs}
    publish(__file__, page(boats, (time.process_time() - began) / 60))


if __name__ == "__main__":
    main()
