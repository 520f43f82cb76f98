"""How the messages of one boat become samples: its channels, the options of the alignment, its mass and top speed.

Each checkpoint contains it, so that a node aboard needs no other configuration, and a live boat is aligned as the
logs were from which the checkpoint was learned.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from usvlearn.core.unconfirmed import SECTION, open_questions, questions_of
from usvlearn.errors import ConfigError, check_positive, under
from usvlearn.logs.alignment.align import Aligner, checked
from usvlearn.logs.alignment.mixing import Mix, parts_of
from usvlearn.logs.channels.channel import AUTO, CHANNELS, COMMANDS, SURGE, Channel, Recording, Source
from usvlearn.logs.channels.derived_surge import LIVE_PAIRS, pair_of
from usvlearn.logs.read import sources_of

KEY = "setup"  # of a checkpoint's metadata
LEAST_STEP, MOST_STEP = 0.01, 2.0  # s, of a live step, as of the plans of `Online.forecast`


@dataclass(frozen=True)
class Setup:
    """The setup of one boat."""

    channels: Mapping[str, Source | Mix]  # that are logged, as `usvlearn.logs.read.read_recordings` takes them
    align: Mapping[str, Any] = field(default_factory=dict)  # options of `Aligner`; its step `dt` is always among them
    mass: float | None = None  # kg, added mass included, if it is known
    surge_max: float | None = None  # top speed, m/s, by which the data check judges speeds, if it is known
    reader: str | None = None  # the class that reads logs of this boat, which says what the names of channels are
    unconfirmed: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # see `usvlearn.core.unconfirmed`
    command_period: float | None = None  # s between two commands of the first log, if it is known

    def __post_init__(self) -> None:
        object.__setattr__(self, "align", {"dt": _defaults()["dt"], **self.align})

    @classmethod
    def of(cls, given: Any) -> Setup:
        """From what `json` returns; a ConfigError if it is something else, or a value is outside its legal range."""
        if not isinstance(given, Mapping) or not isinstance(given.get("channels"), Mapping):
            raise ConfigError(f"{KEY}: found {type(given).__name__}, expected channels and the options of an alignment")
        channels = {name: each for name, each in given["channels"].items()}
        for name, each in channels.items():
            if not isinstance(each, Mapping):
                raise ConfigError(f"{KEY}: data.channels.{name}: found {each!r:.60}, expected {{name: …, unit: …}}")
        align, vehicle = given.get("align") or {}, given.get("vehicle") or {}
        if not isinstance(align, Mapping) or not isinstance(vehicle, Mapping):
            raise ConfigError(f"{KEY}: found an alignment or a vehicle that is no mapping, expected options by name")
        for name in ("mass", "surge_max"):
            if vehicle.get(name) is not None:
                check_positive(f"vehicle.{name}", vehicle[name])
        reader, period = given.get("reader"), given.get("command_period")
        if period is not None:
            check_positive("command_period", period, "of s")
        return cls(
            sources_of(channels), dict(align), vehicle.get("mass"), vehicle.get("surge_max"),
            reader if isinstance(reader, str) else None, questions_of(given.get(SECTION)), period,
        )  # fmt: skip

    @classmethod
    def of_set(cls, facts: Mapping[str, Any]) -> Setup | None:
        """That of a checkpoint, from its metadata; None if it has none. Errors as of `of`."""
        return None if facts.get(KEY) is None else cls.of(facts[KEY])

    def live(self) -> Setup:
        """Without channels that only the track of a log needs."""
        needed = {*CHANNELS, *(() if SURGE in self.channels else pair_of(self.channels) or ())}
        return replace(self, channels={name: each for name, each in self.channels.items() if name in needed})

    def json(self) -> dict[str, Any]:
        """As JSON values."""
        channels = {name: x.json() if isinstance(x, Mix) else asdict(x) for name, x in self.channels.items()}
        vehicle = {"mass": self.mass, "surge_max": self.surge_max}
        asked: dict[str, Any] = {SECTION: dict(self.unconfirmed)} if self.unconfirmed else {}
        if self.command_period is not None:
            asked["command_period"] = self.command_period
        return {"channels": channels, "align": dict(self.align), "vehicle": vehicle, "reader": self.reader, **asked}

    @property
    def one_command(self) -> bool:
        """Whether both sides have the same command, so that nothing tells them apart."""
        left, right = (self.channels.get(name) for name in COMMANDS)
        return left is not None and left == right

    @property
    def parts(self) -> dict[str, Source]:
        """What is received: channels, and each source of a command that has several, such as "command_left[0]"."""
        return parts_of(self.channels)

    @property
    def aligned(self) -> dict[str, Source]:
        """The channels that are aligned; those of a command with several sources have the options of the first.

        A surge that is computed from a pair has the window and the period of the pair's first.
        """
        sources = {name: each.parts[0] if isinstance(each, Mix) else each for name, each in self.channels.items()}
        if SURGE not in sources and (pair := pair_of(sources)) is not None:
            sources[SURGE] = sources[pair[0]]
        return {name: sources[name] for name in CHANNELS if name in sources}

    def aligner(self, **options: Any) -> Aligner:
        """An aligner of live messages, with options in place of those of the setup; ConfigError if one is illegal."""
        self.check_live()
        with under("align", self.align):
            return Aligner(self.aligned, **{**self.align, **options})

    def check_live(self) -> None:
        """Raise a ConfigError if it cannot be used live; the values of the alignment are checked by `aligner`."""
        if SURGE not in self.channels and pair_of(self.channels) not in LIVE_PAIRS:
            raise ConfigError(
                "data.channels: found no surge, nor velocities or ground speed and course, expected one of them: live "
                "messages do not give it from positions"
            )
        self.check_alignment()

    def check_alignment(self) -> None:
        """Raise a ConfigError if an option of the alignment is not legal, or its step is too short or too long."""
        defaults = _defaults()
        for name in self.align:
            if name not in defaults:
                raise ConfigError(f"align.{name}: found no such option, expected one of {', '.join([*defaults][1:])}")
        options = {**defaults, **self.align}
        with under("align", defaults):
            limits = {name: options[name] for name in ("surge_max", "command_max", "yaw_rate_max")}
            how = (options[name] for name in ("patience", "outage", "steps"))
            checked(self.aligned, options["dt"], options["inputs"], limits, *how)
            if not LEAST_STEP <= options["dt"] <= MOST_STEP:
                raise ConfigError(f"dt: found {options['dt']!r}, expected {LEAST_STEP:g} to {MOST_STEP:g} s")


def _defaults() -> dict[str, Any]:
    """The options of an `Aligner`, and their defaults."""
    return {name: each.default for name, each in inspect.signature(Aligner).parameters.items()}


def setups_of(settings: Mapping[str, Any], recordings: Iterable[Recording]) -> dict[str, Setup]:
    """The setup of each boat whose logs were read, in which periods have been found, by the whole configuration."""
    data, vehicle = settings.get("data") or {}, settings.get("vehicle") or {}
    declared = sources_of(data["channels"]) if data.get("channels") else {}
    reader = (data.get("reader") or {}).get("_target_") if isinstance(data.get("reader"), Mapping) else None
    setups: dict[str, Setup] = {}
    for one in recordings:
        if one.boat in setups:
            continue
        channels = dict(declared) or {name: _own(name, each) for name, each in one.channels.items()}
        for name, each in channels.items():
            if isinstance(each, Source) and each.period == AUTO:
                channels[name] = settled(each, one.channels.get(SURGE))
        steps = np.diff(one.channels[COMMANDS[0]].time) if COMMANDS[0] in one.channels else np.zeros(0)
        period = float(np.median(steps[steps > 0])) if (steps > 0).any() else None
        setups[one.boat] = Setup(
            channels, dict(settings.get("align") or {}), vehicle.get("mass"), vehicle.get("surge_max"), reader,
            open_questions(settings), period,
        )  # fmt: skip
    return setups


def settled(source: Source, surge: Channel | None) -> Source:
    """A source with a period in place of "auto": that which was found for the speed, else 0."""
    return Source(**{**asdict(source), "period": surge.period if surge is not None and surge.period != AUTO else 0.0})


def _own(name: str, channel: Channel) -> Source:
    """The source of a channel that no configuration describes: SI units under its own name."""
    period = 0.0 if channel.period == AUTO or not math.isfinite(float(channel.period)) else float(channel.period)
    return Source(name, held=channel.held, window=channel.window, delay=channel.delay, period=period)
