"""Velocities over ground: to the north and to the east, or speed and course, which give the sway, v = V sin(χ − ψ).

A course that a receiver smooths comes late, and then tells a sway in each turn that is none. So both are written only
where the sway that they give follows the rate of position across the hull.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from usvlearn.logs.channels.bins import cleaned
from usvlearn.logs.channels.channel import AUTO, COURSES
from usvlearn.logs.channels.correlations import SURE
from usvlearn.logs.channels.position_rates import speed_on_positions, sway_on_positions
from usvlearn.logs.inspection.candidate import UNRANKED, Candidate, rank
from usvlearn.logs.inspection.decision import CERTAIN, ORDER, PROBABLE, UNSURE, Decision, least
from usvlearn.logs.inspection.directions import Heading, agreement, read_any_turn
from usvlearn.logs.inspection.position_channels import MOVING, Pair, Places, course_of
from usvlearn.logs.inspection.speeds import RATIO, Speed, read_speed, vectors
from usvlearn.logs.inspection.sway_channels import FOLLOWS
from usvlearn.logs.inspection.vocabulary import OVER_GROUND, fit, words

MOST = 4  # speeds that are tried
BACK, ENOUGH = 0.15, 5.0  # of the greatest speed; s, from which a boat goes astern by its course
Both = tuple[Candidate, Candidate]  # to the north and to the east
ALONG = 0.8  # mean cosine of heading and direction of a velocity over ground
EAST = {"VN": "VE", "vx": "vy"}  # beside the velocity to the north
TURNS = 0.3  # variance of that direction on the circle, from which it is no chance


class Velocities(NamedTuple):
    """The velocity over ground in two components, and their size as a speed."""

    north: Candidate
    east: Candidate
    size: Speed
    guessed: bool = False  # whether only their direction tells it, and hardly changes


def named_velocities(pool: Sequence[Candidate], convention: str) -> Both | None:
    """The velocities to the north and to the east by format or name, if there are."""
    known = [each for each in pool if rank(each, "velocity", convention) < UNRANKED]
    for north in sorted(known, key=lambda each: rank(each, "velocity", convention)):
        for east in pool:
            twin = (east.name, east.field) == (north.name, EAST.get(north.field or ""))
            if twin and len(east.value) == len(north.value):
                return north, east
    for north in pool:
        for east in pool if fit("velocity_north", north.label) >= 2 else ():
            if fit("velocity_east", east.label) >= 2 and (east.name == north.name or north.field in (None, "data")):
                return north, east
    return None


def find_velocities(
    pool: Sequence[Candidate], places: Sequence[Places], heading: Pair | None, convention: str, known: Both | None
) -> Velocities | None:
    """Two series that are the velocity to the north and to the east, known or by their direction, if there are."""
    if known:
        return _velocities(*known, places, heading, convention)
    for x, y in vectors(pool):
        if heading is None or len(x.value) != len(y.value):
            continue
        time, fast = x.time, np.hypot(x.value, y.value) > 0.3 * math.hypot(x.size, y.size)
        for north, east in ((y, x), (x, y)):
            direction = np.arctan2(east.value, north.value)[fast]
            ahead = float(np.cos(np.arctan2(y.value, x.value)[fast]).mean())  # 1 of a vector along the hull
            if max(ALONG, ahead) <= agreement(heading, (time[fast], direction)):
                turns = 1 - abs(np.exp(1j * direction).mean())  # 0 if it is constant, as along a hull
                return _velocities(north, east, places, heading, convention)._replace(guessed=bool(turns < TURNS))
    return None


def _velocities(
    north: Candidate, east: Candidate, places: Sequence[Places], heading: Pair | None, convention: str
) -> Velocities:
    same = len(north.value) == len(east.value)
    size = north.named(value=np.hypot(north.value, east.value) if same else np.abs(north.value))
    relation = speed_on_positions(*places[0][-2:], size.evidence, heading) if places and same else None
    return Velocities(north, east, read_speed(size, relation, convention, 3.0, places[0].length if places else ""))


def report_velocities(
    velocities: Velocities, speeds: Sequence[Speed], channels: dict, series: dict, doubt: str
) -> list[Decision]:
    """Both components, from which the surge is computed with the heading; and why they may be interchanged, or ""."""
    size, decisions = velocities.size, []
    others = tuple(each.candidate.label for each in speeds[:3])
    for name, candidate in (("velocity_north", velocities.north), ("velocity_east", velocities.east)):
        channels[name] = candidate.source(unit=size.unit, window=AUTO)
        series[name] = candidate
        sure = UNSURE if velocities.guessed or doubt else CERTAIN if size.confirmed else PROBABLE
        why = doubt or ("by its direction" if velocities.guessed else "by name")
        why += "; their size follows the rate of position" if size.confirmed else ""
        decisions.append(Decision(name, "series", candidate.label, sure, why))
        decisions.append(Decision(name, "unit", size.unit, size.certainty, size.reason, size.alternatives))
    why = "velocities and heading give a signed surge" + (f"; before {', '.join(others)}" if others else "")
    sure = UNSURE if velocities.guessed else PROBABLE
    return [*decisions, Decision("surge", "series", "from the velocities", sure, why, others)]


class Course(NamedTuple):
    """A course and a speed over ground that tell the sway."""

    course: Heading
    speed: Speed
    why: str


def find_course(
    pool: Sequence[Candidate], speeds: Sequence[Speed], places: Places | None, heading: Heading | None
) -> Course | None:
    """The course and the speed over ground whose sway follows an oriented position best, if one does."""
    if places is None or heading is None:
        return None
    known = course_of(places)
    courses: list[tuple[float, Course]] = []
    for each in pool:
        if fit("course", each.label) < 2:
            continue
        course = read_any_turn(each, known)
        for speed in speeds[:MOST] if course.certainty == CERTAIN else ():
            if speed.candidate.is_signed:
                continue
            sway = _part(np.sin, speed.metres, course.radians, heading.radians)
            relation = sway_on_positions(places.north, places.east, heading.radians, sway)
            follows = relation.correlation >= FOLLOWS and relation.certainty >= SURE
            if follows and 1 / RATIO < relation.slope < RATIO:
                why = f"the sway that both give is {relation.slope:.3g} × the rate of position across the hull"
                why += f" (correlation {relation.correlation:.2f})"
                courses.append((relation.correlation, Course(course, speed, why)))
    return max(courses, key=lambda each: each[0], default=(0.0, None))[1]


def course_beside(pool: Sequence[Candidate], speed: Speed, heading: Heading | None) -> Course | None:
    """The course over ground of a speed that has no sign, from which the surge gets one; None if none is logged."""
    named = [each for each in pool if fit("course", each.label) >= 2 and each.varies]
    if heading is None or not named:
        return None
    read = [read_any_turn(each, heading.radians) for each in named]
    best = max(read, key=lambda each: (ORDER.index(UNSURE) - ORDER.index(each.certainty), each.agreement))
    best = best._replace(certainty=least(best.certainty, PROBABLE))
    return Course(best, speed, "by name; with the heading, course and speed give a signed surge")


def reckoned(
    pool: Sequence[Candidate], speeds: Sequence[Candidate], velocity: tuple[Candidate, Candidate] | None
) -> tuple[tuple[Pair, Pair], Pair, Pair] | None:
    """The track of velocities, or of course and speed, the course while moving, rad, and the speed, if logged."""
    course = max(pool, key=lambda each: fit("course", each.label), default=None)
    if velocity:
        (time, north), (other, east) = (cleaned(each.evidence) for each in velocity)
        east = np.interp(time, other, east)
        speed, angle = (time, np.hypot(north, east)), np.arctan2(east, north)
    elif speeds and course and fit("course", course.label) >= 2:
        speed = max(speeds, key=lambda each: bool({"sog", *OVER_GROUND} & {*words(each.label)})).evidence
        time, angle = cleaned(read_any_turn(course, None).radians)
    else:
        return None
    fast = np.abs(np.interp(time, *cleaned(speed)))
    way, moving = np.gradient(time) * fast, fast > MOVING * np.quantile(fast, 0.95) if len(time) else fast > 0
    track = (time, np.cumsum(way * np.cos(angle))), (time, np.cumsum(way * np.sin(angle)))
    return track, (time[moving], angle[moving]), speed


def seconds_back(chosen: Course, heading: Heading) -> float:
    """How long a speed over ground without a sign is astern by its course, s."""
    _, ahead = _part(np.cos, chosen.speed.metres, chosen.course.radians, heading.radians)
    back = ahead < -BACK * np.quantile(np.append(np.abs(ahead), 0.0), 0.95)
    seconds = float(chosen.course.candidate.interval * back.sum())
    return seconds if seconds > ENOUGH and not chosen.speed.candidate.is_signed else 0.0


def _part(of: Callable[[np.ndarray], np.ndarray], speed: Pair, course: Pair, heading: Pair) -> Pair:
    """The speed ahead (cos) or across (sin) at the times of the course, m/s; speed and heading are interpolated."""
    (at, size), (time, angle), (stamps, turned) = map(cleaned, (speed, course, heading))
    return time, np.interp(time, at, size) * of(angle - np.interp(time, stamps, np.unwrap(turned)))


def report_course(chosen: Course, channels: dict[str, dict[str, Any]], series: dict[str, Candidate]) -> list[Decision]:
    """Both as channels, and what is said about them."""
    course, speed = chosen.course, chosen.speed
    scale = {} if course.span == 1 else {"span": course.span}
    sources = speed.candidate.source(unit=speed.unit), course.candidate.source(unit=course.unit, **scale)
    why, decisions = chosen.why, []
    both: tuple[Speed | Heading, ...] = speed, course
    for name, source, each in zip(COURSES, sources, both, strict=True):
        channels[name], series[name] = {**source, "window": AUTO}, each.candidate
        sure = least(course.certainty, each.certainty)
        decisions.append(Decision(name, "series", each.candidate.label, course.certainty, why))
        decisions.append(Decision(name, "unit", each.unit, sure, each.reason, each.alternatives))
    return decisions
