"""Latency of a live node beside an autopilot, on the loopback: `python benchmarks/live_mavlink.py [SECONDS]`.

An autopilot, of which only the messages are real, sends ATTITUDE, LOCAL_POSITION_NED and SERVO_OUTPUT_RAW together at
1, 10 and 100 Hz to `usvlearn live mavlink`, which runs as a process of its own, starting from the prior. The latency is
the time from the first of the three messages, as they are sent, to the prediction USV_PRED, as it is received: two
passages through the loopback, decoding, alignment, a step of the default ensemble with its forecasts, encoding. Not in
it is the time for which a step waits for late messages (`--patience`), nor that to the next message, which ends it.

Writes live_mavlink.md. Needs the extra mavlink. The first run compiles.
"""

from __future__ import annotations

import math
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from accuracy import publish
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from timing import machine, table

RATES = (1.0, 10.0, 100.0)  # Hz
SERVOS = {1: 73.0, 3: 74.0}
LIMITS = {"MIN": 1100.0, "TRIM": 1500.0, "MAX": 1900.0, "REVERSED": 0.0}
HERE = "127.0.0.1"
BOOTED = 60.0  # s before the start
LEARNED = 20  # steps that are not counted: what is used for the first time is loaded then


class Measured(NamedTuple):
    """What was seen at one rate."""

    latencies: np.ndarray  # (steps,) s
    share: float  # of one core that the node used
    memory: float  # MB, resident


def usage(pid: int) -> tuple[float, float]:
    """Seconds of the processor, and resident MB, of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    seconds = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return seconds, int(fields[21]) * os.sysconf("SC_PAGE_SIZE") / 1e6


class Autopilot:
    """Sends to a node, and receives what it answers."""

    def __init__(self, port: int):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((HERE, 0))
        self.node, self.link, self.begun = (HERE, port), mavlink.MAVLink(None, 1, 1), time.perf_counter()
        self.parser = mavlink.MAVLink(None)
        self.parser.robust_parsing = True

    def send(self, message) -> None:
        self.socket.sendto(message.pack(self.link), self.node)

    def heartbeat(self) -> None:
        self.send(mavlink.MAVLink_heartbeat_message(11, 3, 128, 0, 4, 3))

    def parameters(self) -> None:
        values = {f"SERVO{n}_FUNCTION": SERVOS.get(n, 0.0) for n in range(1, 17)}
        values |= {f"SERVO{n}_{name}": value for n in SERVOS for name, value in LIMITS.items()}
        for name, value in values.items():
            self.send(mavlink.MAVLink_param_value_message(name.encode(), value, 9, len(values), 1))

    def sail(self) -> None:
        """The three messages of now."""
        t = time.perf_counter() - self.begun
        ms, turn = round(1000 * (t + BOOTED)), 0.05 * t
        pulse = round(1700 + 100 * math.sin(0.3 * t))
        speed = 1.5 + 0.2 * math.sin(0.3 * t - 0.5)
        self.send(mavlink.MAVLink_attitude_message(ms, 0, 0, turn % (2 * math.pi), 0, 0, 0.05))
        self.send(
            mavlink.MAVLink_local_position_ned_message(ms, 0, 0, 0, speed * math.cos(turn), speed * math.sin(turn), 0)
        )
        self.send(mavlink.MAVLink_servo_output_raw_message(1000 * ms, 0, pulse, 0, pulse, 0, 0, 0, 0, 0))

    def received(self, timeout: float) -> list[str]:
        """The names of the numbers that come within a time, or until the first datagram."""
        if not select.select([self.socket], [], [], timeout)[0]:
            return []
        found = self.parser.parse_buffer(self.socket.recv(65536)) or []
        return [message.name for message in found if message.get_type() == "NAMED_VALUE_FLOAT"]


def measure(rate: float, seconds: float) -> Measured:
    """Sail at one rate."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind((HERE, 0))
        port = one.getsockname()[1]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "usvlearn", "live", "mavlink", f"udpin:{HERE}:{port}", "--folder", folder,
                   "--mass", "28", "--surge-max", "2.7"]  # fmt: skip
        for name in ("command_left", "command_right", "heading", "yaw_rate", "velocity_north", "velocity_east"):
            command += ["--channel", f"{name}.window={max(0.6, 2.5 / rate)}"]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as node:
            try:
                return _measure(Autopilot(port), node.pid, rate, seconds)
            finally:
                node.terminate()


def _measure(boat: Autopilot, pid: int, rate: float, seconds: float) -> Measured:
    latencies: list[float] = []
    due = sent = beat = time.perf_counter()
    answered, end, before = True, math.inf, (0.0, 0.0)
    while (now := time.perf_counter()) < end:
        if now >= beat:
            beat = now + 1.0
            boat.heartbeat()
            if not latencies:
                boat.parameters()
        if now >= due:
            due, sent, answered = now + 1 / rate, time.perf_counter(), False
            boat.sail()
        names = boat.received(max(0.0, min(due, beat) - time.perf_counter()))
        if "USV_PRED" in names and not answered:
            latencies.append(time.perf_counter() - sent)
            answered = True
            if len(latencies) == LEARNED:
                end, before = time.perf_counter() + seconds, usage(pid)
    spent, memory = usage(pid)
    return Measured(np.array(latencies[LEARNED:]), (spent - before[0]) / seconds, memory)


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    computer = machine()
    found = {rate: measure(rate, seconds) for rate in RATES}
    rows = [
        [
            f"{rate:g}",
            str(len(each.latencies)),
            f"{1e3 * np.median(each.latencies):.2f}",
            f"{1e3 * np.quantile(each.latencies, 0.99):.2f}",
            f"{1e3 * each.latencies.max():.2f}",
            f"{100 * each.share:.1f}",
            f"{each.memory:.0f}",
        ]
        for rate, each in found.items()
    ]
    head = ["messages of each kind, Hz", "predictions", "median, ms", "p99, ms", "most, ms", "one core, %", "MB"]
    publish(
        __file__,
        [
            "# A live node beside an autopilot",
            "",
            f"Measured by `python benchmarks/live_mavlink.py` on: {computer}.",
            "",
            "The time from a message, as the autopilot sends it, to the prediction that it ends, as the autopilot",
            f"receives it, both on the loopback; {seconds:g} s at each rate, steps of 0.4 s, the default ensemble with",
            "its forecasts. Where a message ends several steps, the first prediction counts.",
            "",
            *table(head, rows),
            "",
        ],
    )


if __name__ == "__main__":
    main()
