"""Recursive least squares, for any model that is linear in its parameters; here with exponential forgetting.

With y the part of the speed that φᵀθ explains, and λ the forgetting factor (Plackett 1950; paper, section IV-D):

    s = λ + φᵀPφ,   K = Pφ/s,   θ⁺ = θ + K (y − φᵀθ),   P⁺ = (P − Pφ φᵀP/s)/λ        (1)

which minimises Σ λ^(k−j) (y_j − φ_jᵀθ)² + λ^k θᵀP₀⁻¹θ. Computed with the Cholesky factor S of P = S Sᵀ, lower
triangular (Carlson 1973): with f = Sᵀφ, P⁺ = S (I − f fᵀ/s) Sᵀ/λ, and the matrix between has a factor T in closed form,

    α_j = λ + Σ_{i>j} f_i²,   T_jj = √(α_j/α_{j−1}),   T_ij = −f_i f_j/√(α_{j−1} α_j)  for i > j,   S⁺ = S T/√λ     (2)

in which nothing cancels, and which costs p² operations where one goes along the rows of S from their ends. The
textbook's P − K (φᵀP) multiplies its rounding asymmetry by 1/λ at every step and diverges within minutes; S Sᵀ is
symmetric and positive by construction. Where data stop informing a direction, P grows there without bound: forgetting
pauses wherever it would lift the trace of P over a limit. `SIFtRLS` (see `sift`) needs no such limit.

P is in units of the noise's variance σ², which is estimated from the innovations. The variance of a prediction is
σ² (1 + φᵀPφ)   (3).

The derivation is in `docs/theory/estimators.md#rls`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from usvlearn.core.family import (
    FACTOR,
    FEEDBACK,
    MODEST,
    NOT_NEGATIVE,
    POSITIVE,
    TRIANGLE,
    UNIT,
    Family,
    Options,
    Parameters,
    Range,
    leaf,
)
from usvlearn.estimators.regressors import terms

if TYPE_CHECKING:
    from torch import Tensor

NOISE = 0.05  # m/s, σ before the first innovation
LOOSEST = 100.0  # times P₀'s trace
NOISE_SHARE = 0.02  # of a new innovation in σ²
NOISE_LEAST = 1e-3  # m/s; exact predictions at rest for hours must not make σ so small that it cannot recover
LONGEST = 20.0  # memories: a longer step forgets no more, lest 1/λ overflow


class RLSState(NamedTuple):
    """The state of recursive least squares."""

    theta: Tensor  # (*batch, p) parameters
    factor: Tensor  # (*batch, p, p) S, the Cholesky factor of the covariance, lower triangular
    surge: Tensor  # (*batch,) speed from which the next step departs, m/s
    noise: Tensor  # (*batch,) σ², m²/s²
    deviation: Tensor  # (*batch,) standard deviation of the last prediction by (3), m/s

    @property
    def covariance(self) -> Tensor:
        """P = S Sᵀ, `(*batch, p, p)`, in units of the measurement noise's variance."""
        return self.factor @ self.factor.mT


class Number(Parameters):
    """Numbers of both kinds; a number that a kind does not use has the value that forgets nothing."""

    SCALE = MODEST  # the mass, or 1
    SURGE_MAX = POSITIVE
    PRIOR = POSITIVE  # the trace of P₀
    LOOSEST = NOT_NEGATIVE
    NOISE_SHARE = UNIT
    NOISE_LEAST = POSITIVE  # m²/s²
    FORGETTING = FACTOR  # of "rls"
    TRACE_MAX = NOT_NEGATIVE  # of "rls"
    MEMORY = POSITIVE  # s, of "sift"
    LONGEST = Range(0.0, 80.0)  # of "sift": the exponent of 1/λ
    FLOOR = NOT_NEGATIVE  # of "sift"


class Choice(Options):
    """Choices."""

    FEEDBACK = FEEDBACK
    TERMS = terms.TERMS


FAMILY = Family(
    ("rls", "sift"),
    lambda p: RLSState(
        theta=leaf(p),
        factor=leaf(p, p, legal=TRIANGLE),
        surge=leaf(),
        noise=leaf(legal=POSITIVE),
        deviation=leaf(legal=NOT_NEGATIVE),
    ),
    Number,
    Choice,
    size=terms.parameters,
    work=lambda p: 8 * p,
    heading=terms.heading,
    frozen=("theta", "surge"),
)
AT, RLS = FAMILY.at, FAMILY.kinds.index("rls")
