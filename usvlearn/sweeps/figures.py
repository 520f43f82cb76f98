"""The figures of a sweep: its settings in their order, and the objective against each swept key."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from usvlearn.display.figures import INK, LINE, colours, rendered, themed
from usvlearn.evaluation.comparison import short_keys
from usvlearn.evaluation.objective import Measure
from usvlearn.sweeps.ranking import Standing

MOST_ROWS = 25  # settings
MOST_PANELS = 6
LOGARITHMIC = 20.0  # a ratio of the greatest to the least value, from which on an axis is logarithmic
WORST = 90  # percentile; values far beyond it are off the axis


def sweep_figure(ranks: Sequence[Standing], keys: Sequence[str], measure: Measure | None) -> bytes | None:
    """A PNG; None if no setting has a value, or nothing is swept.

    One panel per key: each point is a setting, a bar its deviation over seeds, the line joins the best of each value.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    shown = [each for each in ranks if each.value is not None]
    keys = list(keys)[:MOST_PANELS]
    if not shown or not keys:
        return None
    what = _words(measure)
    with themed() as Figure:
        figure = Figure(figsize=(min(4.4 * len(keys), 15) + 0.6, 4.2), dpi=90, layout="constrained")
        axes = np.atleast_1d(figure.subplots(1, len(keys)))
        ends = [
            (each.value + sign * (each.deviation or 0.0))
            for each in shown
            if each.value is not None
            for sign in (-1, 1)
        ]
        low, high = -_top([-x for x in ends]), _top(ends)
        margin = 0.08 * (high - low) or 0.05 * abs(high) or 0.01
        for panel, key in zip(axes, keys, strict=False):
            _draw(panel, shown, key, measure)
            panel.set_ylim(low - margin, high + margin)
        axes[0].set_ylabel(what)
        lines = {line.get_label(): line for panel in axes for line in panel.get_lines() if line.get_label()[0] != "_"}
        figure.legend(lines.values(), lines, ncols=len(lines), fontsize="small", loc="outside upper left")
        return rendered(figure, facecolor="white")


def settings_figure(ranks: Sequence[Standing], keys: Sequence[str], measure: Measure | None) -> bytes | None:
    """A PNG with a row per setting, the best above; None for less than two settings with a value.

    Small points are jobs, the large one is their mean. A bar is where the mean is by the paired difference to the
    reference, with its 95 % interval: over seeds, or over runs if there is none over seeds.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    known = [each for each in ranks if each.value is not None]
    shown = known[:MOST_ROWS]
    if len(shown) < 2 or not keys:
        return None
    own = measure.estimator if measure else "ensemble"
    reference = next((each.value for each in known if each.reference), None)
    intervals, paired = [_interval(each) for each in shown], any(_interval(each, "seeds") for each in shown)
    with themed() as Figure:
        figure = Figure(figsize=(7.4, 1.5 + 0.27 * len(shown)), dpi=90, layout="constrained")
        panel, colour = figure.subplots(), colours([own])[own]
        for k, (each, interval) in enumerate(zip(shown, intervals, strict=True)):
            values = list(each.by_seed.values())
            panel.plot(values, [k] * len(values), ".", color=INK, markersize=4, alpha=0.45)
            if interval and reference is not None:
                ends = [reference + x for x in interval]
                panel.plot(ends, [k, k], color=colour, linewidth=5, alpha=0.4, solid_capstyle="butt")
            panel.plot(each.value, k, "o", color=colour, markersize=7)
        if reference is not None:
            panel.axvline(reference, color=INK, linewidth=0.9, linestyle=":")
        names = [" ".join(f"{short}={each.settings[key]}" for short, key in zip(short_keys(keys), keys, strict=True)
                          if key in each.settings) for each in shown]  # fmt: skip
        panel.set_yticks(range(len(shown)), [shortened(name, 44) for name in names])
        panel.set_ylim(len(shown) - 0.5, -0.5)
        panel.grid(axis="x", color=LINE, alpha=0.6)
        panel.set_xlabel(_words(measure))
        over = "seeds" if paired else "runs"
        bars = f"; bar: 95 % of the paired difference, over {over}" if any(intervals) else ""
        more = f"; {len(known) - len(shown)} more settings" if len(known) > len(shown) else ""
        panel.set_title(f"point: job; disc: mean; dotted: reference{bars}{more}", loc="left", fontsize=8.5)
        return rendered(figure, facecolor="white")


def _interval(each: Standing, over: str = "") -> tuple[float, float] | None:
    """The interval of the difference to the reference: over seeds, else over runs unless seeds are asked for."""
    found = each.difference
    for one in (found and found.over_seeds, None if over else found):
        if one is not None and one.low is not None and one.high is not None:
            return one.low, one.high
    return None


def _words(measure: Measure | None) -> str:
    """What the axis of the objective shows."""
    if measure is None:
        return "MAE of each job's output, m/s"
    return f"{measure.title()}, {measure.unit}".removesuffix(", ")


def _draw(panel: Any, shown: Sequence[Standing], key: str, measure: Measure | None) -> None:
    """All settings over the values of one key."""
    values = _ordered([each.settings.get(key, "") for each in shown])
    places = _places(panel, values)
    colour = colours([measure.estimator if measure else "ensemble"])[measure.estimator if measure else "ensemble"]
    x = np.array([places[each.settings.get(key, "")] for each in shown])
    y = np.array([each.value for each in shown], float)
    error = np.array([each.deviation or 0.0 for each in shown])
    panel.errorbar(x, y, error, fmt="o", color=colour, markersize=4.5, alpha=0.75, elinewidth=1, capsize=2)
    best = [min((each for each in shown if each.settings.get(key, "") == v), key=shown.index) for v in values]
    line = [each.value for each in best]
    panel.plot([places[v] for v in values], line, color=colour, linewidth=1.6, zorder=1, label="best of each value")
    winner = shown[0]
    panel.plot(places[winner.settings.get(key, "")], winner.value, "*", color=INK, markersize=12, label="best of all")
    for each in shown:
        if each.default:
            place = places[each.settings.get(key, "")], each.value
            panel.plot(*place, "s", color=INK, markersize=14, markerfacecolor="none", label="default")
    panel.set_xlabel(shortened(key, 40))
    panel.grid(color=LINE, alpha=0.6)


def shortened(text: str, most: int = 16) -> str:
    """A text that fits an axis; its end distinguishes values such as paths."""
    return text if len(text) <= most else f"…{text[1 - most :]}"


def _top(values: Any) -> float:
    """The greatest value, or where the axis ends if that is far from the others."""
    most = float(np.percentile(values, WORST))
    return float(np.max(values)) if np.max(values) <= most + 2 * (most - np.min(values)) else most


def _ordered(values: Sequence[str]) -> list[str]:
    """Distinct values: numbers in their order, else as they came, sorted."""
    distinct = list(dict.fromkeys(values))
    return sorted(distinct, key=float) if _numeric(distinct) else sorted(distinct)


def _numeric(values: Sequence[str]) -> bool:
    try:
        return all(np.isfinite([float(value) for value in values]))
    except ValueError:
        return False


def _places(panel: Any, values: Sequence[str]) -> dict[str, float]:
    """Where each value is on the axis, which is made logarithmic for numbers of several sizes."""
    if not _numeric(values):
        names = [shortened(value) for value in values]
        panel.set_xticks(range(len(values)), names, rotation=30 if sum(map(len, names)) > 30 else 0)
        panel.set_xlim(-0.5, len(values) - 0.5)
        return {value: float(k) for k, value in enumerate(values)}
    numbers = {value: float(value) for value in values}
    least, greatest = min(numbers.values()), max(numbers.values())
    if least > 0 and greatest / least >= LOGARITHMIC:
        panel.set_xscale("log")
        panel.xaxis.set_major_formatter("{x:g}")
        panel.xaxis.set_minor_formatter("")
    if len(values) <= 8:
        panel.set_xticks(list(numbers.values()), values)
        panel.minorticks_off()
    return numbers
