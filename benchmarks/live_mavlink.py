"""Latency of a live node beside an autopilot, on the loopback.

python benchmarks/live_mavlink.py [SECONDS]        writes docs/benchmarks/live_mavlink.md

An autopilot, of which only the messages are real, sends ATTITUDE, LOCAL_POSITION_NED and SERVO_OUTPUT_RAW together at
1, 10 and 100 Hz to `usvlearn live mavlink`, which runs as a process of its own, starting from the prior. The latency is
the time from the first of the three messages, as they are sent, to the prediction USV_PRED, as it is received: two
passages through the loopback, decoding, alignment, a step of the default ensemble with its forecasts, encoding. Not in
it is the time for which a step waits for late messages (`--patience`), nor that to the next message, which ends it.

The script needs the extra mavlink. The first run compiles.
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
from pages import publish
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from timing import machine, table

from usvlearn.live.mavlink.frames import Frames
from usvlearn.live.mavlink.shell import MIDDLEWARE as OWN
from usvlearn.live.mavlink.vehicle import Vehicle
from usvlearn.live.session import Session
from usvlearn.live.start import Options

RATES = (1.0, 10.0, 100.0)  # Hz
SERVOS = {1: 73.0, 3: 74.0}
LIMITS = {"MIN": 1100.0, "TRIM": 1500.0, "MAX": 1900.0, "REVERSED": 0.0}
HERE = "127.0.0.1"
BOOTED = 60.0  # s before the start
MANY = 5000  # of each kind, to be decoded and learned from in one process
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


def parameters() -> list:
    """Those of the servos."""
    values = {f"SERVO{n}_FUNCTION": SERVOS.get(n, 0.0) for n in range(1, 17)}
    values |= {f"SERVO{n}_{name}": value for n in SERVOS for name, value in LIMITS.items()}
    return [mavlink.MAVLink_param_value_message(name.encode(), x, 9, len(values), 1) for name, x in values.items()]


def heartbeat():
    """Of an armed boat."""
    return mavlink.MAVLink_heartbeat_message(11, 3, 128, 0, 4, 3)


def motion(t: float) -> list:
    """The three messages of a time, s."""
    ms, turn = round(1000 * (t + BOOTED)), 0.05 * t
    pulse, speed = round(1700 + 100 * math.sin(0.3 * t)), 1.5 + 0.2 * math.sin(0.3 * t - 0.5)
    north, east = speed * math.cos(turn), speed * math.sin(turn)
    return [
        mavlink.MAVLink_attitude_message(ms, 0, 0, turn % (2 * math.pi), 0, 0, 0.05),
        mavlink.MAVLink_local_position_ned_message(ms, 0, 0, 0, north, east, 0),
        mavlink.MAVLink_servo_output_raw_message(1000 * ms, 0, pulse, 0, pulse, 0, 0, 0, 0, 0),
    ]


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

    def sail(self) -> None:
        """The three messages of now."""
        for message in motion(time.perf_counter() - self.begun):
            self.send(message)

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
            for message in [heartbeat(), *(parameters() if not latencies else ())]:
                boat.send(message)
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


def throughput() -> tuple[float, float, float]:
    """Microseconds of a message that is only decoded, of one that is learned from, and of one that ends a step."""
    link = mavlink.MAVLink(None, 1, 1)
    frames = [bytes(each.pack(link)) for k in range(MANY) for each in motion(0.1 * k)]
    decoder = Frames(mavlink)
    begun = time.perf_counter()
    for frame in frames:
        decoder.take(frame, whole=True)
    decoding = (time.perf_counter() - begun) / len(frames)
    with (
        tempfile.TemporaryDirectory() as folder,
        Session(Options(Path(folder), mass=28.0, surge_max=2.7), OWN) as session,
    ):
        session.start()
        session.wait()
        vehicle = Vehicle(session, mavlink, 10.0, None, say=lambda sentence: None)
        for message in [heartbeat(), *parameters()]:
            vehicle.receive(bytes(message.pack(link)), 0.0, whole=True)
        beat, plain, ending = bytes(heartbeat().pack(link)), [], []
        for k, frame in enumerate(frames):
            now = k / 30.0
            if k % 30 == 0:
                vehicle.receive(beat, now, whole=True)
            before, last = time.perf_counter(), session.last
            vehicle.receive(frame, now, whole=True)
            spent = time.perf_counter() - before
            (plain if session.last is last else ending).append(spent)
    return 1e6 * decoding, 1e6 * float(np.median(plain)), 1e6 * float(np.median(ending))


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
    computer = machine()
    decoding, plain, ending = throughput()
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
            "# Latency of the MAVLink node",
            "",
            f"Measured by `python benchmarks/live_mavlink.py` on: {computer}.",
            "",
            "The time from a message, as the autopilot sends it, to the prediction that it ends, as the autopilot",
            f"receives it, both on the loopback; {seconds:g} s at each rate, steps of 0.4 s, the default ensemble with",
            "its forecasts. Where a message ends several steps, the first prediction counts.",
            "",
            *table(head, rows),
            "",
            "MB is the resident memory where SciPy is installed, which numba then imports. In one process, without a",
            f"network: {decoding:.0f} us to decode a message, {plain:.0f} us (median) until it is aligned,",
            f"{ending:.0f} us where it ends a step, with the step of the ensemble and its forecasts.",
            "",
        ],
    )


if __name__ == "__main__":
    main()
