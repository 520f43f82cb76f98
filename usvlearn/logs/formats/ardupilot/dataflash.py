"""ArduPilot's DataFlash logs (`.BIN`): binary messages, described by the messages FMT, FMTU, UNIT and MULT of the log.

A message is 0xA3, 0x95, its type, and its fields without padding, the lowest byte first. FMT gives the length, name,
format letters and field names of a type; https://ardupilot.org/dev/docs/code-overview-adding-a-new-log-message.html.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np

from usvlearn.errors import LogFormatError
from usvlearn.logs.formats.ardupilot.servos import OUTPUTS, Servos, last_and_former
from usvlearn.logs.formats.messages import Field, Key, MessageLog, MessageReader, Messages, Vehicle

LETTERS = {  # of a format: the type, and what it is divided by
    "b": ("i1", 1), "B": ("u1", 1), "h": ("<i2", 1), "H": ("<u2", 1), "i": ("<i4", 1), "I": ("<u4", 1),
    "q": ("<i8", 1), "Q": ("<u8", 1), "g": ("<f2", 1), "f": ("<f4", 1), "d": ("<f8", 1), "M": ("u1", 1),
    "n": ("S4", 1), "N": ("S16", 1), "Z": ("S64", 1), "a": ("S64", 1),  # a: 32 numbers, too many for a series
    "c": ("<i2", 100), "C": ("<u2", 100), "e": ("<i4", 100), "E": ("<u4", 100), "L": ("<i4", 1e7),
}  # fmt: skip
PREFIXES = {1e-1: "d", 1e-2: "c", 1e-3: "m", 1e-6: "µ", 1e-9: "n"}  # of a unit
STAMPS = ("TimeUS", "TimeMS")  # since boot; logs before 2015 have the latter
PLAIN = {"degheading": "deg", "deglatitude": "deg", "deglongitude": "deg", "UNKNOWN": ""}  # units of UNIT messages
KINDS = {"Name": "S", "Label": "S", "UnitIds": "S", "MultIds": "S", "Id": "iu", "FmtType": "iu"}  # others: numbers
ARMING = {"ARM": ("ArmState", {1: True, 0: False}), "EV": ("Id", {10: True, 11: False})}  # messages, field, values
NAME = re.compile(r"\w+", re.ASCII)
FMT = b"\x80\x59FMT\0" + b"BBnNZ".ljust(16, b"\0") + b"Type,Length,Name,Format,Columns".ljust(64, b"\0")
GPS_EPOCH, WEEK = 315964800, 604800  # s since 1970; s
SERVOS = Servos(OUTPUTS[:3], "C(?:h|han)?{n}")


@dataclass(frozen=True)
class DataFlash(MessageReader):
    """Reads an ArduPilot log. `Source.name` is a message such as `ATT`, `Source.field` one of its fields such as `Yaw`.

    `IMU[1]` is the second of several sensors, `IMU` the first. Several fields, comma-separated, give their Euclidean
    norm. Numbers are scaled by the letters of their format: `c` holds hundredths, `L` holds 1e-7 degrees. Time is
    TimeUS, or TimeMS in old logs.

    `RCOU` has the further fields `throttle_left`, `throttle_right`, `throttle` and `steering`: the pulse width of the
    servo whose SERVOn_FUNCTION is 73, 74, 70 or 26, as a share of full scale by its MIN, TRIM, MAX and REVERSED. These
    parameters are the last in the log.

    Damaged parts are skipped with a warning.

    Args:
        disarmed: `drop` leaves out all servo outputs while the vehicle is disarmed, and counts them as `disarmed`, so
            that nothing is learned while it is towed or carried; `keep` takes them.

    Raises:
        ConfigError: `disarmed` is neither `drop` nor `keep`.

    >>> DataFlash().suffixes
    ('.bin',)
    >>> DataFlash(disarmed="zero")
    Traceback (most recent call last):
    usvlearn.errors.ConfigError: data.reader.disarmed: found 'zero', expected one of drop, keep
    """

    what: ClassVar[str] = "DataFlash"
    suffixes: ClassVar[tuple[str, ...]] = (".bin",)
    left_out: ClassVar[tuple[str, ...]] = ("FMT", "FMTU", "UNIT", "MULT", "PARM")

    def _messages(self, path: Path, data: np.ndarray) -> MessageLog:
        from usvlearn.logs.formats.ardupilot import binary_kernel as compiled

        sizes = np.zeros(256, dtype=np.int64)
        for letter, (kind, _) in LETTERS.items():
            sizes[ord(letter)] = np.dtype(kind).itemsize
        places, kinds, described, skipped = compiled.scan_dataflash(data, sizes)
        if not kinds.any():
            raise LogFormatError(
                f"{path}: expected an ArduPilot DataFlash log, found no message that an FMT message describes: choose "
                "the data option that fits this file"
            )
        texts = (data[place + 3 : place + 3 + len(FMT)].tobytes() for place in described[1:])
        layouts = [_layout(FMT), *map(_layout, texts)]
        time = compiled.dataflash_stamps(data, places, kinds, *_stamps(layouts))
        seconds = (time - time[0]) * 1e-6
        ends = np.cumsum(np.bincount(kinds, minlength=len(layouts)))
        pairs = []
        for layout, rows in zip(layouts, np.split(np.argsort(kinds, kind="stable"), ends[:-1]), strict=True):
            if len(rows) and layout.name:
                lengths = np.full(len(rows), layout.size, dtype=np.uint8)
                pairs.append((layout, Messages(layout.fields, places[rows] + 3, lengths, seconds[rows], rows)))
        fixes = [each for each in _rows(data, pairs, "GPS", "TimeUS", "GWk", "GMS") if each[1]]
        starts = [GPS_EPOCH + WEEK * week + ms / 1e3 - (us - int(time[0])) * 1e-6 for us, week, ms in fixes]
        start = float(np.median(starts)) if starts else math.nan
        return MessageLog(path, data, _by_key(data, pairs), SERVOS, {"": _vehicle(data, pairs)}, ("",), skipped, start)


class Layout(NamedTuple):
    """What an FMT message says about a type."""

    kind: int  # the type
    size: int  # bytes of the payload
    name: str
    fields: dict[str, Field]
    stamp: str | None  # the field that tells when a message was logged


def _layout(fmt: bytes) -> Layout:
    """The layout that the payload of an FMT message describes; with an empty name if it has no legal one."""
    name, letters, columns = (_text(fmt[start:end]) for start, end in ((2, 6), (6, 22), (22, 86)))
    fields, offset = {}, 0
    for letter, column in zip(letters, columns.split(","), strict=False):
        dtype, divisor = LETTERS[letter]
        if column.strip():
            fields[column.strip()] = Field(offset, dtype, divisor)
        offset += np.dtype(dtype).itemsize
    stamp = "T" if {"T", "Week"} <= set(fields) else next((each for each in STAMPS if each in fields), None)  # old GPS
    if stamp and fields[stamp].dtype not in ("<u4", "<u8", "<i8"):
        stamp = None
    return Layout(fmt[0], fmt[1] - 3, name if NAME.fullmatch(name) else "", fields, stamp)


def _text(raw: bytes) -> str:
    return raw.split(b"\0")[0].decode("utf-8", "replace")


def _stamps(layouts: list[Layout]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offset of the stamp from the message's start, its bytes, and us in its unit, for each layout."""
    rows = [
        (3 + where.offset, np.dtype(where.dtype).itemsize, 1 if layout.stamp == "TimeUS" else 1000)
        if layout.stamp and (where := layout.fields[layout.stamp])
        else (-1, 0, 0)
        for layout in layouts
    ]
    offsets, widths, factors = np.array(rows).T.copy()
    return offsets, widths, factors


def _rows(data: np.ndarray, pairs: list[tuple[Layout, Messages]], name: str, *columns: str) -> Iterator[tuple]:
    """The values of some fields of the messages of one name, where they are of the type that ArduPilot gives them."""
    for layout, messages in pairs:
        kinds = {field: np.dtype(where.dtype).kind for field, where in layout.fields.items()}
        if layout.name == name and all(kinds.get(column, "?") in KINDS.get(column, "iuf") for column in columns):
            values = [messages.column(data, column).tolist() for column in columns]
            yield from zip(*values, strict=True)


def _by_key(data: np.ndarray, pairs: list[tuple[Layout, Messages]]) -> dict[Key, list[Messages]]:
    """The messages by name and instance, their fields with units and without stamp and instance."""
    labels = {number & 255: _text(label) for number, label in _rows(data, pairs, "UNIT", "Id", "Label")}
    factors = {number & 255: factor for number, factor in _rows(data, pairs, "MULT", "Id", "Mult")}
    ids = {kind: (units, mults) for kind, units, mults in _rows(data, pairs, "FMTU", "FmtType", "UnitIds", "MultIds")}
    messages: dict[Key, list[Messages]] = {}
    for layout, all_of_them in pairs:
        units, mults = ids.get(layout.kind, (b"", b""))
        instance = _instance(layout, units)
        fields = {}
        for place, (name, where) in enumerate(layout.fields.items()):
            if name not in (layout.stamp, instance):
                label = labels.get(units[place], "") if place < len(units) else ""
                factor = factors.get(mults[place], 1.0) if place < len(mults) and where.divisor == 1 else 1.0
                fields[name] = where._replace(unit=_unit(label, factor))
        for number, part in all_of_them.split(data, instance):
            messages.setdefault(Key(layout.name, number), []).append(part._replace(fields=fields))
    return messages


def _instance(layout: Layout, units: bytes) -> str | None:
    """The field that numbers several equal sensors, if there is one: FMTU says so, or else its name does."""
    names = list(layout.fields)
    if units:
        place = units.find(b"#")
        name = names[place] if 0 <= place < len(names) else None
    else:
        core = "C" if layout.name[:2] in ("XK", "NK") else "I"
        name = next((each for each in ("I", "Instance", core) if each in names), None)
    return name if name and layout.fields[name].dtype in ("u1", "i1") else None


def _unit(label: str, factor: float) -> str:
    """A unit with the prefix of its factor."""
    label, factor = PLAIN.get(label, label), float(f"{factor:.6g}")  # the log's doubles were computed as floats
    if not label or factor in (0.0, 1.0):
        return label
    return f"{PREFIXES[factor]}{label}" if factor in PREFIXES else f"{factor:.4g} {label}"


def _vehicle(data: np.ndarray, pairs: list[tuple[Layout, Messages]]) -> Vehicle:
    """The last parameters, and when the vehicle was armed: before the first change it was the opposite.

    A log without a change counts as armed: by default ArduPilot logs only then.
    """
    rows = ((_text(name), value) for name, value in _rows(data, pairs, "PARM", "Name", "Value"))
    parameters, former = last_and_former(rows)
    for name, (column, meaning) in ARMING.items():
        states = {
            order: meaning[value]
            for layout, messages in pairs
            if layout.name == name and column in layout.fields
            for order, value in zip(messages.order.tolist(), messages.column(data, column).tolist(), strict=True)
            if value in meaning
        }
        if states:
            order = sorted(states)
            armed = [not states[order[0]], *(states[each] for each in order)]
            return Vehicle(parameters, np.array([-1, *order]), np.array(armed), former)
    return Vehicle(parameters, former=former)
