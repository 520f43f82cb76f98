"""Checks positions, from which tracks are judged, against the measured velocity; and the sway against both.

The rate of a position over 5 s is compared with the velocity of surge, sway and heading, as complex numbers north +
i east (`usvlearn.logs.channels.position_rates`). North and east interchanged, or one of them reversed, make a mirror
image, whose angle is +90°, 180° or 0°. So does a heading that counts counter-clockwise. The position is named where the
boat turns as its thrusters demand, and no gyro contradicts. Where nothing tells which is wrong, both keys are given.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from usvlearn.logs.channels.bins import HUGE, bin_edges, bin_means
from usvlearn.logs.channels.channel import DEGREES, METRES, SWAY, UNITS, VELOCITIES
from usvlearn.logs.channels.correlations import angle_offset, rate_slope
from usvlearn.logs.channels.position_rates import speed_on_positions, sway_on_positions
from usvlearn.logs.checks.evidence import LEG, MOVING, NONE, Evidence, angular, mirrored, without
from usvlearn.logs.checks.finding import Finding, override, see

UNLIKE, LONG = 0.4, 120.0  # correlation below which nothing follows; s of evidence
CHANGES, LEAST = 0.2, 0.15  # of the greatest speed; m/s
LENGTHS = (0.3048, 0.01, 0.001, 1000.0, 1852.0)  # m: feet, centimetres, millimetres, kilometres, nautical miles
LIKELY = 0.15  # by which a ratio may differ from that of a unit
COARSE = 0.7  # likewise of degrees: the longitudes shrink by the cosine of a wrong latitude
SURE, TURNS = 4.0, 0.3  # standard errors, and correlation, of a turn that follows the commands, or of a yaw rate
REVERSED, CERTAIN, CLOSE = 0.5, 5.0, 0.9  # correlation and standard errors of a sway; correlation that tells its unit
OTHER = 1.6  # times the rate across the hull, from which a sway is in another unit
QUARTER = math.pi / 2
TOLERANCE = math.radians(30)  # of the angle of a mirror image
POLE = math.pi / 2 + 1e-6  # rad, the greatest latitude
WHOLE = 1e6  # from which a number is a latitude in parts of 1e-7 degrees


def degrees(e: Evidence) -> Iterator[Finding]:
    """Latitudes of more than 90°."""
    value = np.abs(e.values.get(DEGREES[0], np.empty(0)))
    if not len(value) or (greatest := float(np.quantile(value, 0.995))) <= POLE:
        return
    raw, other = (_raw(e, name) for name in DEGREES)
    fix = without(e, DEGREES[0])
    if raw <= 90:
        fix = _both(DEGREES, unit="deg")
    elif raw >= WHOLE:
        fix = _both(DEGREES, unit="deg", span=1e7)
    elif raw <= 180 and other <= 90:
        fix = _interchange(e, DEGREES)
    text = f"latitudes up to {math.degrees(greatest):.4g}°"
    yield Finding(e.boat, DEGREES[0], "position unit", text, "at most 90°", fix if e.channels else "")


def axes(e: Evidence) -> Iterator[Finding]:
    """A position, or a velocity, whose axes are interchanged or reversed, where not the heading is the reason."""
    angle = mirrored_by(e)
    if angle is None:
        return
    text = f"a track that is the mirror image of heading and speed (r = {abs(e.motion.against):.2f})"
    expected = f"the track of heading and speed (r = {abs(e.motion.along):.2f})"
    if e.speeds == VELOCITIES and _velocity_is_mirrored(e):
        fix = mirror_fix(e, angle, VELOCITIES)
        yield Finding(e.boat, ", ".join(VELOCITIES), "velocity axes", text, expected, fix)
        return
    right = heading_is_right(e)
    if e.speeds == VELOCITIES or right or (e.sense is None and not e.turns.correlation < -TURNS):
        fixes = [mirror_fix(e, angle, e.places)]
        if e.channels and e.speeds != VELOCITIES and not (right and "yaw_rate" in e.series):  # the heading may be wrong
            fixes.append(override("heading", {"unit": mirrored(angular(e, "heading"))}))
        fix = " or ".join(filter(None, fixes)) or without(e, e.places[0])
        yield Finding(e.boat, ", ".join(e.places), "position axes", text, expected, fix)


def mirrored_by(e: Evidence) -> float | None:
    """The angle from the mirror image of the measured velocity to that of the track, rad; None if it is no image."""
    motion = e.motion
    if motion.is_mirrored:
        return float(np.angle(motion.against))
    return e.course.offset if e.sense == -1 and abs(motion.against) > abs(motion.along) else None


def _velocity_is_mirrored(e: Evidence) -> bool:
    """Whether the direction of the velocities to the north and to the east turns against the heading."""
    edges = bin_edges(LEG, *(e.series[name] for name in VELOCITIES))
    north, east = (bin_means(e.series[name], edges) for name in VELOCITIES)
    moving = np.hypot(north, east) > MOVING * np.nanmax(np.hypot(north, east), initial=0.0)
    at = (edges[:-1] + edges[1:]) / 2
    return angle_offset((at[moving], np.arctan2(east, north)[moving]), e.series["heading"], LEG).sign < 0


def heading_is_right(e: Evidence) -> bool:
    """Whether the thrusters, and a gyro if there is one, tell that the heading counts clockwise."""
    if not (e.turns.correlation > TURNS and e.turns.certainty > SURE):
        return False
    if "yaw_rate" not in e.series:
        return True
    gyro = rate_slope(e.series["heading"], e.series["yaw_rate"])
    return not (gyro.correlation < -TURNS and gyro.certainty < -SURE)


def mirror_fix(e: Evidence, angle: float, names: tuple[str, str]) -> str:
    """The overrides that turn a mirror image by an angle, rad, into the track; "" where there are none."""
    if not (e.channels and e.has_position):
        return ""
    turns = round(angle / QUARTER)
    if abs(angle - turns * QUARTER) > TOLERANCE:
        return ""
    if turns in (1, -1):
        return _interchange(e, names, reverse=turns < 0)
    wrong = names[1] if turns == 0 else names[0]
    return override(wrong, {"span": -_span(e, wrong)})


def half_turn_fix(e: Evidence, offset: float) -> str:
    """The overrides that reverse both axes, where the heading is half a turn off the course; else ""."""
    half = bool(e.channels) and e.has_position and e.places == METRES and math.pi - abs(offset) < TOLERANCE
    return " ".join(override(name, {"span": -_span(e, name)}) for name in METRES) if half else ""


def follows(e: Evidence) -> Iterator[Finding]:
    """A position that has nothing to do with the measured velocity."""
    motion, logged = e.motion, e.places
    if motion.seconds < LONG or not e.speeds or motion.spread < max(CHANGES * e.fastest, LEAST):
        return
    north, east = (e.series.get(name, NONE) for name in METRES)
    of_speed = speed_on_positions(north, east, e.size)
    both = max(abs(motion.along), abs(motion.against))
    if both < UNLIKE and not of_speed.correlation >= UNLIKE:
        still = f"stands still (its rate changes by {motion.scale * motion.spread:.2g} m/s)"
        text = still if motion.scale < 0.1 else f"does not follow speed and heading (r = {both:.2f})"
        expected = see("one that follows them", *logged)
        fix = without(e, logged[0])
        yield Finding(e.boat, ", ".join(logged), "position", f"a position that {text}", expected, fix)


def position_unit(e: Evidence, slope: float, plausible: tuple[float, float], fits: bool) -> Finding | None:
    """The position in another unit, if rather it than the speed is the reason for their ratio, `slope`.

    Plausible are top speeds between two, m/s; `fits`: whether another unit of the speed would explain the ratio.
    """
    fix = _length(e, slope)
    if not fix or not e.channels or next(degrees(e), None):
        return None
    rate = e.rate(LEG)
    fastest = float(np.nanquantile(rate, 0.995)) if np.isfinite(rate).any() else math.nan
    speed, moved = (plausible[0] < each < plausible[1] for each in (e.fastest, fastest))
    if (moved and not speed) or (moved == speed and fits):
        return None
    text = f"a rate {1 / slope:.3g} times the speed"
    return Finding(e.boat, ", ".join(e.places), "position unit", text, "1 times", fix)


def _length(e: Evidence, slope: float) -> str:
    """The overrides that multiply the position by about `slope`; "" if no unit of a length does that."""
    logged = e.places
    if logged == DEGREES:
        now = UNITS[e.settings(DEGREES[0])["unit"]][0]
        other = "deg" if now == 1 else "rad"
        return _both(DEGREES, unit=other) if _near(slope * now, UNITS[other][0], COARSE) else ""
    scale = e.factor(METRES[0])
    wanted = next((each for each in (1.0, *LENGTHS) if _near(slope * scale, each)), None)
    return _both(METRES, span=1 / wanted) if wanted and not _near(scale, wanted) else ""


def sway(e: Evidence) -> Iterator[Finding]:
    """A logged sway against the rate of position across the hull: sense and unit."""
    if SWAY not in e.series or not e.has_position or mirrored_by(e) is not None:
        return
    north, east = (e.series[name] for name in METRES)
    relation = sway_on_positions(north, east, e.series["heading"], e.series[SWAY])
    if abs(relation.correlation) < REVERSED or not abs(relation.certainty) > CERTAIN:
        return
    text = f"{relation.slope:.2g} times the rate of position across the hull (r = {relation.correlation:.2f})"
    sign = -1.0 if relation.slope < 0 else 1.0
    if abs(math.log(abs(relation.slope))) > math.log(OTHER) and abs(relation.correlation) > CLOSE:
        fix = override(SWAY, {"span": float(f"{relation.slope * _span(e, SWAY):.3g}")})
        yield Finding(e.boat, SWAY, "sway unit", text, "1 times", fix)
    elif sign < 0:
        fix = override(SWAY, {"span": -_span(e, SWAY)})
        yield Finding(e.boat, SWAY, "sway sense", text, "1 times, to starboard", fix)


def _raw(e: Evidence, name: str) -> float:
    """The greatest size of a number as it stands in the log, without outliers."""
    value = e.values.get(name, np.empty(0))
    return float(np.quantile(np.abs(value), 0.995)) / abs(e.factor(name)) if len(value) else HUGE


def _span(e: Evidence, name: str) -> float:
    return float(e.settings(name)["span"])


def _near(one: float, other: float, within: float = LIKELY) -> bool:
    return one > 0 and abs(math.log(one / other)) < within


def _place(e: Evidence, name: str) -> dict[str, object]:
    """Where a channel is logged."""
    settings = e.settings(name)
    return {key: settings[key] for key in ("name", "field") if settings[key] is not None}


def _interchange(e: Evidence, names: tuple[str, str], reverse: bool = False) -> str:
    turned = {"span": -_span(e, names[0])} if reverse else {}
    return " ".join(override(one, {**_place(e, other), **turned}) for one, other in (names, names[::-1]))


def _both(names: tuple[str, ...], **options: object) -> str:
    return " ".join(override(name, options) for name in names)
