"""By how much the measured speed follows the commands: the delay of both that a log's settings do not tell.

A receiver filters its speed, and a command takes its way to the motor. Which of both is late cannot be told, and does
not matter for the other parameters. Measured speeds are moved against all else by whole steps of the grid, while the
set `TERMS` simulates them better. What is left is μ or τ of `motion_kernel`.
"""

from __future__ import annotations

import numpy as np

from usvlearn.core.rows import LEARN, MODE, PREDICT, SURGE
from usvlearn.model.fit.gauss_newton import Missions

TERMS, ENOUGH = "even", 30  # the set that is fitted to it, about to as many pieces
LATEST, EARLIEST = 20, -8  # steps
GAIN = 1e-3  # of the loss a step: a smaller gain ends the search


def moved(rows: np.ndarray, steps: int) -> np.ndarray:
    """Prepared samples whose measured speeds are earlier by some steps; a speed that has no place is left out.

    >>> rows = np.zeros((4, 8))
    >>> rows[:, MODE], rows[:, SURGE] = [1, PREDICT, LEARN, LEARN], [0.0, 1.0, 2.0, 3.0]
    >>> moved(rows, 1)[:, MODE].tolist(), moved(rows, 1)[1:3, SURGE].tolist()
    ([1.0, 3.0, 3.0, 2.0], [2.0, 3.0])
    """
    found, places = rows.copy(), np.arange(len(rows)) + steps
    there = (places >= 0) & (places < len(rows))
    source = places.clip(0, len(rows) - 1)
    measured = there & (rows[source, MODE] == LEARN)
    found[measured, SURGE] = rows[source[measured], SURGE]
    made = rows[:, MODE] >= PREDICT
    found[made, MODE] = np.where(measured[made], LEARN, PREDICT)
    return found


def late(missions: Missions) -> tuple[Missions, int]:
    """The missions with their speeds moved, and by how many steps of the grid these were late."""
    some = range(0, len(missions.rows), max(1, len(missions.rows) // ENOUGH))
    part = Missions([missions.rows[k] for k in some], missions.top)
    tried = {0: part.fit(TERMS)}

    def loss(steps: int, beside: int) -> float:
        if steps not in tried:
            tried[steps] = _moved(part, steps).settled(tried[beside])
        return tried[steps].total

    at, way = 0, 1 if loss(1, 0) < loss(-1, 0) else -1
    while EARLIEST <= at + way <= LATEST and loss(at + way, at) < tried[at].total - GAIN * sum(part.steps):
        at += way
    return _moved(missions, at), at


def _moved(missions: Missions, steps: int) -> Missions:
    return Missions([moved(rows, steps) for rows in missions.rows], missions.top, missions.names)
