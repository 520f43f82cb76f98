"""What a batch fit and other methods find about boats, how well they simulate them, and what a fit takes.

Of simulated boats the truth is known: `study`. Recorded boats have later runs: `frozen`. The page is made by `fit`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import accuracy
import batch
import identify
import numpy as np
import output_error
from fit_simulation import Halves, halves, percentage, season, simulations, whole
from peers import narmax, physics, state_space
from peers.batch import Held, free_run_errors
from truths import MINUTES, NOMINAL, free_run_mae

from usvlearn import SurgeDynamics
from usvlearn.core.samples import Sample
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.estimators.joint.state import NORTH, THETA
from usvlearn.model.fit.fitted import fit_boat
from usvlearn.model.fit.logs import DT as FINE
from usvlearn.model.fit.quantities import quantities
from usvlearn.model.fit.terms import AT, NAMES
from usvlearn.simulate.truth import true_parameters, true_quantities

N, HOURS, LATER = 3, 3.0, 1.0  # boats of a plant and seed; h
FIT, ONLINE, BATCH, SQUARES = "fit", "averaged joint EKF, online", "batch output error", "least squares of one step"
PEERS = {"SysIdentPy": narmax, "jax-sysid": state_space, BATCH: physics}
Values = dict[str, Quantity]


class Study(NamedTuple):
    """What every method found about one boat."""

    plant: str
    truth: dict[str, float]
    found: dict[str, Values]  # by method; intervals of the fit and of the online estimate alone
    free: dict[str, float]  # m/s, MAE of the open-loop simulations of the later runs, by method
    terms: str  # the set that was chosen


class Frozen(NamedTuple):
    """MAE, m/s, of the open-loop simulations of the second half of a boat's runs, by method; NaN: not installed."""

    errors: dict[str, float]
    terms: str
    percentages: tuple[float, float]  # of the fit: of the second half, and of all runs in sample; NaN: not measured


def polynomial(parameters: Mapping[str, float], top: float, mass: float) -> Values:
    """The quantities of parameters per mass, by the names of `SurgeDynamics`, and cubic thrust if any."""
    theta = np.zeros(len(NAMES))
    for name, value in parameters.items():
        theta[AT[name]] = value
    nan = float("nan")
    return {name: Quantity(float(x), nan, nan, "") for name, x in quantities(theta, top, mass).items()}


def squares(runs: Sequence[Sample], mass: float) -> dict[str, float]:
    """Least squares of the increments between measured speeds, per mass."""
    model = SurgeDynamics(mass)
    theta = accuracy.least_squares(model, [accuracy.tensors(run) for run in runs]).theta
    return dict(zip(model.names, (theta.double() / mass).tolist(), strict=True))


def online(runs: Halves, plant: str) -> tuple[Values, output_error.Fit]:
    """The averaged joint EKF after the runs: its quantities, and its parameters for simulations."""
    averaged = identify.members(plant)["joint_averaged"]
    states, _ = identify.learned(averaged, runs.learned)
    known = identify.identified(averaged, states[-1])
    current = np.mean([state.mean[NORTH:THETA].numpy() for state in states], 0)
    frozen = output_error.Fit(identify.ahead(known.theta), float(known.theta[-1]), current[None], 0.0)
    return dict(known), frozen


def study(plant: str, seed: int, n: int = N, hours: float = HOURS, later: float = LATER) -> Iterator[Study]:
    """Every method on every boat of a plant."""
    (mass, top), first = NOMINAL[plant], round(hours * 60 / MINUTES)
    given: dict[str, Any] = {"n": n, "plant": plant, "hours": hours + later, "mission_minutes": MINUTES, "seed": seed}
    truth = true_quantities(mass, true_parameters(mass, **given), **given, mission=first - 1)
    for boat, runs in season(first, **given).items():
        fitted = fit_boat(boat, runs.rows, mass, top)
        values, frozen = online(runs, plant)
        nine, plain = output_error.fit(runs.learned, top), squares(runs.learned, mass)
        found = {FIT: fitted.quantities, ONLINE: values, BATCH: polynomial(nine.parameters, top, mass),
                 SQUARES: polynomial(plain, top, mass)}  # fmt: skip
        models = {ONLINE: frozen, BATCH: nine, SQUARES: output_error.Fit(plain, 0.0, np.zeros((1, 2)), 0.0)}
        free = {FIT: free_run_mae(simulations(fitted.fit, runs), runs.later)} | {
            name: free_run_mae(output_error.free_runs(model, runs.later), runs.later) for name, model in models.items()
        }
        yield Study(plant, truth[boat], found, free, fitted.chosen)


def frozen(log: batch.Log, runs: Halves, every: Halves | None, mass: float) -> Frozen:
    """Every method on the second half of a boat's runs, its parameters frozen; the fit on all runs in sample, too."""
    fitted = fit_boat(log.name, runs.rows, mass, log.top)
    made = simulations(fitted.fit, runs)
    percentages = [percentage(made, runs.later), float("nan")]
    if every:
        percentages[1] = percentage(simulations(fit_boat(log.name, every.rows, mass, log.top).fit, every), every.later)
    errors = {"persistence": free_run_errors(Held(), runs.later)[1]}
    for name, module in PEERS.items():
        row = batch.peer_row(module, log)
        errors[name] = float("nan") if row is None else row.free
    errors["ensemble"] = batch.ours_by_free_run(log)["ensemble"]
    errors[FIT] = free_run_mae(made, runs.later)
    return Frozen(errors, fitted.chosen, tuple(percentages))


def boats(folder: Path) -> Iterator[tuple[batch.Log, Halves, Halves | None, float]]:
    """The recorded boats, with all of their runs, and two simulated ones of `benchmarks/batch.py`, and their masses."""
    for name in batch.REAL:
        log = batch.recorded(folder, name)
        grids = [accuracy.fleet_of((*log.overrides[:2], *more)) for more in ((), (f"align.dt={FINE}",))]
        yield log, halves(*grids), whole(*grids), accuracy.configuration(log.overrides).vehicle.mass
    for plant in batch.PLANTS:
        given = {"n": 1, "plant": plant, "hours": HOURS + LATER, "mission_minutes": MINUTES, "seed": batch.SEED}
        (runs,) = season(round(HOURS * 60 / MINUTES), **given).values()
        yield batch.simulated(plant), runs, None, NOMINAL[plant][0]
