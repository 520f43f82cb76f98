"""Boats of the benchmarks: simulated seasons, and logs that are cut in halves, on two grids; how a fit simulates them.

The batch fit learns on a grid of its own (`usvlearn.model.fit.logs`), and simulates on it. It is judged where all
others are: at the steps of the coarser grid whose speed was measured. As those of the other methods, its simulations
are told the speed with which each segment starts, and the current to expect after the missions that it has learned.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from peers.batch import bounded

from usvlearn.core.samples import Fleet, Run, Sample, masks, tree_map
from usvlearn.logs.recordings import align_fleet
from usvlearn.model.fit.gauss_newton import Fit, Missions, rows_of, scored
from usvlearn.model.fit.logs import DT as FINE
from usvlearn.model.fit.logs import smoothed
from usvlearn.model.fit.open_loop import open_loop, usual_current
from usvlearn.simulate.fleet import fleet

PLANTS = ("heron", "kingfisher", "vtec", "otter", "wamv")
NOMINAL = {"heron": (28.0, 2.74), "kingfisher": (35.0, 1.5), "vtec": (32.25, 1.5), "otter": (85.5, 3.1),
           "wamv": (180.0, 7.7)}  # fmt: skip  # mass, kg, and top speed, m/s, as a user would state them
MINUTES, DT = 10.0, 0.4  # of a mission; s, of a step
HOURS, LATER = 3.0, 1.0  # h, to learn from, and for simulations


class Later(NamedTuple):
    """A run to simulate."""

    rows: np.ndarray  # (fine time, ROW) on the grid of the fit
    places: np.ndarray  # (time,) the fine row at the end of each step of the run


class Halves(NamedTuple):
    """The runs of a boat to learn from, and those after them."""

    learned: list[Sample]  # leaves (time,)
    later: list[Sample]
    rows: dict[str, np.ndarray]  # those to learn from on the grid of the fit, by number, as `usvlearn fit` has them
    ahead: list[Later]  # the later runs again


def season_of(plant: str, seed: int, n: int = 3, hours: float = HOURS, later: float = LATER) -> dict[str, object]:
    """The arguments of `fleet`, and of the truth about its boats."""
    return {"n": n, "plant": plant, "hours": hours + later, "mission_minutes": MINUTES, "seed": seed}


def season(plant: str, seed: int, n: int = 3, hours: float = HOURS, later: float = LATER) -> dict[str, Halves]:
    """Simulated boats of a plant by name: the first `hours` are to learn from."""
    logs, first = fleet(**season_of(plant, seed, n, hours, later)), round(hours * 60 / MINUTES)
    grids = [align_fleet(logs, dt=dt, patience=1.0) for dt in (DT, FINE)]

    def parts(one: Fleet, element: int) -> tuple[list[Run], list[Run]]:
        split: tuple[list[Run], list[Run]] = [], []
        for run in one.runs:
            if run.names[element]:
                split[int(run.names[element][:3]) > first].append(alone(run, element))
        return split

    return {boat: _halves(*(parts(grid, k) for grid in grids)) for k, boat in enumerate(grids[0].boats)}


def halves(coarse: Fleet, fine: Fleet) -> Halves:
    """The halves of the runs of a fleet of one boat, or of its only run."""
    parts = []
    for grid in (coarse, fine):
        runs = [alone(run, 0) for run in grid.runs]
        if len(runs) == 1:
            middle = coarse.runs[0].time[len(coarse.runs[0].time) // 2, 0]
            runs = cut(runs[0], middle - FINE / 2)
        parts.append((runs[: len(runs) // 2], runs[len(runs) // 2 :]))
    return _halves(*parts)


def whole(coarse: Fleet, fine: Fleet) -> Halves:
    """All runs of a fleet of one boat, to learn from and to simulate."""
    parts = [[alone(run, 0) for run in grid.runs] for grid in (coarse, fine)]
    return _halves(*((each, each) for each in parts))


def alone(run: Run, element: int) -> Run:
    """A run of one boat of a fleet, `(time, 1)`."""
    part = slice(run.lengths[element]), slice(element, element + 1)
    return Run(run.time[part], tree_map(lambda x: x[part], run.samples), run.names[element : element + 1],
               run.lengths[element : element + 1])  # fmt: skip


def cut(run: Run, time: float) -> list[Run]:
    """A run of one boat before and after a time, s; the second part starts a segment."""
    at, parts = int((run.time[:, 0] < time).sum()), []
    for part in (slice(at), slice(at, None)):
        samples = tree_map(lambda x, part=part: x[part].copy(), run.samples)
        samples.inputs.dt[0] = 0.0
        parts.append(Run(run.time[part], samples, run.names, (len(samples.surge),)))
    return parts


def _halves(coarse: Sequence[list[Run]], fine: Sequence[list[Run]]) -> Halves:
    learned, later = ([_flat(run) for run in runs] for runs in coarse)
    rows = {str(k + 1): smoothed(rows_of(_flat(run)), FINE) for k, run in enumerate(fine[0])}
    ahead = []
    for run, small in zip(coarse[1], fine[1], strict=True):
        places = np.searchsorted(small.time[:, 0], run.time[:, 0] - FINE / 2).clip(max=len(small.time) - 1)
        ahead.append(Later(smoothed(rows_of(_flat(small)), FINE), places))
    return Halves(learned, later, {name: each for name, each in rows.items() if scored(each).any()}, ahead)


def _flat(run: Run) -> Sample:
    return tree_map(lambda x: x[:, 0], run.samples)


def simulations(fit: Fit, runs: Halves) -> list[np.ndarray]:
    """Speeds, m/s, of the open-loop simulations of the later runs, `(time,)` each."""
    current = usual_current(np.array([end for _, end in Missions(list(runs.rows.values()), fit.top).simulate(fit)]))
    return [open_loop(fit, each.rows, current)[each.places] for each in runs.ahead]


def free_run_mae(predictions: Sequence[np.ndarray], runs: Sequence[Sample]) -> float:
    """The mean absolute error of open-loop simulations, m/s, over all steps whose speed was measured."""
    pairs = zip(predictions, runs, strict=True)
    return float(np.concatenate([bounded(speed - run.surge)[masks(run).learns] for speed, run in pairs]).mean())
