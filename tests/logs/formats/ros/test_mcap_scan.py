"""An MCAP without its end, a database that is not closed, topics that cannot be read: what is left, and a note."""

import re
import shutil
import sqlite3
import struct
import warnings
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from rosbags import rosbag2

from tests.support.bags import NS, START
from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.ros.rosbag import Rosbag
from usvlearn.logs.inspection.logfiles import open_logs

COUNT = 210
SOURCES = {"command_left": Source("left"), "surge": Source("right", field="data")}
THRUST = "usv_msgs/msg/Thrust"


def write(folder: Path, plugin: str = "MCAP", compression: str = "", own: bool = False, mode: str = "STORAGE") -> Path:
    """A bag of two numbers, the second received out of order; `own`: and of a type that the bag alone defines."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store, number = get_typestore(Stores.ROS2_HUMBLE), "std_msgs/msg/Float64"
    store.register(get_types_from_msg("float64 port\n", THRUST))
    bag = rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin[plugin])
    if compression:
        bag.set_compression(rosbag2.CompressionMode[mode], rosbag2.CompressionFormat[compression])
    with bag:
        topics = {"left": number, "right": number} | ({"/thrust": THRUST} if own else {})
        connections = {topic: bag.add_connection(topic, kind, typestore=store) for topic, kind in topics.items()}
        for k in range(COUNT):
            messages = {"left": store.types[number](data=k), "right": store.types[number](data=2.0 * k)}
            messages["/thrust"] = store.types[THRUST](port=0.1)
            for topic, connection in connections.items():
                late = 3 * NS // 10 if k % 7 == 3 and topic == "right" else 0
                data = store.serialize_cdr(messages[topic], topics[topic])
                bag.write(connection, START + k * NS // 10 + late, data)
            if plugin == "MCAP" and bag.storage.chunk.bio.tell() > 1500:
                bag.storage.close_chunk()
    return next(folder.glob("*.[dm][bc]*"))


def noted(path: Path, sources=SOURCES):
    """The channels of a bag, or its series, and the notes about it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        read = Rosbag().read(path, sources)[0] if sources else Rosbag().survey(path)
    return read, [str(each.message) for each in caught]


@pytest.mark.parametrize("compression", ["", "ZSTD"])
def test_an_mcap_is_read_as_far_as_it_is_whole(tmp_path, compression):
    path = write(tmp_path / "run", compression=compression)
    whole, expected = path.read_bytes(), Rosbag().read(path, SOURCES)[0]
    counts = []
    for cut in (len(whole) - 1, len(whole) - 40, *range(len(whole) * 9 // 10, 1000, -len(whole) // 9)):
        path.write_bytes(whole[:cut])
        channels, (note,) = noted(path)
        counts.append(len(channels["surge"].value))
        count = int(re.search(r"recovered (\d+) messages of [\d.]+ s from its records", note)[1])
        assert abs(count - 2 * counts[-1]) <= 1 and (f"of {cut}" in note or "all are whole" in note)
        np.testing.assert_array_equal(np.sort(channels["surge"].value), 2.0 * np.arange(counts[-1]))
    np.testing.assert_array_equal(noted(rewrite(path, whole[:-1]))[0]["surge"].time, expected["surge"].time)
    assert counts == sorted(counts, reverse=True) and len(set(counts)) > 5 and counts[0] == COUNT


def rewrite(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def test_the_last_file_of_a_folder_may_be_cut(tmp_path):
    first, second = write(tmp_path / "a"), write(tmp_path / "b")
    (tmp_path / "a" / "metadata.yaml").unlink()
    first.with_name("b.mcap").write_bytes(second.read_bytes()[:-12_000])
    channels, (note,) = noted(tmp_path / "a")
    assert COUNT < len(channels["surge"].value) < 2 * COUNT and "breaks off" in note


def test_a_bag_whose_files_are_compressed_is_found(tmp_path):
    path = write(tmp_path / "run", "SQLITE3", "ZSTD", mode="FILE")
    logs = open_logs([str(tmp_path)])
    assert logs.files == (path.parent,) and [len(each.value) for each in logs.surveyed[0]] == [COUNT] * 2
    path.rename(path.with_name("run.tar.zstd"))
    with pytest.raises(LogFormatError, match="an archive, or a compressed file: unpack it"):
        open_logs([str(tmp_path)])


def test_messages_of_ros_1_in_an_mcap_are_read_and_others_are_named(tmp_path):
    def record(op: int, content: bytes) -> bytes:
        return struct.pack("<BQ", op, len(content)) + content

    def text(*several: str) -> bytes:
        return b"".join(struct.pack("<I", len(each)) + each.encode() for each in several)

    def mcap(profile: str, schema: bytes, encoding: str, data: bytes) -> bytes:
        channel = struct.pack("<HH", 1, 7) + text("/v", encoding, "")
        messages = [record(5, struct.pack("<HIQQ", 1, k, START + k * NS, 0) + data) for k in range(3)]
        parts = [record(1, text(profile, "")), record(3, struct.pack("<H", 7) + schema), record(4, channel), *messages]
        return b"\x89MCAP0\r\n" + b"".join(parts)

    path, surge = tmp_path / "a.mcap", {"surge": Source("v")}
    schema = text("std_msgs/Float64", "ros1msg", "float64 data")
    channels, (note,) = noted(rewrite(path, mcap("ros1", schema, "ros1", struct.pack("<d", 1.5))), surge)
    assert channels["surge"].value.tolist() == [1.5] * 3 and "recovered 3 messages of 2 s" in note
    rewrite(path, mcap("", text("foxglove.Log", "jsonschema", "{}"), "json", b"{}"))
    series, notes = noted(path, None)
    assert not series and "/v (foxglove.Log) is skipped, since 'foxglove.Log' is no type of ROS" in notes[1]
    with pytest.warns(UserWarning, match="recovered 3"), pytest.raises(LogFormatError, match="no type of ROS"):
        Rosbag().read(path, surge)


def test_a_database_that_was_not_closed_is_read_with_what_is_beside_it(tmp_path, monkeypatch):
    whole = write(tmp_path / "run", "SQLITE3")
    expected = Rosbag().read(whole, SOURCES)[0]
    with sqlite3.connect(whole) as base:
        rows = base.execute("SELECT * FROM messages WHERE id > 150").fetchall()
        base.execute("DELETE FROM messages WHERE id > 150")
    base.close()
    base = sqlite3.connect(whole)
    base.execute("PRAGMA journal_mode=WAL")
    base.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
    base.commit()
    crashed = tmp_path / "crashed"
    shutil.copytree(whole.parent, crashed)
    base.close()
    before = {each: each.read_bytes() for each in crashed.iterdir()}
    path = crashed / whole.name
    for each in (path, crashed):
        channels, (note,) = noted(each)
        np.testing.assert_array_equal(channels["surge"].value, expected["surge"].value)
        assert f"{path}: its recorder has not closed it: read together with {path.name}-wal, from a copy" in note
    assert {each: each.read_bytes() for each in crashed.iterdir()} == before
    monkeypatch.setattr(shutil, "copyfile", Mock(side_effect=OSError("No space left on device")))
    with pytest.raises(
        LogFormatError, match=r"found run\.db3-wal beside it, .*'PRAGMA wal_checkpoint'` on a copy of both"
    ):
        Rosbag().read(path, SOURCES)


@pytest.mark.parametrize("lost", [THRUST, ""])
def test_topics_without_a_definition_are_named(tmp_path, lost):
    path = write(tmp_path / "run", "SQLITE3", own=True)
    with sqlite3.connect(path) as base:
        base.execute("DELETE FROM message_definitions WHERE topic_type LIKE ?", (lost or "%",))
    base.close()
    series, (note,) = noted(path, None)
    assert {each.name for each in series} == {"left", "right"}
    assert f"/thrust ({THRUST}) is skipped, since the definition of {THRUST} is missing" in note
    assert "where usv_msgs is installed" in note and "`ros2 bag convert`" in note
    with pytest.raises(LogFormatError, match=f"the definition of {THRUST} is missing"):
        Rosbag().read(path, {"surge": Source("/thrust", field="port")})
