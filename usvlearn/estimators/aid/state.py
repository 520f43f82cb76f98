"""Adaptive identification (AID) of the surge dynamics.

Continuous (Smallwood & Whitcomb 2003, scalar plant; paper, section IV-C), Δv = v̂ − v, Δθ = θ̂ − θ, a_m < 0:

    v̂_dot = Wᵀθ̂/m + a_m Δv,    θ̂_dot = −Γ W Δv,    V = ½Δv² + ½ Δθᵀ Γ⁻¹ Δθ / m,    V_dot = a_m Δv² ≤ 0

Discrete, with φ = dt·W/m, e = predicted − measured, N = φᵀΓφ; safe for every gain because the step is normalised:

    v̂⁺ = v + φᵀθ̂                                                        (1)
    Γ = gain·diag(spread²)                                               (2)
    θ̂⁺ = clip( θ̂ − Γ φ dz(e)/(1 + N) )  onto the signs of physics          (3)
    V = ½ Δθᵀ Γ⁻¹ Δθ,   V⁺ − V ≤ −½ e²/(1 + N)  without noise

dz is a dead zone. Γ is diagonal, so the clip is the exact projection in the metric Γ⁻¹ and can only lower V. Spread is
in the unit of each parameter and gain in s²/m², so that N has none: (3) is the first step of a Kalman filter with the
prior deviations `spread` and noise of 1/√gain m/s.

Leakage by switching σ-modification (Ioannou & Kokotovic 1984; Ioannou & Sun 1996, chapter 8) towards θ₀:

    n = ‖(θ̂ − θ₀)/spread‖,   σ_s = σ min(max(n/M − 1, 0), 1)               (4)
    θ̂⁺⁺ = θ̂⁺ − l (θ̂⁺ − θ₀),   l = min(1 − exp(−σ_s dt), 1 − M/max(n, M))    (5)

It is the exact solution of a leak held over dt, and stops at the ball n = M. With c = 1 − l the change of V is
proportional to −(1 − c)[(1 + c) n² − 2 x·x*], where x and x* are the normalised θ̂⁺ and θ; since ‖x*‖ ≤ M and
c n ≥ M this is never positive, for any σ and dt: where the truth lies in the ball, leakage can only lower V. θ₀ has the
signs of physics, and so has every point between it and θ̂⁺.

Parallel ("estimate"): v in (1) is AID's own estimate. It keeps the error *after* learning, ε, and the leak of a_m
exactly:

    ε = e − N dz(e)/(1 + N),   v̂⁺ = v_meas + ε exp(a_m dt)                  (6)
    V = ½Δv² + ½ Δθᵀ Γ⁻¹ Δθ,   V⁺ − V ≤ −½ (1 − exp(2 a_m dt) + N) ε²

for any gain, without noise, while the boat's own model contracts; with e in place of ε, V can rise. The regressor is
taken at the estimate, W(v̂): then V_dot = a_m Δv² + Δv (W(v̂) − W(v))ᵀθ/m, and for a boat that moves ahead drag makes
the last term negative.

The mass only scales the parameters. Surge data cannot identify it; `mass` recovers it from known quantities.

The derivation is in `docs/theory/estimators.md#aid`.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING, NamedTuple

from usvlearn.core.family import (
    FEEDBACK,
    FINITE,
    MODEST,
    NOT_NEGATIVE,
    POSITIVE,
    Family,
    Options,
    Parameters,
    ParameterVectors,
    Range,
    leaf,
)
from usvlearn.estimators.regressors import terms

if TYPE_CHECKING:
    from torch import Tensor


class AIDState(NamedTuple):
    """The state of AID."""

    theta: Tensor  # (*batch, p) parameters in the order and units of the model's names
    surge: Tensor  # (*batch,) speed from which the next step departs, m/s


class Number(Parameters):
    """Constants and hyperparameters, in the units of the arguments of `AID`."""

    SCALE = MODEST  # the mass, or 1
    SURGE_MAX = POSITIVE
    GAIN = POSITIVE
    LEAK = POSITIVE
    DEAD_ZONE = NOT_NEGATIVE
    FLOOR = NOT_NEGATIVE
    SIGMA = NOT_NEGATIVE
    BOUND = POSITIVE


class Vector(ParameterVectors):
    """One number for each parameter."""

    SPREAD = NOT_NEGATIVE
    INVERSE_SPREAD = NOT_NEGATIVE
    THETA0 = FINITE
    LOWER = Range(-inf, 0.0)
    UPPER = Range(0.0, inf)


class Choice(Options):
    """Choices."""

    FEEDBACK = FEEDBACK
    TERMS = terms.TERMS


FAMILY = Family(
    ("aid",),
    lambda p: AIDState(theta=leaf(p), surge=leaf()),
    Number,
    Choice,
    Vector,
    size=terms.parameters,
    work=lambda p: 2 * p,
    heading=terms.heading,
    frozen=("theta", "surge"),
)
AT = FAMILY.at
