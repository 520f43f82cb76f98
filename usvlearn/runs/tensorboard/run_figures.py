"""Figures of a boat's run: what open-loop simulation and forecasts predicted, and the forces that were identified."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.display.figures import INK, KNOWN, LINE, SIDES, WORST, colours, guarded, set_reach, themed, worst_stretch
from usvlearn.estimators.joint.curves import Curve
from usvlearn.estimators.joint.quantities import COMMANDS
from usvlearn.estimators.joint.reading import Identified

READ, LEFT, RIGHT = KNOWN["joint_averaged"], *SIDES.values()  # colours: of what is identified, of the thrusters
SPAN, ORIGINS = 240.0, 6  # s of a figure of forecasts, and how many forecasts it shows


class Traces(NamedTuple):
    """A run of one boat."""

    name: str
    time: np.ndarray  # (time,) s
    surge: np.ndarray  # (time,) m/s, NaN where it was not measured
    predicted: np.ndarray  # (time,) m/s


@guarded
def runs_figure(runs: Sequence[Traces], name: str, title: str):
    """Measured and predicted speed of runs above each other, with their MAE; beside each the error of its worst minute.

    Args:
        runs: of one boat.
        name: of the estimator.
        title: of the figure.
    """
    known = [run.surge[np.isfinite(run.surge)] for run in runs]
    errors = [run.predicted - run.surge for run in runs]
    parts = [worst_stretch(run.time, np.abs(error)) for run, error in zip(runs, errors, strict=True)]
    worst = np.concatenate([np.abs(error[part]) for error, part in zip(errors, parts, strict=True)])
    floor = min((float(x.min()) for x in known if len(x)), default=0.0)
    span = max((float(x.max()) for x in known if len(x)), default=0.0) - floor + 0.1  # m/s, between two runs
    scale = 2 * float(np.nanmax(worst)) + 0.02 if np.isfinite(worst).any() else 1.0  # m/s, between two errors
    with themed() as Figure:
        height = 1.2 + 0.42 * max(len(runs), 4)
        figure = Figure(figsize=(9, height), dpi=90)
        figure.subplots_adjust(left=0.25, right=0.985, top=1 - 0.6 / height, bottom=0.45 / height, wspace=0.06)
        left, right = figure.subplots(1, 2, width_ratios=(3, 2))
        colour, whole = colours([name])[name], [slice(None)] * len(runs)
        measured, predicted = [run.surge - floor for run in runs], [run.predicted - floor for run in runs]
        left.plot(*_rows(runs, measured, whole, span), color=INK, linewidth=1.6, label="measured")
        left.plot(*_rows(runs, predicted, whole, span), color=colour, linewidth=0.9, label=name)
        right.plot(*_rows(runs, errors, parts, scale), color=colour, linewidth=1.0)
        right.hlines([-k * scale for k in range(len(runs))], 0, WORST, color=INK, linewidth=0.5)
        for k, (run, part) in enumerate(zip(runs, parts, strict=True)):
            if len(run.time[part]):
                ends = run.time[part][[0, -1]]
                left.fill_between(ends, -k * span, (0.9 - k) * span, color=INK, alpha=0.12, linewidth=0)
        labels = [f"{_short(run.name)}  {_mae(error)}" for run, error in zip(runs, errors, strict=True)]
        left.set_yticks([-k * span for k in range(len(runs))], labels, fontsize=8)
        left.set(xlabel=f"time in the run, s; {span:.1f} m/s between two runs", ylim=((0.5 - len(runs)) * span, span))
        right.set_yticks([])
        right.set(xlabel=f"s; {scale:.2f} m/s between two runs", title="predicted − measured, worst minute")
        right.set_ylim((0.5 - len(runs)) * scale, 0.6 * scale)
        for panel in (left, right):
            panel.margins(x=0)
            panel.grid(color=LINE, axis="x")
            panel.title.set_fontsize(9)
        figure.suptitle(f"{title}, MAE in m/s", x=0.01, ha="left", fontsize=9)
        left.legend(ncols=2, fontsize=8, loc="lower right", bbox_to_anchor=(1, 1), borderaxespad=0.1)
        return figure


def _rows(
    runs: Sequence[Traces], lines: Sequence[np.ndarray], parts: Sequence[slice], span: float
) -> tuple[np.ndarray, np.ndarray]:
    """Time and height of a part of each run, one below the other, with gaps between; a part begins at 0 s."""
    times, heights = [], []
    for k, (run, line, part) in enumerate(zip(runs, lines, parts, strict=True)):
        time = run.time[part]
        times.append(np.append(time - (time[0] if part.start and len(time) else 0.0), np.nan))
        heights.append(np.append(line[part] - k * span, np.nan))
    return np.concatenate(times), np.concatenate(heights)


def _short(name: str) -> str:
    return name if len(name) <= 18 else f"{name[:17]}…"


def _mae(error: np.ndarray) -> str:
    return f"{np.nanmean(np.abs(error)):.3f}" if np.isfinite(error).any() else "–"


@guarded
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
    lines = {"drag": (0, READ), "thrust_left": (1, LEFT), "thrust_right": (1, RIGHT), "steady_speed": (2, READ)}
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
                set_reach(
                    panels[place], min(0.0, 1.1 * seasons[-1][name].low.min()), 1.3 * seasons[-1][name].high.max()
                )
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
        panel.legend(ncols=3, fontsize=8)
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
            start = min(int(np.searchsorted(time, time[end] - horizons[-1] - 1e-6)), int(end))
            at, value, width = (
                np.append(first, x) for first, x in zip((time[start], surge[start], 0.0), fan, strict=True)
            )
            panel.plot(at, value, color=colour, linewidth=0.8, alpha=0.6)  # between the horizons nothing is forecast
            style = {"fmt": "o", "markersize": 2.5, "elinewidth": 1.4, "capsize": 2, "label": label}
            panel.errorbar(at[1:], value[1:], np.where(np.isfinite(width[1:]), width[1:], 0.0), color=colour, **style)
            label = ""
        _frame(panel, surge, title)
        panel.legend(ncols=3, fontsize=8)
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
