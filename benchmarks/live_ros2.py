"""How long a node of ROS 2 takes from a message to its prediction, and what it costs.

python benchmarks/live_ros2.py        prints the table of docs/live/ros2.md

It needs rclpy (source a ROS 2). The node is a process of its own, started as a user starts it; a peer publishes an
Odometry and two thrusters at one rate, and listens. ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST keeps that on one machine.
"""

from __future__ import annotations

import argparse
import importlib
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from timing import machine

from usvlearn.live.ros2.inputs import NS
from usvlearn.live.ros2.outputs import message_class

ODOMETRY, NUMBER = "nav_msgs/msg/Odometry", "std_msgs/msg/Float64"
SPEED, DIAGNOSTICS = "geometry_msgs/msg/TwistWithCovarianceStamped", "diagnostic_msgs/msg/DiagnosticArray"
PATIENCE = 0.1  # s, for which the node waits for late messages
SETTLE = 5.0  # s, after which is measured


class Figures(NamedTuple):
    """What is measured at one rate."""

    hz: float
    steps: int
    message: np.ndarray  # s, from the message that completes a step to the receipt of its prediction
    grid: np.ndarray  # s, from the end of a step to the receipt of its prediction
    core: float  # share of one core
    memory: float  # MB


class Peer:
    """Publishes and listens."""

    def __init__(self) -> None:
        self.node = importlib.import_module("rclpy").create_node("peer")
        self.executor = importlib.import_module("rclpy.executors").SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.odometry = self.node.create_publisher(message_class(ODOMETRY), "/odometry/filtered", 10)
        self.thrust = [
            self.node.create_publisher(message_class(NUMBER), f"/thrusters/{side}/thrust", 10)
            for side in ("left", "right")
        ]
        self.sent: list[tuple[float, float]] = []  # stamp and time of the clock, s
        self.received: list[tuple[float, float]] = []
        self.state = ""
        self.node.create_subscription(message_class(SPEED), "/usvlearn/surge_predicted", self._receive, 100)
        self.node.create_subscription(message_class(DIAGNOSTICS), "/usvlearn/health", self._hear, 10)

    def _receive(self, message: Any) -> None:
        stamp = message.header.stamp
        self.received.append((stamp.sec + stamp.nanosec / NS, time.time()))

    def _hear(self, message: Any) -> None:
        self.state = message.status[0].values[0].value

    def spin(self, until: float) -> None:
        while (left := until - time.time()) > 0:
            self.executor.spin_once(timeout_sec=left)

    def publish(self) -> None:
        for side in self.thrust:
            side.publish(message_class(NUMBER)(data=0.5 + 0.2 * float(np.sin(time.time()))))
        message, now = message_class(ODOMETRY)(), time.time()
        message.header.stamp.sec, message.header.stamp.nanosec = int(now), int(now % 1 * NS)
        message.twist.twist.linear.x = 1.0 + 0.2 * float(np.sin(now - 1.0))
        message.pose.pose.orientation.w = 1.0
        self.sent.append((now, time.time()))
        self.odometry.publish(message)


def usage(pid: int) -> tuple[float, float]:
    """Seconds of a core, and MB, of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"), pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def measure(peer: Peer, pid: int, hz: float, seconds: float) -> Figures:
    """Publish at a rate, and see when predictions come."""
    begin = time.time()
    core = 0.0
    for k in range(round((SETTLE + seconds) * hz)):
        peer.spin(begin + k / hz)
        if core == 0.0 and time.time() > begin + SETTLE:
            core, after = usage(pid)[0], time.time()
            peer.sent.clear()
            peer.received.clear()
        peer.publish()
    peer.spin(time.time() + 0.5)
    used, memory = usage(pid)
    stamps, clocks = np.array(peer.sent).T
    grid, received = np.array(peer.received).T
    last = np.searchsorted(stamps, grid + PATIENCE - 1e-6)  # the message that ends the wait for late ones
    known = last < len(stamps)
    late = received[known] - clocks[last[known]]
    return Figures(hz, int(known.sum()), late, (received - grid)[known], (used - core) / (time.time() - after), memory)


def row(found: Figures) -> str:
    parts = (f"{1e3 * np.median(x):.2f} / {1e3 * np.percentile(x, 99):.2f}" for x in (found.message, found.grid))
    return f"| {found.hz:g} | {found.steps} | {' | '.join(parts)} | {100 * found.core:.1f} % | {found.memory:.0f} MB |"


def main() -> None:
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("--seconds", type=float, default=120.0, help="at each rate")
    arguments = given.parse_args()
    rclpy = importlib.import_module("rclpy")
    rclpy.init()
    peer = Peer()
    print(machine())
    heads = ("Hz", "steps", "message to prediction, ms", "end of step to prediction, ms", "core", "memory")
    print("", "Median / 99 %.", "", f"| {' | '.join(heads)} |", sep="\n")
    print("|---|---|---|---|---|---|")
    for hz in (1.0, 10.0, 100.0):
        with tempfile.TemporaryDirectory() as folder:
            window = max(0.2, 1.5 / hz)
            names = ("command_left", "command_right", "heading", "yaw_rate", "surge")
            words = [word for name in names for word in ("-p", f"channels.{name}.window:={window}")]
            command = [sys.executable, "-m", "usvlearn", "live", "ros2", folder, "--mass", "28", "--surge-max", "2.7"]
            process = subprocess.Popen(
                [*command, "--ros-args", "--log-level", "error", *words], stdout=subprocess.DEVNULL
            )
            try:
                peer.state = ""
                while peer.state not in ("waiting", "ok", "stale"):
                    peer.spin(time.time() + 0.5)
                print(row(measure(peer, process.pid, hz, arguments.seconds)), flush=True)
            finally:
                process.terminate()
                process.wait(60)
    rclpy.shutdown()


if __name__ == "__main__":
    main()
