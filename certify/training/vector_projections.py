"""Nearest weights of a network with a vector state that satisfy a condition at a rate κ, with W fixed.

    x⁺ = R x + A relu(W x + W₂ u + b)

`exact`: the rate over all activation patterns in the norm ‖T x‖_∞, (2) of `certify.proofs.vector_exact`. With T A, T R
T⁻¹ and W T⁻¹ in place of A, R and W, each row ρ, α of (R, A) has to satisfy, for all ε ∈ {±1}^q with c_ε = W ε,

    ρ·ε + Σ_i (α_i c_εi)₊ ≤ κ.                                                                           (1)

These are 2^q convex constraints on (ρ, α), and the rows do not interact. With multipliers θ_ε ≥ 0 the nearest point is

    ρ ← ρ − Σ_ε θ_ε ε,   α_i ← sgn(α_i) (|α_i| − Σ_ε θ_ε d_εi)₊,   d_εi = (sgn(α_i) c_εi)₊                   (2)

No sign of α changes. Given all other multipliers, with what they leave of ρ and of the sizes |α_i|, p and a_i,

    θ_ε = max_k (p·ε + Σ_{i≤k} d_εi a_i − κ) / (q + Σ_{i≤k} d_εi²),   θ_ε ≥ 0,   k = 0 … n,                  (3)

in descending order of a_i/d_εi. This maximises the dual problem along one coordinate. Each round does so for the
constraint of a row whose multiplier is furthest from its optimum, and the rounds converge to the nearest point.

`gershgorin`: the paper's lemma for a vector state, of an elliptic norm that it does not name. Each neuron with
‖W_i‖₁ > ½ is first rescaled to ½, which changes no output. With that the sums of the lemma are smallest in total. Then
each r is one constraint on the sizes of all entries, and the nearest R and A follow by (2) and (3) without ρ:

    Σ_k (|R_rk| + |R_kr|) + Σ_i |A_ri| + Σ_i |W_ir|/(1 − ‖W_i‖₁) Σ_s |A_si| ≤ 2 κ.                         (4)

Both conditions are 1-homogeneous in (R, A). So the factor min(1, κ/rate), applied last, row by row for `exact`, makes
the result hold after any number of rounds. The rate that it uses is increased by a bound of all rounding errors. If
every network of a sequence satisfies `exact` at κ with the same T, then ‖T (x_k − x'_k)‖_∞ ≤ κᵏ ‖T (x₀ − x'₀)‖_∞ for
equal inputs and the same sequence.

All functions are batched and differentiable almost everywhere.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from certify.errors import CertifyError
from certify.networks.vector import VectorWeights
from certify.training.vector_rates import signs

CONDITIONS = ("exact", "gershgorin")
ROUNDS = 6  # multipliers that are improved for each row


def project(
    weights: VectorWeights,
    rate: Tensor | float = 0.999,
    scaling: Tensor | None = None,
    condition: str = "exact",
    rounds: int = ROUNDS,
) -> VectorWeights:
    """The weights with the nearest R and A, and unchanged W, that satisfy a condition at a rate.

    Args:
        weights: `(*batch, …)`, one hidden layer, relu.
        rate: κ, `(*batch,)` or a number, in (0, 1].
        scaling: the diagonal of T, `(q,)`, positive; ones by default. Distances are those of T R T⁻¹ and T A. The
            condition `gershgorin` has no scaling.
        condition: `exact`, in the norm ‖T x‖_∞; or `gershgorin`, in an elliptic norm.
        rounds: number of rounds of (3). More of them come nearer; the rate holds after any number.

    Returns:
        The projected weights, `(*batch, …)`.

    Raises:
        CertifyError: an unknown condition, a rate outside (0, 1], two hidden layers, or a scaling that is not positive.

    >>> one, eye = torch.ones(2, 1).double(), torch.eye(2).double()
    >>> near = project(VectorWeights(eye, eye / 2, eye, one, one[:, 0]), rate=0.75, rounds=30)
    >>> [round(float(x), 3) for x in (near.R[0, 0], near.A[0, 0])]
    [0.625, 0.125]
    """
    _check(weights, rate, scaling, condition)
    if condition == "gershgorin":
        return _by_lemma(weights, rate, rounds)
    R, A, W = weights.R, weights.A, weights.W
    if scaling is not None:
        t = scaling.to(A)
        R, A, W = t[:, None] * R / t, t[:, None] * A, W / t
    kappa = _inner(rate, A)[..., None]  # (*batch, 1), for all rows
    near = _nearest(R, A, W, kappa, rounds)
    kept = torch.cat(near, -1).isfinite().all(-1, keepdim=True)  # an overflow: the factor below alone will do
    R, A = torch.where(kept, near[0], R), torch.where(kept, near[1], A)
    found = _row_rates_above(R, A, W)
    factor = (kappa / found.maximum(kappa))[..., None]
    R, A = R * factor, A * factor
    if scaling is not None:
        R, A = R * t / t[:, None], A / t[:, None]
    return weights._replace(R=R, A=A)


def _check(weights: VectorWeights, rate: Tensor | float, scaling: Tensor | None, condition: str) -> None:
    if condition not in CONDITIONS:
        raise CertifyError(f"condition: found {condition!r}, expected one of {', '.join(CONDITIONS)}")
    if not isinstance(rate, Tensor) and not 0 < rate <= 1:
        raise CertifyError(f"rate: found {rate!r}, expected a number in (0, 1]")
    if weights.V is not None:
        raise CertifyError("weights: found two hidden layers, expected one: only such networks are projected")
    q = weights.W.shape[-1]
    if scaling is not None and (condition == "gershgorin" or scaling.shape != (q,)):
        expected = "no scaling for gershgorin" if condition == "gershgorin" else f"the shape ({q},), the diagonal of T"
        raise CertifyError(f"scaling: found the shape {tuple(scaling.shape)}, expected {expected}")


def _rounding(like: Tensor) -> float:
    """More than the relative error of any sum below of products of three factors."""
    return 4 * (sum(like.shape[-2:]) + 8) * torch.finfo(like.dtype).eps


def _inner(rate: Tensor | float, like: Tensor) -> Tensor:
    """κ as a number of this type, not above the given one, `(*batch,)`."""
    rate = rate.to(like) if isinstance(rate, Tensor) else like.new_full((), rate)
    return (rate * (1 - 8 * torch.finfo(like.dtype).eps)).expand(like.shape[:-2])


def _row_rates_above(R: Tensor, A: Tensor, W: Tensor) -> Tensor:
    """For each row the largest sum (1), increased by what rounding can hide, `(*batch, q)`."""
    eps = signs(W.shape[-1], W)
    moved = (A[..., :, None, :] * (W @ eps.mT).mT[..., None, :, :]).relu().sum(-1)  # (*batch, q, 2^q)
    size = R.abs().sum(-1) + (A.abs() * W.abs().sum(-1)[..., None, :]).sum(-1)
    return (R @ eps.mT + moved).amax(-1) + _rounding(A) * size


def _nearest(R: Tensor, A: Tensor, W: Tensor, kappa: Tensor, rounds: int) -> tuple[Tensor, Tensor]:
    """(2) after some rounds of (3). Rows are `(*batch, q, …)`, constraints come before the last axis."""
    eps, sign = signs(W.shape[-1], W), A.sign()
    d = (sign[..., :, None, :] * (W @ eps.mT).mT[..., None, :, :]).relu()  # (*batch, q, 2^q, n)
    theta = _multipliers(R, A.abs(), eps, d, kappa[..., None], rounds)
    return R - theta @ eps, sign * _left(A.abs(), theta, d).relu()


def _left(size: Tensor, theta: Tensor, d: Tensor) -> Tensor:
    """|α_i| − Σ θ_ε d_εi, `(…, n)`."""
    return size - (theta[..., None, :] @ d)[..., 0, :]


def _multipliers(rho: Tensor, size: Tensor, eps: Tensor, d: Tensor, target: Tensor, rounds: int) -> Tensor:
    """θ of (2), `(…, c)`, for c constraints on ρ `(…, k)` and on sizes `(…, n)`, which are κ `(…, 1)` at most.

    Args:
        eps: the coefficients of ρ, `(c, k)`, ±1.
        d: those of the sizes, `(…, c, n)`, of 0 or more.
    """
    theta = d.new_zeros(d.shape[:-1])
    for _ in range(rounds):
        p, left = rho - theta @ eps, _left(size, theta, d)
        excess = p @ eps.mT + (d @ left.relu()[..., None])[..., 0] - target  # the dual's slope
        away = torch.where(theta > 0, excess.abs(), excess)
        place = away.detach().argmax(-1, keepdim=True)  # (…, 1)
        own, c = theta.gather(-1, place), eps[place[..., 0]]
        row = d.take_along_dim(place[..., None], -2)[..., 0, :]
        offset = ((p + own * c) * c).sum(-1, keepdim=True) - target
        theta = theta.scatter(-1, place, _threshold(left + own * row, row, offset, eps.shape[-1]))
    return theta


def _threshold(size: Tensor, cost: Tensor, offset: Tensor, q: int) -> Tensor:
    """(3), `(…, 1)`: sizes, of which those below zero count as zero, and costs `(…, n)`; p·ε − κ `(…, 1)`."""
    floor = torch.finfo(size.dtype).tiny ** 0.5
    size = size.relu()
    ratio, order = torch.where(cost > 0, size / cost.clamp(min=floor), 0.0).sort(-1, descending=True)
    size, cost = size.gather(-1, order), cost.gather(-1, order) * (ratio > 0)
    sums, squares = (size * cost).cumsum(-1), (cost * cost).cumsum(-1)
    quotients = torch.cat([offset, offset + sums], -1) / (q + pad(squares, (1, 0))).clamp(min=floor)
    return quotients.amax(-1, keepdim=True).clamp(min=0)


def _by_lemma(weights: VectorWeights, rate: Tensor | float, rounds: int) -> VectorWeights:
    R, A, W, W2, b, *_ = weights
    q, n = A.shape[-2:]
    c = 0.5 / W.abs().sum(-1).clamp(min=0.5)  # (*batch, n); 1 where nothing is rescaled
    A, W, W2, b = A / c[..., None, :], W * c[..., None], W2 * c[..., None], b * c
    kappa, room = _inner(rate, A), 1 - W.abs().sum(-1)
    eye = torch.eye(q, dtype=A.dtype, device=A.device)
    of_R = (eye[:, :, None] + eye[:, None, :]).expand(*A.shape[:-2], q, q, q)  # (*batch, r, k, l)
    of_A = eye[..., None] + (W.mT.abs() / room[..., None, :])[..., None, :]  # (*batch, r, s, i)
    d = torch.cat([of_R.flatten(-2), of_A.flatten(-2)], -1)  # (*batch, q, q² + qn)
    both = torch.cat([R.flatten(-2), A.flatten(-2)], -1)
    theta = _multipliers(both[..., :0], both.abs(), d.new_zeros(q, 0), d, 2 * kappa[..., None], rounds)
    near = both.sign() * _left(both.abs(), theta, d).relu()
    near = torch.where(near.isfinite().all(-1, keepdim=True), near, both)
    half = (d @ near.abs()[..., None])[..., 0].amax(-1) / 2
    near = near * (kappa / (half * (1 + _rounding(A))).maximum(kappa))[..., None]
    R, A = near[..., : q * q].unflatten(-1, (q, q)), near[..., q * q :].unflatten(-1, (q, n))
    return VectorWeights(R, A, W, W2, b)
