"""The channels of a boat's logs: the series, their units, and how certain each of that is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from usvlearn.logs.channels.channel import AUTO, CHANNELS, COMMANDS, DEGREES, UNITS
from usvlearn.logs.channels.correlations import heading_rate
from usvlearn.logs.inspection import courses, directions, position_channels
from usvlearn.logs.inspection.candidate import IS_SET, Candidate
from usvlearn.logs.inspection.command_sides import SWAPPED, Commands, Side, doubted, find_commands, seconds_astern
from usvlearn.logs.inspection.config_writer import scalar
from usvlearn.logs.inspection.decision import CERTAIN, PROBABLE, UNSURE, Decision, least
from usvlearn.logs.inspection.directions import Heading, YawRate
from usvlearn.logs.inspection.position_channels import Pair, Places
from usvlearn.logs.inspection.sign_hypotheses import LIKELY
from usvlearn.logs.inspection.speeds import (
    along_hull,
    by_reaction,
    find_speeds,
    following,
    interchanged,
    norms,
    report_speed,
    report_without_sign,
    turned_ahead,
)
from usvlearn.logs.inspection.sway_channels import find_sway, report_sway
from usvlearn.logs.inspection.vehicles import of_one_vehicle
from usvlearn.logs.inspection.vocabulary import (
    WORDS,
    fit,
    names_azimuth,
    names_force,
    names_moment,
    names_side_alone,
    side,
)

UNEVEN, ON_CHANGE = 1.5, 3.0  # ratio of long to usual intervals, from which a command may be, and is posted on change
NO_REPEATS = 0.02  # share of values that repeat the one before, below which none does


class Proposal(NamedTuple):
    """What was concluded."""

    channels: dict[str, dict[str, Any]]  # arguments of a `Source`
    series: dict[str, Candidate]  # of the channels that have one
    decisions: list[Decision]
    missing: list[str]  # required channels that were not found
    unfit: str = ""  # why the commands of this boat are none of two fixed sides


def propose(everything: Sequence[Candidate], convention: str, exchanged: bool = False) -> Proposal:
    """Decide which of all series is which channel; `convention` is the name of the format.

    If `exchanged`, latitude and longitude, or velocities to the north and to the east, are interchanged, since only so
    the heading and the sides are what they are called.
    """
    of_vehicle, decisions = of_one_vehicle(position_channels.in_degrees(everything), convention)
    pool = [each for each in of_vehicle if each.varies]  # on a straight line degrees rise as evenly as a clock
    pool = [each for each in pool if not each.is_clock or max(fit(x, each.label) for x in DEGREES) >= 1]
    places = position_channels.find_places(pool, convention)
    if not places and (guessed := position_channels.guess_places(*_unnamed(pool))):
        places = [guessed]
    named = [each for each in pool if fit("surge", each.label) >= 1]
    crossing = exchanged  # whether latitude and longitude may be interchanged
    if places:
        other, doubtful = interchanged(places[0], named)
        first, crossing = (exchanged and position_channels.crossed(places[0])) or other, exchanged or doubtful
        places = [first, *places[1:]]
    channels: dict[str, dict[str, Any]] = {}
    series: dict[str, Candidate] = {}
    oriented = next((each for each in places if each.oriented), None)
    course = position_channels.course_of(oriented) if oriented else None
    velocity = courses.named_velocities(pool, convention)
    velocity = (velocity[1], velocity[0]) if exchanged and velocity and not oriented else velocity
    sailed = None if oriented else courses.reckoned(pool, named, velocity)
    headings = directions.find_headings(pool, sailed[1] if sailed else course, convention)
    heading = headings[0] if headings else None
    yaw, turn, sense, axes, doubt = None, None, CERTAIN, CERTAIN, ""
    if places and heading and not oriented and (found_axes := directions.orient(places[0], heading)):
        places, axes = [found_axes, *places[1:]], least(PROBABLE, heading.certainty)
        doubt = "which of them is north, is told by the heading, which follows the course then"
    if heading and oriented and course:
        measured = [each for each in named if not each.is_set]
        ahead = next(
            (each.metres for each in find_speeds(measured, [oriented], convention)), position_channels.rate_of(oriented)
        )
        heading = directions.without_error(heading, (oriented.north, oriented.east), course, ahead, convention)
    elif heading and sailed:
        heading = directions.without_error(heading, *sailed, convention)
    if heading:
        alone = {side(each.label) for each in pool if names_side_alone(each.label)}
        turning = [each for each in pool if len(alone) < 2 or not names_side_alone(each.label)]  # L and R are sides
        yaw, rejected = directions.find_yaw_rate(turning, heading)
        turn = _turn(heading, yaw)
        decisions += directions.report_heading(heading, headings, channels, series)
        rivals = [each.label for each in turning if fit("yaw_rate", each.label) >= 0.5]
        decisions += directions.report_yaw_rate(yaw, heading, rivals, channels, series)
        decisions += rejected
    taken = [each for each in (heading and heading.candidate, yaw and yaw.candidate) if each is not None]
    for each in places:
        taken += [each.first, each.second]
    left = [each for each in pool if not any(each is other for other in taken)]
    angles = heading.radians if heading else None
    speeds = find_speeds([*along_hull(left), *norms(left)], places, convention, angles)
    speeds = by_reaction(speeds, [each for each in left if fit("command", each.label) >= 1])
    velocities = courses.find_velocities(left, places, angles, convention, velocity)
    sets = [each.candidate for each in speeds if each.candidate.is_set]
    if (places or velocities) and len(sets) == len(speeds):
        speeds = []
    if velocities and speeds and speeds[0].candidate.is_signed:
        velocities = None  # the speed is signed already
    if velocities:
        speeds = [velocities.size, *speeds]
    if oriented and heading and heading.certainty == CERTAIN:
        speeds = [turned_ahead(each, oriented, heading.radians) for each in speeds]
    speed = speeds[0].metres if speeds else position_channels.rate_of(places[0]) if places else None
    beside = speeds[0] if speeds and not velocities else None
    track = places[0] if places and places[0].oriented else None
    sway = find_sway(left, beside, track, heading)
    over_ground = None if sway or velocities else courses.find_course(left, speeds, track, heading)
    used = [*sets, *(each.candidate for each in (beside, sway) if each)]
    rest = [each for each in left if not (any(each is other for other in used) or _names_state(each))]
    still, unfit = of_vehicle, ""
    if azimuths := [each.label for each in pool if names_azimuth(each.label)]:
        rest, still = ([each for each in group if _names_whole(each)] for group in (rest, of_vehicle))
        unfit = "" if rest else _azimuths_reported(azimuths)
    proved = heading is not None and heading.certainty == CERTAIN and not crossing
    commands = find_commands(rest, still, speed, turn, convention, proved)
    if heading and course and not (proved or heading.declared(convention)):
        commands = [doubted(each) for each in commands]
    turned = commands[0].turning if commands else 0.0
    if heading and not proved and turned < (-LIKELY if heading.by_format else LIKELY):
        against = "the boat would turn against its thrusters: its sense, or the sides, are wrong"
        why = against if turned <= -LIKELY else "nothing confirms its sense"
        decisions = [_doubted(each, why) for each in decisions]
        sense, axes = UNSURE, axes if axes == CERTAIN else UNSURE
    contested = heading and _is_contested(heading, commands, places[0] if course else None, speed)
    local = bool(course and not places[0].geographic)
    exchangeable = (position_channels.crossed(places[0]) if course else velocity) is not None
    if heading and contested and heading.is_from_north and exchangeable and not exchanged:
        return propose(everything, convention, exchanged=True)
    if crossing:
        axes, doubt = UNSURE, "by name, but the speed follows their rate better if they are interchanged"
        if exchanged:
            doubt = "against the names: else the heading counts from east, and the sides are swapped"
        what = "latitude and longitude" if oriented else "velocities to the north and to the east"
        decisions = [_doubted(each, f"{what} may be interchanged") for each in decisions]
    elif contested and (local or exchangeable):
        axes, doubt = UNSURE, "the sense that they give the heading is doubtful: north and east may be interchanged"
        decisions = [_doubted(each, "its name or the sides say the opposite") for each in decisions]
    decisions = report_commands(commands, channels, series) + decisions
    lost = seconds_astern(commands[0], beside.metres) if commands and beside else 0.0
    by_course = courses.course_beside(left, beside, heading) if beside else None
    if by_course and heading and not track:
        lost = max(lost, courses.seconds_back(by_course, heading))
    signed = next((each for each in speeds[1:] if each.candidate.is_signed and not each.contradicted), None)
    if lost and signed:
        speeds, lost = [signed, *(each for each in speeds if each is not signed)], 0.0
    if lost:
        over_ground = over_ground or by_course
        decisions += report_without_sign(speeds[0], lost, over_ground, bool(track))
    if lost and over_ground:
        decisions += courses.report_course(over_ground, channels, series)
    elif lost and track:
        pass  # the surge comes from the position
    elif velocities:
        decisions += courses.report_velocities(
            velocities, speeds[1:], channels, series, doubt if contested or exchanged else ""
        )
    elif speeds:
        decisions += report_speed(speeds, channels, series)
    elif places:
        known = f"{', '.join(each.label for each in sets)} {IS_SET}" if sets else "no series is known to be the speed"
        why = f"{known}: the position tells it"
        decisions.append(Decision("surge", "series", "from the position", PROBABLE, why))
    if sway:
        decisions += report_sway(sway, channels, series, least(sense, axes))
    elif over_ground and not lost and least(sense, axes) == CERTAIN:
        decisions += courses.report_course(over_ground, channels, series)
    if places:
        confirmed = bool(speeds and not lost and speeds[0].confirmed and speeds[0].certainty == CERTAIN)
        decisions += position_channels.report_places(places[0], channels, series, confirmed, axes, doubt)
    spoken = {each.spoken: each.named(spoken="").label for each in of_vehicle if each.spoken}
    decisions = [each._replace(value=spoken.get(each.value, each.value)) for each in decisions]
    why = "it comes again and again, far beyond all others: it means unknown"
    unknown = {name: one.missing for name, one in series.items() if one.missing}
    decisions += [Decision(name, "missing", scalar(list(each)), PROBABLE, why) for name, each in unknown.items()]
    missing = [name for name in (*COMMANDS, "heading") if name not in channels]
    missing += [] if speeds or places else ["surge"]
    if missing == ["surge"]:
        others = [each for each in rest if not any(each is other for other in series.values())]
        unfit = following(others, [series[side] for side in COMMANDS if side in series])
    states = [role for role in ("heading", "surge") if role in missing]
    if still := [x for x in of_vehicle if not x.varies and any(fit(role, x.label) >= 1 for role in states)]:
        sentence = ", ".join(f"{each.label!r} is always {each.value[0]:g}" for each in still[:3])
        unfit = f"{sentence}, as of a sensor that has stopped: give logs in which it changes"
    ordered = {name: channels[name] for name in (*CHANNELS, *channels) if name in channels}
    return Proposal(ordered, series, decisions, missing, unfit)


def _is_contested(heading: Heading, commands: Sequence[Commands], places: Places | None, speed: Pair | None) -> bool:
    """Whether the sides, the name of the heading, or speed and heading contradict the names of north and east."""
    if commands and commands[0].reason == SWAPPED:
        return heading.unit.startswith("enu_") or (places is not None and not places.geographic)
    if places is None or places.geographic:
        return False
    if speed is not None and position_channels.moved_along(places, speed, heading.radians).is_mirrored:
        return True
    odd = heading.unit.startswith("enu_") and not heading.candidate.unit.startswith("enu_") and heading.is_from_north
    return odd and not (commands and commands[0].certainty == CERTAIN)


def _names_whole(candidate: Candidate) -> bool:
    """Whether a name tells the force or the moment of all thrusters together."""
    return names_force(candidate.label) or names_moment(candidate.label)


def _azimuths_reported(labels: Sequence[str]) -> str:
    return (
        f"the thrusters turn ({', '.join(labels[:3])}), so that no two fixed sides drive this boat: log the force "
        "ahead, N, and the moment about the vertical axis, N·m, as tau_x and tau_n, or compute them from thrusts and "
        "angles, and give them to usvlearn.read as arrays"
    )


def _doubted(decision: Decision, why: str) -> Decision:
    """The sense of a heading that neither a course over ground nor the thrusters confirm."""
    if decision[:2] not in (("heading", "unit"), ("yaw_rate", "unit")):
        return decision
    opposite = decision.value.removeprefix("enu_") if decision.value.startswith("enu_") else f"enu_{decision.value}"
    others = tuple(dict.fromkeys((*decision.alternatives, opposite)))
    return decision._replace(certainty=UNSURE, reason=f"{decision.reason}; {why}", alternatives=others)


def _unnamed(pool: Sequence[Candidate]) -> tuple[list[Candidate], list[Candidate]]:
    """Series whose names tell nothing, and those of them and of the named speeds that may be a speed."""
    nameless = [each for each in pool if all(fit(role, each.label) < 1 for role in WORDS if role != "command")]
    named = [each for each in pool if fit("surge", each.label) >= 1]
    return nameless, named or [each for each in nameless if each.size < 100]


def _names_state(candidate: Candidate) -> bool:
    """Whether a name tells a measured state, which no command is."""
    roles = "heading", "course", "surge", "yaw_rate", "latitude", "longitude"
    return any(fit(role, candidate.label) >= 2 for role in roles)


def _turn(heading: Heading, yaw: YawRate | None) -> Pair:
    """The yaw rate, rad/s, clockwise."""
    if yaw is not None:
        return yaw.candidate.scaled(*UNITS[yaw.unit])
    return heading_rate(heading.radians)


def _on_change(candidate: Candidate) -> tuple[bool, str]:
    """Whether values are posted only when they differ from the one before, and how certain that is."""
    ratio = candidate.slow / candidate.interval if candidate.interval > 0 else 1.0
    if candidate.repeats >= NO_REPEATS or not ratio > UNEVEN:
        return False, PROBABLE
    return True, PROBABLE if ratio > ON_CHANGE else UNSURE


def report_commands(commands: Sequence[Commands], channels: dict, series: dict) -> list[Decision]:
    """The best commands as the channels: series, zero, span and sign of each side, and how it is posted."""
    if not commands:
        return []
    best, decisions = commands[0], []
    for channel, one in zip(COMMANDS, (best.left, best.right), strict=True):
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
        how = "sent on change, then held" if held else f"sent every {best.left.parts[0].interval:.2g} s"
        rate = f"{one.parts[0].repeats:.0%} repeat the one before; every {one.parts[0].interval:.2g} s"
        span, span_reason = f"{one.sign * level.span:g}", f"{level.kind}: {level.span_reason}"
        decisions += [
            Decision(channel, "series", label, best.certainty, best.reason, others),
            Decision(channel, "zero", f"{level.zero:g}", level.zero_certainty, level.zero_reason, level.zeros),
            Decision(channel, "span", span, level.span_certainty, span_reason, level.alternatives),
            Decision(channel, "sign", ahead, best.sign_certainty, best.sign_reason, best.alternatives),
            Decision(channel, "messages", how, _on_change(one.parts[0])[1], rate),
        ]
    return decisions


def _listed(one: Side) -> str:
    return " + ".join(each.label for each in one.parts)


def _command_source(one: Side) -> dict[str, Any]:
    held = any(_on_change(each)[0] for each in one.parts)
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
