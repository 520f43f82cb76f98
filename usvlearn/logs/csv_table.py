"""Tables of text (`.csv`): a header line, then one row per time step."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from operator import itemgetter
from pathlib import Path
from typing import ClassVar

import numpy as np

from usvlearn.errors import ConfigError, LogFormatError, check_choice
from usvlearn.logs.channel import QUOTED, Channel, Source, build_channel, match_name, parse_numbers

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}


@dataclass(frozen=True)
class Table:
    """Reads a CSV file. `Source.name` is a column.

    A row with more or fewer cells than the header (a torn write) is dropped and counted as `torn_row`.

    Args:
        time: column of the stamps: numbers, or date-times such as `2025-07-24 17:18:48.207`; a date-time
            without a zone is taken as UTC.
        time_unit: unit of stamps that are numbers: s, ms, us or ns.
        delimiter: what separates the cells.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "a.csv"
    ...     _ = path.write_text("stamp,speed\\n5000,1.2\\n5100,\\n5200,1.3\\n")
    ...     channels, dropped = Table("stamp", time_unit="ms").read(path, {"surge": Source("speed")})
    >>> channels["surge"].time, channels["surge"].value, dropped
    (array([0. , 0.2]), array([1.2, 1.3]), {'surge': {'empty': 1}})
    """

    time: str
    time_unit: str = "s"
    delimiter: str = ","

    suffixes: ClassVar[tuple[str, ...]] = (".csv",)

    def __post_init__(self):
        check_choice("data.reader.time_unit", self.time_unit, tuple(TIME_UNITS))
        if len(self.delimiter) != 1:
            raise ConfigError(f"data.reader.delimiter: found {self.delimiter!r}, expected one character")

    def read(self, path: Path, sources: dict[str, Source]) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
        """The channels of a table, and the counts of unusable cells: channel -> cause -> count.

        Args:
            path: the file.
            sources: channel -> where it is found.

        Raises:
            LogFormatError: the file is no table, or lacks a column.
        """
        with path.open("rb") as head:
            start = head.read(4096).splitlines()
            if any(b"\0" in line.strip(b"\0") for line in start):  # a lost write leaves a line of zeros
                raise LogFormatError(
                    f"{path}: expected a CSV file in UTF-8, found binary data: choose the data option that "
                    "fits this file"
                )
        with path.open(encoding="utf-8-sig", errors="surrogateescape", newline="") as file:
            lines = csv.reader(file, delimiter=self.delimiter)
            try:
                return self._parse(path, lines, sources)
            except csv.Error as error:
                raise LogFormatError(
                    f"{path}, line {lines.line_num}: expected cells separated by {self.delimiter!r}, found a "
                    f"{error}: fix or remove that line"
                ) from error

    def _parse(self, path: Path, lines, sources: dict[str, Source]):
        header = [name.strip() for name in next((row for row in lines if row), [])]
        header[:1] = [name.lstrip("# ") for name in header[:1]]
        names = [name for name in header if name]
        if self.time not in names:
            raise LogFormatError(_no_time_column(path, self.time, names, self.delimiter))
        matched = {}
        for channel, source in sources.items():
            where = f"{path}: data.channels.{channel}.name"
            matched[channel] = match_name(source.name, names, where)
        columns = [self.time, *dict.fromkeys(matched.values())]
        if twice := [name for name in columns if header.count(name) > 1]:
            raise LogFormatError(f"{path}: has several columns {twice[0][:QUOTED]!r}, expected one: rename all but one")
        places = [header.index(name) for name in columns]
        order, rows, torn = _rows(path, lines, len(header), itemgetter(*places, places[0]))
        cells = dict(zip(columns, zip(*rows, strict=True), strict=False))  # the getter's last place is spare
        time = self._seconds(path, order, cells[self.time])

        channels, dropped = {}, {}
        for channel, source in sources.items():
            column = cells[matched[channel]]
            channels[channel], dropped[channel] = build_channel(
                f"{path}: {channel}", source, time, parse_numbers(column), order, column
            )
            if torn:
                dropped[channel]["torn_row"] = torn
        return channels, dropped

    def _seconds(self, path: Path, order: list[int], cells: Sequence[str]) -> np.ndarray:
        """Stamps as seconds since the first readable one."""
        stamps, factor = parse_numbers(cells), TIME_UNITS[self.time_unit]
        if not np.isfinite(stamps).any():
            stamps, factor = np.array([_date(cell) for cell in cells]), 1.0
        readable = np.isfinite(stamps)
        if not readable.any():
            raise LogFormatError(
                f"{path}, line {order[0]}: expected a number or a date-time in the time column "
                f"{self.time!r}, found {cells[0][:QUOTED]!r}: name the column of the stamps in data.reader.time"
            )
        return factor * (stamps - stamps[readable][0])


def _rows(path: Path, lines, width: int, wanted: itemgetter) -> tuple[list[int], list[tuple], int]:
    """Line numbers and wanted cells of the complete rows, and the number of torn rows."""
    order, rows, torn = [], [], 0
    first = ""
    for row in lines:
        if len(row) == width or (len(row) > width and not any(row[width:])):
            order.append(lines.line_num)
            rows.append(wanted(row))
        elif row:
            first = first or f", found {len(row)} in line {lines.line_num}"
            torn += 1
    if not rows:
        what = first or ", found nothing below the header"
        raise LogFormatError(
            f"{path}: expected rows of {width} cells, as many as the header has{what}: fix the header, or "
            "leave this log out"
        )
    return order, rows, torn


def _date(cell: str) -> float:
    """Unix seconds of an ISO 8601 date-time, NaN if it is none."""
    try:
        stamp = datetime.fromisoformat(cell.strip().replace("/", "-"))
    except ValueError:
        return np.nan
    return (stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)).timestamp()


def _no_time_column(path: Path, time: str, names: list[str], delimiter: str) -> str:
    listing = ", ".join(repr(name[:QUOTED]) for name in names[:40]) + (", ..." if len(names) > 40 else "")
    message = f"{path}: expected a time column {time!r}, found the columns {listing or '(none)'}: "
    if len(names) == 1:
        return message + f"set data.reader.delimiter if {delimiter!r} does not separate its cells"
    return message + "name one of them in data.reader.time"
