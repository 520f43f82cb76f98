"""Commands against the motion: sides, delay, and whether anything can be learned from them.

A stronger left thruster turns the bow to starboard, and both push ahead. With the signs of the turn (yaw rate) and of
the speed against the command of each side, at an equal command of the other one:

    mistake                           turn, left    turn, right    speed, left    speed, right
    none                                  +             −              +              +
    left reversed                         −             −              −              +
    right reversed                        +             +              +              −
    both reversed                         −             +              −              −
    sides swapped, or heading             −             +              +              +
    counter-clockwise

Thresholds, and why:

- A sign counts beyond 4 standard errors and a partial correlation of 0.3: over simulated boats without mistakes these
  are 8 and 0.5 or more for the turn. A thruster that dies can turn the sign of one relation (the autopilot then steers
  against the other thruster). So a reversed side needs both, the turn and the speed, in each half of the log.
- Delay and inertia together stay below 20 s for boats of some tons. A delay is called implausible beyond 25 s, or
  before the command by more than 5 s, if the correlation there is 0.6 or more and exceeds that at plausible lags by
  0.2.
- A speed that is correlated with the commands by less than 0.2 over five minutes at any lag does not follow them.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from usvlearn.logs.channel import COMMANDS, SURGE
from usvlearn.logs.checks.evidence import Evidence, spread
from usvlearn.logs.checks.finding import NOTE, Finding, override
from usvlearn.logs.relations import Relation, angle_offset

SURE, CLEAR = 4.0, 0.3  # standard errors; partial correlation
LATE, EARLY = 25.0, -5.0  # s, lags of the speed
FOUND, BETTER = 0.6, 0.2  # correlation at such a lag, and by how much it exceeds that at plausible ones
FOLLOWS, LONG = 0.2, 300.0  # correlation; s of evidence
LEVELS = 3  # values of a command, below which it is on or off
USED = 0.01  # of full scale: a smaller range is no use of a thruster
STEADY = 0.03  # standard deviation of a speed over its mean
SHARED = ("name", "field", "unit", "zero", "span", "weight")  # options that belong to a thruster

Sides = tuple[Relation, Relation]


def sides(e: Evidence) -> Iterator[Finding]:
    """Reversed and swapped sides, by the table above."""
    if implausible_lag(e) is not None:
        return
    turns, moves = e.sides()
    wrong = _mistake(turns, moves)
    if wrong is None:
        return
    half = len(e.speed) // 2
    parts = [_mistake(*e.sides(part), sure=2.0) for part in (slice(half), slice(half, None))]
    if any(part not in (wrong, None) for part in parts) or parts == [None, None]:
        return
    text = "turn {:+.2f} left, {:+.2f} right; speed {:+.2f} left, {:+.2f} right (partial correlations)".format(
        *(each.correlation for each in (*turns, *moves))
    )
    about, expected = ", ".join(COMMANDS), "turn + left, − right; speed + on both"
    if wrong == "swapped":
        swap = " ".join(override(name, each) for name, each in _swapped(e).items())
        unit = e.settings("heading")["unit"]
        mirrored = override("heading", {"unit": _counter(unit)})
        sense = _sense(e)
        fixes = {1.0: swap, -1.0: mirrored}.get(sense, f"{swap} or {mirrored}")
        kind = {1.0: "sides swapped", -1.0: "heading sense"}.get(sense, "sides or heading")
        yield Finding(e.boat, about, kind, text, expected, fixes)
        return
    reversed_ = [name for name in COMMANDS if wrong in (name, "both")]
    fix = " ".join(override(name, {"span": _negative(e.settings(name)["span"])}) for name in reversed_)
    yield Finding(e.boat, ", ".join(reversed_), "side reversed", text, expected, fix)


def _mistake(turns: Sides, moves: Sides, sure: float = SURE) -> str | None:
    """Which of the mistakes of the table the relations show surely."""
    turn = [_sign(each, sure) for each in turns]
    move = [_sign(each, sure) for each in moves]
    if turn == [-1, -1] and move[0] == -1 and move[1] >= 0:
        return "command_left"
    if turn == [1, 1] and move[1] == -1 and move[0] >= 0:
        return "command_right"
    if turn == [-1, 1]:
        if move == [-1, -1]:
            return "both"
        if min(move) >= 0 and max(move) > 0:
            return "swapped"
    return None


def _sign(relation: Relation, sure: float) -> int:
    """1 or -1 where the sign of a relation is sure, else 0."""
    clear = abs(relation.certainty) > sure and abs(relation.correlation) > CLEAR
    return int(np.sign(relation.correlation)) if clear else 0


def _sense(e: Evidence) -> float | None:
    """1 if the heading turns with the course over ground, -1 if against it, None where that is not known."""
    if not {"north", "east"} <= set(e.series):
        return None
    (time, north), (others, east) = e.series["north"], e.series["east"]
    at = np.arange(time[0], time[-1], 1.0) if len(time) else np.empty(0)
    rate_north, rate_east = (np.gradient(np.interp(at, *each)) if len(at) > 2 else at * np.nan
                             for each in ((time, north), (others, east)))  # fmt: skip
    moving = np.hypot(rate_north, rate_east) > 0.3 * e.surge_max
    course = at[moving], np.arctan2(rate_east, rate_north)[moving]
    found = angle_offset(course, e.series["heading"])
    return found.sign if found.seconds > 30 and found.concentration > 0.8 else None


def _swapped(e: Evidence) -> dict[str, dict]:
    """The options of each command that become those of the other one."""
    left, right = (e.settings(name) for name in COMMANDS)
    differ = [key for key in SHARED if left.get(key) != right.get(key)]
    return {COMMANDS[0]: {key: right.get(key) for key in differ}, COMMANDS[1]: {key: left.get(key) for key in differ}}


def _counter(unit: str) -> str:
    own = "rad" if unit == "1" else unit
    return own.removeprefix("enu_") if own.startswith("enu_") else f"enu_{own}"


def _negative(span):
    return -span if isinstance(span, int | float) else [-each for each in span]


def implausible_lag(e: Evidence) -> float | None:
    """The lag of the speed if no boat can have it, s."""
    found, near = e.searched, e.thrust_on_speed
    if not found.seconds or EARLY <= found.lag <= LATE or found.correlation < FOUND:
        return None
    return found.lag if found.correlation > max(near.correlation, 0) + BETTER else None


def delay(e: Evidence) -> Iterator[Finding]:
    """A speed that follows the commands too late, before them, or not at all."""
    pair = f"commands, {SURGE}"
    lag = implausible_lag(e)
    if lag is not None:
        side = "behind" if lag > 0 else "before"
        text = f"speeds {abs(lag):.0f} s {side} the commands (r = {e.searched.correlation:.2f})"
        given = float(e.logs(COMMANDS[0])[0].delay)
        right = max(0.0, given + lag)
        fix = " ".join(override(name, {"delay": float(round(right))}) for name in COMMANDS)
        yield Finding(
            e.boat, pair, "delay", text, f"{EARLY:g} to {LATE:g} s behind them", fix if right != given else ""
        )
        return
    found = e.searched
    if found.seconds >= LONG and abs(found.correlation) < FOLLOWS and _moves(e):
        text = f"a speed without relation to the commands (r = {found.correlation:.2f})"
        fix = " or ".join(override(name, {"name": "NAME"}) for name in (SURGE, COMMANDS[0]))
        yield Finding(e.boat, pair, "thrust", text, f"more than {FOLLOWS:g}", fix)


def _moves(e: Evidence) -> bool:
    """Whether thrust and speed change enough to be compared."""
    return spread(sum(e.commands) / 2) > 0.03 and spread(e.speed) > STEADY * e.surge_max


def excitation(e: Evidence) -> Iterator[Finding]:
    """Commands and speeds from which little can be learned."""
    ranges = {name: float(np.ptp(e.values[name])) for name in COMMANDS if len(e.values.get(name, ()))}
    unused = [name for name, span in ranges.items() if span < USED]
    if len(unused) == len(COMMANDS):
        levels = ", ".join(f"{e.values[name][0]:.3g}" for name in unused)
        yield Finding(e.boat, ", ".join(unused), "excitation", f"commands that never change ({levels})",
                      "thrusters that are used", override(unused[0], {"name": "NAME"}))  # fmt: skip
        return
    for name in unused:
        yield Finding(e.boat, name, "excitation", f"{e.values[name][0]:.3g} all the time", "a thruster that is used",
                      override(name, {"name": "NAME"}))  # fmt: skip
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
