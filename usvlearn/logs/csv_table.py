"""Tables of text (`.csv`, `.tsv`): a header line, then one row per time step."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, compress, islice
from operator import itemgetter
from pathlib import Path
from typing import ClassVar, TextIO

import numpy as np

from usvlearn.errors import ConfigError, LogFormatError, check_choice
from usvlearn.logs.channel import QUOTED, Channel, Source, build_channel, match_name
from usvlearn.logs.csv_dialect import AUTO, Dialect, errors_of, find_dialect, not_text, split_unit
from usvlearn.logs.csv_stamps import ORDERS, Stamps, parse_cells
from usvlearn.logs.series import Series

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
BLOCK = 200  # rows that are parsed at a time
PART = 1 << 16  # characters that are read at a time


@dataclass(frozen=True)
class Table:
    """Reads a CSV file. `Source.name` is a column, with its unit as in `Speed (m/s)`, or without.

    Lines above the header are skipped, and a line below it that holds units. A row with more or fewer cells than the
    header (a torn write) is dropped and counted as `torn_row`. In a file with decimal commas a number with a point is
    counted as `not_a_number`, as is one with separators of thousands.

    Args:
        time: column of the stamps: numbers, date-times such as `2025-07-24 17:18:48.207`, or times of a day, which go
            on past midnight; `Date+Time` joins two columns. A date-time without a zone is taken as UTC.
        time_unit: unit of stamps that are numbers: s, ms, us or ns.
        delimiter: what separates the cells; a space stands for any number of spaces and tabs.
        decimal: sign of the numbers, `.` or `,`.
        encoding: of the text, as Python names it.
        comment: what a line begins with that is skipped; null: no line is.
        dates: order of date-times: year_first, day_first or month_first.

    The last five are "auto" by default: found from the file, the same for the same file.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "a.csv"
    ...     _ = path.write_text("stamp;Speed (m/s)\\n5000;1,2\\n5100;\\n5200;1,3\\n")
    ...     channels, dropped = Table("stamp", time_unit="ms").read(path, {"surge": Source("Speed")})
    >>> channels["surge"].time, channels["surge"].value, dropped
    (array([0. , 0.2]), array([1.2, 1.3]), {'surge': {'empty': 1}})
    """

    time: str
    time_unit: str = "s"
    delimiter: str = AUTO
    decimal: str = AUTO
    encoding: str = AUTO
    comment: str | None = AUTO
    dates: str = AUTO

    suffixes: ClassVar[tuple[str, ...]] = (".csv", ".tsv")

    def __post_init__(self):
        check_choice("data.reader.time_unit", self.time_unit, tuple(TIME_UNITS))
        if self.delimiter != AUTO and (len(self.delimiter) != 1 or self.delimiter in '\r\n"'):
            raise ConfigError(f"data.reader.delimiter: found {self.delimiter!r}, expected one character, or {AUTO}")
        check_choice("data.reader.decimal", self.decimal, (".", ",", AUTO))
        check_choice("data.reader.dates", self.dates, (*ORDERS, AUTO))
        try:
            if self.encoding != AUTO:
                "".encode(self.encoding)
        except LookupError:
            raise ConfigError(
                f"data.reader.encoding: found {self.encoding!r}, expected one such as utf-8, cp1252, or {AUTO}"
            ) from None

    def read(self, path: Path, sources: dict[str, Source]) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
        """The channels of a table, and the counts of unusable cells: channel -> cause -> count.

        Args:
            path: the file.
            sources: channel -> where it is found.

        Raises:
            LogFormatError: the file is no table, or lacks a column, or does not tell how it is written.
        """
        dialect = self._dialect(path)
        stamps = self._stamp_columns(path, dialect)
        matched = {
            channel: _match(source.name, dialect.names, f"{path}: data.channels.{channel}.name")
            for channel, source in sources.items()
        }
        columns = list(dict.fromkeys(matched.values()))
        if twice := [name for name in (*stamps, *columns) if dialect.names.count(name) > 1]:
            raise LogFormatError(f"{path}: has several columns {twice[0][:QUOTED]!r}, expected one: rename all but one")
        body = _Body(path, dialect, stamps, columns)
        time = self._seconds(path, body)
        channels, dropped = {}, {}
        for channel, source in sources.items():
            column = body.columns[matched[channel]]
            channels[channel], dropped[channel] = build_channel(
                f"{path}: {channel}", source, time, column.values, body.order, column.empty, column.first
            )
            if body.torn:
                dropped[channel]["torn_row"] = body.torn
        return channels, dropped

    def survey(self, path: Path) -> list[Series]:
        """All columns with numbers in at least half of their filled cells.

        Args:
            path: the file.

        Raises:
            LogFormatError: as for `read`.
        """
        dialect = self._dialect(path)
        stamps = self._stamp_columns(path, dialect)
        columns = [name for name in dialect.names if name and dialect.names.count(name) == 1 and name not in stamps]
        body = _Body(path, dialect, stamps, columns)
        time = self._seconds(path, body)
        readable, series = np.isfinite(time), []
        for name in columns:
            column = body.columns.pop(name)
            found = np.isfinite(column.values)
            if found.any() and 2 * found.sum() >= (~column.empty).sum():
                unit = dialect.units[dialect.names.index(name)]
                series.append(Series(name, None, time[readable], column.values[readable], body.order[readable], unit))
        return series

    def stamp_kind(self, path: Path) -> tuple[str, str]:
        """What the stamps are (number, time, year_first, day_first or month_first), and a doubt about it, or ""."""
        dialect = self._dialect(path)
        body = _Body(path, dialect, self._stamp_columns(path, dialect), [])
        _, kind, doubt = body.stamps.seconds(self.dates)
        return kind or "number", doubt

    def _dialect(self, path: Path) -> Dialect:
        """How a file is written, by the options given and by what is found."""
        found = find_dialect(path, self.time, self.encoding, self.delimiter, self.comment, self.decimal)
        if "decimal" in found.doubts:
            raise LogFormatError(
                f"{path}: expected to find the decimal sign from the numbers, found {found.doubts['decimal']}: set "
                "data.reader.decimal"
            )
        return found

    def _stamp_columns(self, path: Path, dialect: Dialect) -> list[str]:
        """The columns of the stamps: one, or a date and a time."""
        names = [name for name in dialect.names if name]
        parts = [self.time] if self.time in names else [part.strip() for part in self.time.split("+", 1)]
        bare = [split_unit(name)[0] for name in names]
        for place, part in enumerate(parts):
            if part not in names and bare.count(part) == 1:
                parts[place] = names[bare.index(part)]
            elif part not in names:
                raise LogFormatError(_no_time_column(path, part, names, dialect.delimiter))
        return parts

    def _seconds(self, path: Path, body: _Body) -> np.ndarray:
        """Stamps as seconds since the first readable one."""
        time, kind, doubt = body.stamps.seconds(self.dates)
        if time is None:
            raise LogFormatError(
                f"{path}, line {body.order[0]}: expected a number or a date-time in the time column "
                f"{self.time!r}, found {body.first_stamp[:QUOTED]!r}: name the column of the stamps in data.reader.time"
            )
        if doubt:
            raise LogFormatError(
                f"{path}: expected to find the order of day, month and year from the column {self.time!r}, found "
                f"{doubt}: set data.reader.dates to one of {', '.join(ORDERS)}"
            )
        return time * (TIME_UNITS[self.time_unit] if kind == "number" else 1.0)


class _Column:
    """The numbers of a column, block by block."""

    def __init__(self) -> None:
        self._values: list[np.ndarray] = []
        self._empty: list[np.ndarray] = []
        self.first = ""  # cell

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


class _Body:
    """The rows below the header: stamps, and numbers of some columns.

    Attributes:
        order: lines of the complete rows, `(rows,)` int64.
        torn: number of incomplete rows.
        first_stamp: its text.
    """

    def __init__(self, path: Path, dialect: Dialect, stamps: list[str], columns: list[str]):
        self.stamps, self.first_stamp, self.torn = Stamps(), "", 0
        self.columns = {name: _Column() for name in columns}
        width, orders, first_torn = len(dialect.names), [], ""
        wanted = itemgetter(*(dialect.names.index(name) for name in (*stamps, *columns)), 0)  # the last is spare
        with path.open(encoding=dialect.encoding, errors=errors_of(dialect.encoding), newline="") as file:
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
                    if rows:
                        orders.append(order)
                        self._add(list(zip(*map(wanted, rows), strict=True)), len(stamps), dialect.decimal)
            except csv.Error as error:
                raise LogFormatError(
                    f"{path}, line {lines.places(np.array([reader.line_num]))[0]}: expected cells separated by "
                    f"{dialect.delimiter!r}, found a {error}: fix or remove that line"
                ) from error
            except UnicodeError as error:
                raise not_text(path, dialect.encoding) from error
        if not orders:
            raise LogFormatError(
                f"{path}: expected rows of {width} cells, as many as the header has"
                f"{first_torn or ', found nothing below the header'}: fix the header, or leave this log out"
            )
        self.order = np.concatenate(orders)

    def _add(self, cells: list[tuple[str, ...]], stamps: int, decimal: str) -> None:
        """Take a block, column by column; the first ones hold the stamps."""
        stamp = cells[0] if stamps == 1 else [" ".join(each) for each in zip(*cells[:stamps], strict=True)]
        self.first_stamp = self.first_stamp or stamp[0]
        self.stamps.add(stamp, decimal)
        for column, each in zip(self.columns.values(), cells[stamps:], strict=False):
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
                kept: list[str] = []
                for line in lines:
                    if line.lstrip().startswith(comment):
                        self._from.append(given + len(kept))
                        self._skipped.append(self._skipped[-1] + 1)
                    else:
                        kept.append(line)
                lines = kept
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


def _match(pattern: str, names: list[str], where: str) -> str:
    """The column that a `Source` names, with or without its unit."""
    bare = Counter(split_unit(name)[0] for name in names)
    if pattern not in names and bare[pattern] == 1:
        return next(name for name in names if split_unit(name)[0] == pattern)
    return match_name(pattern, [name for name in names if name], where)


def _no_time_column(path: Path, time: str, names: list[str], delimiter: str) -> str:
    listing = ", ".join(repr(name[:QUOTED]) for name in names[:40]) + (", ..." if len(names) > 40 else "")
    message = f"{path}: expected a time column {time!r}, found the columns {listing or '(none)'}: "
    if len(names) < 2:
        return message + f"set data.reader.delimiter if {delimiter!r} does not separate its cells"
    return message + "name one of them in data.reader.time"
