"""The quantities identified of each boat at the end, and the parameters over the season.

The band of least squares covers the effect of the noise in the samples. It is not an interval for the true value,
because it does not include the bias of the model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from usvlearn.core.samples import tree_map
from usvlearn.display.terminal import ResultTable
from usvlearn.engine.identified import sentences
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.joint.curves import curves
from usvlearn.estimators.joint.quantities import MEANING
from usvlearn.estimators.regressors.terms import UNITS
from usvlearn.evaluation.diagnostics import Truth as Quantities
from usvlearn.evaluation.diagnostics import identified_boats, physical_members, unwrapped
from usvlearn.evaluation.season import Season
from usvlearn.report.sections.season_figures import Course, parameters_figure
from usvlearn.report.sections.section import Drawn, Section
from usvlearn.runs.figures import identified_figure

CAPTION = "Lines: identified. Bands: 90 %."
PAPER_RESULT = (
    "No parameters are shown; the mass is taken as known. Some boats have a noticeable thruster bias, as the errors "
    "between boats confirm, and others have none."
)
NOISE = (
    "the band and the ± (1.645 standard deviations from the covariance of least squares) cover 90 % of the effect of "
    "the noise of the samples, but not the bias of the model (Euler's step, current, lags, a dead band)"
)
BAND = "Band: 90 % of the effect of the noise of the samples, but not the bias of the model."
TOO_SMALL = (
    "Least squares finds forces too small where a current acts that its model does not have, and "
    "where its model makes Euler's step; noise of the speed adds little."
)
SHOWN = ("aid", "dynamic_rls")  # if there are many members, the first two of these are shown
Truth = Mapping[str, Mapping[str, np.ndarray]]  # boat -> parameter -> value on each mission


def identified_section(seasons: Sequence[Season], ensemble: Ensemble, truth: Quantities) -> Section | None:
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


def functionals(names: Sequence[str], speed: float, command: float) -> dict[str, tuple[str, np.ndarray]]:
    """Meaningful sums wᵀθ: each parameter; the drag at a speed; the thrust of each side at a command and that speed.

    On a boat that seldom changes speed, single parameters are hard to distinguish, but their sum at that speed is not.

    >>> functionals(["drag_quadratic", "drag_linear"], 2.0, 0.5)["drag at 2 m/s"]
    ('N', array([4., 2.]))
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

    Args:
        seasons: of all boats.
        ensemble: to which the checkpoints belong.
        truth: of simulated boats, else empty.
        mission: of each boat with a truth, the mission of each of its runs.
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
    caption = "What was identified over the season" + (f"; {NOISE}" if banded else "")
    if truth:
        caption += (
            "; dashed: the true value in each mission, scaled by declared over true mass, since surge data identify "
            "the parameters only in proportion to the mass"
        )
    drawn[0] = drawn[0]._replace(caption=f"{caption}.")
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
        bias = np.log(sides[..., 0] / sides[..., 1])  # (boats, methods and truth)
    if sides.shape[1] > len(shown):
        true = bias[:, -1]
        here.append(
            f"True bias of the thrusters (left over right at the usual command): {np.exp(true.min()):.2f} to "
            f"{np.exp(true.max()):.2f}."
        )
        medians = []
        for k, name in enumerate(shown):
            ok = np.isfinite(bias[:, k]).all() and len(bias) > 2 and bias[:, k].std() > 0 and true.std() > 0
            ratio = f"; correlation with the truth over boats {np.corrcoef(bias[:, k], true)[0, 1]:.2f}" if ok else ""
            wrong = [row[4] / row[6] - 1 for row in rows if row[3] == name and " at " in row[1] and row[6]]
            medians.append(float(np.median(wrong)))
            here.append(f"{name}: drag and thrust differ from the truth by {100 * medians[-1]:+.0f} %, median{ratio}.")
        fitted = {row[3] for row in rows if row[5] is not None}  # by least squares, which has a covariance
        if any(name in fitted and wrong < -0.1 for name, wrong in zip(shown, medians, strict=True)):
            here.append(TOO_SMALL)
    else:
        for k, name in enumerate(shown):
            some = ", ".join(f"{np.exp(b):.2f}" for b in bias[:, k])
            here.append(f"{name}: thrust left over right: {some}.")
    return [*here, *_covered(rows)]


def _covered(rows: Sequence[tuple]) -> list[str]:
    """A sentence about what the ± covers, if there is one."""
    known = [(value, wide, true) for *_, value, wide, true in rows if wide is not None]
    inside = [abs(value - true) <= wide for value, wide, true in known if true is not None]
    if not known:
        return []
    if inside:
        held = f"here they hold {100 * np.mean(inside):.0f} % of the truths at the end"
    else:
        held = "no truth is known here, and on a simulated fleet they held few of the truths (docs/benchmarks/study.md)"
    return [f"{NOISE[0].upper()}{NOISE[1:]}: {held}."]
