"""Links to a vehicle come back after a loss, and frames are found in any bytes."""

import os
import pty
import random
import socket
import struct
import time
from collections import deque

import pytest

pytest.importorskip("pymavlink", reason="needs the package pymavlink")

from tests.support.mavboat import HERE, MavBoat, free_port, mavlink
from usvlearn.errors import ConfigError
from usvlearn.live.mavlink.links import BAUD, LONGEST_WAIT, MUTE, Link, Peer, Place, parse_peer, parse_place
from usvlearn.live.mavlink.messages import Frames


def opened(place: Place, now: float = 0.0, peer: Peer | None = None) -> tuple[Link, list[str]]:
    said: list[str] = []
    link = Link(place, said.append, peer)
    link.open(now)
    return link, said


def arrived(link: Link, now: float = 0.0, timeout: float = 60.0) -> bytes:
    end = time.monotonic() + timeout
    while time.monotonic() < end:
        link.wait(0.05)
        if data := link.read(now):
            return data
    return b""


# ---------------------------------------------------------------- connection strings


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("udpin:0.0.0.0:14550", Place("udpin", "0.0.0.0", 14550)),
        ("udp:localhost:14550", Place("udpin", "localhost", 14550)),
        ("udpout:[::1]:14551", Place("udpout", "::1", 14551)),
        ("/dev/ttyUSB0,57600", Place("serial", "/dev/ttyUSB0", 57600)),
        ("/dev/ttyACM0", Place("serial", "/dev/ttyACM0", BAUD)),
        ("serial:/dev/ttyUSB0:921600", Place("serial", "/dev/ttyUSB0", 921600)),
    ],
)
def test_a_connection_is_what_it_says(text, place):
    assert parse_place(text) == place


@pytest.mark.parametrize(
    "text", ["", "udpin", "udpin:a", "udpin:a:0", "udpin:a:99999", "tcp:a:1", "ttyUSB0", "udpin::1"]
)
def test_another_connection_is_refused(text):
    with pytest.raises(ConfigError, match=r"connection: found .*expected udpin:HOST:PORT, udpout:HOST:PORT, or DEVICE"):
        parse_place(text)


def test_a_speed_that_no_port_has_is_refused():
    with pytest.raises(ConfigError, match="found 12345 baud, expected one of 1200, "):
        parse_place("/dev/ttyUSB0,12345")


# ---------------------------------------------------------------- UDP


def test_answers_go_where_the_vehicle_sent_from_and_nowhere_before():
    port = free_port()
    link, said = opened(Place("udpin", HERE, port))
    assert said == [f"udpin:{HERE}:{port} is open"]
    frames = deque([b"early"])
    link.write(frames, 0.0)
    assert not frames  # nobody to send it to
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as boat,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
    ):
        for one in (boat, other):
            one.bind((HERE, 0))
            one.settimeout(2.0)
        boat.sendto(b"boat", (HERE, port))
        assert arrived(link) == b"boat"
        link.answer()
        other.sendto(b"other", (HERE, port))
        assert arrived(link) == b"other"  # it is read, but not answered
        link.write(deque([b"answer"]), 0.0)
        assert boat.recv(100) == b"answer"
        other.setblocking(False)
        with pytest.raises(BlockingIOError):
            other.recv(100)
    link.close()


def test_a_link_out_survives_that_nobody_listens():
    port = free_port()
    link, _ = opened(Place("udpout", HERE, port))
    for _ in range(5):
        link.write(deque([b"x"]), 0.0)
        assert link.read(0.0) == b""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as boat:
        boat.bind((HERE, port))
        boat.settimeout(2.0)
        link.write(deque([b"hello"]), 0.0)
        data, sender = boat.recvfrom(100)
        boat.sendto(data.upper(), sender)
        assert arrived(link) == b"HELLO"
    link.close()


def test_a_port_that_is_in_use_is_tried_again_ever_less_often():
    port = free_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HERE, port))
        link, said = opened(Place("udpin", HERE, port))
        tries = 0
        for now in range(100):
            before = link._due
            assert not link.open(float(now))
            tries += link._due != before
        assert 5 <= tries <= 9 and link._wait == LONGEST_WAIT
        assert len(said) == 1 and "in use" in said[0]
    assert link.open(1000.0) and "is open" in said[-1]
    link.close()


# ---------------------------------------------------------------- serial


@pytest.fixture
def wire():
    """A serial line: the file of its other end, and the name of its device."""
    other, device = pty.openpty()
    os.set_blocking(other, False)
    yield other, os.ttyname(device)
    os.close(device)
    os.close(other)


def read(other: int) -> bytes:
    """What has come out of the other end of a serial line."""
    try:
        return os.read(other, 4096)
    except BlockingIOError:
        time.sleep(0.001)
        return b""


def test_a_serial_line_carries_any_bytes_both_ways(wire):
    other, name = wire
    link, _ = opened(Place("serial", name, 57600))
    every = bytes(range(256)) * 3  # no byte means anything to the line
    os.write(other, every)
    received = b""
    while len(received) < len(every):
        received += (data := arrived(link))
        assert data
    assert received == every
    frames = deque([every, b"\x03\x04\n\r"])
    link.write(frames, 0.0)
    assert not frames
    sent = b""
    end = time.monotonic() + 60
    while len(sent) < len(every) + 4 and time.monotonic() < end:
        sent += read(other)
    assert sent == every + b"\x03\x04\n\r"
    link.close()


def test_a_serial_line_that_is_full_loses_no_part_of_a_frame(wire):
    other, name = wire
    link, _ = opened(Place("serial", name, 57600))
    frame, frames, sent = bytes(range(250)), deque(maxlen=64), b""
    for _ in range(200):
        frames.append(frame)
        link.write(frames, 0.0)
    assert 0 < len(frames) <= 64
    end = time.monotonic() + 60
    while frames and time.monotonic() < end:
        sent += read(other)
        link.write(frames, 0.0)
    whole = frame * (len(sent) // 250 + 1)
    assert sent == whole[: len(sent)]
    link.close()


def test_a_serial_line_that_is_unplugged_or_mute_is_opened_again(tmp_path):
    path = tmp_path / "ttyUSB0"
    link, said = opened(Place("serial", str(path), 57600))
    assert "No such file" in said[-1]
    for now in (10.0, 100.0):  # it is plugged in, and out again
        other, device = pty.openpty()
        path.unlink(missing_ok=True)
        path.symlink_to(os.ttyname(device))
        assert link.open(now)
        os.write(other, b"alive")
        assert arrived(link, now) == b"alive"
        os.close(device)
        os.close(other)
        assert link.read(now + 1) == b"" and link.open(now + 2.5) is False
        assert "trying again" in said[-1]
    other, device = pty.openpty()
    path.unlink()
    path.symlink_to(os.ttyname(device))
    assert link.open(200.0)
    link.read(200.0 + MUTE + 1)
    assert said[-1] == f"{path}: silent for {MUTE:g} s: trying again"
    assert link.open(300.0)
    link.close()
    os.close(device)
    os.close(other)


def test_a_file_is_no_serial_port(tmp_path):
    path = tmp_path / "file"
    path.write_text("text")
    link, said = opened(Place("serial", str(path), 57600))
    assert "trying again" in said[0] and link.read(0.0) == b""


# ---------------------------------------------------------------- frames


@pytest.mark.parametrize("version", [1, 2])
def test_frames_are_found_however_they_are_cut(version):
    boat = MavBoat(version=version)
    content = b"".join(boat.packed(boat.message(number, 0.1 * k)) for k in range(20) for number in (30, 36, 32, 0, 74))
    expected = Frames(mavlink).take(content, whole=True)
    assert len(expected) == 100
    for size in (1, 2, 3, 7, 64, 300):
        frames = Frames(mavlink)
        taken = [m for k in range(0, len(content), size) for m in frames.take(content[k : k + size])]
        assert [m.get_msgbuf() for m in taken] == [m.get_msgbuf() for m in expected] and frames.skipped == 0


def test_a_datagram_that_is_cut_anywhere_spoils_no_other():
    boat = MavBoat()
    frame = boat.packed(boat.message(30, 1.0))
    frames = Frames(mavlink)
    for end in range(len(frame)):
        assert frames.take(frame[:end], whole=True) == []
        assert len(frames.take(frame, whole=True)) == 1


def test_garbage_costs_no_frame_behind_it():
    boat, rng = MavBoat(), random.Random(0)
    good = [boat.packed(boat.message(number, 0.1 * k)) for k in range(100) for number in (30, 36)]
    frames, taken = Frames(mavlink), []
    for frame in good:
        noise = bytes(rng.choice(b"\xfd\xfe\x00\x1e") for _ in range(rng.randrange(40)))
        wrong = bytearray(frame)
        wrong[rng.randrange(len(wrong) - 2) + 2] ^= 1 << rng.randrange(8)
        taken += frames.take(noise + bytes(wrong) + frame)
    taken += frames.take(bytes(600))
    seen = [bytes(m.get_msgbuf()) for m in taken]
    assert [frame for frame in good if frame not in seen] == []


def test_signed_frames_are_taken_and_unknown_ones_passed_over():
    boat = MavBoat()
    plain = boat.packed(boat.message(30, 1.0))
    boat.pack.signing.secret_key, boat.pack.signing.sign_outgoing = bytes(32), True
    signed = boat.packed(boat.message(30, 2.0))
    assert signed[2] == 1 and len(signed) > len(plain)
    unknown = bytes([0xFD, 3, 0, 0, 7, 1, 1]) + struct.pack("<I", 65_000)[:3] + b"abc" + b"zz"
    taken = Frames(mavlink).take(plain + unknown + signed + plain)
    assert [m.time_boot_ms for m in taken] == [6000, 7000, 6000]


def test_what_waits_for_its_end_is_bounded():
    frames, rng = Frames(mavlink), random.Random(1)
    for _ in range(300):
        frames.take(rng.randbytes(200).replace(b"\x00", b"\xfd"))
        assert len(frames._rest) <= 300


# ---------------------------------------------------------------- one peer


@pytest.mark.parametrize("exact", [True, False])
def test_only_the_peer_is_heard(exact):
    port = free_port()
    kind = socket.AF_INET, socket.SOCK_DGRAM
    with socket.socket(*kind) as one, socket.socket(*kind) as two:
        one.bind((HERE, 0))
        two.bind((HERE, 0))
        number = one.getsockname()[1]
        place = Place("udpin", HERE, port)
        link, said = opened(place, peer=parse_peer(f"localhost:{number}" if exact else HERE, place))
        two.sendto(b"two", (HERE, port))
        two.sendto(b"two", (HERE, port))
        one.sendto(b"one", (HERE, port))
        assert arrived(link) == (b"one" if exact else b"two")
        other = f"{HERE}:{two.getsockname()[1]}"
        assert link.sender == (f"{HERE}:{number}" if exact else other)
        assert said[1:] == ([f"what {other} sends is left out: it is not the --peer"] if exact else [])
        link.close()


@pytest.mark.parametrize("text", ["", "a b", "host:", "host:x", "host:70000", "::1", "udpin:1.2.3.4:5"])
def test_what_is_no_peer_is_refused(text):
    with pytest.raises(ConfigError, match=r"--peer: found .*expected HOST"):
        parse_peer(text, Place("udpin", HERE, 14550))


def test_a_serial_port_has_no_peer():
    with pytest.raises(ConfigError, match=r"--peer: found '1\.2\.3\.4' with a serial port"):
        parse_peer("1.2.3.4", Place("serial", "/dev/ttyUSB0", BAUD))
