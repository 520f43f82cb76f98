"""Finds how a table of text is written from its first lines: encoding, delimiter, comments, header, decimal sign.

Each choice is the same for the same file. Where the file does not tell, the choice comes with a doubt, in words.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usvlearn.errors import LogFormatError
from usvlearn.logs.formats.csv.packed import open_table

AUTO = "auto"
HEAD = 1 << 18  # bytes that are looked at
LINES = 1000  # and lines
FEWEST, MIXED = 8, 0.05  # steps, and share of them that go back in time, from which rows are in no order
KEYED = re.compile(r"\b([A-Za-z_]\w*)\s*[=:]\s*(?=[-.\d])")  # a name beside its number, as in t=12.5
DELIMITERS = (",", ";", "\t", "|", " ")
COMMENTS = ("#", "%", "//")
NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|nan|[+-]?inf", re.IGNORECASE)
CLOCK = r"\d{1,3}:\d\d(:\d\d)?([.,:]\d+)?(\s*[AP]\.?M\.?)?"
STAMP = re.compile(rf"\d{{1,4}}[-./]\d{{1,2}}[-./]\d{{1,4}}([ T]+{CLOCK}\s*(Z|[+-]\d\d:?\d\d)?)?|{CLOCK}", re.I)
COMMA = re.compile(r"[+-]?\d*(\.\d{3})*,\d+([eE][+-]?\d+)?")  # a decimal comma, perhaps with points at thousands
POINT = re.compile(r"[+-]?\d*(,\d{3})*\.\d+([eE][+-]?\d+)?|[+-]?\d{1,3}(,\d{3}){2,}")  # or commas at thousands
EITHER = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")  # one of both
GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}(\.\d{3})+")  # points at thousands beside decimal commas, else a decimal point

UNIT_NAMES = {
    "1": ("1", "-"),
    "percent": ("%", "percent", "pct", "prozent", "pourcent", "procent", "prosent", "percento", "porcentaje"),
    "m/s": ("m/s", "m/sec", "mps", "m_s", "ms-1", "m s-1", "ms^-1"),
    "cm/s": ("cm/s", "cm_s"),
    "mm/s": ("mm/s", "mm_s"),
    "mph": ("mph", "mi/h"),
    "ft/s": ("ft/s", "fps", "ft_s", "ft/sec"),
    "km/h": ("km/h", "kmh", "kph", "kmph", "km_h", "km/t", "km/u"),
    "knots": ("kn", "kt", "kts", "knot", "knots", "knoten", "nœuds", "noeuds", "nœud", "noeud", "nudos", "nodi", "nós",
              "knopen", "knop", "knob", "węzły", "węzłów", "solmua"),
    "deg": ("deg", "degs", "degree", "degrees", "°", "grad", "degré", "degrés", "degres", "grados", "gradi", "graus",
            "graden", "grader", "stopnie", "stopni", "asteet"),
    "rad": ("rad", "rads", "radian", "radians"),
    "deg/s": ("deg/s", "deg/sec", "°/s", "dps", "deg_s", "degps"),
    "deg/min": ("deg/min", "°/min", "deg_min", "degpm"),
    "ddmm": ("ddmm", "ddmm.mmmm", "dddmm.mmmm", "ddmm.mm", "dddmm.mm", "ddmm.mmm", "dddmm.mmm"),
    "rad/s": ("rad/s", "rad/sec", "rad_s", "radps"),
    "s": ("s", "sec", "secs", "second", "seconds", "sek", "sekunden", "secondes", "segundos", "secondi", "seconden",
          "sekunder"),
    "ms": ("ms", "msec", "millis", "milliseconds"),
    "us": ("us", "µs", "μs", "usec", "micros", "microseconds"),
    "ns": ("ns", "nsec", "nanos", "nanoseconds"),
    "m": ("m", "metre", "metres", "meter", "meters"),
    "N·m": ("n·m", "n m", "n*m", "n.m", "nm"),
}  # fmt: skip
UNIT_OF = {alias: unit for unit, aliases in UNIT_NAMES.items() for alias in aliases}
BRACKETED = re.compile(r"(.*\S)\s*(?:\(([^()]*)\)|\[([^\[\]]*)\])")


class Dialect(NamedTuple):
    """How a table is written."""

    encoding: str
    delimiter: str
    comment: tuple[str, ...]  # what begins a line that is skipped
    decimal: str
    names: list[str]  # cells of the header
    units: list[str]  # of the columns, "" where none is declared
    body: int  # lines up to the end of the header
    sample: list[list[str]]  # the first rows of cells, as many as the header has
    doubts: dict[str, str]  # option that was not decidable -> what was found

    @property
    def lacks_header(self) -> bool:
        """Whether no line, or each one, names the columns."""
        return not self.names if self.sample else bool(KEYED.search(" ".join(self.names)))


def split_unit(name: str) -> tuple[str, str]:
    """The name of a column without its unit, and the unit, in the words of `UNITS` where it is one of them."""
    if match := BRACKETED.fullmatch(name):
        unit = (match[2] or match[3] or "").strip()
        return match[1], UNIT_OF.get(unit.lower(), unit)
    first, _, last = name.rpartition(" ")
    if first.strip() and "/" in last and last.lower() in UNIT_OF:  # other last words may belong to the name
        return first.strip(), UNIT_OF[last.lower()]
    parts = name.split("_")
    for count in (2, 1):
        unit = "_".join(parts[-count:]).lower()
        if len(parts) > count and unit in UNIT_OF and unit != "1" and all(parts):
            return "_".join(parts[:-count]), UNIT_OF[unit]
    return name, ""


def find_dialect(path: Path, time: str, encoding: str, delimiter: str, comment: str | None, decimal: str) -> Dialect:
    """How a file is written; an option, also the name of a column of stamps, is as given, or found if it is "auto"."""
    with open_table(path) as file:
        start = file.read(HEAD)
    if encoding == AUTO:
        encoding = _encoding(path, start)
    try:
        text = codecs.getincrementaldecoder(encoding)(errors=errors_of(encoding)).decode(start)
    except UnicodeError as error:
        raise not_text(path, encoding) from error
    return _dialect(tuple(re.split(r"\r\n|\r|\n", text)[:LINES]), time, encoding, delimiter, comment, decimal)


@lru_cache(maxsize=8)  # a log is opened several times: to find its columns, its stamps, its numbers
def _dialect(
    lines: tuple[str, ...], time: str, encoding: str, delimiter: str, comment: str | None, decimal: str
) -> Dialect:
    """How these lines are written."""
    prefixes = _comments(lines) if comment == AUTO else (comment,) if comment else ()
    layouts = [_layout(lines, each, prefixes, time) for each in (DELIMITERS if delimiter == AUTO else delimiter)]
    best = max(layouts, key=lambda each: each.score)
    header = best.rows[best.header] if best.header is not None else []
    names = clean(header)
    if not any(names[best.width :]):  # a delimiter ends the header, but no row
        names = names[: best.width or None]
    units, body = [split_unit(name)[1] for name in names], 0 if best.header is None else best.header + 1
    below = next((k for k in range(body, len(lines)) if lines[k].strip()), None)
    campbell = best.rows[0][:1] == ["TOA5"]  # its header is in line 2, and units in line 3
    if names and below is not None and (campbell or _are_units(best.rows[below], len(names))):
        below_names = [*best.rows[below], *[""] * len(names)]
        units = [unit or _unit(cell) for unit, cell in zip(units, below_names, strict=False)]
        body = below + 1
        while body < len(lines) and 2 * len(set(row := best.rows[body])) <= len(names) and not any(map(is_value, row)):
            body += 1  # such as types
    skip = [bool(prefixes) and line.lstrip().startswith(prefixes) for line in lines]
    rows = [row for row, remark in zip(best.rows[body:], skip[body:], strict=True) if not remark]
    rows = [row for row in rows if len(row) >= max(2, len(names)) and any(map(is_value, row))]
    doubts = {}
    if decimal == AUTO:
        decimal, doubt = find_decimal(cell.strip() for row in rows for cell in row)
        doubts = {"decimal": doubt} if doubt else {}
    return Dialect(encoding, best.delimiter, prefixes, decimal, names, units, body, rows, doubts)


def no_header(path: Path, dialect: Dialect) -> LogFormatError:
    """The error for a table of numbers without names of columns, or with one beside each number, or each row."""
    first = dialect.delimiter.join(dialect.names or dialect.sample[0])
    fault, edit = "none above the first numbers", "'1i time,left,right,heading,speed'"
    if keys := KEYED.findall(first):
        fault = "one beside each number of"
        edit = rf"-E 's/\b[A-Za-z_]\w*\s*[=:]\s*//g; s/[ ,;]+/,/g; 1i {','.join(keys)}'"
    way, rows = f"add such a line, as by sed {edit}", dialect.sample
    if not keys and all(not is_value(row[0]) and len(row) > len(rows) for row in rows):
        fault = "one at the begin of each row, as"
        way = "turn the table, as by python -c 'import csv, sys; "
        way += "csv.writer(sys.stdout).writerows(zip(*csv.reader(sys.stdin)))' <"
    expected = "a header, a line with the names of the columns"
    return LogFormatError(f"{path}: expected {expected}, found {fault} {first[:60]!r}: {way} {path.name} > named.csv")


def not_sorted(path: Path, dialect: Dialect, stamps: list[str], time: np.ndarray) -> LogFormatError | None:
    """The error for rows that are not in the order of their stamps, s; None where most of them are."""
    steps = np.diff(time[np.isfinite(time)])
    if len(steps) < FEWEST or (steps < 0).mean() < MIXED:
        return None
    order, sort = ("no", f".sort_values({stamps!r})") if (steps > 0).any() else ("reverse", ".iloc[::-1]")
    return LogFormatError(
        f"{path}: expected the stamps {'+'.join(stamps)!r} to rise, found the rows in {order} order of time: sort them "
        f"by time: import pandas; pandas.read_csv({path.name!r}, sep={dialect.delimiter!r}, decimal="
        f"{dialect.decimal!r}){sort}.to_csv('sorted.csv', index=False)"
    )


def not_text(path: Path, encoding: str) -> LogFormatError:
    """The error for a file that is not in the encoding that is declared."""
    return LogFormatError(f"{path}: expected text in {encoding}, found other data: set data.reader.encoding")


def errors_of(encoding: str) -> str:
    """How bytes that are no text are read: kept apart, where the encoding can, so that their cell is no number."""
    return "surrogateescape" if codecs.lookup(encoding).name in ("utf-8", "utf-8-sig", "ascii") else "replace"


def find_decimal(cells: Iterator[str] | Sequence[str]) -> tuple[str, str]:
    """The decimal sign of the numbers among cells, and a doubt, or ""."""
    comma = point = either = grouped = ""
    for cell in cells:
        if EITHER.fullmatch(cell):
            either = either or cell
        elif "," in cell and COMMA.fullmatch(cell):
            comma = comma or cell
        elif GROUPED.fullmatch(cell):
            grouped = grouped or cell
        elif POINT.fullmatch(cell):
            point = point or cell
    if comma and point:
        return ".", f"{comma!r} and {point!r}"
    if either and not (comma or point or grouped):
        return ".", f"{either!r}, which may be {either.replace(',', '.')} or {either.replace(',', '')}"
    return ("," if comma else "."), ""


class _Layout(NamedTuple):
    """A head of a file as cells, by one delimiter."""

    delimiter: str
    rows: list[list[str]]
    width: int  # of the rows of numbers
    header: int | None  # its line
    score: tuple[bool, int, float, int]  # the greatest is the best


def _layout(lines: Sequence[str], delimiter: str, comment: tuple[str, ...], time: str) -> _Layout:
    remarks = [bool(comment) and line.lstrip().startswith(comment) for line in lines]
    bare = [line.lstrip("#%/ ") if remark else line for line, remark in zip(lines, remarks, strict=True)]
    rows = [_cells(line, delimiter) for line in bare]
    filled = [sum(1 for cell in row if cell.strip()) for row in rows]
    values = [0 if remark else sum(map(is_value, row)) for row, remark in zip(rows, remarks, strict=True)]
    widths = Counter(len(row) for row, count in zip(rows, values, strict=True) if count and len(row) > 1)
    width = max(widths, key=lambda each: (widths[each], each), default=0)
    counts = [each[:3] for each in zip(rows, values, filled, remarks, strict=True) if each[2] and not each[3]]
    shares = [count / all_ if len(row) == width else 0.0 for row, count, all_ in counts]
    header, named = _header(rows, remarks, values, width, time)
    fits = 0 if header is None else _fits(rows[header], width)
    return _Layout(delimiter, rows, width, header, (named, fits, sum(shares) / max(1, len(shares)), width))


def _header(
    rows: list[list[str]], remarks: list[bool], values: list[int], width: int, time: str
) -> tuple[int | None, bool]:
    """The line of the header, and whether it has the column of the stamps; else it is the one above the numbers."""
    named = [] if time == AUTO else [place for place, row in enumerate(rows) if len(row) > 1 and _has(row, time)]
    if named:
        return max(named, key=lambda place: (_fits(rows[place], width), not remarks[place], -place)), True
    if rows[0][:1] in (["TOA5"], ["TOACI1"]):
        return 1, False
    first = next((k for k, row in enumerate(rows) if values[k] and len(row) == width), len(rows))
    above = [k for k in range(first) if not values[k] and len(rows[k]) > 1 and _fits(rows[k], width)]
    candidates = [k for k in above if not remarks[k]] or above or [k for k in range(first) if rows[k]][:1]
    while len(candidates) > 1 and (
        _are_units(rows[candidates[-1]], len(rows[candidates[-2]]))
        or 2 * len(set(rows[candidates[-1]])) <= len(set(rows[candidates[-2]]))  # types
    ):
        candidates.pop()
    return (candidates[-1] if candidates else None), False


def _has(row: list[str], time: str) -> bool:
    """Whether a row has the name of a column, or the names that a + joins; a unit may follow each."""
    names = clean(row)
    return time in names or {*time.split("+")} <= {*names, *(split_unit(name)[0] for name in names)}


def _fits(row: list[str], width: int) -> int:
    """2 if a header belongs to rows of so many cells, 1 if a delimiter may end one of both, else 0."""
    if width in (len(row), max((k + 1 for k, cell in enumerate(row) if cell.strip()), default=0)):
        return 2
    return int(len(row) > 1 and abs(len(row) - width) == 1)


def clean(header: list[str]) -> list[str]:
    """The names of a header; it may be a comment."""
    names = [name.strip() for name in header]
    return [name.lstrip("#%/ ") for name in names[:1]] + names[1:]


def _cells(line: str, delimiter: str) -> list[str]:
    try:
        return next(csv.reader([" ".join(line.split()) if delimiter == " " else line], delimiter=delimiter), [])
    except csv.Error:
        return []


def is_value(cell: str) -> bool:
    """Whether a cell holds a number or a stamp."""
    cell = cell.strip()
    return bool(NUMBER.fullmatch(cell) or STAMP.fullmatch(cell))


def _unit(cell: str) -> str:
    unit = cell.strip().strip("()[]# ").strip()
    return UNIT_OF.get(unit.lower(), unit)


def _are_units(row: list[str], width: int) -> bool:
    """Whether a row below the header declares units: at least half of its cells are known ones, or in brackets."""
    cells = [cell.strip() for cell in row if cell.strip() not in ("", "1", "-")]
    if not cells or not width - 1 <= len(row) <= width + 1 or any(map(is_value, cells)):
        return False
    return 2 * sum(_unit(cell) in UNIT_NAMES or cell[0] + cell[-1] in ("()", "[]") for cell in cells) >= len(cells)


def _comments(lines: Sequence[str]) -> tuple[str, ...]:
    """The signs at the start of some lines, but of at most half of them, as an identifier of rows could be."""
    filled = [line.lstrip() for line in lines if line.strip()]
    counts = {sign: sum(line.startswith(sign) for line in filled) for sign in COMMENTS}
    return tuple(sign for sign, count in counts.items() if 2 * count <= max(len(filled), 8))


def _encoding(path: Path, start: bytes) -> str:
    if start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if any(b"\0" in line.strip(b"\0") for line in start[:4096].splitlines()):  # a lost write leaves a line of zeros
        raise LogFormatError(
            f"{path}: expected a CSV file in UTF-8, found binary data: choose the data option that fits this file"
        )
    if start.isascii():
        return "utf-8-sig"
    text = codecs.getincrementaldecoder("utf-8")(errors="surrogateescape").decode(start)
    damaged = sum("\udc80" <= sign <= "\udcff" for sign in text)
    return "cp1252" if damaged > sum(sign > "\x7f" for sign in text) - damaged else "utf-8-sig"
