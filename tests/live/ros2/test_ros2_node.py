"""The node against a real rclpy: what it subscribes to, what it publishes, and what faults do to it.

Skipped without rclpy, which comes with ROS 2; `.ci/run` runs it with that of the package index. `test_ros2.py` tries
the rest without it.
"""

import importlib
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("ROS_DOMAIN_ID", str(10 + os.getpid() % 80))

from tests.support import ROOT
from tests.support.live import NotedSession, health
from tests.support.ros2 import Peer
from usvlearn.core.events import Event
from usvlearn.core.forecasts import Track
from usvlearn.errors import ConfigError
from usvlearn.live.node import Step
from usvlearn.live.plan_requests import Point
from usvlearn.live.ros2 import ros2_launch
from usvlearn.live.ros2.messages import message_class
from usvlearn.live.ros2.shell import Shell
from usvlearn.logs.channels.channel import Source

rclpy: Any = pytest.importorskip("rclpy", reason="needs rclpy: source a ROS 2")
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")  # of a parser that rclpy imports
ODOMETRY, NUMBER, TEXT = "nav_msgs/msg/Odometry", "std_msgs/msg/Float64", "std_msgs/msg/String"
DIAGNOSTICS, TABLE = "diagnostic_msgs/msg/DiagnosticArray", "std_msgs/msg/Float64MultiArray"
SPEED, POSE = (f"geometry_msgs/msg/{name}WithCovarianceStamped" for name in ("Twist", "Pose"))
SOURCES = {
    "command_left": Source("*thrusters/left"),
    "command_right": Source("thrusters/right"),
    "heading": Source("*odom", unit="enu_rad"),
    "yaw_rate": Source("*odom", unit="enu_rad/s"),
    "surge": Source("*odom", unit="m/s"),
}
PATIENCE = 20.0  # s, for what takes milliseconds on an idle computer


class Sea(Peer):
    """A peer, and a node under test with a session that notes what it gets."""

    def __init__(self, sources: dict[str, Source] = SOURCES, parameters: Sequence[str] = (), **options: Any):
        super().__init__("peer")
        self.session, self.boat = NotedSession(dict(sources)), Peer("usvlearn", parameters)
        self.shell = Shell(self.boat.node, self.session, **options)  # type: ignore[arg-type]
        self.others: list[Peer] = []

    def other(self) -> Peer:
        """One more peer."""
        self.others.append(Peer(f"other{len(self.others)}"))
        return self.others[-1]

    def until(
        self, true: Callable[[], Any], also: Callable[[], Any] = lambda: None, patience: float = PATIENCE
    ) -> bool:
        """Spin until something is true; `also` is done again and again."""
        end = time.monotonic() + patience
        while time.monotonic() < end:
            also()
            for each in (self.boat, self):
                each.executor.spin_once(timeout_sec=0.02)
            if true():
                return True
        return False

    def close(self) -> None:
        for each in (*self.others, self.boat):
            each.close()
        super().close()


@pytest.fixture
def sea() -> Iterator[Callable[..., Sea]]:
    seas: list[Sea] = []

    def make(**options: Any) -> Sea:
        seas.append(Sea(**options))
        return seas[-1]

    yield make
    for each in seas:
        each.close()


def number(value: float) -> Any:
    return message_class(NUMBER)(data=value)


def odometry(sea: Sea, surge: float = 1.0, yaw: float = 0.0, rate: float = 0.0, ahead: float = 0.0) -> Any:
    """Stamped with the node's clock, or some s ahead of it."""
    message = message_class(ODOMETRY)()
    message.header.stamp = (
        sea.boat.node.get_clock().now() + rclpy.duration.Duration(nanoseconds=int(ahead * 1e9))
    ).to_msg()
    message.twist.twist.linear.x, message.twist.twist.angular.z = surge, rate
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    return message


# inputs


def test_parts_come_from_one_message_with_its_stamp(sea):
    at_sea = sea()
    odom = at_sea.publisher("/boat/odom", ODOMETRY)
    left = at_sea.publisher("/boat/thrusters/left", NUMBER)
    sent = odometry(at_sea, 1.25, 0.5, -0.1)
    assert at_sea.until(lambda: at_sea.session.numbers("surge"), lambda: odom.publish(sent))
    pushed = {part: (stamp, raw) for part, stamp, raw in at_sea.session.pushed}
    stamp = sent.header.stamp.sec + sent.header.stamp.nanosec * 1e-9
    assert pushed["surge"] == pytest.approx((stamp, 1.25)) and pushed["yaw_rate"] == pytest.approx((stamp, -0.1))
    assert pushed["heading"] == pytest.approx((stamp, 0.5))
    now = at_sea.boat.node.get_clock().now().nanoseconds * 1e-9
    assert at_sea.until(lambda: at_sea.session.numbers("command_left"), lambda: left.publish(number(0.75)))
    (value,) = {raw for part, _, raw in at_sea.session.pushed if part == "command_left"}
    stamp = next(stamp for part, stamp, _ in at_sea.session.pushed if part == "command_left")
    assert value == 0.75 and now <= stamp < now + PATIENCE


@pytest.mark.parametrize("reliable", [True, False])
@pytest.mark.parametrize("lasting", [True, False])
def test_publishers_of_every_quality_of_service_are_heard(sea, reliable, lasting):
    at_sea, qos = sea(), importlib.import_module("rclpy.qos")
    profile = qos.QoSProfile(
        depth=1,
        reliability=qos.ReliabilityPolicy.RELIABLE if reliable else qos.ReliabilityPolicy.BEST_EFFORT,
        durability=qos.DurabilityPolicy.TRANSIENT_LOCAL if lasting else qos.DurabilityPolicy.VOLATILE,
    )
    left = at_sea.publisher("/thrusters/left", NUMBER, profile)
    assert at_sea.until(lambda: at_sea.session.numbers("command_left"), lambda: left.publish(number(0.5)))


def test_a_topic_that_comes_back_with_another_type_is_read_anew(sea):
    at_sea = sea()
    first = at_sea.publisher("/thrusters/left", TEXT)
    assert at_sea.until(lambda: at_sea.session.dropped, lambda: first.publish(message_class(TEXT)(data="half ahead")))
    at_sea.node.destroy_publisher(first)
    second = at_sea.other().publisher("/thrusters/left", NUMBER)
    assert at_sea.until(lambda: at_sea.session.numbers("command_left"), lambda: second.publish(number(0.25)))


def test_a_publisher_that_restarts_is_heard_again(sea):
    at_sea = sea()
    for value in (0.25, 0.5, 0.75):
        left = at_sea.publisher("/thrusters/left", NUMBER)
        assert at_sea.until(lambda v=value: v in at_sea.session.numbers("command_left"),
                            lambda p=left, v=value: p.publish(number(v)))  # fmt: skip
        at_sea.node.destroy_publisher(left)
    assert at_sea.until(lambda: "any more" in at_sea.shell._problems.get("command_left", ""))


@pytest.mark.parametrize("name", ["left thruster", "1st", "/a//b"])
def test_a_name_that_is_no_topic_is_refused(sea, name):
    with pytest.raises(ConfigError, match=r"channels: found the topic '.*': topic name .*: name another"):
        sea(sources={"surge": Source(name)})


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["-p", "masss:=3.0"], "parameter masss: found no such parameter: did you mean mass?"),
        (["-p", "mass:=heavy"], "parameter mass: found 'heavy', expected a number"),
        (["-p", "mass:=28.0", "-p", "surge_max:=2.7", "-p", "channels.surge.unit:=furlong"], "found 'furlong'"),
        (["-p", "mass"], "--ros-args: "),
        (["--params-file", "missing.yaml"], "--ros-args: "),
        ([], "found no checkpoint, and no mass and top speed for a prior"),
    ],
)
def test_what_a_user_mistypes_ends_the_command_with_a_sentence(tmp_path, arguments, sentence):
    command = [sys.executable, "-m", "usvlearn", "live", "ros2", "node", "--ros-args", *arguments]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60)
    last = done.stderr.splitlines()[-1]
    assert done.returncode == 2 and last.startswith("error: ") and sentence in last
    assert "Traceback" not in done.stderr


# time


def test_simulated_time_is_obeyed_and_its_reset_begins_a_new_segment(sea):
    at_sea = sea(parameters=["use_sim_time:=true"])
    listened = at_sea.listen("/diagnostics", DIAGNOSTICS)
    left = at_sea.publisher("/thrusters/left", NUMBER)
    assert at_sea.until(
        lambda: ("command_left", "no_time") in at_sea.session.dropped, lambda: left.publish(number(0.5))
    )
    assert at_sea.until(lambda: any("nobody publishes /clock" in told(each, "inputs") for each in listened))
    clock = at_sea.publisher("/clock", "rosgraph_msgs/msg/Clock")
    kind = message_class("rosgraph_msgs/msg/Clock")
    for seconds, restarts in ((100, 0), (4000, 0), (400, 1), (2, 2)):  # ahead by an hour, back by an hour, a reset

        def both(seconds: int = seconds) -> None:
            message = kind()
            message.clock.sec = seconds
            clock.publish(message)
            left.publish(number(float(seconds)))

        assert at_sea.until(lambda s=seconds: ("command_left", float(s), float(s)) in at_sea.session.pushed, both)
        assert at_sea.session.restarts == restarts


# outputs


STEP = Step(
    1.7e9 + 0.5, 1.0, 1.5, 1.25, 1.75, 1.625, 1.5, 1.75, {10.0: (2.0, 1.0, 3.0)}, {10.0: (2.0, 1.5, 2.5)},
    {"aid": 1.5}, (Event(1.0, "loss", "left", 0.4),),
)  # fmt: skip


def test_a_plan_is_answered(sea):
    at_sea = sea()
    publisher, heard = at_sea.publisher("/usvlearn/plan", TEXT), at_sea.listen("/usvlearn/plan_forecast", TEXT)
    plan = message_class(TEXT)(data="0,1,1")
    assert at_sea.until(lambda: heard, lambda: publisher.publish(plan))
    assert heard[0].data == "answer to 0,1,1"


@pytest.mark.parametrize("reliable", [True, False])
def test_what_is_known_is_published(sea, reliable):
    at_sea, qos = sea(members=True), importlib.import_module("rclpy.qos")
    policy = qos.ReliabilityPolicy.RELIABLE if reliable else qos.ReliabilityPolicy.BEST_EFFORT
    profile = qos.QoSProfile(depth=10, reliability=policy)
    kinds = {
        "surge_predicted": SPEED,
        "surge_next": SPEED,
        "forecast": TABLE,
        "members": TABLE,
        "alarm": TEXT,
        "event": TEXT,
    }
    heard = {name: at_sea.listen(f"/usvlearn/{name}", kind, profile) for name, kind in kinds.items()}
    assert at_sea.until(lambda: all(heard.values()), lambda: at_sea.shell.publish([STEP]))
    assert heard["surge_predicted"][0].twist.twist.linear.x == 1.5
    assert heard["surge_predicted"][0].header.stamp.nanosec == 500_000_000
    assert heard["surge_next"][0].header.stamp.nanosec == 750_000_000  # a step of 0.25 s later
    assert heard["surge_next"][0].twist.covariance[0] == pytest.approx((0.125 / 1.645) ** 2, rel=1e-3)
    assert list(heard["forecast"][0].data) == [10.0, 2.0, 1.0, 3.0, 1.5, 2.5] and list(heard["members"][0].data) == [
        1.5
    ]
    assert heard["alarm"][0].data == heard["event"][0].data == "the left thruster gives 40 % of its thrust"
    count = -1
    while count != (count := sum(map(len, heard.values()))):  # until all has arrived
        at_sea.until(lambda: False, patience=1.0)
    for each in heard.values():
        each.clear()
    unknown = STEP._replace(speed=math.nan, forecasts={}, members={}, events=())
    assert at_sea.until(lambda: len(heard["surge_next"]) > 5, lambda: at_sea.shell.publish([unknown]))
    assert [name for name, each in heard.items() if each] == ["surge_next"]


def test_tracks_are_published_with_ellipses_of_both_kinds(sea):
    at_sea, place = sea(), Point(3.0, 1.0, 20.0, math.inf, math.inf, math.nan)
    track = Track(*(np.array([each]) for each in (0.25, 1.0, 0.0, 0.0, 0.35, 3.0, 1.0)), np.full((1, 2, 2), np.inf))
    step = STEP._replace(track=track, places={0.25: place._replace(major=2.0, minor=1.0, bearing=0.0)})
    at_sea.shell.publish([step._replace(places_if_held={0.25: place})])  # makes the topics
    kinds = {"track": "nav_msgs/msg/Path", "track_pose": POSE, "track_pose_if_held": POSE}
    heard = {name: at_sea.listen(f"/usvlearn/{name}", kind) for name, kind in kinds.items()}
    publish = lambda: at_sea.shell.publish([step._replace(places_if_held={0.25: place})])  # noqa: E731
    assert at_sea.until(lambda: all(heard.values()), publish)
    covariance = heard["track_pose"][0].pose.covariance
    assert (
        covariance[7] == pytest.approx(4 * covariance[0]) and heard["track_pose_if_held"][0].pose.covariance[0] == 1e6
    )


def test_services_answer_an_alarm(sea):
    at_sea, trigger = sea(), pytest.importorskip("std_srvs.srv", reason="needs std_srvs").Trigger
    for answer in ("acknowledge", "reset"):
        client = at_sea.node.create_client(trigger, f"/usvlearn/{answer}_alarm")
        assert at_sea.until(client.service_is_ready)
        found = client.call_async(trigger.Request())
        assert at_sea.until(found.done) and found.result().success
    assert at_sea.session.answers == ["acknowledge", "reset"]


def test_parameters_and_the_last_alarm_reach_a_late_subscriber(sea):
    at_sea, qos = sea(), importlib.import_module("rclpy.qos")
    at_sea.session.health = health(identified={"lag": (0.5, 0.25, 0.75, "s")})
    at_sea.shell.publish([STEP])
    at_sea.shell.tick()
    late = qos.QoSProfile(depth=1, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
    alarms, parameters = (at_sea.listen(f"/usvlearn/{name}", TEXT, late) for name in ("alarm", "parameters"))
    assert at_sea.until(lambda: alarms and parameters)
    assert json.loads(parameters[-1].data)["identified"]["lag"] == {
        "value": 0.5,
        "low": 0.25,
        "high": 0.75,
        "unit": "s",
    }


def test_the_health_is_published_each_second_as_a_diagnostic(sea):
    at_sea = sea()
    ours, all_of_them = at_sea.listen("/usvlearn/health", DIAGNOSTICS), at_sea.listen("/diagnostics", DIAGNOSTICS)
    assert at_sea.until(lambda: len(ours) > 1 and len(all_of_them) > 1)
    assert [status.name for status in ours[-1].status] == ["usvlearn: model", "usvlearn: inputs"]
    assert "surge: no topic below / matches *odom yet" in told(ours[-1], "inputs")
    at_sea.session.health = health(state="stale", ages={"surge": 12.0})
    assert at_sea.until(lambda: ours[-1].status[0].level == b"\2")


def test_launch_reads_the_launch_file():
    launch = pytest.importorskip("launch", reason="needs launch and launch_ros: source a ROS 2")
    pytest.importorskip("launch_ros.actions", reason="needs launch_ros: source a ROS 2")
    declared = ros2_launch.generate_launch_description().entities[:-1]
    assert [each.name for each in declared] == list(ros2_launch.ARGUMENTS)
    context = launch.LaunchContext()
    for each in declared:
        each.visit(context)
    (node,) = ros2_launch._nodes(context, importlib.import_module("launch.substitutions").LaunchConfiguration)
    words = ["".join(part.perform(context) for part in word) for word in node.cmd[:4]]
    assert words == ["usvlearn", "live", "ros2", "~/usvlearn"]


def told(message: Any, name: str) -> str:
    """What the status of a diagnostic says."""
    return next(status.message for status in message.status if status.name.endswith(name))
