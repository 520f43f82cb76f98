"""By how much a compass is off, from the rate of position, apart from current, leeway and the drift of turns.

The velocity over ground w, north + i east, is that through the water, turned by the error δ of the heading ψ, and a
current c; in a turn r the hull drifts outwards:

    w = u (a + b r) exp(i ψ) + c,    δ = arg a

a, b and c are complex, and fitted by least squares over bins in which the boat moves ahead, on several courses. The
error of δ is that of a jackknife over blocks of the log, so that a current that changes makes δ uncertain.
"""

from __future__ import annotations

import math

import numpy as np

from usvlearn.logs.channels.bins import Series, bin_directions, bin_edges, bin_means, bin_rates

STEP, BLOCKS, FEWEST = 2.0, 6, 40  # s, of the bins; blocks; bins
ALIKE, ASTERN = 0.6, math.cos(math.radians(165))  # of the mean direction of the course from the heading, if it is known
MOVES, STRAIGHT = 0.3, 0.9  # of the greatest speed; length of the mean heading, beyond which there is one course alone
OFF, SURE, EXACT = math.radians(6), 4.0, math.radians(2.5)  # errors that are told; in, and of standard errors


def compass_error(north: Series, east: Series, heading: Series, speed: Series) -> tuple[float, float] | None:
    """What has to be added to a heading, and its standard error, rad; None unless it is surely more than `OFF`."""
    edges = bin_edges(STEP, north, east, heading, speed)
    along = bin_directions(heading, edges)
    over_ground = bin_rates(north, edges) + 1j * bin_rates(east, edges)
    ahead, turn = bin_means(speed, edges), bin_rates(heading, edges, wraps=True)
    fastest = np.nanquantile(np.abs(ahead), 0.98) if np.isfinite(ahead).any() else 0.0
    with np.errstate(invalid="ignore"):
        fast = (ahead > MOVES * fastest) & np.isfinite(over_ground * along * turn)
        off = np.mean((over_ground * along.conj() / np.abs(over_ground))[fast]) if fast.any() else 0.0
    whole = float(np.angle(off)) if abs(off) > ALIKE and off.real > ASTERN * abs(off) else 0.0
    for _ in range(3):  # each leaves out bins of a boat that goes astern, by the error that is known so far
        known = fast & ((over_ground * along.conj() * np.exp(-1j * whole)).real > 0)
        if known.sum() < FEWEST or abs(np.mean(along[known])) > STRAIGHT:
            return None
        push, goal = ahead[known] * along[known], over_ground[known]
        rows = np.stack([push, push * turn[known], np.ones(len(push))], 1)
        whole = float(np.angle(np.linalg.lstsq(rows, goal)[0][0]))
    block = np.arange(len(push)) * BLOCKS // len(push)
    parts = [np.angle(np.linalg.lstsq(rows[block != k], goal[block != k])[0][0]) for k in range(BLOCKS)]
    error = math.sqrt((BLOCKS - 1) / BLOCKS * float(np.sum(np.square(np.array(parts) - np.mean(parts)))))
    return (whole, error) if abs(whole) > max(OFF, SURE * error) and error < EXACT else None
