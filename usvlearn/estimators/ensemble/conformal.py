"""Prediction intervals that adapt until they cover what they promise.

The half-width q of the interval ŷ ± q is a quantile of |y − ŷ|, tracked by stochastic approximation of its logarithm,
as adaptive conformal inference does (Gibbs & Candès 2021; Angelopoulos, Candès & Tibshirani 2023). With the miscoverage
α and miss = 1 where |y − ŷ| > q:

    log q ← log q + (η + η₀/k) (miss − α)                                                  (1)

Nothing is assumed about the errors: summed up, (1) says |misses/K − α| ≤ |log(q_K/q_0)|/(η K) where η₀ = 0 and q has
not met its least value. The second term finds the scale during the first samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

RATE, BOOST = 0.2, 1.0  # η, η₀
START = 0.05  # m/s, q before the first innovation
LEAST = 5e-3  # m/s; a boat that lies still is predicted exactly for hours, and q has to find back: ten misses


class ConformalState(NamedTuple):
    """The intervals of the next predictions."""

    halfwidth: Tensor  # (*batch, k) q, m/s
    count: Tensor  # (*batch, k) innovations seen


def conformal_start(batch: Sequence[int], k: int, like: Tensor) -> ConformalState:
    """The intervals before the first innovation, of k predictions."""
    return ConformalState(like.new_full((*batch, k), START), like.new_zeros((*batch, k)))


def conformal_kernel(coverage: float) -> dict[str, float]:
    """The numbers of `conformal_step`, for the compiled kernels.

    >>> conformal_kernel(0.9)["coverage"]
    0.9
    """
    return {"coverage": coverage, "rate": RATE, "boost": BOOST, "least": LEAST}


def conformal_step(state: ConformalState, innovation: Tensor, coverage: float) -> ConformalState:
    """The intervals after innovations, m/s, `(*batch, k)`: equation (1). A column that is not finite stays.

    >>> state = conformal_start((), 2, torch.zeros(()))
    >>> conformal_step(state, torch.tensor([0.01, 1.0]), coverage=0.9).halfwidth  # narrower, wider
    tensor([0.0443, 0.1472])
    """
    known = innovation.isfinite()
    count = state.count + known
    miss = (innovation.abs() > state.halfwidth).to(state.halfwidth.dtype)
    rate = RATE + BOOST / count.clamp(min=1)
    halfwidth = (state.halfwidth * (rate * (miss - (1 - coverage))).exp()).clamp(min=LEAST)
    return ConformalState(torch.where(known, halfwidth, state.halfwidth), count)
