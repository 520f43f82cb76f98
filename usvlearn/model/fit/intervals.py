"""90 % intervals of what was fitted: from the scatter of the missions' pieces and from the sets of terms.

Equation (1): `docs/theory/identification.md#batch-fit-intervals`; A and B are P and C there, M pieces, q a quantity.
The own error is what no log shows, such as what every set lacks: gusts make drag and thrust look more linear than they
are. SCATTER, FEW and the own errors were chosen on simulated boats.

After a refit with one more mission C is (C⁻¹ + g H)⁻¹. H is the information of that mission, simulated with the fitted
boat; the logs show that theirs is worth a share g of what a simulation says, (det A / det C)^(1/m) by their scatter,
times the share of steps with a measured speed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from usvlearn.core.prepared_samples import DT, LEARN, LEFT, MODE, PREDICT, RIGHT, SURGE
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.estimators.joint.periodic_estimates import around
from usvlearn.estimators.joint.quantities import QUANTITIES, SIDES
from usvlearn.model.fit.choice import Score
from usvlearn.model.fit.gauss_newton import Fit, Missions
from usvlearn.model.fit.quantities import quantities

SCATTER, FEW = 1.0, 9.0
STEP = 0.1  # deviations: the step of a central difference
OWN_ERROR = 0.015  # of a value
OWN = dict.fromkeys(QUANTITIES, OWN_ERROR) | {"time_constant": 0.03, "stopping_distance": 0.03, "drag_cross": 0.3}
OWN_SHARES = {  # of the full drag or thrust that the terms add up to: how it splits is an extrapolation
    "drag_linear": 0.05, "drag_quadratic": 0.13,
    **{f"thrust_{kind}_{side}": share for side in SIDES
       for kind, share in {"linear": 0.03, "quadratic": 0.045, "speed": 0.03}.items()},
}  # fmt: skip
BEYOND = {"steady_speed_full": 0.35, "thrust_full_left": 0.35, "thrust_full_right": 0.35, "drag_half_speed": 0.7,
          "stopping_distance": 0.35, "time_constant": 0.2}  # fmt: skip  # own error, by the share of command beyond
REACHED = 30.0  # s, for which a mean command was exceeded: that is known
ALIKE = 0.02  # loss a step by which another set may be worse than the chosen one, and still counts


def intervals(
    fits: Mapping[str, Fit], scores: Mapping[str, Score], chosen: str, mass: float, beyond: float = 0.0
) -> dict[str, Quantity]:
    """All quantities of the chosen set with intervals, NaN where undefined; `beyond` as of `unreached`."""
    fit = fits[chosen]
    values, slopes = quantities(fit.theta, fit.top, mass), gradients(fit, mass)
    differ = disagreement(fits, scores, chosen, mass)
    return {
        name: Quantity(float(values[name]), *around(name, float(values[name]), math.sqrt(variance)), QUANTITIES[name])
        for name, variance in variances(values, slopes, differ, beyond, spread(fit)).items()
    }


def variances(
    values: Mapping[str, Any], slopes: Mapping[str, np.ndarray], differ: Mapping[str, float], beyond: float,
    C: np.ndarray,
) -> dict[str, float]:  # fmt: skip
    """The variance of each quantity in (1), of its value, its gradient, and what other sets say; C is that of θ."""
    variance = {}
    for name, value in ((name, float(each)) for name, each in values.items()):
        error = math.hypot(own_error(name, values), BEYOND.get(name, 0.0) * beyond * value)
        variance[name] = max(float(slopes[name] @ C @ slopes[name]) + differ[name] ** 2 + error**2, 0.0)
    return variance


def unreached(missions: Missions) -> float:
    """The share of full command above that which the mean of both sides exceeded for `REACHED`."""
    rows = np.concatenate([each[each[:, MODE] >= PREDICT] for each in missions.rows])
    count = round(REACHED / max(float(np.median(rows[:, DT])), 1e-3))
    means = np.sort(rows[:, [LEFT, RIGHT]].mean(1))
    return 1.0 - min(max(float(means[-count]), 0.0), 1.0) if len(means) >= count else 1.0


def own_error(name: str, values: Mapping[str, Any]) -> float:
    """The error of a quantity that no log shows, in its unit; 0 where it is unknown."""
    if name not in OWN_SHARES:
        return float(np.nan_to_num(OWN[name] * abs(values[name])))
    speed = values["steady_speed_full"]
    powers = {"drag_linear": 1, "drag_quadratic": 2}
    if name in powers:
        whole = 2 * values["drag_half_speed"] / speed ** powers[name]
    else:
        whole = values[f"thrust_full_{name.rpartition('_')[2]}"] / (speed if "speed" in name else 1.0)
    return float(np.nan_to_num(OWN_SHARES[name] * abs(whole), posinf=0.0))


def disagreement(fits: Mapping[str, Fit], scores: Mapping[str, Score], chosen: str, mass: float) -> dict[str, float]:
    """|q' − q| of (1) for all quantities; 0 where no other set does about as well."""
    values = quantities(fits[chosen].theta, fits[chosen].top, mass)
    others = [quantities(fits[name].theta, fits[name].top, mass) for name in alike(scores, chosen)]
    away = {name: [abs(float(each[name] - value)) for each in others] for name, value in values.items()}
    return {name: max(filter(math.isfinite, each), default=0.0) for name, each in away.items()}


def alike(scores: Mapping[str, Score], chosen: str) -> list[str]:
    """The other sets that do about as well as the chosen one on missions which they have not learned."""
    return [name for name, score in scores.items() if name != chosen and -score.gain <= ALIKE]


def spread(fit: Fit, share: float = 1.0) -> np.ndarray:
    """A + (SCATTER + FEW/M) · A B A of (1), `(m, m)`; A alone of one piece. M is a `share` of those to come."""
    A, count = fit.covariance, len(fit.score)
    if count < 2:
        return A
    away = fit.score - fit.score.mean(0)
    total: np.ndarray = A + (SCATTER + share * FEW / count) * count / (count - 1) * A @ (away.T @ away) @ A
    return total


def worth(missions: Missions, fit: Fit, C: np.ndarray) -> float:
    """The share g."""
    modes = np.concatenate([rows[rows[:, MODE] >= PREDICT, MODE] for rows in missions.rows])
    scatter = (np.linalg.slogdet(fit.covariance)[1] - np.linalg.slogdet(C)[1]) / len(C)
    return float(np.mean(modes == LEARN)) * math.exp(scatter)


def rehearsed(rows: np.ndarray, fit: Fit) -> Fit:
    """The fit at its own parameters of a mission that goes as it says, `(time, ROW)` on the grid of fits: with H."""
    alone = Missions([rows], fit.top)
    ((speed, _),) = alone.simulate(alone.evaluate(fit.terms, fit.theta, fit.deviation))
    rows[:, SURGE] = np.nan_to_num(speed)
    return alone.evaluate(fit.terms, fit.theta, fit.deviation)


def gradients(fit: Fit, mass: float) -> dict[str, np.ndarray]:
    """The gradients of all quantities to the fitted parameters, `(m,)` each."""
    active, steps = fit.known.active, STEP * np.sqrt(np.diag(fit.covariance))
    shifts = np.zeros((len(active), len(fit.theta)))
    shifts[np.arange(len(active)), active] = steps
    ends = quantities(fit.theta + np.stack([shifts, -shifts]), fit.top, mass)
    return {name: np.nan_to_num((each[0] - each[1]) / (2 * steps)) for name, each in ends.items()}
