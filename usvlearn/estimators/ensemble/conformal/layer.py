"""Prediction intervals in torch: equation (1) of `state`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from usvlearn.estimators.ensemble.conformal.state import BOOST, FEW, LEAST, NONE, RATE, START, ConformalState
from usvlearn.estimators.ensemble.manoeuvre_intervals import layer as conditional
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import PATH, StepState


def conformal_start(batch: Sequence[int], k: int, like: Tensor, knows: bool = False) -> ConformalState:
    """The intervals before the first innovation, of k predictions; `knows`: whether they depend on the manoeuvre."""
    widths = StepState(conditional.init(batch, k, like), like.new_zeros((*batch, PATH))) if knows else NONE
    return ConformalState(like.new_full((*batch, k), START), like.new_zeros((*batch, k)), widths)


def published(state: ConformalState) -> Tensor:
    """The half-widths that do not depend on the manoeuvre, m/s, `(*batch, k)`: infinite before FEW innovations."""
    return torch.where(state.count < FEW, torch.inf, state.halfwidth)


def conformal_step(state: ConformalState, innovation: Tensor, coverage: float) -> ConformalState:
    """The intervals after innovations, m/s, `(*batch, k)`: equation (1). A column that is not finite stays."""
    known = innovation.isfinite()
    count = state.count + known
    miss = (innovation.abs() > state.halfwidth).to(state.halfwidth.dtype)
    rate = RATE + BOOST / count.clamp(min=1)
    halfwidth = (state.halfwidth * (rate * (miss - (1 - coverage))).exp()).clamp(min=LEAST)
    return state._replace(halfwidth=torch.where(known, halfwidth, state.halfwidth), count=count)
