"""Sensors that stand still: a part whose value repeats for longer under way than it ever did.

Coarse sensors, copies, boats at rest and simulators repeat values, too. So for each part the node counts the changes
and the repeats under way, p = (repeats + 1)/(repeats + changes + 2), and the longest stretch of repeats. n repeats are
evidence of n log(1/p). The part is frozen if its stretch lasts `LEAST` s, is `TIMES` as long as the longest one, the
evidence exceeds `CERTAIN`, and the throttle, or for a turn the difference of the sides, has changed meanwhile. Of a
sensor with noise, which rises and falls in turn, such reversals count in place of changes, and the commands may stay.
Its messages are then left out, until the value changes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from usvlearn.live.health import seconds
from usvlearn.logs.channels.channel import COMMANDS, Source

UNDER_WAY, VARIED = 0.05, 0.1  # of full scale: a command above it; a change of it that a sensor should show
LEAST, TIMES, CERTAIN = 10.0, 3, 20.0  # s; times the longest stretch; evidence
KNOWN, NOISY = 50, 100  # changes, and reversals of a value, before which nothing is concluded from them
TURNS = ("heading", "yaw_rate", "course")


@dataclass
class _Stretch:
    """The present one of a part, and what is known of those before."""

    value: float = math.nan
    since: float = 0.0  # s, stamp of its first repeat under way
    repeats: int = 0
    command: float = 0.0  # as it began
    varied: bool = False
    frozen: float = 0.0  # s for which it has lasted, once it is frozen
    longest: int = 0
    before: int = 0  # repeats of the ended ones
    changes: int = 0
    reversals: int = 0
    rise: float = 0.0  # the last change

    def end(self, value: float) -> None:
        """The value has changed."""
        if not self.frozen:
            self.longest, self.before = max(self.longest, self.repeats), self.before + self.repeats
        rise, self.changes = value - self.value, self.changes + 1
        self.reversals += rise * self.rise < 0
        self.value, self.rise, self.repeats, self.frozen, self.varied = value, rise, 0, 0.0, False

    def is_new(self) -> bool:
        """Whether it is another one than those before."""
        certain = [
            self.repeats * math.log1p((count + 1) / (self.before + 1)) > CERTAIN and count > least
            for count, least in ((self.changes, KNOWN), (self.reversals, NOISY))
        ]
        return self.repeats > TIMES * self.longest and ((certain[0] and self.varied) or certain[1])


class FrozenSensors:
    """Watches all parts but the commands; the sources are by part."""

    def __init__(self, sources: Mapping[str, Source]):
        self._sources = sources
        self._stretches = {part: _Stretch() for part in sources if not part.startswith(COMMANDS)}
        self._commands = dict.fromkeys((part for part in sources if part.startswith(COMMANDS)), 0.0)
        self._one_command = len({sources[part].name for part in self._commands}) < 2

    def take(self, part: str, stamp: float, raw: float) -> bool:
        """Take a message; returns whether its sensor stands still, so that it is to be left out."""
        if part in self._commands:
            value: Any = self._sources[part].convert(np.float64(raw))  # type: ignore[arg-type]
            self._commands[part] = float(value)
        if (own := self._stretches.get(part)) is None:
            return False
        if raw != own.value:
            own.end(raw)
        elif max(map(abs, self._commands.values()), default=0.0) > UNDER_WAY:
            command = self._command(part)
            if own.repeats == 0:
                own.since, own.command = stamp, command
            own.repeats += 1
            own.varied |= abs(command - own.command) > VARIED
            if own.frozen or (stamp - own.since > LEAST and own.is_new()):
                own.frozen = stamp - own.since
        elif not own.frozen:
            own.repeats, own.varied = 0, False
        return bool(own.frozen)

    def _command(self, part: str) -> float:
        """The command that a part should follow, share of full scale."""
        left, right = (self._commands.get(side, self._commands.get(f"{side}[0]", 0.0)) for side in COMMANDS)
        if part not in TURNS or self._one_command:
            return (left + right) / 2
        return self._commands.get("command_left[1]", left - right)

    @property
    def warnings(self) -> dict[str, str]:
        """Part -> a sentence, "" while its sensor works."""
        why = "under way: it is left out until it changes: check its sensor"
        found = {part: seconds(own.frozen) if own.frozen else "" for part, own in self._stretches.items()}
        return {k: x and f"{k} ({self._sources[k].name}) has stood still for {x} {why}" for k, x in found.items()}
