"""Nearest weights that satisfy a condition of `certify.training.conditions` at a rate κ.

With w₁ fixed each condition is a polytope in a. For `lmi` and `exact`, whose two sign classes of s_i = a_i w_{1i} do
not interact, and for `gershgorin`, it is a weighted ℓ₁ ball Σ c_i |a_i| ≤ r, onto which the projection is

    a_i ← sgn(a_i) (|a_i| − θ c_i)₊,   θ = max_k (Σ_{i≤k} c_i |a_i| − r) / Σ_{i≤k} c_i²,  θ ≥ 0,            (1)

in descending order of |a_i|/c_i. On a box the neurons that are always on couple the two classes by one scalar δ, the
difference of their thresholds:

    a_i ← a_i − δ w_{1i} (always on),   δ = θ₊(κ − S_on + δ W_on) − θ₋(κ + S_on − δ W_on)                     (2)

with S_on = Σ s_i and W_on = Σ w_{1i}² over them. Every rate is 1-homogeneous in a. So a ← a min(1, κ/rate), applied
last, removes what rounding leaves. If every network of a sequence satisfies one at κ, |x_k − x'_k| ≤ κᵏ |x₀ − x'₀| for
equal inputs and the same sequence, however the weights change in between.

All functions are batched and differentiable almost everywhere.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights
from certify.training import conditions
from certify.training.conditions import extreme_slopes, fixed_signs

GAUGES = ("literal", "best")
Bounds = tuple[Tensor, Tensor]  # least and greatest x, u₁ … u_m, (1 + m,) each


def project(
    weights: ShallowWeights,
    condition: str = "exact",
    rate: Tensor | float = 0.999,
    gauge: str = "literal",
    bounds: Bounds | None = None,
) -> ShallowWeights:
    """The weights with the nearest a, and unchanged w₁, that satisfy a condition at a rate.

    The literal `simple` and `gershgorin` require |w_{1i}| < 1. A neuron that violates this is first rescaled to
    |w_{1i}| = ½, which changes no output of the network.

    Args:
        weights: `(*batch, …)`.
        condition: `simple`, `gershgorin`, `lmi`, `exact`, or `interval`.
        rate: κ, `(*batch,)` or a number, in (0, 1].
        gauge: "literal", or "best": of the equal networks (a_i/c_i, c_i w_{1i}, …), for `simple` and `gershgorin`.
        bounds: of the box, for `interval`.

    Returns:
        The projected weights, `(*batch, …)`.

    Raises:
        CertifyError: an unknown condition or gauge, a rate outside (0, 1], or `interval` without bounds.

    >>> wide = ShallowWeights(torch.tensor([3.0, 1.0]), torch.ones(2), torch.zeros(2, 1), torch.zeros(2))
    >>> project(wide, rate=0.5).a
    tensor([0.5000, 0.0000])
    """
    _check(condition, rate, gauge, bounds)
    weights = _within_gauge(weights, condition, gauge)
    a, w1 = weights.a, weights.w1
    kappa = _inner(rate, a)[..., None]
    size, w, n = a.abs(), w1.abs(), a.shape[-1]
    if condition == "simple":
        limit = (1 - w) / (n + 1) if gauge == "literal" else 0.25 / ((n + 1) * w.clamp(min=torch.finfo(w.dtype).tiny))
        nearest = a.sign() * size.minimum(kappa * limit)
    elif condition == "gershgorin":
        cost, radius = (1 / (1 - w), 2 * kappa) if gauge == "literal" else (w, kappa / 2)
        nearest = a.sign() * _shrink(size, cost, radius)
    elif condition == "interval" and bounds is not None:
        nearest = _nearest_on_box(weights, kappa[..., 0], *bounds)
    else:
        positive = a * w1 > 0
        classes = torch.stack([torch.where(positive, w, 0.0), torch.where(positive, 0.0, w)])
        nearest = a.sign() * _shrink(size[None], classes, kappa / _times(condition)).amin(0)
    return _scale(weights._replace(a=nearest), condition, rate, gauge, bounds)


def _times(condition: str) -> int:
    """The ratio of a condition's rate to K."""
    return {"lmi": 2, "exact": 1}[condition]


def _check(condition: str, rate: Tensor | float, gauge: str, bounds: Bounds | tuple[()] | None) -> None:
    known = (*conditions.CONDITIONS, "interval")
    if condition not in known:
        raise CertifyError(f"condition: found {condition!r}, expected one of {', '.join(known)}")
    if gauge not in GAUGES:
        raise CertifyError(f"gauge: found {gauge!r}, expected one of {', '.join(GAUGES)}")
    if not isinstance(rate, Tensor) and not 0 < rate <= 1:
        raise CertifyError(f"rate: found {rate!r}, expected a number in (0, 1]")
    if condition == "interval" and bounds is None:
        raise CertifyError("interval: found no bounds, expected those of the box on which it is to hold")


def _inner(rate: Tensor | float, a: Tensor) -> Tensor:
    """κ minus the most that rounding can add to a sum of n products, `(*batch,)`."""
    rate = rate.to(a) if isinstance(rate, Tensor) else a.new_full((), rate)
    return (rate * (1 - 8 * a.shape[-1] * torch.finfo(a.dtype).eps)).expand(a.shape[:-1])


def _within_gauge(weights: ShallowWeights, condition: str, gauge: str) -> ShallowWeights:
    if condition not in ("simple", "gershgorin") or gauge == "best":
        return weights
    w = weights.w1.abs()
    c = torch.where(w < 1, torch.ones_like(w), 0.5 / w.clamp(min=1))
    return ShallowWeights(weights.a / c, c * weights.w1, c[..., None] * weights.W2, c * weights.b)


def _scale(weights: ShallowWeights, condition: str, rate: Tensor | float, gauge: str, bounds: Bounds | None):
    a, w1 = weights.a, weights.w1
    kappa = _inner(rate, a)

    def factor(smallest: Tensor) -> Tensor:  # (*batch, 1), 1 where the rate is kept
        return (kappa / smallest.maximum(kappa))[..., None]

    if condition in ("lmi", "exact"):
        times = _times(condition)
        up, down = (factor(times * extreme) for extreme in extreme_slopes(a, w1))
        return weights._replace(a=a * torch.where(a * w1 > 0, up, down))
    if condition == "interval" and bounds is not None:
        rounding = 4 * a.shape[-1] * torch.finfo(a.dtype).eps  # neurons that are always on may cancel
        smallest = conditions.interval(weights, *bounds).rate + rounding * (a * w1).abs().sum(-1)
    else:
        rates: dict[str, Callable] = conditions.BEST_GAUGE if gauge == "best" else conditions.CONDITIONS
        smallest = rates[condition](a, w1).rate
    return weights._replace(a=a * factor(smallest))


class _Prefixes(NamedTuple):
    """Sums over the first k neurons in descending order of |a_i|/c_i, `(*batch, n)`."""

    sums: Tensor  # Σ c_i |a_i|
    squares: Tensor  # Σ c_i²
    ratios: Tensor  # |a_k|/c_k; 0 where c_k = 0


def _prefixes(size: Tensor, cost: Tensor) -> _Prefixes:
    floor = torch.finfo(size.dtype).tiny ** 0.5
    ratios = torch.where(cost > 0, size / cost.clamp(min=floor), 0.0)
    ratios, order = ratios.sort(-1, descending=True)
    size, cost = size.expand(order.shape).gather(-1, order), cost.gather(-1, order)
    return _Prefixes((size * cost).cumsum(-1), (cost * cost).cumsum(-1).clamp(min=floor), ratios)


def _threshold(prefixes: _Prefixes, radius: Tensor) -> tuple[Tensor, Tensor]:
    """θ of (1), `(*batch, 1)`, and −∂θ/∂r; radius is `(*batch, 1)`."""
    quotients = (prefixes.sums - radius) / prefixes.squares
    theta, k = quotients.max(-1, keepdim=True)
    steepness = 1 / prefixes.squares.expand_as(quotients).gather(-1, k)
    return theta.clamp(min=0), torch.where(theta > 0, steepness, 0.0)


def _shrink(size: Tensor, cost: Tensor, radius: Tensor) -> Tensor:
    """(1): the nearest sizes in the weighted ball; those with cost 0 are unchanged."""
    return (size - _threshold(_prefixes(size, cost), radius)[0] * cost).clamp(min=0)


def _nearest_on_box(weights: ShallowWeights, kappa: Tensor, lo: Tensor, hi: Tensor) -> Tensor:
    """(2): the nearest a."""
    a, w1 = weights.a, weights.w1
    always, never = fixed_signs(weights, lo, hi)
    free, s, kappa = ~(always | never), a * w1, kappa[..., None]
    on = torch.where(always, w1, 0.0)
    S, W = (on * a).sum(-1, keepdim=True), (on * on).sum(-1, keepdim=True)
    sides = [torch.where(free & side, w1.abs(), 0.0) for side in (s > 0, s < 0)]
    above, below = (_prefixes(a.abs(), side) for side in sides)
    safe = torch.where(W > 0, W, 1.0)
    least, most = (torch.where(W > 0, (S + edge) / safe, 0.0) for edge in (-kappa, kappa))
    with torch.no_grad():
        delta = _balance(above, below, kappa, S, W, least, most)
    (up, slope_up), (down, slope_down) = _thresholds(above, below, kappa, S, W, delta)
    delta = delta + (up - down - delta) / (1 + W * (slope_up + slope_down)).detach()  # carries its gradient
    delta = delta.maximum(least).minimum(most)  # at an end, where the free neurons of one class are all zero
    (up, _), (down, _) = _thresholds(above, below, kappa, S, W, delta)
    return a - delta * on - a.sign() * a.abs().minimum(up * sides[0] + down * sides[1])


def _thresholds(above: _Prefixes, below: _Prefixes, kappa: Tensor, S: Tensor, W: Tensor, delta: Tensor):
    radii = kappa - S + delta * W, kappa + S - delta * W  # 0 at the ends of δ, up to rounding
    return _threshold(above, radii[0].clamp(min=0)), _threshold(below, radii[1].clamp(min=0))


def _balance(above: _Prefixes, below: _Prefixes, kappa, S, W, least, most) -> Tensor:
    """δ of (2), `(*batch, 1)`: the root of θ₊ − θ₋ − δ, which falls and is linear between the places where a neuron
    becomes zero."""

    def radii(prefixes: _Prefixes) -> Tensor:  # at which a neuron becomes zero, and at which none moves
        sums, squares, ratios = prefixes
        return torch.cat([sums - ratios * squares, sums[..., -1:]], -1)

    safe = torch.where(W > 0, W, 1.0)
    places = torch.cat([(radii(above) - kappa + S) / safe, (kappa + S - radii(below)) / safe, least, most], -1)
    places = places.maximum(least).minimum(most)
    wider, deeper = (_Prefixes(*(x[..., None, :] for x in side)) for side in (above, below))
    (up, _), (down, _) = _thresholds(wider, deeper, kappa[..., None], S[..., None], W[..., None], places[..., None])
    excess = (up - down)[..., 0] - places
    low, high = (torch.where(excess >= 0, places, least), torch.where(excess <= 0, places, most))
    low, high = low.amax(-1, keepdim=True), high.amin(-1, keepdim=True)
    before = torch.where(excess >= 0, excess, torch.inf).amin(-1, keepdim=True)
    after = torch.where(excess <= 0, excess, -torch.inf).amax(-1, keepdim=True)
    share = torch.where(before > 0, before / (before - after), 0.0)  # NaN or 0 where the root is at an end
    return torch.where(before.isinf(), least, torch.where(after.isinf(), most, low + (high - low) * share))
