"""The figures of earlier runs, and the rule by which a figure has become worse.

Each run appends its figures to `history.csv`, one a row. A time stands there as a ratio to a reference that is timed
in the same rounds, because machines differ: to the same step in C, or to a loop of plain RLS in numpy. A figure is
compared with the earlier entries whose name, reference and effort are the same; the machine must be the same, too, if
the figure is timed.

w is the change v/b − 1 of a figure, with v now and b before; lower is better. A figure is worse if

    w > t against the median of the last five such entries,   or   w > √2 t against the last of them,

    t = max(10 %, 2.5 s) of a timed figure,   t = 2 % of any other

s is the largest of three spreads: that of the repeats in this run, the median of those of the repeats in the entries,
and, from three entries on, that of the entries' values. A spread is 1.4826 times the median absolute deviation from the
median, relative to it; of normal values this is the standard deviation. One entry varies more than a median: hence √2.
Repeats of a figure that is not timed give the same value.
"""

import csv
import io
import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from usvlearn.errors import UsvlearnError

LAST, SPREADS = 5, 2.5
TIMED_FLOOR, FLOOR = 0.10, 0.02


class Figure(NamedTuple):
    """A ratio that a run reports; lower is better."""

    name: str
    value: float
    reference: str  # what the value is a ratio to
    spread: float | None = None  # of its repeats, relative; None: not timed


class Run(NamedTuple):
    """When, where and with what it was measured."""

    date: str  # ISO 8601
    version: str  # of usvlearn
    effort: str  # "whole" or "quick"
    machine: str
    python: str
    torch: str
    numba: str
    numpy: str


class Entry(NamedTuple):
    """A row of the history."""

    run: Run
    figure: Figure


class Comparison(NamedTuple):
    """A figure beside its earlier values; None where there is none."""

    figure: Figure
    entries: int  # that are comparable
    last: float | None  # change since the last, relative: value/last − 1
    median: float | None  # change against the median of the last five
    tolerance: float
    worse: bool


COLUMNS = (*Run._fields, *Figure._fields)


def spread(values: Sequence[float]) -> float:
    """Relative to the median, 1.4826 times the median absolute deviation from it."""
    middle = statistics.median(values)
    return 1.4826 * statistics.median(abs(x - middle) for x in values) / abs(middle) if middle else 0.0


def timed(name: str, ratios: Sequence[float], reference: str) -> Figure:
    """The figure of a ratio of times, one for each round."""
    return Figure(name, statistics.median(ratios), reference, spread(ratios))


def read(path: Path) -> list[Entry]:
    """All entries, oldest first; none where there is no file. A damaged line is an error that names it."""
    if not path.exists():
        return []
    entries, rows = [], csv.reader(io.StringIO(path.read_text(), newline=""))
    for line, row in enumerate(rows, 1):
        try:
            run, (name, value, reference, between) = Run(*row[:8]), row[8:]
            if line > 1:
                figure = Figure(name, float(value), reference, float(between) if between else None)
                entries.append(Entry(run, figure))
        except (TypeError, ValueError):
            raise UsvlearnError(f"{path}, line {line}: expected {','.join(COLUMNS)}: correct or delete it") from None
    return entries


def append(path: Path, entries: Sequence[Entry]) -> None:
    """Add entries to the file, which is made where it is absent."""
    old = path.read_text() if path.exists() else ""
    lines = io.StringIO(newline="")
    writer = csv.writer(lines, lineterminator="\n")
    if not old:
        writer.writerow(COLUMNS)
    for run, figure in entries:
        spread = "" if figure.spread is None else f"{figure.spread:.3g}"
        writer.writerow([*run, figure.name, f"{figure.value:.5g}", figure.reference, spread])
    path.write_text(old + ("\n" if old and not old.endswith("\n") else "") + lines.getvalue())


def comparable(history: Sequence[Entry], now: Entry) -> list[Entry]:
    """The earlier entries of the same figure under the same circumstances, oldest first."""

    def kind(entry: Entry):
        run, figure = entry
        machine = None if figure.spread is None else run.machine
        return figure.name, figure.reference, run.effort, machine

    return [entry for entry in history if kind(entry) == kind(now)]


def compare(history: Sequence[Entry], now: Entry) -> Comparison:
    """A figure beside its earlier values, by the rule above."""
    figure, before = now.figure, [entry.figure for entry in comparable(history, now)]
    values, tolerance = [each.value for each in before[-LAST:]], FLOOR
    if figure.spread is not None:
        spreads = [figure.spread, statistics.median([each.spread or 0.0 for each in before[-LAST:]] or [0.0])]
        spreads += [spread(values)] if len(values) > 2 else []
        tolerance = max(TIMED_FLOOR, SPREADS * max(spreads))
    if not values:
        return Comparison(figure, 0, None, None, tolerance, False)
    changes = [change(figure.value, base) for base in (values[-1], statistics.median(values))]
    worse = changes[0] > math.sqrt(2) * tolerance or changes[1] > tolerance
    return Comparison(figure, len(before), *changes, tolerance, worse)


def change(value: float, base: float) -> float:
    """Relative; of a base of 0, nothing or infinite."""
    if base == 0:
        return math.copysign(math.inf, value) if value else 0.0
    return (value - base) / abs(base)
