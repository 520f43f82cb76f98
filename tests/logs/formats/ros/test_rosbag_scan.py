"""A ROS 1 bag without a usable index gives what its index would give, up to where the file breaks off."""

import bz2
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest

from tests.support import cases, few, over
from tests.support.bags import SOURCES, STEPS, unindexed, write_bag
from usvlearn.errors import LogFormatError
from usvlearn.logs.formats.ros.rosbag import Rosbag
from usvlearn.logs.formats.ros.rosbag_scan import BAG_HEADER, CHUNK, MAGIC
from usvlearn.logs.read import read_recordings

COMPRESSIONS = ("none", "bz2", "lz4")


def recovered(path: Path, content: bytes):
    """The channels of a damaged bag and the warning about it; None for what is refused."""
    path.write_bytes(content)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            channels, _ = Rosbag().read(path, SOURCES)
        except LogFormatError as error:
            assert "\n" not in str(error) and len(str(error)) < 800
            return None, None
    (warning,) = caught
    assert str(path) in str(warning.message)
    return channels, str(warning.message)


def assert_equal(found, expected):
    assert found.keys() == expected.keys()
    for name, channel in expected.items():
        for part in ("time", "value", "order"):
            np.testing.assert_array_equal(getattr(found[name], part), getattr(channel, part))


def records(data: bytes):
    """(op, place of its header, of its data, of its end) of each record."""
    place = 0
    while place < len(data):
        (size,) = struct.unpack_from("<I", data, place)
        op = data[data.index(b"op=", place) + 3]
        start = place + 8 + size
        end = start + struct.unpack_from("<I", data, start - 4)[0]
        yield op, place, start, end
        place = end


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize(
    ("name", "index"), [("a.bag", 0), ("a.bag.active", 0), ("a.bag", 4200), ("a.bag", 10**9), ("a.bag", 2**64 - 1)]
)
def test_a_scan_equals_the_reading_by_the_index(tmp_path, compression, name, index):
    whole = write_bag(tmp_path / "whole.bag", compression)
    expected, _ = Rosbag().read(whole, SOURCES)
    assert len(expected["surge"].time) == STEPS
    channels, warning = recovered(tmp_path / name, unindexed(whole.read_bytes(), index))
    assert_equal(channels, expected)
    assert f"recovered {4 * STEPS - STEPS // 4} messages" in warning and "all are whole" in warning
    assert "index" in warning and "missing or damaged" in warning


@pytest.mark.thorough
@pytest.mark.parametrize("compression", few(COMPRESSIONS, ["lz4"], "thorough"))
@cases(75, 150)
def test_whatever_is_left_of_a_cut_bag_is_read(tmp_path, compression, count):
    whole = write_bag(tmp_path / "whole.bag", compression).read_bytes()
    ends = {len(MAGIC) + end: op for op, _, _, end in records(whole[len(MAGIC) :])}
    chunks = [end for end, op in ends.items() if op == CHUNK]
    assert len(chunks) > 5
    total = 0
    for cut in (0, 5, 13, 50, *range(4000, len(whole), len(whole) // count), *chunks, len(whole) - 1):
        channels, warning = recovered(tmp_path / "a.bag", whole[:cut])
        if channels is None:
            assert cut < chunks[len(chunks) // 2]  # the topic that begins last has no message yet
            continue
        assert ("breaks off" in warning) == (cut not in ends)
        for name, (first, factor) in {"command_left": (STEPS // 4, -1), "surge": (0, 5)}.items():
            steps = np.sort(channels[name].value / factor)  # some were received out of order
            np.testing.assert_allclose(steps, np.arange(first, first + len(steps)), rtol=1e-14)
            assert (np.diff(channels[name].time) >= 0).all() and (np.diff(channels[name].order) > 0).all()
        total = int(warning.split("recovered ")[1].split()[0])
    assert total == 4 * STEPS - STEPS // 4


def test_messages_of_a_chunk_that_was_never_closed_are_read(tmp_path):
    whole = write_bag(tmp_path / "whole.bag").read_bytes()
    expected, _ = Rosbag().read(tmp_path / "whole.bag", SOURCES)
    body, unchunked = whole[len(MAGIC) :], b""
    everything = b"".join(body[start:end] for op, _, start, end in records(body) if op == CHUNK)
    for op, place, start, end in records(body):
        unchunked += body[start:end] if op == CHUNK else body[place:end] if op == BAG_HEADER else b""
    channels, _ = recovered(tmp_path / "outside.bag", unindexed(MAGIC + unchunked))
    assert_equal(channels, expected)

    bag_header = next(body[place:end] for op, place, _, end in records(body) if op == BAG_HEADER)
    for compression, data in (("none", everything), ("bz2", bz2.compress(everything))):
        fields = (b"op=\5", b"compression=" + compression.encode(), b"size=" + bytes(4))
        header = b"".join(struct.pack("<I", len(field)) + field for field in fields)
        unclosed = struct.pack("<I", len(header)) + header + bytes(4) + data
        channels, _ = recovered(tmp_path / "unclosed.bag.active", unindexed(MAGIC + bag_header + unclosed))
        assert_equal(channels, expected)


def test_a_scan_ends_at_lost_writes_and_says_where(tmp_path):
    whole = write_bag(tmp_path / "whole.bag").read_bytes()
    ends = [end + len(MAGIC) for op, _, _, end in records(whole[len(MAGIC) :]) if op == CHUNK]
    place = ends[len(ends) // 2]
    (tmp_path / "a.bag").write_bytes(whole[:place] + bytes(5000))
    with pytest.warns(UserWarning, match=rf"a\.bag: .*breaks off in the one at byte {place} of {place + 5000}"):
        channels, _ = Rosbag().read(tmp_path / "a.bag", SOURCES)
    assert 0 < len(channels["surge"].time) < STEPS


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
def test_a_scan_ends_at_a_chunk_that_does_not_unpack_to_its_end(tmp_path, compression):
    """The chunk's record is whole, and so are those behind it: what it lacks is lost, not passed over in silence."""
    whole = write_bag(tmp_path / "whole.bag", compression).read_bytes()
    chunks = [each for each in records(whole[len(MAGIC) :]) if each[0] == CHUNK]
    _, place, start, end = (len(MAGIC) + x for x in chunks[len(chunks) // 2])
    data = whole[start : (start + end) // 2]
    broken = whole[: start - 4] + struct.pack("<I", len(data)) + data + whole[end:]
    channels, warning = recovered(tmp_path / "a.bag", unindexed(broken))
    assert f"breaks off in the one at byte {place} of {len(broken)}" in warning
    before, _ = recovered(tmp_path / "b.bag", unindexed(whole[:place]))
    count = len(before["surge"].time)
    assert 0 < count <= len(channels["surge"].time) < STEPS
    np.testing.assert_array_equal(channels["surge"].value[:count], before["surge"].value)


@over("content", [b"", MAGIC, MAGIC + bytes(9000), b"#ROSBAG V1.2\n", b"\xff" * 9000, b"PK\3\4"])
@over("name", ["a.bag", "a.bag.active", "a.mcap"])
def test_what_holds_no_message_is_refused(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(LogFormatError, match=r"whole ROS bag.*no message could be recovered"):
        Rosbag().read(tmp_path / name, SOURCES)


def test_a_folder_with_a_crashed_recording_is_read(tmp_path):
    whole = write_bag(tmp_path / "run_1.bag").read_bytes()
    (tmp_path / "run_2.bag.active").write_bytes(unindexed(whole))
    with pytest.warns(UserWarning, match=r"run_2\.bag\.active: .*not closed.*recovered"):
        first, second = read_recordings(tmp_path, Rosbag(), SOURCES)
    assert (first.run, second.run) == ("run_1", "run_2.bag")
    assert_equal(second.channels, first.channels)
