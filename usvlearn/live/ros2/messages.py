"""Between ROS 2 and a session: topics that hold its parts, the numbers and stamps of their messages, and what is
published. rclpy is not imported: the classes of messages are given.
"""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from usvlearn.core.forecasts import Track
from usvlearn.display.json_values import finite
from usvlearn.errors import ConfigError, LogFormatError
from usvlearn.live.plan_requests import Point
from usvlearn.logs.channels.channel import Source, matching
from usvlearn.logs.formats.ros.message_fields import CLOCK_LIMIT, default_field, read_field, stamp_of

if TYPE_CHECKING:
    from usvlearn.live.session import Session

NS = 1_000_000_000
SIMULATED_LIMIT = 60.0  # s between a stamp and a simulated clock, which may be published seldom, or have been reset
LISTED = 5  # topics in a sentence

# What is read where neither a checkpoint nor a parameter says otherwise. Units are those of REP 103.
DEFAULTS: dict[str, dict[str, Any]] = {
    "command_left": {"name": "*thrusters/left/thrust"},
    "command_right": {"name": "*thrusters/right/thrust"},
    "heading": {"name": "*odometry/filtered", "unit": "enu_rad"},
    "yaw_rate": {"name": "*odometry/filtered", "unit": "enu_rad/s"},
    "surge": {"name": "*odometry/filtered", "unit": "m/s"},
}
AUXILIARY: dict[str, dict[str, Any]] = {  # likewise, of a node that makes tracks
    "north": {"name": "*odometry/filtered", "field": "pose.pose.position.y", "unit": "m"},
    "east": {"name": "*odometry/filtered", "field": "pose.pose.position.x", "unit": "m"},
}


class Subscriptions(NamedTuple):
    """What is subscribed to."""

    topics: dict[str, str]  # topic -> type of its messages
    fields: dict[str, dict[str, str]]  # topic -> part -> field of the message
    problems: dict[str, str]  # part -> why it is not received, in one sentence


def choose_topics(
    sources: Mapping[str, Source],
    names: Iterable[str],
    kinds: Callable[[str], Sequence[str]],
    resolve: Callable[[str], str],
    namespace: str = "/",
    current: Mapping[str, str] | None = None,
) -> Subscriptions:
    """Choose a topic for each part.

    A name without `*` is resolved as ROS resolves it: with the node's namespace and the remappings. A name with `*`
    chooses the only topic below the namespace that it matches.
    A `current` topic stays with its type while somebody publishes it, or nobody publishes.
    """
    below, current = namespace.rstrip("/") + "/", current or {}
    names = sorted(name for name in names if name.startswith(below))
    taken = Subscriptions({}, {}, {})
    for part, source in sources.items():
        chosen = matching(source.name, names) if set("*?[") & set(source.name) else [resolve(source.name)]
        subscribed = [topic for topic in chosen if topic in current]
        if len(chosen) > 1:
            taken.problems[part] = f"{_listing(chosen)} match {source.name}: set channels.{part}.name to one of them"
        elif not chosen:
            taken.problems[part] = f"no topic below {below} matches {source.name} yet"
        if len(chosen) != 1 and len(subscribed) != 1:
            continue
        topic = (subscribed or chosen)[0]
        kind, problem = _kind(topic, sorted(set(kinds(topic))), current.get(topic))
        if problem:
            taken.problems[part] = problem
        if kind is not None:
            taken.topics[topic] = kind
            taken.fields.setdefault(topic, {})[part] = source.field or default_field(kind, part)
    return taken


def _kind(topic: str, published: Sequence[str], current: str | None) -> tuple[str | None, str | None]:
    """The type of a topic that is subscribed to, None if there is none; and what is wrong with the topic."""
    if not published:
        return current, f"nobody publishes {topic} any more" if current else f"nobody publishes {topic} yet"
    if len(published) == 1:
        return published[0], None
    if current in published:
        others = " and as ".join(each for each in published if each != current)
        return current, f"{topic} is published as {others}, too: only {current} is read"
    return None, f"{topic} is published as {' and as '.join(published)}: let it have one type"


def _listing(topics: Sequence[str]) -> str:
    return ", ".join(topics[:LISTED]) + (f" and {len(topics) - LISTED} more" if len(topics) > LISTED else "")


class Messages:
    """Gives the numbers of messages to a session, with their times.

    The time of a message is the stamp of its header, else the node's clock at its receipt; see `stamp_of`. If the
    node's clock steps back, the session begins a new segment. `clock` is "header" or "receive": where times come from.
    """

    def __init__(self, session: Session, clock: str = "header", simulated: bool = False):
        self.problems: dict[str, dict[str, str]] = {}  # topic -> part -> what was wrong with the latest message
        self.off: dict[str, float] = {}  # topic -> s by which the latest stamp was too far from the node's clock
        self._session, self._clock, self._simulated = session, clock, simulated
        self._limit = SIMULATED_LIMIT if simulated else CLOCK_LIMIT
        self._step_back = 0 if simulated else int(CLOCK_LIMIT * NS)  # ns that the clock may step back
        self._now = 0  # ns

    def take(self, topic: str, fields: Mapping[str, str], message: Any, now: int) -> list[Any]:
        """Push the parts of a message, by field; returns the steps that it completes.

        `now` is the node's clock, ns; 0 while a simulated clock has not been received.
        """
        steps, wrong = self.notice(now), {}
        if now == 0:
            for part in fields:
                self._session.drop(part, "no_time")
            return steps
        stamp = stamp_of(message, now, self._clock, self._limit)
        stamped = stamp_of(message, now, self._clock, math.inf)
        if stamp == stamped:
            self.off.pop(topic, None)
        else:
            self.off[topic] = (stamped - now) / NS
        for part, field in fields.items():
            try:
                raw = read_field(message, field, part)
            except LogFormatError as error:
                wrong[part] = str(error)
                self._session.drop(part, "wrong_type")
                continue
            steps += self._session.push(part, stamp / NS, raw)
        if wrong or topic in self.problems:
            self.problems[topic] = wrong
        return steps

    def notice(self, now: int) -> list[Any]:
        """Take the node's clock, ns: if it has stepped back, a new segment begins. Returns the last steps before it."""
        back = now < self._now - self._step_back
        if back or now > self._now:
            self._now = now
        return self._session.restart() if back else []

    def sentences(self) -> list[str]:
        """What an operator should know of the messages."""
        lines = [each for parts in self.problems.values() for each in parts.values()]
        hint = "set the clock of its computer" if self._simulated else "set that clock, or use_sim_time"
        for topic, seconds in self.off.items():
            lines.append(
                f"the stamps of {topic} are {abs(seconds):.3g} s {'ahead of' if seconds > 0 else 'behind'} the node's "
                f"clock: the time of receipt is used; {hint}"
            )
        if self._simulated and self._now == 0:
            lines.append("use_sim_time is set, and nobody publishes /clock: no message has a time")
        return lines


NORMAL90 = 1.6448536269514722  # half-width of a 90 % interval over the standard deviation
ELLIPSE90 = 2 * math.log(10)  # square of a semi-axis of the ellipse that holds 90 %, over the variance
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
    """The class of a type of message, such as `nav_msgs/msg/Odometry`."""
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
    """Makes messages."""

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
        rows = [(horizon, *values, *if_held[horizon][1:]) for horizon, values in sorted(forecasts.items())]
        return self.table(rows, "horizon", "horizon_s,surge,low,high,low_if_held,high_if_held")

    def path(self, stamp: float, track: Track) -> Any:
        """Where the boat will be at the end of each step, as a Path; its frame is that of `place`."""
        message = self._types["Path"]()
        message.header.stamp, message.header.frame_id = self.time(stamp), self._frame + ENU
        message.poses = [self._types["PoseStamped"]() for _ in track.time]
        for k, each in enumerate(message.poses):
            self._put(each, each.pose, stamp, track, k)
        return message

    def place(self, stamp: float, track: Track, k: int, point: Point) -> Any:
        """Where the boat will be after step k, from 0, with the ellipse of a point, as a PoseWithCovarianceStamped.

        Its origin is where the boat is at `stamp`, s, x points east, y north, and the yaw counts from east, counter-
        clockwise. What is not known has the variance `UNKNOWN`.
        """
        message = self._types["PoseWithCovarianceStamped"]()
        self._put(message, message.pose.pose, stamp, track, k)
        for place in DIAGONAL:
            message.pose.covariance[place] = UNKNOWN
        if math.isfinite(point.major):
            major, minor = point.major**2 / ELLIPSE90, point.minor**2 / ELLIPSE90
            cosine, sine = math.cos(math.radians(point.bearing)), math.sin(math.radians(point.bearing))
            both = (major - minor) * sine * cosine
            east, north = major * sine**2 + minor * cosine**2, major * cosine**2 + minor * sine**2
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
        """The health as a DiagnosticArray: one status of the model, and one of the inputs."""
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
        return self.text(json.dumps(finite(content), allow_nan=False))


def _model(health: Any) -> Iterable[tuple[str, Any]]:
    yield from (("state", health.state), ("steps", health.steps), ("learned", health.learned))
    yield from (("alarms", health.alarms), ("uptime s", health.uptime), ("saved s ago", health.saved))
    for network, verdict in health.contraction.items():
        yield from ((f"{network} {key.replace('_', ' ')}", value) for key, value in verdict.items())
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
