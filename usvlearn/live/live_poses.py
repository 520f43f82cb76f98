"""Heading, yaw rate, sway and position at the end of each step, from messages that come one by one.

It is the live twin of `usvlearn.logs.channels.poses`, by whose functions it computes: the same messages, in the same
order, give the same numbers to the last bit.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

import numpy as np

from usvlearn.core.samples import Sample
from usvlearn.logs.channels import poses
from usvlearn.logs.channels.channel import AUTO, Source
from usvlearn.logs.channels.derived_surge import TOGETHER
from usvlearn.logs.channels.positions import GAP

MOST = 4096  # messages of a channel that are kept until a step uses them: 10 s at 400 Hz
NONE = np.full(1, math.nan)


class LivePoses:
    """Keeps the messages of the heading, the yaw rate and the auxiliary channels that the next step may need."""

    def __init__(self, channels: Mapping[str, Source]):
        self._gyro, self._sway, self._pair = (
            "yaw_rate" in channels, poses.sway_names(channels), poses.fix_names(channels),
        )  # fmt: skip
        names = {"heading", *(("yaw_rate",) if self._gyro else ()), *self._sway, *(self._pair or ())}
        self._channels = {name: channels[name] for name in names}
        self._time, self._heading = NONE, NONE  # the end of the last step, s, and the heading then
        self._way = np.zeros((1, 2))  # that of the boat by its own velocity, m
        self._velocity: np.ndarray | None = None  # m/s
        self._forget()

    def _forget(self) -> None:
        self._recent = {name: _Recent(source.window) for name, source in self._channels.items()}
        self._before: tuple[str, float, float] | None = None  # the last message of the pair that is in no fix
        self._fixes: deque[tuple[float, np.ndarray, np.ndarray]] = deque(maxlen=MOST)  # s, m, m/s
        self._past: deque[tuple[float, np.ndarray]] = deque(maxlen=MOST)  # fixes, from the one a second ago, s, m
        self._turns = np.full(3, math.nan)  # rad/s, what the gyro said after the last three steps
        self._origin: tuple[float, float] | None = None  # the first fix
        self._offset: np.ndarray | None = None  # m, from the fixes to the way

    def take(self, channel: str, time: float, value: float) -> None:
        """Take one message, s and SI units."""
        recent = self._recent.get(channel)
        if recent is None or not math.isfinite(value) or not recent.take(time, value):
            return
        if self._pair is None or channel not in self._pair:
            return
        before, self._before = self._before, (channel, time, value)
        if before is not None and before[0] != channel and abs(time - before[1]) <= TOGETHER:
            self._before = None
            first, second = (value, before[2]) if channel == self._pair[0] else (before[2], value)
            self._fix(max(time, before[1]), first, second)

    def _fix(self, time: float, first: float, second: float) -> None:
        assert self._pair is not None
        if not poses.is_fix(self._pair, np.array([first]), np.array([second]))[0]:
            return
        if self._origin is None:
            self._origin = first, second
        both = zip(self._origin, (first, second), strict=True)
        place = poses.metres(self._pair, *(np.array(each) for each in both))[1:]
        if not self._fixes:
            self._fixes.append((time, place, np.full((1, 2), np.nan)))
            self._past.append((time, place))
            return
        if (place != self._fixes[-1][1]).any():
            while len(self._past) > 1 and self._past[1][0] <= time - poses.BASE:
                self._past.popleft()
            since, then = self._past[0]
            speed = poses.velocity(place - then, np.array([time]) - since)
            self._fixes.append((time, place, speed))
            self._past.append((time, place))

    def at(self, time: float, sample: Sample) -> np.ndarray:
        """The numbers of `poses` at the end of a step, s, `(5,)`; the steps come in their order."""
        end = np.array([time])
        if time < self._time[0]:
            self._forget()
        last = {name: recent.last(time) for name, recent in self._recent.items()}
        heading, step = last["heading"], end - self._time
        turn = poses.slope(heading - self._heading, step)
        if self._gyro:
            self._turns = np.append(self._turns[1:], last["yaw_rate"])
            turn = turn if poses.is_stuck(self._turns)[-1] and np.isfinite(turn[0]) else last["yaw_rate"]
        sway = poses.across(self._sway, [last[name] for name in self._sway], heading)
        surge = np.array([sample.surge if sample.measured else math.nan])
        known = bool(np.isfinite(surge[0]) and np.isfinite(heading[0]))
        before = self._velocity
        if known or before is None:
            self._velocity = poses.over_ground(surge, sway, heading)
        assert self._velocity is not None
        if before is not None:
            self._way = self._way + poses.run(before, self._velocity, step)
        self._time, self._heading = end, heading
        return np.concatenate([heading, turn, sway, self._position(time, known)])

    def _position(self, time: float, known: bool) -> np.ndarray:
        while len(self._fixes) > 1 and self._fixes[1][0] <= time + poses.LATE:
            self._fixes.popleft()
        fixed = np.full(2, math.nan)
        if self._fixes and self._fixes[0][0] <= time + poses.LATE:
            since, place, speed = self._fixes[0]
            if time - since <= GAP:
                fixed = (place + speed * (np.array([time]) - since)[:, None])[0]
        if self._offset is None:
            if not math.isfinite(fixed[0]):
                return self._way[0] if known else fixed
            self._offset = self._way[0] - fixed
        return fixed + self._offset


class _Recent:
    """The messages of one channel, each newer than all before it, from the last one that a step has used."""

    def __init__(self, window: float | str):
        self._window, self._newest, self._last = window, -math.inf, math.nan
        self._messages: deque[tuple[float, float, float]] = deque(maxlen=MOST)  # s, SI units, window in s
        if window == AUTO:
            from usvlearn.logs.alignment import window_kernel  # numba takes a moment to import

            self._kernel, self._followed = window_kernel, window_kernel.new_followed(1)
            window_kernel.follow(*self._followed, 0, -math.inf)  # compiled now: a boat's first message need not wait
            window_kernel.window_of(*self._followed[1:], 0)

    def take(self, time: float, value: float) -> bool:
        """Keep a message; returns whether it is newer than all before it."""
        since, self._last = abs(time - self._last), time
        if time <= self._newest or since > poses.AHEAD:  # NaN before the first message
            return False
        self._newest, window = time, self._window
        if window == AUTO:
            self._kernel.follow(*self._followed, 0, time)
            window = self._kernel.window_of(*self._followed[1:], 0)
        self._messages.append((time, value, float(window)))
        return True

    def last(self, time: float) -> np.ndarray:
        """The last value within its window before a time, s, `(1,)`; NaN if there is none."""
        messages = self._messages
        while len(messages) > 1 and messages[1][0] <= time + poses.LATE:
            messages.popleft()
        if not messages or messages[0][0] > time + poses.LATE or not time - messages[0][0] <= messages[0][2]:
            return NONE
        return np.array([messages[0][1]])
