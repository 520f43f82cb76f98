"""Tables of one folder that are the topics of one run: each file has some of its channels, and time joins them.

A column is then FILE.COLUMN: `odom.field.twist.twist.linear.x` is the column `field.twist.twist.linear.x` of
`odom.csv`. All stamps must be of one clock. The rules of `docs/formats.md` tell such tables from those of one run each.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usvlearn.errors import LogFormatError, printable
from usvlearn.logs.channels.channel import Channel, Source, match_name
from usvlearn.logs.channels.series import Series, interleaved
from usvlearn.logs.formats.csv.opened import OpenedTable
from usvlearn.logs.formats.csv.rows import Place, channels_of

RUNS, TOPICS = "runs", "topics"  # what the tables of a folder are
SUFFIXES = ".csv", ".tsv", ".slog", ".csv.gz", ".tsv.gz"
ALIKE = 0.5  # share of all columns that two files have both, from which they are of one kind
FEWEST = 3  # columns of a run: a command, a heading and a speed
MISSING = 3e8  # s, above which a stamp is a date


def several_kinds(columns: Sequence[Sequence[str]]) -> bool:
    """Whether tables with these columns are topics, and not runs: these have the same columns, and enough of them."""
    sets = [set(each) for each in columns]
    if len(sets) < 2:
        return False
    largest = max(sets, key=len)
    return len(largest) < FEWEST or any(len(each & largest) < ALIKE * len(each | largest) for each in sets)


def tables_of(folder: Path) -> list[Path]:
    """The tables that lie in a folder."""
    return sorted(each for each in folder.iterdir() if each.name.lower().endswith(SUFFIXES) and each.is_file())


def read_topics(
    folder: Path, topics: Mapping[str, OpenedTable], sources: dict[str, Source]
) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
    """The channels of a run whose topics are tables; a LogFormatError where their stamps do not overlap."""
    places = {}
    for channel, source in sources.items():
        topic, column = locate(source.name, topics, f"{folder}: data.channels.{channel}.name")
        places[channel] = topic, Place(topics[topic].path, column, source)
    used = {topic: topics[topic] for topic in topics if any(topic == each for each, _ in places.values())}
    wanted = {topic: [place.name for name, place in places.values() if name == topic] for topic in used}
    columns = {topic: each.columns(wanted[topic]) for topic, each in used.items()}
    spans = {topic: Span.of(each.time, each.origin) for topic, each in columns.items()}
    late, early = max(spans, key=lambda topic: spans[topic].begin), min(spans, key=lambda topic: spans[topic].end)
    if spans[late].begin >= spans[early].end:
        raise apart(folder, {name: spans[name] for name in (early, late)})
    start = min(each.begin for each in spans.values())
    columns = {k: x._replace(time=x.time + (x.origin - start), origin=start) for k, x in columns.items()}
    joined = {used[topic].path: each for topic, each in columns.items()}
    orders = dict(zip(joined, interleaved([each.time for each in joined.values()]), strict=True))
    return channels_of(joined, orders, {channel: place for channel, (_, place) in places.items()})


def survey_topics(folder: Path, topics: Mapping[str, OpenedTable]) -> list[Series]:
    """All series of a run whose topics are tables, as FILE.COLUMN; those of another time or clock are left out."""
    surveyed: dict[str, tuple[list[Series], float]] = {}
    for topic, opened in topics.items():
        try:
            series, origin = opened.survey()
        except LogFormatError as error:
            warnings.warn(f"table left out: {error}", stacklevel=4)
            continue
        if series:
            surveyed[topic] = series, origin
    spans = {topic: Span.of(series[0].time, origin) for topic, (series, origin) in surveyed.items()}
    if not spans:
        raise LogFormatError(f"{folder}: expected tables of one run, found no numbers in them: give another folder")
    together = _largest(spans)
    if len(spans) > 1 and len(together) < 2:
        raise apart(folder, spans)
    longest = max(sorted(together), key=lambda topic: spans[topic].end - spans[topic].begin)
    for topic in sorted(spans.keys() - together):
        warnings.warn(f"table left out: {apart(folder, {k: spans[k] for k in (topic, longest)})}", stacklevel=4)
    start = min(spans[topic].begin for topic in together)
    runs = {topic: each for topic, each in surveyed.items() if topic in together}
    times = [series[0].time + (origin - start) for series, origin in runs.values()]
    listed = []
    for (topic, (series, _)), time, order in zip(runs.items(), times, interleaved(times), strict=True):
        listed += [each._replace(name=f"{topic}.{each.name}", time=time, order=order) for each in series]
    return listed


class Span(NamedTuple):
    """The first and the last stamp of a table, s."""

    begin: float
    end: float

    @classmethod
    def of(cls, time: np.ndarray, origin: float) -> Span:
        known = time[np.isfinite(time)] + origin
        return cls(float(known.min()), float(known.max()))

    def __str__(self) -> str:
        if self.begin > MISSING:
            return " to ".join(f"{datetime.fromtimestamp(min(each, 2e11), UTC):%Y-%m-%d %H:%M:%S}" for each in self)
        return f"{self.begin:.6g} to {self.end:.6g} s"


def _largest(spans: dict[str, Span]) -> set[str]:
    """The most tables whose times overlap that of one of them; of equal numbers those of the longest."""
    near = {
        topic: {other for other, each in spans.items() if each.begin <= span.end and span.begin <= each.end}
        for topic, span in spans.items()
    }
    return max(near.items(), key=lambda item: (len(item[1]), spans[item[0]].end - spans[item[0]].begin))[1]


def apart(folder: Path, spans: dict[str, Span]) -> LogFormatError:
    """The error for tables whose times do not overlap."""
    (one, first), (other, second) = list(spans.items())[:2]
    return LogFormatError(
        f"{folder}: expected tables of one run, whose times overlap, found {one} from {first} and {other} from "
        f"{second}: their clocks or time zones differ, or they are of several runs: write the stamps of one clock, or "
        "give each run a folder of its own"
    )


def locate(pattern: str, topics: Mapping[str, OpenedTable], where: str) -> tuple[str, str]:
    """The topic and the column that a `Source` names; a LogFormatError where there is none, or several."""
    for topic, opened in topics.items():
        if pattern.startswith(f"{topic}.") and len(matches := opened.find(pattern[len(topic) + 1 :])) == 1:
            return topic, matches[0]
    alone = [(topic, name) for topic, opened in topics.items() for name in opened.find(pattern)]
    if len(alone) == 1:
        return alone[0]
    if alone:
        listed = ", ".join(f"{topic}.{name}" for topic, name in alone[:8])
        raise LogFormatError(
            f"{where}: the column {printable(pattern)!r} is in several tables: name one of {printable(listed)}"
        )
    every = {f"{topic}.{name}": (topic, name) for topic, opened in topics.items() for name in opened.names}
    return every[match_name(pattern, every, where)]
