"""The ARX filter: a Kalman filter over the weights of a linear model of the speed's increment.

ARX: autoregressive with exogenous inputs. Equations (1) to (4): `docs/theory/estimators.md#arx`. The covariance is kept
in the factors of `usvlearn.estimators.ud_factorization`. A step without a measured speed departs from the prediction
before it, and its increment is the predicted one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from usvlearn.core.family import (
    NOT_NEGATIVE,
    POSITIVE,
    TRIANGLE,
    UNIT,
    Family,
    Options,
    Parameters,
    ParameterVectors,
    Range,
    leaf,
)

if TYPE_CHECKING:
    from torch import Tensor

STEP = 0.4  # s, the step that weights refer to
LONGEST = 25.0  # steps; a longer step counts as this long
REST_SQUARE = 0.01  # of u_L² + u_R² + v², v in m/s, below which a boat rests
REST_TIME = 60.0  # s of rest after which nothing is learned
MOST_LAGS = 50  # 20 s; p grows with it, and the time of a step as p²

SPEED, SQUARE, RATES = 1, 2, 4  # places in f of v, of v|v| and of the first increment
EVEN_SQUARE = 2  # place of v² in its group
COMMANDS = ("sum", "difference", "square_left", "square_right")
EVEN = ("even_command", "even_command_square", "even_speed_square", "even_command_speed")
TURNING = ("yaw_rate", "yaw_rate_change")
THRUST_SPEED = ("thrust_speed_left", "thrust_speed_right")


def deviations(lags: int, even: bool, turning: bool, thrust_speed: bool) -> dict[str, float]:
    """The features in their order, each with the prior deviation of its weight over `scale`."""
    return {
        "bias": 1.0,
        **dict.fromkeys(("speed", "speed_square", "turning_speed"), 10.0),
        **{f"increment_{j}": 30.0 / j for j in range(1, lags + 1)},
        **{f"{name}_{j}": 10.0 for j in range(lags + 1) for name in COMMANDS},
        **dict.fromkeys(EVEN if even else (), 1.0),
        **dict.fromkeys(TURNING if turning else (), 10.0),
        **dict.fromkeys(THRUST_SPEED if thrust_speed else (), 10.0),
    }


class ARXState(NamedTuple):
    """The state of the ARX filter; p features."""

    theta: Tensor  # (*batch, p) weights, m/s per step of 0.4 s and unit of the feature
    factor: Tensor  # (*batch, p, p) U and D of P: row j holds U_ij for i < j, then D_j; zeros above the diagonal
    past: Tensor  # (*batch, p) f of the last step, its increments moved on by one; zeros where a segment starts
    surge: Tensor  # (*batch,) speed from which the next step departs, m/s
    noise: Tensor  # (*batch,) σ², m²/s²
    deviation: Tensor  # (*batch,) standard deviation of the last prediction, √(S σ²), m/s
    turn: Tensor  # (*batch,) place of the parameter that gets random-walk noise next
    rest: Tensor  # (*batch,) s of rest so far
    started: Tensor  # (*batch,) bool: no step was made since the segment's start


class Number(Parameters):
    """Constants and hyperparameters."""

    SURGE_MAX = POSITIVE
    WALK = POSITIVE
    TAILS = NOT_NEGATIVE  # 1/ν


class Vector(ParameterVectors):
    """One number for each weight."""

    PRIOR = POSITIVE  # the diagonal of P₀


class Choice(Options):
    """Choices: the features."""

    LAGS = Range(0, MOST_LAGS)
    EVEN = False, True
    TURNING = False, True
    THRUST_SPEED = False, True
    PROJECT = False, True


def parameters(own: Mapping[str, Any]) -> int:
    """How many features an estimator has, from its entries in a description."""
    return len(deviations(*(own[choice.key] for choice in Choice if choice != Choice.PROJECT)))


FAMILY = Family(
    ("arx",),
    lambda p: ARXState(
        theta=leaf(p),
        factor=leaf(p, p, legal=TRIANGLE),
        past=leaf(p),
        surge=leaf(),
        noise=leaf(legal=POSITIVE),
        deviation=leaf(legal=NOT_NEGATIVE),
        turn=leaf(legal=Range(0.0, max(p - 1.0, 0.0), index=True)),
        rest=leaf(legal=NOT_NEGATIVE),
        started=leaf(legal=UNIT, flag=True),
    ),
    Number,
    Choice,
    Vector,
    size=parameters,
    work=lambda p: 5 * p,
    frozen=("theta", "past", "surge", "started"),
)
AT = FAMILY.at
