"""Asynchronous channels to samples on a grid of `dt`: message by message, aboard or in a loop over a log.

The step k → k+1 runs from the grid time t_k to t_{k+1} = t_k + dt. Its *target* is the last speed message stamped in
(t_k, t_{k+1}], at s. What a prediction may see of each input (theory, section 1):

    mean   time-weighted mean of the held signal over [t_k, s): nothing stamped at or after the target (the default)
    last   the value in force at t_k: a true forecast
    next   the value at t_{k+1}, the paper's own form. It leaks: in a closed loop the command logged beside a speed was
           computed from that speed.

An input with a `delay` counts from its stamp plus that delay, so it can only be seen later than stamped. (A delay of
the speed is one of all inputs: declare it there.)

A message is rejected, and counted by channel and cause, when it is not a number (`not_a_number`), beyond a physical
limit (`out_of_range`), an exact copy (`duplicate`), stamped before what its channel or the log already had
(`backwards`), or the first one beyond an outage, which may be a stray stamp (`ahead`). Two values under one stamp: the
later one stands (`repeated`). A step without a recent message of a channel counts as `stale`.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from usvlearn.errors import ConfigError, LogFormatError, check_choice, check_not_negative, check_positive
from usvlearn.logs.channel import CHANNELS, REQUIRED, Channel
from usvlearn.signals import Inputs, Sample

EPSILON = 1e-6  # s, below which two stamps are one
SLACK = 1.0  # s, by which a channel may lag behind the newest message of any other
RESETS = 3  # messages in a row, of several channels, that far behind are a clock that was set back
TURN = 2 * math.pi


class Track:
    """The recent messages of one channel, oldest first."""

    __slots__ = ("delay", "held", "times", "values", "window")

    def __init__(self, held: bool, window: float, delay: float):
        self.held, self.window, self.delay = held, window, delay
        self.times: list[float] = []  # stamp + delay: when a value takes effect
        self.values: list[float] = []

    def at(self, time: float) -> int:
        """Index of the last message stamped at or before `time`; -1 where there is none."""
        return bisect_right(self.times, time + EPSILON) - 1

    def before(self, time: float) -> int:
        """Index of the last message stamped before `time`; -1 where there is none."""
        return bisect_left(self.times, time - EPSILON) - 1

    def mean(self, start: float, end: float) -> float:
        """Time-weighted mean of the held signal over [start, end); NaN where it had no value yet."""
        times, values = self.times, self.values
        j, last = self.at(start), self.before(end)
        if last < 0:
            return math.nan
        if j < 0:
            j, start = 0, times[0]
        if j == last:
            return values[j]
        total, since = 0.0, start
        for i in range(j, last):
            total += values[i] * (times[i + 1] - since)
            since = times[i + 1]
        return (total + values[last] * (end - since)) / (end - start)

    def forget(self, time: float, span: float) -> None:
        """Drop what is not needed to know the signal from `span` before its last message at or before `time`."""
        last = self.at(time)
        keep = self.at(self.times[last] - span) if last > 0 else 0
        if keep > 0:
            del self.times[:keep], self.values[:keep]


class Aligner:
    """Turns messages into samples; feed it with `push`, and with `flush` at the end of a log.

    Args:
        dt: step, s.
        inputs: "mean", "last" or "next", as above.
        channels: what is logged, each with its `held`, `window` and `delay` (a `Channel` or a `Source`). Without
            "yaw_rate" the heading's slope is taken.
        surge_max, command_max, yaw_rate_max: physical limits, m/s, share of full scale, rad/s.
        patience: how long after a grid time stragglers are waited for, s.
        outage: silence of all channels after which the grid starts anew, s; nothing is emitted for it.

    Attributes:
        rejected: counts by channel and cause.

    Raises:
        ConfigError: an option outside its range.

    >>> from usvlearn.logs.channel import Source
    >>> aligner = Aligner({name: Source(name) for name in REQUIRED}, dt=0.4)
    >>> samples = []
    >>> for k in range(9):
    ...     for name in REQUIRED:
    ...         samples += aligner.push(name, 0.1 * k, 0.5)
    >>> [(round(t, 1), sample.measured) for t, sample in samples]
    [(0.0, False), (0.4, True)]
    """

    def __init__(
        self,
        channels: Mapping,
        dt: float = 0.4,
        inputs: str = "mean",
        surge_max: float = 10.0,
        command_max: float = 1.2,
        yaw_rate_max: float = 3.0,
        patience: float = 0.1,
        outage: float = 5.0,
    ):
        self.dt = check_positive("dt", dt, "of s")
        self.inputs = check_choice("inputs", inputs, ("mean", "last", "next"))
        self.outage = check_positive("outage", outage, "of s")
        self.patience = check_not_negative("patience", patience, "of s")
        self.limits = {
            "command_left": check_positive("command_max", command_max),
            "command_right": command_max,
            "surge": check_positive("surge_max", surge_max, "of m/s"),
            "yaw_rate": check_positive("yaw_rate_max", yaw_rate_max, "of rad/s"),
            "heading": math.inf,
        }
        if missing := [name for name in REQUIRED if name not in channels]:
            raise LogFormatError(f"channels: {', '.join(missing)} missing, expected {', '.join(REQUIRED)}")
        if unknown := [name for name in channels if name not in CHANNELS]:
            raise ConfigError(f"channels: found {', '.join(unknown)}, expected some of {', '.join(CHANNELS)}")
        if channels["surge"].delay:
            raise ConfigError("delay of surge: expected 0: give the inputs the delay with which they act on it")
        if channels["surge"].held:
            raise ConfigError("held of surge: expected false: an old speed is no measurement")
        self.tracks = {name: Track(bool(c.held), float(c.window), float(c.delay)) for name, c in channels.items()}
        self.rejected = {name: Counter() for name in (*self.tracks, "yaw_rate")}
        self._newest = -math.inf  # newest stamp of any channel
        self._behind: list[str] = []  # channels of the messages in a row that lie far behind it
        self._ahead = -math.inf  # stamp of the last message that lay beyond an outage
        self._heard = -math.inf  # grid time of the last measured speed
        self._tick: float | None = None  # the grid time that was emitted last
        self._known = False  # whether an estimator knows the speed at that time

    def push(self, channel: str, time: float, value: float) -> list[tuple[float, Sample]]:
        """Take one message in SI units; returns the samples that it completes, each with its grid time, s."""
        if channel not in self.tracks:
            raise ConfigError(f"channel: found {channel!r}, expected one of {', '.join(self.tracks)}")
        count = self.rejected[channel]
        try:
            time, value = float(time), float(value)
        except (TypeError, ValueError):
            time = value = math.nan
        if not (math.isfinite(value) and math.isfinite(time)):
            count["not_a_number"] += 1
            return []
        if not -self.limits[channel] <= value <= self.limits[channel]:
            count["out_of_range"] += 1
            return []
        out = []
        track = self.tracks[channel]
        if time < self._newest - SLACK:
            self._behind.append(channel)
            if len(self._behind) < RESETS or len(set(self._behind)) == 1:
                count["backwards"] += 1
                return []
            out += self.flush()  # the clock was set back: a new segment
            self._restart()
        elif time > self._newest + self.outage and self._newest > -math.inf:
            strays, self._ahead = abs(time - self._ahead) > self.outage, time
            if strays:  # a stray stamp, unless the next message confirms it
                count["ahead"] += 1
                return []
            out += self.flush()
            self._restart()
        self._behind.clear()
        if channel == "heading":
            value = self._unwrap(track, value)
        effect = time + track.delay
        if track.times and effect <= track.times[-1]:
            if effect < track.times[-1]:
                count["backwards"] += 1
            elif value == track.values[-1]:
                count["duplicate"] += 1
            else:
                count["repeated"] += 1
                track.values[-1] = value
            return out
        track.times.append(effect)
        track.values.append(value)
        self._newest = max(self._newest, time)
        if self._tick is None:
            if channel == "surge":
                self._tick, self._known, self._heard = time, True, time
                out.append((time, self._start(value)))
        elif self._newest > self._tick + self.dt + self.patience:
            out += self._advance(self._newest - self.patience)
        return out

    def flush(self) -> list[tuple[float, Sample]]:
        """The samples up to the newest message, without waiting for stragglers."""
        return self._advance(self._newest) if self._tick is not None else []

    def _restart(self) -> None:
        for track in self.tracks.values():
            # what is held stands, however old
            track.times[:] = [-math.inf] if track.held and track.times else []
            track.values[:] = track.values[-1:] if track.held else []
        self._newest, self._tick, self._known = -math.inf, None, False

    def _unwrap(self, track: Track, value: float) -> float:
        if not track.times:
            return value
        return value + TURN * round((track.values[-1] - value) / TURN)

    def _advance(self, until: float) -> list[tuple[float, Sample]]:
        out = []
        while self._tick + self.dt <= until + EPSILON:
            start, end = self._tick, self._tick + self.dt
            out.append((end, self._step(start, end)))
            self._tick = end
            for track in self.tracks.values():
                track.forget(start, self.dt)
        return out

    def _step(self, start: float, end: float) -> Sample:
        """The sample of the step from `start` to `end`."""
        speed = self.tracks["surge"]
        i = speed.at(end)
        measured = i >= 0 and speed.times[i] > start + EPSILON and end - speed.times[i] <= speed.window + EPSILON
        surge = speed.values[i] if measured else math.nan
        if not measured:
            self.rejected["surge"]["stale"] += 1
        elif end - self._heard > self.outage:
            self._known = False  # too long ago for the way from there to be one step
        if measured:
            self._heard = end
        # [start, cut): what a prediction may see under "mean"
        cut = speed.times[i] if measured else end
        values = {}
        for name, track in self.tracks.items():
            if name != "surge":
                values[name] = self._input(name, track, start, cut, end)
        if "yaw_rate" not in values:
            values["yaw_rate"] = self._heading_slope(start, cut, end)
        fresh = not any(math.isnan(x) for x in values.values())
        if not (fresh and self._known):
            # no step can be made; a measured speed still tells where the next one departs
            self._known = measured
            return self._start(surge) if measured else self._hold()
        inputs = Inputs(
            values["command_left"],
            values["command_right"],
            values["heading"] % TURN,
            values["yaw_rate"],
            self.dt,
        )
        return Sample(inputs, surge, True, measured)

    def _input(self, name: str, track: Track, start: float, cut: float, end: float) -> float:
        """The value of one input, NaN where it is stale."""
        if self.inputs == "mean":
            when, i = cut, track.before(cut)
        else:
            when = start if self.inputs == "last" else end
            i = track.at(when)
        if i < 0 or not (track.held or when - track.times[i] <= track.window + EPSILON):
            self.rejected[name]["stale"] += 1
            return math.nan
        return track.mean(start, cut) if self.inputs == "mean" else track.values[i]

    def _heading_slope(self, start: float, cut: float, end: float) -> float:
        """Yaw rate, rad/s, from the unwrapped heading over about one step; NaN where unknown or impossible."""
        track = self.tracks["heading"]
        j = track.before(cut) if self.inputs == "mean" else track.at(start if self.inputs == "last" else end)
        if j < 0:
            return math.nan  # counted as a stale heading
        i = track.at(track.times[j] - self.dt / 2)
        if track.held and (cut - track.times[j]) > 2 * self.dt + track.window:
            return 0.0  # it is held: the boat keeps its heading
        if i < 0 or track.times[j] - track.times[i] > 2 * self.dt + track.window:
            self.rejected["yaw_rate"]["stale"] += 1
            return math.nan
        slope = (track.values[j] - track.values[i]) / (track.times[j] - track.times[i])
        if abs(slope) > self.limits["yaw_rate"]:
            self.rejected["yaw_rate"]["out_of_range"] += 1
            return math.nan
        return slope

    def _start(self, surge: float) -> Sample:
        return Sample(Inputs(0.0, 0.0, 0.0, 0.0, 0.0), surge, False, False)

    def _hold(self) -> Sample:
        return Sample(Inputs(0.0, 0.0, 0.0, 0.0, self.dt), math.nan, False, False)


class Aligned(NamedTuple):
    """One log on the grid."""

    time: np.ndarray  # (time,) s since the log's start
    samples: Sample  # leaves (time,)
    rejected: dict[str, dict[str, int]]  # channel -> cause -> count


def align(channels: Mapping[str, Channel], **options) -> Aligned:
    """Align a whole log: its messages, in the order in which they were logged, through an `Aligner`.

    Args:
        channels: by name; `REQUIRED` and perhaps "yaw_rate".
        **options: of `Aligner`.
    """
    aligner = Aligner(channels, **options)
    names = list(channels)
    which = np.repeat(np.arange(len(names)), [len(channels[name].time) for name in names])
    stamps = np.concatenate([channels[name].time for name in names])
    values = np.concatenate([channels[name].value for name in names])
    order = np.argsort(np.concatenate([channels[name].order for name in names]), kind="stable")
    rows: list[tuple[float, Sample]] = []
    push = aligner.push
    for c, t, x in zip(which[order].tolist(), stamps[order].tolist(), values[order].tolist(), strict=True):
        if done := push(names[c], t, x):
            rows += done
    rows += aligner.flush()
    table = np.array([(t, *s.inputs, *s[1:]) for t, s in rows], dtype=np.float64).reshape(len(rows), 9)
    time, *inputs, surge, fresh, measured = table.T.copy()
    samples = Sample(Inputs(*inputs), surge, fresh > 0, measured > 0)
    rejected = {name: dict(count) for name, count in aligner.rejected.items() if count}
    return Aligned(time, samples, rejected)
