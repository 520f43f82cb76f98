"""Finds tables whose rows are of several boats, or hold one number each beside its name.

The column that tells them apart is called so, also in several tables. Or it has few values, and from a row of one to a
row of another most measured numbers jump far more than between two rows of the same. Where one boat changes its mode or
gear, its heading and speed do not jump. Blocks of rows of what may be devices, and no modes, legs or runs, are asked.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usvlearn.errors import LogFormatError, printable
from usvlearn.logs.formats.csv.dialect import AUTO, Dialect, find_dialect
from usvlearn.logs.formats.csv.rows import Rows
from usvlearn.logs.formats.csv.stamps import WORD, parse_cells

VEHICLES = {"vehicle", "boat", "robot", "vessel", "ship", "usv", "asv", "auv", "agent", "mmsi", "imo", "callsign",
            "hull", "sysid", "system", "boot", "schiff", "fahrzeug", "bateau", "navire", "barco", "buque"}  # fmt: skip
NUMBERED = {"id", "name", "number", "no", "nr", "code"}  # words beside these
DEVICES = {*("id name node platform drone serial device unit tracker craft asset member host hostname sender client "
             "uuid imei gerät geraet plattform kennung nom appareil nombre dispositivo").split()}  # fmt: skip
PHASES = {*("run session trial test lap leg mission experiment episode log file part segment section block day date "
            "phase step stage task mode modus state status flag waypoint wp wpt goal target line track route pass path "
            "cycle round maneuver manoeuvre behavior behaviour action command event scenario case config gear "
            "direction weather wind site location place area comment note lauf fahrt versuch tag abschnitt etappe "
            "runde zustand phase ziel etape étape état etat essai tour jour prueba vuelta estado modo tramo día tappa "
            "giro prova stato fase tilstand tur fart data raw csv bag train valid morning noon evening lake sea river "
            "pool harbour calm rough auto automatic autonomous manual guided hold loiter idle stop rtl remote on off "
            "true false yes ahead astern forward reverse left right straight turn circle zigzag").split()}  # fmt: skip
NAMED = {"id", "variable", "signal", "channel", "parameter", "tag", "key", "sensor"}  # of a column of quantities
MOST, FEWEST, LOOKED = 20, 3, 16  # boats; rows of each; columns that are looked at
JUMPS, BLOCKS, HELD = 3.0, 0.02, 0.1  # how much more numbers jump; shares of rows of another boat, with another number
DIGITS = 5  # of a number that identifies something


class Kinds(NamedTuple):
    """The column that tells which of several boats, or which quantity, a row is of."""

    column: str
    values: list[str]
    number: str = ""  # the only column of numbers, where its rows are of several quantities


@np.errstate(all="ignore")
def kinds_of(path: Path, dialect: Dialect, beside: Sequence[Path] = ()) -> Kinds | None:
    """The column that tells rows apart, by the first rows, or by its name in the file and those beside it; or None."""
    names = [name for name in dialect.names if name and dialect.names.count(name) == 1]
    cells = {name: [row[dialect.names.index(name)].strip() for row in dialect.sample] for name in names}
    numbers = {name: parse_cells(each, dialect.decimal) for name, each in cells.items()}
    varied = [each for each, x in numbers.items() if 2 * np.isfinite(x).sum() > len(x) and np.nanmax(x) > np.nanmin(x)]
    columns: list[Kinds] = []
    for name, texts in cells.items():
        labels, words = np.array(texts), words_of(name)
        rows = np.flatnonzero(labels != "")
        counts, text = Counter(labels[rows].tolist()), np.isnan(numbers[name][rows]).all()
        if not (text or (numbers[name][rows] % 1 == 0).all()):
            continue
        if _may_name(name, VEHICLES):
            known = {*labels_of(path, dialect, name), *_firsts(beside, name)} - {""}
            if 2 <= len(known) <= MOST:
                return Kinds(name, sorted(known))
        few = 2 <= len(counts) <= (len(rows) / FEWEST if text or words & NAMED else MOST)
        labels = np.unique(labels[rows], return_inverse=True)[1]
        if not few or (labels[1:] != labels[:-1]).mean() < BLOCKS:
            continue
        others = [each for each in varied if each != name][:: 1 + len(varied) // LOOKED]
        steps = {each: step for each in others if (step := _steps(numbers[each][rows], labels))}
        jumping = [across > JUMPS * within for across, within, moved in steps.values() if moved >= HELD]
        alone = (text or words & NAMED) and len(steps) == 1 and len(varied) < LOOKED
        if alone and (one := next(iter(steps.values())))[0] > JUMPS * one[1]:
            columns.append(Kinds(name, sorted(counts), *steps))
        elif len(counts) <= MOST and len(jumping) > 1 and 2 * sum(jumping) > len(jumping):
            columns.append(Kinds(name, sorted(counts)))
    return max(columns, key=lambda each: len(each.values), default=None)


def _steps(values: np.ndarray, labels: np.ndarray) -> tuple[float, float, float] | None:
    """Mean steps where the label changes, and between rows of one label, and the share of these; None of a stamp."""
    order, steps = np.argsort(labels, kind="stable"), np.diff(values)
    across = np.abs(steps[(labels[1:] != labels[:-1]) & np.isfinite(steps)])
    within = np.diff(values[order])[labels[order][1:] == labels[order][:-1]]
    within = within[np.isfinite(within)]
    if len(across) <= FEWEST or not len(within) or not (within < 0).any():
        return None
    return float(across.mean()), float(np.abs(within).mean()), float((within != 0).mean())


def doubt_of(path: Path, dialect: Dialect, jumps: Sequence[int], beside: Sequence[Path]) -> str:
    """What is said of a column that may tell boats apart, also from other tables; `jumps` are lines; or ""."""
    for name in dict.fromkeys(name for name in dialect.names if dialect.names.count(name) == 1):
        cells = [row[dialect.names.index(name)].strip() for row in dialect.sample]
        device = _may_name(name, DEVICES) or _may_name(next(iter(cells), ""), VEHICLES)
        likely = device or (jumps and sum(a != b for a, b in pairwise(cells)) <= len(jumps))
        if not likely or words_of(name) & PHASES or len({*cells}) > MOST:
            continue
        rows = Rows(path, dialect, [name], [], texts=True)
        texts = np.array([each.strip() for each in rows.texts or ()])
        labels = {*texts.tolist(), *_firsts(beside, name)} - {""}
        if not 2 <= len(labels) <= MOST or any(words_of(each) & PHASES for each in labels):
            continue
        lines = rows.order[1:][texts[1:] != texts[:-1]].tolist()
        back = lines == [*jumps] and lines and (device or all(len(each) >= DIGITS or words_of(each) for each in labels))
        if back or (device and len(lines) < 2 * len(labels)):
            why = f"the clock jumps back where {name!r} changes" if back else f"{name!r} changes from block to block"
            how = f"set data.boat_column={name} and data.boat=null; then, or if all are of one boat, confirm it"
            return f"rows: {why}, as where another boat's rows begin: {how}"
    return ""


def _firsts(files: Sequence[Path], name: str) -> Iterator[str]:
    """The first text of a column in each table that has it."""
    for file in files:
        with suppress(LogFormatError):
            head = find_dialect(file, AUTO, AUTO, AUTO, AUTO, AUTO)
            if head.names.count(name) == 1:
                yield next((cell for row in head.sample if (cell := row[head.names.index(name)].strip())), "")


def words_of(text: str) -> set[str]:
    """The words of a name, in lower case, without numbers."""
    return {*WORD.findall(text.lower())}


def _may_name(column: str, things: set[str]) -> bool:
    """Whether the name of a column has no other words than those of such things and their numbers."""
    return bool((words := words_of(column)) & things) and words <= things | VEHICLES | NUMBERED


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
