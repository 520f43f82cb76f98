"""Which series is the heading, in which unit and sense, and which is the yaw rate.

The course over ground decides about unit and sense of a heading, where a position is logged. A jump by a full turn
tells the unit, and the range of the values may. A yaw rate is what follows the derivative of the heading.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from usvlearn.logs.channels.bins import cleaned
from usvlearn.logs.channels.channel import AUTO, UNITS
from usvlearn.logs.channels.correlations import rate_slope
from usvlearn.logs.channels.position_rates import OFF, compass_error, deviations, legs_on
from usvlearn.logs.channels.position_rates import SURE as CLEAR
from usvlearn.logs.inspection.candidate import ANGLES, IS_SET, Candidate, rank
from usvlearn.logs.inspection.decision import CERTAIN, PROBABLE, UNSURE, Decision, least
from usvlearn.logs.inspection.position_channels import Pair, Places, course_of
from usvlearn.logs.inspection.vocabulary import fit, words

HEADINGS = ("deg", "rad", "enu_deg", "enu_rad")
ENOUGH = 30  # courses, below which they decide nothing
AGREES = 0.6  # mean cosine of heading and course, from which they agree
ALONG = 0.8  # or that of local coordinates, from which it tells which of them is north
CLOSELY = 0.9  # median of the cosine, from which they do so closely
MARGIN = 0.25  # of that, over the next best unit
FOLLOWS, SHORT = 0.6, 20.0  # correlation of a yaw rate with the heading's derivative; s, of a close one
EXACT = 4.0  # three standard errors, degrees, up to which the error of a compass is probable
RATIO, SCALE = 1.6, 1.1  # by which the slope may differ from that of a unit, and from that of a gyro
NORTH = {"heading", "hdg", "hdt", "compass", "steuerkurs", "kurs", "ned", "cap", "rumbo"}  # words of angles from north
NORTH_FORMATS = {"MOOS", "ArduPilot DataFlash", "MAVLink telemetry", "PX4 ULog"}  # whose headings are from north
FULL_TURN = 6.6  # a heading in rad, within ±2π, is smaller
BYTE = 256.0  # a full turn in whole numbers of 8 bits
FINE_TURNS = {BYTE: "bytes, 256 to a turn,", 400.0: "gradians", 3600.0: "tenths of a degree", 4096.0: "12-bit numbers",
              6283.2: "milliradians", 6400.0: "mils", 36000.0: "hundredths of a degree",
              65536.0: "16-bit numbers"}  # fmt: skip
FASTEST_TURN, SLOW_TURN = 60.0, 0.05  # °/s, of a boat; rad/s, that one exceeds which turns several times
MOST_RADIANS = 100.0  # 16 turns, of a heading that counts on
BEYOND = 361.0  # values above this are no degrees of one turn
NOT_MEASURED = {"innovation", "innovations", "innov", "ratio", "ratios", "test", "residual", "uncertainty"}


class Heading(NamedTuple):
    """A series that may be the heading."""

    candidate: Candidate
    unit: str
    certainty: str  # of the unit
    reason: str
    alternatives: tuple[str, ...]
    agreement: float  # mean cosine of heading and course; NaN where no course is known
    score: float  # of the series
    by_format: bool = False  # whether the format of the log defines the sense
    span: float = 1.0  # of the candidate's numbers in the unit
    zero: float = 0.0  # likewise: the error of the compass
    why_zero: str = ""
    sure_zero: str = PROBABLE
    loose: bool = False  # whether it follows the course so loosely that its error may change

    @property
    def radians(self) -> Pair:
        factor, offset = UNITS[self.unit]
        return self.candidate.scaled(factor / self.span, offset - factor * self.zero / self.span)

    @property
    def is_from_north(self) -> bool:
        """Whether its name says that it counts from north, clockwise."""
        return bool(NORTH & set(words(self.candidate.label)))

    def declared(self, convention: str) -> bool:
        """Whether the log itself says in which direction the heading counts."""
        return convention in NORTH_FORMATS or self.candidate.unit.startswith("enu_")


def agreement(heading: Pair, course: Pair, of: Callable[[np.ndarray], Any] = np.mean) -> float:
    """The mean cosine of the difference between a heading and a course; NaN with too few courses."""
    time, angle = cleaned(heading)
    if len(course[0]) < ENOUGH or len(time) < ENOUGH:
        return math.nan
    place = np.searchsorted(time, course[0]).clip(0, len(time) - 1)
    near = np.abs(time[place] - course[0]) < 3.0
    return float(of(np.cos(angle[place][near] - course[1][near]))) if near.sum() >= ENOUGH else math.nan


def read_heading(candidate: Candidate, course: Pair | None, convention: str = "") -> Heading:
    """The unit and the sense of a heading, by all evidence that there is."""
    agree = {unit: agreement(candidate.scaled(*UNITS[unit]), course) if course else math.nan for unit in HEADINGS}
    usual = "rad" if convention == "PX4 ULog" else ""
    declared = candidate.unit if candidate.unit in ANGLES else usual
    enu = declared.startswith("enu_") or "enu" in words(candidate.label)
    ranked = sorted(HEADINGS, key=lambda unit: -agree[unit] if agree[unit] == agree[unit] else 0.0)
    best = ranked[0]
    known = declared or convention in NORTH_FORMATS or candidate.size > MOST_RADIANS
    both = not known and 0 < turning(candidate) < math.radians(FASTEST_TURN)
    large = candidate.size > FULL_TURN and not (declared.endswith("rad") or both)
    by_size = candidate.wraps or ("deg" if large else "")
    why = f"it jumps by {'2π' if by_size == 'rad' else 360} at a full turn" if candidate.wraps else ""
    why = why or (f"values reach {candidate.size:.0f}" if by_size else "")
    name = fit("heading", candidate.label)
    if agree[best] == agree[best] and agree[best] >= AGREES and (not by_size or best.endswith(by_size)):
        margin = agree[best] - agree[ranked[1]]
        sentence = f"agrees with the course over ground (mean cosine {agree[best]:.2f})"
        if margin >= MARGIN:
            typical = agreement(candidate.scaled(*UNITS[best]), course, np.median) if course else 1.0
            score = name + 2 * agree[best]
            return Heading(candidate, best, CERTAIN, sentence, (), agree[best], score, loose=typical < CLOSELY)
        close = tuple(unit for unit in ranked[1:] if agree[best] - agree[unit] < MARGIN)
        choice = next((unit for unit in (best, *close) if unit == (declared or by_size)), best)
        sure = PROBABLE if declared or (by_size and not choice.startswith("enu")) else UNSURE
        sentence += ", which does not tell it from " + " or ".join(unit for unit in (best, *close) if unit != choice)
        others = tuple(unit for unit in (best, *close) if unit != choice)
        return Heading(candidate, choice, sure, sentence, others, agree[choice], name + agree[best])
    if agree[worst := ranked[-1]] <= -ALONG and (not by_size or worst.endswith(by_size)):
        sentence = f"the course over ground is half a turn from it (mean cosine {agree[worst]:.2f})"
        why, half = f"{sentence}: the compass points astern, or both axes of the track do", math.pi / UNITS[worst][0]
        astern = Heading(candidate, worst, UNSURE, sentence, (), -agree[worst], name - agree[worst])
        return astern._replace(zero=abs(half), why_zero=why)
    radians = np.ptp(candidate.extent) > 1.5 and (candidate.size < FULL_TURN or turning(candidate) > SLOW_TURN)
    base = by_size or declared.removeprefix("enu_") or ("rad" if radians else "deg")
    unit = f"enu_{base}" if enu else base
    either = () if by_size or declared else ("deg" if base == "rad" else "rad",)
    others = (f"enu_{base}" if not enu else base, *either)
    low, high = candidate.extent
    sentence = why or (f"declared as {declared}" if declared else f"values within {low:.1f} … {high:.1f}")
    if by_size and declared and not declared.endswith(by_size):
        return Heading(candidate, unit, UNSURE, f"{why}, but declared as {declared}", (declared,), math.nan, name)
    if agree[best] == agree[best] and agree[best] < AGREES:
        sentence += f"; it does not follow the course over ground (mean cosine {agree[best]:.2f} at best)"
        return Heading(candidate, unit, UNSURE, sentence, others, agree[best], name + min(agree[best], 0) - 1)
    if either:
        sentence += ", which may be degrees or radians"
        return Heading(candidate, unit, UNSURE, sentence, others, math.nan, name)
    sentence += "" if enu else "; taken as 0 north, clockwise"
    by_format = enu or convention in NORTH_FORMATS
    sure = PROBABLE if by_format or NORTH & set(words(candidate.label)) else UNSURE
    return Heading(candidate, unit, sure, sentence, others, math.nan, name, by_format)


def orient(places: Places, heading: Heading) -> Places | None:
    """Local coordinates of which the heading tells which one is north; None if it does not."""
    turned = places._replace(first=places.second, second=places.first, north=places.east, east=places.north)
    for each in (places, turned):
        if agreement(heading.radians, course_of(each)) >= ALONG:
            return each._replace(oriented=True)
    return None


def full_turn(candidate: Candidate) -> float:
    """The numbers of a full turn, where they cannot be degrees of one turn; 360 otherwise.

    Where the numbers go round, they jump by a turn. Values beyond a turn that do not are degrees that count on, if the
    boat then turns as a boat may. Whole numbers that go round below 256 are bytes.
    """
    low, high = candidate.extent
    spread, (_, value) = high - min(low, 0.0), candidate.evidence
    turn = next((each for each in FINE_TURNS if spread <= each * 1.001), 360.0)
    steps = np.abs(np.diff(value))
    jumps = bool((steps > 0.95 * turn).any())
    if turn == BYTE:
        whole = jumps and (value == np.round(value)).all() and not ((steps > BYTE / 2) & (steps < 0.8 * BYTE)).any()
        return BYTE if whole else 360.0
    if jumps and spread > BEYOND:
        return turn
    fast = candidate.size > BEYOND and low >= 0 and (turning(candidate) > FASTEST_TURN or spread <= 400.4)
    return turn if fast else 360.0


def turning(candidate: Candidate) -> float:
    """The rate that 5 % of its steps exceed, 1/s; 0 where few are known."""
    time, value = candidate.evidence
    passed = np.diff(time)
    steady = (passed > 0) & (passed < 1.0)
    rates = np.abs(np.diff(value))[steady] / passed[steady]
    return float(np.quantile(rates, 0.95)) if len(rates) > ENOUGH else 0.0


def read_any_turn(candidate: Candidate, course: Pair | None, convention: str = "") -> Heading:
    """As `read_heading`, also of tenths or hundredths of degrees, and of gradians, which are read with a span."""
    turn = full_turn(candidate)
    if convention == "MOOS" and "yaw" in words(candidate.label):
        heading = read_any_turn(candidate.named(value=-candidate.value, unit=candidate.unit or "rad"), course)
        why = f"the yaw of MOOS counts counter-clockwise from north; {heading.reason}"
        sure = heading.certainty if heading.certainty == CERTAIN else PROBABLE
        return heading._replace(candidate=candidate, span=-heading.span, reason=why, certainty=sure, by_format=True)
    if turn == 360:
        heading = read_heading(candidate, course, convention)
        beyond = candidate.size > BEYOND and heading.unit.endswith("deg") and heading.certainty != CERTAIN
        return heading._replace(certainty=UNSURE, reason=f"{heading.reason}; beyond one turn") if beyond else heading
    span = float(f"{turn / 360:.6g}")
    scaled = candidate.named(value=candidate.value / span, unit="deg")
    heading = read_heading(scaled, course, convention)
    sure = heading.certainty if heading.certainty == CERTAIN else UNSURE
    sentence = f"values reach {candidate.size:.0f}, as {FINE_TURNS[turn]} do; {heading.reason}"
    return heading._replace(candidate=candidate, span=span, zero=span * heading.zero, certainty=sure, reason=sentence)


def without_error(heading: Heading, track: tuple[Pair, Pair], course: Pair, speed: Pair, convention: str) -> Heading:
    """The same with the error of the compass as its zero, if positions to the north and to the east surely tell one."""
    legs = legs_on(*track, heading.radians, speed)
    if any(size > max(OFF, CLEAR * error) for size, error in deviations(legs)[1:]):
        heading = heading._replace(loose=True)
    if (found := compass_error(legs)) is None:
        return heading
    factor = UNITS[heading.unit][0] / heading.span
    zero = float(f"{heading.zero - found[0] / factor:.3g}")
    shifted = heading.candidate.named(value=np.mod(heading.candidate.value - zero, abs(2 * math.pi / factor)))
    read = read_any_turn(shifted, course, convention)
    if read.unit != heading.unit or read.agreement <= heading.agreement:
        return heading
    error = 3 * math.degrees(found[1])
    off = f"{math.degrees(zero * factor):+.0f}° ± {error:.1f}°"
    why = f"it differs from the course by {off} (three standard errors) on all courses, apart from current and drift"
    zeroed = read._replace(zero=zero, why_zero=why, sure_zero=PROBABLE if error < EXACT else UNSURE)
    return zeroed._replace(candidate=heading.candidate, span=heading.span, score=heading.score)


def find_headings(pool: Sequence[Candidate], course: Pair | None, convention: str = "") -> list[Heading]:
    """Series that may be the heading, the best first; by name, and without a name by their numbers."""
    found = []
    for each in pool:
        if NOT_MEASURED & set(words(each.label)):
            continue
        name, over_ground = fit("heading", each.label), fit("course", each.label)
        if name >= 1 and name > over_ground:
            found.append(read_any_turn(each, course, convention))
        elif name >= 0 and over_ground <= 0 and (each.wraps or _may_be_angle(each)):
            read = read_any_turn(each, course, convention)
            if each.wraps or read.agreement >= AGREES:
                found.append(read._replace(score=read.score - 1))
        elif over_ground >= 1 and name > -3:
            read = read_any_turn(each, course, convention)
            sentence = "a course over ground, in place of a heading: wrong where the boat drifts or backs up; "
            sentence += read.reason
            found.append(read._replace(score=read.score - 6, certainty=UNSURE, reason=sentence))
    measured = [each for each in found if not each.candidate.is_set]
    found = [each if each in measured else each._replace(score=each.score - 6, certainty=UNSURE) for each in found]
    return sorted(found, key=lambda each: 0.5 * rank(each.candidate, "heading", convention) - each.score)


def _may_be_angle(candidate: Candidate) -> bool:
    low, high = candidate.extent
    return candidate.size <= 400 and high - low > 1.5 and len(np.unique(candidate.value)) > 30


class YawRate(NamedTuple):
    """A series that follows the derivative of the heading."""

    candidate: Candidate
    unit: str
    certainty: str
    reason: str
    correlation: float


def find_yaw_rate(pool: Sequence[Candidate], heading: Heading) -> tuple[YawRate | None, list[Decision]]:
    """The yaw rate, if one is logged; and what was rejected although its name says yaw rate."""
    found, rejected = [], []
    for each in pool:
        name = fit("yaw_rate", each.label)
        if each is heading.candidate or name < 0 or (name < 0.5 and fit("heading", heading.candidate.label) >= 1):
            continue
        relation = rate_slope(heading.radians, each.evidence)
        follows = abs(relation.correlation) >= (FOLLOWS if name >= 1 else 0.75) and relation.is_sure(SHORT)
        unit = _rate_unit(relation.slope, RATIO if name >= 1 else 1.3) if follows else ""
        if unit:
            sentence = f"follows the heading's derivative: slope {relation.slope:.3g}, "
            sentence += f"correlation {relation.correlation:.2f}"
            sure = CERTAIN if name >= 1 and abs(relation.correlation) >= 0.75 else PROBABLE
            if each.unit and not unit.endswith(each.unit.removeprefix("enu_")):
                sentence, sure = f"{sentence}, but declared as {each.unit}", UNSURE
            doubt, ratio, noise = "", relation.slope * UNITS[unit][0], abs(relation.correlation)
            if ratio * noise > SCALE or ratio < noise / SCALE:  # noise makes a slope steeper
                doubt = f"{ratio:.2f} times what it says"
            elif relation.lag < 0:
                doubt = f"{-relation.lag:g} s before it, as the setpoint of a turn, or with a compass that is late"
            if doubt:
                sentence, sure = f"{sentence}: {doubt}; name: null takes it from the heading", UNSURE
            close = abs(relation.correlation) + 0.2 * name
            found.append((close, YawRate(each, unit, sure, sentence, relation.correlation)))
        elif name >= 2:
            what = f"correlation {relation.correlation:.2f}, slope {relation.slope:.3g}"
            why = f"does not follow the heading's derivative: {what if relation.seconds else 'no evidence'}"
            rejected.append(Decision("yaw_rate", "rejected", each.label, PROBABLE, why))
    return (max(found, key=lambda pair: pair[0])[1] if found else None), rejected


def _rate_unit(slope: float, tolerance: float = RATIO) -> str:
    """The unit of a yaw rate whose slope against the heading's derivative in rad/s is known; "" if none fits."""
    for unit in ("rad/s", "deg/s", "deg/min"):
        ratio = abs(slope) * UNITS[unit][0]
        if 1 / tolerance < ratio < tolerance:
            return unit if slope > 0 else f"enu_{unit}"
    return ""


def report_heading(best: Heading, headings: Sequence[Heading], channels: dict, series: dict) -> list[Decision]:
    """The best heading as the channel, its unit, and its span where it has one."""
    candidate = best.candidate
    scale = {} if best.span == 1 else {"span": best.span}
    scale |= {"zero": best.zero} if best.zero else {}
    channels["heading"] = candidate.source(unit=best.unit, window=AUTO, **scale)
    series["heading"] = candidate
    close = [each.candidate.label for each in headings[1:] if each.score > best.score - 1]
    named = fit("heading", candidate.label)
    if named >= 1:
        agreed = best.agreement == best.agreement and best.agreement > 0.6
        sure = CERTAIN if agreed and not close else PROBABLE
        why = "by name" + (", and it follows the course over ground" if agreed else "")
        if candidate.is_set:
            sure, why = UNSURE, f"by name, but it {IS_SET}: log the latter"
        elif agreed and best.loose:
            sure, why = PROBABLE, f"{why} loosely: the boat drifts much, or the error of the compass changes"
    else:
        sure, why = UNSURE, best.reason
    why += f"; others: {', '.join(close[:3])}" if close else ""
    decisions = [
        Decision("heading", "series", candidate.label, sure, why, tuple(close)),
        Decision("heading", "unit", best.unit, best.certainty, best.reason, best.alternatives),
    ]
    if best.span != 1:
        decisions.append(Decision("heading", "span", f"{best.span:g}", best.certainty, best.reason))
    if best.zero:
        sure = least(best.sure_zero, best.certainty)
        decisions.append(Decision("heading", "zero", f"{best.zero:g}", sure, best.why_zero, ("0",)))
    return decisions


def report_yaw_rate(
    yaw: YawRate | None, heading: Heading, rivals: Sequence[str], channels: dict, series: dict
) -> list[Decision]:
    """The yaw rate as the channel; where no series is one, it is the derivative of the heading."""
    if yaw is None:
        channels["yaw_rate"] = {"name": None, "unit": "rad/s"}
        sure = UNSURE if rivals else PROBABLE
        why = "no series follows the heading's derivative"
        return [Decision("yaw_rate", "series", "from the heading", sure, why, tuple(rivals[:3]))]
    channels["yaw_rate"] = yaw.candidate.source(unit=yaw.unit, window=AUTO)
    series["yaw_rate"] = yaw.candidate
    return [
        Decision("yaw_rate", "series", yaw.candidate.label, yaw.certainty, yaw.reason),
        Decision("yaw_rate", "unit", yaw.unit, least(yaw.certainty, heading.certainty), "by that slope"),
    ]
