"""MOOS logs (`.alog`): rows of `time VARIABLE SOURCE[:AUX] VALUE`, separated by white space.

The value may hold spaces and colours of a terminal, or be empty. Stamps are seconds since the logger's
start and need not be in order. Lines that are not rows (the header starts with `%%`) are skipped.
"""

from __future__ import annotations

import math
import re
import warnings
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import ClassVar

import numpy as np

from usvlearn.errors import LogFormatError
from usvlearn.logs.channels.channel import LISTED, Channel, Source, as_number, build_channel, match_name, parse_numbers
from usvlearn.logs.channels.series import Reader, Series

START = re.compile(r"%%\s*LOGSTART\s+(\d+\.?\d*)\s*$")  # s since 1970
ANSI = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


@dataclass(frozen=True)
class Alog(Reader):
    """Reads a MOOS log.

    `Source.name` is a variable, from whichever app posts it, or `VARIABLE@app` to keep one app's posts only
    (the app as in the log's third column, without `:AUX`): `NAV_SPEED@pEchoVar`.

    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     path = Path(folder) / "a.alog"
    ...     _ = path.write_text("%% LOGSTART 1.5e9\\n0.5 NAV_SPEED iGPS 1.2\\n0.9 NAV_SPEED iGPS off\\n")
    ...     channels, dropped = Alog().read(path, {"surge": Source("NAV_SPEED")})
    >>> channels["surge"].value, channels["surge"].order, dropped
    (array([1.2]), array([2]), {'surge': {'not_a_number': 1}})
    """

    suffixes: ClassVar[tuple[str, ...]] = (".alog",)

    def read(self, path: Path, sources: dict[str, Source]) -> tuple[dict[str, Channel], dict[str, dict[str, int]]]:
        posts = _posts(path)
        if not posts:
            raise _no_rows(path)
        matched = {}  # channel -> VARIABLE or VARIABLE@app
        for channel, source in sources.items():
            where = f"{path}: data.channels.{channel}.name"
            matched[channel] = match_name(source.name, posts["@" in source.name], where)
        rows = _rows(path, set(matched.values()))
        start = next((float(match[1]) for line in islice(_lines(path), 9) if (match := START.match(line))), math.nan)
        channels, dropped = {}, {}
        for channel, source in sources.items():
            order, time, cells = rows[matched[channel]]
            raw = parse_numbers(cells)
            empty = np.array([not cell.strip() for cell in cells], bool)
            channels[channel], dropped[channel] = build_channel(
                f"{path}: {channel}", source, parse_numbers(time), raw, order, empty, cells[0] if cells else "", start
            )  # fmt: skip
        return channels, dropped

    def survey(self, path: Path) -> list[Series]:
        heard: dict[str, dict[str, tuple[array, array, array]]] = {}  # variable -> app -> stamps, values, line numbers
        lost = 0
        for number, line in enumerate(_lines(path), 1):
            parts = line.split(None, 3)
            if len(parts) < 3 or not math.isfinite(stamp := as_number(parts[0])) or not _is_name(parts[1] + parts[2]):
                lost += bool(parts) and not line.startswith("%")
                continue
            value = parts[3] if len(parts) == 4 else ""
            columns = heard.setdefault(parts[1], {}).setdefault(_app(parts[2]), (array("d"), array("d"), array("q")))
            for column, each in zip(columns, (stamp, as_number(ANSI.sub("", value)), number), strict=True):
                column.append(each)
        if not heard:
            raise _no_rows(path)
        series, partly = [], []
        for variable, apps in heard.items():
            for app, columns in apps.items():
                time, values, order = (np.array(column) for column in columns)
                name, share = variable if len(apps) == 1 else f"{variable}@{app}", np.isfinite(values).mean()
                if "@" not in variable and share >= 0.5:
                    series.append(Series(name, None, time, values, order, kind=app))
                elif share:
                    partly.append(name)
        if lost or partly:
            named = f"; variables of few numbers: {', '.join(partly[:LISTED])}" if partly else ""
            warnings.warn(f"{path}: skipped {lost} lines that are no rows{named}", stacklevel=2)
        return series


def _lines(path: Path) -> Iterator[str]:
    with path.open(encoding="utf-8", errors="surrogateescape", newline="\n") as file:
        yield from file


def _posts(path: Path) -> dict[bool, set[str]]:
    """All names in the log: variables (False) and VARIABLE@app (True); {} if there is no row."""
    pairs: set[tuple[str, str]] = set()
    for line in _lines(path):
        parts = line.split(None, 3)
        if len(parts) > 2 and (parts[1], parts[2]) not in pairs and _is_number(parts[0]):
            if _is_name(parts[1] + parts[2]):
                pairs.add((parts[1], parts[2]))
    if not pairs:
        return {}
    return {False: {name for name, _ in pairs}, True: {f"{name}@{_app(app)}" for name, app in pairs}}


def _rows(path: Path, names: set[str]) -> dict[str, tuple[list[int], list[str], list[str]]]:
    """name -> line numbers, stamps and values (without colours) of its rows."""
    rows: dict[str, tuple[list[int], list[str], list[str]]] = {name: ([], [], []) for name in names}
    variables = {name.split("@")[0] for name in names}
    for number, line in enumerate(_lines(path), 1):
        parts = line.split(None, 3)
        if len(parts) < 3 or parts[1] not in variables or not _is_number(parts[0]):
            continue
        value = parts[3].strip() if len(parts) == 4 else ""
        if "\x1b" in value:
            value = ANSI.sub("", value)
        for name in (parts[1], f"{parts[1]}@{_app(parts[2])}"):
            if name in rows:
                order, time, cells = rows[name]
                order.append(number)
                time.append(parts[0])
                cells.append(value)
    return rows


def _app(source: str) -> str:
    return source.split(":")[0]


def _is_name(text: str) -> bool:
    """Whether it is one; binary data may look like a row."""
    return text.isascii() and text.isprintable()


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _no_rows(path: Path) -> LogFormatError:
    return LogFormatError(
        f"{path}: expected a MOOS log, found no row of the form 'time VARIABLE SOURCE VALUE': "
        "give the .alog of a run, or choose the data option that fits this file"
    )
