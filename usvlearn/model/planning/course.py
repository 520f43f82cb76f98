"""Courses for a next mission: commands and headings over time, within bounds of the commands and of the area.

A course has a throttle ξ, the mean of both commands, and a wanted heading at each step. Equation (1), and the path:
`docs/theory/identification.md#input-design`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from usvlearn.core.prepared_samples import COS, DT, LEARN, LEFT, MODE, RIGHT, ROW, SIN, YAW_RATE
from usvlearn.errors import ConfigError, check_positive

QUARTER = math.pi / 2  # rad; headings of a plan are multiples of it, from the first one
LEAST_SEGMENTS, MOST_SEGMENTS = 4, 60  # more take minutes to search
LEAST_SEGMENT, MOST_MINUTES = 2.0, 120.0  # s; min
LEAST_RANGE = 0.1  # share of full scale
LINE, ACROSS, SURVEY = 40.0, 8.0, 0.6  # s of a line of a lawn mower's and of the way to the next; share of the throttle
SPEED_SHARE = 0.8  # of the area's side that a line takes


@dataclass(frozen=True)
class Limits:
    """What a plan must keep to."""

    minutes: float = 5.0  # its length
    area: float = 200.0  # m, side of the square in which the boat must stay, from its middle on
    least: float = 0.0  # bounds of the commands, −1 … 1
    most: float = 1.0
    segment: float = 15.0  # s, how long throttle and wanted heading stay the same
    heading: float = 0.0  # rad, of the first segment, and of two sides of the square
    turn_rate: float = 0.35  # rad/s, in a turn
    steering: float = 0.35  # δ of a turn, share of full scale, a side

    def __post_init__(self) -> None:
        for name, value, unit in (
            ("--minutes", self.minutes, "of minutes"), ("--area", self.area, "of m"),
            ("--segment", self.segment, "of s"), ("--turn-rate", self.turn_rate, "of rad/s"),
        ):  # fmt: skip
            check_positive(name, value, unit)
        for name, value in (("--command-min", self.least), ("--command-max", self.most)):
            if not -1 <= value <= 1:
                raise ConfigError(f"{name}: found {value!r}, expected a share of full scale, from -1 to 1")
        if not self.most >= max(self.least, 0.0) + LEAST_RANGE:
            raise ConfigError(
                f"--command-max: found commands from {self.least:g} to {self.most:g}, expected a range of "
                f"{LEAST_RANGE:g} or more, part of it ahead: thrust and drag show only where the commands change"
            )
        low, high = (count * self.segment / 60 for count in (LEAST_SEGMENTS, MOST_SEGMENTS))
        for wrong, name, value, expected in (
            (self.segment < LEAST_SEGMENT, "--segment", self.segment, f"{LEAST_SEGMENT:g} s or more"),
            (self.minutes > MOST_MINUTES, "--minutes", self.minutes, f"{MOST_MINUTES:g} at most"),
            (self.segments > MOST_SEGMENTS, "--minutes", self.minutes, f"{high:g} or less ({MOST_SEGMENTS} segments): "
             "sail a shorter plan, learn from it, and plan again, or give a longer --segment"),
            (self.segments < LEAST_SEGMENTS, "--minutes", self.minutes, f"{low:g} or more ({LEAST_SEGMENTS} segments): "
             "give more minutes, or a shorter --segment"),
        ):  # fmt: skip
            if wrong:
                raise ConfigError(f"{name}: found {value:g}, expected {expected}")

    @property
    def segments(self) -> int:
        """How many there are."""
        return round(60 * self.minutes / self.segment)


class Course(NamedTuple):
    """A course; leaves `(steps,)`."""

    left: np.ndarray  # share of full scale
    right: np.ndarray
    throttle: np.ndarray  # ξ of (1)
    wanted: np.ndarray  # rad
    heading: np.ndarray  # rad, at the end of the step, not wrapped
    yaw_rate: np.ndarray  # rad/s
    dt: float  # s

    @property
    def rows(self) -> np.ndarray:
        """As the kernels read it, `(steps, ROW)`."""
        rows = np.zeros((len(self.left), ROW))
        rows[:, LEFT], rows[:, RIGHT], rows[:, YAW_RATE], rows[:, DT] = self.left, self.right, self.yaw_rate, self.dt
        middle = self.heading - self.yaw_rate * self.dt / 2
        rows[:, SIN], rows[:, COS], rows[:, MODE] = np.sin(middle), np.cos(middle), LEARN
        return rows

    def path(self, speed: np.ndarray, current: np.ndarray) -> np.ndarray:
        """Places north and east of the start, m, after each step, `(steps, 2)`, at speeds and a current in m/s."""
        along = np.stack([np.cos(self.heading), np.sin(self.heading)], -1)
        return np.cumsum(self.dt * (speed[:, None] * along + current), axis=0)


def steer(throttle: np.ndarray, wanted: np.ndarray, limits: Limits, dt: float) -> Course:
    """The course of (1), of throttles and wanted headings, rad, at each step, `(steps,)`."""
    heading, most = limits.heading, limits.turn_rate * dt
    headings, rates = np.empty((2, len(wanted)))
    for k, towards in enumerate(wanted.tolist()):
        away = (towards - heading + math.pi) % (2 * math.pi) - math.pi
        if abs(away) > math.pi - 1e-6:  # a turn round, always to the same side
            away = math.pi
        away = min(max(away, -most), most)
        heading += away
        headings[k], rates[k] = heading, away / dt
    steering = limits.steering * np.where(np.abs(rates) > 1e-9, np.sign(rates), 0.0)
    left, right = (np.clip(throttle + sign * steering, limits.least, limits.most) for sign in (1, -1))
    return Course(left, right, throttle, wanted, headings, rates, dt)


def steps_of(limits: Limits, dt: float) -> np.ndarray:
    """The segment of each step, `(steps,)`."""
    steps = round(limits.segments * limits.segment / dt)
    return np.minimum((np.arange(steps) * dt / limits.segment).astype(int), limits.segments - 1)


def planned(throttles: np.ndarray, quarters: np.ndarray, limits: Limits, dt: float) -> Course:
    """The course of a throttle and a heading, quarter turns from `limits.heading`, for each segment, `(segments,)`."""
    segment = steps_of(limits, dt)
    return steer(throttles[segment], limits.heading + QUARTER * quarters[segment], limits, dt)


def lawn_mower(limits: Limits, speed: float, dt: float) -> Course:
    """A survey of parallel lines at one throttle, as long as a plan; `speed` is the steady one at full command, m/s."""
    steps = len(steps_of(limits, dt))
    line = min(LINE, max(SPEED_SHARE * limits.area / max(SURVEY * speed, 0.1), ACROSS))
    time = np.arange(steps) * dt
    track, crossing = (time // (line + ACROSS)).astype(int), time % (line + ACROSS) >= line
    wanted = limits.heading + QUARTER * np.where(crossing, 1, 2 * (track % 2))
    return steer(np.full(steps, SURVEY * limits.most), wanted, limits, dt)
