"""The link to the vehicle: UDP or a serial port, opened anew when it is lost. Only the standard library is used.

    udpin:HOST:PORT      wait at this address for the vehicle; answers go where its messages came from
    udpout:HOST:PORT     send to this address first
    DEVICE,BAUD          a serial port such as /dev/ttyUSB0,57600; serial:DEVICE:BAUD means the same

A link that fails is opened again after 1 s, then after twice as long each time, at most 30 s. A serial port that is
silent for 15 s is opened again, too: the adapter may have been plugged out and in.
"""

from __future__ import annotations

import os
import re
import select
import socket
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

from usvlearn.errors import ConfigError

LARGEST = 65536  # bytes of one read
FIRST_WAIT, LONGEST_WAIT = 1.0, 30.0  # s until a link is opened again
MUTE = 15.0  # s without a byte, after which a serial port is opened again
MOST_SENDERS = 20  # that are told
BAUD = 57600  # of ArduPilot's telemetry ports
EXPECTED = "expected udpin:HOST:PORT, udpout:HOST:PORT, or DEVICE,BAUD such as /dev/ttyUSB0,57600"


class Place(NamedTuple):
    """What a connection string means."""

    kind: str  # "udpin", "udpout" or "serial"
    name: str  # host or device
    number: int  # port or baud


def parse_place(text: str) -> Place:
    """The place that a connection string names."""
    udp = re.fullmatch(r"(udpin|udpout|udp):(?:\[([^\]]+)\]|([^:]+)):(\d+)", text)
    if udp and 0 < int(udp[4]) < 65536:
        return Place("udpout" if udp[1] == "udpout" else "udpin", udp[2] or udp[3], int(udp[4]))
    port = re.fullmatch(r"serial:([^,:]+)(?:[,:](\d+))?", text) or re.fullmatch(r"(/[^,]+)(?:,(\d+))?", text)
    if port:
        number = int(port[2] or BAUD)
        if number not in _speeds():
            raise ConfigError(f"connection: found {number} baud, expected one of {', '.join(map(str, _speeds()))}")
        return Place("serial", port[1], number)
    raise ConfigError(f"connection: found {text!r}, {EXPECTED}")


class Peer(NamedTuple):
    """The only sender that is listened to."""

    host: str
    port: int  # 0: any


def parse_peer(text: str, place: Place) -> Peer:
    """The sender that `--peer` names, of a connection by UDP."""
    if place.kind == "serial":
        raise ConfigError(f"--peer: found {text!r} with a serial port, which has one sender: leave it out")
    match = re.fullmatch(r"(?:\[([^\]]+)\]|([^:\s]+))(?::(\d+))?", text)
    if not match or not 0 <= int(match[3] or 0) < 65536:
        raise ConfigError(f"--peer: found {text!r}, expected HOST or HOST:PORT, such as 192.168.2.1 or [::1]:14551")
    return Peer(match[1] or match[2], int(match[3] or 0))


def _addresses(peer: Peer, family: int) -> set[tuple[str, int]]:
    """All addresses of a peer, and its port; raises OSError while its name is not known."""
    addresses = socket.getaddrinfo(peer.host, None, family, socket.SOCK_DGRAM)
    return {(str(address[0]), peer.port) for *_, address in addresses}


def _speeds() -> dict[int, int]:
    """Baud -> what the operating system calls it."""
    try:
        import termios
    except ImportError as error:
        raise ConfigError("connection: found a serial port, expected udpin or udpout on this system") from error
    speeds = {int(name[1:]): value for name, value in vars(termios).items() if re.fullmatch(r"B\d+", name)}
    return {baud: speeds[baud] for baud in sorted(speeds) if baud >= 1200}


class Udp:
    """A UDP socket, which takes the datagrams of its peer only, or of anybody. An OSError: the link is lost."""

    whole = True  # what it reads are datagrams

    def __init__(self, place: Place, peer: Peer | None = None):
        family, *_, address = socket.getaddrinfo(place.name, place.number, type=socket.SOCK_DGRAM)[0]
        self._only = None if peer is None else _addresses(peer, family)
        self.left_out = ""  # the last sender whose datagram was not taken
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._peer: Any = address if place.kind == "udpout" else None
        self._sender: Any = None
        if place.kind == "udpin":
            try:
                self._socket.bind(address)
            except OSError:
                self._socket.close()
                raise

    def fileno(self) -> int:
        return self._socket.fileno()

    @property
    def sender(self) -> str:
        """Where what was read last came from, as HOST:PORT."""
        if self._sender is None:
            return ""
        host, port = self._sender[:2]
        return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"

    def read(self) -> bytes:
        """What has arrived; empty if nothing."""
        try:
            data, self._sender = self._socket.recvfrom(LARGEST)
        except (BlockingIOError, ConnectionRefusedError):  # the latter: nobody listens there yet
            return b""
        if self._only is not None and self._only.isdisjoint({self._sender[:2], (self._sender[0], 0)}):
            self.left_out = self.sender
            return b""
        return data

    def write(self, frame: bytes) -> bool:
        """Send a frame; False if there is no room now."""
        if self._peer is not None:
            with suppress(OSError):  # a network that is down comes back, and a datagram may be lost anyway
                self._socket.sendto(frame, self._peer)
        return True

    def answer(self) -> None:
        """What was read last came from the vehicle: from now on, send there."""
        self._peer = self._sender

    def close(self) -> None:
        self._socket.close()


class Serial:
    """As `Udp`, a serial port, 8 data bits, no parity, 1 stop bit, without flow control."""

    whole, sender, left_out = False, "", ""

    def __init__(self, place: Place, peer: Peer | None = None):
        import termios
        import tty

        self._file = os.open(place.name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            tty.setraw(self._file)
            how = termios.tcgetattr(self._file)
            how[2] = how[2] & ~(termios.CSTOPB | termios.PARENB | termios.CRTSCTS) | termios.CLOCAL | termios.CREAD
            how[4] = how[5] = _speeds()[place.number]
            termios.tcsetattr(self._file, termios.TCSANOW, how)
        except termios.error as error:
            os.close(self._file)
            raise OSError(*error.args) from error
        self._rest = b""  # of a frame that was sent in part

    def fileno(self) -> int:
        return self._file

    def read(self) -> bytes:
        try:
            data = os.read(self._file, LARGEST)
        except BlockingIOError:
            return b""
        if not data:
            raise OSError("the serial port was closed")
        return data

    def write(self, frame: bytes) -> bool:
        data = self._rest or frame
        try:
            sent = os.write(self._file, data)
        except BlockingIOError:
            return False
        began, self._rest = bool(self._rest), data[sent:]
        return not began  # else the rest of an earlier frame went first

    def answer(self) -> None:
        pass

    def close(self) -> None:
        os.close(self._file)


class Link:
    """A port that is opened when it can be. `say` takes sentences for the operator; times are s of a steady clock."""

    def __init__(self, place: Place, say: Callable[[str], None], peer: Peer | None = None):
        self._place, self._say, self._peer = place, say, peer
        self._left_out: set[str] = set()  # senders that were told
        self._port: Udp | Serial | None = None
        self._due, self._wait = 0.0, FIRST_WAIT  # when to open it, and how long to wait after the next failure
        self._heard = 0.0  # when something was read last, or it was opened
        self._told = ""

    @property
    def whole(self) -> bool:
        return self._port is not None and self._port.whole

    @property
    def sender(self) -> str:
        """Where that came from which was read last, as HOST:PORT; empty of a serial port."""
        return "" if self._port is None else self._port.sender

    def open(self, now: float) -> bool:
        """Open the link if it is due; returns whether it was opened now."""
        if self._port is not None or now < self._due:
            return False
        try:
            self._port = (Serial if self._place.kind == "serial" else Udp)(self._place, self._peer)
        except OSError as error:
            self._lose(error, now)
            return False
        self._heard, self._told = now, ""
        self._say(f"{':'.join(map(str, self._place))} is open")
        return True

    def _lose(self, error: OSError, now: float) -> None:
        self.close()
        sentence = f"{self._place.name}: {error.strerror or error}: trying again"
        if sentence != self._told:
            self._told = sentence
            self._say(sentence)
        self._due, self._wait = now + self._wait, min(2 * self._wait, LONGEST_WAIT)

    def wait(self, timeout: float) -> None:
        """Wait for something to read, s."""
        ports = [] if self._port is None else [self._port]
        with suppress(OSError, ValueError):  # it was closed from below; reading will tell
            select.select(ports, [], [], max(timeout, 0.0))

    def read(self, now: float) -> bytes:
        """What has arrived, one datagram at most; empty if nothing."""
        if self._port is None:
            return b""
        try:
            data = self._port.read()
        except OSError as error:
            self._lose(error, now)
            return b""
        if (other := self._port.left_out) not in self._left_out and other and len(self._left_out) < MOST_SENDERS:
            self._left_out.add(other)
            self._say(f"what {other} sends is left out: it is not the --peer")
        if data:
            self._heard, self._wait = now, FIRST_WAIT
        elif self._place.kind == "serial" and now - self._heard > MUTE:
            self._lose(OSError(f"silent for {MUTE:g} s"), now)
        return data

    def answer(self) -> None:
        """What was read last came from the vehicle."""
        if self._port is not None:
            self._port.answer()

    def write(self, frames: deque[bytes], now: float) -> None:
        """Send frames, the first ones first, until there is no room; without a port they are lost."""
        try:
            while self._port is not None and frames and self._port.write(frames[0]):
                frames.popleft()
        except OSError as error:
            self._lose(error, now)
        if self._port is None:
            frames.clear()

    def close(self) -> None:
        if self._port is not None:
            self._port.close()
            self._port = None
