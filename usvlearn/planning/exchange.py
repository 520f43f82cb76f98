"""The search for the course that shrinks the intervals most: coordinate exchange over the segments of a plan.

The criterion is the mean logarithm of the widths of the intervals that are still wide. With a normal distribution it is
that of D-optimal designs for the quantities one by one (Atkinson, Donev & Tobias 2007, chapters 10 and 11); it has no
unit, so that newtons and seconds can be added. Coordinate exchange (Meyer & Nachtsheim 1995) goes through the segments
in turn, tries each throttle and each heading for one segment while the others stay, and keeps the best, until a whole
round changes nothing. It finds a local optimum, so it begins from several courses. A course outside the area is worse
than any inside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.errors import ConfigError
from usvlearn.estimators.joint.reading import Identified
from usvlearn.estimators.regressors.terms import SURGE
from usvlearn.planning.course import Course, Limits, planned
from usvlearn.planning.rehearsal import Rehearsal, Rehearsed

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

Cost = tuple[float, float]  # m outside the area; mean log width


class Plan(NamedTuple):
    """The best course that was found."""

    course: Course
    expected: Rehearsed
    path: np.ndarray  # (steps, 2) m north and east of the start
    throttles: np.ndarray  # (segments,)
    quarters: np.ndarray  # (segments,)
    evaluations: int


def wide(found: Identified) -> list[str]:
    """The quantities that are not well determined, without single parameters, which trade against each other."""
    return [
        name
        for name, (value, low, high, _) in found.items()
        if name not in SURGE and not high - low < 2 * WELL * abs(value)
    ]


def derived(found: Identified) -> list[str]:
    """All quantities but the single parameters."""
    return [name for name in found if name not in SURGE]


def log_width(found: Identified, aims: Sequence[str]) -> float:
    """The mean logarithm of the widths of some intervals."""
    widths = [found[name].high - found[name].low for name in aims]
    return float(np.mean([math.log(x) if 0 < x < math.inf else NOTHING for x in widths]))


def search(rehearsal: Rehearsal, limits: Limits, dt: float, aims: Sequence[str], seed: int = 0) -> Plan:
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
    count, n = 0, limits.segments

    def tried(places: np.ndarray, quarters: np.ndarray) -> Cost:
        nonlocal count
        count += 1
        course = planned(levels[places], quarters, limits, dt)
        expected = rehearsal(course.rows)
        outside = excess(course.path(expected.speed, rehearsal.current), limits)
        return (outside if outside > TOLERANCE else 0.0), log_width(expected.found, aims)

    best: tuple[Cost, np.ndarray, np.ndarray] | None = None
    for pattern in STARTS.values():
        places = np.resize(np.minimum(pattern, len(levels) - 1), n)
        quarters = np.resize([0, 0, 2, 2, 1, 1, 3, 3], n)
        cost = tried(places, quarters)
        for _ in range(ROUNDS):
            before = cost
            for k in rng.permutation(n):
                for row, options in ((places, range(len(levels))), (quarters, range(4))):
                    kept = row[k]
                    for option in options:
                        if option == kept:
                            continue
                        row[k] = option
                        if (other := tried(places, quarters)) < cost:
                            cost, kept = other, option
                    row[k] = kept
            if not cost < before:
                break
        if best is None or cost < best[0]:
            best = cost, places, quarters
    assert best is not None
    (outside, _), places, quarters = best
    if outside > 0:
        fastest = abs(rehearsal.top_speed(limits.most))
        raise ConfigError(
            f"--area: found {limits.area:g} m, and the best course leaves it by {outside:.0f} m, since the boat goes "
            f"{fastest:.2g} m/s at --command-max and keeps a heading for {limits.segment:g} s: give an area of "
            f"{2 * fastest * limits.segment:.0f} m, a shorter --segment, or a lower --command-max"
        )
    course = planned(levels[places], quarters, limits, dt)
    expected = rehearsal(course.rows)
    return Plan(course, expected, course.path(expected.speed, rehearsal.current), levels[places], quarters, count)


def excess(path: np.ndarray, limits: Limits) -> float:
    """How far a path leaves the area, m.

    >>> excess(np.array([[0.0, 0.0], [120.0, 0.0]]), Limits(area=200.0))
    20.0
    """
    cosine, sine = math.cos(limits.heading), math.sin(limits.heading)
    turned = path @ np.array([[cosine, -sine], [sine, cosine]])
    return float(max(np.abs(turned).max() - limits.area / 2, 0.0))
