"""Readers give what the log holds, in its order and in SI units, and say in one sentence why they cannot."""

import math
import time
from pathlib import Path

import numpy as np
import pytest

from tests.support.bags import NS, START, ros2_types, write_ros2
from tests.support.files import configured, one, refused, write
from usvlearn.errors import ConfigError, LogFormatError, MissingExtraError
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.formats.moos.alog import Alog
from usvlearn.logs.formats.ros.message_fields import yaw
from usvlearn.logs.formats.ros.rosbag import Rosbag

# ---------------------------------------------------------------- CSV


def test_table_converts_to_si_with_zero_span_and_a_reversed_side(tmp_path):
    path = write(tmp_path / "a.csv", "t,l,psi,v\n0,1511,90,-0.5\n1,1111,-180,2\n")
    sources = {
        "command_left": Source("l", zero=1511, span=-400, held=True, window=0.7),
        "heading": Source("psi", unit="deg"),
        "surge": Source("v", unit="knots"),
    }
    channels, dropped = Table("t").read(path, sources)
    np.testing.assert_array_equal(channels["command_left"].value, [0.0, 1.0])
    np.testing.assert_allclose(channels["heading"].value, [math.pi / 2, -math.pi], rtol=1e-15)
    np.testing.assert_allclose(channels["surge"].value, np.array([-0.5, 2]) * 1852 / 3600, rtol=1e-15)
    assert channels["command_left"].held and channels["command_left"].window == 0.7
    assert not channels["surge"].held and channels["surge"].window == 0.2
    assert dropped == {"command_left": {}, "heading": {}, "surge": {}}
    assert all(c.time.dtype == c.value.dtype == np.float64 and c.order.dtype == np.int64 for c in channels.values())


def test_table_counts_bad_cells_by_cause_and_keeps_line_numbers(tmp_path):
    rows = "0,1,\n0.1,1,nan\n0.2,1,off\n0.3,1,1.5\n\n,1,1.6\n0.4,1\n0.5,1,1.7,,\n0.6,1,inf\n0.7,1,9,9\n"
    path = write(tmp_path / "a.csv", "\ufefft,L,v\n" + rows.replace("\n", "\r\n"))
    channel, dropped = one(Table("t"), path, name="v")
    np.testing.assert_array_equal(channel.value, [1.5, 1.7])
    np.testing.assert_array_equal(channel.time, [0.3, 0.5])
    np.testing.assert_array_equal(channel.order, [5, 9])
    assert dropped == {"empty": 1, "not_a_number": 3, "no_time": 1, "torn_row": 2}


def test_table_drops_cells_not_rows(tmp_path):
    path = write(tmp_path / "a.csv", "t,L,v\n0,1,\n1,2,3\n")
    channels, dropped = Table("t").read(path, {"command_left": Source("L"), "surge": Source("v")})
    np.testing.assert_array_equal(channels["command_left"].order, [2, 3])
    np.testing.assert_array_equal(channels["surge"].order, [3])
    assert dropped == {"command_left": {}, "surge": {"empty": 1}}


def test_readers_keep_backward_repeated_and_burst_stamps_and_outages_in_file_order(tmp_path):
    stamps = [10.0, 10.0, 9.5, 10.0002, 10.0004, 121.0]
    path = write(tmp_path / "a.csv", "t,v\n" + "".join(f"{t},1\n" for t in stamps))
    channel, _ = one(Table("t"), path, name="v")
    np.testing.assert_allclose(channel.time, np.array(stamps) - 10, atol=1e-12)  # 10 - 9.5 etc. are exact
    path = write(tmp_path / "a.alog", "".join(f"{t} NAV_SPEED iGPS 1\n" for t in stamps))
    channel, dropped = one(Alog(), path, name="NAV_SPEED")
    np.testing.assert_array_equal(channel.time, stamps)
    np.testing.assert_array_equal(channel.order, [1, 2, 3, 4, 5, 6])
    assert dropped == {}


@pytest.fixture
def elsewhere(monkeypatch):
    """A computer whose clock is five hours behind UTC."""
    monkeypatch.setenv("TZ", "EST5")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.parametrize(
    ("unit", "cells"),
    [
        ("s", ("1721841528.25", "1721841528.5")),
        ("ms", ("1444243.083", "1444493.083")),
        ("us", ("1721841528000000", "1721841528250000")),
        ("ns", ("1721841528000000000", "1721841528250000000")),
        ("s", ("2025-07-24 17:18:48.207", "2025-07-24 17:18:48.457")),
        ("s", ("2025-07-24T17:18:48.900", "2025-07-24T17:18:49.150Z")),
        ("s", ("2025-07-24T17:18:48.9+02:00", "2025-07-24T15:18:49.15+00:00")),
        ("s", ("2025/12/31 23:59:59.9", "2026/01/01 00:00:00.15")),
    ],
)
def test_table_time_is_seconds_since_the_first_stamp(tmp_path, elsewhere, unit, cells):
    path = write(tmp_path / "a.csv", "t,v\n,0\n" + "".join(f"{cell},1\n" for cell in cells))
    channel, dropped = one(Table("t", time_unit=unit), path, name="v")
    np.testing.assert_allclose(channel.time, [0, 0.25], atol=1e-6)  # Unix time in float64 resolves 0.24 us
    assert dropped == {"no_time": 1}


def test_table_with_another_delimiter_a_commented_header_and_a_lost_write(tmp_path):
    path = write(tmp_path / "a.csv", "# t; ; v\n0;0;1.5\n\0\0\0\0\n1;1; 2.5 \n")
    channel, dropped = one(Table("t", delimiter=";"), path, name="v")
    np.testing.assert_array_equal(channel.value, [1.5, 2.5])
    assert dropped == {"torn_row": 1}


def test_a_source_whose_numbers_are_out_of_range_is_refused():
    for option, values in {
        "span": (0, math.nan, math.inf),
        "window": (0, math.nan),
        "delay": (-1, math.inf),
        "missing": ("9", ["x"]),
    }.items():
        for value in values:
            assert f"{option}: found" in refused(ConfigError, Source, "v", **{option: value})


# ---------------------------------------------------------------- MOOS

ALOG = """\
%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%%
%% FILE OPENED ON  Wed Dec 31 19:00:00 1969
%% LOGSTART               1616339425.37
-67301.667      IVPHELM_LIFE_EVENT   pHelmIvP        time=15.04, iter=1, bname=waypt_return
-981.671        NAV_SPEED            pEchoVar        0.00000
0.500           IVPHELM_REGISTER     pHelmIvP        NAV_SPEED
0.855           NAV_SPEED            pEchoVar        -0.25000
0.855           NAV_SPEED            pEchoVar        -0.25000
0.856           NAV_SPEED            iSim:truth      0.31000
0.857           NAV_SPEED_OVER_GROUND iSim           0.9
0.858           NAV_SPEED            pEchoVar
0.859           NAV_SPEED            pEchoVar        \x1b[7;32m0.50\x1b[0m
0.860           NAV_SPEED            pEchoVar        \x1b[7;31mNO FIX, WAITING\x1b[0m
0.861           DB_STATUS            MOOSDB_a        caf\udce9 NAV_SPEED 3 4
soon            NAV_SPEED            pEchoVar        7
nan             NAV_SPEED            pEchoVar        8
0.870           NAV_SPEED            pEchoVar        nan
"""


def test_alog_reads_only_rows_of_the_variable(tmp_path):
    path = write(tmp_path / "a.alog", ALOG)
    channel, dropped = one(Alog(), path, name="NAV_SPEED")
    np.testing.assert_array_equal(channel.value, [0, -0.25, -0.25, 0.31, 0.5])
    np.testing.assert_array_equal(channel.time, [-981.671, 0.855, 0.855, 0.856, 0.859])
    np.testing.assert_array_equal(channel.order, [5, 7, 8, 9, 12])
    assert dropped == {"empty": 1, "not_a_number": 2, "no_time": 1}


def test_alog_picks_one_app_of_several(tmp_path):
    path = write(tmp_path / "a.alog", ALOG)
    np.testing.assert_array_equal(one(Alog(), path, name="NAV_SPEED@iSim")[0].value, [0.31])
    np.testing.assert_array_equal(one(Alog(), path, name="NAV_SPEED@pEcho*")[0].value, [0, -0.25, -0.25, 0.5])
    message = refused(LogFormatError, one, Alog(), path, name="NAV_SPEED@pEcho")
    assert "NAV_SPEED@pEchoVar" in message and "NAV_SPEED@iSim" in message


def test_binary_data_that_look_like_rows_of_an_alog_are_none(tmp_path):
    path = write(tmp_path / "a.alog", "1 \x01 \x02 3\n2 caf\udce9 pApp 4\n")
    assert "no row of the form" in refused(LogFormatError, one, Alog(), path, name="NAV_SPEED")


# ---------------------------------------------------------------- ROS


def write_bag(path: Path, topics: dict[str, tuple[str, list]]):
    """A ROS 1 bag of topic -> (type, [(received ns, stamp ns or None, {field: value})])."""
    from rosbags import rosbag1
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    drive = "Header header\nfloat32 left\nfloat32 right\n"
    store.register(get_types_from_msg(drive, "heron_msgs/msg/Drive"))
    build = store.types

    def header(stamp):
        clock = build["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        return build["std_msgs/msg/Header"](seq=0, stamp=clock, frame_id="")

    def made(value):  # ("Vector3", {...}) stands for such a message
        if not isinstance(value, tuple):
            return value
        return build[f"geometry_msgs/msg/{value[0]}"](**{name: made(part) for name, part in value[1].items()})

    with rosbag1.Writer(path) as bag:
        for topic, (kind, messages) in topics.items():
            connection = bag.add_connection(topic, kind, typestore=store)
            for received, stamp, values in messages:
                extra = {} if stamp is None else {"header": header(stamp)}
                message = build[kind](**extra, **{name: made(value) for name, value in values.items()})
                bag.write(connection, received, store.serialize_ros1(message, kind))
    return path


def floats(*pairs):
    return "std_msgs/msg/Float64", [(START + int(t * NS), None, {"data": value}) for t, value in pairs]


def test_rosbag_reads_topics_fields_norms_and_receive_times(tmp_path):
    vector = [(START + 2 * NS, None, {"x": 3.0, "y": -4.0, "z": 0.1})]
    topics = {
        "/usv/left_thruster": floats((0, 36.5), (1, math.nan), (1.0002, -73)),
        "/usv/local_vel": ("geometry_msgs/msg/Vector3", vector),
    }
    path = write_bag(tmp_path / "a.bag", topics)
    sources = {
        "command_left": Source("*left_thruster", span=36.5),
        "surge": Source("usv/local_vel", field="x, y"),
        "yaw_rate": Source("/usv/local_vel", field="z", unit="enu_rad/s"),
    }
    channels, dropped = Rosbag().read(path, sources)
    np.testing.assert_array_equal(channels["command_left"].value, [1, -2])
    np.testing.assert_allclose(channels["command_left"].time, [0, 1.0002], atol=1e-9)
    np.testing.assert_array_equal(channels["command_left"].order, [0, 2])
    np.testing.assert_array_equal(channels["surge"].value, [5.0])
    np.testing.assert_array_equal(channels["yaw_rate"].value, [-0.1])
    assert dropped == {"command_left": {"not_a_number": 1}, "surge": {}, "yaw_rate": {}}


def test_rosbag_prefers_header_stamps_unless_their_clock_was_never_set(tmp_path):
    received, sent = START + NS, START + NS // 2
    messages = [
        (received, sent, {"left": 0.5, "right": 0.5}),
        (received + NS, 0, {"left": 0.25, "right": 0.5}),  # stamp left at zero
    ]
    topics = {"/first": floats((0, 0)), "/cmd_drive": ("heron_msgs/msg/Drive", messages)}
    path = write_bag(tmp_path / "a.bag", topics)
    source = {"name": "cmd_drive", "field": "left"}
    np.testing.assert_allclose(one(Rosbag(), path, **source)[0].time, [0.5, 2.0], atol=1e-9)
    np.testing.assert_allclose(one(Rosbag(clock="receive"), path, **source)[0].time, [1.0, 2.0], atol=1e-9)


def test_rosbag_config_reads_a_heron(tmp_path):
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}
    half = math.sqrt(0.5)  # yaw 90 deg from east, counter-clockwise: north
    imu = {
        "orientation": ("Quaternion", {"x": 0.0, "y": 0.0, "z": half, "w": half}),
        "angular_velocity": ("Vector3", {**zero, "z": 0.2}),
        "linear_acceleration": ("Vector3", zero),
        **{f"{name}_covariance": np.zeros(9) for name in ("orientation", "angular_velocity", "linear_acceleration")},
    }
    speed = {"linear": ("Vector3", {"x": -0.6, "y": 0.8, "z": 5.0}), "angular": ("Vector3", zero)}
    topics = {
        "/heron/cmd_drive": ("heron_msgs/msg/Drive", [(START, START, {"left": 0.5, "right": -1.0})]),
        "/heron/imu/data": ("sensor_msgs/msg/Imu", [(START, START, imu)]),
        "/heron/imu/data_raw": ("sensor_msgs/msg/Imu", [(START, START, imu)]),
        "/heron/navsat/vel": (
            "geometry_msgs/msg/TwistStamped",
            [(START, START, {"twist": ("Twist", speed)})],
        ),
    }
    (recording,) = configured("rosbag", write_bag(tmp_path / "heron.bag", topics))
    values = {name: channel.value[0] for name, channel in recording.channels.items()}
    expected = {"command_left": 0.5, "command_right": -1, "heading": 0, "yaw_rate": -0.2, "surge": 1}
    assert values == pytest.approx(expected, abs=1e-15)


def test_rosbag_reads_ros2_and_elements_of_arrays(tmp_path):
    types = ros2_types()
    layout = types["MultiArrayLayout"](dim=[], data_offset=0)
    arrays = (types["Float64MultiArray"](layout=layout, data=np.array([k, -2.0 * k])) for k in range(3))
    path = write_ros2(tmp_path / "run", ((k * NS, "/thrust", each) for k, each in enumerate(arrays)))
    channel, _ = one(Rosbag(), path, name="thrust", field="data.1")
    np.testing.assert_array_equal(channel.value, [0, -2, -4])
    np.testing.assert_allclose(channel.time, [0, 1, 2], atol=1e-9)


@pytest.mark.parametrize("angle", [-3.0, -1.0, 0.0, 0.5, 2.5])
def test_yaw_of_a_quaternion_is_its_angle_about_z_whatever_its_length(angle):
    quaternion = 0.0, 0.0, 3 * math.sin(angle / 2), 3 * math.cos(angle / 2)
    assert yaw(*quaternion) == pytest.approx(angle, abs=1e-15)
    assert math.isnan(yaw(0.0, 0.0, 0.0, 0.0))


def test_rosbag_without_rosbags_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    message = refused(MissingExtraError, one, Rosbag(), tmp_path / "a.bag", name="v")
    assert "pip install 'usvlearn[logs]'" in message and "rosbags" in message


def test_rosbag_errors_name_the_fields_the_topics_and_the_damage(tmp_path):
    vector = ("geometry_msgs/msg/Vector3", [(START, None, {"x": 3.0, "y": 4.0, "z": 0.0})])
    twist = {
        "linear": ("Vector3", {"x": 1.0, "y": 0.0, "z": 0.0}),
        "angular": ("Vector3", {"x": 0.0, "y": 0.0, "z": 0.0}),
    }
    topics = {"/vel": vector, "/twist": ("geometry_msgs/msg/Twist", [(START, None, twist)])}
    path = write_bag(tmp_path / "a.bag", topics)
    message = refused(LogFormatError, one, Rosbag(), path, name="vel")
    assert "data.channels.surge.field" in message and "'data'" in message and "x, y, z" in message
    message = refused(LogFormatError, one, Rosbag(), path, name="twist", field="linear")
    assert "expected a number in 'linear'" in message and "x, y, z" in message
    message = refused(LogFormatError, one, Rosbag(), path, name="speed")
    assert "data.channels.surge.name" in message and "/twist, /vel" in message

    assert "no row of the form" in refused(LogFormatError, one, Alog(), path, name="speed")
    assert "binary data" in refused(LogFormatError, one, Table("t"), path, name="speed")
    whole = path.read_bytes()
    place = whole.index(b"index_pos=") + len("index_pos=")
    (tmp_path / "b.bag").write_bytes(whole[:place] + bytes(8) + whole[place + 8 :])
    with pytest.warns(UserWarning, match=r"b\.bag: the index .* missing or damaged .*recovered 2 messages"):
        assert one(Rosbag(), tmp_path / "b.bag", name="vel", field="x")[0].value == [3.0]
    (tmp_path / "c.bag").write_bytes(whole[:4200])  # ends before the first message
    assert "c.bag" in refused(LogFormatError, one, Rosbag(), tmp_path / "c.bag", name="vel", field="x")
