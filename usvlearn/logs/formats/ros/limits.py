"""Limits of a bag, since 10 kB can hold gigabytes of zeros, and a few bytes gigabytes of objects.

The package rosbags unpacks a chunk at once, whatever its size. `limited` makes it use `unpack`.
"""

from __future__ import annotations

import bz2
import io
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.channel import QUOTED

MB = 1_000_000
MESSAGE = MB  # most bytes of one message that is read; as Python objects it takes a hundred times as many
BLOCK = 1 << 16  # bytes unpacked at a time: the blocks before a damaged one are kept
MOST = 1000  # a bag may unpack to so many times its size, all chunks together
FIELDS = 10_000  # of one message; an array of numbers counts as one
DEEPEST = 20  # types within types
NOTHING = "structure_needs_at_least_one_member"  # as rosbags calls the field of a type without fields
_PATCHED = threading.Lock()  # all threads share the functions with which rosbags unpacks


def unpack(path: Path, data: bytes, compression: str, limit: int, announced: int = 0) -> tuple[bytes, bool]:
    """A chunk's data as far as it can be read, and whether it is complete; a ValueError for an unknown compression.

    The chunk's header may announce a size, else 0. Data beyond it count as damage. A LogFormatError if the chunk, or
    the size in its header, is larger than the limit, bytes.
    """
    if compression == "none":
        return data, True
    if announced > limit:
        raise _too_large(path, f"a chunk that unpacks to {announced / MB:.0f} MB, more than {limit / MB:g} MB")
    most, unpacked, whole = announced or limit, bytearray(), False
    stream = _opened(compression, io.BytesIO(data))
    try:
        while part := stream.read1(min(BLOCK, most + 1 - len(unpacked))):
            unpacked += part
        whole = announced in (0, len(unpacked))
    except Exception:  # each library raises its own type for damage; the blocks before it are kept
        pass
    if len(unpacked) > limit:
        raise _too_large(path, f"a chunk that unpacks to more than {limit / MB:g} MB")
    return bytes(unpacked[:most]), whole


def _opened(compression: str, file: BinaryIO) -> Any:
    """A stream of the unpacked file."""
    if compression == "bz2":
        return bz2.BZ2File(file)
    if compression == "lz4":
        from lz4.frame import LZ4FrameFile

        return LZ4FrameFile(file)
    if compression == "zstd":
        from rosbags.rosbag2.storage_mcap import zstd  # type: ignore[attr-defined]  # of Python, or its backport

        return zstd.ZstdFile(file)
    raise ValueError(f"compression {compression!r}")


class Total:
    """Counts the unpacked data of one bag, and limits them to `MOST` times its size, and one chunk of `limit` bytes."""

    def __init__(self, path: Path, limit: int):
        files = path.iterdir() if path.is_dir() else [path]
        self.path, self.size, self.count = path, sum(file.stat().st_size for file in files), 0
        self.most = limit + MOST * self.size

    def message(self, data: bytes) -> None:
        """Count a message before it is read; raise a LogFormatError if it, or all of them, are too large."""
        if len(data) > MESSAGE:
            raise LogFormatError(
                f"{self.path}: found a message of {len(data) / MB:.1f} MB, expected at most {MESSAGE / MB:g} MB: name "
                "another topic in data.channels"
            )
        self.add(len(data))

    def add(self, count: int) -> None:
        """Count more bytes; raise a LogFormatError if there are too many."""
        self.count += count
        if self.count > self.most:
            raise _too_large(self.path, f"more than {self.most / MB:.0f} MB of messages in {self.size} bytes")


def _too_large(path: Path, what: str) -> LogFormatError:
    advice = "leave this log out, or raise data.reader.chunk_limit if you know where it is from"
    return LogFormatError(f"{path}: found {what}: {advice}")


def _whole(path: Path, data: bytes, compression: str, limit: int, announced: int) -> bytes:
    unpacked, whole = unpack(path, data, compression, limit, announced)
    if not whole:
        raise ValueError(f"a chunk of {announced} bytes ends after {len(unpacked)}")
    return unpacked


@contextmanager
def limited(path: Path, limit: int) -> Iterator[None]:
    """A context in which rosbags unpacks the chunks or rows of a ROS 2 bag up to a limit only, bytes."""
    import apsw
    from rosbags.rosbag2.storage_mcap import DECOMPRESSORS

    total = Total(path, limit)

    def chunk(compression: str, data: bytes, announced: int) -> bytes:
        unpacked = _whole(path, data, compression, limit, announced)
        total.add(len(unpacked))
        return unpacked

    def rows(connection: apsw.Connection) -> None:
        connection.limit(apsw.SQLITE_LIMIT_LENGTH, min(limit, 2**31 - 1))

    with _PATCHED:
        before = dict(DECOMPRESSORS)
        DECOMPRESSORS.update({name: partial(chunk, name) for name in ("lz4", "zstd")})
        apsw.connection_hooks.append(rows)
        try:
            yield
        finally:
            DECOMPRESSORS.update(before)
            apsw.connection_hooks.remove(rows)


def limit_chunks(path: Path, reader: Any, limit: int) -> None:
    """Make an open `rosbags.rosbag1.Reader` unpack chunks up to a limit only, bytes, and to the size they announce."""
    from rosbags.rosbag1.reader import Header

    def unpacked(place: int, data: bytes) -> bytes:
        reader.bio.seek(place)
        header = Header.read(reader.bio)
        return _whole(path, data, header.get_string("compression"), limit, header.get_uint32("size"))

    reader.chunks |= {at: chunk._replace(decompressor=partial(unpacked, at)) for at, chunk in reader.chunks.items()}


def check_type(path: Path, msgtype: str, definitions: Mapping[str, Any]) -> None:
    """Raise a LogFormatError if a type is not defined, or its messages can have many more fields than bytes.

    The definitions are the `fielddefs` of a `rosbags.typesys.store.Typestore`.
    """
    from rosbags.interfaces import Nodetype

    known: dict[str, tuple[int, int]] = {}

    def refused(what: str) -> LogFormatError:
        return LogFormatError(
            f"{path}: found the message type {msgtype[:QUOTED]!r} with {what}, expected one that holds some numbers: "
            "name another topic in data.channels"
        )

    def measure(description: Any, depth: int) -> tuple[int, int]:
        """The least bytes and the most fields of a type."""
        kind, inner = description
        if kind == Nodetype.BASE:
            return 1, 1
        if kind == Nodetype.NAME:
            if depth > DEEPEST:
                raise refused(f"more than {DEEPEST} types within each other")
            if inner not in definitions:
                package = inner.partition("/")[0][:QUOTED]
                way = "or export the topic to a CSV file"
                if "/" not in inner:
                    raise LogFormatError(f"{path}: {inner[:QUOTED]!r} is no type of ROS: name another topic, {way}")
                raise LogFormatError(
                    f"{path}: the definition of {inner[:QUOTED]} is missing: where {package} is installed, convert the "
                    f"bag to MCAP, which stores definitions (`ros2 bag convert`), {way} (`ros2 topic echo --csv`)"
                )
            if inner not in known:
                fields = [measure(each, depth + 1) for name, each in definitions[inner][1] if name != NOTHING]
                known[inner] = sum(size for size, _ in fields), 1 + sum(count for _, count in fields)
            return known[inner]
        element, length = inner
        size, count = measure(element, depth)
        if kind == Nodetype.SEQUENCE:
            if size == 0:
                raise refused("a list of what has no fields")
            return 4, 1
        numbers = element[0] == Nodetype.BASE and element[1][0] != "string"
        if (total := 1 if numbers else length * count) > FIELDS:
            raise refused(f"an array of {total} fields")
        return length * size, total

    if measure((Nodetype.NAME, msgtype), 0)[1] > FIELDS:
        raise refused(f"{known[msgtype][1]} fields")
