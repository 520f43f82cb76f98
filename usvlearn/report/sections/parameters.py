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
import torch
from torch import Tensor

from usvlearn.core.protocol import Estimator
from usvlearn.core.samples import Inputs, Sample, named_leaves, tree_map
from usvlearn.display.figures import INK, LINE, colours, guarded, panels_of, themed
from usvlearn.display.terminal import Cell, ResultTable
from usvlearn.engine.identified import sentences
from usvlearn.engine.online import Online
from usvlearn.estimators.aid.layer import AID
from usvlearn.estimators.arx.layer import ARX
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.joint.curves import curves
from usvlearn.estimators.joint.layer import JointEKF
from usvlearn.estimators.joint.quantities import MEANING
from usvlearn.estimators.least_squares.rls import RLS
from usvlearn.estimators.least_squares.sift import SIFtRLS
from usvlearn.estimators.regressors.terms import UNITS
from usvlearn.estimators.rnn.layer import RNN
from usvlearn.estimators.wrappers.bank import Bank
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
Truth = Mapping[str, Mapping[str, np.ndarray]]  # boat -> parameter -> value on each mission


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


def functionals(names: Sequence[str], speed: float, command: float) -> dict[str, tuple[str, np.ndarray]]:
    """Meaningful sums wᵀθ: each parameter; the drag at a speed; the thrust of each side at a command and that speed.

    On a boat that seldom changes speed, single parameters are hard to distinguish, but their sum at that speed is not.
    """
    found = {name: (UNITS[name], np.eye(len(names))[k]) for k, name in enumerate(names)}
    terms = {f"drag at {speed:.3g} m/s": {"drag_quadratic": speed * speed, "drag_linear": speed}}
    for side in ("left", "right"):
        if f"thrust_linear_{side}" in names:
            terms[f"thrust {side} at {100 * command:.0f} %, {speed:.3g} m/s"] = {
                f"thrust_linear_{side}": command,
                f"thrust_quadratic_{side}": command * command,
                f"thrust_speed_{side}": command * speed,
            }
    for label, weights in terms.items():
        found[label] = ("N", np.array([weights.get(name, 0.0) for name in names]))
    return found


def course(hours: np.ndarray, state: Any, weights: np.ndarray) -> Course:
    """wᵀθ over the checkpoints and, if the state has a covariance, its standard deviation √(σ² wᵀPw).

    Args:
        hours: `(sets,)`.
        state: with `theta` `(sets, p)`, and for least squares `factor` and `noise`.
        weights: w, `(p,)`.
    """
    w = torch.as_tensor(weights, dtype=state.theta.dtype)
    deviation = None
    if hasattr(state, "factor"):
        through: Tensor = (state.factor * w[:, None]).sum(-2)
        deviation = (state.noise * (through * through).sum(-1)).sqrt().numpy()
    return Course(hours, (state.theta @ w).numpy(), deviation)


def parameters_section(
    seasons: Sequence[Season], ensemble: Ensemble, truth: Truth, mission: Mapping[str, np.ndarray]
) -> Section | None:
    """A figure per boat, and a table of the parameters at the end and of the true ones.

    None if no member identifies the surge dynamics.
    """
    every = physical_members(ensemble)
    shown = [name for name in (*SHOWN, *every) if name in every]
    shown = list(dict.fromkeys(shown))[:2]
    if not shown:
        return None
    drawn, rows, sides = [], [], []
    for season in seasons:
        speed, command = _usual(season)
        members = {name: unwrapped(ensemble.members[name], season.state.members[name]) for name in shown}
        names = members[shown[0]][0].model.names
        sums = functionals(names, speed, command)
        courses = {
            label: {name: course(season.hours, state, w) for name, (_, state) in members.items()}
            for label, (_, w) in sums.items()
        }
        units = {label: unit for label, (unit, _) in sums.items()}
        known: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        if season.boat in truth:
            theta = np.stack([truth[season.boat][name] for name in names], -1)[mission[season.boat]]  # (runs, p)
            known = {label: (_ends(season), (theta @ w).repeat(2)) for label, (_, w) in sums.items()}
        title = f"{season.boat}: identified surge dynamics"
        drawn.append(Drawn(f"parameters_{season.boat}", parameters_figure(courses, units, known, title), ""))
        for label, row in courses.items():
            true = float(known[label][1][-1]) if label in known else None
            for name, (_, value, deviation) in row.items():
                wide = None if deviation is None else 1.645 * float(deviation[-1])
                rows.append((season.boat, label, units[label], name, float(value[-1]), wide, true))
        left, right = (label for label in sums if label.startswith("thrust ") and " at " in label)
        sides.append([
            [float(courses[side][name].value[-1]) for side in (left, right)] for name in shown
        ] + ([[float(known[side][1][-1]) for side in (left, right)]] if known else []))  # fmt: skip
    banded = any(wide is not None for *_, wide, _ in rows)
    drawn = [each._replace(caption=BAND if banded else "") for each in drawn]
    caption = f"What was identified over the season. {BAND if banded else ''}".strip()
    if truth:
        caption += (
            " Dashed: the true value in each mission, scaled by declared over true mass, since surge data identify the "
            "parameters only in proportion to the mass."
        )
    drawn[0] = drawn[0]._replace(caption=caption)
    columns = ("boat", "quantity", "unit", "method", "at the end", "±, of the noise alone (90 %)", "truth")
    return Section(
        "parameters", "Parameters over the season", PAPER_RESULT, _findings(shown, np.array(sides), rows),
        drawn, [ResultTable("parameters", columns, rows)],
    )  # fmt: skip


def _usual(season: Season) -> tuple[float, float]:
    """The mean speed, m/s, and the mean command while under way."""
    surge = np.concatenate([run.samples.surge[run.steps] for run in season.runs])
    sides = [run.samples.inputs[k][run.steps] for run in season.runs for k in (0, 1)]
    commands = np.abs(np.concatenate(sides))
    under_way = commands[commands > 0]
    return round(float(np.abs(surge).mean()), 2), round(float(under_way.mean()), 2) if len(under_way) else 0.5


def _ends(season: Season) -> np.ndarray:
    """Hours at which each run began and ended, `(2 * runs,)`."""
    ends = (
        np.cumsum([0.0, *(len(run.samples.surge) * float(run.samples.inputs.dt.max()) for run in season.runs)]) / 3600
    )
    return np.stack([ends[:-1], ends[1:]], -1).ravel()


def _findings(shown: Sequence[str], sides: np.ndarray, rows: Sequence[tuple]) -> list[str]:
    """Sentences; sides is `(boats, methods and truth, 2)`, N."""
    here = []
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = sides[..., 0] / sides[..., 1]  # (boats, methods and truth)
    for name, each in zip((*shown, "truth"), ratios.T, strict=False):
        here.append(f"{name}: thrust left over right at the usual command: {', '.join(f'{x:.2f}' for x in each)}.")
    for name in shown:
        wrong = [row[4] / row[6] - 1 for row in rows if row[3] == name and " at " in row[1] and row[6]]
        if wrong:
            here.append(f"{name}: drag and thrust differ from the truth by {100 * np.median(wrong):+.0f} %, median.")
    return here


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
    """A panel per parameter: each method's value over the hours, the band of the noise, and the truth."""
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
        for k, panel in enumerate(panels):
            panel.grid(color=LINE)
            if k + across >= len(panels):
                panel.set_xlabel("time on the water, h")
                panel.tick_params(labelbottom=True)
        handles: dict[str, Any] = {}
        for panel in panels:
            handles |= {label: handle for handle, label in zip(*panel.get_legend_handles_labels(), strict=True)}
        figure.legend(handles.values(), handles, loc="outside upper left", ncols=5, fontsize=8, title=title,
                      title_fontsize=9, alignment="left")  # fmt: skip
        return figure


PAPER_RESULT = (
    "AID: 9 parameters, O(p) to predict and to learn. RNN: n = 20, m = 4, 140 weights, O(n (m + 1)) both. RLS: 9 "
    "parameters, O(p) and O(p²). No times are given; it ran on a Raspberry Pi 4."
)
ORDERS = {  # to predict, to learn
    AID: ("p", "p"), RNN: ("n (m + 1)", "n (m + 1), rounds of n to project"), RLS: ("p", "p²"), SIFtRLS: ("p", "p²"),
    JointEKF: ("p", "p²"), ARX: ("p", "p²"),
}  # fmt: skip
STEPS, PASSES = 400, 5


def cost_section(ensemble: Ensemble) -> Section:
    """The time of one boat, one sample at a time, as in live use: the median over passes."""
    sample = Sample(Inputs(0.5, 0.4, 1.0, 0.05, 0.4), 0.8, True, True)
    rows: list[tuple[Cell, ...]] = []
    total = 0
    for name, member in ensemble.members.items():
        inner, core = unwrapped(member, member.init(()))
        orders = next((found for kind, found in ORDERS.items() if isinstance(inner, kind)), ("1", "1"))
        elements = len(member.labels) if isinstance(member, Bank) else 1
        kind = f"{type(inner).__name__}, {elements} settings" if elements > 1 else type(inner).__name__
        alone = member if isinstance(member, Estimator) else Ensemble({name: member}, watched=False)
        total += (count := _parameters(core))
        rows.append((name, kind, count, *(f"O({o})" for o in orders), *_times(alone, sample)))
    rows.append(("all together", "Ensemble", total, "–", "–", *_times(ensemble, sample)))
    columns = "method", "kind", "parameters", "to predict", "to learn", "predict, µs", "predict and learn, µs"
    machine = f"{platform.machine()}, Python {platform.python_version()}, one thread"
    here = [f"Measured on {machine}: one boat, one sample at a time from Python, the median of {PASSES} passes."]
    return Section(
        "cost", "Parameters and time per sample", PAPER_RESULT, here, (), [ResultTable("cost", columns, rows)]
    )


def _times(estimator: Estimator, sample: Sample) -> tuple[float, float]:
    """The times in µs: to predict, and to predict and learn."""
    boat = Online(estimator)
    return _median(lambda: boat.predict(sample.inputs)), _median(lambda: boat.step(sample))


def _parameters(state: Any) -> int:
    """The identified parameters of a method: θ, the network's weights, or what a joint EKF reads of its state."""
    identified = [
        leaf for name, leaf in named_leaves(state) if name in ("theta", "reading") or name.startswith("weights.")
    ]
    return sum(leaf.numel() for leaf in identified)


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
