"""A bag that is small on the disk cannot fill the memory: its chunks are unpacked up to a limit."""

import bz2
import sqlite3
import struct
import subprocess
import sys
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from rosbags import rosbag1

from tests.support import few
from tests.support.bags import NS, SOURCES, START, unindexed, write_bag
from usvlearn.errors import ConfigError, LogFormatError
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.ros.limits import MB, MOST, Total, unpack
from usvlearn.logs.formats.ros.rosbag import Rosbag

BOMB = 120 * MB  # bytes of zeros, some kB compressed
SPEED = {"surge": Source("speed")}
PEAK = """
import resource, sys
from pathlib import Path
from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.ros.rosbag import Rosbag
import rosbags.highlevel

def memory():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024

before = memory()
for path in sys.argv[1:]:
    try:
        Rosbag(chunk_limit=20).read(Path(path), {"surge": Source("speed")})
        print("read")
    except LogFormatError as error:
        print(error)
print(memory() - before)
"""


@cache
def ros1(kind: str) -> bytes:
    """A ROS 1 bag of one chunk: some speeds and a long text."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    number, text = (store.types[f"std_msgs/msg/{name}"] for name in ("Float64", "String"))
    with TemporaryDirectory() as folder:
        path = Path(folder, "a.bag")
        bag = rosbag1.Writer(path)
        bag.chunk_threshold = 2 * BOMB
        bag.set_compression(rosbag1.Writer.CompressionFormat[kind.upper()])
        with bag:
            speed = bag.add_connection("/speed", number.__msgtype__, typestore=store)
            talk = bag.add_connection("/talk", text.__msgtype__, typestore=store)
            for k in range(5):
                bag.write(speed, START + k * NS, store.serialize_ros1(number(data=0.5 * k), number.__msgtype__))
            bag.write(talk, START + 5 * NS, struct.pack("<I", BOMB) + bytes(BOMB))
        return path.read_bytes()


def announcing(content: bytes, size: int) -> bytes:
    """A ROS 1 bag with another size in the header of its first chunk."""
    place = content.index(b"size=") + len("size=")
    return content[:place] + struct.pack("<I", size) + content[place + 4 :]


@cache
def ros2(kind: str) -> tuple[bytes, int]:
    """An MCAP of one chunk, likewise, and the size of that chunk."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    number = store.types["std_msgs/msg/Float64"]
    with TemporaryDirectory() as folder:
        with Writer(Path(folder, "run"), version=9, storage_plugin=StoragePlugin.MCAP) as bag:
            speed = bag.add_connection("/speed", number.__msgtype__, typestore=store)
            for k in range(5):
                bag.write(speed, START + k * NS, store.serialize_cdr(number(data=0.5 * k), number.__msgtype__))
            bag.storage.chunk.bio.write(b"\x7f" + struct.pack("<Q", BOMB) + bytes(BOMB))  # a record that is skipped
            size = bag.storage.chunk.bio.tell()
            bag.storage.compression, bag.storage.compressor = kind, partial(packed, kind)
        return Path(folder, "run", "run.mcap").read_bytes(), size


def packed(kind: str, data: bytes) -> bytes:
    if kind == "bz2":
        return bz2.compress(data)
    if kind == "zstd":
        from rosbags.rosbag2.storage_mcap import zstd

        return zstd.compress(data)
    from lz4.frame import compress

    return compress(data)


def db3(path: Path) -> Path:
    """A database whose data are computed as they are read."""
    base = sqlite3.connect(path)
    base.executescript(
        f"""
        CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT,
                            offered_qos_profiles TEXT);
        CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,
                              data BLOB GENERATED ALWAYS AS (zeroblob({BOMB})) VIRTUAL);
        INSERT INTO topics VALUES (1, '/speed', 'std_msgs/msg/Float64', 'cdr', '');
        INSERT INTO messages(id, topic_id, timestamp) VALUES (1, 1, 1), (2, 1, 2);
        """
    )
    base.close()
    return path


def peak(paths: list[Path]) -> tuple[list[str], int]:
    """What a fresh process says to bags, and by how many MB that raised its peak of memory."""
    done = subprocess.run([sys.executable, "-c", PEAK, *map(str, paths)], capture_output=True, text=True, check=True)
    *said, grown = done.stdout.splitlines()
    assert len(said) == len(paths)
    return said, int(grown)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["bz2", "lz4"])
def test_a_small_bag_of_ros1_cannot_fill_the_memory(tmp_path, kind):
    """Whatever its chunk announces, and whether it is found by the index or by a scan."""
    paths, refused = [], []
    for announced in (None, 0, 10_000, 19 * MB, 2**32 - 1):
        for index in ("indexed", "scanned"):
            content = ros1(kind) if announced is None else announcing(ros1(kind), announced)
            assert len(content) < BOMB / 200
            paths.append(tmp_path / f"{announced}{index}.bag")
            paths[-1].write_bytes(content if index == "indexed" else unindexed(content))
            refused.append(announced in (None, 0, 2**32 - 1))
    said, grown = peak(paths)
    assert grown < 80
    for sentence, is_refused in zip(said, refused, strict=True):
        if is_refused:
            assert "found a chunk that unpacks to " in sentence and "data.reader.chunk_limit" in sentence
        else:
            assert sentence == "read"  # as far as it was announced


@pytest.mark.thorough
@pytest.mark.parametrize("kind", few(["zstd", "lz4"], ["zstd"], "thorough"))
def test_a_small_bag_of_ros2_cannot_fill_the_memory(tmp_path, kind):
    """Whatever its chunk announces, with a summary and without."""
    (content, size), paths, refused = ros2(kind), [], []
    assert len(content) < BOMB / 200
    for announced in (size, 10_000, 19 * MB, 2**62):
        for ending in (content[-28:-20], bytes(8)):
            path = tmp_path / f"{len(paths)}.mcap"
            forged = content[:-28] + ending + content[-20:]
            path.write_bytes(forged.replace(struct.pack("<Q", size), struct.pack("<Q", announced)))
            paths.append(path)
            refused.append("chunk_limit" if announced in (size, 2**62) else "read")  # as far as it was announced
    said, grown = peak(paths)
    assert grown < 80
    for sentence, expected in zip(said, refused, strict=True):
        assert expected in sentence


def test_a_row_of_a_database_cannot_fill_the_memory(tmp_path):
    (said,), grown = peak([db3(tmp_path / "a.db3")])
    assert "too big" in said and grown < 80


@pytest.mark.thorough
def test_a_larger_limit_reads_the_same_bag(tmp_path):
    for path, content in ((tmp_path / "a.bag", ros1("lz4")), (tmp_path / "a.mcap", ros2("zstd")[0])):
        path.write_bytes(content)
        with pytest.raises(LogFormatError, match=r"more than 100 MB: leave this log out, or raise data\.reader"):
            Rosbag().read(path, SPEED)
        channels, _ = Rosbag(chunk_limit=300).read(path, SPEED)
        np.testing.assert_array_equal(channels["surge"].value, 0.5 * np.arange(5))


def test_chunks_just_below_and_above_the_limit(tmp_path):
    path = tmp_path / "a.bag"
    for kind in ("bz2", "lz4", "zstd"):
        data = packed(kind, bytes(MB))
        assert unpack(path, data, kind, MB) == (bytes(MB), True) == unpack(path, data, kind, MB, MB)
        assert unpack(path, data, kind, MB, MB - 1) == (bytes(MB - 1), False)
        assert unpack(path, data, kind, MB + 1, MB + 1) == (bytes(MB), False)
        for announced in (0, MB):
            with pytest.raises(LogFormatError, match="chunk_limit"):
                unpack(path, data, kind, MB - 1, announced)
        cut, whole = unpack(path, data[: len(data) // 2], kind, MB)
        assert not whole and cut == bytes(len(cut))
    with pytest.raises(ValueError, match="xz"):
        unpack(path, b"", "xz", MB)


@pytest.mark.parametrize("limit", [0, -1.0, float("nan"), float("inf"), "100", None])
def test_limits_that_are_none_are_refused(limit):
    with pytest.raises(ConfigError, match=r"data\.reader\.chunk_limit: found .* positive number of MB"):
        Rosbag(chunk_limit=limit)


def test_many_chunks_cannot_fill_the_memory_together(tmp_path):
    whole = write_bag(tmp_path / "a.bag", "bz2")
    assert len(Rosbag().read(whole, SOURCES)[0]["surge"].time) == 40  # some of them are read many times
    total = Total(whole, MB)
    total.add(MB + MOST * whole.stat().st_size)
    with pytest.raises(LogFormatError, match=r"a\.bag: found more than \d+ MB of messages"):
        total.add(1)


def typed(path: Path, definition: str, data: bytes, indexed: bool) -> Path:
    """A bag of one message of a type of its own."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, "own/msg/Speed"))
    with rosbag1.Writer(path) as bag:
        connection = bag.add_connection("/speed", "own/msg/Speed", typestore=store)
        bag.write(connection, START, data)
    if not indexed:
        path.write_bytes(unindexed(path.read_bytes()))
    return path


EMPTY = "\n" + 80 * "=" + "\nMSG: own/Empty\n"
NESTED = "".join(f"\n{80 * '='}\nMSG: own/T{k}\nown/T{k + 1}[100] x\n" for k in range(4)) + EMPTY.replace("Empty", "T4")


@pytest.mark.parametrize("indexed", [True, False])
@pytest.mark.parametrize(
    ("definition", "data", "what"),
    [
        (f"float64 data\nown/Empty[] x{EMPTY}", bytes(8) + b"\xff" * 4, "a list of what has no fields"),
        (f"float64 data\nown/Empty[100000000] x{EMPTY}", bytes(8), "an array of 100000000 fields"),
        (f"float64 data\nown/T0 x{NESTED}", bytes(8), "an array of 10100 fields"),
        ("float64 data\nstring[50000000] x", bytes(8), "an array of 50000000 fields"),
        ("float64 data\nuint8[] x", bytes(8) + struct.pack("<I", 2 * MB) + bytes(2 * MB), "a message of 2.0 MB"),
    ],
)
def test_a_message_cannot_become_many_more_objects_than_it_has_bytes(tmp_path, definition, data, what, indexed):
    path = typed(tmp_path / "a.bag", definition, data, indexed)
    with pytest.raises(LogFormatError, match=what):
        Rosbag().read(path, SPEED)


def test_types_of_many_numbers_are_read(tmp_path):
    path = typed(
        tmp_path / "a.bag", "float64 data\nfloat64[50000] x\nuint8[] y\nstring[3] z", bytes(8 + 400_000 + 16), True
    )
    assert Rosbag().read(path, SPEED)[0]["surge"].value == [0.0]
