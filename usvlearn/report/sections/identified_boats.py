"""The physical quantities of each boat at the end of the season, with 90 % intervals, and curves of its forces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.joint.curves import Curve, curves
from usvlearn.estimators.joint.quantities import COMMANDS, MEANING
from usvlearn.estimators.joint.reading import Identified
from usvlearn.evaluation.identification import Truth, identified_boats
from usvlearn.evaluation.season import Season
from usvlearn.figures import INK, KNOWN, LINE, themed
from usvlearn.identified import sentences
from usvlearn.report.result_table import ResultTable
from usvlearn.report.section import Drawn, Section
from usvlearn.signals import tree_map

LEFT, RIGHT = KNOWN["aid"], KNOWN["sift_map"]  # colours
CAPTION = "Lines: identified. Bands: 90 %."


def identified_section(seasons: Sequence[Season], ensemble: Ensemble, truth: Truth) -> Section | None:
    """A table of all quantities, and a figure of curves per boat; None if no member is a reader.

    Args:
        seasons: of all boats.
        ensemble: to which the sets belong.
        truth: quantities of simulated boats, else empty.
    """
    rows, drawn, held, boats = [], [], [], {}
    for season in seasons:
        last = tree_map(lambda leaf: leaf[-1:], season.state)
        found = identified_boats(ensemble, last, [season.boat]).get(season.boat)
        if found is None:
            return None
        known = truth.get(season.boat, {})
        for name, (value, low, high, unit) in found.items():
            rows.append((season.boat, name, unit, value, low, high, known.get(name)))
            if name in known:
                held.append(low <= known[name] <= high)
        boats[season.boat] = found
        if shown := curves(found):
            figure = identified_figure(shown, found, known, season.boat)
            drawn.append(Drawn(f"identified_{season.boat}", figure, CAPTION + (" Crosses: truth." if known else "")))
    here = [MEANING, *sentences(boats)]
    if held:
        here.insert(0, f"The intervals hold {100 * np.mean(held):.0f} % of the truths at the end (90 % asked).")
    columns = ("boat", "quantity", "unit", "value", "from (90 %)", "to (90 %)", "truth")
    return Section("identified", "Identified boats", "", here, drawn, [ResultTable("identified", columns, rows)])


def identified_figure(shown: Mapping[str, Curve], found: Identified, truth: Mapping[str, float], title: str):
    """Drag over speed, thrust over command, and steady speed over command, each with its band, and known truths.

    Args:
        shown: of `usvlearn.estimators.joint.curves`.
        found: the quantities of the boat.
        truth: quantity -> value.
        title: of the figure.
    """
    lines = {"drag": (0, LEFT), "thrust_left": (1, LEFT), "thrust_right": (1, RIGHT), "steady_speed": (2, LEFT)}
    labels = (
        ("speed, m/s", "drag, N"),
        ("command, share of full scale", "thrust of a side at standstill, N"),
        ("command of both sides, share of full scale", "steady speed, m/s"),
    )
    half = found["steady_speed_full"].value / 2
    points = [
        (0, half, "drag_half_speed", INK),
        (1, 1.0, "thrust_full_left", LEFT),
        (1, 1.0, "thrust_full_right", RIGHT),
        *((2, at, f"steady_speed_{name}", INK) for name, at in COMMANDS.items()),
    ]
    with themed() as Figure:
        figure = Figure(figsize=(9.5, 2.9), layout="constrained")
        panels = figure.subplots(1, 3)
        for name, (place, colour) in lines.items():
            curve, label = shown[name], name.rpartition("_")[2]
            panels[place].plot(curve.at, curve.value, color=colour, linewidth=1.4, label=label)
            panels[place].fill_between(curve.at, curve.low, curve.high, color=colour, alpha=0.22, linewidth=0)
        for place, at, name, colour in points:
            if name in truth:
                panels[place].plot(at, truth[name], marker="x", color=colour, linestyle="", clip_on=False)
        for panel, (xlabel, ylabel) in zip(panels, labels, strict=True):
            panel.set(xlabel=xlabel, ylabel=ylabel)
            panel.grid(color=LINE)
        panels[1].legend(fontsize=8)
        figure.suptitle(f"{title}: identified", fontsize=9.5)
        return figure
