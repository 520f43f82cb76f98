"""The channels of a boat's logs: the series, their units, and how certain each of that is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from usvlearn.logs.channels.channel import AUTO
from usvlearn.logs.channels.relations import heading_rate
from usvlearn.logs.inspection.candidate import Candidate
from usvlearn.logs.inspection.courses import find_course, tell_course
from usvlearn.logs.inspection.decision import CERTAIN, PROBABLE, UNSURE, Decision, least
from usvlearn.logs.inspection.directions import Heading, YawRate, find_headings, find_yaw_rate, orient
from usvlearn.logs.inspection.places import (
    Pair,
    Places,
    course_of,
    find_places,
    guess_places,
    is_mirror_image,
    rate_of,
    tell_places,
)
from usvlearn.logs.inspection.senses import LIKELY
from usvlearn.logs.inspection.sides import SWAPPED, Commands, Side, doubted, find_commands
from usvlearn.logs.inspection.speeds import (
    Speed,
    Velocities,
    along_hull,
    find_speeds,
    find_velocities,
    interchanged,
    is_part,
    norms,
    period_of,
)
from usvlearn.logs.inspection.sways import find_sway, tell_sway
from usvlearn.logs.inspection.vocabulary import (
    WORDS,
    fit,
    names_azimuth,
    names_force,
    names_moment,
    names_side_alone,
    side,
)
from usvlearn.logs.inspection.written import scalar

SIDES = ("command_left", "command_right")
UNEVEN, ON_CHANGE = 1.5, 3.0  # ratio of long to usual intervals, from which a command may be, and is posted on change
DEGREES = ("latitude", "longitude")  # which rise as evenly as a clock on a straight line
NO_REPEATS = 0.02  # share of values that repeat the one before, below which none does


class Proposal(NamedTuple):
    """What was concluded."""

    channels: dict[str, dict[str, Any]]  # arguments of a `Source`
    series: dict[str, Candidate]  # of the channels that have one
    decisions: list[Decision]
    speed: Pair | None  # m/s, of the surge or of the position
    heading: Heading | None
    yaw_rate: YawRate | None
    missing: list[str]  # required channels that were not found
    unfit: str = ""  # why the commands of this boat are none of two fixed sides


def propose(found: Sequence[Candidate], convention: str) -> Proposal:
    """Decide which series is which channel.

    Args:
        found: all series.
        convention: name of the format.
    """
    pool = [
        each for each in found if each.varies and not (each.is_clock and max(fit(x, each.label) for x in DEGREES) < 1)
    ]
    places = find_places(pool)
    if not places and (guessed := guess_places(*_unnamed(pool))):
        places = [guessed]
    crossing = False  # whether latitude and longitude may be interchanged
    if places:
        named = [each for each in pool if fit("surge", each.label) >= 1]
        first, crossing = interchanged(places[0], named)
        places = [first, *places[1:]]
    channels: dict[str, dict[str, Any]] = {}
    series: dict[str, Candidate] = {}
    decisions: list[Decision] = []
    oriented = next((each for each in places if each.oriented), None)
    course = course_of(oriented) if oriented else None
    headings = find_headings(pool, course, convention)
    heading = headings[0] if headings else None
    yaw, turn, sense, axes, doubt = None, None, CERTAIN, CERTAIN, ""
    if places and heading and not oriented and (found_axes := orient(places[0], heading)):
        places, axes = [found_axes, *places[1:]], least(PROBABLE, heading.certainty)
        doubt = "which of them is north, is told by the heading, which follows the course then"
    if heading:
        alone = {side(each.label) for each in pool if names_side_alone(each.label)}
        turning = [each for each in pool if len(alone) < 2 or not names_side_alone(each.label)]  # L and R are sides
        yaw, rejected = find_yaw_rate(turning, heading)
        turn = _turn(heading, yaw)
        decisions += _tell_heading(heading, headings, channels, series)
        rivals = [each.label for each in turning if fit("yaw_rate", each.label) >= 0.5]
        decisions += _tell_yaw_rate(yaw, heading, rivals, channels, series)
        decisions += rejected
    taken = [each for each in (heading and heading.candidate, yaw and yaw.candidate) if each is not None]
    for each in places:
        taken += [each.first, each.second]
    left = [each for each in pool if not any(each is other for other in taken)]
    speeds = find_speeds([*along_hull(left), *norms(left)], places, convention)
    velocities = find_velocities(left, places, heading.radians if heading else None, convention)
    if velocities and speeds and (speeds[0].candidate.extent[0] < -0.03 * speeds[0].candidate.size):
        velocities = None  # the speed is signed already
    if velocities:
        speeds = [velocities.size, *speeds]
    speed = speeds[0].metres if speeds else rate_of(places[0]) if places else None
    beside = speeds[0] if speeds and not velocities else None
    track = places[0] if places and places[0].oriented else None
    sway = find_sway(left, beside, track, heading)
    over_ground = None if sway or velocities else find_course(left, speeds, track, heading)
    used = [each.candidate for each in (beside, sway) if each]
    rest = [each for each in left if not (any(each is other for other in used) or names_state(each))]
    everything, unfit = found, ""
    if azimuths := [each.label for each in pool if names_azimuth(each.label)]:
        rest, everything = ([each for each in group if _names_whole(each)] for group in (rest, found))
        unfit = "" if rest else _told_azimuths(azimuths)
    proved = heading is not None and heading.certainty == CERTAIN and not crossing
    commands = find_commands(rest, everything, speed, turn, convention, proved)
    if heading and course and not (proved or heading.declared(convention)):
        commands = [doubted(each) for each in commands]
    turned = commands[0].turning if commands else 0.0
    if heading and not proved and turned < (-LIKELY if heading.by_format else LIKELY):
        against = "the boat would turn against its thrusters: its sense, or the sides, are wrong"
        why = against if turned <= -LIKELY else "nothing confirms its sense"
        decisions = [_doubted(each, why) for each in decisions]
        sense, axes = UNSURE, axes if axes == CERTAIN else UNSURE
    if crossing:
        axes, doubt = UNSURE, "by name, but the speed follows their rate better if they are interchanged"
        decisions = [_doubted(each, "latitude and longitude may be interchanged") for each in decisions]
    if heading and course and not places[0].geographic and _is_contested(heading, commands, places[0], speed):
        axes, doubt = UNSURE, "the sense that they give the heading is doubtful: north and east may be interchanged"
        decisions = [_doubted(each, "its name or the sides say the opposite") for each in decisions]
    decisions = _tell_commands(commands, channels, series) + decisions
    if velocities:
        decisions += _tell_velocities(velocities, speeds[1:], channels, series)
    elif speeds:
        decisions += _tell_speed(speeds, channels, series)
    elif places:
        decisions += _tell_places_as_speed()
    if sway:
        decisions += tell_sway(sway, channels, series, least(sense, axes))
    elif over_ground and least(sense, axes) == CERTAIN:
        decisions += tell_course(over_ground, channels, series)
    if places:
        decisions += tell_places(
            places[0],
            channels,
            series,
            bool(speeds and speeds[0].confirmed and speeds[0].certainty == CERTAIN),
            axes,
            doubt,
        )
    missing = [name for name in (*SIDES, "heading") if name not in channels]
    missing += [] if speeds or places else ["surge"]
    order = [*SIDES, "heading", "yaw_rate", "surge"]
    ordered = {name: channels[name] for name in (*order, *channels) if name in channels}
    return Proposal(ordered, series, decisions, speed, heading, yaw, missing, unfit)


def _is_contested(heading: Heading, commands: Sequence[Commands], places: Places, speed: Pair | None) -> bool:
    """Whether the sides, the name of the heading, or speed and heading contradict the names of local coordinates."""
    if speed is not None and is_mirror_image(places, speed, heading.radians):
        return True
    if commands and commands[0].reason == SWAPPED:
        return True
    odd = heading.unit.startswith("enu_") and not heading.candidate.unit.startswith("enu_") and heading.is_from_north
    return odd and not (commands and commands[0].certainty == CERTAIN)


def _names_whole(candidate: Candidate) -> bool:
    """Whether a name tells the force or the moment of all thrusters together."""
    return names_force(candidate.label) or names_moment(candidate.label)


def _told_azimuths(labels: Sequence[str]) -> str:
    return (
        f"the thrusters turn ({', '.join(labels[:3])}), so that no two fixed sides drive this boat: log the force "
        "ahead, N, and the moment about the vertical axis, N·m, as tau_x and tau_n, or compute them from thrusts and "
        "angles, and give them to usvlearn.read as arrays"
    )


def _doubted(decision: Decision, why: str) -> Decision:
    """The sense of a heading that neither a course over ground nor the thrusters confirm."""
    if decision[:2] not in (("heading", "unit"), ("yaw_rate", "unit")):
        return decision
    other = decision.value.removeprefix("enu_") if decision.value.startswith("enu_") else f"enu_{decision.value}"
    others = tuple(dict.fromkeys((*decision.alternatives, other)))
    return decision._replace(certainty=UNSURE, reason=f"{decision.reason}; {why}", alternatives=others)


def _unnamed(pool: Sequence[Candidate]) -> tuple[list[Candidate], list[Candidate]]:
    """Series whose names tell nothing, and those of them and of the named speeds that may be a speed."""
    nameless = [each for each in pool if all(fit(role, each.label) < 1 for role in WORDS if role != "command")]
    named = [each for each in pool if fit("surge", each.label) >= 1]
    return nameless, named or [each for each in nameless if each.size < 100]


def names_state(candidate: Candidate) -> bool:
    """Whether a name tells a measured state, which no command is."""
    return any(
        fit(role, candidate.label) >= 2 for role in ("heading", "course", "surge", "yaw_rate", "latitude", "longitude")
    )


def _turn(heading: Heading, yaw: YawRate | None) -> Pair:
    """The yaw rate, rad/s, clockwise."""
    if yaw is not None:
        from usvlearn.logs.channels.channel import UNITS

        return yaw.candidate.scaled(*UNITS[yaw.unit])
    return heading_rate(heading.radians)


def on_change(candidate: Candidate) -> tuple[bool, str]:
    """Whether values are posted only when they differ from the one before, and how certain that is."""
    ratio = candidate.slow / candidate.interval if candidate.interval > 0 else 1.0
    if candidate.repeats >= NO_REPEATS or not ratio > UNEVEN:
        return False, PROBABLE
    return True, PROBABLE if ratio > ON_CHANGE else UNSURE


def _tell_heading(best: Heading, headings: Sequence[Heading], channels: dict, series: dict) -> list[Decision]:
    candidate = best.candidate
    scale = {} if best.span == 1 else {"span": best.span}
    channels["heading"] = candidate.source(unit=best.unit, window=AUTO, **scale)
    series["heading"] = candidate
    close = [each.candidate.label for each in headings[1:] if each.score > best.score - 1]
    named = fit("heading", candidate.label)
    if named >= 1:
        agreed = best.agreement == best.agreement and best.agreement > 0.6
        sure = CERTAIN if agreed and not close else PROBABLE
        why = "by name" + (", and it follows the course over ground" if agreed else "")
    else:
        sure, why = UNSURE, best.reason
    why += f"; others: {', '.join(close[:3])}" if close else ""
    decisions = [
        Decision("heading", "series", candidate.label, sure, why, tuple(close)),
        Decision("heading", "unit", best.unit, best.certainty, best.reason, best.alternatives),
    ]
    return decisions + [Decision("heading", "span", f"{best.span:g}", best.certainty, best.reason) for _ in scale]


def _tell_yaw_rate(
    yaw: YawRate | None, heading: Heading, rivals: Sequence[str], channels: dict, series: dict
) -> list[Decision]:
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


def _tell_speed(speeds: Sequence[Speed], channels: dict, series: dict) -> list[Decision]:
    best = speeds[0]
    candidate = best.candidate
    channels["surge"] = candidate.source(unit=best.unit, window=AUTO, period="auto")
    series["surge"] = candidate
    close = [each for each in speeds[1:] if each.score > best.score - 1.5 and not each.contradicted]
    sure = (
        CERTAIN
        if best.confirmed and fit("surge", candidate.label) >= 1
        else PROBABLE
        if not best.contradicted
        else UNSURE
    )
    if fit("surge", candidate.label) < 1:
        sure = PROBABLE if best.certainty == CERTAIN else UNSURE
    elif not best.confirmed and is_part(candidate):
        sure = UNSURE  # a part of a vector may be to the north as well as along the hull
    why = "follows the rate of position" if best.confirmed else "by name"
    if best.contradicted:
        why = "by name, but it does not follow the rate of position"
    if candidate.extent[0] < -0.03 * candidate.size:
        why += "; signed"
    if close:
        why += f"; before {', '.join(each.candidate.label for each in close[:3])}: {_why_better(best, close[0])}"
    decisions = [
        Decision("surge", "series", candidate.label, sure, why, tuple(each.candidate.label for each in close)),
        Decision("surge", "unit", best.unit, least(best.certainty, sure), best.reason, best.alternatives),
    ]
    period, share = period_of(candidate)
    if period:
        decisions.append(
            Decision(
                "surge", "period", f"{period:g} s", PROBABLE, f"{share:.0%} of the speeds are copies of the one before"
            )
        )
    return decisions


def _why_better(best: Speed, other: Speed) -> str:
    one, two = best.candidate, other.candidate
    reasons = []
    if one.interval < 0.7 * two.interval:
        reasons.append("it comes more often")
    if one.repeats < two.repeats - 0.1:
        reasons.append("it repeats less")
    if one.extent[0] < -0.03 * one.size and not two.extent[0] < -0.03 * two.size:
        reasons.append("it is signed")
    if best.confirmed and not other.confirmed:
        reasons.append("it follows the position")
    return ", ".join(reasons) or "its name fits better"


def _tell_commands(commands: Sequence[Commands], channels: dict, series: dict) -> list[Decision]:
    if not commands:
        return []
    best, decisions = commands[0], []
    for channel, one in zip(SIDES, (best.left, best.right), strict=True):
        channels[channel] = _command_source(one)
        if len(one.parts) == 1:
            series[channel] = one.parts[0]
        others = tuple(_listed(getattr(each, channel.removeprefix("command_"))) for each in commands[1:4])
        other = _listed(best.right if one is best.left else best.left)
        if best.certainty == UNSURE and other != _listed(one):
            others = (other, *others)
        if best.middle:
            others = (scalar([each.name for each in (*one.parts, best.middle)]), *others)
        label, level = _listed(one), one.levels[0]
        ahead = "reversed" if min((one.sign, *one.weights[:1])) < 0 else "positive ahead"
        held = channels[channel].get("held", False)
        how = "on change: held until the next one" if held else "periodic: window auto"
        rate = f"{one.parts[0].repeats:.0%} repeat the one before; every {one.parts[0].interval:.2g} s"
        span, span_reason = f"{one.sign * level.span:g}", f"{level.kind}: {level.span_reason}"
        decisions += [
            Decision(channel, "series", label, best.certainty, best.reason, others),
            Decision(channel, "zero", f"{level.zero:g}", level.zero_certainty, level.zero_reason, level.zeros),
            Decision(channel, "span", span, level.span_certainty, span_reason, level.alternatives),
            Decision(channel, "sign", ahead, best.sign_certainty, best.sign_reason, best.alternatives),
            Decision(channel, "posting", how, on_change(one.parts[0])[1], rate),
        ]
    return decisions


def _listed(one: Side) -> str:
    return " + ".join(each.label for each in one.parts)


def _command_source(one: Side) -> dict[str, Any]:
    held = any(on_change(each)[0] for each in one.parts)
    keys = {"held": held, "window": AUTO, "delay": 0.0}
    zeros, spans = [each.zero for each in one.levels], [one.sign * each.span for each in one.levels]
    if len(one.parts) == 1:
        return one.parts[0].source(unit="1", zero=zeros[0], span=spans[0], **keys)
    source: dict[str, Any] = {"name": [each.name for each in one.parts]}
    if any(each.field not in (None, "data") for each in one.parts):
        source["field"] = [each.field or "data" for each in one.parts]
    kinds = [each.kind for each in one.levels]
    source |= {
        "unit": kinds if "N·m" in kinds else "1",
        "zero": zeros[0] if len(set(zeros)) == 1 else zeros,
        "span": spans[0] if len(set(spans)) == 1 else spans,
    }
    if one.weights:
        source["weight"] = list(one.weights)
    return source | keys


def _tell_velocities(found: Velocities, speeds: Sequence[Speed], channels: dict, series: dict) -> list[Decision]:
    """Both components, from which the surge is computed with the heading."""
    size, decisions = found.size, []
    others = tuple(each.candidate.label for each in speeds[:3])
    for name, candidate in (("velocity_north", found.north), ("velocity_east", found.east)):
        channels[name] = candidate.source(unit=size.unit, window=AUTO)
        series[name] = candidate
        sure = UNSURE if found.guessed else CERTAIN if size.confirmed else PROBABLE
        why = ("by its direction" if found.guessed else "by name") + (
            "; their size follows the rate of position" if size.confirmed else ""
        )
        decisions.append(Decision(name, "series", candidate.label, sure, why))
        decisions.append(Decision(name, "unit", size.unit, size.certainty, size.reason, size.alternatives))
    why = "velocities and heading give a signed surge" + (f"; before {', '.join(others)}" if others else "")
    sure = UNSURE if found.guessed else PROBABLE
    return [*decisions, Decision("surge", "series", "from the velocities", sure, why, others)]


def _tell_places_as_speed() -> list[Decision]:
    return [
        Decision(
            "surge",
            "series",
            "from the position",
            PROBABLE,
            "no series is known to be the speed: the position tells it",
        )
    ]
