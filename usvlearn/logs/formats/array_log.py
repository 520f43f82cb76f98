"""A log that a program holds as arrays: NumPy arrays, lists, a dictionary of them, or a table such as pandas makes.

A value that is NaN means that the channel had no message at that time.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Container, Mapping, MutableMapping
from dataclasses import dataclass
from datetime import UTC
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from usvlearn.errors import ConfigError, did_you_mean
from usvlearn.logs.channels.channel import (
    AUTO,
    AUXILIARY,
    CHANNELS,
    REQUIRED,
    SURGE,
    Channel,
    Recording,
    Source,
    build_channel,
    match_name,
)
from usvlearn.logs.channels.derived_surge import PAIRS_TOLD, pair_of
from usvlearn.logs.channels.repeated_values import settle_period
from usvlearn.logs.channels.series import Series
from usvlearn.logs.formats.csv.stamps import TIME_UNITS, spread, unwrapped
from usvlearn.logs.read import recordings_of, sources_of

TIME, BOAT = "time", "boat"
NAMES = (TIME, *CHANNELS, *AUXILIARY)
FASTEST, SLOWEST = 1e-3, 5.0  # s, between stamps that are taken for a log of a boat
FALLING = 0.5  # share of the stamps that are earlier than the one before, at most


def arrays_among(given: Any, settings: MutableMapping[str, Any]) -> dict[str, Any] | None:
    """The arrays among the arguments of `usvlearn.read`, by name; None if it was given a path, or nothing.

    The settings are the keywords; those that are arrays are taken out.
    """
    arrays = {name: settings.pop(name) for name in NAMES if name in settings}
    if isinstance(given, str | os.PathLike):
        if arrays:
            raise ConfigError(f"{', '.join(arrays)}: found values beside a path, expected either of them")
        return None
    if hasattr(given, "columns") and hasattr(given, "__getitem__"):
        table = {str(name): given[name] for name in given.columns}
        index = getattr(given, "index", None)
        if TIME not in table and TIME not in arrays and getattr(index, "name", None) == TIME:
            table[TIME] = index
    elif isinstance(given, Mapping) and not all(isinstance(each, str | os.PathLike) for each in given.values()):
        table = {str(name): each for name, each in given.items()}
    elif given is None or isinstance(given, Mapping):
        table = {}
    else:
        raise ConfigError(
            f"path: found {described(given)}, expected a path, a pattern, a dictionary of boat: path, or arrays by "
            "name (time=…, surge=…)"
        )
    if isinstance(column := arrays.get(TIME), str):
        if column not in table:
            raise ConfigError(f"time: found {column!r}, expected a column{did_you_mean(column, table)}")
        arrays[TIME] = table.pop(column)
    return {name: each for name, each in (table | arrays).items() if each is not None} or None


def described(value: Any) -> str:
    """What a value is, in words: never its numbers."""
    kind = type(value).__name__
    shape = getattr(value, "shape", None)
    return f"{kind} of shape {tuple(shape)}" if isinstance(shape, tuple) else kind


def channels_of_arrays(
    columns: Mapping[str, Any], channels: Mapping[str, Mapping[str, Any] | None] | None, units: Mapping[str, str] | None
) -> tuple[Arrays, dict[str, dict[str, Any]]]:
    """Arrays as a log, and the description of its channels, as of `usvlearn.logs.read.read_recordings`.

    Keys of channels count where they differ from its own name, SI units and automatic windows. A ConfigError if an
    array is missing, of another length, or holds something else than numbers.
    """
    units, asked = dict(units or {}), {name: dict(keys or {}) for name, keys in (channels or {}).items()}
    for name in units:
        if name not in NAMES:
            raise ConfigError(f"units: found {name!r}, expected one of {', '.join(NAMES)}{did_you_mean(name, NAMES)}")
    unit = units.get(TIME, "s")
    if unit not in TIME_UNITS:
        raise ConfigError(f"units.time: found {unit!r}, expected one of {', '.join(TIME_UNITS)}")
    log = Arrays.of(columns, TIME_UNITS[unit], {*NAMES, *(str(keys.get("name")) for keys in asked.values())})
    wanted = {name: asked.get(name, {}) for name in NAMES[1:] if asked.get(name, {}).get("name") or name in log.columns}
    wanted = {name: keys for name, keys in wanted.items() if keys.get("name", name) is not None}
    if missing := [name for name in REQUIRED if name not in wanted and (name != SURGE or pair_of(wanted) is None)]:
        more = f", or {PAIRS_TOLD}" if SURGE in missing else ""
        raise ConfigError(
            f"{missing[0]}: found no such array among {', '.join(list(columns)[:20])}, expected {', '.join(REQUIRED)}"
            f"{more}: give it by this name, or name its column in channels"
        )
    settings: dict[str, dict[str, Any]] = {name: {"name": None} for name in NAMES[1:]}
    settings |= {name: keys for name, keys in asked.items() if name not in NAMES}  # named in an error
    for name, keys in wanted.items():
        period = {"period": AUTO} if name == SURGE else {}
        settings[name] = {"name": name, "unit": units.get(name, "1"), "window": AUTO, **period, **keys}
    return log, settings


def read_arrays(log: Arrays, channels: Mapping[str, Mapping[str, Any]], boat: str | None) -> list[Recording]:
    """The recordings of arrays: several where the stamps jump back."""
    name = BOAT if boat is None else str(boat)
    return settle_period(name, recordings_of(Path("arrays"), log, sources_of(channels), name, "arrays"))


@dataclass(frozen=True, eq=False, repr=False)
class Arrays:
    """Reads channels from arrays."""

    time: np.ndarray
    columns: Mapping[str, np.ndarray]

    suffixes: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def of(cls, given: Mapping[str, Any], unit: float, needed: Container[str] = NAMES) -> Arrays:
        """From what a person gives; `unit` of a number of `time`, s. Other columns of other than numbers are left out.

        A ConfigError if there is no time, or an array that is `needed` is not one of numbers of its length.
        """
        if TIME not in given:
            raise ConfigError(f"time: found no such array among {', '.join(list(given)[:20])}, expected stamps, s")
        time, origin = _stamps(given[TIME], unit)
        columns = {}
        steps = np.diff(time[np.isfinite(time)])
        if len(steps) and (steps < 0).mean() > FALLING:
            raise ConfigError("time: found stamps that fall, expected ones that rise: sort all arrays by time")
        rising = steps[steps > 0]
        if len(rising) and ((step := float(np.median(rising))) < FASTEST / 10 or np.median(steps) > SLOWEST):
            likely = [name for name, size in TIME_UNITS.items() if FASTEST <= step / unit * size <= SLOWEST]
            hint = f"units={{'time': {likely[0 if step > 1 else -1]!r}}}" if likely else "units={'time': …}"
            raise ConfigError(
                f"time: found stamps {step:.3g} s apart, expected {FASTEST:g} to {SLOWEST:g} s: if they do not "
                f"count seconds, give {hint}"
            )
        for name, values in given.items():
            if name == TIME:
                continue
            try:
                column = _numbers(name, values)
                if len(column) != len(time):
                    raise ConfigError(f"{name}: found {len(column)} values, expected {len(time)}, one for each of time")
                columns[name] = column
            except ConfigError:
                if name in needed:
                    raise
        spread_time, rate = spread(time, origin)
        if rate:
            warnings.warn(
                f"arrays: the stamps are whole seconds, with {rate:.3g} values each: the values of a second are spread "
                "evenly within it",
                stacklevel=5,
            )
        return cls(spread_time, columns)

    def read(self, path: Path, sources: dict[str, Source]) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
        """The channels, and the counts of values that are none: channel -> cause -> count."""
        channels, dropped = {}, {}
        for channel, source in sources.items():
            values = self.columns[match_name(source.name, self.columns, f"channels.{channel}.name")]
            channels[channel], dropped[channel] = build_channel(
                channel, source, self.time, values, np.arange(1, len(values) + 1), np.isnan(values), f"{values[0]}"
            )
        return channels, dropped

    def survey(self, path: Path) -> list[Series]:
        """All columns."""
        order = np.arange(1, len(self.time) + 1)
        return [Series(name, None, self.time, values, order) for name, values in self.columns.items()]


def _stamps(given: Any, unit: float) -> tuple[np.ndarray, float]:
    """Seconds since the first stamp, and that one, s; of date-times, durations, or numbers of so many seconds."""
    stamps = _array(TIME, given)
    if stamps.dtype.kind == "O" and any(hasattr(each, "tzinfo") for each in stamps):  # of datetime, or with a zone
        known = [None if each is None or each != each else each for each in stamps]  # without NaT
        given, unit = [each and each.replace(tzinfo=each.tzinfo or UTC).timestamp() for each in known], 1.0
    dates = stamps.dtype.kind in "mM"
    stamps = stamps if dates else unwrapped(_numbers(TIME, given))
    readable = ~np.isnat(stamps) if dates else np.isfinite(stamps)
    if not readable.any():
        raise ConfigError(f"time: found {len(stamps)} values and no finite one, expected stamps")
    first, passed = stamps[readable][0], stamps - stamps[readable][0]
    if dates:  # only what has passed is counted in ns: 64 bits of ns since 1970 end in 2262
        passed, unit = passed.astype("m8[ns]").astype(np.int64), 1e-9
        first = (first - first.dtype.type(0, "s")) / np.timedelta64(1, "ns")
    return np.where(readable, passed, np.nan) * unit, float(first) * unit


def _numbers(name: str, given: Any) -> np.ndarray:
    """Values as float64."""
    array = _array(name, given)
    if array.dtype.kind == "O" and hasattr(given, "to_numpy"):  # a nullable column of pandas
        try:
            array = given.to_numpy(dtype=np.float64, na_value=np.nan)
        except (TypeError, ValueError):
            pass
    if array.dtype.kind == "O" and all(each is None or type(each) in (int, float) for each in array):
        array = array.astype(np.float64)  # None is NaN
    if array.dtype.kind not in "fiu":
        what = {"U": "text", "S": "text", "b": "booleans", "c": "complex numbers", "O": "objects"}.get(array.dtype.kind)
        raise ConfigError(f"{name}: found {what or array.dtype}, expected numbers: convert it with .astype(float)")
    return array.astype(np.float64)


def _array(name: str, given: Any) -> np.ndarray:
    try:
        with warnings.catch_warnings(action="ignore"):
            array = np.asarray(given)
            if np.ma.isMaskedArray(given):
                dates = array.dtype.kind in "mM"
                array = np.ma.filled(
                    given if dates else given.astype(np.float64), array.dtype.type("NaT") if dates else np.nan
                )
    except (TypeError, ValueError, RuntimeError):
        raise ConfigError(f"{name}: found {described(given)}, expected an array of numbers") from None
    array = array.ravel() if array.ndim == 2 and 1 in array.shape else array  # of MATLAB
    if array.ndim != 1:
        raise ConfigError(f"{name}: found an array of shape {array.shape}, expected one dimension: (time,)")
    return array
