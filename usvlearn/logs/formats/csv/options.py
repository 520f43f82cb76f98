"""Finds the options with which a table is to be read from its first rows, before anybody has named a column."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.channel import QUOTED
from usvlearn.logs.channels.series import OtherBoats
from usvlearn.logs.formats.csv.boats import kinds_of, refused
from usvlearn.logs.formats.csv.dialect import AUTO, UNIT_NAMES, Dialect, find_dialect, no_header, not_sorted, split_unit
from usvlearn.logs.formats.csv.rows import Rows
from usvlearn.logs.formats.csv.stamps import (
    HHMMSS,
    OFTEN,
    ORDERS,
    TIME_UNITS,
    WORD,
    Stamps,
    joined,
    part_of,
    rows_a_second,
)
from usvlearn.logs.formats.csv.topics import TOPICS, tables_of

NAMED = {
    "time", "timestamp", "t", "stamp", "datetime", "date_time", "date time", "date/time", "utc", "zeit", "zeitstempel",
    "uhrzeit", "temps", "heure", "horodatage", "tiempo", "hora", "tempo", "ora", "tid", "tidsstempel", "tijd",
    "tijdstempel", "czas", "aika", "aikaleima", "elapsed", "clock", "epoch", "unix", "ts",
}  # fmt: skip
COUNTERS = {"", "index", "idx", "row", "line", "sample", "frame", "record", "count", "counter", "seq", "sequence",
            "packet", "step", "number", "nr", "no", "n", "i", "k", "id", "unnamed"}  # fmt: skip
PARTS = ("time", "stamp", "zeit")  # of a name that may be one of stamps
RISING = 0.95  # share of the steps of a column of stamps that are not negative
ADVANCING = 0.2  # share of them that are positive
EVEN, FEWEST = -1, 9  # rank of a column that is known only by its even steps, and the least number of these
READABLE = 0.9  # share of its cells that are stamps
# from 1979 to 2128; days of a spreadsheet, of MATLAB, or Julian
EPOCHS = {"s": (3e8, 5e9), "ms": (3e11, 5e12), "us": (3e14, 5e15), "ns": (3e17, 5e18), "days": (2e4, 3e6)}
UNIT_OF_PART = {3: "ms", 6: "us", 9: "ns", "second": "s", "minute": "min", "hour": "h", "day": "days"}
SHORTEST, LONGEST = 0.005, 5.0  # s, usual time between two rows
JOINED = 2.5  # rank of columns that together are stamps


class _Candidate(NamedTuple):
    rank: float
    name: str
    kind: str
    unit: str  # that the header declares
    values: np.ndarray  # since the first
    first: float  # number


def find_options(path: Path, boat: str | None, beside: Sequence[Path]) -> tuple[dict[str, str], list[str]]:
    """The options of `Table` for one table, as found, and a sentence for each unsure one that begins with its key.

    The option `comment` stays "auto". Of a folder of topics, an option that differs between its tables does, too. Where
    this and the tables beside it hold rows of several boats, those of one are read. A LogFormatError where the file is
    no table with a header, or no column can be one of stamps in the order of time.
    """
    if path.is_dir():
        return _of_topics(path)
    dialect = find_dialect(path, AUTO, AUTO, AUTO, AUTO, AUTO)
    if dialect.lacks_header:
        raise no_header(path, dialect)
    unsure = [f"decimal: found {doubt}; '.' is assumed" for doubt in dialect.doubts.values()]
    if (count := len(dialect.sample)) < 2:
        seen = "a header and no rows" if not count else "a header and a single row"
        raise LogFormatError(
            f"{path}: expected a table with a header, a column of stamps and two rows or more, found {seen}: "
            "leave it out"
        )
    if kinds := kinds_of(path, dialect, beside):
        label = next((each for each in kinds.values if boat is not None and each.strip("/") == boat), None)
        if kinds.number or label is None:
            raise refused(path.parent if len(beside) > 1 else path, dialect, kinds)
        place = dialect.names.index(kinds.column)
        dialect = dialect._replace(sample=[row for row in dialect.sample if row[place].strip() == label])
        if not dialect.sample:
            raise OtherBoats(f"{path}: found no row with {label!r} among the first ones: leave it out")
    advancing, counters = _candidates(path, dialect)
    candidates = sorted(advancing, key=lambda each: -each.rank)
    if not candidates:
        listing = ", ".join(repr(name[:QUOTED]) for name in dialect.names[:40]) or "(none)"
        listing += f", of which {counters[0]!r} counts rows and does not tell their rate" if counters else ""
        line, sign = dialect.body, {"\t": "\\t", " ": "[ \\t]+"}.get(dialect.delimiter, dialect.delimiter)
        raise LogFormatError(
            f"{path}: expected a table with a header and a column of stamps that rise, found the columns {listing}: "
            "name the column of the stamps, or those of their parts (secs+nsecs), in data.reader.time; or add a column "
            f"of seconds, as for 10 rows a second: awk -F'{sign}' -v OFS='{dialect.delimiter}' "
            f"'{{print (NR > {line} ? (NR - {line + 1}) / 10 : \"time\"), $0}}' {path.name} > timed.csv"
        )
    best = candidates[0]
    if best.rank < 0:
        unsure.append(f"time: found no column that is called so; {best.name!r} is the first one that rises evenly")
    elif not _advances(best.values):
        unsure.append(f"time: found {best.name!r}, whose stamps repeat, as whole seconds do at a higher rate")
    rivals = [each.name for each in candidates[1:] if each.rank == best.rank >= 0]
    if rivals:
        unsure.append(f"time: found {best.name!r}, but the stamps may also be {' or '.join(map(repr, rivals[:3]))}")
    unit, unclear = _time_unit(best)
    options = {"time": best.name, **{name: getattr(dialect, name) for name in ("delimiter", "decimal", "encoding")}}
    again = find_dialect(path, best.name, dialect.encoding, dialect.delimiter, AUTO, dialect.decimal)
    only = None
    if kinds and label is not None:
        only, options["rows"] = (again.names.index(kinds.column), label), f"{kinds.column}={label}"
    stamps = Rows(path, again, stamp_columns(path, best.name, again), [], only).stamps
    _, kind, doubt = stamps.seconds(AUTO)
    if doubt:
        unsure.append(f"dates: found {doubt}; {kind} is assumed")
    if kind == "number" and stamps.clock_numbers():
        return {**options, "time_unit": HHMMSS}, unsure
    if unclear:
        unsure.append(f"time_unit: {unclear}")
    return {**options, "time_unit": unit} | ({"dates": kind} if kind in ORDERS else {}), unsure


def stamp_columns(path: Path, time: str, dialect: Dialect) -> list[str]:
    """The columns of the stamps, one or more, by their names with or without a unit."""
    names = [name for name in dialect.names if name]
    parts = [time] if time in names else [part.strip() for part in time.split("+")]
    bare = [split_unit(name)[0] for name in names]
    for place, part in enumerate(parts):
        if part not in names and bare.count(part) == 1:
            parts[place] = names[bare.index(part)]
        elif part not in names:
            raise LogFormatError(_no_time_column(path, part, names, dialect.delimiter))
    return parts


def _no_time_column(path: Path, time: str, names: list[str], delimiter: str) -> str:
    listing = ", ".join(repr(name[:QUOTED]) for name in names[:40]) + (", ..." if len(names) > 40 else "")
    message = f"{path}: expected a time column {time!r}, found the columns {listing or '(none)'}: "
    if len(names) < 2:
        return message + f"set data.reader.delimiter if {delimiter!r} does not separate its cells"
    return message + "name one of them in data.reader.time"


def _of_topics(folder: Path) -> tuple[dict[str, str], list[str]]:
    tables: list[dict[str, str]] = []
    unsure: dict[str, None] = {}
    failed: LogFormatError | None = None
    for file in tables_of(folder):
        try:
            options, doubts = find_options(file, None, ())
        except LogFormatError as error:
            failed = failed or error
            continue
        tables.append({"dates": AUTO, **options})
        unsure |= dict.fromkeys(doubts)
    if not tables:
        raise failed or LogFormatError(f"{folder}: expected tables, found none: give another folder")
    same = {name: tables[0][name] for name in ("delimiter", "decimal", "encoding", "dates")
            if len({each[name] for each in tables}) == 1}  # fmt: skip
    stamps = {(each["time"], each["time_unit"]) for each in tables}
    time, unit = stamps.pop() if len(stamps) == 1 else (AUTO, "s")
    return {"time": time, "time_unit": unit, "files": TOPICS, **same}, list(unsure)


def _candidates(path: Path, dialect: Dialect) -> tuple[list[_Candidate], list[str]]:
    """The columns that may be stamps, one of dates with one of times; and those that only count the rows."""
    names = [name for name in dialect.names if name and dialect.names.count(name) == 1]
    joins, days = _joins(names)
    candidates: list[_Candidate] = []
    counters, taken, unsorted = list[str](), set[str](), dict[float, LogFormatError]()
    for parts in [*joins, *([name] for name in names)]:
        places, name = [dialect.names.index(part) for part in parts], "+".join(parts)
        several = len(parts) > 1
        cells = [row[places[0]] for row in dialect.sample]
        if several:
            cells = joined(parts, ([row[place] for place in places] for row in dialect.sample))
        stamps = Stamps()
        stamps.add(cells, "." if several else dialect.decimal)
        time, kind, _ = stamps.seconds(AUTO)
        if parts[-1] in taken or time is None or np.isfinite(time).mean() < READABLE:
            continue
        bare, unit = split_unit(name)[0].lower(), _declared(name, dialect.units[places[0]])
        if kind not in ("number", "time") and not any(":" in cell or len(cell.strip()) > 12 for cell in cells):
            days.append(name)
            continue
        rising = np.diff(time[np.isfinite(time)])
        part = any(part in bare for part in PARTS)
        rank: float = 4 * (kind != "number") + 3 * (bare in NAMED) + 2 * part + (unit in TIME_UNITS)
        distinct = len(np.unique(time)) > READABLE * len(time)
        if rank > 1 and distinct and (error := not_sorted(path, dialect, parts, time)):
            unsorted[rank] = error
        if not len(rising) or (rising >= 0).mean() < RISING or not (rising > 0).any():
            continue
        rank = rank if rank and (_advances(time) or kind != "number") else EVEN if _is_even(rising) else 0
        if several:
            rank, unit, taken = JOINED, "s", taken | {*parts}
        if rank == EVEN and ({*WORD.findall(bare)} <= COUNTERS or (rising == 1).mean() >= RISING):
            counters.append(name)
        elif rank:
            candidates.append(_Candidate(rank, name, kind, unit, time, stamps.origin))
    for k, each in enumerate(candidates):
        if each.kind == "time" and days:
            candidates[k] = each._replace(name=f"{days[0]}+{each.name}", rank=each.rank + 4)
    if unsorted and max(unsorted) > max((each.rank for each in candidates), default=EVEN):
        raise unsorted[max(unsorted)]
    return candidates, counters


def _joins(names: list[str]) -> tuple[list[list[str]], list[str]]:
    """The columns that may be a stamp together, up to its fraction; and a date in three columns without a time."""
    groups: dict[tuple[str, ...], dict[str | int | None, str]] = {}
    for name in names:
        others = part_of(name)[1]
        group = groups.setdefault(others, {})
        group.setdefault(part_of(name, group)[0], name)
    date, clock = ("year", "month", "day"), ("hour", "minute", "second")
    dates = [[group[part] for part in date] for group in groups.values() if {*date} <= group.keys()][:1]
    joins = []
    for others, group in groups.items():
        fraction = [group[part] for part in (3, 6, 9) if part in group][:1]
        if {*clock} <= group.keys():
            joins.append([*(dates[0] if dates else []), *(group[part] for part in clock), *fraction])
        elif fraction and "second" in group:
            joins.append([group["second"], *fraction])
        elif fraction and not others:
            joins += [[name, *fraction] for name in names if name.lower() in NAMED]
    return joins, [] if any(len(each) > 2 for each in joins) else ["+".join(each) for each in dates]


def _declared(name: str, unit: str) -> str:
    """The unit of stamps that a header or the name of their column declares, as in "Time (hours)", "t_min"."""
    part, others = part_of(unit or name)
    telling = unit not in UNIT_NAMES and {*others} <= NAMED and (unit or others or len(name) > 2)
    return UNIT_OF_PART.get(part, unit) if telling else unit


def _advances(stamps: np.ndarray) -> bool:
    """Whether enough of the steps are no repetitions, or they repeat as whole seconds do."""
    known = stamps[np.isfinite(stamps)]
    return bool((np.diff(known) > 0).mean() >= ADVANCING) or rows_a_second(known) >= OFTEN


def _is_even(steps: np.ndarray) -> bool:
    """Whether a column rises at an even rate, as stamps do whatever they are called."""
    usual = float(np.median(steps))
    return len(steps) >= FEWEST and usual > 0 and bool((np.abs(steps - usual) <= 0.5 * usual).mean() >= RISING)


def _time_unit(stamps: _Candidate) -> tuple[str, str]:
    """The unit of the stamps, and a doubt or ""."""
    if stamps.kind != "number":
        return "s", ""
    if stamps.unit in TIME_UNITS:
        return stamps.unit, ""
    steps = np.diff(stamps.values[np.isfinite(stamps.values)])
    step = float(np.median(steps[steps > 0]))
    usual = [unit for unit, factor in TIME_UNITS.items() if SHORTEST <= factor * step <= LONGEST]
    for unit in usual:
        if unit in EPOCHS and EPOCHS[unit][0] <= stamps.first <= EPOCHS[unit][1]:
            return unit, ""
    if stamps.first in (0, 1) and (steps == 1).all():
        return "s", f"found {stamps.first:g}, {stamps.first + 1:g}, …: seconds, or rows, to divide by their rate, Hz"
    fine = [unit for unit in usual if unit not in ("min", "h", "days")]
    minutes = "min" in usual and _digits(60 * step) < min(3, _digits(step))  # rounder than seconds
    fractions = (np.abs(steps - np.round(steps)) > 1e-9).any()
    if fine and not minutes and (len(fine) == 1 or (fractions and fine[0] == "s")):
        return fine[0], ""
    may = fine + (["min"] if minutes else []) if fine else ["s", *usual]
    best = fine[0] if fine else "min" if minutes else next((each for each in ("days", "h") if each in usual), "s")
    return best, f"found steps of {step:g}, which may be {' or '.join(may)}; {best} is assumed"


def _digits(value: float) -> int:
    """Significant digits, of four at most."""
    return len(f"{value:.3e}".split("e")[0].replace(".", "").rstrip("0"))
