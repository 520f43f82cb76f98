"""Tables whose rows are of several boats, or hold one number each beside its name.

The column that tells them apart has few values, and from a row of one to a row of another most measured numbers jump
far more than between two rows of the same. Where one boat changes its mode or gear, its heading and speed do not jump.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usvlearn.errors import LogFormatError, printable
from usvlearn.logs.formats.csv.dialect import Dialect
from usvlearn.logs.formats.csv.rows import Rows
from usvlearn.logs.formats.csv.stamps import WORD, parse_cells

VEHICLES = {"vehicle", "boat", "robot", "vessel", "ship", "usv", "asv", "auv", "agent", "mmsi", "imo", "callsign",
            "hull", "sysid", "system", "boot", "schiff", "fahrzeug", "bateau", "navire", "barco", "buque"}  # fmt: skip
NUMBERED = {"id", "name", "number", "no", "nr", "code"}  # words beside these
RUNS = {
    *"run session trial test lap leg mission experiment episode log file part segment day date".split()
}  # of one boat
NAMED = {"id", "variable", "signal", "channel", "parameter", "tag", "key", "sensor"}  # of a column of quantities
MOST, FEWEST, LOOKED = 20, 3, 16  # boats; rows of each; columns that are looked at
JUMPS, BLOCKS, HELD = 3.0, 0.02, 0.1  # how much more numbers jump; shares of rows of another boat, with another number


class Kinds(NamedTuple):
    """The column that tells which of several boats, or which quantity, a row is of."""

    column: str
    values: list[str]
    number: str = ""  # the only column of numbers, where its rows are of several quantities


@np.errstate(all="ignore")
def kinds_of(path: Path, dialect: Dialect) -> Kinds | None:
    """The column that tells rows apart, by the first rows, or by its name in the whole file; None if there is none."""
    names = [name for name in dialect.names if name and dialect.names.count(name) == 1]
    cells = {name: [row[dialect.names.index(name)].strip() for row in dialect.sample] for name in names}
    numbers = {name: parse_cells(each, dialect.decimal) for name, each in cells.items()}
    varied = [each for each, x in numbers.items() if 2 * np.isfinite(x).sum() > len(x) and np.nanmax(x) > np.nanmin(x)]
    found: list[Kinds] = []
    for name, own in cells.items():
        labels, words = np.array(own), {*WORD.findall(name.lower())}
        rows = np.flatnonzero(labels != "")
        counts, text = Counter(labels[rows].tolist()), np.isnan(numbers[name][rows]).all()
        if not (text or (numbers[name][rows] % 1 == 0).all()):
            continue
        if words & VEHICLES and words <= VEHICLES | NUMBERED:
            counts = Counter(each for each in labels_of(path, dialect, name) if each)
            if 2 <= len(counts) <= MOST:
                return Kinds(name, sorted(counts))
        few = 2 <= len(counts) <= (len(rows) / FEWEST if text or words & NAMED else MOST)
        labels = np.unique(labels[rows], return_inverse=True)[1]
        if not few or (labels[1:] != labels[:-1]).mean() < BLOCKS:
            continue
        others = [each for each in varied if each != name][:: 1 + len(varied) // LOOKED]
        steps = {each: step for each in others if (step := _steps(numbers[each][rows], labels))}
        jumping = [across > JUMPS * within for across, within, moved in steps.values() if moved >= HELD]
        alone = (text or words & NAMED) and len(steps) == 1 and len(varied) < LOOKED
        if alone and (one := next(iter(steps.values())))[0] > JUMPS * one[1]:
            found.append(Kinds(name, sorted(counts), *steps))
        elif len(counts) <= MOST and len(jumping) > 1 and 2 * sum(jumping) > len(jumping):
            found.append(Kinds(name, sorted(counts)))
    return max(found, key=lambda each: len(each.values), default=None)


def _steps(values: np.ndarray, labels: np.ndarray) -> tuple[float, float, float] | None:
    """Mean steps where the label changes, and between rows of one label, and the share of these; None of a stamp."""
    order, steps = np.argsort(labels, kind="stable"), np.diff(values)
    across = np.abs(steps[(labels[1:] != labels[:-1]) & np.isfinite(steps)])
    within = np.diff(values[order])[labels[order][1:] == labels[order][:-1]]
    within = within[np.isfinite(within)]
    if len(across) <= FEWEST or not len(within) or not (within < 0).any():
        return None
    return float(across.mean()), float(np.abs(within).mean()), float((within != 0).mean())


def changes_at(path: Path, dialect: Dialect, lines: Sequence[int]) -> str:
    """What is said where the text of a column changes at these lines, and nowhere else; or ""."""
    for name in dict.fromkeys(name for name in dialect.names if dialect.names.count(name) == 1):
        cells = [row[dialect.names.index(name)].strip() for row in dialect.sample]
        if sum(a != b for a, b in pairwise(cells)) <= len(lines) and not {*WORD.findall(name.lower())} & RUNS:
            rows = Rows(path, dialect, [name], [], texts=True)
            texts = np.array([each.strip() for each in rows.texts or ()])
            if rows.order[1:][texts[1:] != texts[:-1]].tolist() == list(lines):
                how = f"set data.boat_column={name} and data.boat=null; then, or if all are of one boat, confirm it"
                return f"rows: the clock jumps back where {name!r} changes, as where another boat's rows begin: {how}"
    return ""


def refused(path: Path, dialect: Dialect, kinds: Kinds) -> LogFormatError:
    """The error for rows of several boats or quantities."""
    column, one = printable(kinds.column), printable(kinds.values[0].strip("/"))
    listed = ", ".join(printable(repr(each)) for each in kinds.values[:4]) + (", …" if len(kinds.values) > 4 else "")
    if kinds.number:
        return LogFormatError(
            f"{path}: found one number a row and its name in the column {column!r} ({listed}), expected a column each: "
            f"import pandas; pandas.read_csv({path.name!r}, sep={dialect.delimiter!r}, decimal={dialect.decimal!r})"
            f".pivot_table(index={dialect.names[0]!r}, columns={column!r}, values={kinds.number!r}).to_csv('wide.csv')"
        )
    return LogFormatError(
        f"{path}: found rows of several boats or devices in the column {column!r} ({listed}), expected those of one: "
        f"look at one by usvlearn inspect … --name {one}; to read several boats, set data.boat_column={column} and "
        f"data.boat=null, or data.boat={one} for this one; data.reader.rows=all takes all rows as of one boat"
    )


def labels_of(path: Path, dialect: Dialect, column: str) -> list[str]:
    """The texts of a column."""
    return [label.strip() for label in Rows(path, dialect, [column], [], texts=True).texts or ()]
