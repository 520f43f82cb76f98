"""The rows of a table below its header: stamps, and numbers of some columns, parsed block by block; and its channels.

Four columns of a quaternion are one more column, the yaw.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Mapping, Sequence
from io import TextIOWrapper
from itertools import chain, compress, islice
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple, TextIO

import numpy as np

from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.channel import Channel, Source, build_channel
from usvlearn.logs.channels.series import OtherBoats
from usvlearn.logs.formats.csv.dialect import Dialect, errors_of, not_text
from usvlearn.logs.formats.csv.packed import open_table
from usvlearn.logs.formats.csv.stamps import Stamps, joined, parse_cells

BLOCK = 200  # rows that are parsed at a time; so many fit the processor's cache
PART = 1 << 16  # characters that are read at a time
NORM = 0.1  # by which the length of a quaternion may differ from 1
LETTERED = re.compile(r"(.*?)([._/ ]?)(x|y|z|w|X|Y|Z|W)")
NUMBERED = re.compile(r"(.*\bq|.*_q|q)(?:\[([0-3])\]|[._]0?([0-3])|([0-3]))", re.IGNORECASE)
ENU, NED = "enu_rad", "rad"  # by REP 103 of ROS, and of PX4


class Column:
    """The numbers of a column, block by block, or at once; of a yaw, `bad` rows are no rotation."""

    def __init__(self, values: np.ndarray | None = None, empty: np.ndarray | None = None, bad: int = 0) -> None:
        self._values = [] if values is None else [values]
        self._empty = [] if empty is None else [empty]
        self.first, self.bad = "", bad  # cell; rows

    def add(self, cells: Sequence[str], decimal: str) -> None:
        self.first = self.first if self._values else cells[0]
        values = parse_cells(cells, decimal)
        empty = np.zeros(len(cells), bool)
        for place in np.flatnonzero(np.isnan(values)).tolist():
            empty[place] = not cells[place].strip()
        self._values.append(values)
        self._empty.append(empty)

    @property
    def values(self) -> np.ndarray:  # (rows,) float64, NaN where there is no number
        self._values = [np.concatenate(self._values)]
        return self._values[0]

    @property
    def empty(self) -> np.ndarray:  # (rows,) bool, cells without text
        self._empty = [np.concatenate(self._empty)]
        return self._empty[0]


class Rows:
    """All complete rows of a file: stamps of one column or more, and columns of numbers.

    `only` is the place of a column and its text, if only rows with it are wanted; `texts`: whether the cells of the
    stamps are kept as they are. `order` are the lines of the rows, `(rows,)` int64, and `torn` counts incomplete rows.
    """

    def __init__(
        self, path: Path, dialect: Dialect, stamps: list[str], columns: list[str],
        only: tuple[int, str] | None = None, texts: bool = False,
    ):  # fmt: skip
        self.stamps, self.first_stamp, self.torn = Stamps(), "", 0
        self.texts: list[str] | None = [] if texts else None
        self.columns = {name: Column() for name in columns}
        width, orders, first_torn = len(dialect.names), [], ""
        wanted = itemgetter(*(dialect.names.index(name) for name in (*stamps, *columns)), 0)  # the last is spare
        how = dialect.encoding, errors_of(dialect.encoding)
        with TextIOWrapper(open_table(path), *how, newline="") as file:
            lines = _Lines(file, dialect)
            reader = csv.reader(chain.from_iterable(lines), delimiter=dialect.delimiter)
            given = 0
            try:
                while rows := list(islice(reader, BLOCK)):
                    order = lines.places(given + _ends(rows, reader.line_num - given))
                    given = reader.line_num
                    if set(map(len, rows)) != {width}:
                        whole = np.array([len(row) == width or bool(row[width:]) > any(row[width:]) for row in rows])
                        if lost := [k for k in np.flatnonzero(~whole).tolist() if rows[k]]:
                            first_torn = first_torn or f", found {len(rows[lost[0]])} in line {order[lost[0]]}"
                            self.torn += len(lost)
                        rows, order = list(compress(rows, whole)), order[whole]
                    if only is not None:
                        whole = np.array([row[only[0]].strip() == only[1] for row in rows], bool)
                        rows, order = list(compress(rows, whole)), order[whole]
                    if rows:
                        orders.append(order)
                        self._add(list(zip(*map(wanted, rows), strict=True)), stamps, dialect.decimal)
            except csv.Error as error:
                raise LogFormatError(
                    f"{path}, line {lines.places(np.array([reader.line_num]))[0]}: expected cells separated by "
                    f"{dialect.delimiter!r}, found a {error}: fix or remove that line"
                ) from error
            except UnicodeError as error:
                raise not_text(path, dialect.encoding) from error
        if not orders:
            if only and not first_torn:
                raise OtherBoats(f"{path}: found no row with {only[1]!r}: set data.reader.rows, or leave this log out")
            seen = first_torn or ", found nothing below the header"
            raise LogFormatError(
                f"{path}: expected rows of {width} cells, as many as the header has{seen}: fix the header, or leave "
                "this log out"
            )
        self.order = np.concatenate(orders)

    def _add(self, cells: list[tuple[str, ...]], stamps: list[str], decimal: str) -> None:
        """Take a block, column by column; the first ones hold the stamps."""
        count = len(stamps)
        stamp = cells[0] if count == 1 else joined(stamps, zip(*cells[:count], strict=True))
        self.first_stamp = self.first_stamp or stamp[0]
        if self.texts is None:
            self.stamps.add(stamp, decimal if count == 1 else ".")
        else:
            self.texts += stamp
        for column, each in zip(self.columns.values(), cells[count:], strict=False):
            column.add(each, decimal)


class _Lines:
    """The lines below the header that are no comments, in lists; and their places in the file."""

    def __init__(self, file: TextIO, dialect: Dialect):
        self._file, self._dialect = file, dialect
        self._from, self._skipped = [0], [dialect.body]  # after so many lines given, so many lines were skipped

    def __iter__(self) -> Iterator[list[str]]:
        for _ in range(self._dialect.body):
            next(self._file, "")
        comment, given = self._dialect.comment, 0
        while lines := self._file.readlines(PART):
            text = "".join(lines) if comment else ""
            if any(sign in text for sign in comment):
                selected: list[str] = []
                for line in lines:
                    if line.lstrip().startswith(comment):
                        self._from.append(given + len(selected))
                        self._skipped.append(self._skipped[-1] + 1)
                    else:
                        selected.append(line)
                lines = selected
            given += len(lines)
            yield [" ".join(line.split()) for line in lines] if self._dialect.delimiter == " " else lines

    def places(self, given: np.ndarray) -> np.ndarray:
        """The places in the file, from 1, of lines that were given, from 1."""
        return given + np.array(self._skipped)[np.searchsorted(self._from, given, side="left") - 1]


def _ends(rows: list[list[str]], lines: int) -> np.ndarray:
    """The last lines of rows, from 1; a cell in quotes may have several lines."""
    if lines == len(rows):
        return np.arange(1, lines + 1)
    return np.cumsum([1 + sum(len(cell.splitlines()) - 1 for cell in row if "\n" in cell) for row in rows])


class Quaternion(NamedTuple):
    """The columns x, y, z and w of a quaternion, and the unit of its yaw by convention."""

    columns: tuple[str, str, str, str]
    unit: str


def quaternions(names: Sequence[str]) -> dict[str, Quaternion]:
    """Name of an orientation -> its columns. `q[0]` … `q[3]`, as PX4 writes them, begin with w."""
    groups: dict[tuple[str, str], dict[str, str]] = {}
    for name in names:
        if match := NUMBERED.fullmatch(name):
            number = next(each for each in match.groups()[1:] if each)
            groups.setdefault((match[1], NED), {})["wxyz"[int(number)]] = name
        elif (match := LETTERED.fullmatch(name)) and match[1]:
            groups.setdefault((match[1], ENU), {})[match[3].lower()] = name
    return {
        stem: Quaternion((axes["x"], axes["y"], axes["z"], axes["w"]), unit)
        for (stem, unit), axes in groups.items()
        if len(axes) == 4 and stem not in names
    }


def yaw_of(parts: Sequence[Column]) -> Column:
    """Yaw of quaternions from the columns x, y, z and w, rad, counter-clockwise about z; NaN of what is no rotation."""
    x, y, z, w = (part.values for part in parts)
    missing = np.logical_and.reduce([part.empty for part in parts])
    with np.errstate(over="ignore", invalid="ignore"):
        size = np.sqrt(x * x + y * y + z * z + w * w)
        values = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
        rotation = np.abs(size - 1) <= NORM
    return Column(np.where(rotation, values, np.nan), missing, int((~rotation & ~missing).sum()))


class Columns(NamedTuple):
    """The numbers of some columns of a table."""

    time: np.ndarray  # (rows,) float64, s since the first readable stamp, NaN where it is unreadable
    origin: float  # that stamp, s since 1970, midnight or a start
    order: np.ndarray  # (rows,) int64, lines
    by_name: dict[str, Column]
    torn: int  # incomplete rows


class Place(NamedTuple):
    """Where a channel is, in one of several tables."""

    path: Path
    name: str  # of the column
    source: Source


def channels_of(
    tables: Mapping[Path, Columns], orders: Mapping[Path, np.ndarray], places: Mapping[str, Place]
) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
    """The channels, and the counts of unusable cells, from tables whose times count from one start.

    Of each file, the columns and the places of its rows in the log; of each channel, where it is.
    """
    channels, dropped = {}, {}
    for channel, (path, name, source) in places.items():
        table, column = tables[path], tables[path].by_name[name]
        channels[channel], causes = build_channel(
            f"{path}: {channel}", source, table.time, column.values, orders[path], column.empty, column.first or None,
            table.origin,
        )  # fmt: skip
        if column.bad:
            others = causes.pop("not_a_number", 0) - column.bad
            causes = {**causes, "no_rotation": column.bad} | ({"not_a_number": others} if others > 0 else {})
        dropped[channel] = {**causes, "torn_row": table.torn} if table.torn else causes
    return channels, dropped
