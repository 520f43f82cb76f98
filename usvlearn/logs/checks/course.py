"""Checks the heading by the velocity over ground: a course in its place, and errors that change.

A current c adds Re(c exp(−iψ)) to the speed along a heading ψ, and Im(c exp(−iψ)) across it. Both are fitted by least
squares over bins of 2 s: the speed along beside the thrust, the speed across beside the turn. Only along a course, the
velocity has no part across. Without a current or wind, a course cannot be told from the heading of a boat without sway.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from usvlearn.logs.channels.bins import bin_means
from usvlearn.logs.channels.channel import COMMANDS, SURGE
from usvlearn.logs.channels.position_rates import BLOCKS, LEG, Legs, deviations, jackknife, legs_of, offset
from usvlearn.logs.checks.evidence import Evidence
from usvlearn.logs.checks.finding import NOTE, Finding, see

FEWEST = 120  # bins
SURE, LEAST, ACROSS = 5.0, 0.15, 0.15  # standard errors; m/s along; share of that across
OFF, CLEAR, LONG = math.radians(12), 2.5, 270  # errors of two headings, or of one on two courses; their errors; bins
PART, WHOLE = 15, 25  # fewest bins of a third, and of a log


def compass(e: Evidence) -> Iterator[Finding]:
    """A heading along which there is a current, and across which there is none; or off by what changes with it."""
    edges, legs = _legs(e)
    over_ground, way, ahead, turn = legs
    if len(way) < FEWEST:
        return
    left, right = (bin_means(e.series[name], edges, held=True) for name in COMMANDS)
    thrust = np.convolve(left + right, (0.5, 0.3, 0.2))[: len(way)]  # the boat answers within some seconds
    velocity: NDArray[np.complex128] = over_ground * way.conj()
    one, current = np.ones(len(way)), (way.real, way.imag)
    parts = (
        (velocity.real, thrust, thrust * np.abs(thrust), *current),
        (velocity.imag, turn, turn * thrust, *current),
    )
    known = np.isfinite(velocity + thrust + turn + ahead)
    if known.sum() < FEWEST:
        return
    sizes = []
    for goal, *others in parts:
        fits = jackknife(np.stack([one, *others], 1)[known], goal[known])[:, -2:]
        sizes.append((float(np.hypot(*fits[0])), math.sqrt((BLOCKS - 1) * float(fits[1:].var(0).sum()))))
    (along, error), (across, _) = sizes
    if along > max(LEAST, SURE * error) and across < ACROSS * along:
        text = f"a current of {along:.2f} m/s along the heading, and {across:.2f} m/s across it: it may be a course"
        expected = "as much across a compass's heading, unless the position is computed from it"
        yield Finding(e.boat, "heading", "course", text, see(expected, "heading"), severity=NOTE)
    if e.sense == -1:
        return
    sure = (CLEAR, known.sum() > LONG, "on the opposite one"), (SURE, True, "a quarter of a turn from it")
    for (off, doubt), (errors, enough, where) in zip(deviations(legs), sure, strict=False):
        if enough and off > max(OFF, errors * doubt):
            text = f"a heading that is {math.degrees(off):.0f}° off on one course, and the other way {where}"
            expected = "the same on all courses: calibrate the compass on board"
            yield Finding(e.boat, "heading", "compass", text, expected)
            return


def compass_of_runs(e: Evidence) -> Iterator[Finding]:
    """A heading whose error is not the same in all logs, or in all thirds of one of them."""
    legs_of = {log.recordings[0].run: _legs(log)[1] for log in e.alone or [e] if log.sense != -1}
    offsets = {run: off for run, legs in legs_of.items() if (off := offset(legs, WHOLE))}
    far = {off: sum(_apart(off, other) for other in offsets.values()) for off in offsets.values()}
    usual = min(far, key=lambda off: (far[off], abs(off[0])), default=(0.0, 0.0))
    odd = [f"{round(math.degrees(-off[0])):+d}° off in {run}" for run, off in offsets.items() if _differ(off, usual)]
    if odd:
        text = f"a heading that is {', '.join(odd)}, and {round(math.degrees(-usual[0])):+d}° off in other logs"
        expected = "one error in all logs: read those by a configuration with a heading.zero of their own"
        yield Finding(e.boat, "heading", "compass of runs", text, expected)
    for run, legs in legs_of.items():
        thirds = [Legs(*parts) for parts in zip(*(np.array_split(each, 3) for each in legs), strict=True)]
        offs = [off for third in thirds if (off := offset(third, PART))]
        if any(_differ(one, other) for one in offs for other in offs):
            shown = ", then ".join(f"{round(math.degrees(-off)):+d}°" for off, _ in offs)
            text = f"a heading that is {shown} off in the thirds of {run}: a gyro drifts, or a compass was moved"
            expected = "one error from begin to end: correct it, or leave out the log"
            yield Finding(e.boat, "heading", "compass drift", text, expected)


def _legs(e: Evidence) -> tuple[np.ndarray, Legs]:
    """The edges of bins, s, and what tells the error of a heading; the size of a speed from positions needs none."""
    heading = e.series["heading"]
    edges = e.moving_edges(LEG, heading)
    north, east = e.velocity(edges)
    legs = legs_of(north + 1j * east, heading, e.series[SURGE], edges)
    return edges, legs if e.speeds == (SURGE,) else legs._replace(ahead=np.hypot(north, east))


def _apart(one: tuple[float, float], other: tuple[float, float]) -> float:
    """The angle between two errors of a heading, rad."""
    return abs(math.remainder(one[0] - other[0], 2 * math.pi))


def _differ(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether they surely differ, by their standard errors."""
    return _apart(one, other) > max(OFF, SURE * math.hypot(one[1], other[1]))
