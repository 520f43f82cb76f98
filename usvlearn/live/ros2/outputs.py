"""From a session to ROS 2: the messages of steps and of health. Their classes are given, so rclpy is not imported."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from usvlearn.core.forecasts import Track
from usvlearn.errors import ConfigError
from usvlearn.live.ros2.inputs import NS

NORMAL90 = 1.6448536269514722  # half-width of a 90 % interval over the standard deviation
ENU = "_enu"  # behind the name of the boat's frame: the frame of tracks, which does not turn with the boat
UNKNOWN = 1e6  # (m/s)^2, (rad/s)^2, m^2 or rad^2: the variance of what is not known, which a filter then ignores
DIAGONAL = range(0, 36, 7)  # of a 6 x 6 covariance
NAME = "usvlearn"
WARN = b"\x01"
LEVELS = {"ok": b"\x00", "compiling": WARN, "waiting": WARN, "sparse": WARN, "stale": b"\x02"}  # the last is ERROR
CLASSES = {  # type -> package
    "Time": "builtin_interfaces",
    "TwistWithCovarianceStamped": "geometry_msgs",
    "Float64MultiArray": "std_msgs",
    "MultiArrayDimension": "std_msgs",
    "String": "std_msgs",
    "DiagnosticArray": "diagnostic_msgs",
    "DiagnosticStatus": "diagnostic_msgs",
    "KeyValue": "diagnostic_msgs",
}
TRACK_CLASSES = {  # likewise, of a node that makes tracks
    "Path": "nav_msgs",
    "PoseStamped": "geometry_msgs",
    "PoseWithCovarianceStamped": "geometry_msgs",
}


def message_class(kind: str) -> type:
    """The class of a type of message, such as `nav_msgs/msg/Odometry`.

    Raises:
        ConfigError: it is not installed.
    """
    package, _, name = kind.partition("/msg/")
    try:
        if not (package.isidentifier() and name.isidentifier()):
            raise ImportError
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise ConfigError(
            f"found messages of type {kind}, which is not installed here: source the workspace that has {package}"
        ) from None


class Outputs:
    """Makes messages.

    Args:
        types: name -> class, those of `CLASSES`; for tracks those of `TRACK_CLASSES`, too.
        frame: of the boat, as in the `child_frame_id` of its odometry.
    """

    def __init__(self, types: Mapping[str, Any], frame: str = "base_link"):
        self._types, self._frame = types, frame

    def time(self, stamp: float) -> Any:
        """A stamp in s as a Time."""
        stamp = min(max(stamp, -(2.0**31)), 2.0**31 - 1) if math.isfinite(stamp) else 0.0
        whole = math.floor(stamp)
        return self._types["Time"](sec=whole, nanosec=min(round((stamp - whole) * NS), NS - 1))

    def speed(self, stamp: float, surge: float, low: float, high: float) -> Any:
        """A surge with its 90 % interval, m/s, as a TwistWithCovarianceStamped.

        The standard deviation is that of a normal distribution with such an interval. All that is not predicted, and a
        surge whose interval is not known yet, has the variance `UNKNOWN`.
        """
        message = self._types["TwistWithCovarianceStamped"]()
        message.header.stamp, message.header.frame_id = self.time(stamp), self._frame
        message.twist.twist.linear.x = float(surge)
        for place in DIAGONAL:
            message.twist.covariance[place] = UNKNOWN
        width = (high - low) / 2
        if math.isfinite(width):
            message.twist.covariance[0] = min((width / NORMAL90) ** 2, UNKNOWN)
        return message

    def table(self, rows: Sequence[Sequence[float]], first: str, second: str) -> Any:
        """Rows of numbers as a Float64MultiArray; the labels of its dimensions name rows and columns."""
        message = self._types["Float64MultiArray"]()
        columns = len(rows[0]) if rows else 0
        for label, size, stride in ((first, len(rows), len(rows) * columns), (second, columns, columns)):
            message.layout.dim.append(self._types["MultiArrayDimension"](label=label, size=size, stride=stride))
        message.data = [float(each) for row in rows for each in row]
        return message

    def forecast(self, forecasts: Mapping[float, Sequence[float]], if_held: Mapping[float, Sequence[float]]) -> Any:
        """The surge at each horizon: rows of horizon (s), surge, low, high (m/s), and the ends if commands stay."""
        rows = [(horizon, *found, *if_held[horizon][1:]) for horizon, found in sorted(forecasts.items())]
        return self.table(rows, "horizon", "horizon_s,surge,low,high,low_if_held,high_if_held")

    def path(self, stamp: float, track: Track) -> Any:
        """Where the boat will be at the end of each step, as a Path; its frame is that of `place`."""
        message = self._types["Path"]()
        message.header.stamp, message.header.frame_id = self.time(stamp), self._frame + ENU
        message.poses = [self._types["PoseStamped"]() for _ in track.time]
        for k, each in enumerate(message.poses):
            self._put(each, each.pose, stamp, track, k)
        return message

    def place(self, stamp: float, track: Track, k: int) -> Any:
        """Where the boat will be after a step, numbered from 0, as a PoseWithCovarianceStamped.

        Its origin is where the boat is at `stamp`, s, x points east, y north, and the yaw counts from east, counter-
        clockwise. What is not known has the variance `UNKNOWN`.
        """
        message = self._types["PoseWithCovarianceStamped"]()
        self._put(message, message.pose.pose, stamp, track, k)
        (north, both), (_, east) = track.covariance[k].tolist()
        known = math.isfinite(north) and math.isfinite(east)
        for place in DIAGONAL:
            message.pose.covariance[place] = UNKNOWN
        if known:
            for place, value in ((0, east), (1, both), (6, both), (7, north)):
                message.pose.covariance[place] = value
        return message

    def _put(self, message: Any, pose: Any, stamp: float, track: Track, k: int) -> None:
        """Fill header, position and orientation."""
        message.header.stamp = self.time(stamp + float(track.time[k]))
        message.header.frame_id = self._frame + ENU
        pose.position.x, pose.position.y = float(track.east[k]), float(track.north[k])
        yaw = math.pi / 2 - float(track.heading[k])
        pose.orientation.z, pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)

    def members(self, members: Mapping[str, float]) -> Any:
        """The prediction of each member, m/s; the label of the second dimension names them."""
        return self.table([list(members.values())] if members else [], "step", ",".join(members))

    def text(self, text: str) -> Any:
        return self._types["String"](data=text)

    def diagnostics(self, stamp: float, name: str, health: Any, problems: Mapping[str, str], notes: Sequence[str]):
        """The health as a DiagnosticArray: one status of the model, and one of the inputs.

        Args:
            stamp: the node's clock, s.
            name: of the node.
            health: a `usvlearn.live.node.Health`.
            problems: part -> why it is not received.
            notes: what else an operator should know.
        """
        level = LEVELS.get(health.state, LEVELS["stale"])
        said = f"{health.loss}; {health.sentence}" if health.loss else health.sentence
        model = self._status(f"{name}: model", max(level, WARN) if health.loss else level, said, _model(health))
        inputs = [*(f"{part}: {each}" for part, each in problems.items()), *notes]
        level = max(level, WARN) if inputs or health.warnings else level
        said = "; ".join([*inputs, *health.warnings]) or f"inputs {health.state}"
        message = self._types["DiagnosticArray"]()
        message.header.stamp = self.time(stamp)
        message.status = [model, self._status(f"{name}: inputs", level, said, _inputs(health))]
        return message

    def _status(self, name: str, level: bytes, message: str, values: Iterable[tuple[str, Any]]) -> Any:
        pairs = [self._types["KeyValue"](key=key, value=_shown(value)) for key, value in values]
        return self._types["DiagnosticStatus"](level=level, name=name, message=message, hardware_id=NAME, values=pairs)

    def parameters(self, stamp: float, health: Any) -> Any:
        """What has been identified, with intervals, and the contraction of the networks, as JSON; null if not known."""
        content = {
            "stamp": stamp,
            "identified": {
                name: {"value": value, "low": low, "high": high, "unit": unit}
                for name, (value, low, high, unit) in health.identified.items()
            },
            "contraction": health.contraction,
        }
        return self.text(json.dumps(_finite(content), allow_nan=False))


def _model(health: Any) -> Iterable[tuple[str, Any]]:
    yield from (("state", health.state), ("steps", health.steps), ("learned", health.learned))
    yield from (("alarms", health.alarms), ("uptime s", health.uptime), ("saved s ago", health.saved))
    for network, found in health.contraction.items():
        yield from ((f"{network} {key.replace('_', ' ')}", value) for key, value in found.items())
    for name, (value, low, high, unit) in health.identified.items():
        known = math.isfinite(value)
        yield name, f"{value:.4g} {unit}, 90 % interval {low:.4g} to {high:.4g}" if known else "not known yet"
    yield from (("note", each) for each in health.notes)


def _inputs(health: Any) -> Iterable[tuple[str, Any]]:
    yield from ((f"{part} age s", age) for part, age in health.ages.items())
    for channel, causes in health.counts.items():
        yield from ((f"{channel} {cause}", count) for cause, count in causes.items())


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return "never" if value == math.inf else f"{value:.6g}"
    return "unknown" if value is None else str(value)


def _finite(value: Any) -> Any:
    """JSON values without NaN and infinity."""
    if isinstance(value, Mapping):
        return {str(key): _finite(each) for key, each in value.items()}
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
