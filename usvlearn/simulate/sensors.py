"""A simulated boat's log: stamped, noisy, late, quantised and partly lost messages of the true motion.

Every channel has its own clock, so channels are not sampled together. The k-th message has the stamp
t_k = (k + phase)/hz + jitter, contains the true value at t_k with the sensor's errors, and arrives (is logged) after a
latency. Speed below 0.2 m/s comes from a filter, so it is smoother than the quantised value above.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from usvlearn.errors import ConfigError, check_choice, check_positive
from usvlearn.logs.channels.channel import Channel

Posted = tuple[np.ndarray, np.ndarray]  # stamps and values of a channel's messages, (n,) each


@dataclass(frozen=True)
class Sensors:
    """Rates, errors and losses.

    Args:
        surge_hz: messages of speed a second, 1/s.
        surge_noise: standard deviation of white noise, m/s.
        surge_quantum: resolution of the speed, m/s.
        surge_filtered: below this speed a filter's value is logged: not quantised, no outliers, m/s.
        filter_time: time constant of that filter, s.
        outlier_share: share of the speeds with an outlier added.
        outlier_scale: scale of the outliers, which are Student t with 2 degrees of freedom, m/s.
        heading_hz: messages of heading a second, 1/s.
        heading_noise: standard deviation, rad.
        commands: "periodic" posts every command, "on_change" only those that differ from the last one (then held).
        jitter: stamps lie within +- this of their clock, s.
        latency: messages arrive up to this after their stamp, s.
        lost_share: share of single messages that are lost, of each channel.
        outages_per_hour: mean number of outages of each channel, 1/h.
        outage: shortest and longest outage, s.
        command_window: a command is stale when it is older, s.
        heading_window: likewise, of the heading, s.
        surge_window: likewise, of the speed, s.
        stuck: s of the mission at which the speed begins to repeat itself, and for how long, s.

    Raises:
        ConfigError: a number outside its range, or another way of commands.

    >>> Sensors(surge_hz=1.0).surge_quantum
    0.05
    """

    surge_hz: float = 5.0
    surge_noise: float = 0.02
    surge_quantum: float = 0.05
    surge_filtered: float = 0.2
    filter_time: float = 2.0
    outlier_share: float = 0.003
    outlier_scale: float = 0.4
    heading_hz: float = 10.0
    heading_noise: float = 0.01
    commands: str = "periodic"
    jitter: float = 0.01
    latency: float = 0.03
    lost_share: float = 0.01
    outages_per_hour: float = 3.0
    outage: tuple[float, float] = (2.0, 8.0)
    command_window: float = 0.5
    heading_window: float = 0.25
    surge_window: float = 0.3
    stuck: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self):
        check_choice("commands", self.commands, ("periodic", "on_change"))
        positive = ("surge_hz", "heading_hz", "surge_quantum", "filter_time")
        for name in (*positive, "command_window", "heading_window", "surge_window"):
            check_positive(name, getattr(self, name))
        for name, value in vars(self).items():
            if name in ("commands", "outage", "stuck"):
                continue
            most = 1.0 if name.endswith("share") else math.inf
            if not (0 <= value <= most and math.isfinite(value)):
                raise ConfigError(f"{name}: found {value!r}, expected a number from 0 to {most}")
        if len(self.outage) != 2 or not 0 <= self.outage[0] <= self.outage[1]:
            raise ConfigError(f"outage: found {self.outage!r}, expected the shortest and longest time in s")
        if len(self.stuck) != 2 or not 0 <= min(self.stuck) <= max(self.stuck) < math.inf:
            raise ConfigError(f"stuck: found {self.stuck!r}, expected when the speed sticks and for how long, in s")
        if self.jitter * max(self.surge_hz, self.heading_hz) >= 0.25:
            raise ConfigError(
                f"jitter: found {self.jitter} s, expected less than a quarter of the shortest period, "
                f"{0.25 / max(self.surge_hz, self.heading_hz):g} s"
            )


class Truth(NamedTuple):
    """The true motion on one mission of one boat."""

    dt: float  # s, step of the motion
    surge: np.ndarray  # (time,) over ground, m/s, at 0, dt, 2 dt, ...
    heading: np.ndarray  # (time,) rad, not wrapped
    tick: float  # s, step of the commands
    commands: np.ndarray  # (ticks, 2) left and right; the k-th is in force from k*tick


def measure(
    rng: np.random.Generator, truth: Truth, sensors: Sensors
) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
    """The channels of the log, and how many messages each lost to single losses and to outages."""
    span = (truth.surge.size - 1) * truth.dt
    held = sensors.commands == "on_change"
    window = (sensors.command_window, sensors.command_window, sensors.heading_window, sensors.surge_window)
    names = ("command_left", "command_right", "heading", "surge")
    posted = [*_commands(rng, truth, sensors), _heading(rng, truth, sensors), _surge(rng, truth, sensors)]
    arrived, dropped = [], {}
    for name, (time, value) in zip(names, posted, strict=True):
        sent, dropped[name] = _kept(rng, time, span, sensors)
        arrival = time + rng.uniform(0, sensors.latency, time.size)
        sent = np.flatnonzero(sent)
        sent = sent[np.argsort(arrival[sent], kind="stable")]
        arrived.append((time[sent], value[sent], arrival[sent]))
    orders = ranks([arrival for _, _, arrival in arrived])
    channels = {
        name: Channel(time, value, order, held and name.startswith("command"), window[i])
        for i, (name, (time, value, _), order) in enumerate(zip(names, arrived, orders, strict=True))
    }
    return channels, dropped


def _stamps(rng: np.random.Generator, hz: float, span: float, jitter: float) -> np.ndarray:
    """Stamps within 0 ... span, s, ascending."""
    count = math.floor(span * hz)
    return (np.arange(count) + rng.uniform(0.25, 0.75)) / hz + rng.uniform(-jitter, jitter, count)


def _at(truth_column: np.ndarray, dt: float, time: np.ndarray) -> np.ndarray:
    return np.interp(time, np.arange(truth_column.size) * dt, truth_column)


def _commands(rng: np.random.Generator, truth: Truth, sensors: Sensors) -> list[Posted]:
    """Both commands, each posted up to two jitters after it takes effect."""
    posted = []
    for value in truth.commands.T:
        time = np.arange(value.size) * truth.tick + rng.uniform(0, 2 * sensors.jitter, value.size)
        if sensors.commands == "on_change":
            new = np.append(True, np.diff(value) != 0)
            time, value = time[new], value[new]
        posted.append((time, value))
    return posted


def _heading(rng: np.random.Generator, truth: Truth, sensors: Sensors) -> Posted:
    """A compass: 0 ... 2 pi."""
    time = _stamps(rng, sensors.heading_hz, truth.dt * (truth.heading.size - 1), sensors.jitter)
    noise = rng.normal(0, sensors.heading_noise, time.size)
    return time, np.mod(_at(truth.heading, truth.dt, time) + noise, 2 * math.pi)


def _surge(rng: np.random.Generator, truth: Truth, sensors: Sensors) -> Posted:
    """GPS: quantised truth + white noise + outliers; near standstill truth + low-passed white noise; it may stick."""
    time = _stamps(rng, sensors.surge_hz, truth.dt * (truth.surge.size - 1), sensors.jitter)
    speed = _at(truth.surge, truth.dt, time)
    noise = rng.normal(0, sensors.surge_noise, time.size)
    hit = rng.random(time.size) < sensors.outlier_share
    outliers = hit * rng.standard_t(2, time.size) * sensors.outlier_scale
    keep = math.exp(-1 / (sensors.filter_time * sensors.surge_hz))
    taps = math.ceil(7 * sensors.filter_time * sensors.surge_hz)  # e^-7 is left behind the last
    kernel = (1 - keep) * keep ** np.arange(taps)
    filtered = speed + np.convolve(noise, kernel)[: time.size]
    raw = np.round((speed + noise + outliers) / sensors.surge_quantum) * sensors.surge_quantum
    shown = np.where(np.abs(filtered) < sensors.surge_filtered, filtered, raw)
    sticks = (time >= sensors.stuck[0]) & (time < sum(sensors.stuck))
    return time, np.where(sticks, shown[max(0, int(np.searchsorted(time, sensors.stuck[0])) - 1)], shown)


def _kept(
    rng: np.random.Generator, time: np.ndarray, span: float, sensors: Sensors
) -> tuple[np.ndarray, dict[str, int]]:
    """Which messages arrive, and the counts of the lost ones, by cause."""
    lost = rng.random(time.size) < sensors.lost_share
    count = rng.poisson(sensors.outages_per_hour * span / 3600)
    start = rng.uniform(0, span, (count, 1))
    out = ((time >= start) & (time < start + rng.uniform(*sensors.outage, (count, 1)))).any(axis=0)
    return ~(lost | out), {"lost": int((lost & ~out).sum()), "outage": int(out.sum())}


def ranks(arrivals: list[np.ndarray]) -> list[np.ndarray]:
    """The place of each message in the log of all channels."""
    by_arrival = np.argsort(np.concatenate(arrivals), kind="stable")
    rank = np.empty(by_arrival.size, dtype=np.int64)
    rank[by_arrival] = np.arange(by_arrival.size)
    return np.split(rank, np.cumsum([arrival.size for arrival in arrivals])[:-1])
