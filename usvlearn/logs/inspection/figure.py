"""The picture of `usvlearn inspect --plot`: the channels over time, and how they hang together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usvlearn.display.figures import LINE, guarded, rendered, themed
from usvlearn.errors import printable
from usvlearn.logs.channels.bins import cleaned
from usvlearn.logs.channels.channel import COMMANDS, Channel, Recording
from usvlearn.logs.channels.correlations import heading_rate
from usvlearn.logs.channels.positions import track
from usvlearn.logs.inspection.inspected import Inspected
from usvlearn.logs.inspection.position_channels import MOVING, SPAN, even_times

LEFT, RIGHT, MAIN, OTHER, BAD = "#0072b2", "#d55e00", "#1f2430", "#12b5cb", "#cc0033"
MOST_POINTS = 20_000  # of a curve
BETWEEN = 20.0  # s between two runs in the picture
HALF = 0.5  # s
LOST = 2.0  # s, of a silence that is marked


class Curve(NamedTuple):
    """A channel of all runs, one behind the other."""

    time: np.ndarray  # (n,) s, NaN between runs and in silences
    value: np.ndarray  # (n,)


def draw(found: Inspected, path: Path) -> None:
    """Write the picture."""
    path.write_bytes(rendered(_picture(found), dpi=100))


@guarded
def _picture(found: Inspected) -> Any:
    recordings, limit = found.recordings, 2 * found.settings["vehicle"]["surge_max"]
    begins = _begins(recordings)
    names = (*COMMANDS, "heading", "yaw_rate", "surge")
    curves = {name: _curve([one.channels.get(name) for one in recordings], begins) for name in names}
    course, rate = _over_ground(recordings, begins)
    turn = _curve([_derivative(one.channels["heading"]) for one in recordings], begins)
    with themed() as Figure:
        figure = Figure(figsize=(11, 12), layout="constrained", facecolor="white")
        rows = figure.subfigures(2, 1, height_ratios=[2.4, 1])
        axes = rows[0].subplots(4, 1, sharex=True)
        _panel(axes[0], "commands, share", (curves[COMMANDS[0]], LEFT, "left"), (curves[COMMANDS[1]], RIGHT, "right"))
        _panel(axes[1], "heading, deg", (_degrees(curves["heading"]), MAIN, "heading"),
               (_degrees(course), OTHER, "course over ground"), dots=True)  # fmt: skip
        _panel(axes[2], "yaw rate, deg/s", (_scaled(turn, math.degrees(1)), OTHER, "derivative of the heading"),
               (_scaled(curves["yaw_rate"], math.degrees(1)), MAIN, "yaw rate"), clip=True)  # fmt: skip
        _panel(axes[3], "speed, m/s", (rate, OTHER, "rate of position"), (curves["surge"], MAIN, "speed"), limit=limit)
        axes[3].set_xlabel("time, s (runs one behind the other)")
        runs = f"{len(recordings)} run{'s' * (len(recordings) > 1)}"
        figure.suptitle(printable(f"{found.settings['data']['boat']}: {runs} as configured"))
        below = rows[1].subplots(1, 3)
        _against(below[0], _degrees(course), _degrees(curves["heading"]), "course, deg", "heading, deg", line=True)
        _against(below[1], _scaled(turn, math.degrees(1)), _scaled(curves["yaw_rate"], math.degrees(1)),
                 "derivative of heading, deg/s", "yaw rate, deg/s", line=True)  # fmt: skip
        both = _mean(curves[COMMANDS[0]], curves[COMMANDS[1]])
        _against(below[2], both, curves["surge"], "mean command, share", "speed, m/s")
        return figure


def _begins(recordings: Sequence[Recording]) -> list[tuple[float, float]]:
    """The first stamp of each run, and where it begins in the picture, s."""
    found, begin = [], 0.0
    for one in recordings:
        first = min(float(each.time.min()) for each in one.channels.values() if len(each.time))
        last = max(float(each.time.max()) for each in one.channels.values() if len(each.time))
        found.append((first, begin))
        begin += last - first + BETWEEN
    return found


def _curve(channels: Sequence[Channel | None], begins: Sequence[tuple[float, float]]) -> Curve:
    times, values = [], []
    for channel, (first, begin) in zip(channels, begins, strict=True):
        if channel is None or not len(channel.time):
            continue
        time, value = cleaned((channel.time, channel.value))
        silent = np.flatnonzero(np.diff(time) > LOST) + 1 if not channel.held else np.empty(0, int)
        times.append(np.append(np.insert(time - first + begin, silent, np.nan), np.nan))
        values.append(np.append(np.insert(value, silent, np.nan), np.nan))
    if not times:
        return Curve(np.empty(0), np.empty(0))
    return Curve(np.concatenate(times), np.concatenate(values))


def _derivative(heading: Channel) -> Channel:
    """The rate of turn over half seconds: shorter ones show the noise of the compass."""
    place = np.floor(heading.time / HALF)
    kept = np.append(True, np.diff(place) != 0)
    time, rate = heading_rate((heading.time[kept], heading.value[kept]))
    return Channel(time, rate, np.arange(len(time)))


def _over_ground(recordings: Sequence[Recording], begins: Sequence[tuple[float, float]]) -> tuple[Curve, Curve]:
    """The course where the boat moves, rad, and the rate of position, m/s."""
    courses: list[Channel | None] = []
    rates: list[Channel | None] = []
    for one in recordings:
        heading = one.channels["heading"].time
        time = even_times(heading)
        places = track(one.channels, time) if len(time) > 2 else None
        if places is None:
            courses.append(None)
            rates.append(None)
            continue
        moved = np.diff(places, axis=0)
        moved[np.diff(time) > 1.5 * SPAN] = np.nan
        rate, middle = np.hypot(*moved.T) / SPAN, time[:-1] + SPAN / 2
        known = np.isfinite(rate)
        fast = known & (rate > MOVING * np.quantile(rate[known], 0.95)) if known.any() else known
        courses.append(Channel(middle[fast], np.arctan2(moved[:, 1], moved[:, 0])[fast], np.arange(fast.sum())))
        rates.append(Channel(middle[known], rate[known], np.arange(known.sum())))
    return _curve(courses, begins), _curve(rates, begins)


def _panel(axes, label: str, *curves: tuple[Curve, str, str], dots: bool = False, clip: bool = False,
           limit: float = math.inf) -> None:  # fmt: skip
    for curve, colour, name in curves:
        if not len(curve.time):
            continue
        every = max(1, len(curve.time) // MOST_POINTS)
        time, value = curve.time[::every], curve.value[::every]
        style = {"ls": "", "marker": ".", "ms": 2} if dots else {"lw": 0.9}
        axes.plot(time, value, color=colour, label=name, **style)
        wild = np.abs(value) > limit
        if wild.any():
            axes.plot(time[wild], np.full(wild.sum(), limit), "v", color=BAD, ms=5, label="rejected: out of range")
    first = next((curve for curve, _, _ in curves if len(curve.time)), curves[0][0])
    for begin, end in _silences(first):
        axes.axvspan(begin, end, color=LINE, alpha=0.6, lw=0)
    if clip and len(first.value) and np.isfinite(first.value).any():
        most = 1.3 * float(np.nanquantile(np.abs(first.value), 0.999)) + 1e-9
        axes.set_ylim(-most, most)
    if limit < math.inf:
        axes.set_ylim(top=min(axes.get_ylim()[1], 1.1 * limit))
    axes.set_ylabel(label)
    axes.grid(True)
    axes.legend(loc="lower right", bbox_to_anchor=(1, 0.97), fontsize=8, ncols=3)


def _silences(curve: Curve) -> list[tuple[float, float]]:
    """Where a channel is silent, and between runs."""
    holes = np.flatnonzero(np.isnan(curve.time))
    return [(curve.time[k - 1], curve.time[k + 1]) for k in holes if 0 < k < len(curve.time) - 1]


def _against(axes, x: Curve, y: Curve, name: str, other: str, line: bool = False) -> None:
    axes.set_xlabel(name)
    axes.set_ylabel(other)
    axes.grid(True)
    known = np.isfinite(x.time)
    if not known.any() or not np.isfinite(y.time).any():
        axes.text(0.5, 0.5, "not logged", ha="center", transform=axes.transAxes)
        return
    time, own = x.time[known], x.value[known]
    stamps = _rising(y.time)
    place = np.clip(np.searchsorted(stamps, time), 0, len(stamps) - 1)
    value = np.where(np.abs(stamps[place] - time) < LOST, y.value[place], np.nan)
    every = max(1, len(time) // 5000)
    axes.plot(own[::every], value[::every], ".", color=MAIN, ms=2, alpha=0.4)
    if line:
        low, high = np.nanquantile(own, [0.002, 0.998])
        axes.plot([low, high], [low, high], color=BAD, lw=0.8)
        axes.set_xlim(low, high)


def _rising(time: np.ndarray) -> np.ndarray:
    """Stamps without NaN, each of which becomes the one before it."""
    return np.fmax.accumulate(time) if len(time) else time


def _mean(left: Curve, right: Curve) -> Curve:
    known = np.isfinite(left.time) & np.isfinite(left.value)
    others = np.isfinite(right.time) & np.isfinite(right.value)
    if not known.any() or not others.any():
        return Curve(np.empty(0), np.empty(0))
    time = left.time[known]
    return Curve(time, (left.value[known] + np.interp(time, right.time[others], right.value[others])) / 2)


def _degrees(curve: Curve) -> Curve:
    return curve._replace(value=np.degrees(curve.value) % 360)


def _scaled(curve: Curve, factor: float) -> Curve:
    return curve._replace(value=factor * curve.value)
