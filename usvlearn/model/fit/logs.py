"""A run's logs as missions to fit, on a grid of their own.

The run predicts a step of some tenths of a second ahead; its samples hold the mean command over that step, and the yaw
rate of two headings. Both bend what is fitted: thrust is not linear in the command, and noise in the yaw rate makes
|r| larger on a straight course and smaller beside its true size in a turn. Here the grid is finer, and the yaw rate is
that of a parabola through the headings around each step (Savitzky & Golay 1964), which may look ahead, because the
whole log is there.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import savgol_filter

from usvlearn.core.rows import MODE, PREDICT, YAW_RATE
from usvlearn.core.samples import Fleet, tree_map
from usvlearn.errors import ConfigError
from usvlearn.model.fit.gauss_newton import rows_of, scored

DT = 0.1  # s, of the grid
WINDOW = 3.0  # s, of the parabola
FEWEST = 600  # measured steps, below which nothing is fitted


def missions_of(fleet: Fleet, boat: str, dt: float = DT) -> list[np.ndarray]:
    """The missions of a boat as prepared samples, `(time, ROW)` each; those without measured steps are left out.

    Args:
        fleet: logs, aligned on a grid of `dt`.
        boat: its name in the fleet.
        dt: s.

    Raises:
        ConfigError: there are too few measured steps in which the boat moves.
    """
    element, found = fleet.boats.index(boat), []
    for run in fleet.runs:
        if length := run.lengths[element]:
            rows = rows_of(tree_map(lambda x, n=length: x[:n, element], run.samples))
            if scored(rows).any():
                found.append(smoothed(rows, dt))
    measured = sum(int(scored(rows).sum()) for rows in found)
    if measured < FEWEST:
        raise ConfigError(
            f"{boat}: found {measured} measured speeds of a boat that moves, expected at least {FEWEST}: a fit needs "
            "some minutes of logs in which the boat sails"
        )
    return found


def smoothed(rows: np.ndarray, dt: float) -> np.ndarray:
    """Prepared samples with the yaw rate of a parabola over `WINDOW`, as far as there are enough steps."""
    count, steps = 2 * round(WINDOW / dt / 2) + 1, rows[:, MODE] >= PREDICT
    if count < 4 or steps.sum() <= count:
        return rows
    rows, places = rows.copy(), np.arange(len(rows))
    rate = np.interp(places, places[steps], rows[steps, YAW_RATE])
    smooth: np.ndarray = np.asarray(savgol_filter(rate, count, 2))
    rows[steps, YAW_RATE] = smooth[steps]
    return rows
