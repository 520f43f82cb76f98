"""Two clocks in one log: the heading and the course over ground, which fit each other best some seconds apart.

For each lag, the concentration of the angle 2 (χ − ψ) between course χ and heading ψ is compared, on bins of 2 s in
which the boat moves: |mean exp(2i (χ − ψ))|. The factor 2 makes a boat that goes astern count like one that goes ahead,
and a constant error of the compass changes nothing. Neither commands nor the sign of a speed are needed.

A heading that is early is told from 5 s on, since filters of positions and receivers are late by up to 3 s, and drift
in a turn makes the course late, too. Nothing makes a heading late, so that one is told from the first bin on. In both
cases the lag must leave less than half of the dispersion 1 − |mean| that no lag leaves, and be better by 4 standard
errors over blocks of 20 s, or less than a quarter, and 2.4.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from usvlearn.logs.channels.bins import bin_directions
from usvlearn.logs.checks.evidence import MOVING, Evidence
from usvlearn.logs.checks.finding import Finding
from usvlearn.logs.checks.response import CLOCKS

STEP, FARTHEST = 2.0, 25  # s, of the bins; bins of lag that are tried
LEAST, LATE = 5.0, 2.0  # s, of a heading that is early, and of one that is late
SURE, CLOSE = ((4.0, 0.5), (2.4, 0.25)), 0.3  # standard errors, and of the dispersion that is left; dispersion
BLOCK, FEWEST = 10, 3  # bins: 20 s; blocks


def clocks(e: Evidence) -> Iterator[Finding]:
    """A heading whose stamps are of another clock than those of the position or of the velocity over ground."""
    edges = e.moving_edges(STEP, e.series["heading"])
    if len(edges) <= BLOCK * FEWEST + 2 * FARTHEST:
        return
    heading = np.exp(2j * np.angle(bin_directions(e.series["heading"], edges)))
    north, east = e.velocity(edges)
    velocity = north + 1j * east
    velocity[np.abs(velocity) < MOVING * min(e.surge_max, e.fastest)] = np.nan
    course = np.exp(2j * np.angle(velocity))[FARTHEST:-FARTHEST]
    lags = range(-FARTHEST, FARTHEST + 1)
    angles = np.stack([course * heading[FARTHEST + lag : len(heading) - FARTHEST + lag].conj() for lag in lags])
    angles = angles[:, np.isfinite(angles).all(0)]
    blocks = angles[:, : angles.shape[1] // BLOCK * BLOCK].reshape(len(angles), -1, BLOCK)
    if blocks.shape[1] < FEWEST:
        return
    means = blocks.mean((1, 2))
    spread = 1 - np.abs(means)
    best, none = int(spread.argmin()), FARTHEST
    lag = (best - none) * STEP
    aligned = (blocks * (means.conj() / np.abs(means))[:, None, None]).real.mean(2)  # (lags, blocks)
    gain = aligned[best] - aligned[none]
    certain = float(gain.mean()) / max(float(gain.std(ddof=1)) / math.sqrt(len(gain)), 1e-12)
    less = spread[best] / max(spread[none], 1e-12)
    sure = any(certain > errors and less < left for errors, left in SURE)
    if -LEAST < lag < LATE or abs(best - none) == FARTHEST or spread[best] > CLOSE or not sure:
        return
    channels = ", ".join(e.places if e.has_position else e.speeds)
    side = "later" if lag > 0 else "earlier"
    text = f"a heading that fits the course over ground {abs(lag):.0f} s {side} (dispersion × {less:.2f})"
    expected = f"less than {LATE if lag > 0 else LEAST:g} s: {CLOCKS}"
    yield Finding(e.boat, f"heading, {channels}", "clocks", text, expected)
