"""Whatever arrives, no exception is raised, and the memory that is used stays bounded."""

import math
import random
import struct
import tracemalloc
from collections import Counter

import pytest

pytest.importorskip("pymavlink", reason="needs the package pymavlink")

from tests.support.mavboat import MavBoat, RecordingSession, mavlink
from usvlearn.live.mavlink.messages import CHANNELS, ROOM
from usvlearn.live.mavlink.vehicle import Vehicle
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.ardupilot.mavlink_messages import MESSAGES

SOURCES = {part: Source(**each) for part, each in CHANNELS.items()} | {
    "course": Source("RPM", "rpm1, rpm2"),
    "north": Source("ESC_TELEMETRY_1_TO_4", "rpm.1"),
    "east": Source("RAW_IMU[1]", "xacc"),
    "latitude": Source("GPS_RAW_INT@*.1", "lat"),
}
NUMBERS = (*MESSAGES, 77, 251, 253, 148, 230)
FLOATS = (math.nan, math.inf, -math.inf, 3.4e38, -3.4e38, 1e-45, 0.0, -1.0, 1500.0, 73.0)


class Counting(RecordingSession):
    """Counts instead of keeping."""

    def __init__(self):
        super().__init__(SOURCES)
        self.count = Counter()

    def push(self, part, stamp, raw):
        assert part in SOURCES and math.isfinite(stamp) and isinstance(raw, float)
        self.count[part] += 1
        return []

    def drop(self, part, cause):
        self.count[part, cause] += 1

    def restart(self):
        self.count["restart"] += 1
        return []


def drawn(number: int, boat: MavBoat, rng: random.Random) -> bytes:
    """A frame of any content with a right checksum, of the boat or of others."""
    kind = mavlink.mavlink_map[number]
    raw = bytearray(rng.randbytes(kind.unpacker.size))
    for place in range(0, len(raw) - 3, 4):
        if rng.random() < 0.3:
            raw[place : place + 4] = struct.pack("<f", rng.choice(FLOATS))
    if number == 22 and rng.random() < 0.8:
        suffix = rng.choice(("FUNCTION", "MIN", "MAX", "TRIM", "REVERSED"))
        raw[8:24] = f"SERVO{rng.randrange(20)}_{suffix}".encode().ljust(16, b"\0")[:16]
    message = kind(*unpacked(kind, bytes(raw)))
    sender = mavlink.MAVLink(None, *((1, 1) if rng.random() < 0.8 else (rng.randrange(256), rng.randrange(256))))
    return bytes(message.pack(sender, force_mavlink1=number < 256 and rng.random() < 0.3))


def unpacked(kind, raw: bytes):
    """The fields of a payload in the order of the constructor."""
    link = mavlink.MAVLink(None, 1, 1)
    frame = bytearray(struct.pack("<BBBBBBB", 0xFD, len(raw), 0, 0, 0, 1, 1) + struct.pack("<I", kind.id)[:3] + raw)
    crc = mavlink.x25crc(frame[1:] + bytes([kind.crc_extra])).crc
    message = link.decode(frame + struct.pack("<H", crc))
    return [getattr(message, f"_{name}_raw", getattr(message, name)) for name in kind.fieldnames]


def mutated(frame: bytes, rng: random.Random) -> bytes:
    """A frame with a few bytes changed, cut, or doubled."""
    damaged = bytearray(frame)
    for _ in range(rng.randrange(1, 4)):
        place = rng.randrange(len(damaged)) if damaged else 0
        what = rng.randrange(4)
        if what == 0 and damaged:
            damaged[place] = rng.randrange(256)
        elif what == 1:
            del damaged[place:]
        elif what == 2:
            damaged[place:place] = rng.randbytes(rng.randrange(20))
        else:
            damaged += damaged[place:]
    return bytes(damaged[:2000])


@pytest.mark.fuzz(cases=3000, slow=100_000)
@pytest.mark.parametrize("whole", [True, False], ids=["datagrams", "stream"])
def test_any_bytes_are_survived(whole, rng, cases):
    draw, boat, session = random.Random(int(rng.integers(1 << 62))), MavBoat(), Counting()
    vehicle = Vehicle(session, mavlink, 10.0, None, say=lambda sentence: None)
    now, memory = 1000.0, []
    tracemalloc.start()
    for case in range(cases):
        now += draw.choice((0.0, 0.01, 0.1, 1.0))
        kind = draw.randrange(6)
        if kind == 0:
            data = draw.randbytes(draw.randrange(300))
        elif kind <= 2:
            data = drawn(draw.choice(NUMBERS), boat, draw)
        elif kind <= 4:
            data = mutated(drawn(draw.choice(NUMBERS), boat, draw), draw)
        else:
            data = b"".join(boat.packed(boat.message(number, now - 1000)) for number in (0, 30, 32, 36))
        if draw.random() < 0.005:
            boat.reboot(now - 1000)
        vehicle.receive(data, now, whole)
        if case % 10 == 0:
            vehicle.tick(now)
        assert len(vehicle.telemetry.queue) <= ROOM
        if case % (cases // 10) == cases // 10 - 1:
            memory.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert session.count["heading"] > cases / 20  # it still listens
    assert session.count["restart"] > 0
    assert memory[-1] - memory[4] < 200_000, memory
