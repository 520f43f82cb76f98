"""The message types that a bag defines; types that turn a few bytes into gigabytes of objects are refused."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.channel import QUOTED

FIELDS = 10_000  # of one message; an array of numbers counts as one
DEEPEST = 20  # types within types
NOTHING = "structure_needs_at_least_one_member"  # as rosbags calls the field of a type without fields


def check_type(path: Path, msgtype: str, definitions: Mapping[str, Any]) -> None:
    """Raise a LogFormatError if a type is not defined, or its messages can have many more fields than bytes.

    The definitions are the `fielddefs` of a `rosbags.typesys.store.Typestore`.
    """
    from rosbags.interfaces import Nodetype

    known: dict[str, tuple[int, int]] = {}

    def refused(what: str) -> LogFormatError:
        return LogFormatError(
            f"{path}: found the message type {msgtype[:QUOTED]!r} with {what}, expected one that holds some numbers: "
            "name another topic in data.channels"
        )

    def measure(description: Any, depth: int) -> tuple[int, int]:
        """The least bytes and the most fields of a type."""
        kind, inner = description
        if kind == Nodetype.BASE:
            return 1, 1
        if kind == Nodetype.NAME:
            if depth > DEEPEST:
                raise refused(f"more than {DEEPEST} types within each other")
            if inner not in definitions:
                package = inner.partition("/")[0][:QUOTED]
                way = "or export the topic to a CSV file"
                if "/" not in inner:
                    raise LogFormatError(f"{path}: {inner[:QUOTED]!r} is no type of ROS: name another topic, {way}")
                raise LogFormatError(
                    f"{path}: the definition of {inner[:QUOTED]} is missing: where {package} is installed, convert the "
                    f"bag to MCAP, which stores definitions (`ros2 bag convert`), {way} (`ros2 topic echo --csv`)"
                )
            if inner not in known:
                fields = [measure(each, depth + 1) for name, each in definitions[inner][1] if name != NOTHING]
                known[inner] = sum(size for size, _ in fields), 1 + sum(count for _, count in fields)
            return known[inner]
        element, length = inner
        size, count = measure(element, depth)
        if kind == Nodetype.SEQUENCE:
            if size == 0:
                raise refused("a list of what has no fields")
            return 4, 1
        numbers = element[0] == Nodetype.BASE and element[1][0] != "string"
        if (total := 1 if numbers else length * count) > FIELDS:
            raise refused(f"an array of {total} fields")
        return length * size, total

    if measure((Nodetype.NAME, msgtype), 0)[1] > FIELDS:
        raise refused(f"{known[msgtype][1]} fields")
