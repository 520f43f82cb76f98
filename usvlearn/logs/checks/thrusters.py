"""Checks commands against the motion: sides, and whether anything can be learned from them.

The signs of turn and speed with each command tell the mistake: see `docs/theory/model.md#two-channels`. Over half an
hour of simulated boats without mistakes the certainties are 10 (turn) and 3.4 (speed), or more.

A thruster that dies can turn the sign of one relation, since the autopilot then steers against the other thruster. So
neither half of the log may say anything else, and one has to say the same. A speed controller opens the throttle where
the boat is slow, so that the speed falls as the commands rise. So what the boat does while it moves ahead counts more.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from usvlearn.logs.channels.channel import COMMANDS, SURGE
from usvlearn.logs.channels.correlations import Relation
from usvlearn.logs.checks.evidence import Evidence, angular, mirrored
from usvlearn.logs.checks.finding import NOTE, Finding, override, see
from usvlearn.logs.checks.response import STEADY, implausible_lag

TURN, MOVE, HALF = 3.0, 2.5, 2.0  # standard errors, of the turn, the speed, and in half of a log
CLEAR_TURN, CLEAR_MOVE, STRONG, SURELY = 0.3, 0.25, 0.6, 0.8  # partial correlations
LEVELS = 3  # values of a command, below which it is on or off
SHOWN = 3  # names of logs
GONE = 0.2  # partial correlation of a turn with a thruster that has no effect
USED = 0.01  # of full scale: a smaller range is no use of a thruster
SHARED = ("name", "field", "unit", "zero", "span", "weight")  # options that belong to a thruster

PUSHED, MOSTLY, AHEAD, ENOUGH = 0.05, 0.9, 0.3, 60  # of full scale; of the time; of the greatest speed; bins

BOTH = ("both", "both, and swapped")

Sides = tuple[Relation, Relation]


def sides(e: Evidence) -> Iterator[Finding]:
    """Reversed and swapped sides, by the table above."""
    if implausible_lag(e) is not None:
        return
    turns, moves = e.sides()
    wrong, way = _mistake(turns, moves), _way(e)
    if way < 0 and wrong not in COMMANDS:
        yield _backward(e, turns)
        return
    if wrong is None or (way > 0 and wrong in BOTH):
        return
    half = len(e.speed) // 2
    parts = [_mistake(*e.sides(part), half=True) for part in (slice(half), slice(half, None))]
    if any(part not in (wrong, "unknown", None) for part in parts) or parts == [None, None]:
        return
    text = "turn {:+.2f} left, {:+.2f} right; speed {:+.2f} left, {:+.2f} right (partial correlations)".format(
        *(each.correlation for each in (*turns, *moves))
    )
    about, expected = ", ".join(COMMANDS), "turn + left, − right; speed + on both"
    turned = [name for name in COMMANDS if wrong in (name, "unknown", *BOTH)]
    reverse = _changed(e, COMMANDS, swap=True, reverse=True) if wrong == BOTH[1] else _changed(e, turned, reverse=True)
    if wrong in ("swapped", "unknown"):
        if e.sense == -1:  # the heading is wrong: see `scales.heading_sense`
            return
        fixes = [_changed(e, COMMANDS, swap=True)]
        if e.sense is None:
            fixes.append(override("heading", {"unit": mirrored(angular(e, "heading"))}))
        kind = "sides or heading" if e.sense is None or turned else "sides swapped"
        yield Finding(e.boat, about, kind, text, expected, " or ".join([*fixes, *([reverse] if reverse else [])]))
        return
    yield Finding(e.boat, ", ".join(turned), "side reversed", text, expected, reverse)


def lost(e: Evidence) -> Iterator[Finding]:
    """A command that turns the boat in one half of the time, and not in the other."""
    half = len(e.speed) // 2
    parts = [e.sides(part)[0] for part in (slice(half), slice(half, None))]
    signs = [[_sign(each, TURN, CLEAR_TURN) for each in part] for part in parts]
    for side, name in enumerate(COMMANDS):
        other = [sign[1 - side] == 2 * side - 1 for sign in signs]
        gone = [abs(part[side].correlation) < GONE and holds for part, holds in zip(parts, other, strict=True)]
        if any(gone) and [1, -1] in signs:
            text = "a turn that follows it by {:+.2f} in the first half of the time, and by {:+.2f} in the second one"
            expected = "one partial correlation: leave out the time in which the thruster had stopped"
            observed = text.format(*(part[side].correlation for part in parts))
            yield Finding(e.boat, name, "thruster lost", observed, expected, severity=NOTE)


def sides_of_runs(e: Evidence) -> Iterator[Finding]:
    """Logs in which the boat turns by the commands of the sides in another way than in others."""
    by_signs: dict[tuple[int, ...], list[str]] = {}
    for log in e.alone:
        turns = log.sides()[0]
        signs = tuple(_sign(each, TURN, CLEAR_TURN) for each in turns)
        surely = min(abs(each.correlation) for each in turns) > SURELY  # a dead thruster can turn one sign
        if all(signs) and (sum(signs) == 0 or surely):
            by_signs.setdefault(signs, []).append(log.recordings[0].run)
    usual = max(by_signs, key=lambda signs: (len(by_signs[signs]), signs == (1, -1)), default=())
    for signs, odd in by_signs.items():
        wrong = [name for name, one, other in zip(COMMANDS, signs, usual, strict=True) if one != other]
        if wrong:
            names = ", ".join(odd[:SHOWN]) + ", …" * (len(odd) > SHOWN)
            text = f"a turn against the commands, unlike in other logs, in {names}"
            how = "reverse it there" if len(wrong) == 1 else "swap both there, or change the sense of the heading"
            yield Finding(e.boat, ", ".join(wrong), "sides of runs", text, f"one way in all logs: {how}")


def _way(e: Evidence) -> int:
    """1 if the boat moves ahead with commands above zero, -1 if below zero, 0 if that is not clear."""
    if not len(e.values[SURGE]) or min(e.values[SURGE]) < -AHEAD * e.fastest:
        return 0  # it backs up, too
    pushed = e.thrust[(e.speed > AHEAD * e.fastest) & np.isfinite(e.thrust)]
    if len(pushed) < ENOUGH:
        return 0
    above, below = ((way * pushed > PUSHED).mean() >= MOSTLY for way in (1, -1))
    return int(above) - int(below)


def _backward(e: Evidence, turns: Sides) -> Finding:
    """Commands that are below zero while the boat moves ahead; the turn tells whether the sides are swapped, too."""
    text = f"commands of {float(np.nanmean(e.thrust)):+.2f} on average while the boat moves ahead"
    known = [_sign(each, TURN, CLEAR_TURN) for each in turns]
    both, swapped = (_changed(e, COMMANDS, swap, reverse=True) for swap in (False, True))
    fix = both if known == [-1, 1] else swapped if known == [1, -1] and e.sense == 1 else f"{both} or {swapped}"
    return Finding(e.boat, ", ".join(COMMANDS), "side reversed", text, "some above zero: zero or span is wrong", fix)


def _changed(e: Evidence, names: Sequence[str], swap: bool = False, reverse: bool = False) -> str:
    """The overrides that swap commands, reverse them, or both."""
    changes = []
    for name, other in zip(names, names[::-1] if swap else names, strict=True):
        current, given = e.settings(name), e.settings(other)
        options = {key: given.get(key) for key in SHARED if current.get(key) != given.get(key)}
        if reverse:
            span = given["span"]
            options["span"] = -span if isinstance(span, int | float) else [-each for each in span]
        changes.append(override(name, options))
    return " ".join(changes)


def _mistake(turns: Sides, moves: Sides, half: bool = False) -> str | None:
    """Which of the mistakes of the table the relations show surely; in half of a log, less sureness will do."""
    turn = [_sign(each, HALF if half else TURN, CLEAR_TURN) for each in turns]
    move = [_sign(each, HALF if half else MOVE, CLEAR_MOVE) for each in moves]
    strong = all(abs(each.correlation) > STRONG for each in turns)  # then the speed need not say the same
    for side, signs in enumerate(([-1, -1], [1, 1])):
        if turn == signs and move[side] != 1 and move[1 - side] != -1 and (move[side] == -1 or strong):
            return COMMANDS[side]
    if turn == [1, -1] and max(move) <= 0 and min(move) < 0:
        return BOTH[1]
    if turn == [-1, 1]:
        if max(move) <= 0 and min(move) < 0:
            return BOTH[0]
        if min(move) >= 0 and max(move) > 0:
            return "swapped"
        if strong and move == [0, 0]:
            return "unknown"
    return None


def _sign(relation: Relation, sure: float, clear: float) -> int:
    """1 or -1 where the sign of a relation is sure, else 0."""
    known = abs(relation.certainty) > sure and abs(relation.correlation) > clear
    return int(np.sign(relation.correlation)) if known else 0


def excitation(e: Evidence) -> Iterator[Finding]:
    """Commands and speeds from which little can be learned."""
    ranges = {name: float(np.ptp(e.values[name])) for name in COMMANDS if len(e.values.get(name, ()))}
    unused = [name for name, span in ranges.items() if span < USED]
    if len(unused) == len(COMMANDS):
        levels = ", ".join(f"{e.values[name][0]:.3g}" for name in unused)
        yield Finding(e.boat, ", ".join(unused), "excitation", f"commands that never change ({levels})",
                      see("thrusters that are used", *unused))  # fmt: skip
        return
    for name in unused:
        yield Finding(
            e.boat, name, "excitation", f"{e.values[name][0]:.3g} all the time", see("a thruster that is used", name)
        )
    left, right = e.commands
    both = np.isfinite(left) & np.isfinite(right)
    if not unused and both.any() and float(np.max(np.abs(left - right)[both])) < USED:
        yield Finding(e.boat, ", ".join(COMMANDS), "excitation", "equal commands on both sides",
                      "a difference at times: the sides cannot be told apart", severity=NOTE)  # fmt: skip
    if all(len(np.unique(e.values[name].round(2))) < LEVELS for name in ranges):
        yield Finding(e.boat, ", ".join(COMMANDS), "excitation", "commands that are on or off alone",
                      "several levels: the shape of the thrust cannot be learned", severity=NOTE)  # fmt: skip
    speed = e.values[SURGE]
    mean = abs(float(speed.mean())) if len(speed) else 0.0
    if mean > 0 and 0 < float(speed.std()) < STEADY * mean:
        yield Finding(e.boat, SURGE, "excitation", f"{mean:.2g} m/s within {speed.std() / mean:.1%}",
                      "a speed that changes: drag and mass cannot be learned", severity=NOTE)  # fmt: skip
