"""Aligns asynchronous channels to samples on a grid of `dt`, message by message: live on a boat, or over a log.

`docs/theory/model.md#inputs-and-causality` says what a step, its target, and the choices of `inputs` and `steps` are;
`docs/troubleshooting.md` lists the causes by which rejected messages are counted.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from functools import cache
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.forecasts import HEADING
from usvlearn.core.samples import Inputs, Sample
from usvlearn.errors import ConfigError, LogFormatError, check_choice, check_not_negative, check_positive
from usvlearn.logs.channels.channel import AUTO, CHANNELS, COMMANDS, REQUIRED, Channel

LEAST_DT = 1e-3  # s; far below the time constants of a hull; a finer grid would fill the memory
ROOM = 64  # messages of a channel for which there is room at first


class Aligner:
    """Turns messages into samples; feed it with `push`, and with `flush` at the end of a log.

    Args:
        dt: step, s; with `steps="speed"` the least one.
        inputs: "mean", "last" or "next": see `docs/logs.md#alignment`.
        channels: the logged channels, each with its `held`, `window`, `delay` and `period` (a `Channel` or a `Source`).
            Without "yaw_rate", the slope of the heading is used. A window that is "auto" follows the rate of the
            messages: `usvlearn.logs.alignment.window_kernel`.
        surge_max: greatest speed, m/s; a faster one is rejected, as with the other limits.
        command_max: greatest command, share of full scale.
        yaw_rate_max: greatest yaw rate, rad/s.
        patience: time to wait for late messages after a grid time, s.
        outage: silence of all channels after which the grid starts anew, s; it gives no samples.
        steps: "grid" or "speed", likewise.

    Attributes:
        rejected: counts by channel and cause.

    Raises:
        ConfigError: an option outside its range.

    >>> from usvlearn.logs.channels.channel import Source
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
        steps: str = "grid",
    ):
        from usvlearn.core.jit import announce

        limits = {"surge_max": surge_max, "command_max": command_max, "yaw_rate_max": yaw_rate_max}
        self._settings = checked(channels, dt, inputs, limits, patience, outage, steps)
        self._places = {name: CHANNELS.index(name) for name in channels}
        kernel = _compiled()
        self._memory = kernel.new_memory(self._settings)
        self._times, self._values = np.empty((2, len(CHANNELS), ROOM))  # recent messages
        self._room = ROOM  # messages until some are to be forgotten
        none = np.empty(0)
        with announce(str(kernel.__file__), "alignment"):  # so that a boat's first message need not wait
            self.feed(none.astype(np.int64), none, none)
            self._make_room(0)
            self.ahead(1)
            _ = self.windows

    def __copy__(self) -> Aligner:  # a shallow copy would share its messages
        return copy.deepcopy(self)

    @property
    def rejected(self) -> dict[str, dict[str, int]]:
        """Counts of rejected messages: channel -> cause -> count."""
        counts = {
            name: {cause: int(n) for cause, n in zip(_compiled().CAUSES, row, strict=True) if n}
            for name, row in zip(CHANNELS, self._memory["rejected"][0], strict=True)
        }
        return {name: causes for name, causes in counts.items() if causes}

    @property
    def windows(self) -> dict[str, tuple[float, float]]:
        """The usual interval between messages and the window in force, s, of each channel; NaN until it is known."""
        from usvlearn.logs.alignment.window_kernel import usual

        memory = self._memory[0]
        usually = {name: usual(memory["seen"], memory["intervals"], k) for name, k in self._places.items()}
        return {name: (usually[name], float(memory["window"][k])) for name, k in self._places.items()}

    def push(self, channel: str, time: float, value: float) -> list[tuple[float, Sample]]:
        """Take one message.

        Args:
            channel: its name, one of those that were given.
            time: its stamp, s.
            value: in SI units.

        Returns:
            The samples that it completes, each with its grid time, s.

        Raises:
            ConfigError: there is no such channel.
        """
        if channel not in self._places:
            raise ConfigError(f"channel: found {channel!r}, expected one of {', '.join(self._places)}")
        try:
            time, value = float(time), float(value)
        except (TypeError, ValueError):
            time = value = math.nan
        rows = self.feed(np.array([self._places[channel]]), np.array([time]), np.array([value]))
        return _samples(rows) if len(rows) else []

    def flush(self) -> list[tuple[float, Sample]]:
        """The samples up to the newest message, without waiting for late messages.

        Returns:
            The samples, each with its grid time, s.

        >>> from usvlearn.logs.channels.channel import Source
        >>> aligner = Aligner({name: Source(name) for name in REQUIRED}, dt=0.4)
        >>> _ = [aligner.push(name, t, 0.5) for t in (0.0, 0.4) for name in REQUIRED]
        >>> [time for time, sample in aligner.flush()]
        [0.4]
        """
        none = np.empty(0)
        return _samples(self.feed(none.astype(np.int64), none, none, flush=True))

    def ahead(self, steps: int) -> Inputs:
        """The inputs of the steps after the last one, as far as they are known.

        A command stays in force until the next message, and takes effect after its delay. The boat keeps its yaw rate
        for 1.2 s; then the rate fades with a time constant of 1.2 s, because most boats are steered and hold a heading.
        A value that is older than its window at the newest message is NaN.

        Args:
            steps: number of steps.

        Returns:
            Leaves `(steps,)`.

        >>> from usvlearn.logs.channels.channel import Source
        >>> sources = {name: Source(name, held=name.startswith("command")) for name in REQUIRED}
        >>> aligner = Aligner(sources, dt=0.4)
        >>> _ = [aligner.push(name, 0.1 * k, 0.5) for k in range(9) for name in REQUIRED]
        >>> aligner.ahead(2).command_left
        array([0.5, 0.5])
        """
        left, right, heading, turn = _compiled().ahead(self._settings, self._memory, self._times, self._values, steps)
        return Inputs(left, right, heading, turn, np.full(steps, self._settings["dt"][0]))

    def feed(self, channels: np.ndarray, times: np.ndarray, values: np.ndarray, flush: bool = False) -> np.ndarray:
        """Take many messages at once.

        Args:
            channels: `(messages,)` int64, places in `CHANNELS`.
            times: `(messages,)` float64, stamps, s.
            values: `(messages,)` float64, SI units.
            flush: whether to call `flush` afterwards.

        Returns:
            `(samples, columns)`, see `usvlearn.logs.alignment.align_kernel.COLUMNS`.

        >>> from usvlearn.logs.channels.channel import Source
        >>> aligner = Aligner({name: Source(name) for name in REQUIRED}, dt=0.4)
        >>> channels = np.array([CHANNELS.index(name) for name in REQUIRED] * 9)
        >>> times = np.repeat(0.1 * np.arange(9), len(REQUIRED))
        >>> len(aligner.feed(channels, times, 0 * times + 0.5, flush=True))
        3
        """
        if len(times) > self._room:
            self._make_room(len(times))
        self._room -= len(times)
        recent = self._memory, self._times, self._values
        return _compiled().feed(self._settings, *recent, channels, times, values, flush)

    def _make_room(self, messages: int) -> None:
        """Drop messages that are no longer needed, and make room for twice the rest, so that this is seldom called."""
        _compiled().forget(self._settings, self._memory, self._times, self._values)
        used = int(self._memory["count"].max())
        if 2 * (used + messages) > self._times.shape[1]:
            new = np.empty((2, len(CHANNELS), 2 * (used + messages)))
            new[:, :, :used] = self._times[:, :used], self._values[:, :used]
            self._times, self._values = new
        self._room = self._times.shape[1] - used


def checked(
    channels: Mapping, dt: float, inputs: str, limits: Mapping[str, float], patience: float, outage: float, steps: str
) -> np.ndarray:
    """The settings of an alignment, a record of `align_kernel.SETTINGS`; arguments and errors as of `Aligner`."""
    if check_positive("dt", dt, "of s") < LEAST_DT:
        raise ConfigError(f"dt: found {dt!r}, expected {LEAST_DT:g} s or more")
    check_choice("inputs", inputs, _compiled().INPUTS)
    check_choice("steps", steps, _compiled().STEPS)
    check_positive("outage", outage, "of s")
    check_not_negative("patience", patience, "of s")
    command_max = check_positive("command_max", limits["command_max"])
    surge_max = check_positive("surge_max", limits["surge_max"], "of m/s")
    yaw_rate_max = check_positive("yaw_rate_max", limits["yaw_rate_max"], "of rad/s")
    most = {"surge": surge_max, "yaw_rate": yaw_rate_max, "heading": HEADING, **dict.fromkeys(COMMANDS, command_max)}
    if missing := [name for name in REQUIRED if name not in channels]:
        raise LogFormatError(f"channels: {', '.join(missing)} missing, expected {', '.join(REQUIRED)}")
    if unknown := [name for name in channels if name not in CHANNELS]:
        raise ConfigError(f"channels: found {', '.join(unknown)}, expected some of {', '.join(CHANNELS)}")
    if channels["surge"].delay:
        raise ConfigError(
            f"data.channels.surge.delay: found {channels['surge'].delay}, expected 0: give that delay to the inputs"
        )
    if channels["surge"].held:
        raise ConfigError("data.channels.surge.held: found true, expected false: an old speed is not measured again")
    for name, channel in channels.items():
        if channel.period == AUTO:
            raise ConfigError(
                f"data.channels.{name}.period: found {AUTO}, expected a time in s: live messages do not tell it; "
                "take that which reading a log of this boat prints, or 0"
            )
        if channel.period and name != "surge":
            raise ConfigError(f"data.channels.{name}.period: found {channel.period}, expected 0: it is for surge")
    logged = [channels.get(name, channels["heading"]) for name in CHANNELS]  # its slope replaces a missing yaw rate
    return _compiled().new_settings(
        dt=dt,
        inputs=_compiled().INPUTS.index(inputs),
        steps=_compiled().STEPS.index(steps),
        period=channels["surge"].period,
        patience=patience,
        outage=outage,
        limit=[most[name] for name in CHANNELS],
        logged=[name in channels for name in CHANNELS],
        window=[0.0 if channel.window == AUTO else channel.window for channel in logged],
        **{key: [getattr(channel, key) for channel in logged] for key in ("held", "delay")},
    )


@cache
def _compiled() -> ModuleType:
    """The compiled module; numba takes a moment to import."""
    from usvlearn.logs.alignment import align_kernel as compiled

    return compiled


def _samples(rows: np.ndarray) -> list[tuple[float, Sample]]:
    return [
        (time, Sample(Inputs(*inputs), surge, fresh > 0, measured > 0))
        for time, *inputs, surge, fresh, measured, _ in rows.tolist()
    ]


class Aligned(NamedTuple):
    """One log on the grid."""

    time: np.ndarray  # (time,) s since the log's start
    samples: Sample  # leaves (time,)
    rejected: dict[str, dict[str, int]]  # channel -> cause -> count
    came: np.ndarray  # (time,) place in the log of the message that completed the step; infinite at the log's end


def align(channels: Mapping[str, Channel], **options: Any) -> Aligned:
    """Align a whole log: its messages, in the order in which they were logged, through an `Aligner`.

    Args:
        channels: by name; `REQUIRED` and perhaps "yaw_rate".
        **options: of `Aligner`.

    Returns:
        The samples with their grid times, and the counts of rejected messages.

    >>> from usvlearn.logs.channels.channel import Channel
    >>> t = 0.1 * np.arange(20.0)
    >>> channels = {name: Channel(t, 0 * t + 0.5, 3 * np.arange(20) + k) for k, name in enumerate(REQUIRED)}
    >>> align(channels, dt=0.4).samples.surge[-1]
    np.float64(0.5)
    """
    aligner = Aligner(channels, **options)
    counts = [len(channel.time) for channel in channels.values()]
    which = np.repeat([CHANNELS.index(name) for name in channels], counts)
    time, value, order = (
        np.concatenate([getattr(channel, name) for channel in channels.values()]) for name in ("time", "value", "order")
    )
    place = np.argsort(order, kind="stable")
    rows = aligner.feed(which[place], time[place], value[place], flush=True)
    time, *inputs, surge, fresh, measured, completed = rows.T.copy()
    came = np.append(order[place], np.inf)[completed.astype(np.int64)]
    return Aligned(time, Sample(Inputs(*inputs), surge, fresh > 0, measured > 0), aligner.rejected, came)
