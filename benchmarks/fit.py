"""Errors of the parameters of `usvlearn fit`, coverage of their intervals, and errors of their simulations.

python benchmarks/fit.py [--seeds 8001 8002 8003 8004] [--boats 3]        writes docs/benchmarks/fit.md, in 20 min

Five plants, three boats of each and seed, 3 h to learn from and 1 h for open-loop simulations. The terms, the prior and
the widths of the intervals were chosen on other boats.
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import accuracy
import numpy as np
import output_error
import seasons
import torch
from pages import publish, table
from seasons import HOURS, LATER, NOMINAL, PLANTS, free_run_mae, season, season_of, simulations

from usvlearn import SurgeDynamics
from usvlearn.core.samples import Sample
from usvlearn.engine.backend import arrays_of
from usvlearn.engine.rollouts import rollout, tensors
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.estimators.joint.periodic_estimates import Identified, identify
from usvlearn.estimators.joint.quantities import Ahead, sums
from usvlearn.estimators.joint.state import NORTH, THETA
from usvlearn.model.fit.fitted import fit_boat
from usvlearn.model.fit.quantities import quantities
from usvlearn.model.fit.terms import AT as PLACES
from usvlearn.model.fit.terms import NAMES
from usvlearn.simulate.truth import true_parameters, true_quantities

N, SEEDS = 3, (8001, 8002, 8003, 8004)  # boats of a plant and seed
FIT, ONLINE, BATCH, SQUARES = "fit", "averaged joint EKF, online", "batch output error", "least squares of one step"
ADAPTIVE, SHOWN = "aid, online", (FIT, ONLINE, BATCH, SQUARES)
AFTER = (1, 2, 4, 6, 9, 18)  # missions after which the online estimate is noted
AIMS = {"steady_speed_full": 0.015, "time_constant": 0.07, "drag_half_speed": 0.04, "thrust_full_left": 0.05,
        "thrust_full_right": 0.05}  # fmt: skip
EACH, ALL = (0.82, 0.97), (0.88, 0.93)  # aims: share of the truths inside, of a quantity and of all
NARROW = ("steady_speed_full", "steady_speed_half", "steady_speed_quarter", "drag_half_speed")
SPLIT = ("drag_linear", "drag_quadratic")
NARROWER, WIDEST = 0.6, 1.3  # aims: half-width over that of the online estimate, of NARROW and of the others

SCOPE = """\
Nothing was chosen on these boats. The fit learns on its own grid of 0.1 s, all other methods on steps of 0.4 s. The
batch output error is that of `benchmarks/output_error.py`: nine terms, cubic thrust, a lag, and a current for each
mission. Least squares fits nine terms to the increments between measured speeds."""
ERRORS = """\
Median over the boats of the error relative to the truth. Open-loop simulation: median ratio of the MAE to that of the
batch output error, parameters frozen, over the fourth hour. All but least squares take the mean of their currents over
the missions that they have learned; that of the fit is smaller the less the missions agree."""
INTERVALS = f"""\
Share of the truths that the intervals hold, over all boats; medians of the half-widths relative to the truth, and of
their ratio to those of the averaged joint EKF, online. Aims: {EACH[0]:.0%} to {EACH[1]:.0%} of the truths of a
quantity, {ALL[0]:.0%} to {ALL[1]:.0%} of all, and the ratio. How drag splits into a linear and a quadratic part is an
extrapolation: the widths of these two have no aim."""

Values = Mapping[str, Quantity]


class Study(NamedTuple):
    """What every method found about one boat."""

    plant: str
    truth: dict[str, float]
    found: dict[str, Values]  # by method; intervals of the fit and of the online estimate alone
    free: dict[str, float]  # m/s, MAE of the open-loop simulations of the later runs, by method
    terms: str  # the set that was chosen
    noted: list[Values]  # the online estimate after so many missions, AFTER


def polynomial(parameters: Mapping[str, float], top: float, mass: float) -> Values:
    """The quantities of parameters per mass, by the names of `SurgeDynamics`, and cubic thrust if any."""
    theta = np.zeros(len(NAMES))
    for name, value in parameters.items():
        theta[PLACES[name]] = value
    nan = float("nan")
    return {name: Quantity(float(x), nan, nan, "") for name, x in quantities(theta, top, mass).items()}


def squares(runs: Sequence[Sample], mass: float) -> dict[str, float]:
    """Least squares of the increments between measured speeds, per mass."""
    model = SurgeDynamics(mass)
    theta = accuracy.least_squares(model, [tensors(run, torch.float64) for run in runs]).theta
    return dict(zip(model.names, (theta.double() / mass).tolist(), strict=True))


def learned(estimator: Any, runs: Sequence[Sample]) -> list[Any]:
    """The state after each run of a boat."""
    state, states = estimator.init(), []
    with torch.no_grad():
        for run in runs:
            state, _, _ = rollout(estimator, state, tensors(run, torch.float64))
            states.append(state)
    return states


def identified(averaged: Any, state: Any) -> Identified:
    return identify(averaged.description(), arrays_of(state))


def model(parameters: Mapping[str, float], lag: float = 0.0, current: Sequence[float] = (0.0, 0.0)) -> output_error.Fit:
    """Parameters per mass, for simulations."""
    return output_error.Fit(dict(parameters), lag, np.array([current]), 0.0)


def ahead(theta: np.ndarray) -> dict[str, float]:
    """Nine parameters and cubic thrust of motion ahead, whose fore-aft asymmetry terms are added; per mass."""
    boat = Ahead(theta)
    forces = {name: float(boat.sums[name]) for name in sums(True) if not name.startswith("thrust_full")}
    for side in ("left", "right"):
        cubic = float(boat.cubic[side])
        forces[f"thrust_cubic_{side}"] = cubic
        forces[f"thrust_linear_{side}"] += 0.4 * cubic
        forces[f"thrust_quadratic_{side}"] -= 4 / 3 * cubic
    return forces


def study(plant: str, seed: int, n: int = N, hours: float = HOURS, later: float = LATER) -> Iterator[Study]:
    """Every method on every boat of a plant."""
    (mass, top), given = NOMINAL[plant], season_of(plant, seed, n, hours, later)
    members = accuracy.ensemble((f"vehicle.mass={mass}", f"vehicle.surge_max={top}")).members
    averaged, aid = members["joint_averaged"], members["aid"]
    last = round(hours * 60 / seasons.MINUTES) - 1  # of the missions that are learned
    truth = true_quantities(mass, true_parameters(mass, **given), **given, mission=last)
    for boat, runs in season(plant, seed, n, hours, later).items():
        fitted, nine = fit_boat(boat, runs.rows, mass, top), output_error.fit(runs.learned, top)
        plain, states = squares(runs.learned, mass), learned(averaged, runs.learned)
        noted = [identified(averaged, states[min(k, len(states)) - 1]) for k in (*AFTER, len(states))]
        flow, theta = np.mean([state.mean[NORTH:THETA].numpy() for state in states], 0), noted[-1].theta
        adapted = learned(aid, runs.learned)[-1].theta / mass
        adaptive = dict(zip(aid.model.names, adapted.tolist(), strict=True))
        values = {FIT: fitted.quantities, ONLINE: noted[-1]} | {
            name: polynomial(each, top, mass)
            for name, each in ((BATCH, nine.parameters), (SQUARES, plain), (ADAPTIVE, adaptive))
        }
        models = {ONLINE: model(ahead(theta), float(theta[-1]), flow), BATCH: nine, SQUARES: model(plain),
                  ADAPTIVE: model(adaptive)}  # fmt: skip
        free = {FIT: free_run_mae(simulations(fitted.fit, runs), runs.later)} | {
            name: free_run_mae(output_error.free_runs(each, runs.later), runs.later) for name, each in models.items()
        }
        yield Study(plant, truth[boat], values, free, fitted.chosen, noted[: len(AFTER)])


def wrong(one: Study, method: str, name: str) -> float:
    """The error of a quantity relative to its truth, infinite where it is undefined; NaN without a truth."""
    true, value = one.truth[name], one.found[method][name].value
    return (value / true - 1 if math.isfinite(value) else math.inf) if true else math.nan


def holds(one: Study, method: str, name: str) -> bool:
    """Whether the interval of a quantity holds its truth."""
    each = one.found[method][name]
    return each.low <= one.truth[name] <= each.high


def width(one: Study, method: str, name: str) -> float:
    """Half of an interval."""
    each = one.found[method][name]
    return (each.high - each.low) / 2


def share(x: Any, digits: int = 1) -> str:
    """Percent; nothing where there is no truth, or it is 0."""
    value = float(x)
    return f"{value:.{digits}%}" if math.isfinite(value) and abs(value) < 10 else "–"


def verdict(met: bool | np.bool) -> str:
    return "yes" if met else "**no**"


def accuracy_table(studies: Sequence[Study]) -> list[str]:
    """Median errors, by method."""
    head = ["median of \\|error\\|", *AIMS, "open-loop simulation over batch"]
    lines = []
    for method in SHOWN:
        medians = [statistics.median(abs(wrong(one, method, name)) for one in studies) for name in AIMS]
        free = statistics.median(one.free[method] / one.free[BATCH] for one in studies)
        lines.append([method, *map(share, medians), f"{free:.2f}"])
    return table(head, [*lines, ["aim of the fit", *(f"≤ {aim:.1%}" for aim in AIMS.values()), ""]])


def plants_table(studies: Sequence[Study]) -> list[str]:
    """The fit's median errors with their signs, by plant."""
    lines = []
    for plant in dict.fromkeys(one.plant for one in studies):
        some = [one for one in studies if one.plant == plant]
        lines.append([plant, *(f"{statistics.median(wrong(one, FIT, name) for one in some):+.1%}" for name in AIMS)])
    return table(["median error of the fit", *AIMS], lines)


def coverage_table(studies: Sequence[Study]) -> list[str]:
    """Which share of the truths the intervals hold, and how wide they are."""
    lines, held = (
        [],
        {method: np.mean([holds(one, method, n) for one in studies for n in one.truth]) for method in (FIT, ONLINE)},
    )
    for name in studies[0].truth:
        inside, beside = (np.mean([holds(one, method, name) for one in studies]) for method in (FIT, ONLINE))
        wide, other = (statistics.median(width(one, method, name) / abs(one.truth[name] or np.nan) for one in studies)
                       for method in (FIT, ONLINE))  # fmt: skip
        narrower = statistics.median(width(one, FIT, name) / width(one, ONLINE, name) for one in studies)
        aim = NARROWER if name in NARROW else WIDEST
        met = EACH[0] <= inside <= EACH[1] and (name in SPLIT or narrower <= aim)
        lines.append([name, share(inside, 0), share(beside, 0), share(wide), share(other), f"{narrower:.2f}",
                      "" if name in SPLIT else f"≤ {aim:g}", verdict(met)])  # fmt: skip
    met = ALL[0] <= held[FIT] <= ALL[1]
    lines.append(["all", share(held[FIT], 0), share(held[ONLINE], 0), "", "", "", "", verdict(met)])
    head = ["quantity", "holds", "online", "half-width", "online", "ratio", "aim", "met"]
    return table(head, lines)


def page(studies: Sequence[Study], command: str) -> list[str]:
    """The page."""
    return [
        "# The batch fit beside online learning and other batch fits",
        "",
        f"Made by `{command}`: {len(studies)} simulated boats of {len(PLANTS)} plants, {HOURS:g} h to learn",
        f"from and {LATER:g} h of open-loop simulations each.",
        "",
        SCOPE,
        "",
        "## Errors",
        "",
        ERRORS,
        "",
        *accuracy_table(studies),
        "",
        *plants_table(studies),
        "",
        "## Intervals of 90 %",
        "",
        INTERVALS,
        "",
        *coverage_table(studies),
    ]


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    options.add_argument("--boats", type=int, default=N)
    given = options.parse_args()
    torch.set_num_threads(1)
    studies = []
    for seed in given.seeds:
        for plant in PLANTS:
            for one in study(plant, seed, given.boats):
                studies.append(one)
                print(plant, seed, one.terms, {name: f"{x:.3f}" for name, x in one.free.items()}, flush=True)
    command = f"python benchmarks/fit.py --seeds {' '.join(map(str, given.seeds))} --boats {given.boats}"
    publish(__file__, page(studies, command))


if __name__ == "__main__":
    main()
