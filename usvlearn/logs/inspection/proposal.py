"""The channels of a boat's logs: the series, their units, and how certain each of that is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from usvlearn.logs.channels.channel import UNITS
from usvlearn.logs.channels.correlations import heading_rate
from usvlearn.logs.inspection.candidate import IS_SET, Candidate
from usvlearn.logs.inspection.command_sides import SWAPPED, Commands, doubted, find_commands, seconds_astern
from usvlearn.logs.inspection.commands import SIDES, tell_commands
from usvlearn.logs.inspection.config_writer import scalar
from usvlearn.logs.inspection.courses import (
    course_beside,
    find_course,
    find_velocities,
    named_velocities,
    reckoned,
    seconds_back,
    tell_course,
    tell_velocities,
)
from usvlearn.logs.inspection.decision import CERTAIN, PROBABLE, UNSURE, Decision, least
from usvlearn.logs.inspection.directions import (
    Heading,
    YawRate,
    find_headings,
    find_yaw_rate,
    orient,
    tell_heading,
    tell_yaw_rate,
    without_error,
)
from usvlearn.logs.inspection.position_channels import (
    Pair,
    Places,
    course_of,
    crossed,
    find_places,
    guess_places,
    in_degrees,
    moved_along,
    rate_of,
    tell_places,
)
from usvlearn.logs.inspection.sign_hypotheses import LIKELY
from usvlearn.logs.inspection.speeds import (
    along_hull,
    by_reaction,
    find_speeds,
    following,
    interchanged,
    norms,
    tell_speed,
    tell_without_sign,
    turned_ahead,
)
from usvlearn.logs.inspection.sway_channels import find_sway, tell_sway
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

DEGREES = ("latitude", "longitude")  # which rise as evenly as a clock on a straight line


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


def propose(everything: Sequence[Candidate], convention: str, exchanged: bool = False) -> Proposal:
    """Decide which of all series is which channel; `convention` is the name of the format.

    If `exchanged`, latitude and longitude, or velocities to the north and to the east, are interchanged, since only so
    the heading and the sides are what they are called.
    """
    found, decisions = of_one_vehicle(in_degrees(everything), convention)
    pool = [
        each for each in found if each.varies and not (each.is_clock and max(fit(x, each.label) for x in DEGREES) < 1)
    ]
    places = find_places(pool, convention)
    if not places and (guessed := guess_places(*_unnamed(pool))):
        places = [guessed]
    named = [each for each in pool if fit("surge", each.label) >= 1]
    crossing = exchanged  # whether latitude and longitude may be interchanged
    if places:
        other, doubtful = interchanged(places[0], named)
        first, crossing = (exchanged and crossed(places[0])) or other, exchanged or doubtful
        places = [first, *places[1:]]
    channels: dict[str, dict[str, Any]] = {}
    series: dict[str, Candidate] = {}
    oriented = next((each for each in places if each.oriented), None)
    course = course_of(oriented) if oriented else None
    velocity = named_velocities(pool, convention)
    velocity = (velocity[1], velocity[0]) if exchanged and velocity and not oriented else velocity
    sailed = None if oriented else reckoned(pool, named, velocity)
    headings = find_headings(pool, sailed[1] if sailed else course, convention)
    heading = headings[0] if headings else None
    yaw, turn, sense, axes, doubt = None, None, CERTAIN, CERTAIN, ""
    if places and heading and not oriented and (found_axes := orient(places[0], heading)):
        places, axes = [found_axes, *places[1:]], least(PROBABLE, heading.certainty)
        doubt = "which of them is north, is told by the heading, which follows the course then"
    if heading and oriented and course:
        measured = [each for each in named if not each.is_set]
        ahead = next((each.metres for each in find_speeds(measured, [oriented], convention)), rate_of(oriented))
        heading = without_error(heading, (oriented.north, oriented.east), course, ahead, convention)
    elif heading and sailed:
        heading = without_error(heading, *sailed, convention)
    if heading:
        alone = {side(each.label) for each in pool if names_side_alone(each.label)}
        turning = [each for each in pool if len(alone) < 2 or not names_side_alone(each.label)]  # L and R are sides
        yaw, rejected = find_yaw_rate(turning, heading)
        turn = _turn(heading, yaw)
        decisions += tell_heading(heading, headings, channels, series)
        rivals = [each.label for each in turning if fit("yaw_rate", each.label) >= 0.5]
        decisions += tell_yaw_rate(yaw, heading, rivals, channels, series)
        decisions += rejected
    taken = [each for each in (heading and heading.candidate, yaw and yaw.candidate) if each is not None]
    for each in places:
        taken += [each.first, each.second]
    left = [each for each in pool if not any(each is other for other in taken)]
    angles = heading.radians if heading else None
    speeds = find_speeds([*along_hull(left), *norms(left)], places, convention, angles)
    speeds = by_reaction(speeds, [each for each in left if fit("command", each.label) >= 1])
    velocities = find_velocities(left, places, angles, convention, velocity)
    sets = [each.candidate for each in speeds if each.candidate.is_set]
    if (places or velocities) and len(sets) == len(speeds):
        speeds = []
    if velocities and speeds and speeds[0].candidate.is_signed:
        velocities = None  # the speed is signed already
    if velocities:
        speeds = [velocities.size, *speeds]
    if oriented and heading and heading.certainty == CERTAIN:
        speeds = [turned_ahead(each, oriented, heading.radians) for each in speeds]
    speed = speeds[0].metres if speeds else rate_of(places[0]) if places else None
    beside = speeds[0] if speeds and not velocities else None
    track = places[0] if places and places[0].oriented else None
    sway = find_sway(left, beside, track, heading)
    over_ground = None if sway or velocities else find_course(left, speeds, track, heading)
    used = [*sets, *(each.candidate for each in (beside, sway) if each)]
    rest = [each for each in left if not (any(each is other for other in used) or _names_state(each))]
    still, unfit = found, ""
    if azimuths := [each.label for each in pool if names_azimuth(each.label)]:
        rest, still = ([each for each in group if _names_whole(each)] for group in (rest, found))
        unfit = "" if rest else _told_azimuths(azimuths)
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
    exchangeable = (crossed(places[0]) if course else velocity) is not None
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
    decisions = tell_commands(commands, channels, series) + decisions
    lost = seconds_astern(commands[0], beside.metres) if commands and beside else 0.0
    by_course = course_beside(left, beside, heading) if beside else None
    if by_course and heading and not track:
        lost = max(lost, seconds_back(by_course, heading))
    signed = next((each for each in speeds[1:] if each.candidate.is_signed and not each.contradicted), None)
    if lost and signed:
        speeds, lost = [signed, *(each for each in speeds if each is not signed)], 0.0
    if lost:
        over_ground = over_ground or by_course
        decisions += tell_without_sign(speeds[0], lost, over_ground, bool(track))
    if lost and over_ground:
        decisions += tell_course(over_ground, channels, series)
    elif lost and track:
        pass  # the surge comes from the position
    elif velocities:
        decisions += tell_velocities(velocities, speeds[1:], channels, series, doubt if contested or exchanged else "")
    elif speeds:
        decisions += tell_speed(speeds, channels, series)
    elif places:
        known = f"{', '.join(each.label for each in sets)} {IS_SET}" if sets else "no series is known to be the speed"
        why = f"{known}: the position tells it"
        decisions.append(Decision("surge", "series", "from the position", PROBABLE, why))
    if sway:
        decisions += tell_sway(sway, channels, series, least(sense, axes))
    elif over_ground and not lost and least(sense, axes) == CERTAIN:
        decisions += tell_course(over_ground, channels, series)
    if places:
        confirmed = bool(speeds and not lost and speeds[0].confirmed and speeds[0].certainty == CERTAIN)
        decisions += tell_places(places[0], channels, series, confirmed, axes, doubt)
    spoken = {each.spoken: each.named(spoken="").label for each in found if each.spoken}
    decisions = [each._replace(value=spoken.get(each.value, each.value)) for each in decisions]
    why = "it comes again and again, far beyond all others: it means unknown"
    unknown = {name: one.missing for name, one in series.items() if one.missing}
    decisions += [Decision(name, "missing", scalar(list(each)), PROBABLE, why) for name, each in unknown.items()]
    missing = [name for name in (*SIDES, "heading") if name not in channels]
    missing += [] if speeds or places else ["surge"]
    if missing == ["surge"]:
        others = [each for each in rest if not any(each is other for other in series.values())]
        unfit = following(others, [series[side] for side in SIDES if side in series])
    states = [role for role in ("heading", "surge") if role in missing]
    if still := [x for x in found if not x.varies and any(fit(role, x.label) >= 1 for role in states)]:
        told = ", ".join(f"{each.label!r} is always {each.value[0]:g}" for each in still[:3])
        unfit = f"{told}, as of a sensor that has stopped: give logs in which it changes"
    order = [*SIDES, "heading", "yaw_rate", "surge"]
    ordered = {name: channels[name] for name in (*order, *channels) if name in channels}
    return Proposal(ordered, series, decisions, speed, heading, yaw, missing, unfit)


def _is_contested(heading: Heading, commands: Sequence[Commands], places: Places | None, speed: Pair | None) -> bool:
    """Whether the sides, the name of the heading, or speed and heading contradict the names of north and east."""
    if commands and commands[0].reason == SWAPPED:
        return heading.unit.startswith("enu_") or (places is not None and not places.geographic)
    if places is None or places.geographic:
        return False
    if speed is not None and moved_along(places, speed, heading.radians).is_mirrored:
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


def _names_state(candidate: Candidate) -> bool:
    """Whether a name tells a measured state, which no command is."""
    roles = "heading", "course", "surge", "yaw_rate", "latitude", "longitude"
    return any(fit(role, candidate.label) >= 2 for role in roles)


def _turn(heading: Heading, yaw: YawRate | None) -> Pair:
    """The yaw rate, rad/s, clockwise."""
    if yaw is not None:
        return yaw.candidate.scaled(*UNITS[yaw.unit])
    return heading_rate(heading.radians)
