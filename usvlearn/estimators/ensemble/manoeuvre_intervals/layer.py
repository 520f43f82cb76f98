"""The first state of interval widths as a function of the manoeuvre."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from usvlearn.estimators.ensemble.manoeuvre_intervals import state as at
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import HorizonState, LearnedState


def init(batch: Sequence[int], k: int, like: Tensor) -> LearnedState:
    """What is known of k half-widths before the first error."""
    shape = (*batch, k)
    first = torch.eye(at.FEATURES, dtype=like.dtype, device=like.device)[0]
    ridge = torch.diag(at.RIDGE + (at.PRIOR - at.RIDGE) * first)
    return LearnedState(
        coefficients=first.expand(*shape, at.FEATURES).clone(),
        gram=ridge.expand(*shape, at.FEATURES, at.FEATURES).clone(),
        moments=(at.PRIOR * first).expand(*shape, at.FEATURES).clone(),
        level=like.new_zeros(shape),
        factors=like.new_full((*shape, at.GROUPS), at.FIRST),
        scores=like.new_zeros((*shape, 2)),
    )


def init_horizons(batch: Sequence[int], slots: int, k: int, like: Tensor) -> HorizonState:
    """Of forecasts over k horizons, before the first sample."""
    learned, share = init(batch, k, like), 1 / (1 + like.new_tensor(at.DOUBT).exp())
    held = [0.0] * at.FEATURES, [at.LEAST], [at.FIRST] * at.GROUPS
    return HorizonState(
        learned=learned,
        path=like.new_zeros((*batch, at.PATH)),
        paths=like.new_zeros((*batch, slots, at.PATH)),
        held=torch.cat([*map(like.new_tensor, held), share[None]]).expand(*batch, slots, k, at.HELD).clone(),
        due=like.new_full((*batch, k, at.DUE), math.nan),
    )
