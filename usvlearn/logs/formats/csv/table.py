"""Tables of text (`.csv`, `.tsv`): a header line, then one row per time step."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from usvlearn.errors import ConfigError, LogFormatError, check_choice
from usvlearn.logs.channels.channel import Channel, Source, match_name
from usvlearn.logs.channels.series import Reader, Series
from usvlearn.logs.formats.csv import topics
from usvlearn.logs.formats.csv.boats import doubt_of, kinds_of, labels_of, refused
from usvlearn.logs.formats.csv.dialect import AUTO, Dialect, find_dialect, no_header
from usvlearn.logs.formats.csv.opened import OpenedTable
from usvlearn.logs.formats.csv.options import find_options, stamp_columns
from usvlearn.logs.formats.csv.rows import Place, channels_of
from usvlearn.logs.formats.csv.stamps import HHMMSS, ORDERS, TIME_UNITS


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
    def of_file(cls, path: Path, boat: str | None = None, beside: Sequence[Path] = ()) -> tuple[Table, list[str]]:
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

    def _topics(self, folder: Path) -> dict[str, OpenedTable]:
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

    def _topic(self, file: Path) -> OpenedTable:
        """One of several tables; without the column that `time` names its stamps are found."""
        if file.stat().st_size == 0:
            raise LogFormatError(f"{file}: expected a table, found an empty file: remove it")
        try:
            return self.open(file)
        except LogFormatError:
            if self.time == AUTO:
                raise
            return replace(self, time=AUTO).open(file)

    def open(self, path: Path) -> OpenedTable:
        """A file whose columns are known."""
        if self.time == AUTO:
            return replace(self.of_file(path)[0], files=self.files).open(path)
        dialect = self._dialect(path)
        stamps, only = stamp_columns(path, self.time, dialect), self._only(path, dialect)
        return OpenedTable(path, self.time, self.time_unit, self.dates, dialect, stamps, only)

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
