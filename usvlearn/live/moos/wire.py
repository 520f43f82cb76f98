"""Packets and messages of MOOS V10, as bytes.

A packet is `int32 bytes, int32 messages, uint8 compressed`, then the messages. A message is `int32 bytes, int32 id,
char kind, char data`, four strings (source, aux, community, key), `float64 time, value, value2`, and a string. A string
is `int32 bytes` and these bytes. All numbers are little endian, and a length of a packet or a message counts itself.
There is no checksum: after nonsense the only remedy is a new connection.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Iterable
from typing import NamedTuple

PROTOCOL = b"ELKS CAN'T DANCE 2/8/10".ljust(32, b"\0")  # what a client sends first
LARGEST = 1 << 22  # bytes of a packet; five variables at 100 Hz need 0.25 MB in 5 s
NOTIFY, REGISTER, TIMING, DATA, WELCOME, POISON = "NRTiWK"
NUMBER, TEXT, BINARY = "DSB"
NOTHING = -1.0  # a number that is not used

_PACKET = struct.Struct("<iiB")
_HEAD = struct.Struct("<iicc")
_SIZE = struct.Struct("<i")
_NUMBERS = struct.Struct("<ddd")
SMALLEST = _HEAD.size + 5 * _SIZE.size + _NUMBERS.size  # bytes of a message: 54


class WireError(Exception):
    """Bytes that are no packet of MOOS. The connection cannot be used any more."""


class Message(NamedTuple):
    """One message."""

    kind: str  # one character
    key: str = ""  # the variable
    data: str = NUMBER  # which of value and text counts: NUMBER, TEXT or BINARY
    value: float = NOTHING
    text: str = ""  # UTF-8; other bytes as surrogates
    time: float = 0.0  # s, MOOS time
    source: str = ""  # the app that posted it
    aux: str = ""
    community: str = ""
    value2: float = NOTHING
    id: int = -1


def encode(messages: Iterable[Message]) -> bytes:
    """A packet of these messages."""
    parts = [_encode(message) for message in messages]
    return _PACKET.pack(_PACKET.size + sum(map(len, parts)), len(parts), 0) + b"".join(parts)


def _encode(message: Message) -> bytes:
    body = b"".join(
        (
            *map(_string, (message.source, message.aux, message.community, message.key)),
            _NUMBERS.pack(message.time, message.value, message.value2),
            _string(message.text),
        )
    )
    head = _HEAD.pack(_HEAD.size + len(body), message.id, message.kind.encode("latin1"), message.data.encode("latin1"))
    return head + body


def _string(text: str) -> bytes:
    raw = text.encode("utf-8", "surrogateescape")
    return _SIZE.pack(len(raw)) + raw


def size_of(packet: bytes) -> int:
    """The length of a packet from its first four bytes."""
    (size,) = _SIZE.unpack_from(packet)
    if not _PACKET.size <= size <= LARGEST:
        raise WireError(f"a packet of {size} bytes, expected {_PACKET.size} to {LARGEST}")
    return size


def decode(packet: bytes) -> list[Message]:
    """The messages of a packet."""
    if len(packet) < _PACKET.size:
        raise WireError(f"a packet of {len(packet)} bytes, expected at least {_PACKET.size}")
    size, count, compressed = _PACKET.unpack_from(packet)
    if size != len(packet):
        raise WireError(f"a packet of {len(packet)} bytes says that it has {size}")
    if compressed:
        raise WireError("a compressed packet, which no version of MOOS sends")
    if not 0 <= count <= (size - _PACKET.size) // SMALLEST:
        raise WireError(f"a packet of {size} bytes says that it has {count} messages")
    messages, at = [], _PACKET.size
    for _ in range(count):
        message, at = _decode(packet, at)
        messages.append(message)
    if at != size:
        raise WireError(f"a packet of {size} bytes has {size - at} bytes after its last message")
    return messages


def _decode(packet: bytes, at: int) -> tuple[Message, int]:
    """The message at a place, and the place after it."""
    if at + SMALLEST > len(packet):
        raise WireError("a packet ends before its last message")
    length, number, kind, data = _HEAD.unpack_from(packet, at)
    end = at + length
    if length < SMALLEST or end > len(packet):
        raise WireError(f"a message of {length} bytes in a packet of {len(packet)}")
    place, strings = at + _HEAD.size, []
    for _ in range(4):
        text, place = _text(packet, place, end)
        strings.append(text)
    if place + _NUMBERS.size > end:
        raise WireError("a message ends before its numbers")
    time, value, value2 = _NUMBERS.unpack_from(packet, place)
    text, _ = _text(packet, place + _NUMBERS.size, end)  # what follows within the message is skipped
    source, aux, community, key = strings
    kinds = kind.decode("latin1"), data.decode("latin1")
    return Message(kinds[0], key, kinds[1], value, text, time, source, aux, community, value2, number), end


def _text(packet: bytes, at: int, end: int) -> tuple[str, int]:
    begin = at + _SIZE.size
    if begin > end:
        raise WireError("a message ends before a string")
    (size,) = _SIZE.unpack_from(packet, at)
    if not 0 <= size <= end - begin:
        raise WireError(f"a string of {size} bytes in a message with {end - begin} left")
    return packet[begin : begin + size].decode("utf-8", "surrogateescape"), begin + size


async def read(reader: asyncio.StreamReader) -> list[Message]:
    """The messages of the next packet of a stream.

    Raises:
        WireError: it is no packet.
        asyncio.IncompleteReadError: the stream ended.
    """
    first = await reader.readexactly(_SIZE.size)
    return decode(first + await reader.readexactly(size_of(first) - len(first)))
