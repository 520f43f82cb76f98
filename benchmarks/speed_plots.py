"""Figures of the measurements of speed."""

from collections.abc import Mapping

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from timing import micro

matplotlib.rcParams |= {"svg.hashsalt": "speed", "svg.fonttype": "none", "font.size": 9, "axes.axisbelow": True}
WIDTH = 8.0  # inches


def bars(costs: Mapping[str, Mapping[str, float | None]]) -> Figure:
    """Seconds of a step by estimator and way, on a logarithmic axis."""
    ways = list(next(iter(costs.values())))
    figure = Figure((WIDTH, 0.6 * len(costs) + 0.8), layout="constrained")
    axes = figure.subplots()
    height = 0.8 / len(ways)
    for k, way in enumerate(ways):
        values = np.array([np.nan if x[way] is None else 1e6 * x[way] for x in costs.values()])
        places = np.arange(len(costs)) + (k - (len(ways) - 1) / 2) * height
        axes.barh(places, values, height, label=way)
        for place, value in zip(places, values, strict=True):
            if np.isfinite(value):
                axes.annotate(
                    micro(value / 1e6), (value, place), (2, 0), textcoords="offset points", va="center", size=6
                )
    axes.set_yticks(range(len(costs)), list(costs))
    axes.set(xscale="log", xlabel="µs a step", ylim=(len(costs) - 0.5, -0.5))
    axes.margins(x=0.1)
    axes.grid(axis="x", which="both", alpha=0.25)
    figure.legend(loc="outside upper center", ncols=len(ways))
    return figure


def throughput(costs: Mapping[tuple[str, int], Mapping[int, float]]) -> Figure:
    """Seconds of an element-step against batch elements, by estimator and threads."""
    figure = Figure((WIDTH, 3.6), layout="constrained")
    axes = figure.subplots()
    names = list(dict.fromkeys(name for name, _ in costs))
    for (name, threads), by_elements in costs.items():
        style, label = ("-", name) if threads == 1 else ("--", f"{name}, {threads} threads")
        color = f"C{names.index(name)}"
        axes.plot(
            list(by_elements),
            [1e6 * x for x in by_elements.values()],
            style,
            color=color,
            marker="o",
            ms=4,
            label=label,
        )
    elements = list(next(iter(costs.values())))
    axes.set(xscale="log", yscale="log", xlabel="batch elements", ylabel="µs an element-step")
    axes.set_xticks(elements, [str(n) for n in elements])
    axes.minorticks_off()
    axes.grid(alpha=0.25)
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


def growth_curves(kinds: Mapping[str, Mapping[str, Mapping[int, float]]]) -> Figure:
    """Seconds of a step against each size, in a panel of its own."""
    figure = Figure((WIDTH, 2.8), layout="constrained")
    for k, (axes, (kind, ways)) in enumerate(zip(figure.subplots(1, len(kinds)), kinds.items(), strict=True)):
        for j, (way, by_size) in enumerate(ways.items()):
            if by_size:
                costs = [1e6 * x for x in by_size.values()]
                axes.plot(list(by_size), costs, color=f"C{j}", marker="o", ms=4, label=way)
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.set(xlabel=kind, ylim=(0, None), ylabel="" if k else "µs a step")
        axes.grid(alpha=0.25)
        axes.legend()
    return figure
