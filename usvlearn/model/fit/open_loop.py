"""Open-loop simulations by a fit, and whether the fit or the ensemble simulates a boat better.

Which of them to use is decided on missions that neither has learned: the second half. For it the chosen terms are
fitted to the first half alone, and the ensemble is frozen where it was after that half (`free` in `results.json`). The
fit is used if its errors are smaller by more than their standard error over the missions; with fewer than three of
them the ensemble stays. Both know the speed with which each segment starts, the commands and the headings, and nothing
else; the current is that to expect after the learned missions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.prepared_samples import COS, MODE, PREDICT, SIN, START, SURGE
from usvlearn.core.samples import Fleet, masks, tree_map
from usvlearn.errors import ConfigError
from usvlearn.model.fit.choice import FEWEST_WORN, WEAR, compared
from usvlearn.model.fit.gauss_newton import Fit, Missions, rows_of
from usvlearn.model.fit.logs import DT, missions_of, smoothed
from usvlearn.model.fit.wear import worn

ENSEMBLE, FIT = "ensemble", "fit"


class FreeMode(NamedTuple):
    """Which open-loop simulation to use, and why."""

    used: str  # `FIT` or `ENSEMBLE`
    missions: int  # on which that was decided
    fit: float | None  # m/s, MAE there; None: there were too few missions to decide
    ensemble: float | None
    gain: float | None  # m/s, by which the fit errs less
    error: float | None  # its standard error over the missions; None: too few of them

    @property
    def sentence(self) -> str:
        """What was decided, for a person."""
        if self.fit is None or self.ensemble is None or self.gain is None:
            return "Open-loop simulation: the ensemble's, as no mission was left to compare it with the fit's."
        many = "1 mission" if self.missions == 1 else f"{self.missions} missions"
        errors = f"the fit errs by {self.fit:.4f} m/s, the ensemble by {self.ensemble:.4f}, on {many} that neither had"
        if self.error is None:
            return f"Open-loop simulation: the ensemble's, as too few missions decide nothing: {errors} learned."
        away = f"a difference of {self.gain:.4f} ± {self.error:.4f}"
        return f"Open-loop simulation: use the {self.used}'s: {errors} learned, {away}."

    def json(self) -> dict[str, Any]:
        """As JSON values, with the sentence."""
        return self._asdict() | {"sentence": self.sentence}


NOTHING = FreeMode(ENSEMBLE, 0, None, None, None, None)


def open_loop(fit: Fit, rows: np.ndarray, current: np.ndarray) -> np.ndarray:
    """Speeds of a mission, m/s, `(time,)`, of which only those are measured with which segments start."""
    rows, steps = rows.copy(), rows[:, MODE] >= PREDICT
    along = rows[:, [COS, SIN]] @ current
    rows[steps, MODE] = PREDICT
    starts = np.flatnonzero(rows[:, MODE] == START)
    after = (starts + 1).clip(max=len(rows) - 1)
    begun = rows[starts, SURGE]
    rows[starts, SURGE] -= along[after]  # the kernel knows of no current
    ((speeds, _),) = Missions([rows], fit.top).simulate(fit)
    speeds = speeds + along
    speeds[starts] = begun
    known = np.maximum.accumulate(np.where(np.isfinite(speeds), np.arange(len(speeds)), 0))
    return np.nan_to_num(speeds[known])  # where no step is made, the speed is held


def usual_current(currents: np.ndarray) -> np.ndarray:
    """The current to expect, m/s, `(2,)`, from those of some missions, `(missions, 2)`: their mean, smaller the
    less they agree (James & Stein 1961).
    """
    mean: np.ndarray = currents.mean(0)
    if len(currents) < 2 or not mean.any():
        return mean
    return mean * max(1 - float(currents.var(0, ddof=1).sum() / len(currents) / (mean @ mean)), 0.0)


def decide(
    boat: str, terms: str, top: float, fine: Fleet, coarse: Fleet, first: int, ensemble: Mapping[str, float]
) -> FreeMode:
    """Which simulation to use for a boat, by the runs from the second half's `first` one.

    `fine` and `coarse` are the logs on the grids of the fit and of the run; `ensemble` is the MAE of its simulation,
    m/s, by the name of a run.
    """
    element = fine.boats.index(boat)
    later = {run.names[element]: run for run in coarse.runs[first:] if run.lengths[element]}
    again = {run.names[element]: run for run in fine.runs if run.names[element] in later}
    try:
        before = tuple(run for run in fine.runs if run.names[element] not in later)
        rows = missions_of(fine._replace(runs=before), boat)
    except ConfigError:
        return NOTHING
    learned = Missions(list(rows.values()), top)
    fit = learned.fit(terms.removesuffix(WEAR))
    current = usual_current(np.array([end for _, end in learned.simulate(fit)]))
    if terms.endswith(WEAR) and len(rows) >= FEWEST_WORN:
        fit, _ = worn(learned, fit, fit.deviation)
    errors = []
    for name in sorted(later.keys() & again.keys() & ensemble.keys()):
        run, small = later[name], again[name]
        m, n = run.lengths[element], small.lengths[element]
        if n:
            speeds = open_loop(
                fit, smoothed(rows_of(tree_map(lambda x, n=n: x[:n, element], small.samples)), DT), current
            )
            samples = tree_map(lambda x, m=m: x[:m, element], run.samples)
            places = np.searchsorted(small.time[:n, element], run.time[:m, element] - DT / 2).clip(max=n - 1)
            learns = masks(samples).learns
            if learns.any():
                error = float(np.abs(speeds[places] - samples.surge)[learns].mean())
                errors.append((ensemble[name], error, int(learns.sum())))
    if not errors:
        return NOTHING
    theirs, ours, steps = (np.array(each, float) for each in zip(*errors, strict=True))
    gain, error = compared(theirs, ours, steps.astype(int).tolist())
    own, other = (float(each @ steps / steps.sum()) for each in (ours, theirs))
    used = FIT if gain > error else ENSEMBLE
    return FreeMode(used, len(errors), own, other, gain, error if np.isfinite(error) else None)
