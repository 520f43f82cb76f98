"""Finds a channel that stays the same number while the others show that it should change: a sensor that froze.

A stretch of equal values is a finding only with a witness in its own time, since coarse numbers, copies and held
commands repeat themselves, too. The thrusters of a boat at rest may be off, so zeros of a speed need positions. At the
end of its range a command is no witness: an autopilot that steers against a dead thruster stays there. Nor is it in
less than 20 s: one gust or wake turns a boat as long.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from usvlearn.logs.channels.bins import GAP, INTERVALS, Series, bin_means, bin_rates, cleaned
from usvlearn.logs.channels.channel import COMMANDS, METRES, SURGE
from usvlearn.logs.checks.evidence import LEG, MOVING, NONE, STEP, Evidence, spread, without
from usvlearn.logs.checks.finding import Finding, see

LONGEST, MESSAGES, TIMES = 10.0, 20, 20.0  # s; messages; median stretches
CHANGE, AHEAD = 0.25, 0.1  # of the top speed: its change, and the speed of a boat that moves
TURNED = math.radians(30)
ONE_WAY = 0.9  # length of the mean vector of a course
FOLLOWS, CERTAIN = 0.3, 2.5  # correlation of the turn or the speed with the commands; standard errors
USED = 0.2  # of full scale, the range of the other command
TURNING = 0.03  # rad/s, standard deviation of a turn
UNLIKE = 4.0  # times the squares of residuals elsewhere
FAR = 15.0  # m
EDGE = 0.02  # of the range of a command, from its ends

Witness = Callable[[Evidence, str, float, slice], str | None]


def stretches(series: Series) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First and last times of long stretches of equal values, s, and the values, `(stretches,)`."""
    time, value = cleaned(series)
    if len(time) < MESSAGES:
        return np.empty(0), np.empty(0), np.empty(0)
    passed = np.diff(time)
    limit = max(GAP, INTERVALS * float(np.median(passed)))
    ends = np.flatnonzero((np.diff(value) != 0) | (passed > limit))
    first, last = np.append(0, ends + 1), np.append(ends, len(time) - 1)
    lasted = time[last] - time[first]
    long = (last - first >= MESSAGES) & (lasted > max(LONGEST, TIMES * float(np.median(lasted))))
    return time[first[long]], time[last[long]], value[first[long]]


def frozen(e: Evidence) -> Iterator[Finding]:
    """Channels that froze, with the longest stretch of each."""
    for name, witness in WITNESSES.items():
        if name not in e.series or not len(e.edges):
            continue
        cases = []
        for first, last, value in zip(*stretches(e.series[name]), strict=True):
            begin, end = np.searchsorted(e.edges, (first, last))
            part = slice(int(begin), int(end) - 1)
            if part.stop - part.start >= LONGEST / STEP / 2 and (why := witness(e, name, float(value), part)):
                cases.append((float(last - first), float(first), float(value), why))
        if not cases:
            continue
        lasted, first, value, why = max(cases)
        run, began = e.place(first)
        share = sum(each[0] for each in cases) / max(STEP * np.isfinite(e.means(name)).sum(), lasted)
        number = f"{math.degrees(value):.4g}°" if name == "heading" else f"{value:.4g}" + " m" * (name in METRES)
        about = dict(zip(METRES, e.places, strict=True)).get(name, name)
        text = f"{number} from {began:.0f} to {began + lasted:.0f} s of {run} ({share:.0%} of the time) while {why}"
        also = f", one of {len(cases)} such stretches" if len(cases) > 1 else ""
        yield Finding(e.boat, about, "frozen", text + also, see("a value that changes", about), without(e, about))


def _speed(e: Evidence, name: str, value: float, part: slice) -> str | None:
    least = CHANGE * min(e.surge_max, e.fastest)
    rate = np.hypot(*_moves(e, part))
    if _range(rate) > least or (value == 0 and _middle(rate) > least):
        return f"the rate of position reaches {np.nanmax(rate):.2g} m/s"
    relation, demanded = e.thrust_on_speed, _range(_smooth(e.thrust[part]))
    follows = relation.correlation > FOLLOWS and relation.certainty > CERTAIN
    if value != 0 and follows and relation.slope * demanded > least:
        return f"the commands change by {demanded:.2g}"
    return None


def _heading(e: Evidence, name: str, value: float, part: slice) -> str | None:
    speed = np.abs(e.speed[part])
    stuck = _middle(speed) > 1e-6 and np.nanmax(speed) - np.nanmin(speed) < 1e-9  # it froze, too, and says nothing
    if not (stuck or _middle(speed) > AHEAD * min(e.surge_max, e.fastest)):
        return None
    if "yaw_rate" in e.series and (turned := _turned(e.means("yaw_rate")[part])) > TURNED:
        return f"the yaw rate says turns by {math.degrees(turned):.0f}°"
    north, east = moves = _moves(e, part)
    moving = np.hypot(*moves) > MOVING * min(e.surge_max, e.fastest)
    if moving.sum() > LONGEST and abs(np.mean(np.exp(1j * np.arctan2(east, north)[moving]))) < ONE_WAY:
        return "the course over ground changes"
    turns = e.turns
    if abs(turns.correlation) > FOLLOWS and abs(turns.certainty) > CERTAIN:
        demanded = _turned(turns.slope * (e.commands[0] - e.commands[1])[part])
        if demanded > TURNED:
            return f"the commands demand turns by {math.degrees(demanded):.0f}°"
    return None


def _yaw_rate(e: Evidence, name: str, value: float, part: slice) -> str | None:
    turned = spread(e.turn[part])
    return f"the heading turns at ±{turned:.2g} rad/s" if turned > TURNING else None


def _command(e: Evidence, name: str, value: float, part: slice) -> str | None:
    command, other = e.commands[::-1] if name == COMMANDS[1] else e.commands
    low, high = (float(each) for each in np.nanquantile(command, [0.005, 0.995]))
    inside = low + EDGE * (high - low) < value < high - EDGE * (high - low)
    if not inside or _range(other[part]) < USED or (part.stop - part.start) * STEP < 2 * LONGEST:
        return None
    difference, turn = e.commands[0] - e.commands[1], e.turn
    lag = round(e.turns.lag / STEP) if e.turns.seconds else 0
    difference = np.concatenate([np.full(lag, np.nan), difference])[: len(turn)]
    within = np.zeros(len(turn), dtype=bool)
    within[part] = True
    known = np.isfinite(difference) & np.isfinite(turn)
    elsewhere, here = known & ~within, known & within
    if min(elsewhere.sum(), here.sum()) < LONGEST or not np.ptp(difference[elsewhere]) > USED:
        return None
    slope, zero = np.polyfit(difference[elsewhere], turn[elsewhere], 1)
    follows = np.corrcoef(difference[elsewhere], turn[elsewhere])[0, 1]
    wrong = turn - slope * difference - zero
    error, usual = (float(np.mean(wrong[each] ** 2)) for each in (here, elsewhere))
    straight = float(np.mean((turn[here] - zero) ** 2))
    if abs(follows) > FOLLOWS and error > UNLIKE * usual and error > 2 * straight and error > TURNING**2:
        return "the other one changes, and the boat turns as if this one did, too"
    return None


def _coordinate(e: Evidence, name: str, value: float, part: slice) -> str | None:
    if not e.speeds:
        return None  # the speed comes from positions itself
    speed = bin_means(e.over_ground[METRES.index(name)], e.edges)[part]
    way = np.cumsum(speed[np.isfinite(speed)]) * STEP
    moved = float(np.ptp(way)) if len(way) else 0.0
    if _middle(np.abs(e.speed[part])) > CHANGE * min(e.surge_max, e.fastest) and moved > FAR:
        return f"speed and heading say that the boat moves by {moved:.0f} m"
    return None


def _moves(e: Evidence, part: slice) -> np.ndarray:
    """Rates of the positions north and east over 5 s, `(2, bins)`; NaN where they are not known."""
    return np.stack([_smooth(bin_rates(e.series.get(name, NONE), e.edges)[part]) for name in METRES])


def _smooth(values: np.ndarray) -> np.ndarray:
    """Means over `LEG`, `(bins - 4,)`."""
    size = round(LEG / STEP)
    return np.convolve(values, np.ones(size) / size, "valid") if len(values) >= size else values[:0]


def _range(values: np.ndarray) -> float:
    """Between the 5 % and the 95 % quantile of those that are known."""
    known = values[np.isfinite(values)]
    return float(np.ptp(np.quantile(known, [0.05, 0.95]))) if len(known) else 0.0


def _middle(values: np.ndarray) -> float:
    """The median of those that are known; 0 if none is."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 0.0


def _turned(rate: np.ndarray) -> float:
    """The range of the angle that rates of turn less their mean make, rad; a constant bias turns nothing."""
    known = rate[np.isfinite(rate)]
    return float(np.ptp(np.cumsum(known - known.mean()))) * STEP if len(known) else 0.0


WITNESSES: dict[str, Witness] = {
    SURGE: _speed, "heading": _heading, "yaw_rate": _yaw_rate,
    **dict.fromkeys(COMMANDS, _command), **dict.fromkeys(METRES, _coordinate),
}  # fmt: skip
