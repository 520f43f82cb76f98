"""Which series are the commands of the left and the right side.

By name, where the names tell it: `senses` decides whether the motion agrees, and which command is reversed. Numbered
thrusters are told apart by the turn, and unnamed series by speed and turn.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from usvlearn.logs.channels.bins import bin_edges, bin_means
from usvlearn.logs.channels.correlations import NOTHING, Relation, side_sign, speed_on_thrust, without_sign
from usvlearn.logs.inspection.candidate import Candidate, held_at
from usvlearn.logs.inspection.command_scaling import PWM, Level, find_level, sharing
from usvlearn.logs.inspection.decision import CERTAIN, PROBABLE, UNSURE, least
from usvlearn.logs.inspection.position_channels import Pair
from usvlearn.logs.inspection.sign_hypotheses import LIKELY, SURE, Decided, Senses, decide, pushes
from usvlearn.logs.inspection.vocabulary import (
    GEARS,
    MIDDLE,
    OTHER_UNITS,
    SPEED_SETS,
    fit,
    names_force,
    names_moment,
    names_side_alone,
    side,
    without_side,
    words,
)

CLEAR = 4.0  # standard errors of a correlation, beyond which it is no chance
STRONG = 0.35  # correlation that two unnamed series need to be taken as commands
MOST_UNNAMED = 14  # series among which unnamed commands are sought
UNSIGNED, ASTERN, SELDOM, POSITIONS = 0.02, 0.1, 0.01, 5  # of full scale, the greatest speed, the time; of a gear
TEXTS = "gear", "hemisphere N"  # units of a column of texts that name gears
MIXED = {"steer", "steering", "turn", "differential", "diff"}  # names of what a mixer adds to the throttle


class Side(NamedTuple):
    """The command of one side: one series, or several."""

    parts: tuple[Candidate, ...]
    levels: tuple[Level, ...]
    sign: int
    weights: tuple[float, ...] = ()


class Commands(NamedTuple):
    """What was found."""

    left: Side
    right: Side
    certainty: str  # of the series and their sides
    reason: str
    sign_certainty: str
    sign_reason: str
    alternatives: tuple[str, ...]
    score: float
    turning: float = 0.0  # cost by which the turn confirms the sides, or contradicts them if it is negative
    middle: Candidate | None = None  # a thruster between both sides, which is in neither


SWAPPED = "swapped against the names: only so the boat moves as it is steered, by a heading that is proved"


def find_commands(pool: Sequence[Candidate], everything: Sequence[Candidate], speed: Pair | None, turn: Pair | None,
                  convention: str, proved: bool = False) -> list[Commands]:  # fmt: skip
    """Commands of both sides, the best first, among series that are not yet taken.

    Given are all series, too, constant ones among them; the speed, m/s; the yaw rate, rad/s, clockwise; the name of the
    format; and whether the sense of the heading is proved.
    """
    still = [each for each in everything if not each.varies and names_command(each)]
    if known := [each for each in everything if each.by_parameters]:
        pool, still = known, []  # the parameters of the autopilot say which output drives what
    pool = [each for each in pool if each.unit not in OTHER_UNITS]
    levels = {id(each): find_level(each, everything, convention, speed) for each in (*pool, *still)}
    named = [each for each in (*pool, *still) if fit("command", each.label) >= 1 and side(each.label)]
    judged = [judge(left, right, levels, speed, turn, proved) for left, right in _pairs(named)]
    judged = [_without_middle(each, pool) for each in judged]
    judged = judged or list(_groups(pool, levels, speed, turn))
    if not judged:
        alone = [each for each in (*pool, *still) if names_side_alone(each.label)]
        judged = [judge(left, right, levels, speed, turn, proved) for left, right in _pairs(alone)]
    both = [*pool, *still]
    thrusts = [each for each in both if fit("command", each.label) >= 1 and fit("rudder", each.label) < 1]
    rudders = [each for each in both if fit("rudder", each.label) >= 1]
    judged = judged or list(_with_rudder(thrusts, rudders, levels, speed, turn))
    judged = judged or list(_unnamed(pool, levels, speed, turn))
    return [_with_gear(each, everything, speed) for each in sorted(judged, key=lambda each: -each.score)]


def _with_gear(commands: Commands, everything: Sequence[Candidate], speed: Pair | None) -> Commands:
    """The same, but unsure where commands without a sign drive a boat that has gears, or that goes astern."""
    thrusts = [(one.parts[0], one.levels[0]) for one in (commands.left, commands.right)]
    if any(each.extent[0] < level.zero - UNSIGNED * abs(level.span) for each, level in thrusts):
        return commands
    named = [each for each in everything if GEARS & set(words(each.label))]
    gears = [each.label for each in named if each.unit in TEXTS or 2 <= len(np.unique(each.value)) <= POSITIONS]
    astern = float((speed[1] < -ASTERN * np.quantile(np.abs(speed[1]), 0.95)).mean()) if speed and len(speed[1]) else 0
    why = f"the speed is astern in {astern:.0%} of the time: if they push astern, log them with a sign"
    why = f"{', '.join(gears)} may tell the sense: if so, make them negative where it says astern" if gears else why
    reason = f"{commands.sign_reason}; the commands are never negative, but {why}"
    return commands._replace(sign_certainty=UNSURE, sign_reason=reason) if gears or astern > SELDOM else commands


def names_command(candidate: Candidate) -> bool:
    """Whether a name tells a thruster of a side, or a rudder, even if it never changes."""
    sided = fit("command", candidate.label) >= 2 and side(candidate.label)
    return bool(sided) or names_side_alone(candidate.label) or fit("rudder", candidate.label) >= 1


def judge(left: Sequence[Candidate], right: Sequence[Candidate], levels: dict[int, Level], speed: Pair | None,
          turn: Pair | None, proved: bool) -> Commands:  # fmt: skip
    """Two named sides: what the names and the motion tell of them."""
    sides = _sides(left, right, levels)
    decided = decide(_share(sides[0]), _share(sides[1]), speed, turn, _leveled(sides), proved)
    name = float(np.mean([fit("command", each.label) for each in (*left, *right)]))
    which, reason = UNSURE, "by name; too little in the motion confirms the sides"
    if decided.taken.swapped:
        reason = SWAPPED
    elif decided.best.swapped:
        reason = "by name, but the motion fits swapped sides better, or a heading that counts the other way"
    elif decided.sides < 0:
        reason = "by name, but the motion fits swapped sides better: weak evidence"
    elif decided.sides >= LIKELY:
        which = CERTAIN if decided.sides >= SURE else PROBABLE
        reason = "by name; the boat moves with them" if which == CERTAIN else "by name; the motion agrees"
    return _commands(sides, decided, which, reason, name)


def doubted(commands: Commands) -> Commands:
    """The same, but unsure: the sides are judged by a heading that a position should prove, and does not."""
    if commands.certainty == UNSURE:
        return commands
    reason = f"{commands.reason}; but the heading, by which it turns, does not follow the course over ground clearly"
    return commands._replace(certainty=UNSURE, reason=reason)


def _commands(sides: Sequence[Side], decided: Decided, which: str, reason: str, name: float) -> Commands:
    """Both sides as they were decided."""
    taken = decided.taken
    signed = [one._replace(sign=sign) for one, sign in zip(sides, taken[1:], strict=True)]
    left, right = signed[::-1] if taken.swapped else signed
    backward = min(taken[1:]) < 0
    sure = _surely(decided.signs, *taken[1:])
    sentence, rival = decided.facts(), _reversed(decided.rival)
    if decided.signs < LIKELY:
        sentence = f"{sentence}; weak evidence" if backward else "too little evidence in speed and turn"
        sentence += f"; {'more' if decided.signs < 0 else 'almost as'} likely: {rival}"
    score = name + 0.08 * decided.support - 0.5 * backward
    others = (rival,) if sure == UNSURE else ()
    return Commands(left, right, which, reason, sure, sentence, others, score, decided.turning)


def _reversed(each: Senses) -> str:
    """A hypothesis about signs in words."""
    left, right = each[:0:-1] if each.swapped else each[1:]
    sentence = {(1, 1): "none reversed", (-1, -1): "both reversed", (-1, 1): "left reversed, right not"}
    swap = ", and left and right swapped" if each.swapped else ""
    return sentence.get((left, right), "right reversed, left not") + swap


def _leveled(sides: Sequence[Side]) -> bool:
    """Whether the zeros of all commands are known."""
    return all(level.zero_certainty != UNSURE for one in sides for level in one.levels)


def _without_middle(commands: Commands, pool: Sequence[Candidate]) -> Commands:
    """The same, but unsure where a third thruster between the sides is left out."""
    stem = set(without_side(commands.left.parts[0].label))
    named = [(each, set(words(each.label))) for each in pool]
    middle = [each for each, tokens in named if MIDDLE & tokens and tokens - MIDDLE == stem]
    if not middle:
        return commands
    reason = f"{commands.reason}; {middle[0].label} is on neither side and is left out"
    return commands._replace(certainty=UNSURE, reason=reason, middle=middle[0])


def _sides(left: Sequence[Candidate], right: Sequence[Candidate], levels: dict[int, Level]) -> list[Side]:
    """Both sides, with the same full scale for all commands of one kind."""
    scales = {id(each): levels[id(each)] for each in (*left, *right)}
    if middle := next((each for each in scales.values() if each.kind != PWM and each.zero), None):
        scales = {key: each if each.zero or each.zero_certainty == CERTAIN else middle for key, each in scales.items()}
    common = {}
    for key, level in scales.items():
        alike = [each for each in scales.values() if (each.kind == PWM) == (level.kind == PWM)]
        zero = {name: value for name, value in level._asdict().items() if name.startswith("zero")}
        common[key] = max(alike, key=lambda each: each.span)._replace(**zero)
    return [Side(tuple(part), tuple(common[id(each)] for each in part), 1) for part in (left, right)]


def _correlations(speed: Relation, turn: Relation) -> str:
    both = (("speed on their sum", speed), ("yaw rate on left − right", turn))
    parts = [f"{what} {each.correlation:+.2f}" for what, each in both if each.seconds]
    return "correlation of " + ", of ".join(parts) if parts else "neither speed nor yaw rate tells"


def _pairs(named: Sequence[Candidate]) -> Iterator[tuple[list[Candidate], list[Candidate]]]:
    """Left and right commands whose names differ in the side only; several of a side as a group."""
    groups: dict[tuple, dict[str, list[Candidate]]] = {}
    for each in named:
        stem = _stem(each, without_side(each.label))
        groups.setdefault(stem, {}).setdefault(side(each.label), []).append(each)
    for sides in groups.values():
        if len(sides) == 2:
            yield sides["left"], sides["right"]
    # a bow and a stern thruster of each side: groups whose words differ in one other word
    stems = [stem for stem, sides in groups.items() if len(sides) == 2]
    for one, other in combinations(stems, 2):
        if len(one) == len(other) and sum(a != b for a, b in zip(one, other, strict=True)) == 1:
            apart = set(one) ^ set(other)
            if {"bow", "stern", "front", "rear", "aft", "fore", "bug", "heck", "inner", "outer"} & apart:
                yield groups[one]["left"] + groups[other]["left"], groups[one]["right"] + groups[other]["right"]


def _stem(candidate: Candidate, spoken: Sequence[str]) -> tuple[str, ...]:
    """The words of a name without its numbers, but with its sender: two senders are two vehicles."""
    return (*(word for word in spoken if not word.isdigit()), candidate.name.partition("@")[2])


def _groups(
    pool: Sequence[Candidate], levels: dict[int, Level], speed: Pair | None, turn: Pair | None
) -> Iterator[Commands]:
    """Numbered thrusters: those on which the yaw rate rises are on the left."""
    stems: dict[tuple, list[Candidate]] = {}
    for each in pool:
        spoken = words(each.label)
        if fit("command", each.label) >= 1 and not side(each.label) and any(word.isdigit() for word in spoken):
            stems.setdefault(_stem(each, spoken), []).append(each)
    for members in stems.values():
        if len(members) < 2 or turn is None:
            continue
        whole = [_share(Side((each,), (levels[id(each)],), 1)) for each in members]
        base = _mean_of(whole)
        relations = [side_sign(each, base, turn) for each in whole]
        if len(members) == 2 and all(each.seconds for each in relations):
            order = sorted(range(2), key=lambda k: -relations[k].correlation)
            left, right = [members[order[0]]], [members[order[1]]]
        else:
            left = [each for each, one in zip(members, relations, strict=True) if one.correlation > 0]
            right = [each for each, one in zip(members, relations, strict=True) if one.correlation < 0]
        if not left or not right:
            continue
        sides = _sides(left, right, levels)
        decided = decide(_share(sides[0]), _share(sides[1]), speed, turn, _leveled(sides), proved=True, named=False)
        alike = all(np.array_equal(each.value, part[0].value) for part in (left, right) for each in part)
        if alike and (throttle := decided.throttle) is not None:
            yield from _by_motion([left[0], right[0]], throttle, levels, speed, turn)
            continue
        clear = min(abs(each.certainty) for each in relations if each.seconds) >= CLEAR
        steady = clear and decided.sides >= LIKELY and min(decided.taken[1:]) > 0
        one = right if decided.taken.swapped else left
        reason = f"the turn fits {', '.join(each.label for each in one)} on the left, and the others on the right"
        weak = "" if clear else "; weak evidence for some of them"
        name = fit("command", members[0].label)
        yield _commands(sides, decided, PROBABLE if steady else UNSURE, reason + weak, name)._replace(turning=0.0)


def _by_motion(both: Sequence[Candidate], throttle: int, levels: dict[int, Level], speed: Pair | None,
               turn: Pair | None) -> Iterator[Commands]:  # fmt: skip
    """A throttle and a rudder whose names do not tell them: one drives the speed alone, and the other one the turn."""
    thrust, rudder = both[throttle], both[1 - throttle]
    for each in _with_rudder([thrust], [rudder], levels, speed, turn):
        why = f"{thrust.label} drives the speed alone, and {rudder.label} the turn: a throttle and a rudder"
        yield each._replace(certainty=UNSURE, reason=why)


def _with_rudder(thrusts: Sequence[Candidate], rudders: Sequence[Candidate], levels: dict[int, Level],
                 speed: Pair | None, turn: Pair | None) -> Iterator[Commands]:  # fmt: skip
    """One thrust for both sides; a steering signal is added on the left and subtracted on the right.

    A rudder drives no side, so that it is only told.
    """
    for thrust in thrusts:
        level, name = levels[id(thrust)], fit("command", thrust.label)
        one = Side((thrust,), (level,), 1)
        ahead, cost, pushed = pushes(_share(one), speed, _leveled([one]))
        push = _surely(cost, ahead)
        name += 0.1 * min(max(cost, 0.0), 20.0)  # of several thrusts, the speed tells the one that drives the boat
        other = "reversed" if ahead > 0 else "positive ahead"
        against = (other,) if push == UNSURE else ()
        both = one._replace(sign=ahead)
        if not rudders:
            sentence = "one thrust and no rudder: both sides get the same command"
            if SPEED_SETS & set(words(thrust.label)):
                sentence += "; it names a speed: log what drives the thrusters"
            yield Commands(both, both, UNSURE, sentence, UNSURE, f"no side is logged; {pushed}", against, name - 2)
        for rudder in rudders:
            if names_force(thrust.label) != names_moment(rudder.label):
                continue
            level, angle = levels[id(thrust)], find_rudder(rudder, levels[id(rudder)])
            if names_moment(rudder.label):
                level, angle = sharing(thrust, rudder, (level, angle))
            relation = NOTHING
            if turn is not None:
                time, share = _share(Side((rudder,), (angle,), 1))
                relation = side_sign((time, share), (time, 0 * share), turn)
            known = abs(relation.certainty) >= CLEAR
            sign = -1 if known and relation.correlation < 0 else 1
            weights = [(float(ahead), float(sign * way)) for way in (1, -1)]
            mixed = MIXED & set(words(rudder.label)) and not rudder.by_parameters  # an output, not what is mixed
            if mixed or names_moment(rudder.label):
                left, right = (Side((thrust, rudder), (level, angle), 1, each) for each in weights)
                reason = "steering is added to the throttle on the left, and subtracted on the right"
                if names_moment(rudder.label):
                    reason = "the force ahead is shared by both sides, and the moment turns the boat"
                sentence = f"the yaw rate follows {rudder.label}: correlation {relation.correlation:+.2f}"
                sentence = sentence if known else f"too little evidence of the sense of {rudder.label}"
                sure = least(push, PROBABLE if known else UNSURE)
                yield Commands(left, right, PROBABLE, reason, sure, f"{pushed}; {sentence}", against, name + 3)
            else:
                reason = f"one thrust for both sides; the rudder {rudder.label} drives none"
                mix = " and ".join(f"[{first:g}, {second:g}]" for first, second in weights)
                mix = f"[{thrust.label}, {rudder.label}] with weight: {mix}, if it mixes thrusters"
                yield Commands(both, both, PROBABLE, reason, push, pushed, (mix, *against), name + 3)


def _surely(cost: float, *signs: int) -> str:
    """How certain signs are: a reversed command is never, so that it is listed."""
    return UNSURE if min(signs) < 0 or cost < LIKELY else CERTAIN if cost >= SURE else PROBABLE


def find_rudder(candidate: Candidate, level: Level) -> Level:
    """Zero and span of a rudder: the greatest angle seen is full rudder."""
    if level.kind == "PWM in us":
        return level
    size = max(candidate.size, 1e-9)
    full = next((each for each in (1.0, 30.0, 35.0, 45.0, 90.0, 100.0) if 0.9 * each <= size <= each * 1.001), size)
    sentence = f"the greatest angle is {size:.3g}"
    return Level(0.0, float(f"{full:.3g}"), "rudder", PROBABLE, "by convention", PROBABLE, sentence, ())


def _unnamed(
    pool: Sequence[Candidate], levels: dict[int, Level], speed: Pair | None, turn: Pair | None
) -> Iterator[Commands]:
    """Two series without telling names that drive speed and yaw rate as the commands of two sides do."""
    if speed is None or turn is None:
        return
    able = [each for each in pool if fit("command", each.label) > -2 and len(each.value) > 100][:MOST_UNNAMED]
    for one, other in combinations(able, 2):
        if levels[id(one)].kind != levels[id(other)].kind:
            continue
        for left, right in ((one, other), (other, one)):
            sides = _sides([left], [right], levels)
            one_share, other_share = (_share(each) for each in sides)
            on_speed, on_turn = speed_on_thrust(one_share, other_share, speed), side_sign(one_share, other_share, turn)
            sign = -1 if on_speed.correlation < 0 else 1
            clear = min(sign * on_speed.certainty, sign * on_turn.certainty) > CLEAR
            if not clear or min(sign * on_speed.correlation, sign * on_turn.correlation) < STRONG:
                continue
            throttle = decide(one_share, other_share, speed, turn, _leveled(sides), True, named=False).throttle
            if throttle is not None:
                yield from _by_motion([left, right], throttle, levels, speed, turn)
                continue
            sentence = _correlations(on_speed, on_turn)
            score = abs(on_speed.correlation) + abs(on_turn.correlation)
            sides = [each._replace(sign=sign) for each in sides]
            yield Commands(sides[0], sides[1], UNSURE, f"by its numbers alone: {sentence}", UNSURE, sentence, (), score)


def _share(one: Side) -> Pair:
    """The command of a side as a share of full scale, both as far as they are known."""
    parts = []
    for candidate, level in zip(one.parts, one.levels, strict=True):
        time, value = candidate.evidence
        parts.append((time, (value - level.zero) / level.span))
    return _mean_of(parts)


def _mean_of(parts: Sequence[Pair]) -> Pair:
    """The mean of several commands at the stamps of the first; each is held until its next value."""
    if len(parts) == 1:
        return parts[0]
    time = parts[0][0]
    return time, np.mean([held_at(each, time) for each in parts], axis=0)


def seconds_astern(commands: Commands, speed: Pair) -> float:
    """How long a speed, m/s, lacks its sign while both commands push astern, s."""
    sides = [_share(one) for one in (commands.left, commands.right)]
    edges = bin_edges(1.0, speed, *sides)
    left, right = (one.sign * bin_means(each, edges, held=True) for one, each in zip(commands[:2], sides, strict=True))
    return float(without_sign(left, right, bin_means(speed, edges)).sum())
