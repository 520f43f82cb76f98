"""A log of PX4 is read as its package reads it, and hostile ones are refused in bounded time and memory."""

import math
import struct
import sys

import numpy as np
import pytest

from tests.support import ROOT
from tests.support.files import assert_same_as_read
from tests.support.ulogs import block, boat, header, message, subscribe
from usvlearn.errors import LogFormatError, MissingExtraError
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.px4.ulog import Ulog
from usvlearn.logs.read import read_recordings

FOLDER = ROOT.parent / "shared" / "data" / "formats" / "ulog"


@pytest.fixture
def pyulog():
    return pytest.importorskip("pyulog", reason="needs the package pyulog")


def test_topics_instances_arrays_norms_and_yaw(tmp_path, pyulog):
    formats = {
        "attitude": "uint64_t timestamp;float[4] q;char[8] text;uint8_t[20] raw;",
        "speed": "uint64_t timestamp;float vx;float vy;point[2] at;",
        "point": "float x;float y;",
        "clockless": "float x;",
    }
    names = ["attitude", "speed", "clockless"]
    data = [header(formats), *(subscribe(k, name) for k, name in enumerate(names)), subscribe(9, "speed", 1)]
    for k in range(3):
        half = 0.1 * k
        data += [
            message(1, 10**6 * k + 1, "6f", 3, 4, 1, 2, 3, k),
            message(0, 10**6 * k, "4f8s20B", math.cos(half), 0, 0, math.sin(half), b"abc", *range(20)),
            message(9, 10**6 * k + 2, "6f", 6, 8, 0, 0, 0, 0),
        ]
    path = tmp_path / "a.ulg"
    path.write_bytes(b"".join(data))
    sources = {
        "surge": Source("speed", field="vx, vy"),
        "heading": Source("attitude", field="q"),
        "yaw_rate": Source("speed", field="at[1].y"),
        "command_left": Source("speed[1]", field="vx"),
    }
    channels, dropped = Ulog().read(path, sources)
    values = {name: channel.value.tolist() for name, channel in channels.items()}
    assert values["surge"] == [5, 5, 5] and values["yaw_rate"] == [0, 1, 2] and values["command_left"] == [6, 6, 6]
    np.testing.assert_allclose(values["heading"], [0, 0.2, 0.4], atol=1e-7)  # float32 in the log
    np.testing.assert_allclose(channels["heading"].time, [0, 1, 2], atol=1e-12)
    assert [channels[name].order.tolist() for name in ("heading", "surge", "command_left")] == [
        [0, 3, 6], [1, 4, 7], [2, 5, 8]]  # fmt: skip
    assert not any(dropped.values())
    series = {(each.name, each.field): each for each in Ulog().survey(path)}
    quaternion = ["q", *(f"q[{k}]" for k in range(4))]
    speed = ["vx", "vy", *(f"at[{k}].{axis}" for k in range(2) for axis in "xy")]
    assert list(series) == [
        *(("attitude", field) for field in quaternion), *((name, f) for name in ("speed", "speed[1]") for f in speed)
    ]  # fmt: skip
    assert series["attitude", "q"].unit == "rad" and series["speed[1]", "vx"].kind == "speed"
    assert_same_as_read(Ulog(), path, [*series.values()])


@pytest.mark.parametrize("name", ["sample_log_small.ulg", "sample_appended_multiple.ulg"])
def test_a_log_of_px4_has_the_numbers_that_pyulog_finds(name, pyulog):
    if not (path := FOLDER / name).is_file():
        pytest.skip("recorded logs are not part of the repository and are not beside it")
    log = pyulog.ULog(str(path))
    series = {(each.name, each.field): each for each in Ulog().survey(path)}
    assert len(series) > 200
    compared = 0
    for data in log.data_list:
        topic = data.name + f"[{data.multi_id}]" * (data.multi_id > 0)
        for field, expected in data.data.items():
            if (topic, field) in series:
                each = series[topic, field]
                np.testing.assert_array_equal(each.value, expected.astype(float))
                stamps = (data.data["timestamp"].astype(np.int64) - log.start_timestamp) * 1e-6
                np.testing.assert_array_equal(each.time, stamps)
                compared += 1
    assert compared == sum(each.unit != "rad" for each in series.values())  # that is a yaw
    orders = np.concatenate([{each.name: each.order for each in series.values()}[n] for n in {k[0] for k in series}])
    assert len(np.unique(orders)) == len(orders)


def test_what_is_not_there_is_named(tmp_path, pyulog):
    path = tmp_path / "a.ulg"
    path.write_bytes(boat([(0.1 * k, 0.5, 0.5, 90, 1) for k in range(3)]))
    for source, expected in {
        ("motor", None): "no channel 'motor'.*Did you mean motors",
        ("motion", None): "no field '' in motion.*timestamp, psi, v",
        ("motion", "q"): "no field 'q' in motion",
    }.items():
        with pytest.raises(LogFormatError, match=expected):
            Ulog().read(path, {"surge": Source(source[0], field=source[1])})
    path.write_bytes(b"not a log of PX4")
    with pytest.raises(LogFormatError, match="expected a ULog of PX4"):
        Ulog().survey(path)
    path.write_bytes(boat([]))
    with pytest.raises(LogFormatError, match="no message of 'motion'"):
        Ulog().read(path, {"surge": Source("motion", field="v")})


def test_a_topic_without_a_time_is_named(tmp_path, pyulog):
    formats = {"speed": "uint64_t timestamp;float vx;", "old": "uint32_t timestamp;float x;"}
    data = [header(formats), subscribe(0, "speed"), subscribe(1, "old")]
    data += [message(0, 10**6 * k, "f", 1) for k in range(3)]
    (tmp_path / "a.ulg").write_bytes(b"".join([*data, message(1, 7, "")]))
    with pytest.warns(UserWarning, match="skipped the topic old, which has no timestamp in us"):
        assert [each.name for each in Ulog().survey(tmp_path / "a.ulg")] == ["speed"]


def test_a_damaged_log_is_read_with_a_warning(tmp_path, pyulog):
    whole = boat([(0.1 * k, 0.5, 0.5, 90, 1) for k in range(30)])
    place = whole.index(message(1, 1_000_001, "fd", 90, 1))
    (tmp_path / "a.ulg").write_bytes(whole[:place] + block("D", struct.pack("<HQ", 77, 0)) + whole[place:])
    with pytest.warns(UserWarning, match="a.ulg: this log is damaged"):
        channels, _ = Ulog().read(tmp_path / "a.ulg", {"surge": Source("motion", field="v")})
    assert len(channels["surge"].value) == 30


def test_damaged_numbers_do_not_warn(tmp_path, pyulog):
    """A signalling NaN, and speeds whose square overflows."""
    path = tmp_path / "a.ulg"
    data = header({"v": "uint64_t timestamp;float psi;double x;double y;"}) + subscribe(0, "v")
    path.write_bytes(
        data + message(0, 0, "4s2d", struct.pack("<I", 0x7F800001), 1e300, 1e300) + message(0, 1, "f2d", 1, 3, 4)
    )
    psi, *_ = Ulog().survey(path)
    np.testing.assert_array_equal(psi.value, [np.nan, 1])
    channels, _ = Ulog().read(path, {"surge": Source("v", field="x, y")})
    np.testing.assert_allclose(channels["surge"].value, [math.sqrt(2) * 1e300, 5])


def test_a_field_whose_name_is_lost_is_left_out(tmp_path, pyulog):
    path = tmp_path / "a.ulg"
    data = header({"v": "uint64_t timestamp;float ;float x;"}) + subscribe(0, "v")
    path.write_bytes(data + message(0, 0, "2f", 1, 2))
    assert [(each.field, each.value.tolist()) for each in Ulog().survey(path)] == [("x", [2])]


@pytest.mark.parametrize(
    "formats",
    [
        {"a": "uint64_t timestamp;b[60000] b;", "b": "c[60000] c;", "c": "float[60000] x;"},
        {"a": "uint64_t timestamp;a a;"},
        {"a": "uint64_t timestamp;b[60000] b;", "b": "c[60000] c;", "c": ""},
        {"a": "uint64_t timestamp;float[40000] x;"},
    ],
)
def test_types_with_millions_of_fields_are_refused(tmp_path, pyulog, formats):
    path = tmp_path / "a.ulg"
    path.write_bytes(header(formats) + b"".join(subscribe(k, "a") for k in range(100)))
    with pytest.raises(LogFormatError, match="more than 50000 fields in all"):
        Ulog().survey(path)


def test_without_pyulog_the_extra_is_named(tmp_path, monkeypatch):
    (tmp_path / "a.ulg").write_bytes(boat([]))
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'usvlearn\[logs\]'"):
        read_recordings(
            tmp_path / "a.ulg",
            Ulog(),
            {name: {"name": "motion", "field": "v"} for name in ("command_left", "command_right", "heading", "surge")},
        )


def test_damage_in_which_pyulog_would_go_round_for_ever_is_refused(tmp_path, pyulog):
    """It steps back by the size that a message declares, though the file ended before."""
    path = tmp_path / "a.ulg"
    path.write_bytes(header({}) + 25_000 * block("I", b"") + struct.pack("<HB", 60_000, 0) + b"ab")
    with pytest.raises(LogFormatError, match="damage in which pyulog finds no end"):
        Ulog().survey(path)


@pytest.mark.parametrize("topic", ["vehicle_gps_position", "sensor_gps"])
def test_a_log_begins_when_its_receiver_says(tmp_path, pyulog, topic):
    formats = {topic: "uint64_t timestamp;uint64_t time_utc_usec;", "speed": "uint64_t timestamp;float v;"}
    for fix, start in ((1_717_406_100_000_000, 1717406098.5), (0, math.nan)):
        data = [header(formats), subscribe(0, topic), subscribe(1, "speed"), message(0, 0, "Q", 0)]
        data += [message(0, 1_500_000, "Q", fix), message(1, 2_000_000, "f", 1)]
        (tmp_path / "a.ulg").write_bytes(b"".join(data))
        channels, _ = Ulog().read(tmp_path / "a.ulg", {"surge": Source("speed", "v")})
        assert channels["surge"].start == pytest.approx(start, abs=1e-3, nan_ok=True)
