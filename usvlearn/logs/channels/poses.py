"""What a log says at the end of each step beside the surge: heading, yaw rate, sway and position.

Each has its own freshness: a number is the last message stamped within its window before the end of the step, or NaN.
Nothing stamped after the end of a step is used, so that a boat that is under way has the same numbers.

- The *yaw rate* is the gyro's; without one, the slope of the heading over the step.
- The *sway* is logged, or comes from a velocity over ground: −v_n sin ψ + v_e cos ψ, or V sin(χ − ψ).
- The *position* is the last fix, carried on to the end of the step by the velocity between the last two fixes. A
  latitude and longitude of exactly 0 is no fix. Without any fix it is the integral of the measured velocity, so that
  tracks are judged by the boat's own speed and heading.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from usvlearn.core.samples import Sample
from usvlearn.logs.channels.channel import COURSES, DEGREES, METRES, SWAY, VELOCITIES, Channel
from usvlearn.logs.channels.positions import GAP, local

SLOWEST = 3.0  # usual intervals between messages, after which one is old; where the window is automatic
LEAST, MOST = 0.2, 5.0  # s, of such a window
JUMP = 30.0  # m/s between two fixes, from which they are no motion
SLOPE = 2.0  # s, the longest step over which the heading gives a yaw rate
LATE = 1e-6  # s, below which two stamps are one


def poses(channels: Mapping[str, Channel], time: np.ndarray, samples: Sample) -> np.ndarray:
    """Heading, rad, yaw rate, rad/s, sway over ground, m/s, and position, m north and east, at the end of each step.

    Args:
        channels: of a recording, in SI units.
        time: `(n,)`, s since the log's start, the ends of the steps.
        samples: of the steps, leaves `(n,)`.

    Returns:
        `(n, 5)`, NaN where nothing fresh is known.

    >>> from usvlearn.core.samples import Inputs
    >>> at, zero = np.arange(0.0, 3.0), np.zeros(3)
    >>> heading = Channel(at, np.array([0.0, 0.1, 0.2]), np.arange(3))
    >>> samples = Sample(Inputs(zero, zero, zero, zero, zero + 1), zero + 2, zero < 1, zero < 1)
    >>> poses({"heading": heading}, at, samples)[1:].round(2).tolist()
    [[0.1, 0.1, nan, 2.0, 0.1], [0.2, 0.1, nan, 3.97, 0.4]]
    """
    heading = last(channels["heading"], time)
    if "yaw_rate" in channels:
        turn = last(channels["yaw_rate"], time)
    else:
        turned, step = np.diff(heading, prepend=np.nan), np.diff(time, prepend=np.nan)
        turned = np.remainder(turned + math.pi, 2 * math.pi) - math.pi
        turn = np.where(step <= SLOPE, turned / np.where(step > 0, step, np.nan), np.nan)
    sway = _sway(channels, time, heading)
    position = _fixes(channels, time)
    if position is None:
        position = reckoned(time, heading, np.where(samples.measured, samples.surge, np.nan), sway)
    return np.column_stack([heading, turn, sway, position])


def last(channel: Channel, time: np.ndarray, window: float | None = None) -> np.ndarray:
    """The last number stamped within the window before some times, `(n,)`; NaN where there is none."""
    stamps, value = _sorted(channel)
    if not len(stamps):
        return np.full(len(time), np.nan)
    k = np.searchsorted(stamps, time + LATE, side="right") - 1
    age = time - stamps[np.clip(k, 0, None)]
    return np.where((k >= 0) & (age <= (window or window_of(channel, stamps))), value[np.clip(k, 0, None)], np.nan)


def window_of(channel: Channel, stamps: np.ndarray) -> float:
    """The staleness window of a channel, s."""
    if not isinstance(channel.window, str):
        return float(channel.window)
    usual = float(np.median(np.diff(stamps))) if len(stamps) > 1 else LEAST
    return min(max(SLOWEST * usual, LEAST), MOST)


def reckoned(time: np.ndarray, heading: np.ndarray, surge: np.ndarray, sway: np.ndarray) -> np.ndarray:
    """The way of a boat by its own measured velocity, m north and east, `(n, 2)`; NaN where none is measured."""
    aside = np.nan_to_num(sway)
    north = surge * np.cos(heading) - aside * np.sin(heading)
    east = surge * np.sin(heading) + aside * np.cos(heading)
    velocity, known = np.column_stack([north, east]), np.isfinite(surge) & np.isfinite(heading)
    held = velocity[np.maximum.accumulate(np.where(known, np.arange(len(time)), 0))]
    before = np.concatenate([held[:1], held[:-1]])
    way = np.cumsum(np.nan_to_num((held + before) / 2) * np.diff(time, prepend=time[:1])[:, None], 0)
    return np.where(known[:, None], way, np.nan)


def _sway(channels: Mapping[str, Channel], time: np.ndarray, heading: np.ndarray) -> np.ndarray:
    if SWAY in channels:
        return last(channels[SWAY], time)
    if all(name in channels for name in VELOCITIES):
        north, east = (last(channels[name], time) for name in VELOCITIES)
        return east * np.cos(heading) - north * np.sin(heading)
    if all(name in channels for name in COURSES):
        speed, course = (last(channels[name], time) for name in COURSES)
        return speed * np.sin(course - heading)
    return np.full(len(time), np.nan)


def _fixes(channels: Mapping[str, Channel], time: np.ndarray) -> np.ndarray | None:
    """The position at some times, m, `(n, 2)`, from fixes before them; None if none is logged."""
    pair = next((pair for pair in (DEGREES, METRES) if all(name in channels for name in pair)), None)
    if pair is None:
        return None
    (stamps, first), (others, second) = (_sorted(channels[name]) for name in pair)
    if not len(stamps) or not len(others):
        return None
    at = np.searchsorted(others, stamps + LATE, side="right") - 1
    together = at >= 0
    stamps, first, second = stamps[together], first[together], second[np.clip(at, 0, None)][together]
    if pair == DEGREES:
        given = (first != 0) | (second != 0)
        stamps, first, second = stamps[given], first[given], second[given]
        if not len(stamps):
            return None
        first, second = local(first, second)
    elif len(stamps):
        first, second = first - first[0], second - second[0]
    fix = np.column_stack([first, second])
    moved = np.ones(len(fix), bool)
    moved[1:] = (np.diff(fix, axis=0) != 0).any(1)  # a fix that is posted again is the same fix
    stamps, fix = stamps[moved], fix[moved]
    if len(stamps) < 2:
        return None
    speed = np.diff(fix, axis=0) / np.maximum(np.diff(stamps), LATE)[:, None]
    speed = np.where((np.hypot(*speed.T) < JUMP)[:, None] & (np.diff(stamps) <= GAP)[:, None], speed, 0.0)
    k = np.searchsorted(stamps, time + LATE, side="right") - 1
    age = time - stamps[np.clip(k, 0, None)]
    found = fix[np.clip(k, 0, None)] + speed[np.clip(k - 1, 0, None)] * age[:, None]
    return np.where(((k >= 1) & (age <= GAP))[:, None], found, np.nan)


def _sorted(channel: Channel) -> tuple[np.ndarray, np.ndarray]:
    """Stamps that rise, and their numbers, without those that are none."""
    finite = np.isfinite(channel.time) & np.isfinite(channel.value)
    stamps, place = np.unique(channel.time[finite], return_index=True)
    return stamps, channel.value[finite][place]
