"""Prediction intervals in torch: equation (1) of `state`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from usvlearn.estimators.ensemble.conformal.state import BOOST, FEW, LEAST, RATE, START, ConformalState


def conformal_start(batch: Sequence[int], k: int, like: Tensor) -> ConformalState:
    """The intervals before the first innovation, of k predictions."""
    return ConformalState(like.new_full((*batch, k), START), like.new_zeros((*batch, k)))


def published(state: ConformalState) -> Tensor:
    """The half-widths that are published, m/s, `(*batch, k)`: infinite before FEW innovations.

    >>> published(conformal_start((), 2, torch.zeros(())))
    tensor([inf, inf])
    """
    return torch.where(state.count < FEW, torch.inf, state.halfwidth)


def conformal_numbers(coverage: float) -> dict[str, float]:
    """The numbers of `conformal_step`, for its kernel.

    >>> conformal_numbers(0.9)["coverage"]
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
