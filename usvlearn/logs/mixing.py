"""Commands that several logged signals make together: thrusters in two groups, or throttle and steering.

The command of a side is a weighted sum of signals, each as a share of full scale:

    ξ(t) = Σ_k w_k ξ_k(t)

Without weights it is the mean of the thrusters of a side. A mixer of differential thrust adds steering to the throttle
on the left (weights 1 and 1), subtracts it on the right (1 and −1), and limits the sum to ±1; where the weights add up
to more than 1, so does this module. A boat with one thruster and a rudder has the same signal on both sides.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from usvlearn.errors import ConfigError
from usvlearn.logs.channel import Channel, Source

SOURCE_KEYS = (*(field.name for field in fields(Source)), "weight")
PER_NAME = ("name", "field", "zero", "span")  # may be lists
LIMIT, TOLERANCE = 1.2, 1e-9  # a plausible share of full scale; of the sum of weights


@dataclass(frozen=True)
class Mix:
    """A channel that is the weighted sum of several sources.

    >>> Mix.of({"name": ["bow", "stern"], "span": [400, -400], "zero": 1500, "held": True}).parts[1].span
    -400
    """

    parts: tuple[Source, ...]
    weights: tuple[float, ...]

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Mix:
        """From the arguments of a `Source`, with a list of names; `field`, `zero`, `span` may be lists, `weight` too.

        Raises:
            ConfigError: the lists differ in length, or a weight is no finite number.
        """
        names = list(given["name"])
        count = len(names)
        rows = {key: row for key in (*PER_NAME, "weight") if (row := listed(given.get(key))) is not None}
        for key, row in rows.items():
            if len(row) != count:
                raise ConfigError(f"{key}: found {len(row)} values, expected one for each of the {count} names")
        weights = rows.pop("weight", None)
        if weights is None and given.get("weight") is not None:
            raise ConfigError(f"weight: found {given['weight']!r}, expected a list of {count} numbers")
        for weight in weights or []:
            if isinstance(weight, bool) or not isinstance(weight, int | float) or not math.isfinite(weight):
                raise ConfigError(f"weight: found {weight!r}, expected a number")
        same = {key: value for key, value in given.items() if key not in ("weight", *rows)}
        parts = [Source(**same, **{key: row[k] for key, row in rows.items()}) for k in range(count)]
        return cls(tuple(parts), tuple(weights or [1 / count] * count))

    def json(self) -> dict[str, Any]:
        """The arguments of `of`, as JSON values."""
        same = {key: value for key, value in asdict(self.parts[0]).items() if key not in PER_NAME}
        rows = {key: [getattr(part, key) for part in self.parts] for key in PER_NAME}
        return {**same, **rows, "weight": list(self.weights)}


def listed(value: Any) -> list | None:
    """A list or tuple as a list; None for anything else, also for text."""
    return list(value) if isinstance(value, Sequence) and not isinstance(value, str) else None


def parts_of(sources: Mapping[str, Source | Mix]) -> dict[str, Source]:
    """What a reader is asked for: each source, those of a mix under names such as "command_left[0]".

    >>> list(parts_of({"command_left": Mix.of({"name": ["a", "b"]}), "surge": Source("v")}))
    ['command_left[0]', 'command_left[1]', 'surge']
    """
    found: dict[str, Source] = {}
    for name, source in sources.items():
        if isinstance(source, Mix):
            found |= {f"{name}[{k}]": part for k, part in enumerate(source.parts)}
        else:
            found[name] = source
    return found


def mixed(
    sources: Mapping[str, Source | Mix], channels: Mapping[str, Channel], dropped: Mapping[str, dict[str, int]]
) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
    """The channels of the sources, and the counts of what was dropped, from those of `parts_of`."""
    found, counts = {}, {}
    for name, source in sources.items():
        if not isinstance(source, Mix):
            found[name], counts[name] = channels[name], dropped[name]
            continue
        names = [f"{name}[{k}]" for k in range(len(source.parts))]
        found[name], alone = mix([channels[each] for each in names], source.weights)
        total = {"alone": alone} if alone else {}
        for each in names:
            for cause, count in dropped[each].items():
                total[cause] = total.get(cause, 0) + count
        counts[name] = total
    return found, counts


def mix(parts: Sequence[Channel], weights: Sequence[float]) -> tuple[Channel, int]:
    """The weighted sum of channels, at each of their messages, from the latest value of each; and how many are dropped.

    Values that stand at one place of the log (one row, one message) make one. A message is dropped while another part
    has no value yet, or only one that is older than its staleness window, unless it is held.

    >>> one = Channel(np.array([0.0, 1.0]), np.array([0.2, 0.4]), np.array([0, 2]), held=True)
    >>> other = Channel(np.array([0.5]), np.array([1.0]), np.array([1]), held=True)
    >>> channel, dropped = mix([one, other], [0.5, 0.5])
    >>> channel.time, channel.value, dropped
    (array([0.5, 1. ]), array([0.6, 0.7]), 1)
    """
    first = parts[0]
    order, last = np.unique(np.concatenate([part.order for part in parts]), return_inverse=True)
    value, oldest, time = np.zeros(len(order)), np.full(len(order), np.inf), np.full(len(order), -np.inf)
    known = np.ones(len(order), dtype=bool)
    begin = 0
    for part, weight in zip(parts, weights, strict=True):
        own = last[begin : begin + len(part.order)]
        begin += len(own)
        place = np.full(len(order), -1)
        np.maximum.at(place, own, np.arange(len(own)))
        has = place >= 0
        place = np.maximum.accumulate(place)
        known &= place >= 0
        value += weight * part.value[place]
        oldest = np.minimum(oldest, part.time[place])
        time = np.where(has, np.maximum(time, part.time[place]), time)
    keep = known & (first.held | (time - oldest <= first.window))
    value, most = value[keep], sum(map(abs, weights))
    if most > 1 + TOLERANCE:
        value = np.where(np.abs(value) <= LIMIT * most, np.clip(value, -1.0, 1.0), value)  # nonsense stays as it is
    return first._replace(time=time[keep], value=value, order=order[keep]), int((~keep).sum())


class LiveMix:
    """`mix` of messages that come one by one, each at a place of its own.

    >>> both = LiveMix(Mix.of({"name": ["bow", "stern"], "held": True}))
    >>> both.push(0, 0.0, 0.2), both.push(1, 0.5, 1.0), both.push(0, 1.0, 0.4)
    (None, 0.6, 0.7)
    """

    def __init__(self, given: Mix):
        self._weights, self._most = given.weights, sum(map(abs, given.weights))
        self._held, self._window = given.parts[0].held, given.parts[0].window
        self._last: list[tuple[float, float] | None] = [None] * len(given.parts)

    def push(self, part: int, time: float, value: float) -> float | None:
        """The sum after a message of one part; None while another part has no recent value.

        Args:
            part: its place.
            time, value: s and share of full scale, finite.
        """
        self._last[part] = time, value
        total, oldest = 0.0, math.inf
        for last, weight in zip(self._last, self._weights, strict=True):
            if last is None:
                return None
            total += weight * last[1]
            oldest = min(oldest, last[0])
        if not (self._held or time - oldest <= self._window):
            return None
        if self._most > 1 + TOLERANCE and abs(total) <= LIMIT * self._most:
            return min(max(total, -1.0), 1.0)
        return total
