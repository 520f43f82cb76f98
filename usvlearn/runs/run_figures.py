"""Figures of a boat's run: what a free run and forecasts predicted, and the forces that were identified."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.estimators.joint.curves import Curve
from usvlearn.estimators.joint.quantities import COMMANDS
from usvlearn.estimators.joint.reading import Identified
from usvlearn.figures import INK, KNOWN, LINE, colours, themed, worst_stretch

LEFT, RIGHT = KNOWN["aid"], KNOWN["sift_map"]  # colours
SPAN, ORIGINS = 240.0, 6  # s of a figure of forecasts, and how many forecasts it shows


class Traces(NamedTuple):
    """A run of one boat."""

    name: str
    time: np.ndarray  # (time,) s
    surge: np.ndarray  # (time,) m/s, NaN where it was not measured
    predicted: np.ndarray  # (time,) m/s


def runs_figure(runs: Sequence[Traces], name: str, title: str):
    """Measured and predicted speed of runs above each other; beside each its worst minute, enlarged.

    Args:
        runs: of one boat.
        name: of the estimator.
        title: of the figure.
    """
    known = [x[np.isfinite(x)] for run in runs for x in (run.surge,)]
    span = max((float(np.ptp(x)) for x in known if len(x)), default=0.0) + 0.1  # m/s, between two runs
    parts = [worst_stretch(run.time, np.abs(run.predicted - run.surge)) for run in runs]
    with themed() as Figure:
        height = 1.0 + 0.42 * max(len(runs), 4)
        figure = Figure(figsize=(8, height), dpi=90)
        figure.subplots_adjust(left=0.17, right=0.985, top=1 - 0.4 / height, bottom=0.45 / height, wspace=0.04)
        left, right = figure.subplots(1, 2, width_ratios=(3, 2), sharey=True)
        style = {"linewidth": 0.9, "color": colours([name])[name], "label": name}
        for panel, chosen in ((left, [slice(None)] * len(runs)), (right, parts)):
            rows = [
                _row(run, part, -k * span, panel is right)
                for k, (run, part) in enumerate(zip(runs, chosen, strict=True))
            ]
            time, surge, predicted = (np.concatenate(column) for column in zip(*rows, strict=True))
            panel.plot(time, surge, color=INK, linewidth=1.6, label="measured")
            panel.plot(time, predicted, **style)
            panel.margins(x=0)
            panel.grid(color=LINE, axis="x")
        for k, (run, part) in enumerate(zip(runs, parts, strict=True)):
            if len(run.time[part]):
                ends = run.time[part][[0, -1]]
                left.fill_between(ends, -k * span, (0.9 - k) * span, color=INK, alpha=0.12, linewidth=0)
        left.set_yticks([-k * span for k in range(len(runs))], [run.name[-18:] for run in runs], fontsize=7)
        left.set(xlabel="time in the run, s", title=title, ylim=((0.5 - len(runs)) * span, span))
        right.set(xlabel=f"s; {span:.1f} m/s between two runs", title="its worst minute")
        right.tick_params(left=False)
        right.legend(ncols=2, fontsize=7, loc="upper right")
        return figure


def _row(run: Traces, part: slice, offset: float, own: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, measured and predicted speed of a run at its height, with a gap at the end."""
    time = run.time[part] - (run.time[part][0] if own and len(run.time[part]) else 0.0)
    heights = run.surge[part] + offset, run.predicted[part] + offset
    return np.append(time, np.nan), np.append(heights[0], np.nan), np.append(heights[1], np.nan)


def identified_figure(
    seasons: Sequence[Mapping[str, Curve]], found: Identified, truth: Mapping[str, float], title: str
):
    """Drag over speed, thrust over command, and steady speed over command, with bands, and known truths.

    Args:
        seasons: of `usvlearn.estimators.joint.curves`, the last one at the end; earlier ones are fainter.
        found: the quantities of the boat at the end.
        truth: quantity -> value.
        title: of the figure.
    """
    lines = {"drag": (0, LEFT), "thrust_left": (1, LEFT), "thrust_right": (1, RIGHT), "steady_speed": (2, LEFT)}
    labels = (
        ("speed, m/s", "drag, N"),
        ("command, share of full scale", "thrust of a side at standstill, N"),
        ("command of both sides, share", "steady speed, m/s"),
    )
    half = found["steady_speed_full"].value / 2
    points = [
        (0, half, "drag_half_speed", INK),
        (1, 1.0, "thrust_full_left", LEFT),
        (1, 1.0, "thrust_full_right", RIGHT),
        *((2, at, f"steady_speed_{name}", INK) for name, at in COMMANDS.items()),
    ]
    with themed() as Figure:
        figure = Figure(figsize=(9.5, 2.9), dpi=90)
        figure.subplots_adjust(left=0.06, right=0.985, top=0.88, bottom=0.17, wspace=0.22)
        panels = figure.subplots(1, 3)
        for k, shown in enumerate(seasons, 1):
            strength, last = k / len(seasons), k == len(seasons)
            for name, (place, colour) in lines.items():
                curve, label = shown[name], name.rpartition("_")[2] if last else None
                panels[place].plot(curve.at, curve.value, color=colour, linewidth=1.4, alpha=strength, label=label)
                style = {"color": colour, "alpha": 0.22 * strength if last else 0.06, "linewidth": 0}
                panels[place].fill_between(curve.at, curve.low, curve.high, **style)
        for place, at, name, colour in points:
            if name in truth:
                panels[place].plot(at, truth[name], marker="x", color=colour, linestyle="", clip_on=False)
        for panel, (xlabel, ylabel) in zip(panels, labels, strict=True):
            panel.set(xlabel=xlabel, ylabel=ylabel)
            panel.grid(color=LINE)
        if len(seasons) > 1:  # early bands may be very wide
            for name, (place, _) in lines.items():
                panels[place].set_ylim(min(0.0, 1.1 * seasons[-1][name].low.min()), 1.3 * seasons[-1][name].high.max())
        panels[1].legend(fontsize=8)
        figure.suptitle(f"{title}: identified", fontsize=9.5)
        return figure


def free_figure(time: np.ndarray, surge: np.ndarray, predictions: np.ndarray, names: Sequence[str], title: str):
    """Measured speed, and what estimators simulate from the commands alone.

    Args:
        time: s, `(time,)`.
        surge: m/s, `(time,)`; NaN where it was not measured.
        predictions: m/s, `(time, estimators)`.
        names: of the estimators.
        title: of the figure.
    """
    palette = colours(names)
    with themed() as Figure:
        figure = Figure(figsize=(7, 3), dpi=100)
        figure.subplots_adjust(left=0.09, right=0.985, top=0.91, bottom=0.15)
        panel = figure.subplots()
        panel.plot(time, surge, color=INK, linewidth=1.8, label="measured")
        errors = np.abs(predictions - surge[:, None])
        for k, name in enumerate(names):
            known = errors[np.isfinite(errors[:, k]), k]
            mae = f", MAE {known.mean():.3f} m/s" if len(known) else ""
            panel.plot(time, predictions[:, k], color=palette[name], linewidth=1.0, label=f"{name}{mae}")
        _frame(panel, surge, title)
        panel.legend(ncols=3, fontsize="small")
        return figure


def forecast_figure(
    time: np.ndarray,
    surge: np.ndarray,
    forecasts: np.ndarray,
    halfwidths: np.ndarray,
    horizons: Sequence[float],
    name: str,
    title: str,
):
    """Measured speed, and the forecasts of some origins with their 90 % intervals.

    Args:
        time: s, `(time,)`.
        surge: m/s, `(time,)`; NaN where it was not measured.
        forecasts, halfwidths: m/s, `(time, horizons)`, at the step at which each became due.
        horizons: s, ascending.
        name: whose forecasts these are.
        title: of the figure.
    """
    part = slice(int(np.searchsorted(time, time[-1] - SPAN)), len(time))
    time, surge, forecasts, halfwidths = time[part], surge[part], forecasts[part], halfwidths[part]
    colour, label = colours([name])[name], f"{name}, 90 %"
    with themed() as Figure:
        figure = Figure(figsize=(7, 3), dpi=100)
        figure.subplots_adjust(left=0.09, right=0.985, top=0.91, bottom=0.15)
        panel = figure.subplots()
        panel.plot(time, surge, color=INK, linewidth=1.8, label="measured")
        ends = np.flatnonzero(np.isfinite(forecasts[:, -1]) & (time - horizons[-1] >= time[0]))
        for end in ends[:: max(1, -(-len(ends) // ORIGINS))]:
            fan = fan_at(time, forecasts, halfwidths, horizons, float(time[end]) - horizons[-1])
            start = int(np.searchsorted(time, time[end] - horizons[-1] - 1e-6))
            at, value, width = (
                np.append(first, x) for first, x in zip((time[start], surge[start], 0.0), fan, strict=True)
            )
            panel.plot(at, value, color=colour, linewidth=0.8, alpha=0.6)  # between the horizons nothing is forecast
            style = {"fmt": "o", "markersize": 2.5, "elinewidth": 1.4, "capsize": 2, "label": label}
            panel.errorbar(at[1:], value[1:], np.where(np.isfinite(width[1:]), width[1:], 0.0), color=colour, **style)
            label = ""
        _frame(panel, surge, title)
        panel.legend(ncols=3, fontsize="small")
        return figure


def fan_at(
    time: np.ndarray, forecasts: np.ndarray, halfwidths: np.ndarray, horizons: Sequence[float], origin: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, forecasts and half-widths of the forecasts that were made closest to an origin, one for each horizon.

    >>> time, made = np.arange(4.0), np.array([[np.nan, np.nan], [1.0, np.nan], [2.0, 5.0], [3.0, np.nan]])
    >>> [x.tolist() for x in fan_at(time, made, 0 * made + 0.1, [1.0, 2.0], 0.0)]
    [[1.0, 2.0], [1.0, 5.0], [0.1, 0.1]]
    """
    found = []
    for j, horizon in enumerate(horizons):
        due = np.flatnonzero(np.isfinite(forecasts[:, j]))
        if len(due):
            k = due[np.abs(time[due] - origin - horizon).argmin()]
            if abs(time[k] - origin - horizon) <= 0.5 * horizon:
                found.append((time[k], forecasts[k, j], halfwidths[k, j]))
    at, value, width = np.array(found).reshape(-1, 3).T
    return at, value, width


def _frame(panel, surge: np.ndarray, title: str) -> None:
    seen = surge[np.isfinite(surge)]
    low, high = (seen.min(), seen.max()) if len(seen) else (0.0, 1.0)
    margin = 0.3 * (high - low) + 0.05
    panel.set(xlabel="time in the run, s", ylabel="surge, m/s", title=title, ylim=(low - margin, high + margin))
    panel.margins(x=0)
    panel.grid(color=LINE)
