"""The numbers and the stamp of a ROS message, from a bag or from rclpy: a number at a dotted path, or all of them.

Messages from a bag are dataclasses of the package rosbags; those of rclpy name their fields by a method.

The recorder of a bag stamps each message at its receipt. Headers or /clock with another rate hold the time of a
simulation. Then all receipts are mapped to it, so that messages with and without a header are in one time.
"""

from __future__ import annotations

import math
import struct
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.series import ELEMENTS, Series
from usvlearn.logs.formats.ros.limits import NOTHING

PATHS = 256  # of one topic, at most
DEEPEST = 10  # messages within each other
CLOCK_LIMIT = 1.0  # s; a header's stamp further from the receipt comes from a clock that was never set
CLOCKS = ("header", "receive")  # where a message's time is taken from
_ODOMETRY = {"surge": "twist.twist.linear.x", "yaw_rate": "twist.twist.angular.z", "heading": "pose.pose.orientation"}
_TWIST = {"surge": "twist.linear.x", "yaw_rate": "twist.angular.z"}
FIELDS: dict[str, dict[str, str]] = {  # type of message -> channel -> its field, where none is named
    "nav_msgs/msg/Odometry": _ODOMETRY,
    "geometry_msgs/msg/TwistWithCovarianceStamped": {name: _ODOMETRY[name] for name in _TWIST},
    "geometry_msgs/msg/TwistStamped": _TWIST,
    "geometry_msgs/msg/Twist": {name: field.removeprefix("twist.") for name, field in _TWIST.items()},
    "geometry_msgs/msg/PoseStamped": {"heading": "pose.orientation"},
    "geometry_msgs/msg/PoseWithCovarianceStamped": {"heading": _ODOMETRY["heading"]},
    "sensor_msgs/msg/Imu": {"heading": "orientation", "yaw_rate": "angular_velocity.z"},
}
CLOCK = "rosgraph_msgs/msg/Clock"
LIMIT = CLOCK_LIMIT * 1e9  # ns
RATES = 0.01, 100.0  # of a simulation; a stamp beyond them is a counter, or stands still
SAME = 0.02  # a rate so near 1, without /clock, is that of a clock that was never set
FEWEST, FORWARD = 10, 0.95  # stamps of a clock, and the share of them that are not before the last one
FAR = 1e6  # s before the first and after the last stamp, in which a clock goes on at its mean rate


def default_field(kind: str, part: str) -> str:
    """The field of a channel in a type of message, where the configuration names none; `data` of a type not known.

    Instead of a channel, it may be of one of several sources of a command, such as `command_left[0]`.
    """
    return FIELDS.get(kind, {}).get(part.partition("[")[0], "data")


def stamp_of(message: Any, received: int, clock: str = "header", limit: float = CLOCK_LIMIT) -> int:
    """The time of a message, ns: the stamp of its header, or its receipt.

    With the clock `header`, a message without a stamp has the time of its receipt, and so has one whose stamp is 0, or
    further than `limit`, s, from it.
    """
    stamp: Any = getattr(getattr(message, "header", None), "stamp", None)
    if clock == "receive" or not hasattr(stamp, "nanosec"):
        return received
    time = stamp.sec * 10**9 + stamp.nanosec
    return time if time and abs(time - received) <= limit * 1e9 else received


def read_field(message, field: str, where: str) -> float:
    """The number at a dotted path, or the norm of several."""
    if "," not in field:
        return _read_one(message, field.strip(), where)
    return math.hypot(*(_read_one(message, part.strip(), where) for part in field.split(",")))


def _read_one(message, field: str, where: str) -> float:
    value: Any = message
    for step in field.split("."):
        if step.isdigit() and hasattr(value, "__len__") and int(step) < len(value):
            value = value[int(step)]
        elif step in _fields(value):
            value = getattr(value, step)
        else:
            raise LogFormatError(f"{where}: no field {step!r} in {field!r}. {_listing(value)}")
    if all(hasattr(value, axis) for axis in "xyzw"):
        return yaw(value.x, value.y, value.z, value.w)
    try:  # rclpy has bytes of a field of type `byte`; rosbags reads it with a sign, as ROS 1 does
        return float(int.from_bytes(value, signed=True) if isinstance(value, bytes) and len(value) == 1 else value)
    except (TypeError, ValueError):
        raise LogFormatError(f"{where}: expected a number in {field!r}. {_listing(value)}") from None


def _listing(value) -> str:
    names = _fields(value)
    if not names and not is_dataclass(value):
        return f"It holds {type(value).__name__} {str(value)[:40]!r}: name a field that is a number"
    shown = ", ".join(name for name in names if not name.startswith("__"))
    return f"The fields here are: {shown or 'none'}; name one of them"


def _fields(value: Any) -> tuple[str, ...]:
    """The names of a message's fields; none of what is no message."""
    return _fields_of(value.__class__)


@lru_cache(maxsize=256)
def _fields_of(kind: type) -> tuple[str, ...]:
    if is_dataclass(kind):
        return tuple(item.name for item in fields(kind))
    listed = getattr(kind, "get_fields_and_field_types", None)  # of rclpy
    return () if listed is None else tuple(listed())


def yaw(x: float, y: float, z: float, w: float) -> float:
    """Yaw of a quaternion of any length, rad, counter-clockwise about z; NaN for the zero quaternion."""
    if not (x or y or z or w):
        return math.nan
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def numbers(message: Any, prefix: str = "", depth: int = 0) -> Iterator[tuple[str, float]]:
    """The dotted path and the value of each number in a message; a quaternion gives its yaw, too.

    Headers, stamps, text, and arrays of more than `ELEMENTS` elements are left out.
    """
    inner: list[tuple[Any, Any]] = []
    if hasattr(message, "__dataclass_fields__"):
        if prefix and all(hasattr(message, axis) for axis in "xyzw"):
            yield prefix, yaw(message.x, message.y, message.z, message.w)
        inner = [(name, getattr(message, name)) for name in _names(message.__class__)]
    elif isinstance(message, np.ndarray | list):
        inner = list(enumerate(message)) if len(message) <= ELEMENTS else []
    for name, value in inner:
        path = f"{prefix}.{name}" if prefix else str(name)
        if isinstance(value, float | int | np.number | np.bool_):
            yield path, float(value)
        elif depth < DEEPEST:
            yield from numbers(value, path, depth + 1)


@lru_cache(maxsize=256)
def _names(kind: type) -> tuple[str, ...]:
    """The fields of a type of message that may hold numbers; none of a stamp."""
    names = tuple(item.name for item in fields(kind) if not str(item.type).startswith("ClassVar"))  # a constant
    return () if names == ("sec", "nanosec") else tuple(name for name in names if name not in ("header", NOTHING))


class Collected:
    """The numbers of all messages of one topic, of one type."""

    def __init__(self, topic: str, kind: str):
        self._topic, self._kind, self._order = topic, kind, array("q")
        self.values: dict[str, array] = {}  # path -> one value a message, as far as one was found

    def add(self, order: int, message: Any) -> None:
        """Take a message, and its number in the bag."""
        count = len(self._order)
        for path, value in numbers(message):
            values = self.values.get(path)
            if values is None:
                if len(self.values) == PATHS:
                    continue
                values = self.values[path] = array("d")
            values.extend([math.nan] * (count - len(values)))
            values.append(value)
        self._order.append(order)

    def series(self, time: np.ndarray) -> Iterator[Series]:
        """One of each path; `time` of all messages, s."""
        order = np.array(self._order, np.int64)
        for path, values in self.values.items():
            value = np.full(len(time), np.nan)
            value[: len(values)] = values
            unit = "enu_rad" if f"{path}.w" in self.values else ""  # REP 103: from east, counter-clockwise
            yield Series(self._topic, path, time, value, order, unit, self._kind)


def has_stamp(bag: Any, msgtype: str) -> bool:
    """Whether messages of a type begin with a header, or are of /clock."""
    fields = bag.typestore.fielddefs.get(msgtype, ("", ()))[1]
    return msgtype == CLOCK or any(name == "header" for name, _ in fields[:1])


class Heard:
    """When the messages of a topic of a bag were received and stamped."""

    def __init__(self, bag: Any, topic: str, msgtype: str):
        self.topic, self.is_clock, self._is2 = topic, msgtype == CLOCK, bag.is2
        place = 0 if self.is_clock and not bag.is2 else 4  # after the encoding, or the number, of a header
        self._place = place if has_stamp(bag, msgtype) else None
        self.order, self._received, self._stamps = array("q"), array("q"), array("q")

    def add(self, order: int, received: int, data: bytes) -> None:
        """Take a message: its number in the bag, the time of its receipt in ns, and its bytes."""
        stamp = 0  # none
        if self._place is not None and len(data) >= self._place + 8:
            seconds, rest = struct.unpack_from("<II" if data[1] & 1 or not self._is2 else ">II", data, self._place)
            stamp = seconds * 10**9 + rest
        self.order.append(order)
        self._received.append(received)
        self._stamps.append(stamp)

    def times(self) -> tuple[np.ndarray, np.ndarray]:
        """Receipts and stamps of all messages, ns; 0 for no stamp."""
        return np.array(self._received, np.int64), np.array(self._stamps, np.int64)

    def seconds(self, start: int, clock: Clock | None, receive: bool) -> np.ndarray:
        """The times of all messages, s since the start of the bag in ns, by the rules of `Rosbag.clock`."""
        received, stamps = self.times()
        if clock is None:
            by_header = (stamps > 0) & (np.abs(stamps - received) <= LIMIT) & (not receive)
            return (np.where(by_header, stamps, received) - start) * 1e-9
        stamped, mapped = (stamps - clock.zero) * 1e-9, clock.at(received)
        return np.where((stamps > 0) & (np.abs(stamped - mapped) <= clock.limit), stamped, mapped) - clock.at(start)


class Clock:
    """The clock of a topic's stamps, as a function of the time of receipt."""

    def __init__(self, heard: Heard, received: np.ndarray, stamps: np.ndarray):
        self.heard, self.count, self.zero, self._start = heard, len(stamps), stamps[0], received[0]
        apart = max(1, self.count // 10)
        steps, spans = stamps[apart:] - stamps[:-apart], received[apart:] - received[:-apart]
        self.rate = float(np.median(steps / np.maximum(spans, 1))) if self.count >= FEWEST else 0.0
        self.limit = CLOCK_LIMIT * max(1.0, self.rate)  # s that a stamp may be from the clock
        self.goes = RATES[0] < self.rate < RATES[1] and (np.diff(stamps) >= 0).mean() >= FORWARD
        if not heard.is_clock:  # whole seconds may be a counter
            self.goes = self.goes and abs(self.rate - 1) > SAME and (stamps % 10**9).any()
        x, y = (received - self._start) * 1e-9, (stamps - self.zero) * 1e-9
        self._receipts = np.concatenate([[x[0] - FAR], x, [x[-1] + FAR]])
        self._stamps = np.concatenate([[y[0] - FAR * self.rate], y, [y[-1] + FAR * self.rate]])

    def at(self, received: Any) -> np.ndarray:
        """Its time at receipts in ns, s since `zero`."""
        return np.interp((received - self._start) * 1e-9, self._receipts, self._stamps)


def find_clock(heard: Iterable[Heard]) -> tuple[Clock | None, str]:
    """The simulated clock of a bag, or None, and a sentence about stamps of another rate, or "".

    /clock tells that the time is simulated, or most topics with a stamp do.
    """
    times = [(each, *each.times()) for each in heard]
    known = [(each, received[stamps > 0], stamps[stamps > 0]) for each, received, stamps in times if stamps.any()]
    far = [each for each in known if np.median(np.abs(each[2] - each[1])) > LIMIT]
    votes = {}
    for clock in (Clock(*each) for each in far):
        off = [np.median(np.abs((stamps - clock.zero) * 1e-9 - clock.at(received))) for _, received, stamps in far]
        votes[clock] = clock.heard.is_clock, sum(each <= clock.limit for each in off), clock.count
    best = max((clock for clock in votes if clock.goes), key=lambda clock: votes[clock], default=None)
    if best is None:
        return None, ""
    sentence = f"the stamps of {best.heard.topic} advance by {best.rate:.3g} s in each second of receipt"
    if not best.heard.is_clock and votes[best][1] <= len(known) - len(far):
        return None, f"{sentence}, but those of most topics by 1 s: its messages have the time of receipt"
    sentence += ", as simulated time does: all times and rates are in simulated time. If this is no simulation, set "
    return best, f"{sentence}data.reader.clock=receive"
