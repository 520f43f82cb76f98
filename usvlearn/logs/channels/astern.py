"""Speeds that lack their sign while a boat goes astern, as a receiver's speed over ground does.

A speed with a sign falls below zero while both commands push astern for long. One without a sign falls to zero and
rises again. A boat that only brakes does not: its speed falls all the time.
"""

from __future__ import annotations

import numpy as np

PUSHES, SIGNED, RISES = -0.1, 0.03, 0.15  # of full scale; of the greatest speed
ENOUGH, MOSTLY = 2, 0.5  # stretches; share of the time, from which rather the sign of the commands is wrong


def without_sign(left: np.ndarray, right: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Where a speed, m/s, is known to lack its sign, `(n,)` bool.

    Speed and commands, shares of full scale, are in the order of time; NaN where unknown.
    """
    none, known = np.zeros(len(speed), bool), speed[np.isfinite(speed)]
    if not len(known) or (fastest := float(np.quantile(np.abs(known), 0.995))) <= 0:
        return none
    back = (left < PUSHES) & (right < PUSHES)
    if float(np.quantile(known, 0.005)) < -SIGNED * fastest or back.mean() > MOSTLY:
        return none
    edges = np.flatnonzero(np.diff(np.concatenate([[False], back, [False]]).astype(np.int8)))
    found, stretches = none.copy(), 0
    for first, last in edges.reshape(-1, 2):
        part = speed[first:last]
        if not np.isfinite(part).any():
            continue
        low = int(np.nanargmin(part))
        if np.nanmax(part[low:]) - part[low] > RISES * fastest and part[low] < 0.5 * fastest:
            found[first + low : last], stretches = True, stretches + 1
    return found if stretches >= ENOUGH else none
