"""The ARX filter: a Kalman filter over the weights of a linear model of the speed's increment.

ARX: autoregressive with exogenous inputs. The increment of a step depends on the last L increments and on the commands
of this step and of the L before. With h = dt/(0.4 s), and everything per step of 0.4 s:

    v⁺ = v + h fᵀθ + noise,   f = [1, v, v|v|, |r|v,  a_1 … a_L,  g(u_k), g(u_{k−1}) … g(u_{k−L}), further groups]   (1)
    g(u) = [u_L + u_R, u_L − u_R, u_L|u_L|, u_R|u_R|],   a_j = (v_{k−j+1} − v_{k−j})/h_{k−j}

Further groups, each an option: *even*, for boats that differ forwards and backwards, |u_L| + |u_R|, u_L² + u_R², v² and
(u_L + u_R)v; *turning*, r and its change since the step before; *thrust_speed*, u_L|v| and u_R|v|. In f the speed is
limited to ±`surge_max`, each a_j to ±`surge_max`, and h to 25 (a step of 10 s).

Measurement update with e = v_meas − v − hfᵀθ, φ = hf and the covariance P in units of σ². The noise has Student's t
distribution of ν degrees; its weight w is small for outliers (West 1981):

    S = 1 + φᵀPφ,   w = (ν + 1)/(ν + e²/(S σ²)),   θ⁺ = θ + Pφ e/(1/w + φᵀPφ),   P⁺ = P − PφφᵀP/(1/w + φᵀPφ)         (2)
    σ² ← σ² + 0.02 (w e²/S − σ²),   at least (1 mm/s)²                                                              (3)

w is 1 for all e where ν is infinite. With `project` drag slows the boat: the weights of v, and of v|v| plus and minus
that of the even v², are not positive: in turn, each is projected in the metric of P, (3) of
`usvlearn.estimators.ud_factorization`. Without it a model may grow without bound beyond the speeds that it has seen.

Before the first sample P is diagonal, with the deviations `scale` × (1 for the bias and the fore-aft asymmetry terms,
30/j for a_j, 10 for all others): as multiples of the noise.

Weights walk at random: of variance `walk` P₀ per step of 0.4 s. The factored covariance takes one of the p weights per
update step, in turn, with p times its share; its variance grows up to the prior's and no further:

    P_ii ← P_ii + min(p h walk P₀_ii, P₀_ii − P_ii)                                                                 (4)

so that no idle hour lets P grow without bound. While no speed is measured no noise is added. A boat rests where
u_L² + u_R² + v² < 0.01. After 60 s of rest nothing is learned, and no noise is added, until it moves: at rest the best
prediction of a noisy speed is 0, which is wrong for a boat that moves, and hours would teach nothing else.

A segment starts with a speed alone. The increments before it count as 0, the commands before its first step as equal
to those of this step, and the yaw rate as unchanged. A step without a measured speed departs from the prediction before
it, and its increment is the predicted one.

The covariance is kept as P = U D Uᵀ (`usvlearn.estimators.ud_factorization`), with H = φ and α_0 = 1/w in (2). The
first σ, and the share and the least of (3), are those of least squares.

The derivation is in `docs/theory/estimators.md#arx`.
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
    """The features in their order, each with the prior deviation of its weight over `scale`.

    >>> list(deviations(1, False, False, False))[:6]
    ['bias', 'speed', 'speed_square', 'turning_speed', 'increment_1', 'sum_0']
    >>> len(deviations(3, True, True, True))
    31
    """
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
