"""A survey gives each series of a log under a name and a field with which `read` finds the same numbers."""

import numpy as np
import pytest

from tests.support.bags import NS, START, ros2_types, unindexed, write_bag, write_ros2
from tests.support.files import assert_same_as_read
from usvlearn.errors import LogFormatError
from usvlearn.logs.formats.moos.alog import Alog
from usvlearn.logs.formats.ros.rosbag import LARGE, Rosbag
from usvlearn.logs.read import read_recordings


def test_an_alog_gives_its_numeric_variables_and_their_apps(tmp_path):
    path = tmp_path / "a.alog"
    path.write_text(
        "%% LOGSTART 1.5e9\n0.5 NAV_SPEED iGPS:aux 1.2\n0.6 NAV_SPEED iGPS \x1b[32m1.3\x1b[0m\n0.6 MODE pHelm DRIVE\n"
        "0.7 NAV_X iGPS 5\n0.8 NAV_X iSim 6\n0.9 NAV_SPEED iGPS off\nsoon NAV_SPEED iGPS 7\n1.0 A@B iGPS 7\n"
        "1.1 NOTE iSonar 3\n1.2 NOTE iSonar none\n1.3 NOTE iSonar none\n"  # numbers in fewer than half of its posts
    )
    with pytest.warns(UserWarning, match="skipped 1 lines that are no rows; variables of few numbers: A@B, NOTE$"):
        series = Alog().survey(path)
    assert [(each.name, each.kind, each.order.tolist()) for each in series] == [
        ("NAV_SPEED", "iGPS", [2, 3, 7]),
        ("NAV_X@iGPS", "iGPS", [5]),
        ("NAV_X@iSim", "iSim", [6]),
    ]
    np.testing.assert_array_equal(series[0].value, [1.2, 1.3, np.nan])
    assert_same_as_read(Alog(), path, series)
    path.write_text("nothing\n")
    with pytest.raises(LogFormatError, match="no row of the form"):
        Alog().survey(path)


@pytest.mark.parametrize("whole", [True, False])
def test_a_bag_gives_every_number_of_every_topic(tmp_path, whole):
    path = write_bag(tmp_path / "a.bag")
    if whole:
        series = Rosbag().survey(path)
    else:
        path.write_bytes(unindexed(path.read_bytes()))
        with pytest.warns(UserWarning, match="recovered"):
            series = Rosbag().survey(path)
    assert [(each.name, each.field) for each in series] == [
        ("/usv/left_thruster", "data"),
        ("/usv/right_thruster", "data"),
        *(("/usv/velocity", axis) for axis in "xyz"),
    ]
    assert {each.kind for each in series} == {"std_msgs/msg/Float64", "geometry_msgs/msg/Vector3"}
    if whole:
        assert_same_as_read(Rosbag(), path, series)


def test_ros_2_gives_yaw_arrays_that_grow_and_no_image_nor_constant(tmp_path):
    types = ros2_types()
    stamp = types["Time"](sec=START // NS, nanosec=NS // 2)
    header = types["Header"](stamp=stamp, frame_id="")

    def messages(k: int):
        layout = types["MultiArrayLayout"](dim=[], data_offset=0)
        yield "/thrust", types["Float64MultiArray"](layout=layout, data=np.arange(1.0, 1 + k))
        quaternion = types["Quaternion"](x=0.0, y=0.0, z=np.sin(0.1 * k), w=np.cos(0.1 * k))
        yield "/attitude", types["QuaternionStamped"](header=header, quaternion=quaternion)
        status = types["NavSatStatus"](status=1, service=2)
        yield "/status", status
        yield "/large", types["ByteMultiArray"](layout=layout, data=np.zeros(LARGE, np.uint8))

    path = write_ros2(tmp_path / "run", ((k * NS // 4, *post) for k in range(3) for post in messages(k)))
    with pytest.warns(UserWarning, match=r"/large \(.*ByteMultiArray\) is skipped, since a message has 65552 b"):
        series = {(each.name, each.field): each for each in Rosbag().survey(path)}
    fields = [*(f"quaternion{part}" for part in ("", ".x", ".y", ".z", ".w"))]
    assert list(series) == [
        *(("/attitude", field) for field in fields),
        ("/status", "status"),
        ("/status", "service"),
        ("/thrust", "layout.data_offset"),
        ("/thrust", "data.0"),
        ("/thrust", "data.1"),
    ]
    attitude = series["/attitude", "quaternion"]
    np.testing.assert_allclose(attitude.value, [0, 0.2, 0.4], atol=1e-15)
    np.testing.assert_allclose(attitude.time, 0.5, atol=1e-9)
    assert attitude.unit == "enu_rad" and attitude.kind == "geometry_msgs/msg/QuaternionStamped"
    np.testing.assert_array_equal(series["/thrust", "data.1"].value, [np.nan, np.nan, 2])


@pytest.mark.parametrize("plugin", ["MCAP", "SQLITE3"])
def test_a_folder_of_ros_2_is_one_bag_and_none_of_its_messages_is_lost(tmp_path, plugin):
    """Not even where its metadata names another policy than its files do, as older versions wrote it."""
    from rosbags.highlevel import AnyReader

    folder, number = tmp_path / "logs" / "run.1", ros2_types()["Float64"]
    posts = ((k * NS // 10, f"/{name}", number(data=0.1 * k)) for k in range(30) for name in ("l", "r", "psi", "v"))
    write_ros2(folder, posts, plugin)
    channels = {"command_left": "l", "command_right": "r", "heading": "psi", "surge": "v"}
    sources = {channel: {"name": name} for channel, name in channels.items()}
    for path, boat, run in ((folder, "run.1", "run.1"), (folder.parent, "logs", "run.1")):
        (recording,) = read_recordings(path, Rosbag(), sources)
        assert (recording.boat, recording.run) == (boat, run)
        np.testing.assert_allclose(recording.channels["surge"].value, 0.1 * np.arange(30))
    assert_same_as_read(Rosbag(), folder, Rosbag().survey(folder))

    metadata = folder / "metadata.yaml"
    text = metadata.read_text()
    zero = "sec: 0, nsec: 0"
    policy = f"- {{history: 3, depth: 0, reliability: 1, durability: 2, deadline: {{{zero}}}, lifespan: {{{zero}}}, "
    policy += f"liveliness: 1, liveliness_lease_duration: {{{zero}}}, avoid_ros_namespace_conventions: false}}"
    other = text.replace("offered_qos_profiles: []", f'offered_qos_profiles: "{policy}"')
    assert other != text
    metadata.write_text(other)
    with AnyReader([folder]) as bag:
        assert bag.message_count == 120 and not list(bag.messages())  # what rosbags makes of it
    assert [len(each.value) for each in Rosbag().survey(folder)] == [30] * 4
    metadata.write_text("rosbag2_bagfile_information: nothing")
    assert [len(each.value) for each in Rosbag().survey(folder)] == [30] * 4
    metadata.write_text(text)
    (data,) = folder.glob("*.[dm][bc]*")
    data.unlink()
    with pytest.raises(LogFormatError, match="no message could be recovered"):
        Rosbag().survey(folder)


def test_messages_that_are_announced_but_not_there_are_told(tmp_path, monkeypatch):
    from rosbags import highlevel

    path = write_bag(tmp_path / "a.bag")
    messages = highlevel.AnyReader.messages
    monkeypatch.setattr(highlevel.AnyReader, "messages", lambda *args: list(messages(*args))[:-2])
    with pytest.warns(UserWarning, match=r"a\.bag: found 148 of the 150 messages that this bag announces"):
        series = Rosbag().survey(path)
    assert len(series) == 5
