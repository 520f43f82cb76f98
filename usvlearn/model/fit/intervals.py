"""90 % intervals of what was fitted: from the missions' scatter, from the sets of terms, and from wear.

With A = (Σ H + I₀)⁻¹ and the scatter B of the missions' scores g_m about their mean, M/(M − 1) Σ (g_m − ḡ)(g_m − ḡ)ᵀ,
a quantity q with gradient ∇q has the variance

    ∇qᵀ (A + SCATTER · A B A) ∇q + (q' − q)² + (OWN q)²                                                (1)

A alone supposes that the model is true and that errors are independent; A B A, the sandwich, sees what differs from
mission to mission (White 1982). q' is the value, farthest from q, by another set of terms that does about as well on
missions which it has not learned. OWN is an error that no log shows: the wear of a boat between its missions, and what
every set lacks. SCATTER and OWN were chosen on simulated boats.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from usvlearn.core.events import NINETY
from usvlearn.estimators.joint.lacking import Quantity
from usvlearn.estimators.joint.quantities import QUANTITIES
from usvlearn.estimators.joint.reading import POSITIVE
from usvlearn.model.fit.choice import Score
from usvlearn.model.fit.gauss_newton import Fit
from usvlearn.model.fit.quantities import quantities

SCATTER = 4.0
STEP = 0.1  # deviations: the step of a central difference
OWN = dict.fromkeys(QUANTITIES, 0.03) | {"drag_cross": 0.3, "drag_linear": 0.1, "drag_quadratic": 0.1}
ALIKE = 0.02  # loss a step by which another set may be worse than the chosen one, and still counts


def intervals(fits: Mapping[str, Fit], scores: Mapping[str, Score], chosen: str, mass: float) -> dict[str, Quantity]:
    """All quantities of the chosen set, each with its interval; NaN where it is undefined.

    Args:
        fits, scores: of all sets, by name.
        chosen: the set to use.
        mass: kg.
    """
    fit = fits[chosen]
    values = quantities(fit.theta, fit.top, mass)
    slopes = _gradients(fit, mass)
    covariance = spread(fit)
    alike = [name for name in fits if name != chosen and -scores[name].gain <= ALIKE]
    others = [quantities(fits[name].theta, fit.top, mass) for name in alike]
    found = {}
    for name, value in values.items():
        apart = max((abs(each[name] - value) for each in others if math.isfinite(each[name])), default=0.0)
        variance = float(slopes[name] @ covariance @ slopes[name]) + apart**2 + (OWN[name] * value) ** 2
        low, high = _around(name, value, NINETY * math.sqrt(max(variance, 0.0)))
        found[name] = Quantity(value, low, high, QUANTITIES[name])
    return found


def spread(fit: Fit) -> np.ndarray:
    """A + SCATTER · A B A of (1), `(m, m)`; A alone where there is one mission."""
    A, count = fit.covariance, len(fit.score)
    if count < 2:
        return A
    away = fit.score - fit.score.mean(0)
    found: np.ndarray = A + SCATTER * count / (count - 1) * A @ (away.T @ away) @ A
    return found


def _gradients(fit: Fit, mass: float) -> dict[str, np.ndarray]:
    """The gradients of all quantities to the fitted parameters, `(m,)` each."""
    deviations = np.sqrt(np.diag(fit.covariance))
    found: dict[str, list[float]] = {}
    for place, deviation in zip(fit.known.active, deviations, strict=True):
        ends = []
        for sign in (1.0, -1.0):
            theta = fit.theta.copy()
            theta[place] += sign * STEP * deviation
            ends.append(quantities(theta, fit.top, mass))
        for name in ends[0]:
            found.setdefault(name, []).append((ends[0][name] - ends[1][name]) / (2 * STEP * deviation))
    return {name: np.nan_to_num(np.array(each)) for name, each in found.items()}


def _around(name: str, value: float, half: float) -> tuple[float, float]:
    """The ends of an interval; on the log scale where only positive values make sense."""
    if name in POSITIVE and value > 0:
        ratio = math.exp(min(half / value, 10.0))
        return value / ratio, value * ratio
    return value - half, value + half
