"""The part of the ROS 2 node that needs no rclpy: topics, fields, stamps and what is published.

`test_ros2_node.py` tries the same against a real rclpy.
"""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from tests.support import over
from tests.support.bags import ros2_types, write_ros2
from tests.support.live import NotedSession, health
from tests.support.ros2 import like_rclpy, rclpy_class
from usvlearn.core.forecasts import Track
from usvlearn.errors import ConfigError, LogFormatError
from usvlearn.live.plan_requests import Point
from usvlearn.live.ros2 import shell
from usvlearn.live.ros2.messages import AUXILIARY, CLASSES, NS, UNKNOWN, Messages, Outputs, choose_topics, message_class
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.ros.message_fields import FIELDS, default_field, read_field
from usvlearn.logs.formats.ros.rosbag import Rosbag

rosbags = pytest.importorskip("rosbags.typesys", reason="needs the package rosbags")
ODOMETRY, NUMBER = "nav_msgs/msg/Odometry", "std_msgs/msg/Float64"
START = 1_700_000_000


def odometry(stamp: float, surge: float = 1.0, yaw: float = 0.0, rate: float = 0.0):
    message = rclpy_class(ODOMETRY)()
    message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), round(stamp % 1 * NS)
    message.twist.twist.linear.x, message.twist.twist.angular.z = surge, rate
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    return message


# fields


def test_the_default_fields_are_those_of_the_types():
    """Each is a field of the message, and the one that has the value."""
    for kind, fields in FIELDS.items():
        for part, field in fields.items():
            message = rclpy_class(kind)()
            assert math.isfinite(read_field(message, field, part)) or part == "heading", (kind, part)
            assert default_field(kind, part) == field
    message = odometry(0.0, surge=1.5, yaw=0.25, rate=-0.5)
    assert read_field(message, default_field(ODOMETRY, "surge"), "") == 1.5
    assert read_field(message, default_field(ODOMETRY, "yaw_rate"), "") == -0.5
    assert read_field(message, default_field(ODOMETRY, "heading"), "") == pytest.approx(0.25)
    assert default_field("std_msgs/msg/Float64", "command_left[1]") == default_field("a/msg/B", "surge") == "data"


def test_fields_of_rclpy_are_read_as_those_of_a_bag():
    """Arrays, norms, quaternions, octets; and an error names what there is."""
    message = odometry(0.0, surge=3.0)
    message.twist.twist.linear.y = 4.0
    assert read_field(message, "twist.twist.linear.x, twist.twist.linear.y", "") == 5.0
    assert read_field(message, "pose.covariance.35", "") == 0.0
    array = rclpy_class("std_msgs/msg/Float64MultiArray")(data=[0.5, 0.25])
    assert read_field(array, "data.1", "") == 0.25
    for raw, number in ((b"5", 53.0), (b"\xfe", -2.0)):  # not the digit 5; with a sign, as from a bag
        assert read_field(rclpy_class("std_msgs/msg/Byte")(data=raw), "data", "") == number
    assert read_field(rclpy_class("std_msgs/msg/Bool")(data=True), "data", "") == 1.0
    with pytest.raises(
        LogFormatError, match=r"surge: no field 'speed' in 'twist.speed'. .*covariance, twist|twist, cov"
    ):
        read_field(message, "twist.speed", "surge")
    with pytest.raises(LogFormatError, match=r"expected a number in 'header'\. The fields here are: stamp, frame_id"):
        read_field(message, "header", "surge")
    with pytest.raises(LogFormatError, match="It holds str"):
        read_field(rclpy_class("std_msgs/msg/String")(data="fast"), "data", "surge")
    with pytest.raises(LogFormatError, match="no field '9'"):
        read_field(array, "data.9", "surge")


# topics


def chosen(sources, graph, current=None, namespace="/", remap=None):
    resolve = lambda name: (remap or {}).get(name) or (name if name[0] == "/" else f"{namespace.rstrip('/')}/{name}")  # noqa: E731
    return choose_topics(sources, graph, lambda topic: graph.get(topic, []), resolve, namespace, current)


def test_a_topic_is_chosen_by_name_pattern_namespace_and_remapping():
    sources = {
        "surge": Source("*odom"),
        "command_left": Source("left"),
        "command_right": Source("/x/right", field="data.1"),
    }
    graph = {"/a/odom": [ODOMETRY], "/b/odom": [ODOMETRY], "/a/left": [NUMBER], "/other": [NUMBER],
             "/x/right": ["std_msgs/msg/Float64MultiArray"]}  # fmt: skip
    choice = chosen(sources, graph, namespace="/a")
    assert choice.topics == {"/a/odom": ODOMETRY, "/a/left": NUMBER, "/x/right": "std_msgs/msg/Float64MultiArray"}
    assert choice.fields == {"/a/odom": {"surge": "twist.twist.linear.x"}, "/a/left": {"command_left": "data"},
                            "/x/right": {"command_right": "data.1"}}  # fmt: skip
    assert choice.problems == {}
    choice = chosen(sources, graph, remap={"left": "/other"})
    assert choice.topics == {"/other": NUMBER, "/x/right": "std_msgs/msg/Float64MultiArray"}
    assert choice.problems == {"surge": "/a/odom, /b/odom match *odom: set channels.surge.name to one of them"}


def test_a_topic_that_is_subscribed_to_stays_until_its_type_changes():
    sources = {"surge": Source("*odom")}
    current = {"/a/odom": ODOMETRY}
    assert chosen(sources, {}).problems == {"surge": "no topic below / matches *odom yet"}
    assert chosen({"surge": Source("v")}, {}).problems == {"surge": "nobody publishes /v yet"}
    gone = chosen(sources, {"/a/odom": []}, current)
    assert gone.topics == current and gone.problems == {"surge": "nobody publishes /a/odom any more"}
    other = chosen(sources, {"/a/odom": [ODOMETRY], "/b/odom": [ODOMETRY]}, current)  # another boat comes
    assert other.topics == current and "match *odom" in other.problems["surge"]
    both = chosen(sources, {"/a/odom": [NUMBER, ODOMETRY]}, current)
    assert both.topics == current and "published as std_msgs/msg/Float64, too: only nav" in both.problems["surge"]
    changed = chosen(sources, {"/a/odom": [NUMBER]}, current)
    assert changed.topics == {"/a/odom": NUMBER} and changed.problems == {}
    new = chosen(sources, {"/a/odom": [NUMBER, ODOMETRY]})
    assert new.topics == {} and "let it have one type" in new.problems["surge"]


def test_a_type_that_is_not_installed_is_refused_in_one_sentence():
    for kind in ("heron_msgs/msg/Drive", "os/path/join", "../a/msg/B", "usvlearn/msg/B"):
        with pytest.raises(ConfigError, match="not installed here: source the workspace"):
            message_class(kind)


# time


FIELDS_OF = {"surge": "twist.twist.linear.x", "heading": "pose.pose.orientation"}


def test_a_message_has_the_stamp_of_its_header_or_the_clock_of_its_receipt():
    session = NotedSession()
    messages = Messages(session)
    messages.take("/odom", FIELDS_OF, odometry(START + 0.25, 1.5, 0.5), (START + 1) * NS)
    assert session.pushed == [("surge", START + 0.25, 1.5), ("heading", START + 0.25, pytest.approx(0.5))]
    messages.take("/left", {"command_left": "data"}, rclpy_class(NUMBER)(data=0.5), (START + 2) * NS)
    assert session.pushed[-1] == ("command_left", START + 2, 0.5) and not messages.sentences()
    messages.take("/odom", FIELDS_OF, odometry(0.0), int((START + 2.5) * NS))  # the stamp was never set
    assert session.pushed[-1][1] == START + 2.5 and not messages.sentences()
    for wrong in (START - 3600.0, START + 3600.0):  # a clock that is wrong by an hour
        messages.take("/odom", FIELDS_OF, odometry(wrong), (START + 3) * NS)
        assert session.pushed[-1][1] == START + 3
        (sentence,) = messages.sentences()
        assert "the time of receipt is used" in sentence and ("ahead of" in sentence) == (wrong > START)
    messages.take("/odom", FIELDS_OF, odometry(START + 3.5), (START + 3) * NS)
    assert session.pushed[-1][1] == START + 3.5 and not messages.sentences()
    receive = Messages(session, clock="receive")
    receive.take("/odom", FIELDS_OF, odometry(START), int((START + 0.5) * NS))
    assert session.pushed[-1][1] == START + 0.5 and session.restarts == 0


def test_a_clock_that_steps_back_begins_a_new_segment():
    session = NotedSession()
    real, simulated = Messages(session), Messages(session, simulated=True)
    for second, restarts in ((10, 0), (9.5, 0), (9.0, 0), (10, 0), (8.9, 1), (8.95, 1), (3609.0, 1), (9.0, 2)):
        real.notice(int((START + second) * NS))
        assert session.restarts == restarts, second
    session.restarts = 0
    for second, restarts in ((0, 0), (5, 0), (4.999, 1), (9, 1), (0, 2), (0.1, 2)):
        simulated.notice(int(second * NS))
        assert session.restarts == restarts, second


def test_simulated_time_is_obeyed_and_needs_a_clock():
    session = NotedSession()
    messages = Messages(session, simulated=True)
    messages.take("/left", {"command_left": "data"}, rclpy_class(NUMBER)(data=0.5), 0)
    assert session.dropped == [("command_left", "no_time")] and not session.pushed
    assert any("nobody publishes /clock" in each for each in messages.sentences())
    messages.take("/left", {"command_left": "data"}, rclpy_class(NUMBER)(data=0.5), 7 * NS)
    messages.take("/odom", FIELDS_OF, odometry(12.5), 7 * NS)  # a clock that is published seldom, at a high speed
    assert [stamp for _, stamp, _ in session.pushed] == [7.0, 12.5, 12.5] and not messages.sentences()
    messages.take("/odom", FIELDS_OF, odometry(3600.0), NS)  # sent before the reset of the clock
    assert session.restarts == 1 and session.pushed[-1][1] == 1.0


@over("value", [math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324])
def test_numbers_of_any_size_are_pushed(value):
    session = NotedSession()
    messages = Messages(session)
    message = odometry(START, value)
    message.twist.twist.linear.y = message.pose.pose.orientation.z = message.pose.pose.orientation.x = value
    fields = {"surge": "twist.twist.linear.x", "ground_speed": "twist.twist.linear.x,twist.twist.linear.y",
              "heading": "pose.pose.orientation"}  # fmt: skip
    messages.take("/odom", fields, message, START * NS)
    assert session.pushed[0][2] == value or math.isnan(value)
    assert len(session.pushed) == 3 and not session.dropped


def test_a_message_of_another_kind_is_counted_and_told():
    session = NotedSession()
    messages = Messages(session)
    text, fields = rclpy_class("std_msgs/msg/String")(data="fast"), {"command_left": "data", "surge": "twist.linear.x"}
    for _ in range(3):
        messages.take("/left", fields, text, START * NS)
    assert session.dropped == [("command_left", "wrong_type"), ("surge", "wrong_type")] * 3 and not session.pushed
    assert len(messages.sentences()) == 2 and "command_left" in messages.sentences()[0]
    messages.take("/left", {"command_left": "data"}, rclpy_class(NUMBER)(data=1.0), START * NS)
    assert not messages.sentences() and session.numbers("command_left") == [1.0]


# a bag


def test_a_bag_gives_what_its_messages_would_have_given_live(tmp_path):
    """The live node's stamps, fields and defaults are those of the reader of bags."""
    from rosbags.highlevel import AnyReader

    types, rng, posts = ros2_types(), np.random.default_rng(0), []

    def odom(stamp: int):
        pose = types["Pose"](types["Point"](0.0, 0.0, 0.0), types["Quaternion"](*rng.normal(size=4)))
        twist = types["Twist"](*(types["Vector3"](*rng.normal(size=3)) for _ in range(2)))
        both = types["PoseWithCovariance"](pose, np.zeros(36)), types["TwistWithCovariance"](twist, np.zeros(36))
        return types["Odometry"](types["Header"](types["Time"](stamp // NS, stamp % NS), ""), "base_link", *both)

    for k in range(200):
        received = k * NS // 10 + int(rng.integers(1000))
        now = START * NS + received
        late = {3: 2 * NS, 4: -2 * NS, 5: now}.get(k % 7, int(rng.integers(NS // 5)))  # also never set
        left, thrust = rng.choice([0.5, math.nan, 1e308]), rng.normal(size=3).astype(np.float32)
        posts += [
            (received, "/usv/odom", odom(now - late)), (received, "/usv/left", types["Float64"](left)),
            (received, "/usv/thrust", types["Float32MultiArray"](types["MultiArrayLayout"]([], 0), thrust)),
        ]  # fmt: skip
    path = write_ros2(tmp_path / "boat", posts)
    sources = {
        "command_left": Source("*left", span=2.0), "command_right": Source("/usv/thrust", field="data.2", zero=1.0),
        "heading": Source("*odom", unit="enu_rad"), "yaw_rate": Source("*odom", unit="enu_rad/s"),
        "surge": Source("usv/odom"), "ground_speed": Source("*odom", "twist.twist.linear.x, twist.twist.linear.y"),
    }  # fmt: skip
    expected, _ = Rosbag().read(path, sources)
    session = NotedSession(sources)
    messages = Messages(session)
    with AnyReader([path.parent]) as bag:
        graph = {each.topic: [each.msgtype] for each in bag.connections}
        choice = chosen(sources, graph)
        assert not choice.problems
        start = bag.start_time
        for connection, received, data in bag.messages():
            message = like_rclpy(bag.deserialize(data, connection.msgtype))
            messages.take(connection.topic, choice.fields[connection.topic], message, received)
    assert session.restarts == 0
    for part, channel in expected.items():
        stamps, raw = np.array([(stamp, raw) for name, stamp, raw in session.pushed if name == part]).T
        usable = np.isfinite(raw)
        assert len(raw) == 200 and (usable.all() or part == "command_left")
        np.testing.assert_array_equal(sources[part].convert(raw[usable]), channel.value)
        np.testing.assert_allclose(stamps[usable] - start / NS, channel.time, atol=1e-6)  # a float near 1.7e9 s


# what is published


@pytest.fixture(scope="module")
def out() -> Outputs:
    return Outputs({name: rclpy_class(f"{package}/msg/{name}") for name, package in CLASSES.items()}, "hull")


def test_a_speed_has_its_time_and_the_variance_of_its_interval(out):
    message = out.speed(START + 0.125, np.float64(1.5), 1.5 - 0.329, 1.5 + 0.329)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (START, 125_000_000)
    assert message.header.frame_id == "hull" and message.twist.twist.linear.x == 1.5
    covariance = np.array(message.twist.covariance).reshape(6, 6)
    assert covariance[0, 0] == pytest.approx(0.2**2, rel=1e-3)  # 1.645 standard deviations are 0.329 m/s
    assert np.array_equal(np.diag(covariance)[1:], [UNKNOWN] * 5) and np.count_nonzero(covariance) == 6
    for low, high in ((-math.inf, math.inf), (math.nan, math.nan), (-1e308, 1e308)):
        assert out.speed(0.0, 1.0, low, high).twist.covariance[0] == UNKNOWN


def test_stamps_of_any_size_fit_a_message(out):
    for stamp in (0.0, -0.25, 1e300, -1e300, math.nan, math.inf, START + 0.9999999999):
        message = out.time(stamp)
        assert -(2**31) <= message.sec < 2**31 and 0 <= message.nanosec < NS
    assert (out.time(-0.25).sec, out.time(-0.25).nanosec) == (-1, 750_000_000)


def test_a_forecast_has_a_row_for_each_horizon(out):
    if_held = {10.0: (1.0, 0.75, 1.25), 2.0: (0.5, 0.375, 0.625)}
    message = out.forecast({10.0: (1.0, 0.5, 1.5), 2.0: (0.5, 0.25, 0.75)}, if_held)
    assert message.data == [2.0, 0.5, 0.25, 0.75, 0.375, 0.625, 10.0, 1.0, 0.5, 1.5, 0.75, 1.25]
    assert [(d.label, d.size, d.stride) for d in message.layout.dim] == [
        ("horizon", 2, 12), ("horizon_s,surge,low,high,low_if_held,high_if_held", 6, 6)]  # fmt: skip
    members = out.members({"aid": 1.0, "rls": 2.0})
    assert members.data == [1.0, 2.0] and members.layout.dim[1].label == "aid,rls"


def test_the_health_is_a_diagnostic_of_the_model_and_one_of_the_inputs(out):
    levels = {}
    for state in ("ok", "waiting", "compiling", "stale"):
        message = out.diagnostics(START, "usvlearn", health(state=state), {}, [])
        levels[state] = [each.level for each in message.status]
    assert levels == {"ok": [b"\0"] * 2, "waiting": [b"\1"] * 2, "compiling": [b"\1"] * 2, "stale": [b"\2"] * 2}
    report = health(
        ages={"surge": 0.25, "heading": math.inf}, counts={"surge": {"stale": 3}}, warnings=("the disk is full",),
        identified={"steady_speed_full": (2.5, 2.0, 3.0, "m/s")},
        contraction={"rnn": {"contracting": True, "condition": "exact", "rate": 0.5, "equilibrium": None}},
    )  # fmt: skip
    message = out.diagnostics(START, "usvlearn", report, {"heading": "nobody publishes /imu yet"}, ["a note"])
    model, inputs = message.status
    assert (model.name, inputs.name) == ("usvlearn: model", "usvlearn: inputs") and message.header.stamp.sec == START
    assert model.level == b"\0" and inputs.level == b"\1"
    assert inputs.message == "heading: nobody publishes /imu yet; a note; the disk is full"
    values = {pair.key: pair.value for status in message.status for pair in status.values}
    assert values["surge age s"] == "0.25" and values["heading age s"] == "never" and values["surge stale"] == "3"
    assert values["rnn condition"] == "exact" and values["rnn equilibrium"] == "unknown"
    assert values["steady_speed_full"] == "2.5 m/s, 90 % interval 2 to 3"


def test_parameters_are_json_without_nan(out):
    report = health(
        identified={"lag": (1.0, -math.inf, math.nan, "s")},
        contraction={"rnn": {"contracting": False, "rate": math.inf}},
    )
    content = json.loads(out.parameters(START, report).data, parse_constant=pytest.fail)
    assert content["identified"] == {"lag": {"value": 1.0, "low": None, "high": None, "unit": "s"}}
    assert content["contraction"] == {"rnn": {"contracting": False, "rate": None}}


# tracks


class Noted:
    """A node of rclpy that keeps what is published, without rclpy."""

    def __init__(self):
        self.published: dict[str, list] = {}

    def create_publisher(self, kind, topic, depth):
        messages = self.published.setdefault(topic, [])
        return SimpleNamespace(publish=lambda message: messages.append((kind.__name__, message)))


def track():
    """Of two steps: 3 m north and 1 m east with heading 0, then to the east; the second ellipse is not known."""
    one = np.ones(2)
    covariance = np.array([[[4.0, 0.5], [0.5, 1.0]], np.full((2, 2), np.inf)])
    return Track(
        np.array([0.4, 0.8]), one, 0 * one, 0 * one, np.array([0.0, np.pi / 2]), np.array([3.0, 4.0]),
        np.array([1.0, 2.0]), covariance,
    )  # fmt: skip


def test_a_track_points_east_and_north(monkeypatch):
    """A boat that heads north has a yaw of 90 degrees from east, counter-clockwise; variances follow the axes."""
    monkeypatch.setattr(shell, "message_class", rclpy_class)
    types = {name: rclpy_class(f"{package}/msg/{name}") for name, package in CLASSES.items()}
    node, one = Noted(), object.__new__(shell.Shell)
    one._node, one._types, one._dt, one._publishers, one._outputs = node, types, 0.4, {}, Outputs(types, "hull")
    unknown = Point(0.0, 0.0, 0.0, math.inf, math.inf, 0.0)
    known = unknown._replace(major=2 * 2.146, minor=2.146, bearing=30.0)
    places = {0.4: known, 0.8: unknown}
    step = SimpleNamespace(time=START + 0.5, track=track(), places=places, places_if_held={0.4: unknown})
    one._publish_track(step)
    one._publish_track(step)
    ((kind, path), _), places = node.published["~/track"], node.published["~/track_pose"]
    assert kind == "Path" and [name for name, _ in places] == ["PoseWithCovarianceStamped"] * 4
    assert path.header.frame_id == path.poses[1].header.frame_id == "hull_enu" and len(path.poses) == 2
    assert (path.header.stamp.nanosec, path.poses[0].header.stamp.nanosec) == (500_000_000, pytest.approx(9e8, abs=1e3))
    first, second = (message for _, message in places[:2])
    assert (first.pose.pose.position.x, first.pose.pose.position.y) == (1.0, 3.0)
    turned = read_field(path.poses[0], "pose.orientation", "heading"), read_field(second, "pose.pose.orientation", "")
    assert turned == (pytest.approx(math.pi / 2), pytest.approx(0.0))
    C = np.reshape(first.pose.covariance, (6, 6))
    rise = 3 * math.sqrt(3) / 4  # semi-axes of 2 and 1 standard deviations
    np.testing.assert_allclose(C[:2, :2], [[1.75, rise], [rise, 3.25]], rtol=1e-3)
    assert len(node.published["~/track_pose_if_held"]) == 2 and (np.diag(C)[2:] == UNKNOWN).all()
    assert (np.diag(np.reshape(second.pose.covariance, (6, 6))) == UNKNOWN).all()


def test_a_service_answers_an_alarm():
    one, asked = object.__new__(shell.Shell), []
    one._session = SimpleNamespace(answer_alarm=lambda answer: asked.append(answer) or True)
    response = one._answerer("reset")(None, SimpleNamespace(success=False, message=""))
    assert asked == ["reset"] == [response.message] and response.success


def test_the_position_that_tracks_need_is_that_of_an_odometry():
    message = odometry(0.0)
    message.pose.pose.position.x, message.pose.pose.position.y = 5.0, 7.0
    place = {part: read_field(message, given["field"], part) for part, given in AUXILIARY.items()}
    assert place == {"north": 7.0, "east": 5.0}
