"""A table whose header was read: its columns by name, and their numbers."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.channel import QUOTED, match_name, matching
from usvlearn.logs.channels.series import Series
from usvlearn.logs.formats.csv.dialect import Dialect, not_sorted, split_unit
from usvlearn.logs.formats.csv.rows import Columns, Quaternion, Rows, quaternions, yaw_of
from usvlearn.logs.formats.csv.stamps import HHMMSS, ORDERS, TIME_UNITS, spread

GEAR = re.compile("f|fwd|for.*|ahead|d|drive|neutral.*|stop|r|rev.*|astern|back.*|vor.*|zurück|rück.*|avant|arrière")
HEMISPHERES = ("N", "S", "E", "W")  # cells of a column beside a latitude or a longitude
GRAIN = 0.864  # s, of days with five decimals, as a spreadsheet writes them
ROTATION, ROS = "quaternion", "geometry_msgs"  # kinds of series
ROS_COLUMN = re.compile(r"(^|[./])(linear|angular|angular_velocity|linear_acceleration)[./][xyz]$")


@dataclass(frozen=True)
class OpenedTable:
    """A table whose header was read; `only` is the place and the text of the column by which rows are chosen."""

    path: Path
    time: str  # the options of `Table`
    time_unit: str
    dates: str
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
        grain = GRAIN if self.time_unit == "days" else 1.0
        even, rate = spread(time, origin) if grain == 1 else spread(np.round(time / grain, 3), 0.0)
        if not rate:
            return time, origin
        kind = "whole seconds" if grain == 1 else "rounded"
        text = f"{self.path}: the stamps {self.time!r} are {kind}, with {rate:.3g} rows"
        if np.nanmedian(np.diff(np.unique(time))) >= 30:
            raise LogFormatError(f"{text} of each minute, expected seconds: write stamps with seconds")
        warnings.warn(f"{text} each: the rows of a second are spread evenly within it", stacklevel=5)
        return even * grain, origin

    def _as_written(self, rows: Rows) -> tuple[np.ndarray, float]:
        stamps, unit, first = self.time, self.time_unit, rows.first_stamp[:QUOTED]
        time, kind, doubt = rows.stamps.seconds(self.dates, unit == HHMMSS)
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
        for name in (each for each in list(columns.by_name) if each not in parts):
            column = columns.by_name.pop(name)
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
