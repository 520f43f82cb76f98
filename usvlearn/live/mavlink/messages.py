"""Messages on a MAVLink link: frames, the numbers of channels in them, and the messages of the node.

Each frame of MAVLink 1 or 2 (https://mavlink.io/en/guide/serialization.html) is checked and decoded by pymavlink. What
is no frame is skipped byte by byte, so that a damaged frame never takes a good one with it. An unknown message cannot
be checked, and is skipped likewise.

`Source.name` is a message such as `ATTITUDE`, `ATTITUDE@1.1` (component 1 of system 1) or `SERVO_OUTPUT_RAW[1]` (the
second port); `Source.field` one of its fields, several, of which the Euclidean norm is taken, or `throttle_left` and
the like, by the vehicle's parameters.

A vehicle may not send LOCAL_POSITION_NED, from whose velocities the surge is computed. In their place come those of
GLOBAL_POSITION_INT, or else the ground speed of VFR_HUD in the direction of the heading, V cos ψ and V sin ψ, which
gives the surge V. It has no sign: a boat that goes astern seems to go ahead.

Frames that are sent wait in a bounded queue until the link takes them. Numbers and texts are left out while no vehicle
is heard.
"""

from __future__ import annotations

import importlib
import math
import re
import textwrap
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from usvlearn.errors import ConfigError, MissingExtraError, did_you_mean
from usvlearn.live.status import TABLE, Post
from usvlearn.logs.channels.channel import UNITS, Source
from usvlearn.logs.formats.ardupilot.mavlink_messages import MESSAGES, Message
from usvlearn.logs.formats.ardupilot.servos import FUNCTIONS
from usvlearn.logs.formats.ardupilot.tlog import SERVOS
from usvlearn.logs.formats.messages import NAME

V1, V2 = 0xFE, 0xFD  # the first byte of a frame
HEADS = {V1: 6, V2: 10}  # bytes before the payload
CHECKSUM, SIGNATURE, SIGNED = 2, 13, 1  # bytes, bytes, and the flag of a signed frame
FIRST = re.compile(b"[\xfd\xfe]")


def load_dialect() -> ModuleType:
    """pymavlink's messages of ArduPilot, as MAVLink 2."""
    try:
        return importlib.import_module("pymavlink.dialects.v20.ardupilotmega")
    except ImportError as error:
        raise MissingExtraError("pymavlink", "mavlink", "usvlearn live mavlink") from error


class Frames:
    """Finds the messages in what a link receives."""

    def __init__(self, dialect: ModuleType):
        self._messages = dialect.mavlink_map
        self._link = dialect.MAVLink(None)
        self._error = dialect.MAVError
        self._rest = b""  # of a stream, at most one frame
        self.skipped = 0  # bytes that belong to no frame of a known message

    def take(self, data: bytes, whole: bool = False) -> list[Any]:
        """The messages that are complete now, as pymavlink decodes them; whole: a datagram begins and ends with one."""
        data, place, messages = self._rest + data, 0, []
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
                messages.append(message)
                place = end
        else:
            self.skipped += len(data) - place
            place = len(data)
        self._rest = data[place:]
        return messages

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


NUMBERS = {message.name: number for number, message in MESSAGES.items()}
NED, GLOBAL, HUD, ATTITUDE = (
    NUMBERS[name] for name in ("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "VFR_HUD", "ATTITUDE")
)
VELOCITIES = {"vx": 0, "vy": 1}  # fields of LOCAL_POSITION_NED that others can give: north, east

# What a vehicle of ArduPilot sends, where neither a checkpoint nor the user says otherwise: as in
# configs/data/tlog.yaml
CHANNELS: dict[str, dict[str, Any]] = {
    "command_left": {"name": "SERVO_OUTPUT_RAW", "field": "throttle_left"},
    "command_right": {"name": "SERVO_OUTPUT_RAW", "field": "throttle_right"},
    "heading": {"name": "ATTITUDE", "field": "yaw", "unit": "rad"},
    "yaw_rate": {"name": "ATTITUDE", "field": "yawspeed", "unit": "rad/s"},
    "velocity_north": {"name": "LOCAL_POSITION_NED", "field": "vx", "unit": "m/s"},
    "velocity_east": {"name": "LOCAL_POSITION_NED", "field": "vy", "unit": "m/s"},
}


class Route(NamedTuple):
    """From a message to a part of a channel."""

    part: str  # as in `Session.sources`
    source: Source
    number: int  # of the message
    fields: tuple[str, ...]
    instance: int | None  # of several equal senders within the vehicle
    sender: str | None  # pattern of system.component; None: the autopilot

    @property
    def is_output(self) -> bool:
        """Whether it is a command, which counts only while the vehicle is armed."""
        return MESSAGES[self.number].name in SERVOS.outputs

    @property
    def function(self) -> str | None:
        """The servo's function, where the route is by function."""
        return self.fields[0] if self.is_output and self.fields[0] in FUNCTIONS else None

    @property
    def replaceable(self) -> bool:
        """Whether GLOBAL_POSITION_INT and VFR_HUD can give it, too."""
        return self.number == NED and self.sender is None and len(self.fields) == 1 and self.fields[0] in VELOCITIES

    def raw(self, value: float) -> float:
        """The raw number that the source converts to this SI value."""
        factor, offset = UNITS[self.source.unit]
        return (value - offset) / factor * self.source.span + self.source.zero


def find_routes(sources: Mapping[str, Source]) -> list[Route]:
    """A route for each part of the channels."""
    return [_route(part, source) for part, source in sources.items()]


def _route(part: str, source: Source) -> Route:
    where, parts = f"channels.{part}", NAME.fullmatch(source.name)
    plain, instance, sender = parts.groups() if parts else (source.name, None, None)
    names = [name for name in NUMBERS if fnmatchcase(name, plain)]
    if len(names) != 1:
        hint = did_you_mean(plain, NUMBERS) or "."
        raise ConfigError(
            f"{where}.name: found {source.name!r}, expected the name of a MAVLink message{hint} Name the messages of "
            "this vehicle in --channels FILE"
        )
    message, output = MESSAGES[NUMBERS[names[0]]], names[0] in SERVOS.outputs
    fields = tuple(each.strip() for each in (source.field or "").split(","))
    if output and source.held:
        raise ConfigError(
            f"{where}.held: found true, expected false, because the last command before disarming would stay in force"
        )
    if not (output and len(fields) == 1 and fields[0] in FUNCTIONS):
        known = [
            name
            for name, field in message.fields.items()
            if name not in (message.stamp, message.instance) and not field.dtype.startswith("S")
        ]
        for each in fields:
            if each not in known:
                further = [*known, *(FUNCTIONS if output else ())]
                raise ConfigError(
                    f"{where}.field: found {each!r}, expected a field of {names[0]} among {', '.join(further)}"
                )
    return Route(part, source, NUMBERS[names[0]], fields, None if instance is None else int(instance), sender)


def number_of(message: Any, name: str) -> float:
    """A field of a decoded message; `rpm.0` is the first of an array."""
    plain, _, place = name.partition(".")
    value = getattr(message, plain)
    return float(value[int(place)] if place else value)


def value_of(message: Any, fields: tuple[str, ...]) -> float:
    """A field, or the norm of several."""
    numbers = [number_of(message, name) for name in fields]
    if len(numbers) == 1:
        return numbers[0]
    with np.errstate(all="ignore"):
        return float(np.hypot.reduce(numbers))


def velocity_of(message: Any, heading: float) -> tuple[float, float] | None:
    """North and east, m/s, from a message that can replace LOCAL_POSITION_NED; NaN without a heading."""
    number = message.get_msgId()
    if number == GLOBAL:
        return 0.01 * message.vx, 0.01 * message.vy
    if number == HUD and math.isfinite(heading):
        return message.groundspeed * math.cos(heading), message.groundspeed * math.sin(heading)
    return None


def instance_of(message: Any) -> int | None:
    """The number of the equal sender within a vehicle, where the message has one."""
    declared: Message = MESSAGES[message.get_msgId()]
    return None if declared.instance is None else int(getattr(message, declared.instance))


COMPONENT = 191  # MAV_COMP_ID_ONBOARD_COMPUTER
ROOM = 256  # frames in the queue; the oldest gives way


def in_parts(text: str, most: int) -> list[bytes]:
    """A text in parts that end with a word, as far as words allow; all but the last are full, as MAVLink wants it."""
    lines = textwrap.wrap(text.encode("ascii", "replace").decode(), TEXT, drop_whitespace=True) or [""]
    if len(lines) > most:
        kept = textwrap.wrap(lines[most - 1], TEXT - 4)[0]
        lines = [*lines[: most - 1], f"{kept} ..."]
    return [*(line.ljust(TEXT).encode() for line in lines[:-1]), lines[-1].encode()]


TEXT, PARTS = 50, 4  # characters of one STATUSTEXT, and how many may make one text
BURST, PACE, AGAIN = 5, 2.0, 60.0  # texts at once; s for one more; s before the same text
LARGEST = 3.4e38  # of a 32-bit float
WRAP = 1 << 32  # ms
SET_INTERVAL = 511  # MAV_CMD_SET_MESSAGE_INTERVAL
ONBOARD_CONTROLLER, INVALID, ACTIVE = 18, 8, 4  # type, autopilot and state in our heart-beat
SHORT = {each.name: each.short.encode() for each in TABLE if each.short} | {  # names of at most 10 characters
    "steady_speed_full": b"USV_VFULL", "time_constant": b"USV_TAU", "stopping_distance": b"USV_STOP",
    "thrust_ratio": b"USV_RATIO",
}  # fmt: skip
WARNING, INFO = 4, 6  # severities
COMMAND, USER = 76, 31010  # COMMAND_LONG, and MAV_CMD_USER_1: its first parameter answers an alarm
ANSWERS = {1.0: "acknowledge", 2.0: "reset"}
NUMBERS_SENT = 58  # of a DEBUG_FLOAT_ARRAY


class Telemetry:
    """Makes the frames that are sent."""

    def __init__(self, dialect: ModuleType, system: int = 1):
        self._dialect = dialect
        self.link = dialect.MAVLink(None, srcSystem=system, srcComponent=COMPONENT)  # of pymavlink
        self.queue: deque[bytes] = deque(maxlen=ROOM)
        self.old = False  # whether the vehicle speaks MAVLink 1
        self.left_out = 0  # texts that came too fast
        self._tokens, self._filled = float(BURST), -math.inf
        self._said: dict[str, float] = {}  # text -> when it was said last
        self._text = 0  # number of the last text in parts

    def _send(self, message: Any) -> None:
        self.queue.append(bytes(message.pack(self.link, force_mavlink1=self.old)))
        self.link.seq = (self.link.seq + 1) % 256

    def heartbeat(self) -> None:
        """That this component is alive."""
        self._send(self._dialect.MAVLink_heartbeat_message(ONBOARD_CONTROLLER, INVALID, 0, 0, ACTIVE, 3))

    def ask_interval(self, target: tuple[int, int], number: int, micros: float) -> None:
        """Ask a component for a message at an interval."""
        rest = (float(number), micros, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._send(self._dialect.MAVLink_command_long_message(*target, SET_INTERVAL, 0, *rest))

    def ask_parameter(self, target: tuple[int, int], name: str) -> None:
        """Ask a component for a parameter by its name."""
        self._send(self._dialect.MAVLink_param_request_read_message(*target, name.encode(), -1))

    def acknowledge(self, message: Any, accepted: bool) -> None:
        """Answer a command."""
        sender = message.get_srcSystem(), message.get_srcComponent()
        result = 0 if accepted else 2  # MAV_RESULT_ACCEPTED, MAV_RESULT_DENIED
        self._send(self._dialect.MAVLink_command_ack_message(message.command, result, 0, 0, *sender))

    def array(self, name: str, time: float, rows: Iterable[Sequence[float]]) -> None:
        """Send rows of numbers, one behind the other; MAVLink 1 has no such message."""
        numbers = [float(x) for row in rows for x in row][:NUMBERS_SENT]
        if numbers and not self.old:
            numbers += [0.0] * (NUMBERS_SENT - len(numbers))
            micros = round(1e6 * time) if 0 <= time < 1e12 else 0
            self._send(self._dialect.MAVLink_debug_float_array_message(micros, name.encode(), 0, numbers))

    def values(self, time: float, posts: Iterable[Post]) -> None:
        """Send the numbers among some posts, with a time of the vehicle, s; what no 32-bit float holds is left out."""
        millis = round(1000 * time) % WRAP if math.isfinite(time) else 0
        for name, value in posts:
            if (short := SHORT.get(name)) and not isinstance(value, str) and abs(value) < LARGEST:
                self._send(self._dialect.MAVLink_named_value_float_message(millis, short, value))

    def say(self, text: str, severity: int, now: float) -> bool:
        """Send a text, unless it or others were sent just before; returns whether it was sent."""
        elapsed = now - self._filled
        self._tokens = min(BURST, self._tokens + elapsed / PACE) if math.isfinite(elapsed) else BURST
        self._filled = now
        self._said = {said: when for said, when in self._said.items() if now - when < AGAIN}
        if self._tokens < 1 or text in self._said:
            self.left_out += 1
            return False
        self._tokens -= 1
        self._said[text] = now
        pieces = in_parts(text, 1 if self.old else PARTS)
        self._text = self._text % 0xFFFF + 1
        for k, piece in enumerate(pieces):
            number = self._text if len(pieces) > 1 else 0
            self._send(self._dialect.MAVLink_statustext_message(severity, piece, number, k if number else 0))
        if len(pieces) > 1 and len(pieces[-1]) == TEXT:  # a text in parts ends with a part that is not full
            self._send(self._dialect.MAVLink_statustext_message(severity, b"", self._text, len(pieces)))
        return True
