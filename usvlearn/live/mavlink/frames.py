"""Whole frames of MAVLink 1 and 2 in a stream of bytes or in datagrams: https://mavlink.io/en/guide/serialization.html.

Each frame is checked and decoded by pymavlink. What is no frame is skipped byte by byte, so that a damaged frame never
takes a good one with it. An unknown message cannot be checked, and is skipped likewise.
"""

from __future__ import annotations

import importlib
import re
from types import ModuleType
from typing import Any

from usvlearn.errors import MissingExtraError

V1, V2 = 0xFE, 0xFD  # the first byte of a frame
HEADS = {V1: 6, V2: 10}  # bytes before the payload
CHECKSUM, SIGNATURE, SIGNED = 2, 13, 1  # bytes, bytes, and the flag of a signed frame
FIRST = re.compile(b"[\xfd\xfe]")


def load_dialect() -> ModuleType:
    """pymavlink's messages of ArduPilot, as MAVLink 2.

    Raises:
        MissingExtraError: pymavlink is not installed.
    """
    try:
        return importlib.import_module("pymavlink.dialects.v20.ardupilotmega")
    except ImportError as error:
        raise MissingExtraError("pymavlink", "mavlink", "usvlearn live mavlink") from error


class Frames:
    """Finds the messages in what a link receives.

    Args:
        dialect: of `load_dialect`.

    Attributes:
        skipped: bytes that belong to no frame of a known message.

    >>> dialect = load_dialect()
    >>> frame = dialect.MAVLink_attitude_message(5000, 0, 0, 1.5, 0, 0, 0).pack(dialect.MAVLink(None, 1, 1))
    >>> frames = Frames(dialect)
    >>> frames.take(b"noise" + frame[:20]), [message.yaw for message in frames.take(frame[20:])], frames.skipped
    ([], [1.5], 5)
    """

    def __init__(self, dialect: ModuleType):
        self._messages = dialect.mavlink_map
        self._link = dialect.MAVLink(None)
        self._error = dialect.MAVError
        self._rest = b""  # of a stream, at most one frame
        self.skipped = 0

    def take(self, data: bytes, whole: bool = False) -> list[Any]:
        """The messages that are complete now, as pymavlink decodes them.

        Args:
            data: what was received.
            whole: it is a datagram, which begins with a frame and ends with one.
        """
        data, place, found = self._rest + data, 0, []
        while (first := FIRST.search(data, place)) is not None:
            self.skipped += first.start() - place
            place = first.start()
            end = self._end(data, place)
            if end > len(data) and not whole:
                break  # the rest is to come
            message = self._decode(data[place:end]) if 0 < end <= len(data) else None
            if message is None:
                self.skipped += 1
                place += 1
            else:
                found.append(message)
                place = end
        else:
            self.skipped += len(data) - place
            place = len(data)
        self._rest = data[place:]
        return found

    def clear(self) -> None:
        """Forget the beginning of a frame: the link is a new one."""
        self._rest = b""

    def _end(self, data: bytes, place: int) -> int:
        """Where the frame ends that begins at `place`, perhaps beyond the data; 0 if none begins there."""
        version = data[place]
        head = place + HEADS[version]
        if len(data) < head:
            return len(data) + 1
        flags = data[place + 2] if version == V2 else 0
        number = int.from_bytes(data[place + 7 : head], "little") if version == V2 else data[head - 1]
        if number not in self._messages or flags & ~SIGNED:
            return 0
        if version == V1 and data[place + 1] > self._messages[number].unpacker.size:
            return 0
        return head + data[place + 1] + CHECKSUM + (SIGNATURE if flags else 0)

    def _decode(self, frame: bytes) -> Any | None:
        try:
            return self._link.decode(bytearray(frame))
        except self._error:
            return None
