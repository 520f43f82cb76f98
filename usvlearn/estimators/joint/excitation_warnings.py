"""Warnings that a log excites the boat too little, from a joint EKF's covariance and quantities. Imports no torch.

The equations are those of `periodic_estimates`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from usvlearn.estimators.augmented_ekf.state import NOISE_LEAST
from usvlearn.estimators.joint.quantities import EVEN_BESIDE, SIDES
from usvlearn.estimators.joint.state import NORTH, THETA, names
from usvlearn.estimators.regressors.terms import SURGE

SILENT = 2 * NOISE_LEAST  # m/s, of the noise: no sensor is as good
FEW = 100  # update steps below which nothing else is said
UNUSED = 0.8  # of (3): no step told anything
VAGUE_DRAG, VAGUE_THRUST = 0.1, 0.3  # of (3), beyond which an interval contains the prior's
ONE_HEADING = 0.9  # share of the current's variance across the heading, after some 10 min without a turn
WIDE = 0.5  # half-width over value, beyond which a quantity is not well determined
FAR = 1.5  # ratio of the steady speed to vehicle.surge_max, or its inverse
ASTERN_ONLY = 4.0, 0.1  # ratio of (3) ahead to (3) astern, and least (3) ahead, where the boat went astern only
ONE_COMMAND = "Both thrusters always had the same command: their thrusts cannot be told apart."
WRONG_SIGN = (
    "known: the forces have the opposite sign of those found, so that neither mass nor forces can be told; thrust "
    "ahead is positive, drag negative: correct the signs, and learn anew."
)


POSITIVE_OF_BOATS = {  # what no boat has below zero, in words
    "steady_speed_full": "a steady speed at full command",
    "thrust_full_left": "a full thrust of the left side",
    "thrust_full_right": "a full thrust of the right side",
    "time_constant": "a time constant",
}


class Quantity(NamedTuple):
    """A quantity with its 90 % interval; NaN where nothing is known."""

    value: float
    low: float
    high: float
    unit: str


class Lacking(NamedTuple):
    """What a log lacks."""

    lacks: tuple[str, ...]
    vague: bool  # whether the drag or the thrust is not informed
    astern: np.ndarray  # (m,) variance of fore-aft asymmetry terms, to be added where the boat never went ahead
    blind: float  # m/s, standard deviation of a current that cannot be separated from the speed


def lacking(P: np.ndarray, variance: np.ndarray, current: float, updates: float, silent: bool) -> Lacking:
    """What a log lacks, from the covariance P, `(n, n)`, and the prior variance of the parameters, `(m,)`.

    `silent`: the speed has no noise, as that of a channel that is stuck.
    """
    m = len(variance)
    even = m == len(names(even=True))
    share = {
        name: _least_share(A @ P[THETA:, THETA:] @ A.T, A @ (variance[:, None] * A.T))
        for name, A in _combinations(even).items()
    }  # (3)
    drag, ahead, astern, apart = (share[name] for name in ("drag", "ahead", "astern", "apart"))
    shares = np.linalg.eigvalsh(P[NORTH:THETA, NORTH:THETA]) / current**2
    never = [side for side in SIDES if share[side] > UNUSED]
    pushed = share[f"ahead_{next(side for side in SIDES if side not in never)}"] if len(never) == 1 else ahead
    vague, lacks = drag > VAGUE_DRAG or pushed > VAGUE_THRUST, []
    only_astern = even and ahead > ASTERN_ONLY[0] * astern and ahead > ASTERN_ONLY[1]
    turned = bool(shares[-1] < ONE_HEADING)
    if updates < FEW:
        learned = "1 step was" if updates == 1 else f"{updates:.0f} steps were"
        lacks.append(f"Only {learned} learned under way: the intervals are almost those before any data.")
        turned = True
    elif silent:
        lacks.append("The measured speed does not change, or has no noise: check the speed channel.")
        vague = True
    elif drag > VAGUE_DRAG and not only_astern:
        lacks.append(
            "The speed hardly changed: neither drag nor thrust can be determined. Let the sum of the commands vary, or "
            "check the speed channel."
        )
    elif len(never) == 1:
        lacks.append(f"The {never[0]} thruster was never used: its thrust is only an assumption.")
    elif vague and not only_astern:
        lacks.append("The sum of the commands hardly changed: the thrust cannot be determined. Let the sum vary.")
    elif apart > UNUSED:
        lacks.append(ONE_COMMAND)
    if only_astern:
        lacks.append("The boat went astern only: its motion ahead is an assumption. Let it go ahead, too.")
    if not turned:
        lacks.append(
            "The boat kept one heading, or its opposite, for the last ten minutes or more: the current cannot be "
            "separated from the boat's own speed. Let the boat turn."
        )
    added = np.zeros(m)
    if only_astern:
        place = {name: k for k, name in enumerate(names(even))}
        for odd, beside in EVEN_BESIDE.items():
            added[place[beside]] = variance[place[odd]]
    return Lacking(tuple(lacks), vague, added, 0.0 if turned else current)


@functools.cache
def _combinations(even: bool) -> dict[str, np.ndarray]:
    """The combinations of parameters, `(combinations, m)`, of which (3) is computed."""
    of = dict(zip(names(even), np.eye(len(names(even))), strict=True))
    odd = {side: [f"thrust_{kind}_{side}" for kind in ("linear", "quadratic", "speed", "cubic")] for side in SIDES}
    beside = {name: of[other] for name, other in EVEN_BESIDE.items() if even}
    each = {side: [of[name] for name in odd[side]] + [beside[x] for x in odd[side] if x in beside] for side in SIDES}
    combinations = dict(each)
    combinations["drag"] = [of["drag_quadratic"], of["drag_linear"], *([of["drag_even"]] if even else [])]
    combinations["apart"] = [left - right for left, right in zip(each["left"], each["right"], strict=True)]
    both = {"ahead": (1.0, SIDES), "astern": (-1.0, SIDES)} | {f"ahead_{side}": (1.0, (side,)) for side in SIDES}
    for name, (sign, sides) in both.items():  # linear and quadratic thrust, of the sides together
        combinations[name] = [
            sum((of[odd[side][k]] + sign * beside.get(odd[side][k], 0.0) for side in sides), np.zeros(len(of)))
            for k in range(2)
        ]
    return {name: np.stack(rows) for name, rows in combinations.items()}


def _least_share(left: np.ndarray, prior: np.ndarray) -> float:
    """The least eigenvalue of `left` relative to `prior`, both covariances."""
    lower = np.linalg.inv(np.linalg.cholesky(prior))
    return float(np.linalg.eigvalsh(lower @ left @ lower.T)[0])


def stated_top(variance: np.ndarray) -> float:
    """The top speed that the prior was made with, m/s: the deviation of its first parameter is .5 over it."""
    return 0.5 / math.sqrt(variance[0])


def astray(speed: float, variance: np.ndarray) -> float:
    """How far the steady speed at full command is from the top speed of the prior, as a ratio above 1; 1 below
    `FAR`. The deviations of the prior are wrong by powers of it.
    """
    stated = stated_top(variance)
    ratio = max(stated / max(abs(speed), 1e-3 * stated), abs(speed) / stated) if math.isfinite(speed) else 1.0
    return ratio if ratio > FAR else 1.0


def misstated(speed: float, low: float, high: float, variance: np.ndarray) -> list[str]:
    """A sentence if the interval of the steady speed at full command, m/s, is far from the top speed of the prior."""
    stated = stated_top(variance)
    if not (low > FAR * stated or high < stated / FAR):
        return []
    if speed < 0:  # see `unphysical`
        return []
    return [
        f"vehicle.surge_max: found {stated:.3g} m/s, and the boat's steady speed at full command is "
        f"{speed:.2f} m/s: correct it, and learn anew."
    ]


def unphysical(quantities: Mapping[str, Quantity]) -> str:
    """A sentence about quantities that are surely negative, and cannot be so; "" if there is none."""
    wrong = [
        f"{words} of {quantities[name].value:.3g} {quantities[name].unit}"
        for name, words in POSITIVE_OF_BOATS.items()
        if name in quantities and quantities[name].value < 0 and quantities[name].high < 0
    ]
    if not wrong:
        return ""
    return (
        f"The identified boat is not physical: it has {' and '.join(wrong)}. Signs or sides are wrong: check "
        "data.channels.command_left and data.channels.command_right (name, zero, span) and the sign of "
        "data.channels.surge.span, and learn anew."
    )


def undetermined(quantities: Mapping[str, Quantity]) -> list[str]:
    """A sentence that names quantities with half-widths of more than `WIDE` times their values.

    Single parameters, which trade against each other, are left out.
    """
    wide = [
        name
        for name, (value, low, high, _) in quantities.items()
        if name not in SURGE and not high - low < 2 * WIDE * abs(value)
    ]
    if not wide:
        return []
    return [
        f"Not well determined: {', '.join(wide)}, whose intervals are wider than ± half of the value. Learn from a "
        "longer log in which both commands change often, up to full."
    ]
