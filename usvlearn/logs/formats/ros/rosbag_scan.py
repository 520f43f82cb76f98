"""Reads bags that their recorder has not closed, or that are damaged, as far as they are whole.

ROS 1 bags and MCAPs without an index are read record by record up to the first damaged one. The records are those of
https://wiki.ros.org/Bags/Format/2.0 and of https://mcap.dev/spec. An MCAP may hold messages of ROS 1, too. Of an SQLite
bag, `X.db3-wal` may hold messages that are not in `X.db3` yet, which the package rosbags reads alone. Here both are
copied and joined; the files of the bag stay as they are.
"""

from __future__ import annotations

import io
import itertools
import os
import shutil
import sqlite3
import struct
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO, NamedTuple

from usvlearn.errors import LogFormatError
from usvlearn.logs.formats.ros.limits import Total, check_type, unpack

MAGIC, MCAP = b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n"
MESSAGE, BAG_HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = range(2, 8)  # the field "op" of a record's header
JOURNALS = "-wal", "-journal"  # a rollback journal takes back what was half written
MCAP_HEADER, FOOTER, SCHEMA, CHANNEL, MCAP_MESSAGE, MCAP_CHUNK = range(1, 7)  # the first byte of a record of an MCAP


class Connection(NamedTuple):
    """One publisher of one topic."""

    number: int
    topic: str
    msgtype: str


class Scan:
    """The records of a bag, or a folder of MCAPs, with the attributes of `rosbags.highlevel.AnyReader`.

    It is read once, from its start. The first thing that cannot be parsed ends the scan, at the byte `end` of the last
    file. Only messages of topics and types that `keep` tells are held in memory and deserialised, but `start_time` and
    `end_time`, ns since 1970, and `count` are those of all. A chunk that unpacks to more than `limit` bytes is refused.
    """

    def __init__(self, path: Path, keep: Callable[[str, str], bool], limit: int):
        from rosbags.typesys import Stores, get_typestore

        self.start_time, self.end_time, self.count, self.end, self.size = 2**63 - 1, 0, 0, 0, 0
        self._path, self._limit = path, limit
        self._keep, self.typestore = keep, get_typestore(Stores.EMPTY)
        self._connections: dict[int, Connection] = {}
        self._messages: dict[int, list[tuple[int, bytes]]] = {}  # number of a kept connection -> (received, data)
        self._schemas: dict[int, tuple[str, str, str]] = {}  # of an MCAP: type, encoding, definition
        self.is2 = path.is_dir()
        if path.exists():
            self._total = Total(path, limit)
        for place, each in enumerate(sorted(path.glob("*.mcap")) if self.is2 else [path]):
            self._first = place << 16  # of the numbers of an MCAP's connections
            if each.is_file() and self.end == self.size:
                self._file(each)

    def _file(self, path: Path) -> None:
        """Read a file up to its end, or the first thing that cannot be parsed."""
        with path.open("rb") as file:
            self.size, self.end, start = os.fstat(file.fileno()).st_size, 0, file.read(len(MAGIC))
            if start != MAGIC and not start.startswith(MCAP):
                return
            record = self._record if start == MAGIC else self._mcap
            file.seek(len(MAGIC if start == MAGIC else MCAP))
            try:
                while (end := file.tell()) < self.size:
                    self.end = end
                    record(file, self.size)
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
        logs = [[(connection, *each) for each in self._messages.get(connection.number, ())] for connection in wanted]
        yield from sorted(itertools.chain(*logs), key=lambda message: message[1])

    def deserialize(self, data: bytes, msgtype: str):
        return (self.typestore.deserialize_cdr if self.is2 else self.typestore.deserialize_ros1)(data, msgtype)

    def _record(self, stream: BinaryIO, size: int) -> None:
        """Read the next record of a stream of so many bytes; raise an exception if it cannot be parsed."""
        header = _fields(_read(stream, size, _uint32(stream.read(4))))
        op, length = header["op"][0], _uint32(stream.read(4))
        if op == CHUNK:
            compression, announced = header["compression"].decode(), _uint32(header.get("size", bytes(4)))
            left = size - stream.tell()
            if length == 0 and compression != "none":
                length = left  # the length is written when a chunk is closed, and this chunk was not closed
            self._inner(stream.read(min(length, left)), length > left, compression, announced, self._record)
            return
        data = _read(stream, size, length)
        if op == CONNECTION:
            self._connect(_uint32(header["conn"]), header["topic"].decode(), _fields(data))
        elif op == MESSAGE:
            seconds, nanoseconds = struct.unpack("<II", header["time"])
            self._take(self._connections[_uint32(header["conn"])], seconds * 10**9 + nanoseconds, data)
        elif op not in (BAG_HEADER, INDEX, CHUNK_INFO):
            raise ValueError(op)

    def _inner(self, packed: bytes, cut: bool, compression: str, announced: int, record: Callable):
        """Read the records of a chunk as far as they are whole; raise an exception if they are not."""
        data, whole = unpack(self._path, packed, compression, self._limit, announced)
        inner = io.BytesIO(data)
        while inner.tell() < len(data):
            record(inner, len(data))
        if cut or not whole:
            raise EOFError

    def _mcap(self, stream: BinaryIO, size: int) -> None:
        """Read the next record of an MCAP, as `_record` does."""
        op, length = struct.unpack("<BQ", stream.read(9))
        if op == MCAP_CHUNK:
            (announced,), compression = struct.unpack("<16xQ4x", stream.read(28)), _text(stream) or "none"
            (packed,), left = struct.unpack("<Q", stream.read(8)), size - stream.tell()
            self._inner(stream.read(min(packed, left)), packed > left, compression, announced, self._mcap)
            return
        data = io.BytesIO(_read(stream, size, length))
        if op == MCAP_HEADER:
            self.is2 = _text(data) != "ros1"
        elif op == FOOTER:
            stream.seek(size)
        elif op == SCHEMA:
            (number,) = struct.unpack("<H", data.read(2))
            self._schemas[number] = _text(data), _text(data), _text(data)
        elif op == CHANNEL:
            number, schema = struct.unpack("<HH", data.read(4))
            self._channel(self._first + number, self._schemas.get(schema, ("", "", "")), _text(data))
        elif op == MCAP_MESSAGE:
            number, received = struct.unpack("<H4xQ8x", data.read(22))
            self._take(self._connections[self._first + number], min(received, 2**63 - 1), data.read())

    def _channel(self, number: int, schema: tuple[str, str, str], topic: str) -> None:
        """Note a topic of an MCAP; one that cannot be read has no messages."""
        from rosbags.typesys import get_types_from_idl, get_types_from_msg

        msgtype, language, text = schema
        msgtype = msgtype.replace("/", "/msg/") if msgtype.count("/") == 1 else msgtype
        if number not in self._connections and self._keep(topic, msgtype):
            try:
                defined = get_types_from_idl(text) if "idl" in language else get_types_from_msg(text, msgtype)
                self.typestore.register(defined)
                check_type(self._path, msgtype, self.typestore.fielddefs)
                self._messages[number] = []
            except Exception:  # no type of ROS, or one that is not defined; `check_type` tells it again
                pass
        self._connections.setdefault(number, Connection(number, topic, msgtype))

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

    def _take(self, connection: Connection, received: int, data: bytes) -> None:
        if connection.number in self._messages:
            self._total.message(data)
            self.deserialize(data, connection.msgtype)  # the scan ends at the first message that fails here
            self._messages[connection.number].append((received, data))
        self.start_time, self.end_time = min(self.start_time, received), max(self.end_time, received + 1)
        self.count += 1


def _uint32(data: bytes) -> int:
    return struct.unpack("<I", data)[0]


def _text(stream: BinaryIO) -> str:
    """A text of an MCAP, after its length."""
    return stream.read(_uint32(stream.read(4))).decode(errors="replace")


def _read(stream: BinaryIO, size: int, length: int) -> bytes:
    if stream.tell() + length > size:
        raise EOFError
    return stream.read(length)


def _fields(header: bytes) -> dict[str, bytes]:
    """The fields of a header, each its length and `name=value`."""
    fields, place = {}, 0
    while place < len(header):
        end = place + 4 + _uint32(header[place : place + 4])
        name, sign, value = header[place + 4 : end].partition(b"=")
        if end > len(header) or not sign:
            raise EOFError
        fields[name.decode()] = value
        place = end
    return fields


@contextmanager
def joined_journals(files: list[Path]) -> Iterator[list[Path]]:
    """The files, with a joined copy in place of each database that has a journal, as a context.

    A database and its journal that cannot be copied or joined are a LogFormatError.
    """
    beside = {file: [file.with_name(file.name + end) for end in JOURNALS] for file in files if file.suffix == ".db3"}
    left = {file: [each for each in some if each.is_file() and each.stat().st_size] for file, some in beside.items()}
    with TemporaryDirectory() if any(left.values()) else nullcontext("") as folder:
        yield [_join(file, left[file], Path(folder)) if left.get(file) else file for file in files]


def _join(file: Path, journals: list[Path], folder: Path) -> Path:
    """A copy of a database, joined with its journals."""
    name = journals[0].name
    try:
        for each in (file, *journals):
            shutil.copyfile(each, folder / each.name)
        with closing(sqlite3.connect(folder / file.name)) as base:
            base.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
            base.execute("SELECT count(*) FROM sqlite_master").fetchall()  # this takes back what a -journal holds
    except (OSError, sqlite3.Error) as error:
        raise LogFormatError(
            f"{file}: found {name} beside it, which holds messages that are not in the bag, and could not join them "
            f"({error}): run `sqlite3 {file.name} 'PRAGMA wal_checkpoint'` on a copy of both"
        ) from error
    warnings.warn(f"{file}: its recorder has not closed it: read together with {name}, from a copy", stacklevel=7)
    return folder / file.name
