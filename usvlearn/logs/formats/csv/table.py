"""Tables of text (`.csv`, `.tsv`): a header line, then one row per time step."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np

from usvlearn.errors import ConfigError, LogFormatError, check_choice
from usvlearn.logs.channels.channel import QUOTED, Channel, Source, match_name, matching
from usvlearn.logs.channels.series import Reader, Series
from usvlearn.logs.formats.csv import topics
from usvlearn.logs.formats.csv.boats import doubt_of, kinds_of, labels_of, refused
from usvlearn.logs.formats.csv.dialect import AUTO, Dialect, find_dialect, no_header, not_sorted, split_unit
from usvlearn.logs.formats.csv.options import find_options, stamp_columns
from usvlearn.logs.formats.csv.rows import Columns, Place, Quaternion, Rows, channels_of, quaternions, yaw_of
from usvlearn.logs.formats.csv.stamps import HHMMSS, ORDERS, TIME_UNITS, spread

GEAR = re.compile("f|fwd|for.*|ahead|d|drive|neutral.*|stop|r|rev.*|astern|back.*|vor.*|zurück|rück.*|avant|arrière")
HEMISPHERES = ("N", "S", "E", "W")  # cells of a column beside a latitude or a longitude
GRAIN = 0.864  # s, of days with five decimals, as a spreadsheet writes them
ROTATION, ROS = "quaternion", "geometry_msgs"  # kinds of series
ROS_COLUMN = re.compile(r"(^|[./])(linear|angular|angular_velocity|linear_acceleration)[./][xyz]$")


@dataclass(frozen=True)
class Table(Reader):
    """Reads a CSV file. `Source.name` is a column, with its unit as in `Speed (m/s)`, or without.

    Lines above the header are skipped, and a line below it that holds units. A row with more or fewer cells than the
    header (a torn write) is dropped and counted as `torn_row`. In a file with decimal commas a number with a point is
    counted as `not_a_number`, as is one with separators of thousands.

    The last seven are "auto" by default: found from the file, the same for the same file. So can `time` be, with its
    unit. Where stamps are whole seconds and repeat, the rows of a second are spread evenly within it
    (`usvlearn.logs.formats.csv.stamps.spread`).

    Args:
        time: column of the stamps: numbers, date-times such as `2025-07-24 17:18:48.207`, or times of a day, which go
            on past midnight, or of an hour, mm:ss.f. `A+B` joins columns: `Date+Time`, `secs+nsecs`,
            `year+month+day+hour+minute+second`. A date-time without a zone is taken as UTC.
        time_unit: unit of stamps that are numbers: s, ms, us, ns, min, h or days; or hhmmss, for times of a day such as
            091500.25.
        delimiter: what separates the cells; a space stands for any number of spaces and tabs.
        decimal: sign of the numbers, `.` or `,`.
        encoding: of the text, as Python names it.
        comment: what a line begins with that is skipped; null: no line is.
        dates: order of date-times: year_first, day_first or month_first.
        rows: those that are read: `vehicle=anna`, those with `anna` in the column `vehicle`; `all`; or `auto`: all, but
            rows of several boats are refused.
        files: what the tables of a folder are: `runs`, each of them a run, or `topics`, which together are one run and
            are joined by time. Then a name is FILE.COLUMN, or the column alone, where one file has it. `auto`: runs,
            if one of them has all columns that are named, or if all have the same columns.

    Raises:
        ConfigError: an option outside its legal values.

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
    rows: str = AUTO
    files: str = AUTO

    suffixes: ClassVar[tuple[str, ...]] = topics.SUFFIXES

    def __post_init__(self):
        check_choice("data.reader.time_unit", self.time_unit, (*TIME_UNITS, HHMMSS))
        if self.delimiter != AUTO and (len(self.delimiter) != 1 or self.delimiter in '\r\n"'):
            raise ConfigError(f"data.reader.delimiter: found {self.delimiter!r}, expected one character, or {AUTO}")
        check_choice("data.reader.decimal", self.decimal, (".", ",", AUTO))
        check_choice("data.reader.dates", self.dates, (*ORDERS, AUTO))
        check_choice("data.reader.files", self.files, (topics.RUNS, topics.TOPICS, AUTO))
        try:
            if self.encoding != AUTO:
                "".encode(self.encoding)
        except LookupError:
            raise ConfigError(
                f"data.reader.encoding: found {self.encoding!r}, expected one such as utf-8, cp1252, or {AUTO}"
            ) from None

    @classmethod
    def found(cls, path: Path, boat: str | None = None, beside: Sequence[Path] = ()) -> tuple[Table, list[str]]:
        """A reader with the options that are found, and what is unsure: see `options.find_options`."""
        options, unsure = find_options(path, boat, beside)
        return cls(**options), unsure

    def read(self, path: Path, sources: dict[str, Source]) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
        if path.is_dir():
            return topics.read_topics(path, self._topics(path), sources)
        opened = self.open(path)
        places = {}
        for channel, source in sources.items():
            name = opened.match(source.name, f"{path}: data.channels.{channel}.name")
            places[channel] = Place(path, name, source)
        columns = opened.columns([each.name for each in places.values()])
        return channels_of({path: columns}, {path: columns.order}, places)

    def survey(self, path: Path) -> list[Series]:
        return topics.survey_topics(path, self._topics(path)) if path.is_dir() else self.open(path).survey()[0]

    def is_log(self, folder: Path, files: Sequence[Path], names: Sequence[str]) -> bool:
        """Whether the tables of a folder are topics of one run in which there are columns of these names."""
        if self.files != AUTO or len(files) < 2:
            return self.files == topics.TOPICS
        columns = []
        for file in files:
            with suppress(LogFormatError):
                opened = self._topic(file)
                if all(opened.find(name) for name in names):
                    return False
                columns.append(opened.names)
        return topics.several_kinds(columns)

    def _topics(self, folder: Path) -> dict[str, Opened]:
        """Name of a topic, which is that of its file -> its table. Files that are no tables are left out."""
        files = topics.tables_of(folder)
        stems = [file.stem for file in files]
        tables, unread = {}, []
        for file, stem in zip(files, stems, strict=True):
            try:
                tables[stem if stems.count(stem) == 1 else file.name] = self._topic(file)
            except LogFormatError as error:
                unread.append(error)
        if not tables:
            raise unread[0] if unread else LogFormatError(f"{folder}: expected tables, found none: give another folder")
        for each in unread:
            warnings.warn(f"table left out: {each}", stacklevel=6)
        return tables

    def _topic(self, file: Path) -> Opened:
        """One of several tables; without the column that `time` names its stamps are found."""
        if file.stat().st_size == 0:
            raise LogFormatError(f"{file}: expected a table, found an empty file: remove it")
        try:
            return self.open(file)
        except LogFormatError:
            if self.time == AUTO:
                raise
            return replace(self, time=AUTO).open(file)

    def open(self, path: Path) -> Opened:
        """A file whose columns are known."""
        if self.time == AUTO:
            return replace(self.found(path)[0], files=self.files).open(path)
        dialect = self._dialect(path)
        return Opened(path, self, dialect, stamp_columns(path, self.time, dialect), self._only(path, dialect))

    def boats(self, path: Path, column: str) -> dict[str, Table]:
        """Boat -> a reader of its rows, by the texts of a column."""
        dialect = self._dialect(path)
        labels = {*labels_of(path, dialect, match_name(column, dialect.names, f"{path}: data.boat_column"))} - {""}
        return {each.strip("/").replace("/", "_"): replace(self, rows=f"{column}={each}") for each in sorted(labels)}

    def doubt(self, path: Path, jumps: Sequence[int], beside: Sequence[Path]) -> str:
        """What is unsure about the rows of a file whose clock jumps back at these lines, and of others; or ""."""
        return doubt_of(path, self._dialect(path), jumps, beside) if self.rows == AUTO and not path.is_dir() else ""

    def refuse_several(self, files: Sequence[Path]) -> None:
        """Raise a LogFormatError for tables of several boats, as a column tells."""
        if len(files) > 1 and not files[0].is_dir():
            self._only(files[0], self._dialect(files[0]), files)

    def _only(self, path: Path, dialect: Dialect, beside: Sequence[Path] = ()) -> tuple[int, str] | None:
        """The place of the column by which rows are chosen, and its text."""
        if self.rows == AUTO and (kinds := kinds_of(path, dialect, beside)):
            raise refused(path.parent if beside else path, dialect, kinds)
        if self.rows in (AUTO, "all"):
            return None
        column, _, text = self.rows.rpartition("=")
        return dialect.names.index(match_name(column, dialect.names, f"{path}: data.reader.rows")), text

    def _dialect(self, path: Path) -> Dialect:
        """How a file is written, by the options given and by what is found."""
        dialect = find_dialect(path, self.time, self.encoding, self.delimiter, self.comment, self.decimal)
        if "decimal" in dialect.doubts:
            raise LogFormatError(
                f"{path}: expected to find the decimal sign from the numbers, found {dialect.doubts['decimal']}: set "
                "data.reader.decimal"
            )
        if dialect.lacks_header:
            raise no_header(path, dialect)
        return dialect


@dataclass(frozen=True)
class Opened:
    """A table whose header was read; `only` is the place and the text of the column by which rows are chosen."""

    path: Path
    table: Table
    dialect: Dialect
    stamps: list[str]
    only: tuple[int, str] | None

    @cached_property
    def quaternions(self) -> dict[str, Quaternion]:
        """Name of an orientation -> its columns."""
        return quaternions(self.dialect.names)

    @cached_property
    def names(self) -> list[str]:
        """What a `Source` can name: the columns without those of the stamps, and the orientations."""
        return [name for name in self.dialect.names if name and name not in self.stamps] + list(self.quaternions)

    def find(self, pattern: str) -> list[str]:
        """The columns that a `Source` may mean, with or without their unit."""
        bare = Counter(split_unit(name)[0] for name in self.names)
        if pattern not in self.names and bare[pattern] == 1:
            return [next(name for name in self.names if split_unit(name)[0] == pattern)]
        return matching(pattern, dict.fromkeys(self.names))

    def match(self, pattern: str, where: str) -> str:
        """The column that a `Source` names; a LogFormatError where there is none, or several."""
        matches = self.find(pattern)
        return matches[0] if len(matches) == 1 else match_name(pattern, self.names, where)

    def columns(self, names: Sequence[str]) -> Columns:
        """Numbers of columns, with the yaw of orientations."""
        rotations = {name: self.quaternions[name] for name in names if name in self.quaternions}
        plain = [name for name in names if name not in rotations]
        wanted = list(dict.fromkeys([*plain, *(part for each in rotations.values() for part in each.columns)]))
        every = self.dialect.names
        if twice := [name for name in (*self.stamps, *wanted) if every.count(name) > 1]:
            raise LogFormatError(
                f"{self.path}: has several columns {twice[0][:QUOTED]!r}, expected one: rename all but one"
            )
        rows = Rows(self.path, self.dialect, self.stamps, wanted, self.only)
        time, origin = self._seconds(rows)
        yaws = {name: yaw_of([rows.columns[part] for part in each.columns]) for name, each in rotations.items()}
        return Columns(time, origin, rows.order, rows.columns | yaws, rows.torn)

    def _seconds(self, rows: Rows) -> tuple[np.ndarray, float]:
        """Stamps as seconds since the first readable one, and that one, s since 1970, midnight or a start."""
        time, origin = self._as_written(rows)
        if error := not_sorted(self.path, self.dialect, self.stamps, time):
            raise error
        grain = GRAIN if self.table.time_unit == "days" else 1.0
        even, rate = spread(time, origin) if grain == 1 else spread(np.round(time / grain, 3), 0.0)
        if not rate:
            return time, origin
        kind = "whole seconds" if grain == 1 else "rounded"
        text = f"{self.path}: the stamps {self.table.time!r} are {kind}, with {rate:.3g} rows"
        if np.nanmedian(np.diff(np.unique(time))) >= 30:
            raise LogFormatError(f"{text} of each minute, expected seconds: write stamps with seconds")
        warnings.warn(f"{text} each: the rows of a second are spread evenly within it", stacklevel=5)
        return even * grain, origin

    def _as_written(self, rows: Rows) -> tuple[np.ndarray, float]:
        stamps, unit, first = self.table.time, self.table.time_unit, rows.first_stamp[:QUOTED]
        time, kind, doubt = rows.stamps.seconds(self.table.dates, unit == HHMMSS)
        if time is None:
            raise LogFormatError(
                f"{self.path}, line {rows.order[0]}: expected a number or a date-time in the time column {stamps!r}, "
                f"found {first!r}: name the column of the stamps in data.reader.time"
            )
        if doubt:
            raise LogFormatError(
                f"{self.path}: expected to find the order of day, month and year from the column {stamps!r}, found "
                f"{doubt}: set data.reader.dates to one of {', '.join(ORDERS)}"
            )
        if kind != "number":
            return time, rows.stamps.origin
        if unit == "s" and rows.stamps.clock_numbers():
            warnings.warn(
                f"{self.path}: the numbers of {stamps!r} are times of a day, such as {first!r}, but they are read as "
                f"seconds: set data.reader.time_unit={HHMMSS}",
                stacklevel=6,
            )
        declared = self.dialect.units[self.dialect.names.index(self.stamps[0])]
        if declared in TIME_UNITS and declared != unit:
            warnings.warn(
                f"{self.path}: the header declares {self.stamps[0][:QUOTED]!r} in {declared}, but it is read in {unit}"
                f": set data.reader.time_unit={declared}",
                stacklevel=6,
            )
        return time * TIME_UNITS[unit], rows.stamps.origin * TIME_UNITS[unit]

    def survey(self) -> tuple[list[Series], float]:
        """All series of numbers, quaternions by their yaw alone; and the first stamp, as of `Columns.origin`."""
        every = self.dialect.names
        parts = {name for each in self.quaternions.values() for name in each.columns}
        if twice := list(dict.fromkeys(name for name in self.names if name and every.count(name) > 1)):
            warnings.warn(
                f"{self.path}: several columns are called {', '.join(repr(name[:QUOTED]) for name in twice[:3])}, and "
                "none of them is taken: give them different names",
                stacklevel=3,
            )
        columns = self.columns([name for name in self.names if every.count(name) < 2 and name not in parts])
        readable, series, left = np.isfinite(columns.time), list[Series](), list[str]()
        for name in (each for each in list(columns.found) if each not in parts):
            column = columns.found.pop(name)
            known = np.isfinite(column.values)
            if not known.any() and column.first.strip() in HEMISPHERES:
                ones, unit = np.ones(int(readable.sum())), f"hemisphere {column.first.strip()}"
                series.append(Series(name, None, columns.time[readable], ones, columns.order[readable], unit))
            elif known.any() and 2 * known.sum() >= (~column.empty).sum():
                rotation = self.quaternions.get(name)
                unit = rotation.unit if rotation else self.dialect.units[every.index(name)]
                kind = ROTATION if rotation else ROS if ROS_COLUMN.search(name) else ""
                time, value, order = (each[readable] for each in (columns.time, column.values, columns.order))
                series.append(Series(name, None, time, value, order, unit, kind))
            elif not column.empty.all():
                cell = "" if known.any() else f", as {column.first.strip()[:QUOTED]!r}"
                if GEAR.fullmatch(column.first.strip().lower()):
                    ones = np.ones(int(readable.sum()))
                    series.append(Series(name, None, columns.time[readable], ones, columns.order[readable], "gear"))
                left.append(f"{name[:QUOTED]!r} ({known.sum()} of {(~column.empty).sum()}{cell})")
        if left:
            text = f"left out columns whose cells are mostly no numbers: {', '.join(left[:8])}{', …' * (len(left) > 8)}"
            plain = "where there are none, write them without units and signs of thousands"
            warnings.warn(f"{text}: name one in data.channels to read its numbers; {plain}", stacklevel=3)
        return series, columns.origin
