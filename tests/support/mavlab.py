"""A synthetic boat and the shell for MAVLink, joined without a network, in the boat's time."""

import math

from tests.support.mavboat import MavBoat, RecordingSession, mavlink, record
from usvlearn.live.mavlink.messages import CHANNELS
from usvlearn.live.mavlink.vehicle import Vehicle
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.ardupilot.tlog import Tlog

SOURCES = {part: Source(**each) for part, each in CHANNELS.items()}
RECEIPT = 1000.0  # s; the node's clock when the boat's time is 0
MOST = 10_000_000  # bytes of a log
BASE = 50.0  # s; so long before did the boat boot


class Lab:
    """A boat and a shell, joined without a network, in the boat's time."""

    def __init__(self, boats=None, sources=SOURCES, system=None, hz=10.0):
        self.boats = boats or [MavBoat(booted=-BASE)]
        self.boat, self.time, self.said = self.boats[0], 0.0, []
        self.places = [""] * len(self.boats)  # where each sends from
        self.session = RecordingSession(sources)
        self.vehicle = Vehicle(self.session, mavlink, hz, system, self.said.append)
        self.log, self.deaf, self.mute = b"", False, False

    def sail(self, seconds: float, step: float = 0.02, delay: float = 0.03) -> None:
        """Both ends for some time; `deaf`: the boat does not hear, `mute`: it is not heard."""
        for _ in range(round(seconds / step)):
            self.time += step
            senders = list(zip(self.boats, self.places, strict=True))
            frames = [(frame, at) for boat, at in senders for frame in boat.due(self.time)]
            if math.floor(self.time + 1e-9) != math.floor(self.time - step + 1e-9):
                self.vehicle.tick(RECEIPT + self.time + delay)
            sent = b"".join(self.vehicle.telemetry.queue)
            self.vehicle.telemetry.queue.clear()
            for boat, at in [] if self.deaf else senders:
                frames += [(frame, at) for frame in boat.hear(sent)]
            for frame, at in [] if self.mute else frames:
                self.give(frame, delay, at)

    def give(self, data: bytes, delay: float = 0.03, place: str = "") -> bool:
        receipt = self.time + delay
        self.log = (self.log + record(receipt, data))[-MOST:]
        return self.vehicle.receive(data, RECEIPT + receipt, True, place)

    def read_log(self, tmp_path, sources=None):
        path = tmp_path / "a.tlog"
        path.write_bytes(self.log)
        return Tlog().read(path, sources or self.session.sources)
