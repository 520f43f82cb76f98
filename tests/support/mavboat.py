"""A synthetic boat with an autopilot that speaks MAVLink as ArduPilot does, and a session that only records."""

import contextlib
import math
import socket
import struct
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.support.ardupilot import PARAMETERS
from tests.support.live import NotedSession
from usvlearn.live.health import COMPILING
from usvlearn.logs.formats.ardupilot.servos import DEFAULTS

ARDUPILOT = {f"SERVO{n}_FUNCTION": 0.0 for n in range(1, 17)} | PARAMETERS
EPOCH = 1_700_000_000_000_000  # us
HEARTBEAT, SET_INTERVAL = 0, 511
AUTOPILOT, BOAT, ARMED = 3, 11, 128
HERE = "127.0.0.1"


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind((HERE, 0))
        return one.getsockname()[1]


class Motion(NamedTuple):
    """What a boat does at one time, in SI units."""

    left: float
    right: float
    heading: float
    yaw_rate: float
    surge: float


def turning(time: float) -> Motion:
    """Ahead at 1.5 m/s on a slow turn, with thrusters that change slowly."""
    return Motion(0.5 + 0.4 * math.sin(0.3 * time), -0.2, (0.2 + 0.05 * time) % (2 * math.pi), 0.05, 1.5)


def record(receipt: float, frame: bytes) -> bytes:
    """A frame as a ground station writes it into a telemetry log."""
    return struct.pack(">Q", EPOCH + round(1e6 * receipt)) + frame


class MavBoat:
    """An autopilot: it answers requests, and sends what it was asked for, by ids; its clock began at `booted`, s."""

    def __init__(
        self,
        motion: Callable[[float], Motion] = turning,
        parameters=ARDUPILOT,
        sender=(1, 1),
        version: int = 2,
        booted: float = -5.0,
        sends=(0, 30, 32, 33, 36, 74),
    ):
        self.motion, self.parameters, self.version, self.booted = motion, dict(parameters), version, booted
        self.sends, self.armed = set(sends), True
        self.pack = mavlink.MAVLink(None, *sender)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self.intervals, self._due = {}, {HEARTBEAT: 0.0}
        self.texts, self.values, self.asked, self.heard = [], [], [], []

    def packed(self, message) -> bytes:
        frame = bytes(message.pack(self.pack, force_mavlink1=self.version == 1))
        self.pack.seq = (self.pack.seq + 1) % 256
        return frame

    def hear(self, data: bytes) -> list[bytes]:
        """Take what was sent to it; returns its answers."""
        answers = []
        for message in self._parser.parse_buffer(data) or []:
            kind = message.get_type()
            self.heard.append(message)
            if kind == "STATUSTEXT":
                self.texts.append((message.severity, message.text))
            elif kind == "NAMED_VALUE_FLOAT":
                self.values.append((message.time_boot_ms, message.name, message.value))
            elif kind == "PARAM_REQUEST_READ" and message.target_system == self.pack.srcSystem:
                self.asked.append(message.param_id)
                if message.param_id in self.parameters:
                    answers.append(self.parameter(message.param_id))
            elif kind == "COMMAND_LONG" and message.command == SET_INTERVAL:
                number = int(message.param1)
                if message.target_system == self.pack.srcSystem and number in self.sends:
                    self.intervals[number] = 1e-6 * message.param2
                answers.append(self.packed(mavlink.MAVLink_command_ack_message(SET_INTERVAL, 0)))
        return answers

    def parameter(self, name: str) -> bytes:
        return self.packed(
            mavlink.MAVLink_param_value_message(name.encode(), self.parameters[name], 9, len(self.parameters), 1)
        )

    def reboot(self, time: float) -> None:
        """Its clock begins anew, and what it was asked for is forgotten."""
        self.booted, self.intervals, self._due = time, {}, {HEARTBEAT: time}

    def due(self, time: float) -> list[bytes]:
        """The frames that are due by this time of the boat, s."""
        due = []
        for number, interval in {HEARTBEAT: 1.0, **self.intervals}.items():
            at = self._due.get(number, time)
            while at <= time + 1e-9:
                due.append((at, number))
                at += interval
            self._due[number] = at
        return [self.packed(self.message(number, at)) for at, number in sorted(due)]

    def message(self, number: int, time: float):
        """What it says of one time, as pymavlink's message."""
        ms, now = round(1000 * (time - self.booted)) % (1 << 32), self.motion(time)
        north, east = now.surge * math.cos(now.heading), now.surge * math.sin(now.heading)
        if number == 0:
            return mavlink.MAVLink_heartbeat_message(BOAT, AUTOPILOT, ARMED * self.armed, 0, 4, 3)
        if number == 30:
            return mavlink.MAVLink_attitude_message(ms, 0, 0, now.heading, 0, 0, now.yaw_rate)
        if number == 32:
            return mavlink.MAVLink_local_position_ned_message(ms, 1, 2, 3, north, east, 0)
        if number == 33:
            speeds = round(100 * north), round(100 * east), 0
            return mavlink.MAVLink_global_position_int_message(ms, 0, 0, 0, 0, *speeds, 0)
        if number == 74:
            return mavlink.MAVLink_vfr_hud_message(0, abs(now.surge), 0, 0, 0, 0)
        pulses = [0] * 16
        for function, share in ((73, now.left), (74, now.right), (70, now.left)):
            for n in range(1, 17):
                if self.parameters.get(f"SERVO{n}_FUNCTION") == function:
                    pulses[n - 1] = self.pulse(n, share)
        return mavlink.MAVLink_servo_output_raw_message(1000 * ms % (1 << 32), 0, *pulses)

    def pulse(self, servo: int, share: float) -> int:
        """As ArduPilot makes it, us."""
        low, trim, high, backward = (self.parameters[f"SERVO{servo}_{name}"] for name in DEFAULTS)
        share = -share if backward else share
        return round(trim + share * (high - trim if share > 0 else trim - low))


class OnTheAir(threading.Thread):
    """A boat that sails in real time, or faster, and sends datagrams to a node."""

    def __init__(self, boat: MavBoat, port: int, seconds: float, warp: float = 1.0):
        super().__init__(daemon=True)
        self.boat, self.seconds, self.warp, self.time, self._node = boat, seconds, warp, 0.0, ("127.0.0.1", port)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.setblocking(False)
        self.ended = threading.Event()

    def run(self) -> None:
        first = time.monotonic()
        while self.time < self.seconds and not self.ended.is_set():
            now = self.warp * (time.monotonic() - first)
            self.time = min(now, self.time + 1.0)  # a busy computer skips no second of the boat
            frames = self.boat.due(self.time)
            with contextlib.suppress(BlockingIOError):
                while True:
                    frames += self.boat.hear(self.socket.recv(4096))
            for frame in frames:
                self.socket.sendto(frame, self._node)
            time.sleep(0.001)
        self.ended.set()
        self.socket.close()


class RecordingSession(NotedSession):
    """As a session of a vehicle."""

    def __init__(self, sources, dt: float = 0.4):
        super().__init__(sources)
        self.setup, self.state = SimpleNamespace(align={"dt": dt}), "ok"
        self.restarts, self.ticks, self.identified = [], 0, {}

    def push(self, part: str, stamp: float, raw: float) -> list:
        assert part in self.sources and isinstance(stamp, float) and isinstance(raw, float)
        return super().push(part, stamp, raw)

    def tick(self):
        self.ticks += 1
        sentence = f"the session is {self.state}"
        return COMPILING._replace(state=self.state, sentence=sentence, identified=self.identified)

    def restart(self) -> list:
        self.restarts.append(len(self.pushed))
        return []

    def channel(self, part: str) -> tuple[np.ndarray, np.ndarray]:
        """Stamps and raw values of a part, `(messages,)` each."""
        rows = [(stamp, raw) for name, stamp, raw in self.pushed if name == part]
        return tuple(np.array(rows, dtype=float).reshape(-1, 2).T)
