"""Packets of MOOS: bytes that are known from outside, and what is no packet."""

import asyncio
import struct

import numpy as np
import pytest

from usvlearn.live.moos import wire
from usvlearn.live.moos.wire import Message, WireError

EVERY = Message("N", "NAV_SPEED", "D", 1.5, "ä\udcff", 1.6e9, "iGPS", "aux", "usv", 2.5, 7)
# a notification as a C++ program would lay it out, byte for byte
KNOWN = bytes.fromhex(
    "3f000000 01000000 00"  # 63 bytes, one message, not compressed
    "36000000 ffffffff 4e 44"  # 54 bytes, id -1, N, D
    "00000000 00000000 00000000 00000000"  # source, aux, community, key
    "0000000000000000 000000000000f03f 000000000000f0bf"  # time 0, value 1, value2 -1
    "00000000"
)


def test_bytes_are_those_of_the_description():
    assert wire.encode([Message("N", value=1.0)]) == KNOWN
    assert wire.decode(KNOWN) == [Message("N", value=1.0)]
    assert wire.PROTOCOL.rstrip(b"\0") == b"ELKS CAN'T DANCE 2/8/10" and len(wire.PROTOCOL) == 32


def test_a_message_comes_back_with_every_field():
    several = [EVERY, Message("T", value=float("inf")), Message("N", "A", "B", text="\0\udc80")]
    assert wire.decode(wire.encode(several)) == several
    assert wire.decode(wire.encode([])) == []


def test_what_follows_the_known_fields_of_a_message_is_skipped():
    packet = bytearray(wire.encode([EVERY, EVERY]))
    (length,) = struct.unpack_from("<i", packet, 9)
    packet[9 + length : 9 + length] = b"new"
    struct.pack_into("<i", packet, 9, length + 3)
    struct.pack_into("<i", packet, 0, len(packet))
    assert wire.decode(bytes(packet)) == [EVERY, EVERY]


def changed(at: int, form: str, value: int) -> bytes:
    packet = bytearray(wire.encode([EVERY]))
    struct.pack_into(form, packet, at, value)
    return bytes(packet)


@pytest.mark.parametrize(
    ("packet", "sentence"),
    [
        (b"\x09\0\0", "a packet of 3 bytes"),
        (changed(0, "<i", 8), "says that it has 8"),
        (changed(4, "<i", 2), "2 messages"),
        (changed(4, "<i", -1), "-1 messages"),
        (changed(8, "<B", 1), "compressed"),
        (changed(9, "<i", 10), "a message of 10 bytes"),
        (changed(9, "<i", 1 << 30), "a message of 1073741824 bytes"),
        (changed(9, "<i", -5), "a message of -5 bytes"),
        (changed(19, "<i", -1), "a string of -1 bytes"),
        (changed(19, "<i", 1 << 30), "a string of 1073741824 bytes"),
        (changed(4, "<i", 0), "after its last message"),
    ],
)
def test_nonsense_is_one_error(packet, sentence):
    with pytest.raises(WireError, match=sentence):
        wire.decode(packet)


@pytest.mark.parametrize("size", [-1, 0, 8, wire.LARGEST + 1, 2**31 - 1])
def test_the_size_of_a_packet_is_limited_before_it_is_read(size):
    async def read():
        reader = asyncio.StreamReader()
        reader.feed_data(struct.pack("<i", size))
        await wire.read(reader)

    with pytest.raises(WireError, match=f"a packet of {size} bytes"):
        asyncio.run(read())


def test_every_cut_packet_is_an_error():
    packet = wire.encode([EVERY])
    for end in range(len(packet)):
        with pytest.raises(WireError):
            wire.decode(packet[:end])
        if end >= 9:  # the same with the length of what is there
            with pytest.raises(WireError):
                wire.decode(struct.pack("<i", end) + packet[4:end])


def test_packets_of_another_implementation_are_ours():
    """pymoos2 reads what we write, and we what it writes."""
    packets = pytest.importorskip("pymoos2.core.MOOSCommPkt", reason="needs the package pymoos2")
    rng = np.random.default_rng(0)
    for _ in range(300):
        texts = ["".join(chr(each) for each in rng.integers(32, 900, rng.integers(0, 9))) for _ in range(5)]
        number = struct.unpack("<d", rng.bytes(8))[0]
        number = number if number == number else 1.0
        ours = [
            Message("N", "K" + texts[0], "D", number, "", float(k), *texts[1:4], 2.0, int(rng.integers(-2, 99)))
            if rng.random() < 0.5
            else Message("R", texts[0], "S", number, "S" + texts[4], float(k), *texts[1:4], 2.0, 3)
            for k in range(rng.integers(1, 5))
        ]
        read = packets.unpack(wire.encode(ours))
        for mine, other in zip(ours, read, strict=True):
            assert (chr(other.msg_type), other.key, chr(other.data_type), other.val, other.sval, other.time) == mine[:6]
            assert (other.src, other.src_aux, other.community, other.val2, other.msg_id) == mine[6:]
        assert wire.decode(packets.pack(read)) == ours
