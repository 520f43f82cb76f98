"""Plans that other programs post: what will be commanded, and how a node answers with a forecast.

A plan is text, rows `t,left,right` or `t,left,right,heading` that are separated by `;` or line ends, or a JSON object:

    0,0.5,0.5; 5,0.8,0.6; 10,0.8,0.8
    {"id": "A", "t": [0, 5, 10], "left": [0.5, 0.8, 0.8], "right": [0.5, 0.6, 0.8], "heading": [90, 90, 100]}

t is in s from the end of the node's last step. The commands of a row, shares of full scale from −1 to 1, hold until the
next row; those of the last row hold on. Before the first row the commands in force hold. Headings have the unit of the
heading channel and are joined by straight lines. Without them a node that makes tracks answers with where the boat will
be, in m and degrees from north (`Point`); to another one the boat soon ends its turn
(`Aligner.ahead`). The answer has the form of the plan.

Tracks are published in the units of those who steer: m, and degrees from north.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.forecasts import Forecast, Track
from usvlearn.errors import ConfigError

DECIMALS = (2, 2, 1, 2, 2, 1)


class Point(NamedTuple):
    """Where the boat will be, from where it is now."""

    north: float  # m
    east: float  # m
    heading: float  # deg, 0 north, clockwise, 0 … 360
    major: float  # m, semi-axes of the ellipse that holds the position in 90 % of the cases; infinite: not known yet
    minor: float  # m
    bearing: float  # deg, of the major one, 0 … 180

    @property
    def text(self) -> str:
        """The numbers, joined by colons; without the ellipse while it is not known."""
        known = 6 if math.isfinite(self.major) else 3
        wrapped = self._replace(heading=round(self.heading, 1) % 360, bearing=round(self.bearing, 1) % 180)
        return ":".join(f"{x:.{decimals}f}" for x, decimals in zip(wrapped[:known], DECIMALS, strict=False))


def points(track: Track, steps: Sequence[int] | None = None) -> list[Point]:
    """The places after some steps of one boat's track, numbered from 1; None: after all of them."""
    at = np.arange(len(track.time)) if steps is None else np.asarray(steps, int) - 1
    major, minor, bearing = track.ellipse()
    heading, bearing = np.degrees(track.heading) % 360, np.degrees(bearing) % 180
    columns = (track.north, track.east, heading, major, minor, bearing)
    return [Point(*map(float, row)) for row in np.stack([np.asarray(x)[at] for x in columns], -1)]


KEYS = ("t", "left", "right", "heading")
MOST_ROWS, MOST_TEXT = 1000, 100_000
HEADER = re.compile(r"t\s*,\s*left\s*,\s*right(\s*,\s*heading)?")
EXPECTED = 'expected rows t,left,right or t,left,right,heading, or {"t": […], "left": […], "right": […]}'


class PlannedCommands(NamedTuple):
    """What will be commanded, arrays `(rows,)`."""

    time: np.ndarray  # s from now, increasing
    left: np.ndarray  # shares of full scale
    right: np.ndarray
    heading: np.ndarray | None  # in the unit of the heading channel


def parse_plan(text: str) -> PlannedCommands:
    """The plan in a text."""
    if len(text) > MOST_TEXT:
        raise ConfigError(f"plan: found {len(text)} characters, expected at most {MOST_TEXT}")
    rows = _of_json(text) if is_json(text) else _of_text(text)
    if not 1 <= len(rows) <= MOST_ROWS:
        raise ConfigError(f"plan: found {len(rows)} rows, expected 1 to {MOST_ROWS}")
    columns = np.array(rows, dtype=float).T
    time = columns[0]
    for k, row in enumerate(columns.T, 1):
        for name, value in zip(KEYS, row, strict=False):
            if not math.isfinite(value):
                raise ConfigError(f"plan: found {name} {value:g} in row {k}, expected a finite number")
            if name in ("left", "right") and not -1 <= value <= 1:
                raise ConfigError(f"plan: found {name} {value:g} in row {k}, expected -1 to 1, shares of full scale")
    if time[0] < 0 or not (np.diff(time) > 0).all():
        raise ConfigError("plan: found times t that do not rise from 0 on, expected s from now, increasing")
    return PlannedCommands(time, columns[1], columns[2], columns[3] if len(columns) > 3 else None)


def is_json(text: str) -> bool:
    """Whether a plan is meant as JSON."""
    return text.lstrip()[:1] in ("{", "[")


def identifier(text: str) -> Any:
    """The `id` of a plan in JSON, a text or a number, by which the sender knows the answer; None without."""
    try:
        value = json.loads(text).get("id")
    except (ValueError, AttributeError, RecursionError):
        return None
    plain = isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value))
    return value if plain and len(str(value)) <= 100 else None


def _of_json(text: str) -> list[list[float]]:
    try:
        given = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"plan: found no JSON ({error}), {EXPECTED}") from error
    if not isinstance(given, dict) or not all(isinstance(given.get(key), list) for key in KEYS[:3]):
        raise ConfigError(f"plan: found JSON without lists t, left and right, {EXPECTED}")
    if unknown := [key for key in given if key not in (*KEYS, "id")]:
        raise ConfigError(f"plan: found the key {unknown[0]!r:.40}, expected {', '.join(KEYS)} and id")
    columns = [given[key] for key in KEYS if given.get(key) is not None]
    if not all(isinstance(each, list) and len(each) == len(columns[0]) for each in columns):
        raise ConfigError("plan: found lists of different lengths, expected a number in each for each row")
    for name, column in zip(KEYS, columns, strict=False):
        if wrong := [x for x in column if isinstance(x, bool) or not isinstance(x, int | float) or abs(x) > 1e300]:
            raise ConfigError(f"plan: found {name} {wrong[0]!r:.40}, expected a finite number")
    return [list(row) for row in zip(*columns, strict=True)]


def _of_text(text: str) -> list[list[float]]:
    lines = [line.strip() for line in re.split(r"[;\n\r]+", text) if line.strip()]
    if lines and HEADER.fullmatch(lines[0]):
        del lines[0]
    rows: list[list[float]] = []
    for k, line in enumerate(lines, 1):
        try:
            row = [float(each) for each in line.split(",")]
        except ValueError:
            row = []
        if len(row) not in (3, 4) or len(row) != len(rows[0] if rows else row):
            raise ConfigError(f"plan: found {line!r:.60} in row {k}, {EXPECTED}")
        rows.append(row)
    return rows


def sampled(plan: PlannedCommands, edges: np.ndarray, before: np.ndarray, side: str) -> np.ndarray:
    """The mean command of a side in each step between edges in the plan's time, s, `(steps + 1,)`; `(steps,)`.

    The commands in force before, `(steps,)`, hold until the plan's first row.
    """
    values, time, length = getattr(plan, side), plan.time, np.diff(edges)
    after = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(time))])  # the integral up to each row
    total = np.interp(edges, time, after) + values[-1] * np.maximum(edges - time[-1], 0.0)
    waits = np.clip(time[0] - edges[:-1], 0.0, length) / length
    means: np.ndarray = np.diff(total) / length + waits * before
    return means


def answer(text: str, time: float, forecast: Forecast | Track | str) -> str:
    """The answer to a plan, in its form: a forecast or a track, or a sentence that says why there is none."""
    if not is_json(text):
        if isinstance(forecast, str):
            return f"error: {forecast}"
        if isinstance(forecast, Track):
            return ",".join(f"{t:.6g}={point.text}" for t, point in zip(forecast.time, points(forecast), strict=True))
        return ",".join(
            f"{t:.6g}={v:.3f}" + (f":{low:.3f}:{high:.3f}" if math.isfinite(low) else "")
            for t, v, low, high in zip(*forecast, strict=True)
        )
    head = {} if (name := identifier(text)) is None else {"id": name}
    if isinstance(forecast, str):
        return json.dumps({**head, "error": forecast})
    if isinstance(forecast, Track):
        rows = dict(zip(Point._fields, zip(*points(forecast), strict=True), strict=True))
        rows = {"t": forecast.time, "surge": forecast.surge, "sway": forecast.sway, **rows}
    else:
        rows = dict(zip(("t", "surge", "low", "high"), forecast, strict=True))
    columns = {key: [round(float(x), 3) if math.isfinite(x) else None for x in values] for key, values in rows.items()}
    return json.dumps({**head, "time": round(time, 3), **columns})
