"""Adaptive identification (AID) of the surge dynamics.

Equations (1) to (6), their Lyapunov functions and sources: `docs/theory/estimators.md#aid`. The mass only scales the
parameters. Surge data cannot identify it; `usvlearn.estimators.mass` recovers it from known quantities.
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
    LEAK = POSITIVE, 1.0  # of the feedback "estimate"
    DEAD_ZONE = NOT_NEGATIVE, 0.0
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
