"""The command beside a boat that publishes: the node is a process of its own, tells silences, and saves at its end.

Skipped without rclpy, which comes with ROS 2.
"""

import os
import subprocess
import sys
import time
from typing import Any

import pytest

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("ROS_DOMAIN_ID", str(10 + os.getpid() % 80))

from tests.support import ROOT
from tests.support.ros2 import Peer
from usvlearn.core import checkpoint

rclpy: Any = pytest.importorskip("rclpy", reason="needs rclpy: source a ROS 2")
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")  # of a parser that rclpy imports
NUMBER, ODOMETRY = "std_msgs/msg/Float64", "nav_msgs/msg/Odometry"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
THRUST = 250.0  # N at full thrust


class Boat(Peer):
    """Publishes constant values, and listens to the node."""

    def __init__(self) -> None:
        super().__init__("boat")
        self.advertise()
        self.health = self.listen("/usvlearn/health", DIAGNOSTICS)

    def advertise(self) -> None:
        self.odometry = self.publisher("/boat/odometry/filtered", ODOMETRY)
        self.thrust = {side: self.publisher(f"/boat/thrusters/{side}/thrust", NUMBER) for side in ("left", "right")}

    def spin(self, until: float) -> None:
        """Receive until a time of the monotonic clock, s."""
        while (left := until - time.monotonic()) > 0:
            self.executor.spin_once(timeout_sec=left)

    def state(self) -> str:
        values = {pair.key: pair.value for pair in self.health[-1].status[0].values} if self.health else {}
        return values.get("state", "none")

    def sentence(self) -> str:
        return self.health[-1].status[0].message if self.health else ""

    def wait(self, *states: str) -> None:
        end = time.monotonic() + 120.0
        while self.state() not in states:
            assert time.monotonic() < end, self.state()
            self.spin(time.monotonic() + 0.1)

    def steady(self, without: str = "") -> None:
        """Publish each topic but one for a tenth of a second of real time, constant values."""
        for side in {"left", "right"} - {without}:
            self.thrust[side].publish(self.message(NUMBER, data=0.5 * THRUST))
        if without != "odometry":
            message = self.message(ODOMETRY)
            message.header.stamp = self.node.get_clock().now().to_msg()
            message.twist.twist.linear.x = 1.0
            message.pose.pose.orientation.w = 1.0
            self.odometry.publish(message)
        self.spin(time.monotonic() + 0.1)


def test_the_silence_of_each_topic_and_of_all_is_told_and_ends(tmp_path):
    given = {f"channels.command_{side}.span": THRUST for side in ("left", "right")}
    given |= {f"channels.{channel}.window": 0.5 for channel in ("heading", "yaw_rate", "surge")}
    words = [word for name, value in given.items() for word in ("-p", f"{name}:={value}")]
    command = [sys.executable, "-m", "usvlearn", "live", "ros2", str(tmp_path / "node"), "--mass", "28", "--surge-max",
               "2.74", "--ros-args", *words]  # fmt: skip
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    boat = Boat()
    try:
        boat.wait("waiting")

        def until(said: str, without: str) -> str:
            end = time.monotonic() + 60.0
            while not boat.sentence().startswith(said):
                assert time.monotonic() < end, boat.sentence()
                boat.steady(without)
            return boat.sentence()

        until("waiting for heading", "odometry")
        for topic, part in (("left", "command_left"), ("right", "command_right"), ("odometry", "heading")):
            until("ok", "")
            assert f"no {part} (" in until("no ", topic)
        until("ok", "")
        boat.wait("stale")  # nothing is published while it waits
        assert all(part in boat.sentence() for part in ("command_left", "command_right", "heading", "surge"))
        until("ok", "")
        for kind in (*boat.thrust.values(), boat.odometry):
            boat.node.destroy_publisher(kind)  # all publishers are started anew
        boat.wait("stale")
        boat.advertise()
        until("ok", "")
    finally:
        process.terminate()
        told, _ = process.communicate(timeout=60)
        boat.close()
    assert process.returncode == 0, told
    assert checkpoint.checkpoints(tmp_path / "node")
    assert "DDS listens on all addresses of this computer" in told
