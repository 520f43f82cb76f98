"""The covariance P = U D Uᵀ in torch: equations (1) to (3) of the package, for all columns at once.

U is unit upper triangular, `(*batch, n, n)`, and D the diagonal, `(*batch, n)`.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad


def unpacked(factor: Tensor) -> tuple[Tensor, Tensor]:
    """U and D from the leaf `factor`, `(*batch, n, n)`."""
    return unit(factor.mT), factor.diagonal(dim1=-2, dim2=-1)


def packed(U: Tensor, D: Tensor) -> Tensor:
    """The leaf `factor`, `(*batch, n, n)`."""
    return U.triu(1).mT + torch.diag_embed(D)


def unit(U: Tensor) -> Tensor:
    """What is above the diagonal, and 1 on it."""
    return U.triu(1) + torch.eye(U.shape[-1], dtype=U.dtype, device=U.device)


def variances(U: Tensor, D: Tensor) -> Tensor:
    """The diagonal of P, `(*batch, n)`."""
    return (U * U * D[..., None, :]).sum(-1)


def rotated(U: Tensor, H: Tensor) -> Tensor:
    """f = UᵀH, `(*batch, n)`."""
    return (U * H[..., None]).sum(-2)


def added(U: Tensor, D: Tensor, a: Tensor, c: Tensor) -> tuple[Tensor, Tensor]:
    """P + c a aᵀ, (1), with its sums in closed form.

    Args:
        U, D: of P.
        a: `(*batch, n)` or `(n,)`.
        c: `(*batch,)`, 0 or more.
    """
    a = a.expand(D.shape)
    v = torch.linalg.solve_triangular(U, a[..., None], upper=True, unitriangular=True).squeeze(-1)
    beyond = pad((v * v / D).flip(-1).cumsum(-1)[..., :-1], (1, 0)).flip(-1)  # sums over the columns after each
    left = c[..., None] / (1 + c[..., None] * beyond)
    larger = D + left * v * v
    rest = a[..., None] - pad((U * v[..., None, :]).flip(-1).cumsum(-1)[..., :-1], (1, 0)).flip(-1)
    return unit(U * (D / larger)[..., None, :] + rest * (left * v / larger)[..., None, :]), larger


def measured(U: Tensor, D: Tensor, f: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The measurement update (2): U and D after it, P H before it, `(*batch, n)`, and S, `(*batch,)`.

    Args:
        U, D: of P.
        f: UᵀH, `(*batch, n)`.
        alpha: the variance of the measurement, `(*batch,)`.
    """
    G = D * f
    after = alpha[..., None] + (f * G).cumsum(-1)
    before = torch.cat([alpha[..., None], after[..., :-1]], -1)
    sums = (U * G[..., None, :]).cumsum(-1)
    U = unit(U - pad(sums[..., :-1], (1, 0)) * (f / before)[..., None, :])
    return U, D * before / after, sums[..., -1], after[..., -1]


def projected(x: Tensor, U: Tensor, D: Tensor, d: Tensor) -> Tensor:
    """x after (3) where dᵀx > 0, `(*batch, n)`; the d of shape `(n,)`."""
    value, f = (x * d).sum(-1), rotated(U, d)
    G = D * f
    step = torch.where(value > 0, value / (f * G).sum(-1), 0.0)
    return x - step[..., None] * (U * G[..., None, :]).sum(-1)
