"""The picture at the top of a report: the measured speed and that of the model, in the model's best minutes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from usvlearn.display.figures import INK, KNOWN, SIDES, figure_of, guarded
from usvlearn.evaluation.free_simulation import FreeRun
from usvlearn.evaluation.metrics import fit
from usvlearn.evaluation.season import SeasonRun

LENGTH, SHIFT, KNOWN_SHARE = 180.0, 15.0, 0.9  # s of a part, and between two; how much of it is measured


class BestMinutes(NamedTuple):
    """A part of a run; arrays `(time,)`."""

    run: str
    learned: bool  # whether the model has learned from the run before
    time: np.ndarray  # min of the run
    measured: np.ndarray  # m/s, NaN where it does not count
    simulated: np.ndarray  # m/s
    left: np.ndarray  # commands, shares of full scale
    right: np.ndarray

    @property
    def fit(self) -> float | None:
        """Percent, of these minutes (`usvlearn.evaluation.metrics.fit`)."""
        known = np.isfinite(self.measured) & np.isfinite(self.simulated)
        speeds, errors = self.measured[known], (self.simulated - self.measured)[known]
        return fit(float(errors @ errors), float(((speeds - speeds.mean()) ** 2).sum())) if known.any() else None

    @property
    def caption(self) -> str:
        """What it shows, and how far it is to be trusted."""
        of = "which the model has learned before" if self.learned else "which the model has not learned"
        return (
            f"Speed in {self.run}, {of}: measured, and simulated from the commands alone. Of the parts of three "
            "minutes in which the speed changes as much as usual, it is the one with the least error."
        )


def best_minutes(runs: Sequence[SeasonRun], free: Sequence[FreeRun], column: int) -> BestMinutes | None:
    """The part with the least mean error of those whose speed changes at least as much as in half of all parts.

    Runs of a boat that the model has not learned go first. None where nothing was measured for so long. The column is
    that of the estimator in the runs' simulations.
    """
    pairs = list(zip(runs, free, strict=True))
    pairs = [pair for pair in pairs if not pair[1].learned] or pairs
    parts = [part for run, free_run in pairs for part in _parts(run, free_run, column)]
    if not parts:
        return None
    usual = float(np.median([np.nanstd(part.measured) for part in parts]))
    moving = [part for part in parts if np.nanstd(part.measured) >= usual]
    return min(moving, key=lambda part: float(np.nanmean(np.abs(part.simulated - part.measured))))


def _parts(run: SeasonRun, free: FreeRun, column: int) -> list[BestMinutes]:
    if not len(run.time) or not run.spacing:
        return []
    begins = np.arange(run.time[0], max(run.time[-1] - LENGTH, run.time[0]) + run.spacing, SHIFT)
    simulated, parts = free.predictions[:, column], []
    for begin in begins:
        part = slice(*np.searchsorted(run.time, (begin, begin + LENGTH)))
        measured = np.where(np.isfinite(simulated[part]), run.measured[part], np.nan)
        if np.isfinite(measured).sum() * run.spacing >= KNOWN_SHARE * min(LENGTH, run.time[-1] - run.time[0]) > 0:
            sides = (side[part] for side in run.samples.inputs[:2])
            parts.append(BestMinutes(run.name, free.learned, run.time[part] / 60, measured, simulated[part], *sides))
    return parts


@guarded
def best_figure(best: BestMinutes) -> Any:
    """Speeds above, commands below."""
    figure = figure_of(9.5, 3.1)
    speeds, commands = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    speeds.plot(best.time, best.measured, color=INK, linewidth=1.2, label="measured")
    speeds.plot(best.time, best.simulated, color=KNOWN["ensemble"], linewidth=1.6, label="from the commands alone")
    speeds.set_ylabel("speed, m/s")
    for name, values in (("left", best.left), ("right", best.right)):
        commands.plot(best.time, values, color=SIDES[name], linewidth=1.0, label=name)
    commands.set(ylabel="command", xlabel="time of the run, min")
    for panel in (speeds, commands):
        panel.legend(loc="lower left", bbox_to_anchor=(0, 0.95), ncols=2)
    return figure
