"""The identified quantities of turning, each with a 90 % interval. Imports no torch.

With θ the parameters of the surge (θ̄ of `usvlearn.estimators.joint.periodic_estimates`), of the yaw rate and of the
sway (means of their filters), and ∇g the gradient of a quantity g at θ, the interval is on the log scale

    g(θ) exp(± 1.645 s/g),   s² = Σ ∇gᵀ P ∇g + (ε g)²,   the sum over yaw rate, sway and surge          (1)

P of yaw rate and sway is the covariance of the filter. That of the surge is `SURGE` times λ²P + ν²C of the other
module, whose intervals are wide enough for thrust and drag of other shapes; all of it where drag or thrust of the surge
are not informed. ε (`OWN_ERROR`) is for boats with dead zones, lags and without a gyro, of which the filter finds yaw
rates up to 45 % too small, and time constants up to 8 times: of these nothing is said.

Without excitation P stays as wide as the prior P₀, and so do the intervals. Whether the boat turned is seen in the
share of the prior's variance that is left in the yaw rate of a turn,

    ∇gᵀ P ∇g / ∇gᵀ P₀ ∇g,   of the yaw rate's parameters alone                                         (2)
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from usvlearn.core.events import NINETY
from usvlearn.estimators.axis.state import THETA
from usvlearn.estimators.axis.turning_quantities import QUANTITIES, Theta, quantities
from usvlearn.estimators.joint.excitation_warnings import FEW, Quantity
from usvlearn.estimators.joint.periodic_estimates import Identified, covariance_of
from usvlearn.estimators.joint.quantities import gradients, steps_of

SURGE = 0.1  # of (1)
OWN_ERROR = {name: 0.45 if "radius" in name else 0.35 for name in QUANTITIES} | {
    "yaw_rate_full_difference": 0.2, "yaw_time_constant": 1.2, "yaw_time_constant_rest": 1.2,
}  # fmt: skip  # ε of (1)
TOLD, VAGUE = "yaw_rate_half", 0.3  # quantity and limit of (2), beyond which the boat hardly turned
RATIO = 10.0  # high over low, beyond which an interval says nothing
WIDEST = math.log(1000)  # exponent of an interval
HARDLY = (
    "The boat hardly turned by its thrusters: its yaw rates and turning radii cannot be determined. Let the difference "
    "of the commands vary."
)
B = TypeVar("B", bound=Identified)
FIRST = "Yaw rates, turning radii and yaw time constants: –; the batch fit tells them (usvlearn fit, refit=true)."
Filter = tuple[Mapping[str, Any], Mapping[str, np.ndarray]]  # description of an axis EKF, and leaves of its state


def with_turning(surge: Identified, surge_variance: np.ndarray, yaw: Filter, sway: Filter | None) -> Identified:
    """What was identified of the surge, and the quantities of turning (`turning_quantities.QUANTITIES`) behind it.

    `surge_variance` is the prior variance of its parameters, `(m,)`; yaw and sway are of one boat, None: not measured.
    """
    updates = float(yaw[1]["updates"])
    share = 1.0 if surge.beside is None or surge.beside.vague else SURGE
    parts = [_Part(surge.theta, share * surge.covariance, surge_variance), _part(yaw)]
    parts += [] if sway is None else [_part(sway)]
    if not updates or not all(np.isfinite(part.theta).all() and np.isfinite(part.P).all() for part in parts):
        said = "The filter of the yaw rate has diverged." if updates else (
            "Neither heading nor yaw rate was measured under way: nothing is known of turning."
        )  # fmt: skip
        nothing = {name: Quantity(math.nan, math.nan, math.nan, unit) for name, unit in QUANTITIES.items()}
        return joined(surge, nothing, [said])
    values, slopes = _gradients(parts)
    quantities = {}
    for name, unit in QUANTITIES.items():
        variance = sum(float(g @ part.P @ g) for part, g in zip(parts, slopes[name], strict=True))  # (1)
        quantities[name] = on_log_scale(values[name], variance, OWN_ERROR[name], unit)
    return joined(surge, quantities, _lacks(parts[1], slopes[TOLD][1], updates) or [FIRST], told=False)


class _Part(NamedTuple):
    """The parameters of one axis."""

    theta: np.ndarray  # (m,)
    P: np.ndarray  # (m, m)
    variance: np.ndarray  # (m,) of the prior


def _part(given: Filter) -> _Part:
    description, leaves = given
    mean, factor = (np.asarray(leaves[name], dtype=np.float64) for name in ("mean", "factor"))
    variance = np.asarray(description["vectors"]["variance"], dtype=np.float64)
    return _Part(mean[THETA:], covariance_of(factor)[THETA:, THETA:], variance)


def _gradients(parts: list[_Part]) -> tuple[dict[str, float], dict[str, list[np.ndarray]]]:
    """All quantities, and their gradients to the parameters of each axis, by central differences."""
    theta = np.concatenate([part.theta for part in parts])
    steps = np.concatenate([steps_of(part.variance) for part in parts])
    ends = np.cumsum([len(part.theta) for part in parts])[:-1]
    values, slopes = gradients(lambda each: quantities(Theta(*np.split(each, ends, -1))), theta, steps)
    return values, {name: np.split(slope, ends) for name, slope in slopes.items()}


def on_log_scale(value: float, variance: float, error: float, unit: str) -> Quantity:
    """(1); NaN where it is undefined."""
    if not (math.isfinite(value) and value > 0 and math.isfinite(variance)):
        return Quantity(math.nan, math.nan, math.nan, unit)
    ratio = math.exp(min(NINETY * math.hypot(math.sqrt(max(variance, 0.0)) / value, error), WIDEST))
    return Quantity(value, value / ratio, value * ratio, unit)


def _lacks(yaw: _Part, slope: np.ndarray, updates: float) -> list[str]:
    """What the log lacks for the quantities of turning, one sentence each; `slope`, `(20,)`, is that of `TOLD`."""
    if updates < FEW:
        return [f"Only {updates:.0f} steps of the yaw rate were learned under way: nothing is known of turning yet."]
    share = (slope @ yaw.P @ slope) / (slope @ (yaw.variance * slope))  # (2)
    if share <= VAGUE:
        return []
    return [HARDLY]


def joined(surge: B, turning: dict[str, Quantity], lacks: Sequence[str], told: bool = True) -> B:
    """A boat with the quantities of turning behind those of the surge, told or not, and what its log lacks for them."""
    unknown = {name for name, each in turning.items() if not (told and each.high <= RATIO * each.low)}
    return dataclasses.replace(
        surge, quantities=surge.quantities | turning, lacks=(*surge.lacks, *lacks), unknown=surge.unknown | unknown
    )
