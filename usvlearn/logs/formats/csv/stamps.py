"""The stamps of a table: numbers, date-times in the order year-month-day, day-month-year or month-day-year, or times.

A column has one kind of stamps: the one that most of its cells have. Other cells are unreadable.
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Sequence
from datetime import date, datetime

import numpy as np

from usvlearn.logs.channels.channel import parse_numbers

ORDERS = ("year_first", "day_first", "month_first")
NUMBER, YEAR_FIRST, OTHER_DATE, CLOCK, UNREADABLE = range(5)
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "days": 86400.0}
HHMMSS = "hhmmss"  # in place of a unit: times of a day as numbers
SWAPPED = str.maketrans(",.", ".,")
DAY = 86400.0  # s
MIDNIGHT = datetime(1970, 1, 1)
EPOCH = MIDNIGHT.toordinal()
OFTEN, FEW = 1.25, 4  # rows of one whole second, from which they are no duplicates; and the least number of rows
CERTAIN = 0.99  # share of the telling dates that agree
TIME = r"(\d{1,3}):(\d\d)(?::(\d\d)(?:[.,:](\d+))?)?\s*(?:([AaPp])\.?[Mm]\.?)?"
ONLY_TIME = re.compile(rf"\s*{TIME}\s*")
DATE_TIME = re.compile(rf"\s*(\d{{1,2}})([-./])(\d{{1,2}})\2(\d{{4}}|\d\d)(?:[ T,;]+{TIME})?\s*(Z|[+-]\d\d:?\d\d)?\s*")
ISO = re.compile(r"\s*\d{4}-\d\d-\d\d[ T]\d\d:")
YEARLY = re.compile(  # 2024/6/3 9:15:00.25, 20240603091500.25, 20240603091500250
    r"\s*((?:19|20)\d\d)(\D?)(\d\d?)\2(\d\d?)\D?(\d\d?)(\D?)(\d\d)\6(\d\d)[.,:]?(\d*)\s*Z?\s*"
)
MINUTES = re.compile(r"\s*(\d{1,4}):(\d\d[.,]\d+)\s*")  # and seconds, as a spreadsheet shows them
SHARED = 30  # rows of one minute, from which 12:34 is hours and minutes
WORD = re.compile(r"[^\W\d_]+")
MONTHS = ("jan ene gen", "feb fév", "mar mär mrz mrt maa", "apr avr abr", "may mai mei maj mag", "jun juin giu",
          "jul juil lug", "aug aoû aou ago", "sep set", "oct okt out ott", "nov", "dec dez déc des dic")  # fmt: skip
MONTH_OF = {word: number for number, words in enumerate(MONTHS, 1) for word in words.split()}
PARTS: dict[str | int, str] = {  # of a stamp, each in a column of its own: words of its name; a fraction has digits
    "year": "year yr yyyy yy jahr année annee an año ano anno jaar", "hour": "hour hr hh h stunde heure hora ora uur",
    "minute": "minute min mn mi mm m minuto minuut", "month": "month mon mo mm monat mois mes mês mese maand måned",
    "second": "second sec sc ss s sekunde seconde segundo secondo sekund", 3: "millisecond millisec milli msec ms",
    "day": "day dd dy d jour día dia tag tage giorno dag", 6: "microsecond microsec micro usec us µs μs",
    9: "nanosecond nanosec nano nsec ns",
}  # fmt: skip
PART_OF = {word: part for part, words in PARTS.items() for word in words.split()}
SIGNS = {"year": " ", "month": "-", "day": "-", "hour": " ", "minute": ":", "second": ":"}
WRAPS = (2.0**32, 2.0**32 / 1e3, 2.0**32 / 1e6, 604800.0, 604800e3, DAY, DAY * 1e3)  # counters, GPS weeks, days


def parse_cells(cells: Sequence[str], decimal: str) -> np.ndarray:
    """Cells as float64, NaN where a cell is not a number with this decimal sign."""
    return parse_numbers(cells if decimal == "." else [cell.translate(SWAPPED) for cell in cells])


class Stamps:
    """Takes the cells of the stamps block by block, and converts them when all are known."""

    def __init__(self) -> None:
        self._kinds: list[np.ndarray] = []
        self._values: list[np.ndarray] = []  # number, s since 1970, or s since midnight
        self._dates: list[np.ndarray] = []  # (n, 3) first, second, year; of OTHER_DATE
        self._dotted = False  # dates are written with points
        self._halves = False  # times of dates are AM or PM
        self._minutes = self._seconds = False  # some times are minutes:seconds.fraction; some have seconds
        self.origin = 0.0  # the first readable stamp, as a number, or in s since 1970 or midnight; of `seconds`

    def add(self, cells: Sequence[str], decimal: str = ".") -> None:
        """Take the next cells."""
        values = parse_cells(cells, decimal)
        kinds = np.where(np.isfinite(values), np.int8(NUMBER), np.int8(UNREADABLE))
        dates = np.zeros((len(cells), 3), np.int16)
        for place in np.flatnonzero(values > 1.9e13).tolist():  # 14, 17 or 20 digits are of no unit of time
            digits, stamp = re.split("[.,]", cells[place].strip())[0], _iso(cells[place])
            if len(digits) in (14, 17, 20) and np.isfinite(stamp):
                kinds[place], values[place] = YEAR_FIRST, stamp
        texts = np.flatnonzero(kinds == UNREADABLE)
        values[texts] = [_iso(cells[place]) for place in texts.tolist()]
        kinds[texts[np.isfinite(values[texts])]] = YEAR_FIRST
        if len(texts := np.flatnonzero(kinds == UNREADABLE)):
            parsed = zip(*[self._text(cells[place]) for place in texts.tolist()], strict=True)
            kinds[texts], values[texts], dates[texts] = (list(each) for each in parsed)
        self._kinds.append(kinds)
        self._values.append(values)
        self._dates.append(dates if (kinds == OTHER_DATE).any() else np.broadcast_to(np.int16(0), dates.shape))

    def _text(self, cell: str) -> tuple[int, float, tuple[int, int, int]]:
        """Kind, value and date of a cell that is no number and not in ISO 8601."""
        none = (0, 0, 0)
        if match := ONLY_TIME.fullmatch(cell):
            self._seconds |= match[3] is not None
            return CLOCK, _seconds(*match.groups()), none
        if match := MINUTES.fullmatch(cell):
            self._minutes = True
            return CLOCK, 60.0 * int(match[1]) + float(match[2].replace(",", ".")), none
        if match := DATE_TIME.fullmatch(cell):
            first, sign, second, year, *clock, zone = match.groups()
            seconds = _seconds(*clock) - _offset(zone) if clock[0] else 0.0
            self._dotted |= sign == "."
            self._halves |= clock[4] is not None
            return OTHER_DATE, seconds, (int(first), int(second), int(year) + 2000 * (len(year) == 2))
        stamp = _named(cell)
        return YEAR_FIRST if np.isfinite(stamp) else UNREADABLE, stamp, none

    def clock_numbers(self) -> bool:
        """Whether the stamps are times of a day written as a number, HHMMSS or HHMMSS.s.

        They never have 60 to 99 as minutes or seconds, and a minute goes on by 41 after its 59th second.
        """
        kinds, values = np.concatenate(self._kinds), np.concatenate(self._values)
        values = values[(kinds == NUMBER) & np.isfinite(values)]
        if len(values) < 2 or np.isnan(_of_number(values)).any():
            return False
        full = np.flatnonzero(np.diff(values // 100))
        return bool(
            len(full) and (values[full] % 100 >= 50).mean() > 0.8 and (values[full + 1] % 100 < 10).mean() > 0.8
        )

    def seconds(self, order: str, clock: bool = False) -> tuple[np.ndarray | None, str, str]:
        """Stamps as seconds since the first readable one; numbers in their unit; None if none is readable.

        Dates have an order of `ORDERS`, or "auto"; with `clock`, numbers are times of a day, HHMMSS. Then come the kind
        ("number", "time" or one of `ORDERS`), and a doubt about the order, or "".
        """
        kinds, values = np.concatenate(self._kinds), np.concatenate(self._values)
        values = np.where(np.isfinite(values), values, np.nan)
        counts = np.bincount(kinds[np.isfinite(values)], minlength=5)[:UNREADABLE]
        if not counts.any():
            return None, "", ""
        kind, doubt = int(counts.argmax()), ""
        values[kinds != kind] = np.nan
        if kind == NUMBER and clock:
            kind, values, self._seconds = CLOCK, _of_number(values), True
        name = ("number", "year_first", order, "time")[kind]
        if kind == OTHER_DATE:
            dates = np.concatenate(self._dates)
            if order not in ORDERS[1:]:
                name, doubt = self._order(dates[np.isfinite(values)])
                doubt = doubt if order == "auto" else "dates that do not begin with the year"
            values += DAY * _days(dates, name)
        readable = np.flatnonzero(np.isfinite(values))
        if not len(readable):
            return None, name, doubt
        if kind == CLOCK:
            values[readable] = self._clock(values[readable])
        elif kind == NUMBER:
            values[readable] = unwrapped(values[readable])
        self.origin = float(values[readable[0]])
        return values - self.origin, name, doubt

    def _clock(self, values: np.ndarray) -> np.ndarray:
        """Times that go on past midnight, and minutes and seconds past an hour."""
        if not (self._minutes or self._seconds) and len(values) < SHARED * (1 + np.count_nonzero(np.diff(values))):
            self._minutes, values = True, values / 60
        return np.unwrap(values, period=3600.0 if self._minutes else DAY)

    def _order(self, dates: np.ndarray) -> tuple[str, str]:
        """The order of day and month, from all dates."""
        first, second = (dates[:, :2] > 12).sum(0)
        if first or second:
            share = max(first, second) / (first + second)
            order = "day_first" if first >= second else "month_first"
            return order, "" if share >= CERTAIN else "dates of which some have no month in either order"
        one_day = len(np.unique(dates, axis=0)) == 1  # on which either order gives the same times
        if self._dotted or (one_day and not self._halves):
            return "day_first", ""
        one, other = (dates[place].tolist() for place in (0, -1))
        shown = " to ".join(f"{a}/{b}/{year}" for a, b, year in (one, other))
        return ("day_first", "month_first")[self._halves], f"dates from {shown}, with the day or the month first"


def spread(time: np.ndarray, origin: float) -> tuple[np.ndarray, float]:
    """Stamps of whole seconds that repeat, spread: row k of the n rows of a second is k/n s later.

    The rate of rows is taken as even within each second, so a row may be up to a second off. It needs all rows of a
    second, as only a log has them. `origin` is that of the time 0, s. The second value is the mean number of rows
    of a second, or 0 where nothing was changed.
    """
    readable = np.flatnonzero(np.isfinite(time))
    rate = rows_a_second(time[readable] + origin)
    if rate < OFTEN:
        return time, 0.0
    begins = np.flatnonzero(np.append(True, np.diff(time[readable]) != 0))
    counts = np.diff(np.append(begins, len(readable)))
    place = np.arange(len(readable)) - np.repeat(begins, counts)
    even = time.copy()
    even[readable] += place / np.repeat(counts, counts)
    return even, rate


def rows_a_second(stamps: np.ndarray) -> float:
    """The mean number of rows with one stamp, where all stamps are whole seconds; else 0."""
    if len(stamps) < FEW or (stamps != np.floor(stamps)).any():
        return 0.0
    changes = int((np.diff(stamps) != 0).sum())
    return len(stamps) / (changes + 1) if changes else 0.0


def _iso(cell: str) -> float:
    """Seconds since 1970 of a date-time that begins with the year; NaN if it is none."""
    if not ISO.match(cell) and (match := YEARLY.fullmatch(cell)):
        year, _, month, day, hour, _, minute, second, rest = match.groups()
        cell = f"{year}-{month:0>2}-{day:0>2}T{hour:0>2}:{minute}:{second}.{rest or 0}"
    try:
        stamp = datetime.fromisoformat(cell.strip().replace("/", "-"))
    except ValueError:
        return np.nan
    return stamp.timestamp() if stamp.tzinfo else (stamp - MIDNIGHT).total_seconds()


def _seconds(hour: str, minute: str, second: str | None, fraction: str | None, half: str | None) -> float:
    """Seconds since midnight; NaN if there is no such time."""
    hours = int(hour)
    if half:
        if not 1 <= hours <= 12:
            return np.nan
        hours = hours % 12 + 12 * (half in "Pp")
    if int(minute) > 59 or int(second or 0) > 60:
        return np.nan
    return 3600.0 * hours + 60 * int(minute) + int(second or 0) + float(f"0.{(fraction or '0')[:18]}")


def _named(cell: str) -> float:
    """Seconds since 1970 of a date with the name of its month, such as 03-Jun-2024 09:15:00; NaN if it is none."""
    words = (word for each in WORD.findall(cell.lower()) for word in (each[:4], each[:3]))
    months = [MONTH_OF[word] for word in words if word in MONTH_OF]
    clock = re.search(rf"(?<!\d){TIME}", cell)
    numbers = re.findall(r"\d+", cell.replace(clock[0], " ", 1) if clock else cell)
    if not months or not 1 <= len(numbers) <= 2 or max(map(len, numbers)) > 4:
        return np.nan
    day, year = sorted([*numbers, "2000"][:2], key=lambda each: len(each) == 4)  # syslog has no year
    days = _days(np.array([[int(day), months[-1], int(year) + 2000 * (len(year) == 2)]]), "day_first")
    return float(days[0]) * DAY + (_seconds(*clock.groups()) if clock else 0.0)


@np.errstate(all="ignore")
def unwrapped(stamps: np.ndarray) -> np.ndarray:
    """Numbers of a counter that begins anew, such as one of 32 bits, as if it went on."""
    steps = np.diff(stamps)
    if not (steps < 0).any() or not (steps > 0).any():
        return stamps
    begins, most = np.zeros(len(stamps)), 5 * np.median(steps[steps > 0])
    for period in WRAPS:
        begins[1:] += period * ((steps < -period / 2) & (steps + period <= most) & (steps + period > 0))
    return stamps + np.cumsum(begins)


def part_of(name: str, before: Container[str | int | None] = ()) -> tuple[str | int | None, tuple[str, ...]]:
    """Which of `PARTS` the name of a column tells, if any, and its other words."""
    words = tuple(WORD.findall(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()))
    for place, word in reversed([*enumerate(words)]):
        if part := PART_OF.get(word) or PART_OF.get(word[:-1] if word[-1] in "sn" else ""):
            part = "minute" if word == "mm" and "hour" in before else part
            return part, words[:place] + words[place + 1 :]
    return None, words


def joined(names: Sequence[str], cells: Iterable[Sequence[str]]) -> list[str]:
    """The cells of several columns, row by row, as stamps."""
    parts: list[str | int | None] = []
    for name in names:
        parts.append(part_of(name, parts)[0])
    split = [isinstance(part, int) for part in (*parts[1:], None)]  # the next column has the fraction
    return ["".join(map(_part, parts, row, split)).lstrip(" :-") for row in cells]


def _part(part: str | int | None, cell: str, split: bool) -> str:
    """A cell as a part of a stamp, with the sign before it."""
    whole, _, rest = (cell := cell.strip()).replace(",", ".").partition(".")
    if isinstance(part, int):  # an integer: "ns" may be north or south, and "ms" a speed
        return f".{whole.zfill(part)}" if whole.isdigit() and not rest.strip("0") and len(whole) <= part else "?"
    if part is None or not (part == "month" or (whole + rest).isdigit()):
        return f" {cell}"
    century = "20" if part == "year" and len(whole) == 2 else ""
    return f"{SIGNS[part]}{century}{whole.zfill(2)}" + (f".{rest}" if part == "second" and rest and not split else "")


def _of_number(values: np.ndarray) -> np.ndarray:
    """Seconds since midnight of numbers HHMMSS; NaN where there is no such time."""
    hours, minutes, seconds = values // 10000, values // 100 % 100, values % 100
    known = (hours >= 0) & (hours < 24) & (minutes < 60) & (seconds < 60)
    return np.where(known, 3600 * hours + 60 * minutes + seconds, np.nan)


def _offset(zone: str | None) -> float:
    """Of a zone such as +02:00, s."""
    if zone in (None, "Z"):
        return 0.0
    return (1 if zone[0] == "+" else -1) * (3600.0 * int(zone[1:3]) + 60 * int(zone[-2:]))


def _days(dates: np.ndarray, order: str) -> np.ndarray:
    """Days since 1970 of dates; NaN where there is no such day."""
    distinct, places = np.unique(dates, axis=0, return_inverse=True)
    days = np.full(len(distinct), np.nan)
    for place, (first, second, year) in enumerate(distinct.tolist()):
        day, month = (first, second) if order == "day_first" else (second, first)
        try:
            days[place] = date(year, month, day).toordinal() - EPOCH
        except ValueError:
            pass
    return days[places.reshape(-1)]
