"""What was identified of each boat at the end, the parameters over the season, and the size and cost of each method.

The band of least squares covers the effect of the noise in the samples. It is not an interval for the true value,
because it does not include the bias of the model.
"""

from __future__ import annotations

import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.protocol import Estimator
from usvlearn.core.samples import Inputs, Sample, named_leaves, tree_map
from usvlearn.display.figures import INK, colours, guarded, panels_of
from usvlearn.display.terminal import Cell, ResultTable
from usvlearn.engine.identified import sentences
from usvlearn.engine.online import Online
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.joint.curves import curves
from usvlearn.estimators.joint.quantities import MEANING
from usvlearn.estimators.regressors.terms import UNITS
from usvlearn.evaluation.diagnostics import Truth as Quantities
from usvlearn.evaluation.diagnostics import identified_boats, physical_members, unwrapped
from usvlearn.evaluation.season import Season
from usvlearn.report.sections.section import Drawn, Section
from usvlearn.runs.figures import identified_figure

CAPTION = "Lines: identified. Bands: 90 %."
PAPER_RESULT = (
    "No parameters are shown; the mass is taken as known. Some boats have a noticeable thruster bias, as the errors "
    "between boats confirm, and others have none."
)
BAND = "Band: 90 % of the effect of the noise of the samples, but not the bias of the model."
SHOWN = ("aid", "dynamic_rls")  # if there are many members, the first two of these are shown
PROPORTION = (
    "Single parameters trade against each other, and are in proportion to the declared mass: a force at a speed that "
    "was sailed is better known than each of them."
)


def identified_section(seasons: Sequence[Season], ensemble: Ensemble, truth: Quantities) -> Section | None:
    """A table of all quantities, and a figure of curves per boat; None if no member is an averaged joint EKF."""
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


def course(hours: np.ndarray, state: Any, k: int) -> Course:
    """Parameter k over the checkpoints' hours and, with a covariance, its deviation √(σ² P_kk)."""
    deviation = None
    if hasattr(state, "factor"):
        deviation = (state.noise * state.factor[..., k, :].square().sum(-1)).sqrt().numpy()
    return Course(hours, state.theta[..., k].numpy(), deviation)


def parameters_section(seasons: Sequence[Season], ensemble: Ensemble, truth: Quantities) -> Section | None:
    """A figure per boat, and a table of the parameters at the end and of the true ones, if any."""
    every = physical_members(ensemble)
    shown = list(dict.fromkeys(name for name in (*SHOWN, *every) if name in every))[:2]
    if not shown:
        return None
    drawn, rows = [], []
    for season in seasons:
        members = {name: unwrapped(ensemble.members[name], season.state.members[name]) for name in shown}
        known = truth.get(season.boat, {})
        courses = {
            parameter: {name: course(season.hours, state, k) for name, (_, state) in members.items()}
            for k, parameter in enumerate(members[shown[0]][0].model.names)
        }
        for parameter, row in courses.items():
            for name, (_, value, deviation) in row.items():
                wide = None if deviation is None else 1.645 * float(deviation[-1])
                values = (name, float(value[-1]), wide, known.get(parameter))
                rows.append((season.boat, parameter, UNITS[parameter], *values))
        caption = BAND if any(each.deviation is not None for row in courses.values() for each in row.values()) else ""
        caption += " Dashed: the truth at the end." * bool(known)
        figure = parameters_figure(courses, known, f"{season.boat}: identified surge dynamics")
        drawn.append(Drawn(f"parameters_{season.boat}", figure, caption.strip()))
    columns = ("boat", "parameter", "unit", "method", "at the end", "±, of the noise alone (90 %)", "truth")
    table, here = ResultTable("parameters", columns, rows), [PROPORTION]
    here += [BAND.replace("Band", "Bands and ±")] if any(row[5] is not None for row in rows) else []
    return Section("parameters", "Parameters over the season", PAPER_RESULT, here, drawn, [table])


class Course(NamedTuple):
    """One identified quantity over a season."""

    hours: np.ndarray  # (sets,)
    value: np.ndarray  # (sets,)
    deviation: np.ndarray | None = None  # (sets,) standard deviation, if the estimator has one


@guarded
def parameters_figure(
    courses: Mapping[str, Mapping[str, Course]],
    truth: Mapping[str, float],
    title: str,
):
    """A panel per parameter: each method's value over the hours, the band of the noise, and the truth."""
    palette = colours(list(dict.fromkeys(name for row in courses.values() for name in row)))
    figure, panels = panels_of(len(courses), 3, (3.1, 1.65), (0.2, 0.8), shared="x")
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
            panel.axhline(truth[parameter], color=INK, linewidth=1.4, linestyle="--", label="truth")
            shown.append(np.array([truth[parameter]]))
        known = np.concatenate(shown)
        known = known[np.isfinite(known)]
        if len(known):
            room = 0.08 * (known.max() - known.min()) + 1e-6
            panel.set_ylim(known.min() - room, known.max() + room)
        panel.set_title(f"{parameter}, {UNITS.get(parameter, '')}")
    figure.supxlabel("time on the water, h")
    handles: dict[str, Any] = {}
    for panel in panels:
        handles |= {label: handle for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles, loc="outside upper left", ncols=5, title=title,
                  title_fontsize=9, alignment="left")  # fmt: skip
    return figure


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
