"""The picture of `usvlearn inspect --plot`: the channels over time, and their relations."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from usvlearn.display.figures import LINE, figure_of, guarded, rendered
from usvlearn.errors import printable
from usvlearn.logs.channels.bins import Series, bin_directions
from usvlearn.logs.channels.channel import SURGE
from usvlearn.logs.checks.evidence import MOVING, NONE, Evidence
from usvlearn.logs.inspection.inspected import Inspected
from usvlearn.logs.inspection.position_channels import SPAN

LEFT, RIGHT, MAIN, OTHER, BAD = "#0072b2", "#d55e00", "#1f2430", "#12b5cb", "#cc0033"
MOST_POINTS = 20_000  # of a curve
LOST = 2.0  # s, of a silence that is marked


def draw(inspected: Inspected, path: Path) -> None:
    """Write the picture."""
    path.write_bytes(rendered(_picture(inspected), dpi=100))


@guarded
def _picture(inspected: Inspected) -> Any:
    data, limit = inspected.settings["data"], 2 * inspected.settings["vehicle"]["surge_max"]
    e = Evidence(data["boat"], inspected.recordings, None, {}, limit, data["channels"])
    edges = e.moving_edges(SPAN)
    north, east = e.velocity(edges)
    rate, at, seconds = np.hypot(north, east), _middles(edges), _middles(e.edges)
    course = np.where(rate > MOVING * e.fastest, _degrees(np.arctan2(east, north)), np.nan)
    stamps, angle = _broken(e.series["heading"])
    turn, (times, yaw) = np.degrees(e.turn), _broken(e.series.get("yaw_rate", NONE))
    figure = figure_of(11, 12, facecolor="white")
    rows = figure.subfigures(2, 1, height_ratios=[2.4, 1])
    axes = rows[0].subplots(4, 1, sharex=True)
    left, right = ((seconds, np.where(np.isfinite(e.speed), each, np.nan)) for each in e.commands)
    _panel(axes[0], "commands, share", (left, LEFT, "left"), (right, RIGHT, "right"))
    _panel(axes[1], "heading, deg", ((stamps, _degrees(angle)), MAIN, "heading"),
           ((at, course), OTHER, "course over ground"), dots=True)  # fmt: skip
    _panel(axes[2], "yaw rate, deg/s", ((seconds, turn), OTHER, "derivative of the heading"),
           ((times, np.degrees(yaw)), MAIN, "yaw rate"), clip=True)  # fmt: skip
    speed = _broken(e.series[SURGE])
    _panel(axes[3], "speed, m/s", ((at, rate), OTHER, "speed over ground"), (speed, MAIN, "speed"), limit=limit)
    axes[3].set_xlabel("time, s (runs one behind the other)")
    runs = f"{len(e.recordings)} run{'s' * (len(e.recordings) > 1)}"
    figure.suptitle(printable(f"{e.boat}: {runs} as configured"))
    below = rows[1].subplots(1, 3)
    heading = _degrees(np.angle(bin_directions(e.series["heading"], edges)))
    _against(below[0], course, heading, "course, deg", "heading, deg", line=True)
    rates = np.degrees(e.means("yaw_rate")) if len(yaw) else np.full(len(turn), np.nan)
    _against(below[1], turn, rates, "derivative of heading, deg/s", "yaw rate, deg/s", line=True)
    _against(below[2], e.thrust, e.speed, "mean command, share", "speed, m/s")
    return figure


def _middles(edges: np.ndarray) -> np.ndarray:
    return (edges[:-1] + edges[1:]) / 2


def _degrees(angle: np.ndarray) -> np.ndarray:
    return np.degrees(angle) % 360


def _broken(series: Series) -> Series:
    """A series with NaN in each silence and between runs."""
    time, value = series
    silent = np.flatnonzero(np.diff(time) > LOST) + 1
    return np.insert(time, silent, np.nan), np.insert(value, silent, np.nan)


def _panel(axes, label: str, *curves: tuple[Series, str, str], dots: bool = False, clip: bool = False,
           limit: float = math.inf) -> None:  # fmt: skip
    for (time, value), colour, name in curves:
        every = max(1, len(time) // MOST_POINTS)
        time, value = time[::every], value[::every]
        style = {"ls": "", "marker": ".", "ms": 2} if dots else {"lw": 0.9}
        if len(time):
            axes.plot(time, value, color=colour, label=name, **style)
        if (wild := np.abs(value) > limit).any():
            axes.plot(time[wild], np.full(wild.sum(), limit), "v", color=BAD, ms=5, label="rejected: out of range")
        for k in np.flatnonzero(np.isnan(time[1:-1])) + 1:
            axes.axvspan(time[k - 1], time[k + 1], color=LINE, alpha=0.6, lw=0)
    first = curves[0][0][1]
    if clip and np.isfinite(first).any():
        most = 1.3 * float(np.nanquantile(np.abs(first), 0.999)) + 1e-9
        axes.set_ylim(-most, most)
    if limit < math.inf:
        axes.set_ylim(top=min(axes.get_ylim()[1], 1.1 * limit))
    axes.set_ylabel(label)
    axes.legend(loc="lower right", bbox_to_anchor=(1, 0.97), ncols=3)


def _against(axes, x: np.ndarray, y: np.ndarray, name: str, other: str, line: bool = False) -> None:
    axes.set(xlabel=name, ylabel=other)
    known = np.isfinite(x) & np.isfinite(y)
    if not known.any():
        axes.text(0.5, 0.5, "not logged", ha="center", transform=axes.transAxes)
        return
    every = max(1, len(x) // 5000)
    axes.plot(x[::every], y[::every], ".", color=MAIN, ms=2, alpha=0.4)
    if line:
        low, high = np.quantile(x[known], [0.002, 0.998])
        axes.plot([low, high], [low, high], color=BAD, lw=0.8)
        axes.set_xlim(low, high)
