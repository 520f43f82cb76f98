"""The axis EKF: an extended Kalman filter over the yaw rate or the sway, a disturbance and the parameters.

Equations (1) to (4): `docs/theory/identification.md#yaw-rate-and-sway`. It is to the other two axes what the joint EKF
is to the surge. y is the yaw rate r, rad/s, or the sway v through the water, m/s; o is the other one of them; u is the
surge through the water. u and o come from other estimators and are taken as known: `Inputs` hold o as `heading` and u
as `yaw_rate`, and a `Sample` holds the measured y as `surge`.
"""

from __future__ import annotations

from usvlearn.core.family import FINITE, POSITIVE, POSITIVE_OR_INFINITE, Family, Parameters, ParameterVectors
from usvlearn.estimators.augmented_ekf.state import FROZEN, leaves
from usvlearn.estimators.regressors.terms import LAG

KINDS = ("yaw", "sway")
THETA = 2  # place of the first parameter in x, behind y and b
BODY = ("bias", "linear", "quadratic", "cross", "coupling", "other", "surge")
THRUST = {
    "yaw": ("linear", "quadratic", "speed", "cubic", "even_linear", "even_quadratic"),
    "sway": ("linear", "quadratic"),
}
LINEAR, QUADRATIC, CROSS, COUPLING, OTHER, SURGE = range(THETA + 1, THETA + len(BODY))
SIDE = THETA + len(BODY)  # place of the left side's first term


def names(kind: str) -> tuple[str, ...]:
    """The names of the parameters, in the order of x."""
    return (*BODY, *(f"{term}_{side}" for side in ("left", "right") for term in THRUST[kind]), LAG)


SIZES = {kind: THETA + len(names(kind)) for kind in KINDS}


class Number(Parameters):
    """Hyperparameters, in the units of the arguments of `AxisEKF`."""

    DISTURBANCE = POSITIVE  # q_b
    DISTURBANCE_TIME = POSITIVE  # τ_b
    DRIFT_TIME = POSITIVE  # T_θ
    OUTLIER = POSITIVE_OR_INFINITE  # k


class Vector(ParameterVectors):
    """One number for each parameter."""

    VARIANCE = POSITIVE, lambda size: size - THETA  # prior
    PRIOR = FINITE, lambda size: size - THETA  # mean


FAMILY = Family(
    KINDS,
    leaves,
    Number,
    vectors=Vector,
    size=lambda own: SIZES[own["kind"]],
    work=lambda n: 4 * n + 2,
    frozen=FROZEN,
)
