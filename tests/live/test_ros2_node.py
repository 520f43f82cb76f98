"""The node against a real rclpy: what it subscribes to, what it publishes, and what faults do to it.

Skipped without rclpy, which comes with ROS 2.
"""

import importlib
import os
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("ROS_DOMAIN_ID", str(10 + os.getpid() % 80))

from tests.support.ros2 import NotedSession
from usvlearn.live.ros2 import Shell
from usvlearn.live.ros2_outputs import message_class
from usvlearn.logs.channel import Source

rclpy: Any = pytest.importorskip("rclpy", reason="needs rclpy: source a ROS 2")
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")  # of a parser that rclpy imports
ODOMETRY, NUMBER, TEXT = "nav_msgs/msg/Odometry", "std_msgs/msg/Float64", "std_msgs/msg/String"
SOURCES = {
    "command_left": Source("*thrusters/left"),
    "command_right": Source("thrusters/right"),
    "heading": Source("*odom", unit="enu_rad"),
    "yaw_rate": Source("*odom", unit="enu_rad/s"),
    "surge": Source("*odom", unit="m/s"),
}
PATIENCE = 20.0  # s, for what takes milliseconds on an idle computer


class Sea:
    """A node under test, and a peer that publishes and listens."""

    def __init__(self, sources=SOURCES, parameters=(), **options):
        rclpy.init(args=["--ros-args", *(word for each in parameters for word in ("-p", each))])
        self.session = NotedSession(dict(sources))
        self.node = rclpy.create_node("usvlearn", automatically_declare_parameters_from_overrides=True)
        self.shell = Shell(self.node, self.session, **options)
        self.peer = rclpy.create_node("peer")
        self.executor = importlib.import_module("rclpy.executors").SingleThreadedExecutor()
        for node in (self.node, self.peer):
            self.executor.add_node(node)
        self.heard: dict[str, list[Any]] = {}

    def publisher(self, topic: str, kind: str, qos: Any = 10) -> Any:
        return self.peer.create_publisher(message_class(kind), topic, qos)

    def listen(self, topic: str, kind: str, qos: Any = 10) -> list[Any]:
        found = self.heard[topic] = []
        self.peer.create_subscription(message_class(kind), topic, found.append, qos)
        return found

    def until(self, true: Callable[[], Any], also: Callable[[], Any] = lambda: None) -> bool:
        """Spin until something is true; `also` is done again and again."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            also()
            self.executor.spin_once(timeout_sec=0.02)
            if true():
                return True
        return False

    def close(self) -> None:
        self.executor.shutdown()
        rclpy.try_shutdown()


@pytest.fixture
def sea() -> Iterator[Callable[..., Sea]]:
    made: list[Sea] = []

    def make(**options: Any) -> Sea:
        made.append(Sea(**options))
        return made[-1]

    yield make
    for each in made:
        each.close()


def number(value: float) -> Any:
    return message_class(NUMBER)(data=value)


def odometry(sea: Sea, surge: float = 1.0, yaw: float = 0.0, rate: float = 0.0, ahead: float = 0.0) -> Any:
    import math

    message = message_class(ODOMETRY)()
    message.header.stamp = (sea.node.get_clock().now() + rclpy.duration.Duration(nanoseconds=int(ahead * 1e9))).to_msg()
    message.twist.twist.linear.x, message.twist.twist.angular.z = surge, rate
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    return message


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
    now = at_sea.node.get_clock().now().nanoseconds * 1e-9
    assert at_sea.until(lambda: at_sea.session.numbers("command_left"), lambda: left.publish(number(0.75)))
    (found,) = {raw for part, _, raw in at_sea.session.pushed if part == "command_left"}
    stamp = next(stamp for part, stamp, _ in at_sea.session.pushed if part == "command_left")
    assert found == 0.75 and now <= stamp < now + PATIENCE
