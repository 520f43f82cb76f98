"""The first state of the joint EKF and of the axis EKF."""

from __future__ import annotations

import torch
from torch import Tensor

from usvlearn.estimators.augmented_ekf import state as at
from usvlearn.estimators.augmented_ekf.state import FilterState


def initial(first: Tensor, prior: Tensor, variance: Tensor) -> FilterState:
    """The leaves before the first step, from variances of what stands before the parameters in x, `(*batch, n − m)`.

    `prior`, `variance`: of the parameters, `(*batch, m)` or what broadcasts.
    """
    batch, zero = first.shape[:-1], torch.zeros_like(first[..., 0])
    wide = (*batch, prior.shape[-1])
    return FilterState(
        mean=torch.cat([torch.zeros_like(first), prior.expand(wide)], -1),
        factor=torch.diag_embed(torch.cat([first, variance.expand(wide)], -1)),
        noise=zero + at.NOISE**2,
        updates=zero,
        surge=zero,
        started=zero > 0,
        commands=torch.stack([zero, zero], -1),
        turn=zero,
        deviation=zero,
    )
