"""Closed-form conditions for x⁺ = aᵀ relu(w₁ x + W₂ u + b), x scalar, to contract, from (a, w₁) alone.

With s_i = a_i w_{1i}, P = Σ max(s_i, 0) and N = Σ max(−s_i, 0), the slope of x ↦ x⁺ lies in [−N, P]: K = max(P, N) is
the exact rate over all activation patterns. A margin is positive exactly where its condition holds.
"""

from __future__ import annotations

from torch import Tensor


def rate(a: Tensor, w1: Tensor) -> Tensor:
    """K = max(P, N), the contraction rate over all activation patterns, `(*batch,)`; a, w₁ are `(*batch, n)`.

    >>> import torch
    >>> rate(torch.tensor([0.5, -1.0]), torch.tensor([1.0, 0.9]))
    tensor(0.9000)
    """
    s = a * w1
    return s.clamp(min=0).sum(-1).maximum((-s).clamp(min=0).sum(-1))


def simple_margin(a: Tensor, w1: Tensor) -> Tensor:
    """1 − max_i ((n+1)|a_i| + |w_{1i}|), `(*batch,)`: the paper's theorem with p = 1, λ = 1/(n+1).

    >>> import torch
    >>> simple_margin(torch.tensor([0.25]), torch.tensor([0.25]))
    tensor(0.2500)
    """
    return 1 - ((a.shape[-1] + 1) * a.abs() + w1.abs()).amax(-1)


def tight_margin(a: Tensor, w1: Tensor) -> Tensor:
    """1 − K, `(*batch,)`: the slope-restricted LMI (2Λ in the corner block), which equals all activation patterns.

    >>> import torch
    >>> tight_margin(torch.tensor([0.5]), torch.tensor([0.5]))
    tensor(0.7500)
    """
    return 1 - rate(a, w1)
