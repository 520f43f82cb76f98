"""Figures of a season: the paper's 3, 4 and 5, certificates and parameters over the hours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from usvlearn.display.figures import INK, LINE, colours, guarded, panels_of, set_reach, themed

WORSE = "#C0392B"  # colour of failures
ROW = 0.19  # inch, of a method
ACROSS = 4  # panels


class Box(NamedTuple):
    """A distribution, as it appears in figures and tables."""

    median: float
    lower: float  # quartile
    upper: float
    low: float  # 5 %
    high: float  # 95 %
    mean: float
    number: int  # of values
    beyond: np.ndarray  # the values outside low … high
    outliers: int  # more than 1.5 quartile distances above the box
    diverged: int = 0


def box(values: np.ndarray, diverged: int = 0) -> Box | None:
    """The box of some errors, or None if there are none.

    >>> box(np.arange(101.0)).median
    50.0
    """
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    low, lower, median, upper, high = (float(x) for x in np.percentile(values, (5, 25, 50, 75, 95)))
    beyond = values[(values < low) | (values > high)]
    outliers = int((values > upper + 1.5 * (upper - lower)).sum())
    return Box(median, lower, upper, low, high, float(values.mean()), len(values), beyond, outliers, diverged)


@guarded
def boxes_figure(
    boats: Mapping[str, Mapping[str, Box | None]],
    subtitles: Mapping[str, str],
    xlabel: str,
    points: bool = True,
    reference: str | None = None,
    least: float = 0.0,
):
    """A panel per boat, a row per method: quartiles, 5 and 95 %, mean, values beyond, and the number of diverged runs.

    Args:
        boats: the boxes of each boat, by method, the same methods for all.
        subtitles: under each boat's name.
        xlabel: of the errors, with their unit; the axis is logarithmic.
        points: whether values beyond 5 and 95 % are drawn.
        reference: the method whose mean is drawn as a line.
        least: lowest possible start of the axis, in the errors' unit.

    >>> figure = boxes_figure({"heron": {"aid": box(np.array([0.1, 0.2]))}}, {"heron": "1 h"}, "error, m/s")
    >>> figure.axes[0].get_title(loc="left")
    'heron, 1 h'
    """
    names = list(next(iter(boats.values())))
    palette, across = colours(names), min(ACROSS, len(boats))
    down = -(-len(boats) // across)
    values = [x for row in boats.values() for each in row.values() if each for x in (each.low, each.high, each.mean)]
    values += [x for row in boats.values() for each in row.values() if each and points for x in each.beyond]
    known = np.array([x for x in values if x > 0])
    room = 4.0 if any(each and each.diverged for row in boats.values() for each in row.values()) else 1.3
    limits = (max(least, known.min() * 0.8), known.max() * room) if len(known) else (0.01, 1.0)
    height = ROW * len(names) + 0.55
    with themed() as Figure:
        figure = Figure(figsize=(1.4 + 2.3 * across, 0.45 + height * down), layout="constrained")
        panels = panels_of(figure, len(boats), across, sharex=True, sharey=True)
        for panel, (boat, row) in zip(panels, boats.items(), strict=True):
            panel.set_title(f"{boat}, {subtitles[boat]}", loc="left", fontsize=8.5)
            panel.set(xscale="log", xlim=limits, ylim=(len(names) - 0.4, -0.6), yticks=range(len(names)))
            panel.set_yticklabels(names, fontsize=8)
            panel.tick_params(axis="y", length=0)
            panel.grid(axis="x", which="major")
            if reference is not None and (base := row.get(reference)) is not None:
                panel.axvline(base.mean, color=INK, linewidth=0.8, linestyle=":")
            for k, name in enumerate(names):
                _draw_box(panel, k, row[name], palette[name], name.endswith("+"), points)
        for k, panel in enumerate(panels):
            panel.xaxis.set_major_formatter("{x:g}")
            panel.xaxis.set_minor_formatter("")
            panel.tick_params(labelbottom=k + across >= len(boats), labelsize=8)
        figure.supxlabel(xlabel, fontsize=9, color=INK)
        return figure


def _over_hours(panels: Sequence, across: int) -> None:
    """Draw a grid in each panel, and label the axis under the lowest panel of each column."""
    for k, panel in enumerate(panels):
        panel.grid(color=LINE)
        if k + across >= len(panels):
            panel.set_xlabel("time on the water, h")
            panel.tick_params(labelbottom=True)


def _draw_box(panel, place: int, found: Box | None, colour: str, learning: bool, points: bool) -> None:
    if found is None:
        return
    panel.plot([found.low, found.high], [place, place], color=colour, linewidth=1.1, solid_capstyle="butt")
    wide = [found.lower, max(found.upper, found.lower * 1.01)]
    panel.fill_between(
        wide, place - 0.33, place + 0.33, facecolor="none" if learning else colour, edgecolor=colour, linewidth=1.1
    )
    panel.plot([found.median] * 2, [place - 0.33, place + 0.33], color=INK, linewidth=1.4)
    panel.plot(found.mean, place, marker="D", markersize=3.2, color="white", markeredgecolor=INK, markeredgewidth=0.8)
    if points and len(found.beyond):
        style = {"linestyle": "none", "marker": ".", "markersize": 2.2, "color": colour, "alpha": 0.5}
        panel.plot(found.beyond, np.full(len(found.beyond), place), rasterized=len(found.beyond) > 500, **style)
    if found.diverged:
        at = {"xycoords": ("axes fraction", "data"), "fontsize": 7, "ha": "right", "va": "center"}
        panel.annotate(f"{found.diverged} div.", (1.0, place), color=WORSE, **at)


@guarded
def matrix_figure(matrices: Mapping[str, np.ndarray], boats: Sequence[str]):
    """MSE of the best checkpoint of each boat (rows) on the runs of each boat (columns); the least of a column is
    framed.

    The colours of all methods have one scale.

    Args:
        matrices: `(boats, boats)`, m²/s², by method.
        boats: their names.

    >>> figure = matrix_figure({"average": np.array([[0.01, 0.04], [0.03, 0.02]])}, ["anna", "bert"])
    >>> [text.get_text() for text in figure.axes[0].texts]
    ['10', '40', '30', '20']
    """
    from matplotlib.colors import LogNorm
    from matplotlib.patches import Rectangle
    from matplotlib.ticker import LogLocator

    across, size = min(2, len(matrices)), 0.42 * len(boats) + 1.4
    down = -(-len(matrices) // across)
    every = np.concatenate([matrix[np.isfinite(matrix) & (matrix > 0)] for matrix in matrices.values()])
    low, high = (every.min(), every.max()) if len(every) else (1e-4, 1.0)
    norm = LogNorm(low, high if high > low else low * 1.01)  # one scale, so that the methods can be compared
    with themed() as Figure:
        figure = Figure(figsize=(size * across + 0.4, size * down), layout="constrained")
        panels = panels_of(figure, len(matrices), across)
        for panel, (name, matrix) in zip(panels, matrices.items(), strict=True):
            image = panel.imshow(np.where(matrix > 0, matrix, np.nan), norm=norm, cmap="cividis", aspect="equal")
            for (row, column), value in np.ndenumerate(matrix):
                dark = not np.isfinite(value) or value <= 0 or norm(value) < 0.55
                text = "–" if not np.isfinite(value) else f"{1000 * value:.3g}"
                style = {"ha": "center", "va": "center", "fontsize": 7.5, "color": "white" if dark else "#010101"}
                panel.text(column, row, text, **style)
            for column in range(matrix.shape[1]):
                if np.isfinite(matrix[:, column]).any():
                    best = int(np.nanargmin(matrix[:, column]))
                    frame: dict[str, Any] = {"fill": False, "edgecolor": WORSE, "linewidth": 1.8}
                    panel.add_patch(Rectangle((column - 0.47, best - 0.47), 0.94, 0.94, **frame))
            panel.set_xticks(range(len(boats)), boats, rotation=45, ha="right", rotation_mode="anchor", fontsize=8)
            panel.set_yticks(range(len(boats)), boats, fontsize=8)
            panel.tick_params(length=0)
            panel.spines[:].set_visible(False)
            panel.set_title(name, loc="left", fontsize=10)
            panel.set(xlabel="runs of", ylabel="best checkpoint of")
        bar = figure.colorbar(image, ax=panels, shrink=0.75, ticks=LogLocator(subs=(1, 2, 5)))
        bar.ax.yaxis.set_major_formatter(lambda x, _: f"{1000 * x:g}")
        bar.ax.minorticks_off()
        bar.ax.tick_params(labelsize=7.5)
        bar.set_label("MSE, 10⁻³ m²/s²", color=INK)
        bar.outline.set_visible(False)
        return figure


def boat_colours(boats: Sequence[str]) -> dict[str, Any]:
    """A shade for each boat; hues are reserved for methods."""
    from matplotlib import colormaps

    shades = colormaps["viridis"](np.linspace(0.25, 0.92, max(2, len(boats))))
    return dict(zip(boats, shades, strict=False))


@guarded
def rates_figure(hours: Mapping[str, np.ndarray], rates: Mapping[str, np.ndarray]):
    """The contraction rate K at every saved checkpoint, a line per boat: certified where it is below one.

    Args:
        hours: of the checkpoints, `(sets,)`, by boat.
        rates: K, `(sets,)`, by boat.
    """
    shades = boat_colours(list(hours))
    with themed() as Figure:
        figure = Figure(figsize=(6.4, 2.9), layout="constrained")
        panel = figure.subplots()
        for boat, values in rates.items():
            panel.plot(hours[boat], values, color=shades[boat], linewidth=1.3, marker=".", markersize=3, label=boat)
        every = np.concatenate(list(rates.values()))
        low, high = np.nanmin(every, initial=1.0), np.nanmax(every, initial=1.0)
        room = 0.08 * (high - low) + 1e-3
        set_reach(panel, low - room, high + room)
        panel.axhspan(1.0, high + room, color=WORSE, alpha=0.12, linewidth=0)
        panel.axhline(1.0, color=WORSE, linewidth=1)
        panel.set_ylabel("contraction rate K, per step")
        _over_hours([panel], 1)
        figure.legend(*panel.get_legend_handles_labels(), loc="outside upper left", ncols=8, fontsize=8)
        return figure


class Course(NamedTuple):
    """One identified quantity over a season."""

    hours: np.ndarray  # (sets,)
    value: np.ndarray  # (sets,)
    deviation: np.ndarray | None = None  # (sets,) standard deviation, if the estimator has one


@guarded
def parameters_figure(
    courses: Mapping[str, Mapping[str, Course]],
    units: Mapping[str, str],
    truth: Mapping[str, tuple[np.ndarray, np.ndarray]],
    title: str,
):
    """A panel per parameter: each method's value over the hours, the band of the noise, and the truth.

    Args:
        courses: by parameter and method.
        units: of the parameters.
        truth: hours and values, by parameter; empty for recorded logs.
        title: of the figure.

    >>> course = Course(np.arange(3.0), np.ones(3))
    >>> figure = parameters_figure({"drag_linear": {"aid": course}}, {"drag_linear": "kg/s"}, {}, "heron")
    >>> figure.axes[0].get_title(loc="left")
    'drag_linear, kg/s'
    """
    palette = colours(list(dict.fromkeys(name for row in courses.values() for name in row)))
    across = min(3, len(courses))
    down = -(-len(courses) // across)
    with themed() as Figure:
        figure = Figure(figsize=(3.1 * across + 0.2, 1.65 * down + 0.8), layout="constrained")
        panels = panels_of(figure, len(courses), across, sharex=True)
        for panel, (parameter, row) in zip(panels, courses.items(), strict=True):
            shown = []
            for name, (hours, value, deviation) in row.items():
                panel.plot(hours, value, color=palette[name], linewidth=1.4, label=name)
                shown.append(value)
                if deviation is not None:
                    low, high = value - 1.645 * deviation, value + 1.645 * deviation
                    label = f"{name}, 90 % of noise alone"
                    panel.fill_between(hours, low, high, color=palette[name], alpha=0.22, linewidth=0, label=label)
                    settled = slice(len(value) // 4, None)  # the first bands are those of the prior
                    shown += [low[settled], high[settled]]
            if parameter in truth:
                panel.plot(*truth[parameter], color=INK, linewidth=1.4, linestyle="--", label="truth")
                shown.append(truth[parameter][1])
            known = np.concatenate(shown)
            known = known[np.isfinite(known)]
            if len(known):
                room = 0.08 * (known.max() - known.min()) + 1e-6
                panel.set_ylim(known.min() - room, known.max() + room)
            panel.set_title(f"{parameter}, {units[parameter]}", loc="left", fontsize=8.5)
            panel.tick_params(labelsize=8)
        _over_hours(panels, across)
        handles: dict[str, Any] = {}
        for panel in panels:
            handles |= {label: handle for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)}
        figure.legend(handles.values(), handles, loc="outside upper left", ncols=5, fontsize=8, title=title,
                      title_fontsize=9, alignment="left")  # fmt: skip
        return figure
