"""Which message and field feed which channel, and the numbers in them: those that a telemetry log gives.

`Source.name` is a message such as `ATTITUDE`, `ATTITUDE@1.1` (component 1 of system 1) or `SERVO_OUTPUT_RAW[1]` (the
second port); `Source.field` one of its fields, several, of which the Euclidean norm is taken, or `throttle_left` and
the like, by the vehicle's parameters.

A vehicle may not send LOCAL_POSITION_NED, from whose velocities the surge is computed. In their place come those of
GLOBAL_POSITION_INT, or else the ground speed of VFR_HUD in the direction of the heading, V cos ψ and V sin ψ, which
gives the surge V. It has no sign: a boat that goes astern seems to go ahead.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import numpy as np

from usvlearn.errors import ConfigError, did_you_mean
from usvlearn.logs.channels.channel import UNITS, Source
from usvlearn.logs.formats.ardupilot.mavlink_messages import MESSAGES, Message
from usvlearn.logs.formats.ardupilot.servos import FUNCTIONS
from usvlearn.logs.formats.ardupilot.tlog import SERVOS
from usvlearn.logs.formats.messages import NAME

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
    """A route for each part of the channels.

    Raises:
        ConfigError: a source names no MAVLink message or none of its fields, or would hold a command after disarming.

    >>> [route.number for route in find_routes({part: Source(**each) for part, each in CHANNELS.items()})]
    [36, 36, 30, 30, 32, 32]
    >>> find_routes({"heading": Source("ATT", "Yaw", "deg")})
    Traceback (most recent call last):
    usvlearn.errors.ConfigError: channels.heading.name: found 'ATT', expected the name of a MAVLink message. \
Name the messages of this vehicle in --channels FILE
    """
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
