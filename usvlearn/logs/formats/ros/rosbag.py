"""ROS bags (ROS 1 `.bag`, ROS 2 `.mcap` and `.db3`), read by the package rosbags: no ROS is needed."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from usvlearn.errors import LogFormatError, MissingExtraError, check_choice, check_positive, printable
from usvlearn.logs.channels.channel import Channel, Source, build_channel, match_name, matching
from usvlearn.logs.channels.series import ELEMENTS, Reader, Series
from usvlearn.logs.formats.ros.limits import MB, Total, check_type, limit_chunks, limited
from usvlearn.logs.formats.ros.message_fields import (
    CLOCK,
    CLOCKS,
    Collected,
    Heard,
    default_field,
    find_clock,
    has_stamp,
    read_field,
)
from usvlearn.logs.formats.ros.rosbag_scan import Scan, joined_journals

LARGE = 1 << 16  # bytes of a message that a survey looks into
OF_ROS = "rosout", "rosout_agg", "parameter_events"  # topics that nobody misses
SHOWN = 10  # topics that are skipped for one reason
IMAGES = {f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "PointCloud", "PointCloud2", "LaserScan")}
Found = TypeVar("Found")


@dataclass(frozen=True)
class Rosbag(Reader):
    """Reads a ROS bag. `Source.name` is a topic, `Source.field` a field of its messages.

    A field is a dotted path (`twist.linear.x`; a number indexes an array). By default it is that of `default_field`:
    in an Odometry, an Imu or a TwistStamped the channel's own, else `data`. Several, comma-separated, give their
    Euclidean norm. A quaternion gives its yaw in rad, counter-clockwise about z.

    A folder with the `metadata.yaml` of a ROS 2 bag is one log, of all its files. If fewer messages are found than the
    bag announces, its files are read without their metadata; a warning tells what is still missing.

    A ROS 1 bag whose recording crashed (`.bag.active`, cut off, no index) is read as far as possible, with a warning.

    Args:
        clock: `header` takes the stamp in a message's header, and the time of receipt for messages without
            one or with one more than 1 s from the receipt. If the stamps are of simulated time, which has another rate,
            the receipts are mapped to it, with a warning. `receive` always takes the time of receipt.
        chunk_limit: MB (10⁶ bytes) that a compressed chunk may unpack to; a bag with a larger one is refused.

    Raises:
        ConfigError: another clock, or a limit that is not positive.

    >>> Rosbag().suffixes
    ('.bag', '.active', '.mcap', '.db3')
    >>> Rosbag(clock="gps")
    Traceback (most recent call last):
    usvlearn.errors.ConfigError: data.reader.clock: found 'gps', expected one of header, receive
    """

    clock: str = "header"
    chunk_limit: float = 100.0

    marker: ClassVar[tuple[str, bytes]] = ("metadata.yaml", b"rosbag2_bagfile_information")
    suffixes: ClassVar[tuple[str, ...]] = (".bag", ".active", ".mcap", ".db3")

    def __post_init__(self):
        check_choice("data.reader.clock", self.clock, CLOCKS)
        check_positive("data.reader.chunk_limit", self.chunk_limit, "of MB")

    @property
    def _limit(self) -> int:
        """Bytes."""
        return int(MB * self.chunk_limit)

    def read(self, path: Path, sources: dict[str, Source]) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
        patterns = [source.name for source in sources.values()]

        def keep(topic: str, msgtype: str) -> bool:
            return msgtype == CLOCK or any(matching(pattern, [topic]) for pattern in patterns)

        return self._open(path, keep, lambda bag: self._read(path, bag, sources))

    def survey(self, path: Path) -> list[Series]:
        return self._open(path, lambda topic, msgtype: msgtype not in IMAGES, lambda bag: self._survey(path, bag))

    def _open(self, path: Path, keep: Callable[[str, str], bool], use: Callable[[Any], Found]) -> Found:
        """What `use` makes of an open bag; `keep` tells which topics and types it needs."""
        try:
            import apsw  # noqa: F401  # an older rosbags has none, and cannot be limited
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise MissingExtraError("rosbags", "logs", "reading ROS bags") from error
        latest, attempts = get_typestore(Stores.LATEST), [[path]]
        files = sorted(each for each in path.iterdir() if each.suffix in self.suffixes) if path.is_dir() else [path]
        refusal: Exception = LogFormatError("no file of a bag")
        with joined_journals(files) as joined:
            if joined != [path]:  # of a folder, whose metadata may name the topics otherwise than its files do
                attempts = [[path]] * (joined == files) + [joined]
            for paths in filter(None, attempts):
                try:
                    with limited(path, self._limit), AnyReader(paths, default_typestore=latest) as bag:
                        if not bag.is2:
                            limit_chunks(path, bag.readers[0], self._limit)
                        return use(_Counted(path, bag, refuse=paths is not attempts[-1]))
                except (LogFormatError, Warning):
                    raise
                except Exception as error:  # rosbags raises many types for damage, among them OSError
                    refusal = error
        return use(self._recovered(path, keep, refusal))

    def _recovered(self, path: Path, keep: Callable[[str, str], bool], refusal: Exception) -> Scan:
        """A bag that rosbags refuses, as far as it can be read."""
        what = printable(" ".join(str(refusal).split())[:200].rstrip(".")) or type(refusal).__name__
        if path.suffix == ".active":
            what = "its recording was not closed"
        bag = Scan(path, keep, self._limit)
        if not bag.count:
            way = f"try `sqlite3 {path.name} .recover | sqlite3 new.db3`, or " if path.suffix == ".db3" else ""
            raise LogFormatError(
                f"{path}: expected a whole ROS bag, found: {what}; and no message could be recovered from it: "
                f"{way}leave it out, or name its reader"
            ) from refusal
        ending = f"it breaks off in the one at byte {bag.end} of {bag.size}" if bag.end < bag.size else "all are whole"
        recovered = f"recovered {bag.count} messages of {(bag.end_time - bag.start_time) * 1e-9:.4g} s from its records"
        sentence = f"{path}: the index of this bag is missing or damaged ({what}): {recovered}; {ending}"
        warnings.warn(sentence, stacklevel=4)
        return bag

    def _read(self, path: Path, bag, sources: dict[str, Source]):
        matched = {}  # channel -> topic
        for channel, source in sources.items():
            where = f"{path}: data.channels.{channel}.name"
            matched[channel] = match_name(source.name, {c.topic for c in bag.connections}, where)
        wanted = [each for each in bag.connections if each.topic in matched.values()]
        for each in wanted:
            check_type(path, each.msgtype, bag.typestore.fielddefs)
        others = [each for each in bag.connections if each.msgtype not in IMAGES and has_stamp(bag, each.msgtype)]
        others = [each for each in others if each.topic not in matched.values() and self.clock == "header"]
        heard = {each.topic: Heard(bag, each.topic, each.msgtype) for each in (*wanted, *others)}
        value: dict[str, list[float]] = {channel: [] for channel in sources}
        total = Total(path, self._limit)
        for number, (connection, received, data) in enumerate(bag.messages([*wanted, *others])):
            heard[connection.topic].add(number, received, data)
            readers = [channel for channel, topic in matched.items() if topic == connection.topic]
            if not readers:
                continue
            total.message(data)
            message = bag.deserialize(data, connection.msgtype)
            for channel in readers:
                field = sources[channel].field or default_field(connection.msgtype, channel)
                value[channel].append(read_field(message, field, f"{path}: data.channels.{channel}.field"))

        seconds, start = self._seconds(path, bag, list(heard.values()))
        channels, dropped = {}, {}
        for channel, topic in matched.items():
            raw, order = np.array(value[channel], float), heard[topic].order.tolist()
            channels[channel], dropped[channel] = build_channel(
                f"{path}: {channel}", sources[channel], seconds[topic], raw, order, start=start
            )
        return channels, dropped

    def _seconds(self, path: Path, bag, heard: list[Heard]) -> tuple[dict[str, np.ndarray], float]:
        """The times of all messages by topic, s since the start of the bag, and this; warns if they are simulated."""
        receive = self.clock == "receive"
        clock, sentence = find_clock([] if receive else heard)
        if sentence:
            warnings.warn(f"{path}: {sentence}", stacklevel=6)
        seconds = {each.topic: each.seconds(bag.start_time, clock, receive) for each in heard}
        return seconds, math.nan if clock else bag.start_time * 1e-9

    def _survey(self, path: Path, bag) -> list[Series]:
        topics: dict[str, Collected] = {}
        wanted = [each for each in bag.connections if each.msgtype not in IMAGES]
        unread = {each.topic: why for each in wanted if (why := _unreadable(path, bag, each))}
        heard = {each.topic: Heard(bag, each.topic, each.msgtype) for each in wanted}
        total = Total(path, self._limit)
        readable = [each for each in wanted if each.topic not in unread]
        for number, (connection, received, data) in enumerate(bag.messages(readable)):
            topic = connection.topic
            if topic in unread:
                continue
            total.add(len(data))
            try:
                message = bag.deserialize(data, connection.msgtype) if len(data) <= LARGE else None
            except Exception:  # damaged: another topic may be whole
                message = None
            if message is None:
                unread[topic] = "a message is damaged" if len(data) <= LARGE else f"a message has {len(data)} bytes"
                continue
            heard[topic].add(number, received, data)
            topics.setdefault(topic, Collected(topic, connection.msgtype)).add(number, message)
        for each in wanted:
            if each.topic not in topics:
                unread.setdefault(each.topic, "no message is in the bag")
            elif not topics[each.topic].values and each.msgtype != CLOCK:
                unread[each.topic] = f"no numbers are in the messages, or more than {ELEMENTS} in a row"
        named = [each for each in wanted if each.topic.rpartition("/")[2] not in OF_ROS]
        for why in dict.fromkeys(unread[each.topic] for each in named if each.topic in unread):
            names = [f"{each.topic} ({each.msgtype})" for each in named if unread.get(each.topic) == why]
            names[SHOWN:] = [f"{len(names) - SHOWN} more"] * (len(names) > SHOWN)
            are = "is" if len(names) == 1 else "are"
            warnings.warn(f"{path}: {', '.join(names)} {are} skipped, since {why}", stacklevel=5)
        seconds, _ = self._seconds(path, bag, [heard[topic] for topic in topics if topic not in unread])
        return [series for topic in sorted(seconds) for series in topics[topic].series(seconds[topic])]


class _Counted:
    """An open bag of rosbags whose messages are counted: if it has fewer than it announces, it is refused, or warns."""

    def __init__(self, path: Path, bag: Any, refuse: bool):
        self.connections, self.typestore, self.deserialize = bag.connections, bag.typestore, bag.deserialize
        self.start_time, self.is2 = bag.start_time, bag.is2
        self._path, self._bag, self._refuse = path, bag, refuse

    def messages(self, wanted: list[Any]) -> Iterator[tuple[Any, int, bytes]]:
        announced, count = sum(connection.msgcount for connection in wanted), 0
        for message in self._bag.messages(wanted) if wanted else ():
            count += 1
            yield message
        if count < announced:
            text = f"{self._path}: found {count} of the {announced} messages that this bag announces: its files or "
            text += "its metadata are damaged"
            if self._refuse:
                raise ValueError(text)
            warnings.warn(text, stacklevel=6)


def _unreadable(path: Path, bag, connection) -> str:
    """Why the messages of a connection cannot be read, or ""."""
    try:
        check_type(path, connection.msgtype, bag.typestore.fielddefs)
    except LogFormatError as error:
        return str(error).removeprefix(f"{path}: ")
    return ""
