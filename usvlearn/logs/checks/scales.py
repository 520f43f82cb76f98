"""Checks units and scales: speeds, commands, headings and yaw rates against each other and against physics.

A ratio of two speeds is that of a unit from 1.39 on, midway between 1 and that of knots: currents and noise of
positions change it, too. Thrust that is 30 % greater makes up to 30 % more speed, and a current some 0.5 m/s over
ground. Commands turn a boat at 0.2 to 1.5 rad/s for a full difference of the sides; a gentle run is slow, too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from usvlearn.logs.channels.bins import HUGE
from usvlearn.logs.channels.channel import COMMANDS, METRES, SPEEDS, SURGE, UNITS
from usvlearn.logs.channels.correlations import rate_slope, without_sign
from usvlearn.logs.channels.position_rates import compass_error, legs_on, speed_on_positions
from usvlearn.logs.checks.evidence import STEP, Evidence, angular, mirrored, spread, without
from usvlearn.logs.checks.finding import NOTE, WARNING, Finding, override, see
from usvlearn.logs.checks.track import half_turn_fix, heading_is_right, mirror_fix, position_unit

SURE, LIKELY_TURN = 4.0, 2.5  # standard errors; less beside headings of a wrong range
TOO_FAST, CURRENT, FASTEST = 1.3, 0.5, 15.0  # of the top speed; m/s; m/s
TOO_SLOW, STRONG = 0.4, 0.7  # of the top speed, at such commands
SAME = math.sqrt(3600 / 1852)  # a ratio of two speeds in one unit lies within 1/SAME and SAME
LIKELY = 0.15  # by which that of two units may differ from the measured one
RESTING = 0.1  # m/s that a boat at rest does not reach
WEAK, BEYOND = 0.05, 1.2  # of full scale
CIRCLE = 2 * math.pi
PARTS = (1, 10, math.degrees(1), 100)  # of a degree, in which headings are logged, or converted twice
BIAS, FEWEST, MEAN = math.radians(1), 60, np.full(10, 0.1)  # rad/s, of a gyro; bins each way of turning; weights
TURNED = 0.03  # rad/s, standard deviation of a turn that a yaw rate has to follow
TURNED_AWAY = math.radians(45)  # of the course from the heading; a cross current of half the speed makes 30°
SLUGGISH, FRANTIC = 0.03, 10.0  # rad/s of turn for a full difference of the commands
SWIFT = 0.3  # rad/s; ten times as much is more than a boat turns: tenths of a degree, not many turns without a wrap
OTHER, BYTES, ALIKE, TELLING, SHOWN = 8.0, 2.55, 1.2, 150.0, 3  # ratios of commands in two logs; s; names of logs
CENTURY = (700.0, 2300.0)  # us, the pulses of servos and speed controllers
FULL = (1.0, 100.0, 1000.0)  # scales that commands usually have
IDLE, RANGES = 1500.0, (400.0, 500.0)  # us
MOVED = (*METRES, "heading", SURGE)  # what tells the error of a compass


def zeros(e: Evidence) -> Iterator[Finding]:
    """A channel whose values are all the same."""
    for name in ("heading", SURGE):
        value = e.values.get(name, np.empty(0))
        if len(value) and np.ptp(value) == 0:
            text = f"{value[0]:g} in all of its {len(value)} values"
            yield Finding(e.boat, name, "constant", text, see("a measured value", name), without(e, name))


def rest(e: Evidence) -> Iterator[Finding]:
    """A boat that never moves; a speed of zeros is found by `zeros`."""
    speed = e.values[SURGE]
    if len(speed) and np.ptp(speed) > 0 and e.fastest < RESTING:
        yield Finding(e.boat, SURGE, "at rest", f"at most {e.fastest:.2g} m/s", see("a boat that moves", SURGE),
                      without(e, SURGE))  # fmt: skip


def speed_scale(e: Evidence) -> Iterator[Finding]:
    """The speed against the rate of position, or against the boat's top speed."""
    if e.fastest < RESTING:
        return
    known, plausible = math.isfinite(e.surge_max), TOO_FAST * e.surge_max + CURRENT
    if e.speeds and e.has_position:
        north, east = (e.series[name] for name in METRES)
        relation = speed_on_positions(north, east, e.size)
        if relation.correlation > 0.5 and relation.slope > 0:
            if not 1 / SAME < relation.slope < SAME:
                fits = bool(_in_other_unit(_other_units(e), relation.slope))
                usual = (TOO_SLOW * e.surge_max, plausible) if known else (RESTING, FASTEST)  # of the greatest speed
                if other := position_unit(e, relation.slope, usual, fits):
                    yield other
                    return
                text = f"{relation.slope:.2f} times the rate of position (r = {relation.correlation:.2f})"
                yield Finding(e.boat, SURGE, "speed unit", text, "1 times", _in_units(e, relation.slope))
            return
    limit = plausible if FASTEST <= e.surge_max < math.inf else min(plausible, FASTEST)
    top, bound = (e.surge_max, f"{e.surge_max:g} m/s (vehicle.surge_max)") if known else (FASTEST, f"{FASTEST:g} m/s")
    if e.fastest > limit:
        larger = f"vehicle.surge_max={_ceil(e.fastest)}" if e.fastest <= FASTEST or not e.speeds else ""
        unit = _in_units(e, e.fastest / top, limit / top) if e.channels else ""  # simulated boats have no units
        fix = " or ".join(filter(None, [unit, larger]))
        yield Finding(e.boat, SURGE, "speed scale", f"speeds up to {e.fastest:.2g} m/s", f"at most {bound}", fix)
        return
    strong = np.minimum(*e.commands) > STRONG
    speed = np.abs(e.speed[strong & np.isfinite(e.speed)])
    if known and len(speed) >= 20 and 0 < (reached := float(np.quantile(speed, 0.95))) < TOO_SLOW * e.surge_max:
        text = f"{reached:.2g} m/s at commands above {STRONG:g}"
        units = [_in_units(e, reached / e.surge_max)] if e.channels else []
        fix = " or ".join([f"vehicle.surge_max={_ceil(reached)}", *units])
        yield Finding(e.boat, SURGE, "speed scale", text, f"about {bound}", fix, NOTE)


def sign(e: Evidence) -> Iterator[Finding]:
    """A speed without a sign of a boat that goes astern."""
    wrong = without_sign(*e.commands, e.speed)
    if e.speeds != (SURGE,) or not (seconds := float(wrong.sum()) * STEP):
        return
    text = f"a speed that is never below 0, and rises in {seconds:.0f} s in which both commands push astern"
    name = override(SURGE, {"name": None})
    ways = "a speed with a sign: velocities to the north and east, or ground_speed and course, or a position alone"
    yield Finding(e.boat, SURGE, "speed sign", text, ways, name if e.has_position and e.channels else "")


def runs(e: Evidence) -> Iterator[Finding]:
    """Logs whose commands, or whose speeds, are in another unit than those of the others."""
    moved = [log for log in e.alone if log.fastest > RESTING and log.has_position == e.has_position]
    fastest = [log.fastest for log in moved]
    commands = [np.abs(np.concatenate([log.values[name] for name in COMMANDS])) for log in moved]
    sizes = [float(np.quantile(each, 0.995)) if len(each) else 0.0 for each in commands]
    expected = "logs of one boat in one unit: read these by a configuration of their own, or as another boat"
    text, driven, faster = _odd(moved, sizes, fastest)
    if (driven > math.log(OTHER) or abs(driven - math.log(BYTES)) < 0.02) and abs(faster) < driven / 2:
        yield Finding(e.boat, ", ".join(COMMANDS), "commands of runs", text, expected)
    relations = [log.thrust_on_speed for log in moved]
    if e.has_position:
        relations = [speed_on_positions(log.series["north"], log.series["east"], log.size) for log in moved]
    slopes = [each.slope if each.correlation > 0.5 and each.seconds > TELLING else 0.0 for each in relations]
    text, ratio, faster, driven = _odd(moved, slopes, fastest, sizes)
    known = e.speeds and any(abs(abs(math.log(x)) - (ratio + faster) / 2) < 0.1 for x in _other_units(e).values())
    known = known and abs(faster - ratio) < math.log(SAME) and abs(driven) < math.log(ALIKE)
    placed = e.speeds and e.has_position and ratio > math.log(SAME)  # else a lost thruster may make the difference
    if known or placed:
        yield Finding(e.boat, SURGE, "speeds of runs", text, expected, severity=WARNING if placed else NOTE)


def _odd(runs: list[Evidence], sizes: list[float], *others: list[float]) -> tuple[Any, ...]:
    """Which logs differ from a usual one, and by how much the farthest does: logarithms, the first above 0."""
    order = sorted((k for k, size in enumerate(sizes) if size > 0), key=lambda k: sizes[k])
    if len(order) < 2:
        return "", *[0.0] * (1 + len(others))
    usual = order[(len(order) - 1) // 2]
    ratios = {k: sizes[k] / sizes[usual] for k in order}
    high, low = sorted([usual, max(order, key=lambda k: abs(math.log(ratios[k])))], key=lambda k: -sizes[k])
    odd = [f"{runs[k].recordings[0].run} (× {ratios[k]:.3g})" for k in order if not 1 / SAME < ratios[k] < SAME]
    text = f"another scale than in the other logs in {', '.join(odd[:SHOWN])}" + ", …" * (len(odd) > SHOWN)
    return text, *(math.log(max(each[high], 1e-9) / max(each[low], 1e-9)) for each in (sizes, *others))


def _other_units(e: Evidence) -> dict[str, float]:
    """By how much a speed in each other unit would be less."""
    now = e.factor(e.speeds[0])
    return {unit: now / UNITS[unit][0] for unit in SPEEDS if abs(math.log(now / UNITS[unit][0])) > 0.1}


def _in_other_unit(ratios: Mapping[str, float], ratio: float) -> list[str]:
    return [unit for unit in ratios if abs(math.log(ratios[unit] / ratio)) < LIKELY]


def _ceil(speed: float) -> str:
    return f"{math.ceil(10 * speed) / 10:g}"


def _in_units(e: Evidence, ratio: float, most: float | None = None) -> str:
    """The override that divides a speed by about `ratio`: a unit where one fits, else a span; "" if it is not logged.

    If the right speed is a bound, up to `most` a ratio would do, and the unit of the least factor is taken.
    """
    if not e.speeds:
        return ""
    units, span = _other_units(e), float(e.settings(e.speeds[0])["span"])
    if most is not None:
        fits = [unit for unit in units if 1 < units[unit] and ratio <= units[unit] * most]
    else:
        fits = _in_other_unit(units, ratio)
    options: dict[str, Any] = {"span": span * ratio}
    if fits:
        options = {"unit": min(fits, key=lambda unit: units[unit]), **({} if span == 1 else {"span": 1.0})}
    return " ".join(override(name, options) for name in e.speeds)


def command_scale(e: Evidence) -> Iterator[Finding]:
    """Commands in percent, in pulses of microseconds, or as shares of another scale than declared."""
    for name in COMMANDS:
        value = np.abs(e.values[name])
        settings = e.settings(name)
        if not len(value) or not isinstance(settings["span"], int | float):
            continue
        greatest = float(np.quantile(value, 0.995))
        if WEAK <= greatest <= BEYOND or greatest == 0:
            continue
        raw, zero = e.values[name] / e.factor(name) + settings["zero"], settings["zero"]
        low, high = (float(each) for each in np.quantile(raw, [0.005, 0.995]))
        size = max(abs(low - zero), abs(high - zero))
        full = next((full for full in FULL if 0.2 * full < size <= BEYOND * full), float(f"{size:.2g}"))
        pulses = CENTURY[0] <= low and high <= CENTURY[1] and high - low > 20
        scales = [*((IDLE, each) for each in RANGES if pulses), (zero, full)]
        shares = [float(np.quantile(np.abs(raw - idle), 0.995)) / span for idle, span in scales]
        idle, full = next((each for each, x in zip(scales, shares, strict=True) if WEAK <= x <= BEYOND), scales[-1])
        fix: dict[str, Any] = {"unit": "1"} if settings["unit"] != "1" else {}
        fix |= {"zero": idle} if pulses and idle == IDLE else {}
        fix |= {"span": math.copysign(full, settings["span"])}
        text, expected = f"at most {greatest:.2g} of full scale", f"more than {WEAK:g}"
        if greatest > BEYOND:
            text, expected = f"values up to {greatest:.3g} of full scale", f"at most {BEYOND:g}"
        yield Finding(e.boat, name, "command scale", text, expected, override(name, fix))


def heading_unit(e: Evidence) -> Iterator[Finding]:
    """Radians read as degrees, degrees read as radians, tenths and hundredths of a degree read as degrees."""
    value = e.values["heading"]
    if len(value) < 3 or np.ptp(value) == 0:
        return
    unit, greatest = angular(e, "heading"), float(np.max(np.abs(value)))
    small = math.radians(CIRCLE)
    runs = [each.value[np.abs(each.value) < HUGE] for each in e.logs("heading")]
    jumps = max(float(np.max(np.abs(np.diff(each)), initial=0.0)) for each in runs)
    turns = abs(e.turns.certainty) > LIKELY_TURN and abs(e.turns.correlation) > 0.3
    speeds = abs(e.turns.slope) if turns else None  # rad/s, at a full difference of the commands
    if greatest <= small * 1.001:
        wraps = jumps > 0.95 * np.ptp(value) and np.ptp(value) > 0.9 * small
        sluggish = speeds is not None and speeds < SLUGGISH
        text = f"all headings within {math.degrees(greatest):.2f}°"
        if wraps or sluggish:
            why = "jumps over that range" if wraps else f"{speeds:.1g} rad/s of turn at a full difference of commands"
            twice = {"span": math.radians(1) * e.settings("heading")["span"]}  # converted to radians twice
            fix = {"unit": unit.replace("deg", "rad")} if "deg" in unit else twice
            yield Finding(e.boat, "heading", "heading unit", f"{text}, {why}", "degrees that cover the turns",
                          override("heading", fix))  # fmt: skip
        return
    rated, name = ("deg", "degrees") if unit.endswith("deg") else ("rad", "rad")
    scale = UNITS["deg"][0] if rated == "deg" else 1.0
    for parts in PARTS[rated == "deg" :]:  # of a degree
        circle = 360 * parts * scale
        least = 2 * CIRCLE if parts == 1 else 0.2 * circle
        fits = least < greatest <= circle * 361 / 360 and np.min(value) > -circle * 361 / 360
        wraps = 0.8 * circle < jumps < circle * 361 / 360
        frantic = speeds is not None and speeds > (FRANTIC if rated == "rad" else SWIFT) * parts
        if fits and (wraps or (frantic and isinstance(parts, int))):
            text = f"headings up to {greatest / scale:.0f} {name} that jump by {jumps / scale:.0f}"
            fix = {"unit": unit.replace("rad", "deg")} if rated == "rad" else {}
            fix |= {"span": parts * e.settings("heading")["span"]} if parts > 1 else {}
            expected = "radians within ±2π" if rated == "rad" else "degrees within ±360"
            yield Finding(e.boat, "heading", "heading unit", text, expected, override("heading", fix))
            return


def heading_sense(e: Evidence) -> Iterator[Finding]:
    """The heading against the course over ground: sense, and an offset that no current makes."""
    course = e.course
    if e.sense == -1 and not (e.has_position and heading_is_right(e)):
        text = f"a heading that turns against the course (mean vector {course.concentration:.2f})"
        fix = override("heading", {"unit": mirrored(angular(e, "heading"))})
        if not e.turns.correlation < -0.3 and (other := mirror_fix(e, course.offset, e.places)):
            fix = f"{fix} or {other}"
        yield Finding(e.boat, "heading", "heading sense", text, f"with it ({course.rival:.2f})", fix)
    elif e.sense == 1 and abs(course.offset) > TURNED_AWAY:
        zero = e.settings("heading")["zero"] - course.offset / e.factor("heading")
        text = f"a course {math.degrees(course.offset):+.0f}° from the heading"
        other = half_turn_fix(e, course.offset)
        fix = " or ".join(filter(None, [override("heading", {"zero": float(zero)}), other]))
        yield Finding(e.boat, "heading", "heading offset", text, f"within {math.degrees(TURNED_AWAY):.0f}°", fix)
    elif e.sense != -1 and e.has_position and (off := compass_error(legs_on(*(e.series[name] for name in MOVED)))):
        zero = e.settings("heading")["zero"] - off[0] / e.factor("heading")
        text = f"a heading that is {math.degrees(-off[0]):+.0f}° (± {math.degrees(off[1]):.1f}°) off on all courses"
        yield Finding(e.boat, "heading", "heading offset", text, "the course on straight legs, less current and drift",
                      override("heading", {"zero": float(f"{zero:.3g}")}))  # fmt: skip


def yaw_rate(e: Evidence) -> Iterator[Finding]:
    """The logged yaw rate against the derivative of the heading: unit, sense, delay."""
    if "yaw_rate" not in e.series or next(heading_unit(e), None):
        return
    relation, unit = rate_slope(e.series["heading"], e.series["yaw_rate"], (-5.0, 5.0)), angular(e, "yaw_rate")
    if not relation.seconds:
        return
    pair, expected = "heading, yaw_rate", "the rate of the heading"
    slope, without = abs(relation.slope), override("yaw_rate", {"name": None})
    if abs(relation.correlation) < 0.3:
        if relation.seconds > 60 and spread(e.turn) > TURNED:
            text = f"no relation to the turns of the heading (r = {relation.correlation:.2f})"
            yield Finding(e.boat, pair, "yaw rate", text, expected, without)
        return
    if abs(relation.certainty) < SURE:
        return
    if relation.slope < 0:
        text = f"{relation.slope:.2g} times the rate of the heading (r = {relation.correlation:.2f})"
        turned = e.turns.correlation
        wrong = "heading" if turned < -0.3 and abs(e.turns.certainty) > SURE else "yaw_rate"
        yield Finding(e.boat, pair, "yaw sense", text, "1 times",
                      override(wrong, {"unit": mirrored(angular(e, wrong))}))  # fmt: skip
    if not 1 / 3 < slope < 3:
        text = f"{slope:.2g} times the rate of the heading (r = {relation.correlation:.2f})"
        wrong, right = ("rad/s", "deg/s") if slope > 1 else ("deg/s", "rad/s")
        likely = 20 < max(slope, 1 / slope) < 160 and wrong in unit
        fix = override("yaw_rate", {"unit": unit.replace(wrong, right)}) if likely else without
        yield Finding(e.boat, pair, "yaw rate unit", text, "1 times", fix)
    apart, rate = (np.convolve(each, MEAN, "same") for each in (e.means("yaw_rate") - e.turn, e.turn))
    ways = [apart[(way * rate > 0) & np.isfinite(apart)] for way in (1, -1)]
    low, high = sorted(float(np.median(each)) if len(each) > FEWEST else 0.0 for each in ways)
    if low > BIAS or high < -BIAS:
        zero = e.settings("yaw_rate")["zero"] + (bias := (low + high) / 2) / e.factor("yaw_rate")
        text = f"a gyro that reads {math.degrees(bias):+.2g}°/s where the heading stays"
        yield Finding(e.boat, "yaw_rate", "yaw rate bias", text, "0", override("yaw_rate", {"zero": round(zero, 4)}))
    if abs(relation.lag) >= 1.0:
        text = f"a yaw rate {abs(relation.lag):g} s {'behind' if relation.lag > 0 else 'before'} the heading"
        yield Finding(e.boat, pair, "yaw rate delay", text, "less than 1 s", without, NOTE)
