"""What was identified of each boat at the end, and the size and cost of each method."""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from usvlearn.core.protocol import Estimator
from usvlearn.core.samples import Inputs, Sample, named_leaves, tree_map
from usvlearn.display.terminal import Cell, ResultTable
from usvlearn.engine.identified import sentences
from usvlearn.engine.online import Online
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.joint.curves import curves
from usvlearn.estimators.joint.quantities import MEANING
from usvlearn.evaluation.diagnostics import Truth as Quantities
from usvlearn.evaluation.diagnostics import identified_boats, unwrapped
from usvlearn.evaluation.season import Season
from usvlearn.report.sections.section import Drawn, Section
from usvlearn.runs.figures import identified_figure

CAPTION = "Lines: identified. Bands: 90 %."


def identified_section(seasons: Sequence[Season], ensemble: Ensemble, truth: Quantities) -> Section | None:
    """A table of all quantities, and a figure of curves per boat; None if no member is an averaged joint EKF."""
    rows, drawn, held, boats = [], [], [], {}
    for season in seasons:
        last = tree_map(lambda leaf: leaf[-1:], season.state)
        identified = identified_boats(ensemble, last, [season.boat]).get(season.boat)
        if identified is None:
            return None
        known = truth.get(season.boat, {})
        for name, (_, low, high, _) in identified.items():
            value, start, end, unit = identified.displayed(name)
            rows.append((season.boat, name, unit, value, start, end, known.get(name)))
            if name in known:
                held.append(low <= known[name] <= high)
        boats[season.boat] = identified
        if shown := curves(identified):
            figure = identified_figure([shown], identified, known, season.boat)
            drawn.append(Drawn(f"identified_{season.boat}", figure, CAPTION + (" Crosses: truth." if known else "")))
    here = [MEANING, *sentences(boats)]
    if held:
        here.insert(0, f"The intervals hold {100 * np.mean(held):.0f} % of the truths at the end (90 % asked).")
    columns = ("boat", "quantity", "unit", "value", "from (90 %)", "to (90 %)", "truth")
    return Section("identified", "Identified boats", "", here, drawn, [ResultTable("identified", columns, rows)])


PAPER_RESULT = (
    "AID: 9 parameters, O(p) to predict and to learn. RNN: n = 20, m = 4, 140 weights, O(n (m + 1)) both. RLS: 9 "
    "parameters, O(p) and O(p²). No times are given; it ran on a Raspberry Pi 4."
)
ORDERS = {  # to predict, to learn
    "AID": ("p", "p"), "RNN": ("n (m + 1)", "n (m + 1), rounds of n to project"), "RLS": ("p", "p²"),
    "SIFtRLS": ("p", "p²"), "JointEKF": ("p", "p²"), "ARX": ("p", "p²"),
}  # fmt: skip
STEPS, PASSES = 400, 5


def cost_section(ensemble: Ensemble) -> Section:
    """The time of one boat, one sample at a time, as in live use: the median over passes."""
    sample = Sample(Inputs(0.5, 0.4, 1.0, 0.05, 0.4), 0.8, True, True)
    rows: list[tuple[Cell, ...]] = []
    total = 0
    for name, member in ensemble.members.items():
        inner, core = unwrapped(member, member.init(()))
        orders = next((ORDERS[k.__name__] for k in type(inner).__mro__ if k.__name__ in ORDERS), ("1", "1"))
        total += (count := _parameters(core))
        rows.append((name, type(inner).__name__, count, *(f"O({o})" for o in orders), *_times(member, sample)))
    rows.append(("all together", "Ensemble", total, "–", "–", *_times(ensemble, sample)))
    columns = "method", "kind", "parameters", "to predict", "to learn", "predict, µs", "predict and learn, µs"
    machine = f"{platform.machine()}, Python {platform.python_version()}, one thread"
    here = [f"Measured on {machine}: one boat, one sample at a time from Python, the median of {PASSES} passes."]
    return Section(
        "cost", "Parameters and time per sample", PAPER_RESULT, here, (), [ResultTable("cost", columns, rows)]
    )


def _times(estimator: Estimator, sample: Sample) -> tuple[float, float]:
    """The times in µs: to predict, and to predict and learn; NaN of a member of other code that raises."""
    boat = Online(estimator)
    try:
        return _median(lambda: boat.predict(sample.inputs)), _median(lambda: boat.step(sample))
    except Exception:
        return np.nan, np.nan


def _parameters(state: Any) -> int:
    """The identified parameters of a method: θ, the network's weights, or what a joint EKF reads of its state."""
    return sum(x.numel() for n, x in named_leaves(state) if n in ("theta", "reading") or n.startswith("weights."))


def _median(work: Callable[[], object]) -> float:
    """µs a call."""
    work()
    passes = []
    for _ in range(PASSES):
        start = time.perf_counter()
        for _ in range(STEPS):
            work()
        passes.append((time.perf_counter() - start) / STEPS)
    return 1e6 * statistics.median(passes)
