"""The physical quantities of each boat at the end of the season, with 90 % intervals, and curves of its forces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from usvlearn.core.samples import tree_map
from usvlearn.display.result_table import ResultTable
from usvlearn.engine.identified import sentences
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.joint.curves import curves
from usvlearn.estimators.joint.quantities import MEANING
from usvlearn.evaluation.identification import Truth, identified_boats
from usvlearn.evaluation.season import Season
from usvlearn.report.sections.section import Drawn, Section
from usvlearn.runs.figures import identified_figure

CAPTION = "Lines: identified. Bands: 90 %."


def identified_section(seasons: Sequence[Season], ensemble: Ensemble, truth: Truth) -> Section | None:
    """A table of all quantities, and a figure of curves per boat; None if no member is an averaged joint EKF.

    Args:
        seasons: of all boats.
        ensemble: to which the checkpoints belong.
        truth: quantities of simulated boats, else empty.
    """
    rows, drawn, held, boats = [], [], [], {}
    for season in seasons:
        last = tree_map(lambda leaf: leaf[-1:], season.state)
        found = identified_boats(ensemble, last, [season.boat]).get(season.boat)
        if found is None:
            return None
        known = truth.get(season.boat, {})
        for name, (_, low, high, _) in found.items():
            value, start, end, unit = found.displayed(name)
            rows.append((season.boat, name, unit, value, start, end, known.get(name)))
            if name in known:
                held.append(low <= known[name] <= high)
        boats[season.boat] = found
        if shown := curves(found):
            figure = identified_figure([shown], found, known, season.boat)
            drawn.append(Drawn(f"identified_{season.boat}", figure, CAPTION + (" Crosses: truth." if known else "")))
    here = [MEANING, *sentences(boats)]
    if held:
        here.insert(0, f"The intervals hold {100 * np.mean(held):.0f} % of the truths at the end (90 % asked).")
    columns = ("boat", "quantity", "unit", "value", "from (90 %)", "to (90 %)", "truth")
    return Section("identified", "Identified boats", "", here, drawn, [ResultTable("identified", columns, rows)])
