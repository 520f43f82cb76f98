"""ROS bags (ROS 1 `.bag`, ROS 2 `.mcap` and `.db3`), read by the package rosbags: no ROS is needed."""

from __future__ import annotations

import fnmatch
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from usvlearn.errors import LogFormatError, MissingExtraError, check_choice, check_positive, printable
from usvlearn.logs.channels.channel import Channel, Source, build_channel, match_name
from usvlearn.logs.channels.series import Series
from usvlearn.logs.formats.ros.decompress import MB, Total, limit_chunks, limited
from usvlearn.logs.formats.ros.message_fields import CLOCKS, Collected, default_field, read_field, stamp_of
from usvlearn.logs.formats.ros.rosbag_scan import Scan
from usvlearn.logs.formats.ros.rosbag_types import check_type

LARGE = 1 << 16  # bytes of a message that a survey looks into
IMAGES = {f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "PointCloud", "PointCloud2", "LaserScan")}
Found = TypeVar("Found")


@dataclass(frozen=True)
class Rosbag:
    """Reads a ROS bag. `Source.name` is a topic, `Source.field` a field of its messages.

    A field is a dotted path (`twist.linear.x`; a number indexes an array). By default it is that of `default_field`:
    in an Odometry, an Imu or a TwistStamped the channel's own, else `data`. Several, comma-separated, give their
    Euclidean norm. A quaternion gives its yaw in rad, counter-clockwise about z.

    A folder with the `metadata.yaml` of a ROS 2 bag is one log, of all its files. If fewer messages are found than the
    bag announces, its files are read without their metadata; a warning tells what is still missing.

    A ROS 1 bag whose recording crashed (`.bag.active`, cut off, no index) is read as far as possible, with a warning.

    Args:
        clock: `header` takes the stamp in a message's header, and the time of receipt for messages without
            one or with one more than 1 s from the receipt; `receive` always takes the time of receipt.
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
        """The channels of a bag.

        Args:
            path: the bag, a file or a folder.
            sources: channel -> where it is found.

        Returns:
            The channels, in SI units; and the counts of unusable messages: channel -> cause -> count.

        Raises:
            LogFormatError: the file is no bag, has no readable message, a chunk beyond the limit, or lacks a topic or
                a field.
            MissingExtraError: rosbags is not installed.

        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "a.bag"
        ...     _ = path.write_bytes(b"")
        ...     Rosbag().read(path, {})  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        usvlearn.errors.LogFormatError: ...a.bag: expected a whole ROS bag, found: ...
        """
        patterns = [source.name for source in sources.values()]

        def keep(topic: str, msgtype: str) -> bool:
            return any(_may_match(pattern, topic) for pattern in patterns)

        return self._open(path, keep, lambda bag: self._read(path, bag, sources))

    def survey(self, path: Path) -> list[Series]:
        """All numbers of a bag; a topic with messages of more than `LARGE` bytes, such as images, is left out.

        Args:
            path: the bag.

        Returns:
            The numbers, as they stand in the bag.

        Raises:
            LogFormatError: the file is no bag, or has no readable message, or a chunk beyond the limit.
            MissingExtraError: rosbags is not installed.

        >>> Rosbag().survey(Path("nowhere.bag"))  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        usvlearn.errors.LogFormatError: nowhere.bag: ...
        """
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
        if path.is_dir():  # its metadata may name the topics otherwise than its files do
            attempts.append(sorted(each for each in path.iterdir() if each.suffix in self.suffixes))
        refusal: Exception = LogFormatError("no file of a bag")
        for paths in filter(None, attempts):
            try:
                with limited(path, self._limit), AnyReader(paths, default_typestore=latest) as bag:
                    if not bag.is2:
                        limit_chunks(path, bag.readers[0], self._limit)
                    return use(_Counted(path, bag, refuse=paths is not attempts[-1]))
            except LogFormatError:
                raise
            except Exception as error:  # rosbags raises many types for damage, among them AssertionError and OSError
                refusal = error
        return use(self._recovered(path, keep, refusal))

    def _recovered(self, path: Path, keep: Callable[[str, str], bool], refusal: Exception) -> Scan:
        """A bag that rosbags refuses, as far as it can be read."""
        what = printable(" ".join(str(refusal).split())[:200].rstrip(".")) or type(refusal).__name__
        if path.suffix == ".active":
            what = "its recording was not closed"
        bag = Scan(path, keep, self._limit)
        if not bag.count:
            raise LogFormatError(
                f"{path}: expected a whole ROS bag, found: {what}; and no message could be recovered from it: "
                "leave it out, or name its reader"
            ) from refusal
        ending = f"it breaks off in the one at byte {bag.end} of {bag.size}" if bag.end < bag.size else "all are whole"
        warnings.warn(
            f"{path}: the index of this bag is missing or damaged ({what}): recovered {bag.count} messages "
            f"from its records; {ending}",
            stacklevel=4,
        )
        return bag

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
            seconds = (stamp_of(message, received, self.clock) - start) * 1e-9
            for channel in readings[connection.topic]:
                where = f"{path}: data.channels.{channel}.field"
                time[channel].append(seconds)
                field = sources[channel].field or default_field(connection.msgtype, channel)
                value[channel].append(read_field(message, field, where))
                order[channel].append(number)

        channels, dropped = {}, {}
        for channel, source in sources.items():
            stamps, raw = np.array(time[channel], float), np.array(value[channel], float)
            channels[channel], dropped[channel] = build_channel(
                f"{path}: {channel}", source, stamps, raw, order[channel]
            )
        return channels, dropped

    def _survey(self, path: Path, bag) -> list[Series]:
        topics: dict[str, Collected] = {}
        wanted = [each for each in bag.connections if each.msgtype not in IMAGES]
        unread = {topic for topic in {each.topic for each in wanted} if not _readable(path, bag, wanted, topic)}
        start, total = bag.start_time, Total(path, self._limit)
        for number, (connection, received, data) in enumerate(
            bag.messages([each for each in wanted if each.topic not in unread])
        ):
            topic = connection.topic
            if topic in unread:
                continue
            total.add(len(data))
            try:
                message = bag.deserialize(data, connection.msgtype) if len(data) <= LARGE else None
            except Exception:  # of a type that the log does not define, or damaged: another topic may be whole
                message = None
            if message is None:
                unread.add(topic)
                topics.pop(topic, None)
                continue
            seconds = (stamp_of(message, received, self.clock) - start) * 1e-9
            topics.setdefault(topic, Collected(topic, connection.msgtype)).add(seconds, number, message)
        return [series for _, each in sorted(topics.items()) for series in each.series()]


class _FewerMessages(Exception):
    """A bag holds fewer messages than it announces."""


class _Counted:
    """A bag whose messages are counted and compared with what it announces.

    Args:
        path: of the bag.
        bag: a `rosbags.highlevel.AnyReader` that is open.
        refuse: whether to raise `_FewerMessages`, not only to warn, if messages are missing.
    """

    def __init__(self, path: Path, bag: Any, refuse: bool):
        self.connections, self.typestore, self.deserialize = bag.connections, bag.typestore, bag.deserialize
        self.start_time = bag.start_time
        self._path, self._bag, self._refuse = path, bag, refuse

    def messages(self, wanted: list[Any]) -> Iterator[tuple[Any, int, bytes]]:
        announced, found = sum(connection.msgcount for connection in wanted), 0
        for message in self._bag.messages(wanted) if wanted else ():
            found += 1
            yield message
        if found < announced:
            text = (
                f"{self._path}: found {found} of the {announced} messages that this bag announces: its files or its "
                "metadata are damaged"
            )
            if self._refuse:
                raise _FewerMessages(text)
            warnings.warn(text, stacklevel=6)


def _readable(path: Path, bag, connections, topic: str) -> bool:
    """Whether the types of a topic's messages are defined, and ones that `check_type` admits."""
    try:
        for each in connections:
            if each.topic == topic:
                check_type(path, each.msgtype, bag.typestore.fielddefs)
    except (LogFormatError, KeyError):  # a type that the log does not define
        return False
    return True


def _may_match(pattern: str, topic: str) -> bool:
    """Whether `match_name` can choose this topic."""
    return topic.lstrip("/") == pattern.lstrip("/") or fnmatch.fnmatchcase(topic, pattern)
