"""Missions: courses of references for the autopilot, each drawn from a random generator.

Every mission starts and ends with idle thrusters. Together they mix speeds, turns and coasting, so that each term of
the motion model is excited.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Mission(NamedTuple):
    """A course of references, one per tick of the autopilot; of several boats and missions `(ticks, …)`."""

    surge: np.ndarray  # (ticks,) speed over ground, share of the top speed; NaN where the throttle is open
    throttle: np.ndarray  # (ticks,) mean of both commands where it is open, share of full scale
    heading: np.ndarray  # (ticks,) rad; NaN where the turn is open
    power: np.ndarray  # (ticks,) 1, or 0 where both thrusters are off
    turn: np.ndarray  # (ticks,) half the difference left less right where it is open, share of full scale


def legs(rng: np.random.Generator, ticks: int, hz: float, shortest: float, longest: float) -> np.ndarray:
    """The number of the leg at each tick, `(ticks,)`; legs last `shortest` ... `longest` s."""
    least, most = max(1, round(shortest * hz)), max(1, round(longest * hz))
    lasts = rng.integers(least, most + 1, size=ticks // least + 1)
    return np.repeat(np.arange(lasts.size), lasts)[:ticks]


def convoy(rng: np.random.Generator, ticks: int, hz: float) -> Mission:
    """Follow in a column: the speed changes now and then and oscillates with the gap, and the path winds."""
    time = np.arange(ticks) / hz
    leg = legs(rng, ticks, hz, 30.0, 120.0)
    surge = rng.uniform(0.25, 0.85, leg[-1] + 1)[leg]
    period, phase = rng.uniform(8.0, 25.0), rng.uniform(0, 2 * math.pi)
    surge = surge * (1 + 0.12 * np.sin(2 * math.pi * time / period + phase))
    bend = legs(rng, ticks, hz, 15.0, 60.0)
    heading = rng.uniform(0, 2 * math.pi) + np.cumsum(rng.normal(0, 0.03, bend[-1] + 1)[bend]) / hz
    return _idle_ends(Mission(surge, np.zeros(ticks), heading, np.ones(ticks), np.zeros(ticks)), hz)


def patrol(rng: np.random.Generator, ticks: int, hz: float) -> Mission:
    """Go round a polygon with an open throttle that changes now and then, and coast at times."""
    leg = legs(rng, ticks, hz, 25.0, 70.0)
    turn = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 2.1, leg[-1] + 1)
    heading = (rng.uniform(0, 2 * math.pi) + np.cumsum(turn))[leg]
    spell = legs(rng, ticks, hz, 8.0, 40.0)
    throttle = rng.uniform(0.15, 1.0, spell[-1] + 1)[spell]
    power = (rng.random(spell[-1] + 1) > 0.15)[spell].astype(float)
    return _idle_ends(Mission(np.full(ticks, np.nan), throttle, heading, power, np.zeros(ticks)), hz)


def lawn_mower(rng: np.random.Generator, ticks: int, hz: float) -> Mission:
    """Survey parallel lines, each at a constant speed, with two right-angle turns between lines."""
    line, across = round(rng.uniform(30.0, 70.0) * hz), round(rng.uniform(6.0, 14.0) * hz)
    track = np.arange(ticks) // (line + across)
    crossing = np.arange(ticks) % (line + across) >= line
    side = rng.choice([-1.0, 1.0]) * math.pi / 2
    heading = rng.uniform(0, 2 * math.pi) + side * np.where(crossing, 1, 2 * (track % 2))
    surge = rng.uniform(0.3, 0.9, track[-1] + 1)[track]
    surge = np.where(crossing, np.minimum(surge, 0.4), surge)
    return _idle_ends(Mission(surge, np.zeros(ticks), heading, np.ones(ticks), np.zeros(ticks)), hz)


def station_keeping(rng: np.random.Generator, ticks: int, hz: float) -> Mission:
    """Hold a position: bursts of throttle (astern if the autopilot may), turns on the spot, coasting."""
    spell = legs(rng, ticks, hz, 4.0, 16.0)
    count = spell[-1] + 1
    throttle = rng.uniform(-0.4, 0.8, count)[spell]
    heading = (rng.uniform(0, 2 * math.pi) + np.cumsum(rng.normal(0, 0.7, count)))[spell]
    power = (rng.random(count) > 0.4)[spell].astype(float)
    return _idle_ends(Mission(np.full(ticks, np.nan), throttle, heading, power, np.zeros(ticks)), hz)


def random_commands(rng: np.random.Generator, ticks: int, hz: float) -> Mission:
    """Both commands open and independent, from 0 to full ahead, drawn anew every 4 s: nothing is controlled."""
    spell = legs(rng, ticks, hz, 4.0, 4.0)
    left, right = rng.random((2, spell[-1] + 1))[:, spell]
    none = np.full(ticks, np.nan)
    return _idle_ends(Mission(none, (left + right) / 2, none, np.ones(ticks), (left - right) / 2), hz)


def paused(rng: np.random.Generator, mission: Mission) -> Mission:
    """The mission with the thrusters off for 10 ... 25 % of its length, somewhere in the middle."""
    ticks = mission.power.size
    off, start = round(ticks * rng.uniform(0.1, 0.25)), round(ticks * rng.uniform(0.25, 0.6))
    power = mission.power.copy()
    power[start : start + off] = 0.0
    return mission._replace(power=power)


def aborted(rng: np.random.Generator, mission: Mission, hz: float, coast: float = 15.0) -> Mission:
    """The mission cut short at 30 ... 80 % of its length, the thrusters off over its last `coast` s."""
    ticks = max(1, round(mission.power.size * rng.uniform(0.3, 0.8)))
    short = Mission(*(leaf[:ticks].copy() for leaf in mission))
    short.power[max(0, ticks - round(coast * hz)) :] = 0.0
    return short


def _idle_ends(mission: Mission, hz: float, start: float = 5.0, end: float = 15.0) -> Mission:
    ticks = mission.power.size
    mission.power[: min(round(start * hz), ticks // 8)] = 0.0
    mission.power[ticks - min(round(end * hz), ticks // 8) :] = 0.0
    return mission


MISSIONS: dict[str, Callable[[np.random.Generator, int, float], Mission]] = {
    "convoy": convoy,
    "patrol": patrol,
    "lawn_mower": lawn_mower,
    "station_keeping": station_keeping,
    "random": random_commands,
}
USUAL = ("convoy", "patrol", "lawn_mower", "station_keeping")  # of a season
