"""Which series is the speed, and in which unit.

The rate of position is the only certain evidence of a unit. Without it the log's own declaration, the convention of its
format, or another speed whose unit is known may tell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.logs.channels.bins import cleaned
from usvlearn.logs.channels.channel import AUTO, RARE, SPEEDS, UNITS, Channel
from usvlearn.logs.channels.correlations import Relation, speed_on_thrust
from usvlearn.logs.channels.position_rates import speed_on_positions
from usvlearn.logs.channels.repeated_values import find_period
from usvlearn.logs.inspection.candidate import IS_SET, Candidate
from usvlearn.logs.inspection.decision import CERTAIN, PROBABLE, UNSURE, Decision, least
from usvlearn.logs.inspection.position_channels import CLOSE as FOLLOWED
from usvlearn.logs.inspection.position_channels import Pair, Places, crossed, moved_along
from usvlearn.logs.inspection.vocabulary import OTHER_UNITS, SETPOINT, fit, names_side_alone, words

RATIO = 1.3  # by which a slope may differ from that of a unit, as far as that unit is near at all
FITS, SAME = 1.05, 0.95  # by which it may differ, and the correlation, of a unit that is certain
FOLLOWS, LONG = 0.6, 60.0  # correlation with the rate of position; s, of a close one
ACROSS = 0.5  # share of y in x, from which a vector is not along the hull
STEADY, TIGHT = 0.4, 1.1  # correlation of a speed that varies little, and then the tolerance of the slope
BETTER = 4  # by which 1 − correlation must shrink, to take latitude and longitude against their names
DOUBT = 2.0  # by which it must shrink where the unit of the speed decides, or both are doubtful
MORE = 0.005  # by which the correlation must grow, too, where they are doubtful
MOST, UNLIKE, LIKE = 4, 0.35, 0.5  # series that are compared; correlations with commands
ASTERN = 0.8  # correlation of the velocity with that of speed and heading, below whose opposite the speed is reversed
PLAUSIBLE = 15.0  # m/s, of a boat of this kind
FOLLOWS_NOT = "it does not follow the rate of position"
LATER = (0.0, 10.0)  # s, by which a speed follows its setpoint
METRIC = ("geometry_msgs", "nav_msgs", "MOOS", "ArduPilot DataFlash", "MAVLink telemetry", "PX4 ULog")  # all m/s


class Speed(NamedTuple):
    """A series that may be the speed of the boat."""

    candidate: Candidate
    unit: str
    certainty: str  # of the unit
    reason: str
    alternatives: tuple[str, ...]
    confirmed: bool  # whether it follows the rate of position
    contradicted: str  # why it is hardly the speed; "" if nothing says so
    score: float

    @property
    def metres(self) -> tuple[np.ndarray, np.ndarray]:
        """In m/s."""
        return self.candidate.scaled(*UNITS[self.unit])


def find_speeds(
    pool: Sequence[Candidate], places: Sequence[Places], convention: str, heading: Pair | None = None
) -> list[Speed]:
    """Series that may be the speed, the best first, by the first of the places of the boat.

    By the heading, rad, the way between two places is known.
    """
    found: list[Speed] = []
    sets, placed = [], {id(each) for place in places for each in place[:2]}
    for each in pool:
        name = fit("surge", each.label)
        angle = max(fit(role, each.label) for role in ("heading", "course"))
        part = max(fit(role, each.label) for role in ("velocity_north", "velocity_east"))
        unfit = part >= 2 or (name < 1 and (not places or angle >= 1)) or each.unit in OTHER_UNITS
        if name < 0 or unfit or id(each) in placed:
            continue
        relation = speed_on_positions(*places[0][-2:], each.evidence, heading) if places else None
        speed = read_speed(each, relation, convention, name, places[0].length if places else "")
        if each.is_set and name >= 1:
            why = f"it {IS_SET}: log the latter, or a position"
            sets.append(speed._replace(certainty=UNSURE, confirmed=False, contradicted=why))
        elif name >= 1 or (speed.confirmed and relation and relation.correlation > 0.9 and speed.unit in SPEEDS[:3]):
            found.append(speed)
    if named := [each for each in found if fit("surge", each.candidate.label) >= 1]:
        found = named
    if sets and not (found or places):
        found = [read_speed(each, None, convention, 0.0) for each in pool if _follows_setpoint(each, sets[0].candidate)]
    found.sort(key=lambda each: (not each.confirmed, -each.score))
    known = next((each for each in found if each.confirmed and each.certainty != UNSURE), None)
    return [by_other(each, known) if known and each.certainty == UNSURE else each for each in found] + sets


def _follows_setpoint(candidate: Candidate, setpoint: Candidate) -> bool:
    """Whether a series whose name tells nothing follows a setpoint of the speed, in a unit of speeds."""
    likelihood = max(fit(role, candidate.label) for role in ("command", "rudder", "heading", "course", "yaw_rate"))
    if likelihood >= 1 or names_side_alone(candidate.label) or fit("surge", candidate.label) < 0 or candidate.is_set:
        return False
    relation = speed_on_thrust(setpoint.evidence, setpoint.evidence, candidate.evidence, LATER)
    return relation.correlation > FOLLOWS and bool(unit_of(relation.slope)) and candidate.unit not in OTHER_UNITS


def by_reaction(speeds: list[Speed], commands: Sequence[Candidate]) -> list[Speed]:
    """The speeds; where no position proves one, that which follows the commands stands before one that does not."""
    if len(speeds) < 2 or speeds[0].confirmed or not commands:
        return speeds
    follows = [0.0 if each.contradicted else _follows(each.metres, commands) for each in speeds[:MOST]]
    first = int(np.argmax(follows)) if follows[0] < UNLIKE < LIKE < max(follows) else 0
    return [speeds[first], *speeds[:first], *speeds[first + 1 :]]


def following(pool: Sequence[Candidate], commands: Sequence[Candidate]) -> str:
    """Which series may be the speed since they follow the commands, and what to do; "" if none does."""
    named = [x for x in pool if fit("surge", x.label) >= 0 or len(words(x.label)[0]) == 1]
    named = [x for x in named if not (x.unit in OTHER_UNITS or x.is_set or SETPOINT & set(words(x.label)))]
    known = [repr(each.label.strip()) for each in named if _follows(each.evidence, commands) > LIKE]
    what = f"{' or '.join(known[:MOST])} follows the commands: call it speed only if it is measured, and no setpoint"
    return f"{what}; else log the measured speed, or a position" if known else ""


def _follows(speed: Pair, commands: Sequence[Candidate]) -> float:
    """The greatest correlation with a command, 0 … 1."""
    pairs = [each.evidence for each in commands[:MOST]]
    return float(np.nanmax(np.abs([speed_on_thrust(pair, pair, speed).correlation for pair in pairs]), initial=0.0))


def interchanged(places: Places, speeds: Sequence[Candidate]) -> tuple[Places, bool]:
    """The position with latitude and longitude interchanged if only then a series named as a speed follows its rate.

    Else it is as it is named; the second value says whether it is doubtful which of the two it is.
    """
    crossing = crossed(places)
    if crossing is None or not speeds:
        return places, False
    pairs = [[speed_on_positions(at.north, at.east, each.evidence) for at in (places, crossing)] for each in speeds]
    own, swapped = max(pairs, key=lambda pair: max(np.nan_to_num(each.correlation, nan=-1.0) for each in pair))
    shrunk = (1 - own.correlation) / max(1 - swapped.correlation, 1e-9)
    if not (swapped.correlation > FOLLOWED and shrunk > DOUBT):
        return places, False
    if (shrunk > BETTER and unit_of(swapped.slope)) or (unit_of(swapped.slope, FITS) and not unit_of(own.slope)):
        return crossing, False
    return places, swapped.correlation - own.correlation > MORE


def read_speed(
    candidate: Candidate, relation: Relation | None, convention: str, name: float, length: str = "m"
) -> Speed:
    """The unit of a speed by all evidence that there is; `length`: unit of the position, "" of metres by assumption."""
    declared = candidate.unit if candidate.unit in (*SPEEDS, *RARE) else ""
    usual = "m/s" if any(kind in candidate.kind or kind == convention for kind in METRIC) else ""
    score = name + quality(candidate) + 0.3 * ("nav" in words(candidate.name))
    if relation is not None and relation.correlation >= FOLLOWS and relation.is_sure(LONG):
        unit = unit_of(relation.slope, first=declared)
        if unit and (unit == "m/s" or not _is_twist(candidate)):
            speed = _near(candidate, unit, relation, declared, declared or usual, score)
            if length or declared or usual or speed.certainty != CERTAIN:
                return speed
            return speed._replace(certainty=PROBABLE, reason=f"{speed.reason}, if this is in m: no name tells its unit")
        if _is_twist(candidate):
            sentence = f"m/s by definition, but {relation.slope:.3g} × the rate of position: check stamps and position"
            others = (*filter(None, [unit]), _by_span(relation))
            return Speed(candidate, "m/s", UNSURE, sentence, others, True, "", score)
        sentence = f"{relation.slope:.3g} × the rate of position, which is no known unit"
        others = (*(unit for unit in SPEEDS[:3] if unit != (declared or "m/s")), _by_span(relation))
        return Speed(candidate, declared or "m/s", UNSURE, sentence, others, False, f"it is {sentence}", score - 2)
    if relation is not None and relation.seconds >= LONG and relation.correlation >= STEADY:
        unit = unit_of(relation.slope, TIGHT, declared)
        if unit and unit == (declared or "m/s"):
            sentence = f"{relation.slope:.3g} × the rate of position; the speed varies too little to be certain"
            return Speed(candidate, unit, PROBABLE, sentence, (), False, "", score + 1)
    followed = relation is None or relation.seconds <= 120 or relation.correlation >= FOLLOWS / 2
    follows_not = "" if followed else FOLLOWS_NOT
    unit = declared or usual or "m/s"
    others = tuple(other for other in SPEEDS[:3] if other != unit)
    doubt = f"; {follows_not}" if follows_not else ""
    if candidate.size * UNITS[unit][0] > PLAUSIBLE:
        sentence = f"values reach {candidate.size:.3g}, too much for {unit}{doubt}"
        return Speed(candidate, unit, UNSURE, sentence, others, False, follows_not, score - 3)
    if declared:
        sentence = f"the log says {declared}" + ("; no position confirms it" if relation is None else "")
        others = others if follows_not else ()
    else:
        sentence = "m/s by convention" if usual else "neither the name nor a position tells the unit"
    sure = UNSURE if follows_not or not (declared or usual) else PROBABLE
    return Speed(candidate, unit, sure, sentence + doubt, others, False, follows_not, score - 2 * bool(follows_not))


def _near(candidate: Candidate, unit: str, relation: Relation, declared: str, expected: str, score: float) -> Speed:
    """A speed that follows the rate of position, in the unit that is nearest; a unit must fit closely to be certain."""
    sentence = f"{relation.slope:.3g} × the rate of position (correlation {relation.correlation:.2f})"
    if declared and declared != unit:
        sentence += f", but declared as {declared}"
        return Speed(candidate, unit, UNSURE, sentence, (declared,), True, "", score)
    fits = unit_of(relation.slope, FITS, declared) == unit
    score += 2 * relation.correlation
    if fits or (unit == expected and not (declared and relation.correlation > SAME)):
        sure = CERTAIN if fits and relation.correlation > SAME else PROBABLE
        return Speed(candidate, unit, sure, sentence, (), True, "", score)
    rare = next((each for each in RARE if unit_of(relation.slope, FITS, each)), "")
    sentence += ", which is no known unit" if not rare else f"; {rare} would give {1 / UNITS[rare][0]:.3g}"
    sentence += f"; {unit} would give {1 / UNITS[unit][0]:.3g}"
    others = (unit, _by_span(relation)) if rare else (_by_span(relation),)
    return Speed(candidate, rare or unit, UNSURE, sentence, others, True, "", score)


def _is_twist(candidate: Candidate) -> bool:
    """Whether it is of a ROS twist, whose unit is defined, from a bag or a table."""
    return candidate.kind == "geometry_msgs" or "Twist" in candidate.kind or candidate.kind.startswith("nav_msgs")


def _by_span(relation: Relation) -> str:
    """What reads a speed in a unit of its own, such as ft/s, as an alternative of its unit."""
    return f"m/s, with span: {relation.slope:.3g}"


def by_other(speed: Speed, known: Speed) -> Speed:
    """The unit of a speed by its ratio to one whose unit is known."""
    if speed.contradicted or speed.candidate is known.candidate or _is_twist(speed.candidate):
        return speed
    time, value = cleaned(known.metres)
    own_time, own = speed.candidate.evidence
    expected = np.interp(own_time, time, value)
    fast = np.abs(expected) > 0.3 * np.quantile(np.abs(expected), 0.99)
    unit = unit_of(float(np.median(np.abs(own[fast]) / np.abs(expected[fast])))) if fast.sum() > 30 else ""
    if not unit:
        return speed
    sentence = f"by its ratio to {known.candidate.label}"
    return speed._replace(unit=unit, certainty=PROBABLE, reason=sentence, alternatives=())


def quality(candidate: Candidate) -> float:
    """How good a measurement is, by itself: fast, fine, free of copies, and signed. About 0 to 2."""
    if not len(candidate.intervals):
        return -1.0
    rate = min(1.0, 0.4 / max(candidate.interval, 0.05)) if candidate.interval > 0.4 else 1.0
    sizes = np.abs(np.diff(candidate.value))
    grain = float(np.quantile(sizes[sizes > 0], 0.05)) if (sizes > 0).any() else math.inf
    fine = 1.0 if grain < 0.02 * max(candidate.size, 1e-9) else 0.5
    return rate + 0.5 * fine + 0.3 * candidate.is_signed - 0.5 * candidate.repeats


def vectors(pool: Sequence[Candidate]) -> list[tuple[Candidate, Candidate]]:
    """The parts x and y of velocities that are logged as vectors: fields of a message, or two columns."""
    pairs = []
    for x in pool:
        if _is_part(x):
            twin = x.label[:-1] + ("y" if x.label[-1] == "x" else "Y")
            pairs += [(x, y) for y in pool if y.label == twin]
    return pairs


def _is_part(candidate: Candidate) -> bool:
    """Whether a name tells the part x of a velocity."""
    spoken = set(words(candidate.label))
    named = {"twist", "vel", "velocity", "vx", "linear"} & spoken and not {"angular", "acceleration"} & spoken
    return bool(named) and candidate.label[-1] in "xX"


def norms(pool: Sequence[Candidate]) -> list[Candidate]:
    """The size of each velocity that is logged as a vector, where it is not along the hull: the Euclidean norm."""
    pairs = [(x, y) for x, y in vectors(pool) if x.field and len(x.value) == len(y.value) and y.size > ACROSS * x.size]
    return [x.named(field=f"{x.field},{y.field}", value=np.hypot(x.value, y.value)) for x, y in pairs]


def along_hull(pool: Sequence[Candidate]) -> list[Candidate]:
    """The series without the parts of vectors that are not along the hull."""
    parts = [part for x, y in vectors(pool) if y.size > ACROSS * x.size for part in (x, y)]
    return [each for each in pool if not any(each is part for part in parts)]


def unit_of(slope: float, tolerance: float = RATIO, first: str = "") -> str:
    """The unit in which a speed is `slope` times the speed in m/s, `first` where it fits; "" if there is none."""
    units = (first,) if first in RARE else SPEEDS
    ratios = {unit: abs(math.log(max(slope, 1e-9) * UNITS[unit][0])) for unit in units}
    best = min(ratios, key=lambda unit: ratios[unit])
    return best if ratios[best] < math.log(tolerance) else ""


def turned_ahead(speed: Speed, places: Places, heading: Pair) -> Speed:
    """The speed, with the other sign where the boat moves along its heading, rad, while it tells the opposite."""
    one = speed.candidate
    if not one.is_signed or moved_along(places, speed.metres, heading).along.real > -ASTERN:
        return speed
    return speed._replace(candidate=one.named(value=-one.value, span=-one.span))


def report_speed(speeds: Sequence[Speed], channels: dict, series: dict) -> list[Decision]:
    """The best speed as the channel, its unit, its sensor's period, and how certain each of that is."""
    best = speeds[0]
    candidate = best.candidate
    scale = {"span": candidate.span} if candidate.span < 0 else {}
    channels["surge"] = candidate.source(unit=best.unit, window=AUTO, period="auto", **scale)
    series["surge"] = candidate
    close = [each for each in speeds[1:] if each.score > best.score - 1.5 and not each.contradicted]
    sure = CERTAIN if best.confirmed else UNSURE if best.contradicted else PROBABLE
    if not (named := fit("surge", candidate.label) >= 1):
        sure = PROBABLE if best.certainty == CERTAIN else UNSURE
    elif not best.confirmed and _is_part(candidate):
        sure = UNSURE  # a part of a vector may be to the north as well as along the hull
    why = "follows the rate of position" if best.confirmed else "by name" if named else "it follows the setpoint"
    if best.contradicted:
        why = f"by name, but {best.contradicted}"
    if candidate.is_signed:
        why += "; signed"
    sets = [each.candidate.label for each in speeds[1:] if each.candidate.is_set]
    if sets and not best.contradicted:
        why += f"; not {', '.join(sets)}, which {IS_SET}"
    if close:
        why += f"; before {', '.join(each.candidate.label for each in close[:3])}: {_why_better(best, close[0])}"
    decisions = [
        Decision("surge", "series", candidate.label, sure, why, (*(each.candidate.label for each in close), *sets)),
        Decision("surge", "unit", best.unit, least(best.certainty, sure), best.reason, best.alternatives),
    ]
    if scale:
        why = "the rate of position along the heading is positive where this speed is negative"
        decisions.append(Decision("surge", "span", f"{candidate.span:g}", PROBABLE, why, ("1",)))
    period, share = find_period([Channel(candidate.time, candidate.value, np.arange(len(candidate.time)))])
    if period:
        why = f"{share:.0%} of the speeds are copies of the one before"
        decisions.append(Decision("surge", "period", f"{period:g} s", PROBABLE, why))
    return decisions


def _why_better(best: Speed, other: Speed) -> str:
    one, two = best.candidate, other.candidate
    reasons = ["it repeats less"] * (one.repeats < two.repeats - 0.1)
    reasons += ["it is signed"] * (one.is_signed and not two.is_signed)
    return ", ".join(reasons) or "its name fits better"


def report_without_sign(speed: Speed, seconds: float, course: object, placed: bool) -> list[Decision]:
    """The surge of a boat that goes astern, where its speed has no sign in some seconds, but a course or a position."""
    why = f"{speed.candidate.label} has no sign, and by commands or course the boat goes astern in {seconds:.0f} s"
    if not course and not placed:
        why += ": log velocities, a course or a position, too, or leave out the logs in which the boat goes astern"
        return [Decision("surge", "sign", "never astern", UNSURE, why)]
    value = "from speed and course" if course else "from the position"
    return [Decision("surge", "series", value, PROBABLE, why, (speed.candidate.label,))]
