"""The parts of a log: channels of stamped numbers in SI units, and their place in a file."""

from __future__ import annotations

import difflib
import fnmatch
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from usvlearn.errors import ConfigError, LogFormatError, check_choice

LISTED, QUOTED = 60, 60  # names in an error, and characters of one
COMMANDS, SURGE = ("command_left", "command_right"), "surge"
CHANNELS = (*COMMANDS, "heading", "yaw_rate", SURGE)
HEMISPHERE = re.compile(r"(\d{1,5}\.\d+) ?°? ?([NSEW])")  # a latitude or a longitude with its letter
EPSILON = 1e-6  # s, below which two stamps are one
SLOWEST = 10.0  # s, the longest period
LEAST_WINDOW, MOST_WINDOW = 0.2, 5.0  # s, of an automatic one: see `usvlearn.logs.alignment.window_kernel`
AUTO = "auto"  # a period that is found from the logs, a window that follows the messages
REQUIRED = ("command_left", "command_right", "heading", "surge")  # yaw_rate can be computed from the heading
VELOCITIES, COURSES = ("velocity_north", "velocity_east"), ("ground_speed", "course")
DEGREES, METRES = ("latitude", "longitude"), ("north", "east")
SWAY = "sway"  # m/s over ground, to starboard
AUXILIARY = (SWAY, *VELOCITIES, *COURSES, *DEGREES, *METRES)  # the surge can be computed from a pair, and tracks judged

FORCES = ("N", "kN", "N·m", "kN·m")
# unit -> (factor, offset): SI value = factor * value + offset
UNITS = {
    "1": (1.0, 0.0), "percent": (0.01, 0.0),
    "m/s": (1.0, 0.0), "km/h": (1 / 3.6, 0.0), "knots": (1852 / 3600, 0.0), "cm/s": (0.01, 0.0), "mm/s": (0.001, 0.0),
    "mph": (0.44704, 0.0), "ft/s": (0.3048, 0.0), "m": (1.0, 0.0),
    "rad": (1.0, 0.0), "deg": (math.pi / 180, 0.0),
    "ddmm": (math.pi / 180, 0.0),  # degrees and minutes in one number, as 4218.5 for 42° 18.5'
    "rad/s": (1.0, 0.0), "deg/s": (math.pi / 180, 0.0), "deg/min": (math.pi / 10800, 0.0),
    "enu_rad": (-1.0, math.pi / 2), "enu_deg": (-math.pi / 180, math.pi / 2),  # yaw from east, counter-clockwise
    "enu_rad/s": (-1.0, 0.0), "enu_deg/s": (-math.pi / 180, 0.0), "enu_deg/min": (-math.pi / 10800, 0.0),
    **dict.fromkeys(FORCES, (1.0, 0.0)),  # a share of the span, which is in the same unit
}  # fmt: skip
SPEEDS, RARE = ("m/s", "km/h", "knots", "cm/s", "mm/s"), ("mph", "ft/s")  # the latter where a log says so
ANGLES = ("rad", "deg", "enu_rad", "enu_deg")
OWN_UNITS = {  # channel -> the units that it may have, beside "1" for SI
    **dict.fromkeys(COMMANDS, ("percent", *FORCES)),
    **dict.fromkeys(("heading", "course"), ANGLES),
    "yaw_rate": ("rad/s", "deg/s", "deg/min", "enu_rad/s", "enu_deg/s", "enu_deg/min"),
    **dict.fromkeys(("surge", SWAY, "ground_speed", *VELOCITIES), (*SPEEDS, *RARE)),
    **dict.fromkeys(DEGREES, ("deg", "rad", "ddmm")),
    **dict.fromkeys(METRES, ("m",)),
}


@dataclass(frozen=True)
class Source:
    """The place of a channel in a log, and the conversion of its numbers to SI units.

    value_SI = factor(unit) * (value - zero) / span, plus the unit's offset.

    Args:
        name: column (CSV), variable (MOOS), topic (ROS) or message; `*` matches anything, as in `*left_thruster`.
        field: field of a message, dotted; several, comma-separated, give their Euclidean norm.
        unit: one of `UNITS`. A command in N or N·m is a share of `span`, the greatest force or moment in that unit.
        zero: raw value that means zero, as the log has it (no unit).
        span: raw distance from zero to full scale (commands) or 1, as the log has it (no unit); a negative one reverses
            a side.
        held: the value stays in force until the next message, however old (commands that are posted only on change).
        window: staleness window, s. "auto": it follows the rate of the messages, see
            `usvlearn.logs.alignment.window_kernel`.
        delay: time from the stamp of a value to its effect on the measured speed, s (thruster and filter lag).
        period: time between two measurements of the speed's sensor, s, where messages come faster than it measures: the
            same number again within two periods is a copy of one measurement. 0: every message is a measurement.
            "auto": found from the logs, see `usvlearn.logs.channels.repeated_values`.
        missing: raw values that mean "unknown", such as [65535]; they count as not a number.

    Raises:
        ConfigError: a unit that is not known, or a number outside its range.

    >>> Source("thr_left", zero=1511, span=-400).convert(np.array([1511.0, 1111.0]))
    array([0., 1.])
    """

    name: str
    field: str | None = None
    unit: str = "1"
    zero: float = 0.0
    span: float = 1.0
    held: bool = False
    window: float | str = 0.2
    delay: float = 0.0
    period: float | str = 0.0
    missing: Sequence[float] = ()

    def __post_init__(self):
        given = (self.missing,) if isinstance(self.missing, int | float) else self.missing
        if not isinstance(given, list | tuple) or not all(isinstance(each, int | float) for each in given):
            raise ConfigError(f"missing: found {given!r}, expected numbers such as [65535]")
        object.__setattr__(self, "missing", [*map(float, given)])  # as JSON has it
        check_choice("unit", self.unit, tuple(UNITS))
        if not math.isfinite(self.span) or self.span == 0:
            raise ConfigError(f"span: found {self.span!r}, expected a number other than 0")
        if not math.isfinite(self.zero):
            raise ConfigError(f"zero: found {self.zero!r}, expected a finite number")
        if self.window != AUTO and not (isinstance(self.window, int | float) and self.window > 0):
            raise ConfigError(f"window: found {self.window!r}, expected a positive time in s, or {AUTO}")
        if not 0 <= self.delay < math.inf:
            raise ConfigError(f"delay: found {self.delay!r}, expected a time of 0 s or more")
        if self.period != AUTO and not (isinstance(self.period, int | float) and 0 <= self.period <= SLOWEST):
            raise ConfigError(f"period: found {self.period!r}, expected a time of 0 to {SLOWEST:g} s, or {AUTO}")

    def convert(self, raw: np.ndarray) -> np.ndarray:
        """Raw values to SI units. What is too large for a number becomes infinite.

        Args:
            raw: as logged, an array of any shape, in `unit`, such as N or °.

        Returns:
            In SI units; shape unchanged.
        """
        factor, offset = UNITS[self.unit]
        if self.unit == "ddmm":
            raw = degrees(raw)
        with np.errstate(over="ignore"):
            return factor * (raw - self.zero) / self.span + offset


class Channel(NamedTuple):
    """One quantity of a log, in the order in which it was logged.

    >>> channel = Channel(time=np.array([0.0, 0.2]), value=np.array([1.1, 1.2]), order=np.array([0, 3]))
    >>> channel.held, channel.delay
    (False, 0.0)
    """

    time: np.ndarray  # (n,) float64, s since the log's start; may run backwards, repeat or be negative
    value: np.ndarray  # (n,) float64, SI units; NaN where the log had no number
    order: np.ndarray  # (n,) int64, place in the log (line, row, message): how channels interleave
    held: bool = False  # stays in force until the next message
    window: float | str = 0.2  # staleness window, s; see `Source`
    delay: float = 0.0  # from a stamp to its effect on the measured speed, s
    period: float | str = 0.0  # between two measurements of the sensor, s; see `Source`
    start: float = math.nan  # of the log, s since 1970, where it tells; earlier ones count from another event


class Recording(NamedTuple):
    """One log of one boat.

    >>> surge = Channel(time=np.array([0.0, 0.2]), value=np.array([1.1, 1.2]), order=np.array([0, 3]))
    >>> Recording("heron", "001", {"surge": surge}, dropped={}).channels["surge"].value
    array([1.1, 1.2])
    """

    boat: str  # its name
    run: str  # its name, within the boat
    channels: dict[str, Channel]  # by the names of `CHANNELS` and `AUXILIARY`
    dropped: dict[str, dict[str, int]]  # channel -> cause -> count of what the reader could not use


def degrees(ddmm: np.ndarray) -> np.ndarray:
    """Degrees and minutes in one number as degrees, shape unchanged."""
    whole = np.trunc(ddmm / 100)
    return whole + (ddmm - 100 * whole) / 60


def match_name(pattern: str, available: Iterable[str], where: str) -> str:
    """The only name in `available` that matches `pattern`, but for a leading slash; else a LogFormatError."""
    names = sorted(set(available))
    matches = matching(pattern, names)
    if len(matches) == 1:
        return matches[0]
    if matches:
        raise LogFormatError(
            f"{where}: channel {pattern!r} matches {_listing(matches)}: name one of them in data.channels"
        )
    close = difflib.get_close_matches(pattern, names, n=3, cutoff=0.5)
    hint = f" Did you mean {' or '.join(name[:QUOTED] for name in close)}?" if close else ""
    raise LogFormatError(
        f"{where}: no channel {pattern!r}.{hint} The log has: {_listing(names) or 'nothing'}: name one of them"
    )


def matching(pattern: str, names: Iterable[str]) -> list[str]:
    """The names that a pattern chooses: those equal to it but for a leading slash, else those that it matches."""
    names = list(names)
    exact = [name for name in names if name.lstrip("/") == pattern.lstrip("/")]
    return exact or [name for name in names if fnmatch.fnmatchcase(name, pattern)]


def _listing(names: Sequence[str]) -> str:
    more = f", and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return ", ".join(name[:QUOTED] for name in names[:LISTED]) + more


def parse_numbers(cells: Sequence[str]) -> np.ndarray:
    """Cells of text as float64, NaN where a cell is not a number."""
    try:
        if "_" not in "".join(cells):
            return np.array(cells, dtype=np.float64)
    except ValueError:  # some cell is not a number: convert one by one
        pass
    return np.array([as_number(cell) for cell in cells], dtype=np.float64)


def as_number(cell: str) -> float:
    """A cell as a number, NaN where it is none; (5) is -5, and 20240603_0915 none, other than for Python itself."""
    text = cell.strip().replace("−", "-")
    text = f"-{text[1:-1]}" if text[:1] == "(" and text[-1:] == ")" else text
    try:
        return float(text) if "_" not in text else math.nan
    except ValueError:
        match = HEMISPHERE.fullmatch(text)
        return (-1 if match[2] in "SW" else 1) * float(match[1]) if match else math.nan


def build_channel(
    where: str,
    source: Source,
    time: np.ndarray,  # (n,) s since the log's start, NaN where the stamp was unreadable
    raw: np.ndarray,  # (n,) values as logged, NaN where there was no number
    order: Sequence[int] | np.ndarray,  # (n,) place in the log
    empty: np.ndarray | None = None,  # (n,) bool, where the log had an empty cell
    first: str | None = None,  # the first value as logged, to quote in an error
    start: float = math.nan,  # of the log; see `Channel`
) -> tuple[Channel, dict[str, int]]:
    """A channel in SI units, and the counts of dropped values, by cause; a LogFormatError if none is left."""
    raw = np.where(np.isin(raw, source.missing), math.nan, raw) if source.missing else raw
    usable = np.isfinite(time) & np.isfinite(raw)
    bare = np.zeros(len(raw), bool) if empty is None else empty & ~usable
    none, late = ~bare & ~np.isfinite(raw), ~bare & np.isfinite(raw) & ~usable
    counts = {"empty": bare.sum(), "not_a_number": none.sum(), "no_time": late.sum()}
    dropped = {cause: int(count) for cause, count in counts.items() if count}
    if not usable.any():
        causes = ", ".join(f"{count} {cause}" for cause, count in dropped.items())
        shown = f" ({causes}; the first is {raw[0] if first is None else first[:QUOTED]!r})" if len(raw) else ""
        raise LogFormatError(
            f"{where}: expected numbers in {source.name!r}, found none among its {len(raw)} values{shown}: "
            "name another source, or leave this log out"
        )
    places = np.asarray(order, dtype=np.int64)[usable]
    how = source.held, source.window, source.delay, source.period
    return Channel(time[usable], source.convert(raw[usable]), places, *how, start), dropped
