"""The search for the course that shrinks the intervals most, and what is expected after a course.

Criterion, search and rehearsal: `docs/theory/identification.md#input-design`. The criterion has no unit, so that N
and s can be added. `identify` makes the intervals, as after a mission.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.events import NINETY
from usvlearn.core.jit import announce, jit
from usvlearn.core.prepared_samples import COS, DT, LEARN, LEFT, MODE, RIGHT, ROW
from usvlearn.engine import select_element
from usvlearn.engine.identified import reader_leaves
from usvlearn.engine.program import program_for
from usvlearn.errors import ConfigError
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.estimators.joint.kernel import forecast, learn, start
from usvlearn.estimators.joint.periodic_estimates import POSITIVE, Identified, around, identify, tells_sides
from usvlearn.estimators.joint.quantities import QUANTITIES
from usvlearn.estimators.joint.state import AT, NORTH, THETA
from usvlearn.estimators.regressors.terms import SURGE
from usvlearn.model.fit.boat import FittedBoat
from usvlearn.model.fit.gauss_newton import Fit
from usvlearn.model.fit.intervals import gradients, rehearsed
from usvlearn.model.fit.logs import DT as GRID
from usvlearn.model.fit.terms import prior
from usvlearn.model.planning.course import Course, Limits, planned, steps_of


class Rehearsed(NamedTuple):
    """What is expected after a course."""

    identified: Identified
    speed: np.ndarray  # (steps,) through the water, m/s


class Rehearsal:
    """Rehearses courses from the state of a boat's averaged joint EKF; a ConfigError without one."""

    def __init__(self, members: Mapping[str, Mapping[str, Any] | None], leaves: Mapping[str, np.ndarray]):
        description, read = reader_leaves(members, leaves)
        self.description = select_element(description, 1, 0)
        self._plan = program_for(self.description, (), np.dtype(float))
        self._node = self._plan.program[1]
        self._state = self._plan.pack({key: leaf.astype(float) for key, leaf in read.items()})
        self.current: np.ndarray = read["mean"][NORTH:THETA].astype(float)  # (2,) north and east, m/s
        self.identified = identify(self.description, read)

    def __call__(self, rows: np.ndarray) -> Rehearsed:
        """What is expected after a course, `(steps, ROW)`, which starts at rest; the state stays as it was."""
        state = self._state.copy()
        speed = self._advanced(state, rows, begin=True)
        return Rehearsed(self._identified(state), speed)

    def top_speed(self, command: float) -> float:
        """The speed through the water after a minute at a command of both sides, m/s."""
        rows = np.zeros((150, ROW))
        rows[:, [LEFT, RIGHT]], rows[:, DT], rows[:, COS], rows[:, MODE] = command, 0.4, 1.0, LEARN
        return float(self(rows).speed[-1])

    def by_part(self, rows: np.ndarray, ends: np.ndarray) -> list[Rehearsed]:
        """What is expected after each part of a course, `(steps, ROW)`; `ends` are the steps behind the parts."""
        state, rehearsed, first = self._state.copy(), [], 0
        for last in ends.tolist():
            speed = self._advanced(state, rows[first:last], begin=first == 0)
            rehearsed.append(Rehearsed(self._identified(state), speed))
            first = last
        return rehearsed

    def _advanced(self, state: np.ndarray, rows: np.ndarray, begin: bool) -> np.ndarray:
        speed, work = np.empty(len(rows)), np.empty(self._plan.work)
        with announce(__file__, "rehearsal"):
            _rehearse(self._node, state[0], self._plan.numbers[0], np.ascontiguousarray(rows), begin, work, speed)
        return speed

    def _identified(self, state: np.ndarray) -> Identified:
        return identify(self.description, {key: leaf.copy() for key, leaf in self._plan.unpack(state).items()})


def refitted(boat: FittedBoat, course: np.ndarray, dt: float) -> dict[str, Quantity]:
    """The quantities with the intervals of a refit with one more mission, `(time, ROW)`, of steps of dt, s."""
    rows = np.repeat(course, max(round(dt / GRID), 1), axis=0)
    rows[:, DT] = GRID
    C, known, none = boat.covariance, prior(boat.terms, boat.top), np.zeros(0)
    own = (np.linalg.inv(C) - known.information)[None]
    fit = Fit(boat.terms, boat.top, boat.every(boat.theta), known, none, none, none, own, boat.noise)
    less, found = C - np.linalg.inv(np.linalg.inv(C) + rehearsed(rows, fit).information.sum(0)), {}
    for name, slope in gradients(fit, boat.mass).items():
        value, low, high, unit = boat[name]
        width = value * math.log(high / low) if name in POSITIVE and low > 0 else high - low
        rest = (width / 2 / NINETY) ** 2 - float(slope @ less @ slope)
        found[name] = Quantity(value, *around(name, value, math.sqrt(max(rest, 0.0))), unit)
    return found


@jit(entry=True)
def _rehearse(node, s, q, rows, begin, work, speed):
    """Learn each step's own prediction; the noise stays as it is."""
    noise = s[node[AT.noise]]
    if begin:
        start(node, s, q, 0.0)
    for k in range(len(rows)):
        predicted = forecast(node, s, q, rows[k], work)
        learn(node, s, q, rows[k], predicted, predicted, work)
        s[node[AT.noise]] = noise
        speed[k] = s[node[AT.mean]]


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


def wide(identified: Identified, one_command: bool = False) -> list[str]:
    """Those of `derived` that are not well determined."""
    return [
        name
        for name in derived(identified, one_command)
        if not identified[name].high - identified[name].low < 2 * WELL * abs(identified[name].value)
    ]


def derived(identified: Identified, one_command: bool = False) -> list[str]:
    """All quantities of the surge but the single parameters, and with one command those that tell the sides apart."""
    names = [name for name in identified if name in QUANTITIES and name not in SURGE]
    return [name for name in names if not (one_command and tells_sides(name))]


def log_width(identified: Identified, aims: Sequence[str]) -> float:
    """The mean logarithm of the widths of some intervals."""
    widths = [identified[name].high - identified[name].low for name in aims]
    return float(np.mean([math.log(x) if 0 < x < math.inf else NOTHING for x in widths]))


def search(rehearsal: Rehearsal, limits: Limits, dt: float, aims: Sequence[str], seed: int = 0) -> BestCourse:
    """The course that shrinks the intervals of `aims` most; a ConfigError if none stays in the area."""
    rng = np.random.default_rng(seed)
    levels = limits.least + np.array(SHARES) * (limits.most - limits.least)
    if limits.least < 0:
        levels = np.unique([*levels, 0.0])
    n = limits.segments

    def tried(places: np.ndarray, quarters: np.ndarray) -> Cost:
        course = planned(levels[places], quarters, limits, dt)
        expected = rehearsal(course.rows)
        outside = beyond(course.path(expected.speed, rehearsal.current), limits)
        return float(outside.mean()) if outside.max() > TOLERANCE else 0.0, log_width(expected.identified, aims)

    def improved(places: np.ndarray, quarters: np.ndarray) -> tuple[Cost, np.ndarray, np.ndarray]:
        cost = tried(places, quarters)
        for _ in range(ROUNDS):
            before = cost
            for k in rng.permutation(n):
                for row, options in ((places, range(len(levels))), (quarters, range(4))):
                    chosen = row[k]
                    for option in options:
                        row[k] = option
                        if option != chosen and (other := tried(places, quarters)) < cost:
                            cost, chosen = other, option
                    row[k] = chosen
            if not cost < before:  # a local optimum
                break
        return cost, places, quarters

    starts = [
        improved(np.resize(np.minimum(pattern, len(levels) - 1), n), np.resize([0, 0, 2, 2, 1, 1, 3, 3], n))
        for pattern in STARTS.values()
    ]
    if all(cost[0] > 0 for cost, *_ in starts):
        starts.append(improved(*_near_the_start(rehearsal, limits, dt, levels)))
    _, places, quarters = min(starts, key=lambda each: each[0])
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
    return BestCourse(course, expected, path)


def beyond(path: np.ndarray, limits: Limits) -> np.ndarray:
    """How far each place of a path, `(steps, 2)`, is outside the area, m, `(steps,)`."""
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


def csv_lines(plan: BestCourse) -> Iterator[str]:
    """A plan as a table: a row for each change of a command or of the wanted heading, and one that ends the plan.

    Commands are shares of full scale, as the logs have been read. `throttle` and `steering` are half the sum and half
    the difference of both, which is what a skid-steering autopilot mixes to left and right. Speed and place are what is
    expected at that time, from a start at rest.
    """
    course, n = plan.course, len(plan.course.left)
    speed, path = np.append(0.0, plan.expected.speed), np.concatenate([np.zeros((1, 2)), plan.path])
    watched = np.stack([course.left, course.right, course.wanted])
    changes = np.flatnonzero(np.append(True, (np.abs(np.diff(watched)) > 1e-9).any(0)))
    yield "time_s,left,right,throttle,steering,heading_deg,expected_speed_m_s,expected_north_m,expected_east_m"
    for k in [*changes.tolist(), n]:
        left, right = (float(course.left[k]), float(course.right[k])) if k < n else (0.0, 0.0)
        heading = math.degrees(course.wanted[min(k, n - 1)]) % 360
        shares = (f"{x:.3f}" for x in (left, right, (left + right) / 2, (left - right) / 2))
        place = (f"{x:.1f}" for x in path[k])
        yield ",".join([f"{k * course.dt:.1f}", *shares, f"{heading:.0f}", f"{speed[k]:.2f}", *place])
