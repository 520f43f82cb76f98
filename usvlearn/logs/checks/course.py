"""A course over ground in place of a heading, and iron near a compass, by the velocity over ground along and across it.

A current c adds Re(c exp(−iψ)) to the speed along a heading ψ, and Im(c exp(−iψ)) across it. Both are fitted by least
squares over bins of 2 s: the speed along beside the thrust, the speed across beside the turn. Only along a course, the
velocity has no part across. An error A sin(ψ + φ) of a compass adds u times as much across, with the speed u. Without a
current or wind, a course cannot be told from the heading of a boat without sway.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from usvlearn.logs.channels.bins import bin_directions, bin_means, bin_rates
from usvlearn.logs.channels.channel import COMMANDS, SURGE
from usvlearn.logs.checks.evidence import Evidence
from usvlearn.logs.checks.finding import NOTE, Finding, see

STEP, FEWEST, BLOCKS = 2.0, 120, 6  # s, of the bins; bins; blocks of the jackknife
SURE, LEAST, ACROSS = 5.0, 0.15, 0.15  # standard errors; m/s along; share of that across
OFF, CLEAR, LONG = math.radians(12), 2.5, 270  # of what changes with the heading; standard errors; bins


def compass(e: Evidence) -> Iterator[Finding]:
    """A heading along which there is a current, and across which there is none; or off by what changes with it."""
    edges = e.moving_edges(STEP, e.series["heading"])
    if len(edges) <= FEWEST:
        return
    way: np.ndarray[Any, np.dtype[np.complex128]] = bin_directions(e.series["heading"], edges)
    turn = bin_rates(e.series["heading"], edges, wraps=True)
    north, east = e.velocity(edges)
    left, right = (bin_means(e.series[name], edges, held=True) for name in COMMANDS)
    thrust = np.convolve(left + right, (0.5, 0.3, 0.2))[: len(way)]  # the boat answers within some seconds
    velocity, one = (north + 1j * east) * way.conj(), np.ones(len(way))
    speed, current = bin_means(e.series[SURGE], edges), (way.real, way.imag)
    parts = (
        (velocity.real, thrust, thrust * np.abs(thrust), *current),
        (velocity.imag, turn, turn * thrust, *current),
        (velocity.imag, speed, turn * speed, *current, speed * way.real, speed * way.imag),
    )
    known = np.isfinite(velocity + thrust + turn + speed)
    if known.sum() < FEWEST:
        return
    block, found = np.arange(known.sum()) * BLOCKS // known.sum(), []
    for goal, *others in parts:
        rows = np.stack([one, *others], 1)[known]
        fits = [np.linalg.lstsq(rows[block != k], goal[known][block != k])[0][-2:] for k in range(-1, BLOCKS)]
        error = math.sqrt((BLOCKS - 1) / BLOCKS * float(np.square(fits[1:] - np.mean(fits[1:], 0)).sum()))
        found.append((float(np.hypot(*fits[0])), error))
    (along, error), (across, _), (off, doubt) = found
    if along > max(LEAST, SURE * error) and across < ACROSS * along:
        text = f"a current of {along:.2f} m/s along the heading, and {across:.2f} m/s across it: it may be a course"
        expected = "as much across a compass's heading, unless the position is computed from it"
        yield Finding(e.boat, "heading", "course", text, see(expected, "heading"), severity=NOTE)
    if e.sense != -1 and off > max(OFF, CLEAR * doubt) and known.sum() > LONG:
        text = f"a heading that is {math.degrees(off):.0f}° off on one course, and the other way on the opposite one"
        yield Finding(e.boat, "heading", "compass", text, "the same on all courses: calibrate the compass on board")
