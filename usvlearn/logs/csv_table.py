"""Tables of text (`.csv`, `.tsv`): a header line, then one row per time step."""

from __future__ import annotations

import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from usvlearn.errors import ConfigError, LogFormatError, check_choice
from usvlearn.logs.channel import QUOTED, Channel, Source, build_channel, match_name
from usvlearn.logs.csv_dialect import AUTO, Dialect, find_dialect, split_unit
from usvlearn.logs.csv_rows import Rows
from usvlearn.logs.csv_stamps import ORDERS
from usvlearn.logs.series import Series

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
CLOCK = "hhmmss"  # in place of a unit: times of a day as numbers


@dataclass(frozen=True)
class Table:
    """Reads a CSV file. `Source.name` is a column, with its unit as in `Speed (m/s)`, or without.

    Lines above the header are skipped, and a line below it that holds units. A row with more or fewer cells than the
    header (a torn write) is dropped and counted as `torn_row`. In a file with decimal commas a number with a point is
    counted as `not_a_number`, as is one with separators of thousands.

    Args:
        time: column of the stamps: numbers, date-times such as `2025-07-24 17:18:48.207`, or times of a day, which go
            on past midnight; `Date+Time` joins two columns. A date-time without a zone is taken as UTC.
        time_unit: unit of stamps that are numbers: s, ms, us or ns; or hhmmss, for times of a day such as 091500.25.
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
        check_choice("data.reader.time_unit", self.time_unit, (*TIME_UNITS, CLOCK))
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
        rows = Rows(path, dialect, stamps, columns)
        time = self._seconds(path, dialect, stamps, rows)
        channels, dropped = {}, {}
        for channel, source in sources.items():
            column = rows.columns[matched[channel]]
            channels[channel], dropped[channel] = build_channel(
                f"{path}: {channel}", source, time, column.values, rows.order, column.empty, column.first
            )
            if rows.torn:
                dropped[channel]["torn_row"] = rows.torn
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
        rows = Rows(path, dialect, stamps, columns)
        time = self._seconds(path, dialect, stamps, rows)
        readable, series = np.isfinite(time), []
        for name in columns:
            column = rows.columns.pop(name)
            found = np.isfinite(column.values)
            if found.any() and 2 * found.sum() >= (~column.empty).sum():
                unit = dialect.units[dialect.names.index(name)]
                series.append(Series(name, None, time[readable], column.values[readable], rows.order[readable], unit))
        return series

    def stamp_kind(self, path: Path) -> tuple[str, str]:
        """What the stamps are (number, hhmmss, time or one of `ORDERS`), and a doubt about it, or ""."""
        dialect = self._dialect(path)
        rows = Rows(path, dialect, self._stamp_columns(path, dialect), [])
        _, kind, doubt = rows.stamps.seconds(self.dates)
        return CLOCK if kind == "number" and rows.stamps.clock_numbers() else kind or "number", doubt

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

    def _seconds(self, path: Path, dialect: Dialect, stamps: list[str], rows: Rows) -> np.ndarray:
        """Stamps as seconds since the first readable one."""
        time, kind, doubt = rows.stamps.seconds(self.dates, self.time_unit == CLOCK)
        if time is None:
            raise LogFormatError(
                f"{path}, line {rows.order[0]}: expected a number or a date-time in the time column "
                f"{self.time!r}, found {rows.first_stamp[:QUOTED]!r}: name the column of the stamps in data.reader.time"
            )
        if doubt:
            raise LogFormatError(
                f"{path}: expected to find the order of day, month and year from the column {self.time!r}, found "
                f"{doubt}: set data.reader.dates to one of {', '.join(ORDERS)}"
            )
        if kind != "number":
            return time
        if self.time_unit == "s" and rows.stamps.clock_numbers():
            warnings.warn(
                f"{path}: the numbers of {self.time!r} are times of a day, such as {rows.first_stamp[:QUOTED]!r}, but "
                f"they are read as seconds: set data.reader.time_unit={CLOCK}",
                stacklevel=4,
            )
        declared = dialect.units[dialect.names.index(stamps[0])]
        if declared in TIME_UNITS and declared != self.time_unit:
            warnings.warn(
                f"{path}: the header declares {stamps[0][:QUOTED]!r} in {declared}, but it is read in {self.time_unit}"
                f": set data.reader.time_unit={declared}",
                stacklevel=4,
            )
        return time * TIME_UNITS[self.time_unit]


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
