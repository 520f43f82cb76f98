"""Combiners that combine the predictions of an ensemble's members, x_k, into one, ŷ = Σ w_k x_k.

A member whose prediction is NaN is inactive: the others share its weight, and its loss is that of their weighted mean.
Where all are inactive, the prediction is NaN, and nothing is learned from the step. Equations (1) to (4) of BOA, and
what differs from the published rule: `docs/theory/ensemble.md#combiners`.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING, Any, NamedTuple

from usvlearn.core.family import (
    FACTOR,
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    POSITIVE_OR_INFINITE,
    TRIANGLE,
    UNIT,
    WEIGHT,
    Family,
    Options,
    Parameters,
    ParameterVectors,
    leaf,
)

if TYPE_CHECKING:
    from torch import Tensor

TINY = 1e-12  # added to each weight, so that members that are active share it where all their weights are 0
LOSSES = ("absolute", "square")


class NoState(NamedTuple):
    """A combiner that learns nothing."""


class WeightsState(NamedTuple):
    """The state of `RecursiveWeights`."""

    weights: Tensor  # (*batch, members)
    factor: Tensor  # (*batch, members, members) Cholesky factor of their covariance


class ExponentialState(NamedTuple):
    """The state of `ExponentialWeights`."""

    weights: Tensor  # (*batch, members)
    losses: Tensor  # (*batch, members) sum of the losses that are not forgotten


class BOAState(NamedTuple):
    """The state of `BOA`; all leaves are `(*batch, members)`."""

    weights: Tensor
    losses: Tensor  # L of (2), in units of the loss
    squares: Tensor  # V of (3)
    ranges: Tensor  # E of (1)


class Plain(Parameters):
    """The number that every combiner has."""

    TINY = POSITIVE, TINY


class Recursive(Parameters):
    """Numbers of `RecursiveWeights`."""

    TINY = POSITIVE, TINY
    FORGETTING = FACTOR
    TRACE_MAX = POSITIVE
    SURGE_MAX = POSITIVE


class Exponential(Parameters):
    """Numbers of `ExponentialWeights`."""

    TINY = POSITIVE, TINY
    MEMORY = POSITIVE_OR_INFINITE, inf  # s
    RATE = POSITIVE


class Bernstein(Parameters):
    """Numbers of `BOA`."""

    TINY = POSITIVE, TINY
    MEMORY = POSITIVE_OR_INFINITE, inf  # s
    SCALE = POSITIVE  # E₀
    SHARE = UNIT


class Given(ParameterVectors):
    """The weights of `FixedWeights`."""

    WEIGHTS = FINITE


class Prior(ParameterVectors):
    """The weights from which `ExponentialWeights` starts."""

    PRIOR = FACTOR


class Priors(ParameterVectors):
    """The weights from which `BOA` starts, and c = log(1/w0) of (3)."""

    PRIOR = FACTOR
    COSTS = POSITIVE


class Loss(Options):
    """The loss of a prediction."""

    LOSS = LOSSES


def _weights(m: int) -> Any:
    return leaf(m, legal=WEIGHT)


AVERAGE = Family(("average",), lambda m: NoState(), Plain)
FIXED = Family(("fixed",), lambda m: NoState(), Plain, vectors=Given)
RECURSIVE = Family(
    ("recursive",),
    lambda m: WeightsState(weights=leaf(m), factor=leaf(m, m, legal=TRIANGLE)),
    Recursive,
    work=lambda m: 3 * m,
)
EXPONENTIAL = Family(
    ("exponential",),
    lambda m: ExponentialState(weights=_weights(m), losses=leaf(m, legal=NOT_NEGATIVE)),
    Exponential, Loss, Prior, work=lambda m: m,
)  # fmt: skip
BOA = Family(
    ("boa",),
    lambda m: BOAState(
        weights=_weights(m), losses=leaf(m), squares=leaf(m, legal=NOT_NEGATIVE), ranges=leaf(m, legal=POSITIVE)
    ),
    Bernstein, Loss, Priors, work=lambda m: 2 * m,
)  # fmt: skip
RULES: dict[str, Family[Any]] = {
    each.kinds[0]: each for each in (AVERAGE, FIXED, RECURSIVE, EXPONENTIAL, BOA)
}  # the size counts members
