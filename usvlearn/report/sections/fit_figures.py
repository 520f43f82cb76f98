"""Figures of a batch fit: its curves and where the boat sailed, what is left in its errors, and its worst minutes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from usvlearn.display.figures import INK, LINE, SIDES, guarded, set_reach, themed
from usvlearn.report.sections.fit_file import Course, Curve, Diagnostics, Lags, Sailed

FITTED = "#D55E00"  # the colour of what is simulated with a fit
ENOUGH = 5.0  # s in a bin or beside it: the boat sailed there
ACROSS = 3  # worst minutes in a row
ROOM = 0.6  # of the height of a curve, by which its band may be higher
MINUTE = 60.0  # s


def sailed_at(where: Sailed) -> np.ndarray:
    """Whether the boat sailed at each bin, or at one beside it, for ENOUGH seconds, bool `(bins,)`.

    >>> sailed_at(Sailed(np.arange(5.0), np.array([9.0, 0.0, 0.0, 1.0])))
    array([ True,  True, False, False])
    """
    enough = where.seconds >= ENOUGH
    return enough | np.append(enough[1:], False) | np.append(False, enough[:-1])


@guarded
def curves_figure(found: Diagnostics, title: str, truth: Mapping[str, float]):
    """Thrust of each side over its command and drag over the speed, with bands; below, the seconds sailed there.

    Args:
        found: of one boat.
        title: of the figure.
        truth: known quantities of a simulated boat, which are drawn as crosses.
    """
    points = {f"thrust_{side}": (1.0, truth.get(f"thrust_full_{side}")) for side in SIDES}
    points["drag"] = (truth.get("steady_speed_full", 0.0) / 2, truth.get("drag_half_speed"))
    panels = (
        ("thrust_left", "left", SIDES["left"], "command of the left side", "thrust at standstill, N"),
        ("thrust_right", "right", SIDES["right"], "command of the right side", "thrust at standstill, N"),
        ("drag", "speed", FITTED, "speed, m/s", "drag, N"),
    )
    with themed() as Figure:
        figure = Figure(figsize=(9.5, 3.7), layout="constrained")
        above, below = figure.subplots(2, 3, sharex="col", height_ratios=(3, 1))
        for upper, lower, (name, place, colour, xlabel, ylabel) in zip(above, below, panels, strict=True):
            curve, where = found.curves[name], found.sailed[place]
            known = _drawn(upper, curve, where, colour)
            if points[name][1] is not None:
                upper.plot(*points[name], marker="x", color=INK, linestyle="", clip_on=False, label="truth")
            lower.stairs(where.seconds / 60, where.edges, fill=True, color=colour, alpha=0.55)
            upper.set_ylabel(ylabel, fontsize=8)
            lower.set_xlabel(xlabel, fontsize=8)
            set_reach(upper, *_limits(curve, known))
            for panel in (upper, lower):
                panel.grid(color=LINE)
                panel.tick_params(labelsize=8)
                panel.margins(x=0)
        below[0].set_ylabel("sailed, min", fontsize=8)
        above[0].set_title(title, loc="left", fontsize=8.5)
        handles, labels = above[0].get_legend_handles_labels()
        figure.legend(handles, labels, ncols=5, fontsize=8, loc="outside lower center")
        return figure


def _drawn(panel: Any, curve: Curve, where: Sailed, colour: str) -> np.ndarray:
    """Draw a curve; returns where the boat sailed, bool `(points,)`."""
    sailed = sailed_at(where)
    bins = np.clip(np.searchsorted(where.edges, curve.at, side="right") - 1, 0, len(sailed) - 1)
    known: np.ndarray = sailed[bins] | sailed[np.clip(bins - np.isin(curve.at, where.edges), 0, None)]
    panel.fill_between(curve.at, curve.low, curve.high, color=colour, alpha=0.22, linewidth=0, label="90 %")
    panel.plot(curve.at, np.where(known, curve.value, np.nan), color=colour, linewidth=1.6, label="fitted")
    panel.plot(curve.at, curve.value, color=colour, linewidth=1.1, linestyle=":", label="where it has not sailed")
    edges = np.flatnonzero(np.diff(np.concatenate([[True], sailed, [True]])))
    for k, (first, last) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
        style = {"color": INK, "alpha": 0.1, "linewidth": 0, "label": "not sailed" if k == 0 else None}
        panel.axvspan(where.edges[first], where.edges[last], **style)
    return known


def _limits(curve: Curve, known: np.ndarray) -> tuple[float, float]:
    """Of the axis: the whole curve, the band where the boat sailed, and some of the rest of the band."""
    low, high = float(curve.value.min()), float(curve.value.max())
    room = ROOM * max(high - low, 1e-3)
    if known.any():
        low, high = min(low, float(curve.low[known].min())), max(high, float(curve.high[known].max()))
    low, high = min(low, max(float(curve.low.min()), low - room)), max(high, min(float(curve.high.max()), high + room))
    margin = 0.04 * max(high - low, 1e-3)
    return low - margin, high + margin


@guarded
def residuals_figure(found: Diagnostics, title: str):
    """The autocorrelation of the errors, and their correlation with mean and difference of the commands.

    Args:
        found: of one boat.
        title: of the figure.
    """
    cross = found.cross_correlation
    parts = (
        (found.autocorrelation, "errors with themselves", "lag, s"),
        (cross["mean"], "with the mean command", "error after the command by, s"),
        (cross["difference"], "with the difference, left − right", "error after the command by, s"),
    )
    with themed() as Figure:
        figure = Figure(figsize=(9.5, 2.5), layout="constrained")
        panels = figure.subplots(1, 3, width_ratios=(3, 4, 4))
        for panel, (lags, name, xlabel) in zip(panels, parts, strict=True):
            at, values, bounds = (x[np.isfinite(lags.values)] for x in lags)  # a slow sensor has few lags
            panel.fill_between(at, -bounds, bounds, color=INK, alpha=0.14, linewidth=0)
            panel.axhline(0.0, color=INK, linewidth=0.8)
            panel.plot(at, values, color=FITTED, linewidth=1.4)
            if lags.lags[0] < 0:
                panel.axvline(0.0, color=INK, linewidth=0.8, linestyle=":")
            panel.set_title(name, loc="left", fontsize=8.5)
            panel.set_xlabel(xlabel, fontsize=8)
            panel.set_ylim(*_correlations(lags))
            panel.grid(axis="y", color=LINE)
            panel.tick_params(labelsize=8)
            panel.margins(x=0)
        figure.suptitle(title, x=0.01, ha="left", fontsize=8.5)
        return figure


def _correlations(lags: Lags) -> tuple[float, float]:
    """Of the axis: the values and, if they are not too wide, the bounds."""
    wide = float(np.nanmedian(lags.bounds)) if np.isfinite(lags.bounds).any() else 0.1
    known = lags.values[np.isfinite(lags.values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    return min(1.1 * low, -1.5 * wide), max(1.1 * high, 1.5 * wide)


@guarded
def worst_figure(courses: Sequence[Course], title: str):
    """The worst minutes, shaded, and what is around them: measured and simulated speed, and below the commands.

    Args:
        courses: of one boat, the worst first.
        title: of the figure.
    """
    across = min(ACROSS, len(courses))
    down = -(-len(courses) // across)
    with themed() as Figure:
        figure = Figure(figsize=(1.0 + 3.2 * across, 0.5 + 2.7 * down), layout="constrained")
        panels = figure.subplots(2 * down, across, squeeze=False, height_ratios=(2, 1) * down)
        for panel in panels.reshape(-1):
            panel.set_visible(False)
        for k, each in enumerate(courses):
            row, column = divmod(k, across)
            speed, command = panels[2 * row, column], panels[2 * row + 1, column]
            speed.plot(*_joined(each.time, each.measured), color=INK, linewidth=1.8, label="measured")
            speed.plot(each.time, each.simulated, color=FITTED, linewidth=1.2, label="simulated")
            for side, colour in SIDES.items():
                command.plot(each.time, getattr(each, side), color=colour, linewidth=1.1, label=side)
            for panel in (speed, command):
                panel.set_visible(True)
                panel.axvspan(each.start, each.start + MINUTE, color=INK, alpha=0.1, linewidth=0)
                panel.grid(color=LINE)
                panel.tick_params(labelsize=8)
                known = each.time[np.isfinite(each.time)]
                panel.set_xlim(*((known.min(), known.max()) if len(known) > 1 else (0.0, 1.0)))
            speed.tick_params(labelbottom=False)
            speed.set_title(_short(each.name), loc="left", fontsize=8.5)
            command.set_xlabel("time in the log, s", fontsize=8)
            if column == 0:
                speed.set_ylabel("speed, m/s", fontsize=8)
                command.set_ylabel("command", fontsize=8)
        handles, labels = panels[0, 0].get_legend_handles_labels()
        more, names = panels[1, 0].get_legend_handles_labels()
        figure.legend([*handles, *more], [*labels, *names], ncols=4, fontsize=8, loc="outside upper right")
        figure.suptitle(title, x=0.01, ha="left", fontsize=8.5)
        return figure


def _joined(time: np.ndarray, speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The known speeds, joined by lines across gaps of less than 3 s."""
    known = np.isfinite(speed)
    time, speed = time[known], speed[known]
    gaps = np.flatnonzero(np.diff(time) > 3.0) + 1
    return np.insert(time, gaps, np.nan), np.insert(speed, gaps, np.nan)


def _short(name: str) -> str:
    return name if len(name) <= 40 else f"…{name[-39:]}"
