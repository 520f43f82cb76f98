"""A simulated boat in the loop of ROS 2: the node is a process of its own, and learns in simulated time.

Skipped without rclpy, which comes with ROS 2.
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("ROS_DOMAIN_ID", str(10 + os.getpid() % 80))

from tests.support import ROOT, commands
from tests.support.live import learned_set
from tests.support.ros2 import Peer
from tests.support.voyages import Voyage, voyage
from usvlearn.core import checkpoint
from usvlearn.live.ros2.messages import NS

rclpy: Any = pytest.importorskip("rclpy", reason="needs rclpy: source a ROS 2")
pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")  # of a parser that rclpy imports
NUMBER, CLOCK, ODOMETRY = "std_msgs/msg/Float64", "rosgraph_msgs/msg/Clock", "nav_msgs/msg/Odometry"
SPEED, DIAGNOSTICS = "geometry_msgs/msg/TwistWithCovarianceStamped", "diagnostic_msgs/msg/DiagnosticArray"
START, THRUST = 1000, 250.0  # s of simulated time, N at full thrust
PARAMETERS = {
    "save_period": 3600.0,
    **{f"channels.command_{side}.span": THRUST for side in ("left", "right")},
    **{f"channels.{channel}.window": 0.5 for channel in ("heading", "yaw_rate", "surge")},
}  # fmt: skip


class Boat(Peer):
    """Publishes a voyage, and listens to the node."""

    def __init__(self) -> None:
        super().__init__("boat")
        self.clock = self.publisher("/clock", CLOCK)
        self.advertise()
        self.health = self.listen("/usvlearn/health", DIAGNOSTICS)
        self.predicted = self.listen("/usvlearn/surge_predicted", SPEED, 1000)

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

    def tell(self, at: float) -> None:
        stamp = round((START + at) * NS)
        message = self.message(CLOCK)
        message.clock.sec, message.clock.nanosec = stamp // NS, stamp % NS
        self.clock.publish(message)

    def sail(self, sea: Voyage, warp: float) -> None:
        """Publish a voyage, so many times faster than it was."""
        rows = [
            (at, side, value)
            for side in self.thrust
            for at, value in zip(*getattr(sea, f"command_{side}"), strict=True)
        ]
        heading, rate = (sea.at(name, sea.surge[0]) for name in ("heading", "yaw_rate"))
        rows += [(at, "odometry", each) for at, *each in zip(*sea.surge, heading, rate, strict=True)]
        begin = time.monotonic()
        for at, what, value in sorted(rows, key=lambda row: row[0]):
            self.spin(begin + at / warp)
            self.tell(at)
            if what != "odometry":
                self.thrust[what].publish(self.message(NUMBER, data=THRUST * float(value)))
                continue
            surge, psi, r = map(float, value)
            yaw, message = np.pi / 2 - psi, self.message(ODOMETRY)
            stamp = round((START + at) * NS)
            message.header.stamp.sec, message.header.stamp.nanosec = stamp // NS, stamp % NS
            message.twist.twist.linear.x, message.twist.twist.angular.z = surge, -r
            message.pose.pose.orientation.z, message.pose.pose.orientation.w = (
                float(np.sin(yaw / 2)),
                float(np.cos(yaw / 2)),
            )
            self.odometry.publish(message)


def node(folder: Path, **parameters: Any) -> subprocess.Popen:
    words = [word for name, value in (PARAMETERS | parameters).items() for word in ("-p", f"{name}:={value}")]
    command = [sys.executable, "-m", "usvlearn", "live", "ros2", str(folder), "--ros-args", *words]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_boat_in_the_loop_is_learned_as_in_a_replay(tmp_path, number):
    """The node learns, saves on a signal, and its record replays with the predictions that were published."""
    boat, sea = Boat(), voyage(minutes=4.0 if number == signal.SIGTERM else 1.0)
    process = node(tmp_path / "node", start=learned_set(tmp_path), use_sim_time="true", record="true")
    try:
        boat.tell(0.0)
        boat.wait("waiting")
        boat.sail(sea, warp=20.0)
        boat.wait("stale")
    finally:
        process.send_signal(number)
        output, _ = process.communicate(timeout=60)
        boat.close()
    assert process.returncode == 0, output
    (path,) = checkpoint.checkpoints(tmp_path / "node")
    assert json.loads((tmp_path / "node" / "status.json").read_text())["state"] == "ended"
    records = tmp_path / "node" / "records"
    align = yaml.safe_load((records / "record_0001.yaml").read_text())["align"]
    options = ["data=record_0001.yaml", "resume=record_0001.safetensors", "hydra.run.dir=again"]
    commands.ran(*options, *(f"align.{name}={value}" for name, value in align.items()), folder=records)
    replay = np.load(next((records / "again" / "predictions").glob("*.npz")))
    column = replay["estimators"].tolist().index(checkpoint.load(path)[1]["kernel"]["output"])
    time_of, replayed, measured = (
        replay["time"][:, 0],
        replay["predictions"][:, 0, column],
        replay["measured_surge"][:, 0],
    )
    stamps = np.array([each.header.stamp.sec - START + each.header.stamp.nanosec / NS for each in boat.predicted])
    published = np.array([each.twist.twist.linear.x for each in boat.predicted])
    finite = np.isfinite(replayed)
    stamps += time_of[finite][0] - stamps[0]  # a replay counts from its first sample
    place = np.searchsorted(time_of, stamps - 1e-6)
    assert np.abs(time_of[place] - stamps).max() < 1e-6 and np.unique(place).size == len(place)
    assert len(place) > 0.8 * finite.sum() > 0.5 * sea.surge[0].max() / 0.4  # a busy computer makes messages late
    np.testing.assert_array_equal(published, replayed[place])  # to the last bit
    if number == signal.SIGTERM:
        errors, persistence = (np.abs(x - measured[place])[len(place) // 2 :] for x in (published, measured[place - 1]))
        assert np.nanmean(errors) < 0.8 * np.nanmean(persistence)


def test_the_silence_of_each_topic_and_of_all_is_told_and_ends(tmp_path):
    boat, process = Boat(), node(tmp_path / "node", mass=28.0, surge_max=2.74)
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
        boat.spin(time.monotonic() + 3.0)  # one part may be stale a second before the others
        assert all(part in boat.sentence() for part in ("command_left", "command_right", "heading", "surge"))
        until("ok", "")
        for kind in (*boat.thrust.values(), boat.odometry):
            boat.node.destroy_publisher(kind)  # all publishers are started anew
        boat.wait("stale")
        boat.advertise()
        until("ok", "")
    finally:
        process.terminate()
        output, _ = process.communicate(timeout=60)
        boat.close()
    assert process.returncode == 0, output
    assert "DDS listens on all addresses of this computer" in output
