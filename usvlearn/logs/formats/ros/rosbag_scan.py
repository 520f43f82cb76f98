"""ROS 1 bags whose index is missing or damaged, read record by record up to the first damaged one.

The records are those of format 2.0, https://wiki.ros.org/Bags/Format/2.0
"""

from __future__ import annotations

import io
import itertools
import os
import struct
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from usvlearn.errors import LogFormatError
from usvlearn.logs.formats.ros.decompress import Total, unpack
from usvlearn.logs.formats.ros.rosbag_types import check_type

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = range(2, 8)  # the field "op" of a record's header


class Connection(NamedTuple):
    """One publisher of one topic."""

    number: int
    topic: str
    msgtype: str


class Scan:
    """The records of a bag, with the attributes of `rosbags.highlevel.AnyReader`.

    It is read once, from its start. The first thing that cannot be parsed ends the scan.

    Args:
        path: the bag.
        keep: tells which topics and types are wanted: only their messages are held in memory and deserialised.
        limit: bytes that a compressed chunk may unpack to.

    Attributes:
        connections: sorted by number.
        start_time: ns since 1970, the earliest message of any topic.
        count: messages of any topic.
        end: byte at which the first unreadable record begins; the size of the bag if there is none.
        size: of the bag, bytes.

    Raises:
        LogFormatError: a chunk is larger than the limit.
    """

    def __init__(self, path: Path, keep: Callable[[str, str], bool], limit: int):
        from rosbags.typesys import Stores, get_typestore

        self.start_time, self.count, self.end, self.size = 2**63 - 1, 0, 0, 0
        self._path, self._limit = path, limit
        self._keep, self.typestore = keep, get_typestore(Stores.EMPTY)
        self._connections: dict[int, Connection] = {}
        self._messages: dict[int, list[tuple[int, bytes]]] = {}  # number of a kept connection -> (received, data)
        if not path.is_file():
            return
        self._total = Total(path, limit)
        with path.open("rb") as file:
            self.size = os.fstat(file.fileno()).st_size
            if file.read(len(MAGIC)) != MAGIC:
                return
            try:
                while (end := file.tell()) < self.size:
                    self.end = end
                    self._record(file, self.size)
                self.end = self.size
            except LogFormatError:
                raise
            except Exception as error:  # damaged data raise any type, also within rosbags, bz2 and lz4
                if isinstance(error, OSError) and error.errno:
                    raise

    @property
    def connections(self) -> list[Connection]:
        return [self._connections[number] for number in sorted(self._connections)]

    def messages(self, wanted: Iterable[Connection]) -> Iterator[tuple[Connection, int, bytes]]:
        """The kept messages of these connections, sorted by time of receipt, as an index would."""
        logs = [[(connection, *message) for message in self._messages[connection.number]] for connection in wanted]
        yield from sorted(itertools.chain(*logs), key=lambda message: message[1])

    def deserialize(self, data: bytes, msgtype: str):
        return self.typestore.deserialize_ros1(data, msgtype)

    def _record(self, stream: BinaryIO, size: int) -> None:
        """Read the next record of a stream of so many bytes; raise an exception if it cannot be parsed."""
        header = _fields(_read(stream, size, _uint32(stream.read(4))))
        op, length = header["op"][0], _uint32(stream.read(4))
        if op == CHUNK:
            self._chunk(stream, size - stream.tell(), length, header)
            return
        data = _read(stream, size, length)
        if op == CONNECTION:
            self._connect(_uint32(header["conn"]), header["topic"].decode(), _fields(data))
        elif op == MESSAGE:
            self._take(self._connections[_uint32(header["conn"])], header["time"], data)
        elif op not in (BAG_HEADER, INDEX, CHUNK_INFO):
            raise ValueError(op)

    def _chunk(self, stream: BinaryIO, left: int, length: int, header: dict[str, bytes]) -> None:
        compression, announced = header["compression"].decode(), _uint32(header.get("size", bytes(4)))
        if length == 0 and compression != "none":
            length = left  # the length is written when a chunk is closed, and this chunk was not closed
        data, whole = unpack(self._path, stream.read(min(length, left)), compression, self._limit, announced)
        inner = io.BytesIO(data)
        while inner.tell() < len(data):
            self._record(inner, len(data))
        if length > left or not whole:
            raise EOFError

    def _connect(self, number: int, topic: str, described: dict[str, bytes]) -> None:
        from rosbags.typesys import get_types_from_msg

        if number in self._connections:  # it is repeated in every chunk, and in the index
            return
        topic = "/" * topic.startswith("/") + "/".join(part for part in topic.split("/") if part)
        package, _, name = described["type"].decode().partition("/")
        msgtype = f"{package}/msg/{name}"  # as rosbags names it
        if self._keep(topic, msgtype):
            self.typestore.register(get_types_from_msg(described["message_definition"].decode(), msgtype))
            if self.typestore.generate_msgdef(msgtype)[1] != described["md5sum"].decode():
                raise ValueError(msgtype)
            check_type(self._path, msgtype, self.typestore.fielddefs)
            self._messages[number] = []
        self._connections[number] = Connection(number, topic, msgtype)

    def _take(self, connection: Connection, time: bytes, data: bytes) -> None:
        seconds, nanoseconds = struct.unpack("<II", time)
        received = seconds * 10**9 + nanoseconds
        if connection.number in self._messages:
            self._total.message(data)
            self.deserialize(data, connection.msgtype)  # the scan ends at the first message that fails here
            self._messages[connection.number].append((received, data))
        self.start_time = min(self.start_time, received)
        self.count += 1


def _uint32(data: bytes) -> int:
    return struct.unpack("<I", data)[0]


def _read(stream: BinaryIO, size: int, length: int) -> bytes:
    if stream.tell() + length > size:
        raise EOFError
    return stream.read(length)


def _fields(header: bytes) -> dict[str, bytes]:
    """The fields of a header, each its length and `name=value`.

    >>> _fields(b"\\4\\0\\0\\0op=2\\x07\\0\\0\\0topic=/")
    {'op': b'2', 'topic': b'/'}
    """
    fields, place = {}, 0
    while place < len(header):
        end = place + 4 + _uint32(header[place : place + 4])
        name, sign, value = header[place + 4 : end].partition(b"=")
        if end > len(header) or not sign:
            raise EOFError
        fields[name.decode()] = value
        place = end
    return fields
