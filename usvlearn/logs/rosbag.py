"""ROS bags (ROS 1 `.bag`, ROS 2 `.mcap` and `.db3`), read by the package rosbags: no ROS is needed."""

from __future__ import annotations

import fnmatch
import math
import warnings
from collections import defaultdict
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from usvlearn.errors import LogFormatError, MissingExtraError, check_choice, check_positive, printable
from usvlearn.logs.channel import Channel, Source, build_channel, match_name
from usvlearn.logs.decompress import MB, Total, limit_chunks, limited
from usvlearn.logs.rosbag_scan import Scan
from usvlearn.logs.rosbag_types import check_type

CLOCK_LIMIT = 1.0  # s; a header's stamp further from the receipt comes from a clock that was never set


@dataclass(frozen=True)
class Rosbag:
    """Reads a ROS bag. `Source.name` is a topic, `Source.field` a field of its messages.

    A field is a dotted path (`twist.linear.x`; default `data`; a number indexes an array). Several,
    comma-separated, give their Euclidean norm. A quaternion gives its yaw in rad, counter-clockwise about z.

    A ROS 1 bag whose recording crashed (`.bag.active`, cut off, no index) is read as far as possible, with a warning.

    Args:
        clock: `header` takes the stamp in a message's header, and the time of receipt for messages without
            one or with one more than 1 s from the receipt; `receive` always takes the time of receipt.
        chunk_limit: MB that a compressed chunk may unpack to; a bag with a larger one is refused.

    >>> Rosbag().suffixes
    ('.bag', '.active', '.mcap', '.db3')
    >>> Rosbag(clock="gps")
    Traceback (most recent call last):
    usvlearn.errors.ConfigError: data.reader.clock: found 'gps', expected one of header, receive
    """

    clock: str = "header"
    chunk_limit: float = 100.0

    suffixes: ClassVar[tuple[str, ...]] = (".bag", ".active", ".mcap", ".db3")

    def __post_init__(self):
        check_choice("data.reader.clock", self.clock, ("header", "receive"))
        check_positive("data.reader.chunk_limit", self.chunk_limit, "of MB")

    @property
    def _limit(self) -> int:
        """Bytes."""
        return int(MB * self.chunk_limit)

    def read(self, path: Path, sources: dict[str, Source]) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
        """The channels of a bag, and the counts of unusable messages: channel -> cause -> count.

        Args:
            path: the bag.
            sources: channel -> where it is found.

        Raises:
            LogFormatError: the file is no bag, has no readable message, a chunk beyond the limit, or lacks a topic or
                a field.
            MissingExtraError: rosbags is not installed.
        """
        try:
            import apsw  # noqa: F401  # an older rosbags has none, and cannot be limited
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise MissingExtraError("rosbags", "logs", "reading ROS bags") from error
        try:
            latest = get_typestore(Stores.LATEST)
            with limited(path, self._limit), AnyReader([path], default_typestore=latest) as bag:
                if not bag.is2:
                    limit_chunks(path, bag.readers[0], self._limit)
                return self._read(path, bag, sources)
        except LogFormatError:
            raise
        except Exception as error:  # rosbags raises many types for damage, among them AssertionError and OSError
            refusal = error
        return self._recover(path, sources, refusal)

    def _recover(self, path: Path, sources: dict[str, Source], refusal: Exception):
        """As `read`, for a bag that rosbags refuses."""
        what = printable(" ".join(str(refusal).split())[:200].rstrip(".")) or type(refusal).__name__
        if path.suffix == ".active":
            what = "its recording was not closed"
        patterns = [source.name for source in sources.values()]
        bag = Scan(path, lambda topic: any(_may_match(pattern, topic) for pattern in patterns), self._limit)
        if not bag.count:
            raise LogFormatError(
                f"{path}: expected a whole ROS bag, found: {what}; and no message could be recovered from it: "
                "leave it out, or name its reader"
            ) from refusal
        ending = f"it breaks off in the one at byte {bag.end} of {bag.size}" if bag.end < bag.size else "all are whole"
        warnings.warn(
            f"{path}: the index of this bag is missing or damaged ({what}): recovered {bag.count} messages "
            f"from its records; {ending}",
            stacklevel=3,
        )
        return self._read(path, bag, sources)

    def _read(self, path: Path, bag, sources: dict[str, Source]):
        readings: dict[str, list[str]] = defaultdict(list)  # topic -> channels
        for channel, source in sources.items():
            where = f"{path}: data.channels.{channel}.name"
            readings[match_name(source.name, {c.topic for c in bag.connections}, where)].append(channel)

        time: dict[str, list[float]] = {channel: [] for channel in sources}
        value: dict[str, list[float]] = {channel: [] for channel in sources}
        order: dict[str, list[int]] = {channel: [] for channel in sources}
        start, total = bag.start_time, Total(path, self._limit)
        wanted = [connection for connection in bag.connections if connection.topic in readings]
        for connection in wanted:
            check_type(path, connection.msgtype, bag.typestore.fielddefs)
        for number, (connection, received, data) in enumerate(bag.messages(wanted)):
            total.message(data)
            message = bag.deserialize(data, connection.msgtype)
            seconds = (self._stamp(message, received) - start) * 1e-9
            for channel in readings[connection.topic]:
                where = f"{path}: data.channels.{channel}.field"
                time[channel].append(seconds)
                value[channel].append(_read_field(message, sources[channel].field or "data", where))
                order[channel].append(number)

        channels, dropped = {}, {}
        for channel, source in sources.items():
            stamps, raw = np.array(time[channel], float), np.array(value[channel], float)
            channels[channel], dropped[channel] = build_channel(
                f"{path}: {channel}", source, stamps, raw, order[channel]
            )
        return channels, dropped

    def _stamp(self, message, received: int) -> int:
        """Nanoseconds since 1970."""
        clock: Any = getattr(getattr(message, "header", None), "stamp", None)
        if self.clock == "receive" or not hasattr(clock, "nanosec"):
            return received
        stamp = clock.sec * 10**9 + clock.nanosec
        return stamp if abs(stamp - received) <= CLOCK_LIMIT * 1e9 else received


def _may_match(pattern: str, topic: str) -> bool:
    """Whether `match_name` can choose this topic."""
    return topic.lstrip("/") == pattern.lstrip("/") or fnmatch.fnmatchcase(topic, pattern)


def _read_field(message, field: str, where: str) -> float:
    """The number at a dotted path, or the norm of several."""
    if "," not in field:
        return _read_one(message, field.strip(), where)
    return math.hypot(*(_read_one(message, part.strip(), where) for part in field.split(",")))


def _read_one(message, field: str, where: str) -> float:
    value: Any = message
    for step in field.split("."):
        if step.isdigit() and hasattr(value, "__len__") and int(step) < len(value):
            value = value[int(step)]
        elif is_dataclass(value) and hasattr(value, step):
            value = getattr(value, step)
        else:
            raise LogFormatError(f"{where}: no field {step!r} in {field!r}. {_listing(value)}")
    if all(hasattr(value, axis) for axis in "xyzw"):
        return yaw(value.x, value.y, value.z, value.w)
    try:
        return float(value)
    except (TypeError, ValueError):
        raise LogFormatError(f"{where}: expected a number in {field!r}. {_listing(value)}") from None


def _listing(value) -> str:
    if not is_dataclass(value):
        return f"It holds {type(value).__name__} {str(value)[:40]!r}: name a field that is a number"
    names = ", ".join(item.name for item in fields(value) if not item.name.startswith("__"))
    return f"The fields here are: {names or 'none'}; name one of them"


def yaw(x: float, y: float, z: float, w: float) -> float:
    """Yaw of a quaternion of any length, rad, counter-clockwise about z; NaN for the zero quaternion.

    psi = atan2(2 (w z + x y), w^2 + x^2 - y^2 - z^2)

    >>> round(yaw(0.0, 0.0, 2.0, 2.0), 6)
    1.570796
    """
    if not (x or y or z or w):
        return math.nan
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
