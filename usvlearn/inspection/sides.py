"""Which series are the commands of the left and the right side, and which of them are reversed.

Two relations decide: a boat speeds up with the sum of its sides, and turns to starboard (yaw rate positive) with left −
right. A reversed side changes the sign of its command. Whether the two sides have the same sign shows in which of their
sum and difference the speed follows; the speed then tells the signs. The turn must agree: if it does not, the sides are
swapped, or the heading counts counter-clockwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from usvlearn.inspection.candidate import Candidate
from usvlearn.inspection.decision import CERTAIN, PROBABLE, UNSURE
from usvlearn.inspection.levels import PWM, Level, find_level
from usvlearn.inspection.places import Pair
from usvlearn.inspection.vocabulary import MIDDLE, fit, names_side_alone, side, without_side, words
from usvlearn.logs.relations import NOTHING, Relation, side_sign, speed_on_thrust

SURE, HINT = 4.0, 2.0  # standard errors of a correlation, beyond which it is no chance, and from which it counts
LAGS = (0.0, 10.0)  # s, of the speed
STRONG = 0.35  # correlation that two unnamed series need to be taken as commands
MOST_UNNAMED = 14  # series among which unnamed commands are sought
MIXED = {"steer", "steering", "turn", "differential", "diff"}  # names of what a mixer adds to the throttle


class Signs(NamedTuple):
    """The senses of two sides, and how well both relations then hold."""

    left: int  # 1, or -1 if reversed
    right: int
    speed: Relation  # of the speed on the sum
    turn: Relation  # of the yaw rate on left − right
    margin: float  # of the sum of both certainties over that of the next best combination

    @property
    def score(self) -> float:
        return _clipped(self.speed.certainty) + _clipped(self.turn.certainty)


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
    turn: float = 0.0  # standard errors by which the yaw rate confirms the sides, or contradicts them
    middle: Candidate | None = None  # a thruster between both sides, which is in neither


def find_commands(pool: Sequence[Candidate], everything: Sequence[Candidate], speed: Pair | None, turn: Pair | None,
                  convention: str) -> list[Commands]:  # fmt: skip
    """Commands of both sides, the best first.

    Args:
        pool: series that are not yet taken.
        everything: all series, constant ones too.
        speed: m/s.
        turn: yaw rate, rad/s, clockwise.
        convention: name of the format.
    """
    still = [each for each in everything if not each.varies and names_command(each)]
    levels = {id(each): find_level(each, everything, convention, speed) for each in (*pool, *still)}
    named = [each for each in (*pool, *still) if fit("command", each.label) >= 1 and side(each.label)]
    found = [judge(left, right, levels, speed, turn) for left, right in _pairs(named)]
    found = [_without_middle(each, pool) for each in found]
    if not found:
        found = list(_groups(pool, levels, speed, turn))
    if not found:
        alone = [each for each in (*pool, *still) if names_side_alone(each.label)]
        found = [judge(left, right, levels, speed, turn) for left, right in _pairs(alone)]
    if not found:
        found = list(_with_rudder([*pool, *still], levels, turn))
    if not found:
        found = list(_unnamed(pool, levels, speed, turn))
    return sorted(found, key=lambda each: -each.score)


def names_command(candidate: Candidate) -> bool:
    """Whether a name tells a thruster of a side, or a rudder, even if it never changes."""
    sided = fit("command", candidate.label) >= 2 and side(candidate.label)
    return bool(sided) or names_side_alone(candidate.label) or fit("rudder", candidate.label) >= 1


def judge(left: Sequence[Candidate], right: Sequence[Candidate], levels: dict[int, Level], speed: Pair | None,
          turn: Pair | None) -> Commands:  # fmt: skip
    """Two named sides: their senses, and whether the names agree with the motion."""
    sides = _sides(left, right, levels)
    signs = fit_signs(_share(sides[0]), _share(sides[1]), speed, turn)
    sure, told, others = _told(signs)
    reversed_ = [name for name, sign in (("left", signs.left), ("right", signs.right)) if sign < 0]
    if reversed_ and sure != UNSURE:
        told = f"{' and '.join(reversed_)} reversed: {told}"
    name = float(np.mean([fit("command", each.label) for each in (*left, *right)]))
    turned = _clipped(signs.turn.certainty)
    which = CERTAIN if sure == CERTAIN else PROBABLE if turned >= HINT else UNSURE
    reason = "by name" + ("; the boat moves with them" if sure == CERTAIN else "")
    if which == UNSURE:
        reason += "; but it turns the other way" if turned < -HINT else "; too few turns confirm the sides"
    score = name + 0.08 * signs.score - 0.5 * (signs.left + signs.right < 2)
    one, other = sides[0]._replace(sign=signs.left), sides[1]._replace(sign=signs.right)
    return Commands(one, other, which, reason, sure, told, others, score, turned)


def _without_middle(commands: Commands, pool: Sequence[Candidate]) -> Commands:
    """The same, but unsure where a third thruster between the sides is left out."""
    stem = set(without_side(commands.left.parts[0].label))
    named = [(each, set(words(each.label))) for each in pool]
    middle = [each for each, found in named if MIDDLE & found and found - MIDDLE == stem]
    if not middle:
        return commands
    reason = f"{commands.reason}; {middle[0].label} is on neither side and is left out"
    return commands._replace(certainty=UNSURE, reason=reason, middle=middle[0])


def _sides(left: Sequence[Candidate], right: Sequence[Candidate], levels: dict[int, Level]) -> list[Side]:
    """Both sides, with the same full scale for all commands of one kind."""
    own = {id(each): levels[id(each)] for each in (*left, *right)}
    if middle := next((each for each in own.values() if each.kind != PWM and each.zero), None):
        own = {key: each if each.zero or each.zero_certainty == CERTAIN else middle for key, each in own.items()}
    common = {}
    for key, level in own.items():
        wide = max(
            (each for each in own.values() if (each.kind == PWM) == (level.kind == PWM)), key=lambda each: each.span
        )
        common[key] = wide._replace(
            zero=level.zero, zero_certainty=level.zero_certainty, zero_reason=level.zero_reason, zeros=level.zeros
        )
    return [Side(tuple(part), tuple(common[id(each)] for each in part), 1) for part in (left, right)]


def swapped(commands: Commands) -> Commands:
    """The sides as the boat turns, and not as they are named: for a heading whose sense is proved."""
    reason = "swapped against the names: the boat turns the other way, and its heading follows the course over ground"
    sign = f"by the speed; {commands.sign_reason.partition(': ')[2].partition(': ')[0]} as named"
    return commands._replace(
        left=commands.right, right=commands.left, certainty=UNSURE, reason=reason, sign_reason=sign,
        sign_certainty=PROBABLE, alternatives=(), turn=-commands.turn,
    )  # fmt: skip


def fit_signs(left: Pair, right: Pair, speed: Pair | None, turn: Pair | None) -> Signs:
    """The senses with which speed and yaw rate follow the commands best.

    >>> rng, time = np.random.default_rng(0), np.arange(0, 300, 0.25)
    >>> left, right = (np.repeat(rng.uniform(0, 1, 60), 20) for _ in range(2))
    >>> motion = (time, left + right), (time, 0.3 * (left - right))
    >>> fit_signs((time, -left), (time, right), *motion)[:2]
    (-1, 1)
    """
    found = []
    for sign in (1, -1):
        other = (right[0], sign * right[1])
        on_speed = speed_on_thrust(left, other, speed, LAGS) if speed else NOTHING
        on_turn = side_sign(left, other, turn) if turn else NOTHING
        moves, turns = _clipped(on_speed.certainty), _clipped(on_turn.certainty)
        way = -1 if moves <= -HINT else 1  # not by the turn: swapped names would look like reversed sides
        if way < 0:
            on_speed, on_turn = _negated(on_speed), _negated(on_turn)
        found.append((abs(moves) + abs(turns) + (sign > 0), Signs(way, way * sign, on_speed, on_turn, 0.0)))
    (less, _), (more, best) = sorted(found, key=lambda each: each[0])
    return best._replace(margin=more - less)


def _contradicts(signs: Signs) -> bool:
    return min(_clipped(signs.speed.certainty), _clipped(signs.turn.certainty)) <= -SURE


def _told(signs: Signs) -> tuple[str, str, tuple[str, ...]]:
    """How certain the senses are, why, and what else may be."""
    speed, turn = signs.speed, signs.turn
    told = _correlations(speed, turn)
    on_speed, on_turn = _clipped(speed.certainty), _clipped(turn.certainty)
    if _contradicts(signs):
        what = "the sides may be swapped, or the heading may count counter-clockwise" if on_turn < 0 else "check both"
        return (
            UNSURE,
            f"contradiction: {told}: {what}",
            ("left and right swapped", "both sides reversed", "heading enu"),
        )
    if on_speed >= SURE and on_turn >= SURE and signs.margin > 2:
        return CERTAIN, told, ()
    normal = signs.left == signs.right == 1
    if min(on_speed, on_turn) > -HINT and max(on_speed, on_turn) >= SURE and (normal or signs.margin > 3):
        return PROBABLE, f"{told} (too little evidence of one)", ()
    return UNSURE, f"{told}: too little evidence", ("a reversed side: span below 0",)


def _correlations(speed: Relation, turn: Relation) -> str:
    both = (("speed on their sum", speed), ("yaw rate on left − right", turn))
    parts = [f"{what} {each.correlation:+.2f}" for what, each in both if each.seconds]
    return "correlation of " + ", of ".join(parts) if parts else "neither speed nor yaw rate tells"


def _pairs(named: Sequence[Candidate]) -> Iterator[tuple[list[Candidate], list[Candidate]]]:
    """Left and right commands whose names differ in the side only; several of a side as a group."""
    groups: dict[tuple, dict[str, list[Candidate]]] = {}
    for each in named:
        stem = tuple(word for word in without_side(each.label) if not word.isdigit())
        groups.setdefault(stem, {}).setdefault(side(each.label), []).append(each)
    for sides in groups.values():
        if len(sides) == 2:
            yield sides["left"], sides["right"]
    # a bow and a stern thruster of each side: groups whose words differ in one other word
    stems = [stem for stem, sides in groups.items() if len(sides) == 2]
    for one, other in combinations(stems, 2):
        if len(one) == len(other) and sum(a != b for a, b in zip(one, other, strict=True)) == 1:
            if {"bow", "stern", "front", "rear", "aft", "fore", "bug", "heck", "inner", "outer"} & (
                set(one) ^ set(other)
            ):
                yield groups[one]["left"] + groups[other]["left"], groups[one]["right"] + groups[other]["right"]


def _groups(
    pool: Sequence[Candidate], levels: dict[int, Level], speed: Pair | None, turn: Pair | None
) -> Iterator[Commands]:
    """Numbered thrusters: those on which the yaw rate rises are on the left."""
    stems: dict[tuple, list[Candidate]] = {}
    for each in pool:
        spoken = words(each.label)
        if fit("command", each.label) >= 1 and not side(each.label) and any(word.isdigit() for word in spoken):
            stems.setdefault(tuple(word for word in spoken if not word.isdigit()), []).append(each)
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
        signs = fit_signs(_share(sides[0]), _share(sides[1]), speed, turn)
        clear = min(abs(each.certainty) for each in relations if each.seconds) >= SURE
        sure, told, others = _told(signs)
        backward = signs.left + signs.right < 2
        which = UNSURE if not clear or backward or sure == UNSURE else PROBABLE
        reason = f"the yaw rate rises with {', '.join(each.label for each in left)} and falls with the others"
        weak = "" if clear else "; weak evidence for some of them"
        yield Commands(
            sides[0]._replace(sign=signs.left), sides[1]._replace(sign=signs.right), which, reason + weak,
            UNSURE if backward else sure, told, others, fit("command", members[0].label) + 0.08 * signs.score,
        )  # fmt: skip


def _with_rudder(pool: Sequence[Candidate], levels: dict[int, Level], turn: Pair | None) -> Iterator[Commands]:
    """One thrust for both sides; a steering signal is added on the left and subtracted on the right.

    A rudder drives no side, so that it is only told.
    """
    thrusts = [each for each in pool if fit("command", each.label) >= 1 and fit("rudder", each.label) < 1]
    rudders = [each for each in pool if fit("rudder", each.label) >= 1]
    for thrust in thrusts:
        level, name = levels[id(thrust)], fit("command", thrust.label)
        both = Side((thrust,), (level,), 1)
        if not rudders:
            told = "one thrust and no rudder: both sides get the same command"
            yield Commands(both, both, UNSURE, told, UNSURE, "no side is logged", (), name - 2)
        for rudder in rudders:
            angle = find_rudder(rudder, levels[id(rudder)])
            relation = NOTHING
            if turn is not None:
                time, share = _share(Side((rudder,), (angle,), 1))
                relation = side_sign((time, share), (time, 0 * share), turn)
            known = abs(_clipped(relation.certainty)) >= SURE
            sign = -1 if known and relation.correlation < 0 else 1
            left, right = (Side((thrust, rudder), (level, angle), 1, (1.0, 1.0 * sign * way)) for way in (1, -1))
            told = f"the yaw rate follows {rudder.label}: correlation {relation.correlation:+.2f}"
            told = told if known else f"too little evidence of the sense of {rudder.label}"
            if MIXED & set(words(rudder.label)):
                reason = "steering is added to the throttle on the left, and subtracted on the right"
                sure = PROBABLE if known else UNSURE
                yield Commands(left, right, PROBABLE, reason, sure, told, (), name + 3)
            else:
                reason = f"one thrust for both sides; the rudder {rudder.label} drives none"
                mix = (
                    f"[{thrust.label}, {rudder.label}] with weight: [1, {sign}] and [1, {-sign}], if it mixes thrusters"
                )
                yield Commands(both, both, PROBABLE, reason, PROBABLE, told, (mix,), name + 3)


def find_rudder(candidate: Candidate, level: Level) -> Level:
    """Zero and span of a rudder: the greatest angle seen is full rudder."""
    if level.kind == "PWM in us":
        return level
    size = max(candidate.size, 1e-9)
    full = next((each for each in (1.0, 30.0, 35.0, 45.0, 90.0, 100.0) if 0.9 * each <= size <= each * 1.001), size)
    told = f"the greatest angle is {size:.3g}"
    return Level(0.0, float(f"{full:.3g}"), "rudder", PROBABLE, "by convention", PROBABLE, told, ())


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
            if (
                min(on_speed.correlation, on_turn.correlation) < STRONG
                or not min(on_speed.certainty, on_turn.certainty) > SURE
            ):
                continue
            told = _correlations(on_speed, on_turn)
            score = on_speed.correlation + on_turn.correlation
            yield Commands(sides[0], sides[1], UNSURE, f"by its numbers alone: {told}", UNSURE, told, (), score)


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
    held = []
    for stamps, value in parts:
        order = np.argsort(stamps, kind="stable")
        held.append(value[order][np.clip(np.searchsorted(stamps[order], time, side="right") - 1, 0, None)])
    return time, np.mean(held, axis=0)


def _negated(relation: Relation) -> Relation:
    return relation._replace(slope=-relation.slope, correlation=-relation.correlation)


def _clipped(certainty: float) -> float:
    return 0.0 if math.isnan(certainty) else max(-10.0, min(10.0, certainty))
