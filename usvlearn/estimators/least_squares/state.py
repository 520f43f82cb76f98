"""Recursive least squares, for any model that is linear in its parameters.

Equations (1) to (3) and their sources: `docs/theory/estimators.md#rls`. In the code S is the Cholesky factor of the
covariance, P = S Sᵀ, lower triangular, and T the factor of its update.
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
    """Numbers of both kinds; by default a number that a kind does not use forgets nothing."""

    SCALE = MODEST  # the mass, or 1
    SURGE_MAX = POSITIVE
    PRIOR = POSITIVE  # the trace of P₀
    LOOSEST = NOT_NEGATIVE, LOOSEST
    NOISE_SHARE = UNIT, NOISE_SHARE
    NOISE_LEAST = POSITIVE, NOISE_LEAST**2  # m²/s²
    FORGETTING = FACTOR, 1.0  # of "rls"
    TRACE_MAX = NOT_NEGATIVE, 0.0  # of "rls"
    MEMORY = POSITIVE, 1.0  # s, of "sift"
    LONGEST = Range(0.0, 80.0), 0.0  # of "sift": the exponent of 1/λ
    FLOOR = NOT_NEGATIVE, 0.0  # of "sift"


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
