"""From ROS 2 to a session: which topics hold its parts, and the number and the stamp of each message.

rclpy is not imported.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.channel import Source, matching
from usvlearn.logs.formats.ros.message_fields import CLOCK_LIMIT, default_field, read_field, stamp_of

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

    Args:
        sources: part -> where it is found.
        names: of all topics.
        kinds: the types that are published on a topic.
        resolve: the full name of a topic.
        namespace: of the node.
        current: topic -> type that is subscribed to; it stays while somebody publishes it, or nobody publishes.

    >>> sources = {"surge": Source("*/odom"), "heading": Source("*/odom"), "command_left": Source("thrust")}
    >>> graph = {"/boat/odom": ["nav_msgs/msg/Odometry"]}
    >>> found = choose_topics(sources, graph, lambda topic: graph.get(topic, []), lambda name: "/" + name)
    >>> found.topics, found.fields["/boat/odom"]["heading"]
    ({'/boat/odom': 'nav_msgs/msg/Odometry'}, 'pose.pose.orientation')
    >>> found.problems
    {'command_left': 'nobody publishes /thrust yet'}
    """
    below, current = namespace.rstrip("/") + "/", current or {}
    names = sorted(name for name in names if name.startswith(below))
    found = Subscriptions({}, {}, {})
    for part, source in sources.items():
        chosen = matching(source.name, names) if set("*?[") & set(source.name) else [resolve(source.name)]
        kept = [topic for topic in chosen if topic in current]
        if len(chosen) > 1:
            found.problems[part] = f"{_listing(chosen)} match {source.name}: set channels.{part}.name to one of them"
        elif not chosen:
            found.problems[part] = f"no topic below {below} matches {source.name} yet"
        if len(chosen) != 1 and len(kept) != 1:
            continue
        topic = (kept or chosen)[0]
        kind, problem = _kind(topic, sorted(set(kinds(topic))), current.get(topic))
        if problem:
            found.problems[part] = problem
        if kind is not None:
            found.topics[topic] = kind
            found.fields.setdefault(topic, {})[part] = source.field or default_field(kind, part)
    return found


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


class Receiver(Protocol):
    """What a session does with messages; see `usvlearn.live.session`."""

    def push(self, part: str, stamp: float, raw: float) -> list[Any]: ...

    def drop(self, part: str, cause: str) -> None: ...

    def restart(self) -> list[Any]: ...


class Messages:
    """Gives the numbers of messages to a session, with their times.

    The time of a message is the stamp of its header, else the node's clock at its receipt; see `stamp_of`. If the
    node's clock steps back, the session begins a new segment.

    Args:
        session: a `usvlearn.live.session.Session`.
        clock: "header" or "receive": where the times are taken from.
        simulated: whether the node's clock is the simulated one (`use_sim_time`).

    Attributes:
        problems: topic -> part -> what was wrong with the latest message, in one sentence.
        off: topic -> s by which the latest stamp was too far from the node's clock to be used.
    """

    def __init__(self, session: Receiver, clock: str = "header", simulated: bool = False):
        self.problems: dict[str, dict[str, str]] = {}
        self.off: dict[str, float] = {}
        self._session, self._clock, self._simulated = session, clock, simulated
        self._limit = SIMULATED_LIMIT if simulated else CLOCK_LIMIT
        self._step_back = 0 if simulated else int(CLOCK_LIMIT * NS)  # ns that the clock may step back
        self._now = 0  # ns

    def take(self, topic: str, fields: Mapping[str, str], message: Any, now: int) -> list[Any]:
        """Push the parts of a message; returns the steps that it completes.

        Args:
            topic: its name.
            fields: part -> field.
            message: of any type.
            now: the node's clock, ns; 0 while a simulated clock has not been received.
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
        found = [each for parts in self.problems.values() for each in parts.values()]
        hint = "set the clock of its computer" if self._simulated else "set that clock, or use_sim_time"
        for topic, seconds in self.off.items():
            found.append(
                f"the stamps of {topic} are {abs(seconds):.3g} s {'ahead of' if seconds > 0 else 'behind'} the node's "
                f"clock: the time of receipt is used; {hint}"
            )
        if self._simulated and self._now == 0:
            found.append("use_sim_time is set, and nobody publishes /clock: no message has a time")
        return found
