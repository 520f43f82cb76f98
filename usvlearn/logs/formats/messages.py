"""A binary log of messages with named fields, as `dataflash` and `tlog` find them: its names and its numbers."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar, NamedTuple

import numpy as np

from usvlearn.errors import LogFormatError, check_choice, did_you_mean, printable
from usvlearn.logs.channels.channel import LISTED, Channel, Source, build_channel, match_name
from usvlearn.logs.channels.series import Reader, Series
from usvlearn.logs.formats.ardupilot.servos import FUNCTIONS, Servos

NAME = re.compile(r"(.+?)(?:\[(\d{1,3})\])?(?:@([^@]*))?")  # NAME, NAME[instance], NAME@sender, NAME[instance]@sender
DISARMED = "drop", "keep"  # what a reader may do with servo outputs while the vehicle is disarmed
SHORT = 300  # bytes; less than that at the end of a log is the message that was being written


class Field(NamedTuple):
    """Where a number stands in a message."""

    offset: int  # bytes from the start of the payload
    dtype: str  # of numpy
    divisor: float = 1.0  # value = number / divisor
    unit: str = ""


class Messages(NamedTuple):
    """All messages of one layout, in the order of the log."""

    fields: dict[str, Field]
    starts: np.ndarray  # (n,) int64, bytes from the start of the file to the payload
    lengths: np.ndarray  # (n,) uint8, bytes of the payload
    time: np.ndarray  # (n,) float64, s since the log's start
    order: np.ndarray  # (n,) int64, number of the message in the log

    def take(self, rows: np.ndarray) -> Messages:
        """Some of them."""
        return self._replace(
            starts=self.starts[rows], lengths=self.lengths[rows], time=self.time[rows], order=self.order[rows]
        )

    def column(self, data: np.ndarray, name: str) -> np.ndarray:
        """A field, `(n,)`, as its type; `data` is the file."""
        from usvlearn.logs.formats.ardupilot.binary_kernel import gather

        where = self.fields[name]
        kind = np.dtype(where.dtype)
        return gather(data, self.starts, self.lengths, where.offset, kind.itemsize).view(kind)[:, 0]

    def numbers(self, data: np.ndarray, name: str) -> np.ndarray:
        """A field in its unit, `(n,)` float64."""
        with np.errstate(all="ignore"):  # damaged numbers may be anything
            return self.column(data, name).astype(np.float64) / self.fields[name].divisor

    def split(self, data: np.ndarray, name: str | None) -> Iterator[tuple[int | None, Messages]]:
        """The messages of each value of a field that numbers equal sensors; None: all, with no number."""
        if name is None:
            yield None, self
            return
        numbers = self.column(data, name)
        for number in np.unique(numbers).tolist():
            yield number, self.take(numbers == number)

    def names(self) -> list[str]:
        """The fields that are numbers."""
        return [name for name, where in self.fields.items() if np.dtype(where.dtype).kind != "S"]


class Key(NamedTuple):
    """What identifies messages of one kind in a log."""

    name: str
    instance: int | None = None  # of several equal sensors
    sender: str = ""  # system.component, where several may send

    def __str__(self) -> str:
        number = "" if self.instance is None else f"[{self.instance}]"
        return f"{self.name}{number}" + (f"@{self.sender}" if self.sender else "")


class Vehicle(NamedTuple):
    """What a log says about the sender of commands."""

    parameters: Mapping[str, float] = MappingProxyType({})
    changes: np.ndarray = np.array([-1])  # (k,) from which messages on
    armed: np.ndarray = np.array([True])  # (k,) it was armed or not
    former: Mapping[str, float] = MappingProxyType({})  # other values that parameters had within the log


@dataclass(frozen=True)
class MessageLog:
    """A log whose messages have been found.

    `preferred` are the senders that a name without one means, where they send it; `start` is s since 1970, if it tells.
    """

    path: Path
    data: np.ndarray  # (bytes,) uint8
    messages: dict[Key, list[Messages]]
    servos: Servos
    vehicles: dict[str, Vehicle] = field(default_factory=dict)
    preferred: Sequence[str] = ("",)
    skipped: Sequence[int] | np.ndarray = (0, 0, 0, 0)  # see `binary_kernel.scan_tlog`
    start: float = math.nan

    def channels(self, sources: dict[str, Source], keep_disarmed: bool):
        """The channels, and the counts of unusable values: see a reader's `read`."""
        channels: dict[str, Channel] = {}
        dropped: dict[str, dict[str, int]] = {}
        for channel, source in sources.items():
            where = f"{self.path}: data.channels.{channel}"
            key = self.find(source.name, f"{where}.name")
            time, raw, order = self.values(key, source.field, f"{where}.field")
            disarmed = 0
            if key.name in self.servos.outputs and not keep_disarmed:
                usable = self.armed(key.sender, order)
                disarmed = int((~usable).sum())
                self._check_disarmed(where, source, disarmed, len(raw))
                time, raw, order = time[usable], raw[usable], order[usable]
            channels[channel], dropped[channel] = build_channel(
                f"{self.path}: {channel}", source, time, raw, order, start=self.start
            )
            if disarmed:
                dropped[channel]["disarmed"] = disarmed
        return channels, dropped

    def _check_disarmed(self, where: str, source: Source, disarmed: int, total: int) -> None:
        if disarmed and source.held:
            raise LogFormatError(
                f"{where}.held: found true, expected false, because the last command before disarming would stay in "
                "force: set it to false, or data.reader.disarmed=keep"
            )
        if disarmed and disarmed == total:
            raise LogFormatError(
                f"{where}.name: found no {source.name} while the vehicle was armed, {total} while it was not: leave "
                "this log out, or set data.reader.disarmed=keep"
            )

    def armed(self, sender: str, order: np.ndarray) -> np.ndarray:
        """Whether a vehicle was armed at these messages, `(n,)` bool."""
        vehicle = self.vehicles.get(sender, Vehicle())
        return vehicle.armed[np.searchsorted(vehicle.changes, order, side="right") - 1]

    def find(self, name: str, where: str) -> Key:
        """The messages that a `Source.name` means; a LogFormatError if there are none, or those of several senders."""
        parts = NAME.fullmatch(name)
        plain, number, sender = parts.groups() if parts else (name, None, None)
        plain = match_name(plain, {key.name for key in self.messages}, where)
        senders = self._senders(plain, sender)
        if len(senders) > 1:
            listed = " or ".join(f"{plain}@{each}" for each in senders[:LISTED])
            raise LogFormatError(f"{where}: {plain!r} comes from {len(senders)} senders: name {listed}")
        keys = [key for key in self.messages if key.name == plain]
        matches = [key for key in keys if key.sender in senders and (number is None or key.instance == int(number))]
        if not matches:
            listed = ", ".join(map(str, keys[:LISTED]))
            raise LogFormatError(f"{where}: no channel {name!r}. The log has: {listed}: name one of them")
        return min(matches, key=lambda key: key.instance or 0)

    def _senders(self, name: str, pattern: str | None = None) -> list[str]:
        """Who sends messages of this name: those of the pattern, or else the preferred ones, or else all."""
        senders = list(dict.fromkeys(key.sender for key in self.messages if key.name == name))
        if pattern is not None:
            return [each for each in senders if fnmatchcase(each, pattern)]
        return [each for each in senders if each in self.preferred] or senders

    def values(self, key: Key, name: str | None, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times in s, values and places in the log of a `Source.field`, `(n,)`; a LogFormatError if there is none."""
        if key.name in self.servos.outputs and name in FUNCTIONS:
            vehicle = self.vehicles.get(key.sender, Vehicle())
            number = self.servos.find(name, vehicle.parameters, where)
            column = self.servos.column(number, self._fields(key))
            if column is None:
                raise LogFormatError(
                    f"{where}: the {name.replace('_', ' ')} is servo {number}, which {key} does not hold: name another "
                    f"of {', '.join(self.servos.outputs)}, or the servo's own column"
                )
            limits = self.servos.limits(number, vehicle.parameters, str(self.path), vehicle.former)
            time, pwm, order = self._joined(key, [column])
            return time, limits.share(pwm), order
        names = [each.strip() for each in (name or "").split(",")]
        for each in names:
            if each not in self._holders[key]:
                fields = self._fields(key)
                problem = f"no field {each[:LISTED]!r}{did_you_mean(each, fields)}." if each else "no field is named."
                sentence = f"{where}: {problem} The fields of {key} are: {', '.join(fields)}; name one of them"
                raise LogFormatError(sentence)
        return self._joined(key, names)

    @cached_property
    def _holders(self) -> dict[Key, dict[str, list[Messages]]]:
        """The layouts of each key that have a number of a name."""
        holders: dict[Key, dict[str, list[Messages]]] = {key: {} for key in self.messages}
        for key, part in ((key, part) for key, parts in self.messages.items() for part in parts):
            for name in part.names():
                holders[key].setdefault(name, []).append(part)
        return holders

    def _fields(self, key: Key) -> list[str]:
        return list(self._holders[key])

    def _joined(self, key: Key, names: list[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """One field, or the norm of several, of all layouts that have them, in the order of the log."""
        parts = [part for part in self._holders[key][names[0]] if set(names) <= set(part.names())]
        values = []
        for part in parts:
            columns = [part.numbers(self.data, name) for name in names]
            with np.errstate(all="ignore"):
                values.append(columns[0] if len(columns) == 1 else np.hypot.reduce(columns))
        if len(parts) == 1:
            return parts[0].time, values[0], parts[0].order
        if not parts:
            return np.empty(0), np.empty(0), np.empty(0, np.int64)
        order = np.concatenate([part.order for part in parts])
        place = np.argsort(order, kind="stable")
        return np.concatenate([part.time for part in parts])[place], np.concatenate(values)[place], order[place]

    def survey(self, left_out: Iterable[str]) -> list[Series]:
        """All numbers, except those of some messages; see `usvlearn.logs.channels.series`."""
        every = []
        if unknown := sum(self.skipped[3:]):
            warnings.warn(f"{self.path}: skipped {unknown} messages of types that are not known", stacklevel=3)
        for key in sorted(self.messages, key=lambda key: min(part.order[0] for part in self.messages[key])):
            if key.name in left_out:
                continue
            plain = key._replace(sender="") if self._senders(key.name) == [key.sender] else key
            units = {name: where.unit for part in self.messages[key] for name, where in part.fields.items()}
            for name in self._fields(key):
                every.append(Series(str(plain), name, *self.values(key, name, str(self.path)), units[name], key.sender))
            for name in FUNCTIONS if key.name in self.servos.outputs else ():
                try:
                    values = self.values(key, name, f"{self.path}: {name}")
                except LogFormatError:  # no servo has this function
                    continue
                vehicle = self.vehicles.get(key.sender, Vehicle())
                number = self.servos.find(name, vehicle.parameters, "")
                known = self.servos.are_known(number, vehicle.parameters, vehicle.former)
                every.append(Series(str(plain), name, *values, "1" if known else "", key.sender))
        return every


_LAST: dict[str, MessageLog] = {}  # of each format: a log is read to find its channels, its vehicle, its numbers


@dataclass(frozen=True)
class MessageReader(Reader):
    """What the readers of an autopilot's logs have in common; `disarmed` is as of `DataFlash`."""

    disarmed: str = "drop"

    what: ClassVar[str]  # the name of the format
    left_out: ClassVar[tuple[str, ...]] = ()  # messages that hold no series

    def __post_init__(self):
        check_choice("data.reader.disarmed", self.disarmed, DISARMED)

    def _messages(self, path: Path, data: np.ndarray) -> MessageLog:
        """The messages in the bytes of a log."""
        raise NotImplementedError

    def read(self, path: Path, sources: dict[str, Source]) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
        return self._log(path).channels(sources, keep_disarmed=self.disarmed == "keep")

    def survey(self, path: Path) -> list[Series]:
        return self._log(path).survey(self.left_out)

    def _log(self, path: Path) -> MessageLog:
        """A log whose messages have been found; warns if it holds bytes that belong to none.

        The last message, which was being written when the power went, does not count, nor does an end of equal bytes.
        """
        data, log = np.fromfile(path, dtype=np.uint8), _LAST.get(self.what)
        if log is None or log.path != path or not np.array_equal(log.data, data):
            from usvlearn.core.jit import announce
            from usvlearn.logs.formats.ardupilot import binary_kernel

            with announce(str(binary_kernel.__file__), "readers of binary logs"):
                log = _LAST[self.what] = self._messages(path, data)
        count, gaps, end = (int(each) for each in log.skipped[:3])
        tail = log.data[end + SHORT :]
        if (tail != tail[:1]).any():
            count, gaps = count + len(log.data) - end, gaps + 1
        if gaps:
            warnings.warn(
                f"{printable(str(path))}: the log is damaged: skipped {count} of {len(log.data)} bytes, in {gaps} "
                f"places, which are no {self.what} message",
                stacklevel=4,
            )
        return log
