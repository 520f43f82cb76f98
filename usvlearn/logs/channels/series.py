"""The interface of all readers of logs, the series of numbers that they read, and jumps of a log's clock."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from itertools import pairwise
from pathlib import Path
from typing import ClassVar, NamedTuple, Protocol, TypeVar

import numpy as np

from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.channel import Channel, Source


class Series(NamedTuple):
    """All values of one name and field of a log, as they stand there.

    A reader's `survey(path)` gives them in the order of the log. Text is left out, as are arrays of more than
    `ELEMENTS` numbers.
    """

    name: str  # column, variable, topic or message: a `Source.name` that finds it
    field: str | None  # a `Source.field` that finds it; None where the reader has no fields
    time: np.ndarray  # (n,) float64, s since the log's start, as in a `Channel`
    value: np.ndarray  # (n,) float64 as logged, NaN where there was no number
    order: np.ndarray  # (n,) int64, place in the log
    unit: str = ""  # as the log declares it, such as "deg" or "km/h" of a header "Speed (km/h)"; "" where it does not
    kind: str = ""  # type of the message or the posting app, where there is one
    start: float = math.nan  # as of a `Channel`


ELEMENTS = 16  # of an array, at most
JUMP, AHEAD = 5.0, 1e6  # s, that a clock is set back, or ahead, at least
AROUND = 5  # stamps at each side of a jump
MOST = 50  # jumps, beyond which the rows are in no order of time

T = TypeVar("T", Channel, Series)


class OtherBoats(LogFormatError):
    """No row of a log is of the boat that is read."""


class Reader(Protocol):
    """A reader of one log: `Alog`, `DataFlash`, `Rosbag`, `Table`, `Tlog`, `Ulog`.

    A reader may have a `marker`, the name of a file and what it contains: a folder with such a file is one log. Or it
    may have a method `is_log(folder, files, names)`, which tells this from a folder's files and the names of channels.

    >>> from tempfile import TemporaryDirectory
    >>> from usvlearn.logs.formats.moos.alog import Alog
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "a.alog"
    ...     _ = path.write_text("0.5 NAV_SPEED iGPS 1.2\\n0.9 NAV_SPEED iGPS off\\n")
    ...     channels, dropped = Alog().read(path, {"surge": Source("NAV_SPEED")})
    ...     survey = [(each.name, each.value.tolist()) for each in Alog().survey(path)]
    >>> channels["surge"].value, dropped, survey
    (array([1.2]), {'surge': {'not_a_number': 1}}, [('NAV_SPEED', [1.2, nan])])
    """

    suffixes: ClassVar[tuple[str, ...]]

    def read(self, path: Path, sources: dict[str, Source]) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
        """The channels of a log.

        Args:
            path: the log, a file or a folder that is one.
            sources: channel -> where it is found.

        Returns:
            The channels, in SI units; and the counts of unusable values: channel -> cause -> count.

        Raises:
            LogFormatError: the file is no log of this format, or lacks a channel.
            MissingExtraError: the package that reads it is not installed.
        """
        ...

    def survey(self, path: Path) -> list[Series]:
        """All numbers that a log holds, also while a vehicle is disarmed; without images and stamps.

        Columns and variables have numbers in at least half of their cells; a quaternion is its yaw.

        Args:
            path: as of `read`.

        Returns:
            The numbers, as they stand in the log, in their order there.

        Raises:
            LogFormatError, MissingExtraError: as `read`.
        """
        ...


def segments(series: Collection[T]) -> tuple[list[list[T]], list[tuple[int, float]]]:
    """The series between the jumps of their clock, and each jump: its place in the log, and how far back it goes, s.

    A jump for good counts, as where a logger starts anew or its clock is set: the median of the five stamps after it is
    more than `JUMP` before, or `AHEAD` after, that of the five before it, in most series of the log. No single wrong
    stamp, and no clock of one sensor alone, divides a log. Then times count from the first stamp of each part.
    """
    jumps: list[tuple[int, float]] = _jumps(series)
    parts: list[list[T]] = [] if jumps else [list(series)]
    for begin, end in pairwise([-np.inf, *(place for place, _ in jumps), np.inf]) if jumps else ():
        rows = [(each.order >= begin) & (each.order < end) for each in series]
        start = min(each.time[inside].min() for each, inside in zip(series, rows, strict=True) if inside.any())
        cut = zip(series, rows, strict=True)
        moved = [x._replace(time=x.time[k] - start, value=x.value[k], order=x.order[k]) for x, k in cut]
        parts.append([x._replace(start=x.start + start) for x in moved])
    return parts, jumps


@np.errstate(all="ignore")
def _jumps(series: Collection[T]) -> list[tuple[int, float]]:
    spans: list[tuple[int, int, float]] = []  # places in the log between which a series jumps, and how far
    for each in series:
        steps = np.diff(each.time)
        places = np.flatnonzero((steps < -JUMP) | (steps > AHEAD))
        for k in places.tolist() if len(places) <= AROUND * MOST else ():
            before, after = each.time[max(0, k + 1 - AROUND) : k + 1], each.time[k + 1 : k + 1 + AROUND]
            ahead = np.median(after) - np.median(before)
            if min(len(before), len(after)) > 2 and (ahead < -JUMP or ahead > AHEAD):
                spans.append((int(each.order[k]), int(each.order[k + 1]), float(each.time[k] - each.time[k + 1])))
    jumps: list[tuple[int, float]] = []
    while spans:  # the fewest places that divide all jumps
        end = min(spans, key=lambda span: span[1])
        together = [span for span in spans if span[0] < end[1] <= span[1]]
        if 2 * len(together) > sum(len(each.order) > 0 and each.order[0] < end[1] <= each.order[-1] for each in series):
            jumps.append((end[1], end[2]))
        spans = [span for span in spans if span[0] >= end[1]]
    return jumps if len(jumps) <= MOST else []


def interleaved(times: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The places in a log of the messages of several topics: by time, and each topic in its own order."""
    latest = [np.maximum.accumulate(np.where(np.isfinite(time), time, -np.inf)) for time in times]
    order = np.empty(sum(map(len, times)), np.int64)
    order[np.argsort(np.concatenate([*latest, np.empty(0)]), kind="stable")] = np.arange(len(order))
    return np.split(order, np.cumsum([len(time) for time in times])[:-1])[: len(times)]
