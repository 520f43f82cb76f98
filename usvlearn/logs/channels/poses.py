"""The pose at the end of each step, from a log: heading, yaw rate, sway and position.

Each has its own freshness: a number is the last message stamped within its window before the end of the step, or NaN.
Nothing stamped after the end of a step is used, nor what came after the step was made, so that a boat that is under way
has the same numbers (`usvlearn.live.live_poses`). A message that is not newer than all earlier ones of its channel is
not used, nor one whose stamp jumps (`AHEAD`). A window that is "auto" follows the rate of the messages
(`usvlearn.logs.alignment.window_kernel`).

- The *yaw rate* is the gyro's; without one, and where it says the same number after three steps in a row, as a gyro
  that is stuck does, the slope of the heading over the step.
- The *sway* is logged, or comes from a velocity over ground: −v_n sin ψ + v_e cos ψ, or V sin(χ − ψ).
- The *position* is the last fix, carried on to the end of the step by the velocity since the fix a second before. Two
  messages make a fix if they follow one another and are stamped at most `TOGETHER` apart. A latitude and longitude of
  exactly 0 is no fix. Until two fixes have come, the position is the integral of the measured velocity, and the fixes
  go on from there. So without any fix, tracks are judged by the boat's own speed and heading.

Where a step ends before the one before it, the clock was set back. What came until then is forgotten.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from usvlearn.core.samples import Sample
from usvlearn.logs.channels.channel import AUTO, COURSES, DEGREES, METRES, SWAY, VELOCITIES, Channel
from usvlearn.logs.channels.derived_surge import TOGETHER
from usvlearn.logs.channels.positions import GAP, local

BASE = 1.0  # s between two fixes that give a velocity, at least, where there are so many
JUMP = 30.0  # m/s between two fixes, from which they are no motion
SLOPE = 2.0  # s, the longest step over which the heading gives a yaw rate
AHEAD = 60.0  # s from the message of the channel before, beyond which a stamp is believed if the next one is near it
LATE = 1e-6  # s, below which two stamps are one
SWAYS = ((SWAY,), VELOCITIES, COURSES)  # what the sway comes from: the first that is logged


class Messages(NamedTuple):
    """Messages of one channel, each newer than all before it."""

    time: np.ndarray  # (n,) s
    value: np.ndarray  # (n,) SI units
    order: np.ndarray  # (n,) place in the log
    window: np.ndarray  # (n,) s, after each message


def poses(
    channels: Mapping[str, Channel], time: np.ndarray, samples: Sample, came: np.ndarray | None = None
) -> np.ndarray:
    """Heading, rad, yaw rate, rad/s, sway over ground, m/s, and position, m north and east, at the end of each step.

    The time, `(n,)`, is that of the ends of the steps, s since the log's start; `came` is the place in the log of the
    message with which each step was made; None: all had come. Returns `(n, 5)`, NaN where nothing fresh is known.
    """
    came = np.full(len(time), np.inf) if came is None else came
    pose, begins = np.empty((len(time), 5)), [0, *(np.flatnonzero(np.diff(time) < 0) + 1), len(time)]
    for begin, end in pairwise(begins):
        since = float(came[begin]) if begin else -math.inf
        pose[begin:end] = _rising(channels, time[begin:end], came[begin:end], since)
    way, known = reckoned(time, pose[:, 0], np.where(samples.measured, samples.surge, np.nan), pose[:, 2])
    for begin, end in pairwise(begins):
        position = pose[begin:end, 3:]
        fixed = np.flatnonzero(np.isfinite(position[:, 0]))
        first = fixed[0] if len(fixed) else end - begin
        position[first:] += way[begin + first] - position[first] if len(fixed) else 0.0
        position[:first] = np.where(known[begin : begin + first, None], way[begin : begin + first], np.nan)
    return pose


def _rising(channels: Mapping[str, Channel], time: np.ndarray, came: np.ndarray, since: float) -> np.ndarray:
    """`poses` of steps whose ends rise, from messages after a place of the log; positions from fixes alone."""

    def last(name: str) -> np.ndarray:
        recent = messages(channels[name], since)
        k = _latest(recent.time, recent.order, time, came)
        if not len(recent.time):
            return np.full(len(time), np.nan)
        return np.where((k >= 0) & (time - recent.time[k] <= recent.window[k]), recent.value[k], np.nan)

    heading = last("heading")
    turn = slope(np.diff(heading, prepend=np.nan), np.diff(time, prepend=np.nan))
    if "yaw_rate" in channels:
        gyro = last("yaw_rate")
        turn = np.where(is_stuck(gyro) & np.isfinite(turn), turn, gyro)
    names = sway_names(channels)
    sway = across(names, [last(name) for name in names], heading)
    position, pair = np.full((len(time), 2), np.nan), fix_names(channels)
    if pair is not None:
        stamps, order, *values = _paired(*(messages(channels[name], since) for name in pair))
        given = np.flatnonzero(is_fix(pair, *values))
        if len(given):
            fix = metres(pair, *(each[given] for each in values))
            moved = np.append(True, (np.diff(fix, axis=0) != 0).any(1))  # one that is posted again is the same fix
            stamps, order, fix = stamps[given][moved], order[given][moved], fix[moved]
            base = np.searchsorted(stamps, stamps - BASE, side="right") - 1
            base = np.minimum(np.maximum(base, 0), np.arange(len(stamps)) - 1)[1:]
            speed = velocity(fix[1:] - fix[base], stamps[1:] - stamps[base])
            speed = np.concatenate([np.full((1, 2), np.nan), speed])
            k = _latest(stamps, order, time, came)
            age = time - stamps[k]
            position = np.where(((k >= 0) & (age <= GAP))[:, None], fix[k] + speed[k] * age[:, None], np.nan)
    return np.column_stack([heading, turn, sway, position])


def messages(channel: Channel, since: float = -math.inf) -> Messages:
    """The messages of a channel that can be used, of those after a place in the log."""
    finite = np.isfinite(channel.time) & np.isfinite(channel.value) & (channel.order > since)
    time, value, order = channel.time[finite], channel.value[finite], channel.order[finite]
    near = np.abs(np.diff(time, prepend=time[:1])) <= AHEAD
    newest = np.maximum.accumulate(np.append(-math.inf, np.where(near, time, -math.inf)))
    newer = near & (time > newest[:-1])
    time = np.ascontiguousarray(time[newer], np.float64)
    if channel.window != AUTO:
        return Messages(time, value[newer], order[newer], np.full(len(time), float(channel.window)))
    from usvlearn.logs.alignment.window_kernel import windows_after  # numba takes a moment to import

    return Messages(time, value[newer], order[newer], windows_after(time))


def _latest(stamps: np.ndarray, order: np.ndarray, time: np.ndarray, came: np.ndarray) -> np.ndarray:
    """The last message stamped until each time that had come by then, `(n,)`; −1 where there is none."""
    until, there = np.searchsorted(stamps, time + LATE, side="right"), np.searchsorted(order, came, side="right")
    return np.minimum(until, there) - 1


def slope(turned: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The yaw rate by which the heading turned in a step, rad/s; NaN where the step is too long."""
    turned = np.remainder(turned + math.pi, 2 * math.pi) - math.pi
    return np.where(step <= SLOPE, turned / np.where(step > 0, step, np.nan), np.nan)


def is_stuck(turn: np.ndarray) -> np.ndarray:
    """Where a gyro said the same number after this step and the two before it, `(n,)`."""
    same = np.append(False, np.diff(turn) == 0)
    return same & np.append(False, same[:-1])


def sway_names(channels: Container[str]) -> tuple[str, ...]:
    """The channels from which the sway comes; () if there are none."""
    return next((names for names in SWAYS if all(name in channels for name in names)), ())


def across(names: tuple[str, ...], numbers: Sequence[np.ndarray], heading: np.ndarray) -> np.ndarray:
    """The sway, m/s, from the numbers of `sway_names`, `(n,)` each; NaN without any."""
    if not names:
        return np.full(len(heading), np.nan)
    if len(names) == 1:
        return numbers[0]
    one, other = numbers
    if names == VELOCITIES:
        return other * np.cos(heading) - one * np.sin(heading)
    return one * np.sin(other - heading)


def fix_names(channels: Container[str]) -> tuple[str, str] | None:
    """The channels from which fixes come; None if there are none."""
    return next((pair for pair in (DEGREES, METRES) if all(name in channels for name in pair)), None)


def _paired(one: Messages, other: Messages) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Stamps, places and both values of messages of two channels that follow one another closely; each is used once."""
    side = np.repeat([0, 1], [len(one.time), len(other.time)])
    time, value, order = (np.concatenate([x, y]) for x, y in zip(one[:3], other[:3], strict=True))
    sort = np.argsort(order, kind="stable")
    side, time, value, order = side[sort], time[sort], value[sort], order[sort]
    follows = (np.diff(side) != 0) & (np.abs(np.diff(time)) <= TOGETHER)  # of the message after each
    place = np.arange(len(follows))
    begins = np.maximum.accumulate(np.where(follows & ~np.append(False, follows)[:-1], place, 0))
    k = np.flatnonzero(follows & ((place - begins) % 2 == 0))
    first, second = (np.where(side[k] == which, value[k], value[k + 1]) for which in (0, 1))
    return np.maximum(time[k], time[k + 1]), order[k + 1], first, second


def is_fix(pair: tuple[str, str], first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Whether two numbers are a position; a receiver without one gives zeros."""
    return (first != 0) | (second != 0) if pair == DEGREES else np.ones(len(first), bool)


def metres(pair: tuple[str, str], first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Positions relative to the first of them, m north and east, `(n, 2)`."""
    return np.column_stack(local(first, second) if pair == DEGREES else (first - first[0], second - second[0]))


def velocity(way: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The velocities, m/s, `(n, 2)`, from ways between fixes, m, in times, s; 0 where a position jumps or was away."""
    rates = way / np.maximum(step, LATE)[:, None]
    return np.where((np.hypot(*rates.T) < JUMP)[:, None] & (step <= GAP)[:, None], rates, 0.0)


def over_ground(surge: np.ndarray, sway: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """The measured velocity, m/s north and east, `(n, 2)`; the sway counts as 0 where it is not known."""
    aside = np.nan_to_num(sway)
    north = surge * np.cos(heading) - aside * np.sin(heading)
    return np.column_stack([north, surge * np.sin(heading) + aside * np.cos(heading)])


def reckoned(
    time: np.ndarray, heading: np.ndarray, surge: np.ndarray, sway: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The way of a boat by its own measured velocity, m north and east, `(n, 2)`, and where that was measured, `(n,)`.

    It goes on with the last velocity where none is measured.
    """
    speed, known = over_ground(surge, sway, heading), np.isfinite(surge) & np.isfinite(heading)
    held = speed[np.maximum.accumulate(np.where(known, np.arange(len(time)), 0))]
    before = np.concatenate([held[:1], held[:-1]])
    return np.cumsum(run(before, held, np.diff(time, prepend=time[:1])), 0), known


def run(before: np.ndarray, after: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The way in steps of some lengths, s, from the velocities before and after, m north and east, `(n, 2)`."""
    return np.nan_to_num((before + after) / 2) * step[:, None]
