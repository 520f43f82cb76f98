"""The offset of the compass and the current, from the velocity over ground across the hull.

Equation (1): `docs/theory/identification.md#batch-fit-ground`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from usvlearn.core.events import NINETY
from usvlearn.core.prepared_samples import COS, LEARN, MODE, SIN, YAW_RATE
from usvlearn.estimators.axis.turning_quantities import OF_FIT
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.model.fit.boat import FittedBoat
from usvlearn.model.fit.logs import ACROSS, ALONG, DT, TURNS
from usvlearn.model.fit.pieces import SECONDS

FEW = 8.0  # variances are larger by this over the number of pieces
OWN_ERROR = {"compass_offset": 0.02, "current": 0.001}  # deg, m/s
NO_GROUND = "Neither course nor position was measured: compass_offset and current are not known. Log one of them."
LEAST_PIECES = 3  # of a mission whose current is told: fewer have no scatter
CIRCLES = "The boat went in circles of one speed: compass_offset is not known. Let it go straight, too."
FEW_COURSES = "No log of 7 min or more has several courses: compass_offset and current are not known. Let it turn."


def with_ground(boat: FittedBoat, missions: Mapping[str, np.ndarray]) -> FittedBoat:
    """The boat with what its compass shows too much and the mean size of its missions' currents; NaN if unknown."""
    parts, turned, count = [], np.zeros(len(missions), bool), 3 + 2 * len(missions)
    for k, rows in enumerate(each for each in missions.values() if each.shape[1] > ACROSS):
        use = (rows[:, MODE] == LEARN) & np.isfinite(rows[:, ACROSS])
        along, r, s, c, y = rows[use][:, [ALONG, YAW_RATE, SIN, COS, ACROSS]].T
        X, at = np.column_stack([-along, along * r, r, -s, c]), [0, 1, 2, 3 + 2 * k, 4 + 2 * k]
        pieces = max(round(len(rows) * DT / SECONDS), 1)
        turned[k] = pieces >= LEAST_PIECES and np.linalg.eigvalsh(X[:, 3:].T @ X[:, 3:])[0] > TURNS * len(X)
        for part in np.array_split(np.arange(len(X)), pieces) if use.any() else []:
            parts.append((at, X[part], y[part]))
    quantities, n = {name: Quantity(math.nan, math.nan, math.nan, OF_FIT[name]) for name in OWN_ERROR}, len(parts)
    if not turned.any():
        why = FEW_COURSES if parts else NO_GROUND
        return replace(boat, quantities=boat.quantities | quantities, lacks=(*boat.lacks, why))
    H, g, scores = 1e-6 * np.eye(count), np.zeros(count), np.zeros((n, count))  # of a current without information
    for at, X, y in parts:
        H[np.ix_(at, at)] += X.T @ X
        g[at] += X.T @ y
    A, theta = np.linalg.inv(H), np.linalg.solve(H, g)
    for score, (at, X, y) in zip(scores, parts, strict=True):
        score[at] = X.T @ (y - X @ theta[at])
    P = (n / max(n - 1, 1) + FEW / n) * A @ scores.T @ scores @ A
    currents = np.cos(np.arctan(theta[0])) * theta[3:].reshape(-1, 2)
    sizes, slope = np.hypot(*currents.T), np.zeros(count)
    slope[3:] = (turned / turned.sum() / np.maximum(sizes, 1e-9) * currents.T).T.ravel()
    offset, size = math.degrees(math.atan(theta[0])), float(sizes[turned].mean())
    half, lacks = NINETY * math.hypot(math.degrees(math.sqrt(P[0, 0])), OWN_ERROR["compass_offset"]), boat.lacks
    if 1 / A[0, 0] > TURNS * H[0, 0]:  # of S², what the drift of turns and currents do not explain
        quantities["compass_offset"] = Quantity(offset, offset - half, offset + half, "deg")
    else:
        lacks += (CIRCLES,)
    half = NINETY * math.hypot(math.sqrt(slope @ P @ slope), OWN_ERROR["current"])
    quantities["current"] = Quantity(size, max(size - half, 0.0), size + half, "m/s")
    return replace(boat, quantities=boat.quantities | quantities, lacks=lacks)
