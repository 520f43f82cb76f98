"""Equations (1) and (3) of `state` in torch, and the weights with which a network begins."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from usvlearn.estimators.vector_rnn.state import Kept, NetworkWeights


def network(weights: NetworkWeights, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """x⁺ of (1), `(*batch, q)`, and z, `(*batch, n)`.

    >>> one, eye = torch.ones(2), torch.eye(2)
    >>> network(NetworkWeights(eye, eye, eye, torch.zeros(2, 1), one), torch.tensor([0.25, -2.0]), one[:1])[0]
    tensor([ 1.5000, -2.0000])
    """
    R, A, W, W2, b = weights
    z = _times(W, x) + _times(W2, u) + b
    return _times(R, x) + _times(A, z.relu()), z


def _times(X: Tensor, y: Tensor) -> Tensor:
    return (X @ y[..., None])[..., 0]


def gradient(weights: NetworkWeights, windows: Kept) -> Tensor:
    """(3), the mean over B windows, `(*batch, parameters)` in the order R, A, W, W2, b.

    Args:
        weights: `(*batch, …)`.
        windows: leaves `(*batch, B, H, …)`, in the order of time; `learned` and `turn` are not used.
    """
    R, A, W, W2, b = weights
    count, steps = windows.successive.shape[-2:]

    def by_time(rows: Tensor) -> list[Tensor]:  # H times (*batch, q or m, B): each window is a column
        return list(rows.movedim(-2, 0).mT.unbind(0))

    successive = list(windows.successive[..., None, :, :].unbind(-1))  # H times (*batch, 1, B)
    departs, u = by_time(windows.before), by_time(windows.inputs)
    states, hidden, reached = [], [], []
    x = departs[0]
    for k in range(steps):
        x = departs[k] if k == 0 else torch.where(successive[k] > 0, x, departs[k])
        z = W @ x + (W2 @ u[k] + b[..., None])
        h = z.relu()
        states.append(x)
        hidden.append(h)
        x = R @ x + A @ h
        reached.append(x)
    error = (torch.stack(reached) - torch.stack(by_time(windows.target))) * torch.stack(by_time(windows.weight))
    errors = (error / (steps * count)).unbind(0)
    lambdas, zetas = [errors[-1]], []
    for k in reversed(range(steps)):
        zeta = (A.mT @ lambdas[-1]) * (hidden[k] > 0)
        zetas.append(zeta)
        if k > 0:
            lambdas.append(errors[k - 1] + (R.mT @ lambdas[-1] + W.mT @ zeta) * successive[k])
    lam, zeta = torch.cat(lambdas[::-1], -1), torch.cat(zetas[::-1], -1)  # (*batch, q or n, H B)
    after, before = torch.cat(hidden, -1).mT, torch.cat(states, -1).mT
    parts = lam @ before, lam @ after, zeta @ before, zeta @ torch.cat(u, -1).mT, zeta.sum(-1, keepdim=True)
    return torch.cat([part.flatten(-2) for part in parts], -1)


def initial_weights(q: int, m: int, n: int, ratio: Tensor, generator: torch.Generator) -> NetworkWeights:
    """R = I, A = 0, and neurons whose kinks lie where |x_i| ≤ 1 and |u_j| ≤ 1; the first 2m are relu(±u_j)."""

    def uniform(*shape: int) -> Tensor:
        return 2 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1

    W, W2 = ratio[2] * uniform(n, q) / math.sqrt(q + m), ratio[3] * uniform(n, m) / math.sqrt(q + m)
    b = -((W * uniform(n, q)).sum(-1) + (W2 * uniform(n, m)).sum(-1))
    unit = torch.eye(m, dtype=torch.float64)
    W[: 2 * m], W2[: 2 * m], b[: 2 * m] = 0.0, torch.cat([unit, -unit]), 0.0
    return NetworkWeights(torch.eye(q, dtype=torch.float64), torch.zeros(q, n, dtype=torch.float64), W, W2, b)
