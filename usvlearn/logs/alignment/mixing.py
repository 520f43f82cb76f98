"""Commands that several logged signals make together: thrusters in two groups, throttle and steering, force and moment.

The command of a side is a weighted sum of signals, each as a share of full scale; without weights it is their mean.
Where the weights add up to more than 1, the sum is limited to ±1. `docs/logs.md` has the spans of force and moment.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np

from usvlearn.errors import ConfigError
from usvlearn.logs.channels.channel import AUTO, COMMANDS, Channel, Source

SOURCE_KEYS = (*(field.name for field in fields(Source)), "weight")
PER_NAME = ("name", "field", "unit", "zero", "span")  # may be lists
THROTTLE, STEERING = "throttle", "steering"  # of which the commands of both sides are made: `sides_of`
LIMIT, TOLERANCE = 1.2, 1e-9  # a plausible share of full scale; of the sum of weights


@dataclass(frozen=True)
class Mix:
    """A channel that is the weighted sum of several sources."""

    parts: tuple[Source, ...]
    weights: tuple[float, ...]

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Mix:
        """From the arguments of a `Source`, with a list of names; `PER_NAME` and `weight` may be lists. Else a
        ConfigError.
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
        rows: dict[str, Any] = {key: [getattr(part, key) for part in self.parts] for key in PER_NAME}
        if len(set(rows["unit"])) == 1:
            rows["unit"] = rows["unit"][0]
        return {**same, **rows, "weight": list(self.weights)}


def sides_of(throttle: Mapping[str, Any], steering: Mapping[str, Any] | None = None) -> dict[str, dict[str, Any]]:
    """The channels of both commands of a boat that is commanded by throttle, or by throttle and steering.

    With throttle alone both sides have it: a boat with one thruster and a rudder. Steering is added on the left and
    subtracted on the right. What is not of one name alone stands at the throttle; else it is a ConfigError.
    """
    both = {THROTTLE: throttle} if steering is None else {THROTTLE: throttle, STEERING: steering}
    for channel, given in both.items():
        if not isinstance(given.get("name"), str):
            raise ConfigError(f"{channel}: found {given.get('name')!r}, expected the name of one signal")
        allowed = [key for key in SOURCE_KEYS if key != "weight" and (channel == THROTTLE or key in PER_NAME)]
        if wrong := [key for key in given if key not in allowed]:
            more = ": it has that of the throttle" if channel == STEERING else ""
            raise ConfigError(f"{channel}.{wrong[0]}: found {given[wrong[0]]!r}, expected no such option{more}")
    if steering is None:
        return {side: dict(throttle) for side in COMMANDS}
    if "unit" in steering and "unit" not in throttle:
        unit = f"{STEERING}.unit: found {steering['unit']!r} without {THROTTLE}.unit"
        raise ConfigError(f"{unit}, expected both: name the throttle's, too")
    same = {key: value for key, value in throttle.items() if key not in PER_NAME}
    defaults = {"field": None, "unit": throttle.get("unit", "1"), "zero": 0.0, "span": 1.0}
    rows = {
        key: [each.get(key, defaults.get(key)) for each in (throttle, steering)]
        for key in PER_NAME
        if key in throttle or key in steering
    }
    if len(set(rows.get("unit", ()))) == 1:
        rows["unit"] = rows["unit"][0]
    return {side: {**same, **rows, "weight": [1.0, sign]} for side, sign in zip(COMMANDS, (1.0, -1.0), strict=True)}


def listed(value: Any) -> list | None:
    """A list or tuple as a list; None for anything else, also for text."""
    return list(value) if isinstance(value, Sequence) and not isinstance(value, str) else None


def parts_of(sources: Mapping[str, Source | Mix]) -> dict[str, Source]:
    """What a reader is asked for: each source, those of a mix under names such as "command_left[0]"."""
    parts: dict[str, Source] = {}
    for name, source in sources.items():
        if isinstance(source, Mix):
            parts |= {f"{name}[{k}]": part for k, part in enumerate(source.parts)}
        else:
            parts[name] = source
    return parts


def mixed(
    sources: Mapping[str, Source | Mix], channels: Mapping[str, Channel], dropped: Mapping[str, dict[str, int]]
) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
    """The channels of the sources, and the counts of what was dropped, from those of `parts_of`."""
    combined, counts = {}, {}
    for name, source in sources.items():
        if not isinstance(source, Mix):
            combined[name], counts[name] = channels[name], dropped[name]
            continue
        names = [f"{name}[{k}]" for k in range(len(source.parts))]
        combined[name], alone = mix([channels[each] for each in names], source.weights)
        total = {"alone": alone} if alone else {}
        for each in names:
            for cause, count in dropped[each].items():
                total[cause] = total.get(cause, 0) + count
        counts[name] = total
    return combined, counts


def mix(parts: Sequence[Channel], weights: Sequence[float]) -> tuple[Channel, int]:
    """The weighted sum of channels, at each of their messages, from the latest value of each; and how many are dropped.

    Values that stand at one place of the log (one row, one message) make one. A message is dropped while another part
    has no value yet, or only one that is older than its staleness window, unless it is held.
    """
    first = parts[0]
    order, last = np.unique(np.concatenate([part.order for part in parts]), return_inverse=True)
    value, time = np.zeros(len(order)), np.full(len(order), -np.inf)
    latest: list[np.ndarray] = []  # of each part, the time of its last message, s,
    windows: list[np.ndarray] = []  # and the window of that
    known = np.ones(len(order), dtype=bool)
    begin = 0
    for part, weight in zip(parts, weights, strict=True):
        indices = last[begin : begin + len(part.order)]
        begin += len(indices)
        place = np.full(len(order), -1)
        np.maximum.at(place, indices, np.arange(len(indices)))
        has = place >= 0
        place = np.maximum.accumulate(place)
        known &= place >= 0
        value += weight * part.value[place]
        latest.append(part.time[place])
        windows.append(_windows(part)[place])
        time = np.where(has, np.maximum(time, part.time[place]), time)
    recent = np.all([time - since <= window for since, window in zip(latest, windows, strict=True)], axis=0)
    keep = known & recent
    value, most = value[keep], sum(map(abs, weights))
    if most > 1 + TOLERANCE:
        value = np.where(np.abs(value) <= LIMIT * most, np.clip(value, -1.0, 1.0), value)  # nonsense stays as it is
    return first._replace(time=time[keep], value=value, order=order[keep]), int((~keep).sum())


def _windows(part: Channel) -> np.ndarray:
    """The window of a part after each of its messages, s."""
    if part.window != AUTO or part.held:
        return np.full(len(part.time), math.inf if part.held else part.window)
    from usvlearn.logs.alignment.window_kernel import windows_after  # numba takes a moment to import

    return windows_after(np.ascontiguousarray(part.time, np.float64))


class LiveMix:
    """`mix` of messages that come one by one, each at a place of its own."""

    def __init__(self, given: Mix):
        self._weights, self._most = given.weights, sum(map(abs, given.weights))
        held, window = given.parts[0].held, given.parts[0].window
        self._auto = window == AUTO and not held
        self._windows = [math.inf if held else 0.0 if self._auto else float(window)] * len(given.parts)
        self._last: list[tuple[float, float] | None] = [None] * len(given.parts)
        if self._auto:
            from usvlearn.logs.alignment import window_kernel  # numba takes a moment to import

            self._kernel, self._followed = window_kernel, window_kernel.new_followed(len(given.parts))
            self._kernel.follow(*self._followed, 0, -math.inf)  # compiled now: a boat's first message need not wait
            self._kernel.window_of(*self._followed[1:], 0)

    def push(self, part: int, time: float, value: float) -> float | None:
        """The sum after a message of one part, s and a finite share; None while another part has no recent value."""
        self._last[part] = time, value
        if self._auto:
            self._kernel.follow(*self._followed, part, time)
            self._windows[part] = self._kernel.window_of(*self._followed[1:], part)
        total, recent = 0.0, True
        for last, weight, window in zip(self._last, self._weights, self._windows, strict=True):
            if last is None:
                return None
            total += weight * last[1]
            recent = recent and time - last[0] <= window
        if not recent:
            return None
        if self._most > 1 + TOLERANCE and abs(total) <= LIMIT * self._most:
            return min(max(total, -1.0), 1.0)
        return total
