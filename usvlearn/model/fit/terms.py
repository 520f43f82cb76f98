"""The parameters of the batch fit: the terms of the joint EKF, and curves of thrust and drag on nodes.

Equation (1) and the prior: `docs/theory/identification.md#batch-fit`. A set of terms says which parameters are fitted;
the others are 0. The time constant of the thrust is in all of them: with steering, a set without it takes drag, thrust
and the boat's time constant for wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from usvlearn.estimators.joint.quantities import SIDES
from usvlearn.estimators.joint.state import names
from usvlearn.estimators.regressors.terms import LAG

THRUST_NODES = np.arange(1, 9) / 8  # |ξ|
DRAG_NODES = np.arange(1, 7) / 5  # |w| over the top speed
POLYNOMIAL = tuple(name for name in names(even=True) if name != LAG)  # those of the joint EKF, in its order
SIGNS = ("ahead", "astern")
TIME_CONSTANT = "thruster_time_constant"  # s
NAMES = (
    *POLYNOMIAL,
    *(f"thrust_node_{side}_{sign}_{node:g}" for side in SIDES for sign in SIGNS for node in THRUST_NODES),
    *(f"drag_node_{node:g}" for node in DRAG_NODES),
    LAG,
    TIME_CONSTANT,
)
AT = {name: k for k, name in enumerate(NAMES)}
PLACE_THRUST, PLACE_DRAG, PLACE_LAG, PLACE_TIME = (
    AT["thrust_node_left_ahead_0.125"], AT["drag_node_0.2"], AT[LAG], AT[TIME_CONSTANT],
)  # fmt: skip

EVEN = tuple(name for name in POLYNOMIAL if "even" in name)
CUBIC = tuple(name for name in POLYNOMIAL if "cubic" in name)
NINE = (*(name for name in POLYNOMIAL if name not in (*EVEN, *CUBIC)), TIME_CONSTANT)
THRUST_CURVES = tuple(name for name in NAMES if name.startswith("thrust_node"))
DRAG_CURVES = tuple(name for name in NAMES if name.startswith("drag_node"))
SETS: Mapping[str, tuple[str, ...]] = {
    "nine": NINE,
    "cubic": (*NINE, *CUBIC, LAG),
    "even": (*NINE, *CUBIC, LAG, *EVEN),
    "thrust curves": (*NINE, *CUBIC, LAG, *THRUST_CURVES),
    "curves": (*NINE, *CUBIC, LAG, *THRUST_CURVES, *DRAG_CURVES),
    "curves, even": (*NINE, *CUBIC, LAG, *THRUST_CURVES, *DRAG_CURVES, *EVEN),
}  # the terms of each by name


def by_name(names: Sequence[str], values: np.ndarray) -> np.ndarray:
    """All parameters, `(..., parameters)`, of some with their names, `(..., m)`; the others are 0."""
    theta = np.zeros((*values.shape[:-1], len(NAMES)))
    theta[..., [AT[name] for name in names]] = values
    return theta


SETTLES = 2.5  # s, time constant of the prior's boat
THRUST_SHARE, THRUST_LENGTH = 0.15, 0.35  # deviation of a node over full thrust; correlation length, of commands
DRAG_SHARE, DRAG_LENGTH = 0.2, 0.35  # likewise over full drag, and of speeds over the top speed
ALONE = 1e-2  # of the deviation of a node that its neighbours do not share
ASYMMETRY, LAG_DEVIATION, SPEED_SHARE = 0.2, 0.3, 0.1
AT_ONCE, TIME_DEVIATION = 0.02, 0.3  # s: the prior of the time constant of the thrust


class Prior(NamedTuple):
    """A Gaussian prior of a set of terms."""

    mean: np.ndarray  # (parameters,) of all of `NAMES`
    active: np.ndarray  # (m,) places of the fitted ones
    information: np.ndarray  # (m, m) inverse of their covariance

    def penalty(self, theta: np.ndarray) -> float:
        """½ (θ − θ₀)ᵀ I₀ (θ − θ₀)."""
        away = (theta - self.mean)[self.active]
        return float(0.5 * away @ self.information @ away)


def prior(terms: str, top: float) -> Prior:
    """What is known before the logs: a boat that reaches its top speed, m/s, with a time constant of 2.5 s."""
    linear, quadratic = -0.5 / SETTLES, -0.25 / (SETTLES * top)
    full = 0.5 * (abs(linear) * top + abs(quadratic) * top**2)  # thrust of a side, m/s²
    mean, deviation = np.zeros(len(NAMES)), np.zeros(len(NAMES))
    typical = {"drag_quadratic": 0.5 / top, "drag_linear": 0.4, "drag_cross": 0.3, "drag_even": ASYMMETRY * 0.5 / top,
           LAG: LAG_DEVIATION, TIME_CONSTANT: TIME_DEVIATION}  # fmt: skip
    mean[AT["drag_quadratic"]], mean[AT["drag_linear"]] = quadratic, linear
    mean[PLACE_TIME] = AT_ONCE
    for side in SIDES:
        mean[AT[f"thrust_linear_{side}"]] = mean[AT[f"thrust_quadratic_{side}"]] = full / 2
        typical |= {f"thrust_{kind}_{side}": full for kind in ("linear", "quadratic", "cubic")}
        typical |= {f"thrust_speed_{side}": SPEED_SHARE * full / top}
        typical |= {f"thrust_even_{kind}_{side}": ASYMMETRY * full for kind in ("linear", "quadratic")}
        typical |= {f"thrust_even_speed_{side}": ASYMMETRY * full / top}
    for name, value in typical.items():
        deviation[AT[name]] = value
    covariance = np.diag(deviation**2)
    thrust = THRUST_SHARE * full
    for first in range(PLACE_THRUST, PLACE_DRAG, len(THRUST_NODES)):
        some = slice(first, first + len(THRUST_NODES))
        covariance[some, some] = _smooth(THRUST_NODES, thrust, THRUST_LENGTH)
    some = slice(PLACE_DRAG, PLACE_LAG)
    covariance[some, some] = _smooth(DRAG_NODES, DRAG_SHARE * full, DRAG_LENGTH)
    active = np.array(sorted(AT[name] for name in SETS[terms]))
    fixed = np.setdiff1d(np.arange(len(NAMES)), active)
    mean[fixed] = 0.0
    return Prior(mean, active, np.linalg.inv(covariance[np.ix_(active, active)]))


def _smooth(nodes: np.ndarray, deviation: float, length: float) -> np.ndarray:
    """A covariance whose correlation falls with the distance of the nodes."""
    apart = (nodes[:, None] - nodes) / length
    return deviation**2 * (np.exp(-0.5 * apart**2) + ALONE * np.eye(len(nodes)))
