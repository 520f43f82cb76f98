"""The closed forms of `vector_exact` in torch, for learning: batched, differentiable almost everywhere."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from certify.networks.vector import VectorWeights


def signs(q: int, like: Tensor) -> Tensor:
    """All ε ∈ {±1}^q, `(2^q, q)`."""
    return like.new_tensor(list(itertools.product((-1.0, 1.0), repeat=q)))


def scaled(weights: VectorWeights, scaling: Tensor | None) -> VectorWeights:
    """T R T⁻¹, T A and W T⁻¹ in place of R, A and W; the state is then T x. T is `(q, q)`."""
    if scaling is None:
        return weights
    back = torch.linalg.inv(scaling)
    return weights._replace(R=scaling @ weights.R @ back, A=scaling @ weights.A, W=weights.W @ back)


def row_rates(weights: VectorWeights, leak: float = 0.0) -> Tensor:
    """For each row of J, its largest sum of absolute values over all patterns, `(*batch, q)`; one hidden layer."""
    R, A, W = weights.R, weights.A, weights.W
    eps = signs(W.shape[-1], W)
    moved = A[..., :, None, :] * (W @ eps.mT).mT[..., None, :, :]  # (*batch, q, 2^q, n)
    return ((R @ eps.mT) + moved.maximum(leak * moved).sum(-1)).amax(-1)


def rate(weights: VectorWeights, scaling: Tensor | None = None, leak: float = 0.0) -> Tensor:
    """K_∞, the exact rate in the norm ‖T x‖_∞ over all activation patterns.

    Args:
        weights: `(*batch, …)`, one hidden layer; b and W₂ are not used.
        scaling: T, `(q, q)`; the identity by default.
        leak: slope of φ for negative arguments, no unit.

    Returns:
        K_∞, `(*batch,)`.

    >>> one = torch.ones(1)
    >>> rate(VectorWeights(torch.zeros(1, 1), torch.tensor([[0.5, -1.0]]), torch.tensor([[1.0], [0.75]]), one, one))
    tensor(0.7500)
    """
    return row_rates(scaled(weights, scaling), leak).amax(-1)
