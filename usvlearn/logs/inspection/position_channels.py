"""Finds the series of the boat's position, and computes its course over ground and the rate of its position."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import permutations
from typing import NamedTuple

import numpy as np

from usvlearn.logs.channels.bins import cleaned
from usvlearn.logs.channels.channel import AUTO, degrees
from usvlearn.logs.channels.position_rates import Motion, position_on_velocity, speed_on_positions
from usvlearn.logs.inspection.candidate import Candidate, rank
from usvlearn.logs.inspection.decision import CERTAIN, PROBABLE, UNSURE, Decision, least
from usvlearn.logs.inspection.vocabulary import SETPOINT, fit, words

Pair = tuple[np.ndarray, np.ndarray]  # time, s, and value
METRES = 6_371_000.0 * math.pi / 180  # of a degree of latitude
LENGTHS = {"m": 1.0, "metre": 1.0, "meter": 1.0, "utm": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0,
           **dict.fromkeys(("nm", "nmi", "nautical"), 1852.0), **dict.fromkeys(("yd", "yard", "yards"), 0.9144),
           **dict.fromkeys("ft foot feet fuss pied pieds pies piedi voet".split(), 0.3048)}  # fmt: skip
SPAN = 2.0  # s over which a course and a rate are taken
MOVING = 0.3  # share of the greatest rate above which the course is known
FASTEST = 40.0  # m/s, of a boat
CLOSE = 0.97  # correlation of a speed with the rate of a position that has no name
MOST_UNNAMED = 8
COARSE = 0.3  # m, of a position that tells a speed badly
NO_PLACE = {"vel", "velocity", "twist", "speed", "angular", "linear", "acc", "accel", "acceleration", "force", "error",
            "gyro", "gyr", "mag", "magnetic", "orientation", "ecef", "joy", "joystick", "stick", "gamepad", "pad",
            "remote", "rc"} | SETPOINT  # fmt: skip


class Places(NamedTuple):
    """Two series that give a position."""

    first: Candidate  # latitude, or north
    second: Candidate  # longitude, or east
    geographic: bool  # degrees, not metres
    oriented: bool  # whether it is known which of two local coordinates is north
    north: Pair  # m
    east: Pair  # m

    @property
    def length(self) -> str:
        """The unit of local coordinates that a name or the log tells; "" where they are metres by assumption."""
        return "m" if self.geographic else _length(self.first)


def find_places(pool: Sequence[Candidate], convention: str = "") -> list[Places]:
    """All positions that the names tell: those that the format defines, then the finest; geographic before local."""
    places = []
    for role, other in (("latitude", "longitude"), ("north", "east")):
        for first in (each for each in pool if fit(role, each.label) >= 1):
            beside = [x for x in pool if x is not first and fit(other, x.label) >= 1 and _belong(first, x)]
            places += [_places(first, second, role == "latitude", True) for second in beside]
            if role == "latitude" and 90 < first.size <= 180:  # which no latitude is
                places += [_places(second, first, True, True) for second in beside if second.size <= 90]
    for x in pool:
        if "x" in words(x.label) and not NO_PLACE & set(words(x.label)):
            twin = tuple("y" if word == "x" else word for word in words(x.label))
            places += [_local(x, y) for y in pool if words(y.label) == twin and fit("command", x.label) < 1]
    return sorted((each for each in places if each and _moves(each)), key=lambda each: _order(each, convention))


def _order(places: Places, convention: str) -> tuple[int, bool, bool, bool, float]:
    known, grain = min(rank(each, "position", convention) for each in places[:2]), _grain(places)
    return known, grain > COARSE, not places.geographic, not places.oriented, grain


def in_degrees(pool: Sequence[Candidate]) -> list[Candidate]:
    """The series, with degrees and minutes in one number as degrees; a column of N, S, E or W tells the sign."""
    letters, read = {each.unit[-1] for each in pool if each.unit.startswith("hemisphere")}, []
    roles = [next((role for role in ("latitude", "longitude") if fit(role, each.label) >= 1), "") for each in pool]
    beyond = any(role and 180 < each.size <= 18000 for role, each in zip(roles, pool, strict=True))  # all degrees
    for role, each in zip(roles, pool, strict=True):
        minutes = beyond and each.unit != "deg" and not (np.abs(each.value) % 100 >= 60).any()
        if role and minutes and 100 < each.size <= (9000 if role == "latitude" else 18000):
            sign = -1.0 if {"latitude": "S", "longitude": "W"}[role] in letters and each.extent[0] >= 0 else 1.0
            each = each.named(value=degrees(sign * each.value), unit="ddmm", span=sign)
        read.append(each)
    return read


def guess_places(pool: Sequence[Candidate], speeds: Sequence[Candidate]) -> Places | None:
    """A position without a name: two smooth series whose rate one of the speeds follows closely."""
    smooth = [each for each in pool if _is_smooth(each)][:MOST_UNNAMED]
    best: tuple[float, Places] | None = None
    for first, second in permutations(smooth, 2):
        for geographic in (True, False):
            places = _places(first, second, geographic, geographic)
            if places is None or not _moves(places):
                continue
            for each in speeds:
                relation = speed_on_positions(places.north, places.east, each.evidence)
                if relation.correlation > CLOSE and (best is None or relation.correlation > best[0] + 1e-3):
                    if 1 / 1.1 < relation.slope < 4.0:
                        best = relation.correlation, places
    return best[1] if best else None


def crossed(places: Places) -> Places | None:
    """A position with latitude and longitude interchanged; None where one is no latitude, or they are metres."""
    alike = (places.first.size <= 90) == (places.second.size <= 90)  # both in degrees, or both in 1e-7 of them
    return _places(places.second, places.first, True, True) if places.geographic and alike else None


def _is_smooth(candidate: Candidate) -> bool:
    """Whether it changes little from value to value, and much in all, without jumps."""
    steps, span = np.abs(np.diff(candidate.value)), float(np.ptp(candidate.value))
    return len(steps) > 100 and bool(np.quantile(steps, 0.99) < 0.02 * span and steps.max() < 0.2 * span)


def course_of(places: Places) -> Pair:
    """The course over ground where the boat moves, rad, 0 north, clockwise."""
    time, north, east = _velocity(places)
    rate = np.hypot(north, east)
    if not len(rate):
        return time, rate
    moving = (rate > MOVING * np.quantile(rate, 0.95)) & (rate * SPAN > 3 * _grain(places))
    return time[moving], np.arctan2(east, north)[moving]


def rate_of(places: Places) -> Pair:
    """The speed over ground, m/s."""
    time, north, east = _velocity(places)
    return time, np.hypot(north, east)


def moved_along(places: Places, speed: Pair, heading: Pair) -> Motion:
    """How the track follows that of speed and heading, m/s and rad."""
    (time, size), (stamps, angle) = cleaned(speed), cleaned(heading)
    turned = np.interp(time, stamps, np.unwrap(angle))
    velocity = (time, size * np.cos(turned)), (time, size * np.sin(turned))
    return position_on_velocity((places.north, places.east), velocity)


def report_places(places: Places, channels: dict, series: dict, proved: bool, axes: str, doubt: str) -> list[Decision]:
    """The position as auxiliary channels, for the track.

    `axes` says how certain it is which coordinate is north, and `doubt` why it is not certain.
    """
    names = ("latitude", "longitude") if places.geographic else ("north", "east")
    if not places.oriented:
        both = f"{places.second.label}, {places.first.label}"
        why = "neither the names nor the heading tell which of them is north: set data.channels.north and .east"
        return [Decision("position", "series", both, UNSURE, why)]
    named = fit(names[0], places.first.label) >= 1 or not places.geographic
    sure = UNSURE if not named else CERTAIN if proved else PROBABLE
    why = "the speed follows its rate" if proved else "by name and range"
    why += "" if proved or places.length else "; taken as m"
    if fit("longitude", places.first.label) >= 1:
        why = "against the names: only with latitude and longitude interchanged, the speed follows their rate"
    if axes != CERTAIN:
        sure, why = least(sure, axes), doubt
    decisions = []
    pair, doubtful = (places.first, places.second), axes != CERTAIN
    for name, candidate, other in zip(names, pair, pair[::-1], strict=True):
        span = 1e7 if places.first.size > 90 else 1.0
        span = span if places.geographic else float(f"{1 / LENGTHS.get(places.length, 1.0):.6g}")
        scale = {} if span == 1 else {"span": span}
        unit = "ddmm" if candidate.unit == "ddmm" else "deg" if places.geographic else "m"
        scale |= {"span": candidate.span} if unit == "ddmm" and candidate.span < 0 else {}
        channels[name] = candidate.source(unit=unit, window=AUTO, **scale)
        series[name] = candidate
        decisions.append(Decision(name, "series", candidate.label, sure, why, (other.label,) * doubtful))
        if scale and unit == "m":
            decisions.append(Decision(name, "span", f"{span:g}", sure, f"1 m is {span:g} {places.length}"))
        if unit == "ddmm":
            how = "degrees and minutes in one number" + (", to the west or south" if candidate.span < 0 else "")
            decisions.append(Decision(name, "unit", unit, PROBABLE, f"{how}: values reach {candidate.size:.4g}°"))
    return decisions


def _velocity(places: Places) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, and the velocity to the north and to the east over `SPAN` seconds, m/s; gaps are left out."""
    (time, north), (other, east) = (cleaned(each) for each in (places.north, places.east))
    grid = np.unique(np.floor(time / SPAN)) * SPAN  # that have a stamp within the `SPAN` after them
    north, east = np.interp(grid, time, north), np.interp(grid, other, east)
    continuous = np.diff(grid) < 1.5 * SPAN
    return (grid[:-1] + SPAN / 2)[continuous], np.diff(north)[continuous] / SPAN, np.diff(east)[continuous] / SPAN


def _places(first: Candidate, second: Candidate, geographic: bool, oriented: bool) -> Places | None:
    if not geographic:
        north, east = (x.scaled(LENGTHS.get(_length(x), 1.0)) for x in (first, second))
        return Places(first, second, False, oriented, north, east)
    factor = 1.0 if first.size <= 90 else 1e-7
    if first.size * factor > 90 or second.size * factor > 180 or (first.unit == "rad" and first.size < 1.6):
        return None
    middle, scale = float(np.median(first.value)) * factor, factor * METRES
    shrunk = scale * math.cos(math.radians(middle))
    north = first.scaled(scale, -middle * METRES)
    return Places(first, second, True, oriented, north, second.scaled(shrunk, -float(np.median(second.value)) * shrunk))


def _length(candidate: Candidate) -> str:
    return next((each for each in (candidate.unit, *words(candidate.label)) if each in LENGTHS), "")


def _local(x: Candidate, y: Candidate) -> Places | None:
    """Local coordinates: which of them is north, is known by name only."""
    tokens = set(words(x.label))
    if "ned" in tokens:
        return _places(x, y, False, True)
    return _places(y, x, False, bool({"nav", "enu", "utm"} & tokens))


def _belong(first: Candidate, second: Candidate) -> bool:
    """Whether two series come from the same source, by the words that they share."""
    if first.field not in (None, "data") and first.name != second.name:
        return False
    own, other = words(first.label), words(second.label)
    return len(own) == len(other) and sum(a != b for a, b in zip(own, other, strict=True)) <= 1


def _moves(places: Places) -> bool:
    """Whether it is the track of something that moves as a boat does."""
    if min(len(places.north[0]), len(places.east[0])) < 10:
        return False
    _, rate = rate_of(places)
    return len(rate) > 10 and 0.02 < float(np.quantile(rate, 0.95)) < FASTEST and float(np.max(rate)) < 20 * FASTEST


def _grain(places: Places) -> float:
    """The smallest usual step of a coordinate, m."""
    steps = np.abs(np.diff(places.north[1]))
    return float(np.quantile(steps[steps > 0], 0.05)) if (steps > 0).any() else math.inf
