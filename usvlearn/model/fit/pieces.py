"""Missions cut in pieces, the units of scatter and of leaving out, with the measured speeds at their times.

Errors of neighbouring steps are alike for some seconds to a minute, hardly those of pieces of `SECONDS`. So one long
log tells as much as many short ones; one of a few minutes is cut in three, which the choice of terms needs. Each piece
has a start and a current of its own.

A receiver filters its speed, and a command takes its way to the motor. Which of both is late cannot be told. Measured
speeds are moved against all else by whole steps of the grid where μ of the set `TERMS` is not between 0 and 1, while it
simulates them better. What is left is μ or τ of `motion_kernel`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from usvlearn.core.prepared_samples import HOLD, LEARN, MODE, PREDICT, START, SURGE
from usvlearn.model.fit.gauss_newton import LAGS, Missions, scored
from usvlearn.model.fit.terms import PLACE_LAG

SECONDS, LEAST = 150.0, 60.0  # s; of short logs, so that the choice of terms has three pieces
MOST = 200  # pieces of all missions together, about; of longer logs pieces are longer
TERMS, ENOUGH = "even", 30  # the set that tells how late speeds are, fitted to about as many pieces
LATEST, EARLIEST, GAIN = 20, -8, 1e-3  # steps; of the loss a step: a smaller gain ends the search


def cut(missions: Mapping[str, np.ndarray], top: float, dt: float) -> Missions:
    """Missions on a grid of `dt`, s, in pieces that have their names; pieces without a measured step are left out."""
    total = sum(map(len, missions.values()))
    length = max(min(SECONDS / dt, max(LEAST / dt, total / 3)), total / MOST)
    pieces, names = [], []
    for name, rows in missions.items():
        for k, part in enumerate(np.array_split(rows, max(1, round(len(rows) / length)))):
            if scored(part).any():
                part = part.copy()
                if k:
                    part[0, MODE] = START if part[0, MODE] == LEARN else HOLD
                pieces.append(part)
                names.append(name)
    return Missions(pieces, top, names)


def moved(rows: np.ndarray, steps: int) -> np.ndarray:
    """Prepared samples whose measured speeds are earlier by some steps; a speed that has no place is left out."""
    shifted, places = rows.copy(), np.arange(len(rows)) + steps
    source = rows[places.clip(0, len(rows) - 1)]
    measured, stepped = (source[:, MODE] == LEARN) & (places >= 0) & (places < len(rows)), rows[:, MODE] >= PREDICT
    shifted[measured, SURGE] = source[measured, SURGE]
    shifted[stepped, MODE] = np.where(measured[stepped], LEARN, PREDICT)
    return shifted


def late(missions: Missions) -> tuple[Missions, int]:
    """The missions with their speeds moved, and by how many steps of the grid these were late."""
    some = range(0, len(missions.rows), max(1, len(missions.rows) // ENOUGH))
    part = Missions([missions.rows[k] for k in some], missions.top)
    tried = {0: part.fit(TERMS)}

    def loss(steps: int, beside: int) -> float:
        if steps not in tried:
            tried[steps] = _moved(part, steps).settled(tried[beside])
        return tried[steps].total

    at, way = 0, int(tried[0].theta[PLACE_LAG] >= 1) - int(tried[0].theta[PLACE_LAG] <= LAGS[0])
    while way and EARLIEST <= at + way <= LATEST and loss(at + way, at) < tried[at].total - GAIN * sum(part.steps):
        at += way
    return _moved(missions, at), at


def _moved(missions: Missions, steps: int) -> Missions:
    return Missions([moved(rows, steps) for rows in missions.rows], missions.top, missions.names)
