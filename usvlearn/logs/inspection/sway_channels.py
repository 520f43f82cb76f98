"""Which series is the sway, in which unit, and to which side it counts.

A sway is named so, or stands beside the surge as the other part of the same vector. The rate of position across the
hull proves it, and tells unit and side. Without a position the side is by convention only: vectors of messages whose
heading counts from east, counter-clockwise, count to port.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from usvlearn.logs.channels.channel import AUTO, SPEEDS, SWAY, UNITS
from usvlearn.logs.channels.correlations import CLOSE, NOTHING, SURE, Relation
from usvlearn.logs.channels.position_rates import sway_on_positions
from usvlearn.logs.inspection.candidate import Candidate
from usvlearn.logs.inspection.decision import CERTAIN, PROBABLE, UNSURE, Decision, least
from usvlearn.logs.inspection.directions import Heading
from usvlearn.logs.inspection.position_channels import Places
from usvlearn.logs.inspection.speeds import Speed, unit_of
from usvlearn.logs.inspection.vocabulary import fit, words

PAIRS = {("x", "y"), ("u", "v"), ("vx", "vy"), ("surge", "sway"), ("ahead", "sideways"), ("forward", "lateral"),
         ("longitudinal", "lateral"), ("forward", "right"), ("laengs", "quer")}  # fmt: skip  # words of surge and sway
FOLLOWS = 0.6  # correlation with the rate across the hull
TIGHT = 1.15  # how closely the slope fits a unit that is certain
LEANS = 0.3  # correlation from which the side is probable
LONG = 120.0  # s, in which a close correlation is no chance
PLAUSIBLE = 5.0  # m/s


class Sway(NamedTuple):
    """A series that is the sway."""

    candidate: Candidate
    unit: str
    sign: float  # 1: to starboard, -1: to port
    certainty: tuple[str, str, str]  # of the series, the unit and the side
    reason: tuple[str, str, str]


def find_sway(
    pool: Sequence[Candidate], surge: Speed | None, places: Places | None, heading: Heading | None
) -> Sway | None:
    """The sway, if one is logged, by an oriented position.

    Beside the surge there can be one only if the surge is a series, and signed.
    """
    ranked: list[tuple[bool, bool, float, int, Sway]] = []
    for each in pool:
        named = fit(SWAY, each.label)
        beside = surge is not None and each is not surge.candidate and is_beside(surge.candidate, each)
        if not (named >= 2 or (beside and named >= 0)):
            continue
        relation = NOTHING
        if places is not None and heading is not None:
            relation = sway_on_positions(places.north, places.east, heading.radians, each.evidence)
        follows = abs(relation.correlation) >= FOLLOWS and relation.is_sure(LONG)
        read = _proved(each, relation, surge, heading) if follows and heading else None
        read = read or _by_name(each, named, relation, surge, heading)
        if each.size * UNITS[read.unit][0] < PLAUSIBLE:
            ranked.append((follows, beside, named, -len(ranked), read))
    return max(ranked, key=lambda each: each[:4])[-1] if ranked else None


def is_beside(surge: Candidate, other: Candidate) -> bool:
    """Whether a series is the part across the hull of the vector whose part along the hull is the surge."""
    if surge.field not in (None, "data") and surge.name != other.name:
        return False
    one, two = words(surge.label), words(other.label)
    changed = [pair for pair in zip(one, two, strict=False) if pair[0] != pair[1]]
    return len(one) == len(two) and len(changed) == 1 and changed[0] in PAIRS


def _proved(candidate: Candidate, relation: Relation, surge: Speed | None, heading: Heading) -> Sway | None:
    """A sway that follows the rate of position across the hull."""
    unit = unit_of(abs(relation.slope))
    if not unit:
        return None
    declared = candidate.unit if candidate.unit in SPEEDS else ""
    fits = unit_of(abs(relation.slope), TIGHT) == unit and abs(relation.correlation) >= CLOSE
    expected = declared or (surge.unit if surge else "")
    of_unit = CERTAIN if fits else PROBABLE if unit == expected else UNSURE
    if declared and declared != unit:
        of_unit = UNSURE
    text = f"{relation.slope:.3g} × the rate of position across the hull (correlation {relation.correlation:.2f})"
    sure = heading.certainty
    sign = math.copysign(1.0, relation.slope)
    side = "to starboard" if sign > 0 else "to port"
    reasons = "it follows the rate of position across the hull", text, f"{side}: {text}"
    return Sway(candidate, unit, sign, (sure, of_unit, sure), reasons)


def _by_name(
    candidate: Candidate, named: float, relation: Relation, surge: Speed | None, heading: Heading | None
) -> Sway:
    """A sway that no position proves."""
    declared = candidate.unit if candidate.unit in SPEEDS else ""
    unit = declared or (surge.unit if surge else "m/s")
    leans = heading is not None and abs(relation.certainty) >= SURE and abs(relation.correlation) >= LEANS
    unlike = relation.seconds > 0 and not leans
    sure = PROBABLE if leans or (named >= 2 and not unlike) else UNSURE
    why = "by name" if named >= 2 else "the part across the hull of the vector whose other part is the surge"
    why += "; it does not clearly follow the rate of position across the hull" if unlike else ""
    of_unit = least(sure, PROBABLE if declared else surge.certainty if surge else UNSURE)
    proof = "the log says so" if declared else "as the surge" if surge else "neither the log nor a position tells it"
    if leans and heading:
        of_side = least(PROBABLE, heading.certainty)
        text = f"it leans to the rate of position across the hull (correlation {relation.correlation:.2f})"
        return Sway(candidate, unit, math.copysign(1.0, relation.slope), (sure, of_unit, of_side), (why, proof, text))
    turned = heading is not None and heading.unit.startswith("enu_")
    text = "vectors beside a heading from east count to port" if turned else "taken as to starboard"
    reasons = why, proof, f"{text}: no position confirms it"
    return Sway(candidate, unit, -1.0 if turned else 1.0, (sure, of_unit, UNSURE), reasons)


def report_sway(
    sway: Sway, channels: dict[str, dict[str, Any]], series: dict[str, Candidate], sense: str
) -> list[Decision]:
    """The sway as a channel, and what is said about it.

    `sense` says how certain it is in which sense heading and position count.
    """
    candidate, unit = sway.candidate, sway.unit
    is_sway, of_unit, of_side = least(sway.certainty[0], sense), sway.certainty[1], least(sway.certainty[2], sense)
    spoken = sway.sign < 0 or of_side == UNSURE
    channels[SWAY] = candidate.source(unit=unit, window=AUTO, **({"span": sway.sign} if spoken else {}))
    series[SWAY] = candidate
    side, other = ("to starboard", "-1") if sway.sign > 0 else ("to port", "1")
    others = tuple(each for each in SPEEDS[:3] if each != unit) if of_unit == UNSURE else ()
    return [
        Decision(SWAY, "series", candidate.label, is_sway, sway.reason[0]),
        Decision(SWAY, "unit", unit, of_unit, sway.reason[1], others),
        Decision(SWAY, "sign", side, of_side, sway.reason[2], (other,)),
    ]
