"""The search for the course that shrinks the intervals most: coordinate exchange over the segments of a plan.

The criterion is the mean logarithm of the widths of the intervals that are still wide. With a normal distribution it is
a compound of c-optimality criteria, one for each quantity (Atkinson, Donev & Tobias 2007, chapters 10 and 11); it has
no unit, so that newtons and seconds can be added. Coordinate exchange (Meyer & Nachtsheim 1995) goes through the
segments in turn, tries each throttle and each heading for one segment while the others stay, and keeps the best, until
a whole round changes nothing. It finds a local optimum, so it begins from several courses. A course outside the area
is worse than any inside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.errors import ConfigError
from usvlearn.estimators.joint.periodic_estimates import Identified, tells_sides
from usvlearn.estimators.joint.quantities import QUANTITIES
from usvlearn.estimators.regressors.terms import SURGE
from usvlearn.model.planning.course import Course, Limits, planned, steps_of
from usvlearn.model.planning.rehearsal import Rehearsal, Rehearsed

WELL = 0.1  # half-width over value, below which a quantity is well determined
SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)  # of the range of the commands
STARTS = {  # throttles of the first courses, as places in SHARES, repeated
    "staircase": (1, 2, 3, 4, 3, 2, 1, 0),
    "steps": (4, 0, 2, 0),
    "short steps": (2, 4, 1, 3, 0),
}
ROUNDS = 4
NOTHING = math.log(1e6)  # of an interval without an end
TOLERANCE = 0.01  # m outside the area that counts as inside

Cost = tuple[float, float]  # m outside the area, mean over the steps; mean log width


class BestCourse(NamedTuple):
    """The best course that was found."""

    course: Course
    expected: Rehearsed
    path: np.ndarray  # (steps, 2) m north and east of the start
    throttles: np.ndarray  # (segments,)
    quarters: np.ndarray  # (segments,)


def wide(found: Identified, one_command: bool = False) -> list[str]:
    """Those of `derived` that are not well determined."""
    return [
        name
        for name in derived(found, one_command)
        if not found[name].high - found[name].low < 2 * WELL * abs(found[name].value)
    ]


def derived(found: Identified, one_command: bool = False) -> list[str]:
    """All quantities of the surge but the single parameters, which trade against each other.

    With one command for both sides, those that tell the sides apart are left out, too.
    """
    names = [name for name in found if name in QUANTITIES and name not in SURGE]
    return [name for name in names if not (one_command and tells_sides(name))]


def log_width(found: Identified, aims: Sequence[str]) -> float:
    """The mean logarithm of the widths of some intervals."""
    widths = [found[name].high - found[name].low for name in aims]
    return float(np.mean([math.log(x) if 0 < x < math.inf else NOTHING for x in widths]))


def search(rehearsal: Rehearsal, limits: Limits, dt: float, aims: Sequence[str], seed: int = 0) -> BestCourse:
    """The course that shrinks the intervals of `aims` most.

    Args:
        dt: s, of a step.
        seed: of the order in which segments are changed.

    Raises:
        ConfigError: no course stays in the area.
    """
    rng = np.random.default_rng(seed)
    levels = limits.least + np.array(SHARES) * (limits.most - limits.least)
    if limits.least < 0:
        levels = np.unique([*levels, 0.0])
    n = limits.segments

    def tried(places: np.ndarray, quarters: np.ndarray) -> Cost:
        course = planned(levels[places], quarters, limits, dt)
        expected = rehearsal(course.rows)
        outside = beyond(course.path(expected.speed, rehearsal.current), limits)
        return float(outside.mean()) if outside.max() > TOLERANCE else 0.0, log_width(expected.found, aims)

    def improved(places: np.ndarray, quarters: np.ndarray) -> tuple[Cost, np.ndarray, np.ndarray]:
        cost = tried(places, quarters)
        for _ in range(ROUNDS):
            before = cost
            for k in rng.permutation(n):
                for row, options in ((places, range(len(levels))), (quarters, range(4))):
                    kept = row[k]
                    for option in options:
                        row[k] = option
                        if option != kept and (other := tried(places, quarters)) < cost:
                            cost, kept = other, option
                    row[k] = kept
            if not cost < before:  # a local optimum
                break
        return cost, places, quarters

    found = [
        improved(np.resize(np.minimum(pattern, len(levels) - 1), n), np.resize([0, 0, 2, 2, 1, 1, 3, 3], n))
        for pattern in STARTS.values()
    ]
    if all(cost[0] > 0 for cost, *_ in found):
        found.append(improved(*_near_the_start(rehearsal, limits, dt, levels)))
    _, places, quarters = min(found, key=lambda each: each[0])
    course = planned(levels[places], quarters, limits, dt)
    expected = rehearsal(course.rows)
    path = course.path(expected.speed, rehearsal.current)
    if beyond(path, limits).max() > TOLERANCE:
        fastest = abs(rehearsal.top_speed(limits.most))
        wider = max(2 * fastest * limits.segment, 1.5 * limits.area)
        raise ConfigError(
            f"--area: found {limits.area:g} m, and no course was found that stays within it, since the boat goes "
            f"{fastest:.2g} m/s at --command-max and keeps a heading for {limits.segment:g} s: give an area of "
            f"{wider:.0f} m, a shorter --segment, or a lower --command-max"
        )
    return BestCourse(course, expected, path, levels[places], quarters)


def beyond(path: np.ndarray, limits: Limits) -> np.ndarray:
    """How far each place of a path, `(steps, 2)`, is outside the area, m, `(steps,)`.

    >>> beyond(np.array([[0.0, 0.0], [120.0, 0.0]]), Limits(area=200.0)).tolist()
    [0.0, 20.0]
    """
    return np.maximum(np.abs(_in_square(path, limits)).max(-1) - limits.area / 2, 0.0)


def _in_square(path: np.ndarray, limits: Limits) -> np.ndarray:
    """A path in the directions of the square."""
    cosine, sine = math.cos(limits.heading), math.sin(limits.heading)
    return path @ np.array([[cosine, -sine], [sine, cosine]])


def _near_the_start(
    rehearsal: Rehearsal, limits: Limits, dt: float, levels: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Places in `levels` and headings that keep the boat near the start, also in a current; segment by segment."""
    places, quarters = np.zeros((2, limits.segments), dtype=int)
    places[:] = int(np.abs(levels).argmin())
    segment = steps_of(limits, dt)
    for k in range(limits.segments):
        steps = int((segment <= k).sum())

        def distance(option: tuple[int, int], k: int = k, steps: int = steps) -> float:
            places[k], quarters[k] = option
            course = planned(levels[places], quarters, limits, dt)
            path = course.path(rehearsal(course.rows).speed, rehearsal.current)[:steps]
            return float(np.abs(_in_square(path[segment[:steps] == k], limits)).max())

        places[k], quarters[k] = min(((level, q) for level in range(len(levels)) for q in range(4)), key=distance)
    return places, quarters
