"""Nearest, and radially nearest, weights that hold a condition of `certify.conditions` at a rate κ.

With w₁ fixed each condition is a polytope in a. For `lmi` and `tight`, whose two sign classes of s_i = a_i w_{1i} are
apart, and for `gershgorin`, it is a weighted ℓ₁ ball Σ c_i |a_i| ≤ r, onto which the projection is

    a_i ← sgn(a_i) (|a_i| − θ c_i)₊,   θ = max_k (Σ_{i≤k} c_i |a_i| − r) / Σ_{i≤k} c_i²,  θ ≥ 0,            (1)

in descending order of |a_i|/c_i. On a box the neurons that are always on couple the two classes by one scalar δ, the
difference of their thresholds:

    a_i ← a_i − δ w_{1i} (always on),   δ = θ₊(κ − S_on + δ W_on) − θ₋(κ + S_on − δ W_on)                     (2)

with S_on = Σ s_i and W_on = Σ w_{1i}² over them. The nearest (a, w₁) together is, in one class, with h ≥ l the larger
and the smaller of |a_i|, |w_{1i}|,

    h + l ← (h + l)/(1 + θ),  h − l ← (h − l)/(1 − θ);  l ← 0 where it would be < 0;  Σ h l = r,  θ ∈ [0, 1]    (3)

the global minimum although the set is not convex, since the Lagrangian is convex for these θ. Every rate is
1-homogeneous in a: a ← a min(1, κ/rate), applied last, takes away what rounding leaves, and, alone, inside a forward
pass, parametrises exactly the networks that hold the condition. If every one of a sequence of networks holds one at κ,
|x_k − x'_k| ≤ κᵏ |x₀ − x'₀| for equal inputs and the same sequence, however the weights change in between.

All functions are batched and differentiable almost everywhere.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from certify import conditions
from certify.conditions import extreme_slopes, fixed_signs
from certify.errors import CertifyError
from certify.weights import ShallowWeights

GAUGES = ("literal", "best")
BISECTIONS = 80
Bounds = tuple[Tensor, Tensor]  # least and greatest x, u₁ … u_m, (1 + m,) each


def project(
    weights: ShallowWeights,
    condition: str = "tight",
    rate: Tensor | float = 0.999,
    gauge: str = "literal",
    bounds: Bounds | None = None,
) -> ShallowWeights:
    """The weights with the nearest a, w₁ as it is, that hold a condition at a rate.

    The literal `simple` and `gershgorin` ask for |w_{1i}| < 1: a neuron beyond is first rescaled to |w_{1i}| = ½, which
    changes no output of the network.

    Args:
        weights: `(*batch, …)`.
        condition: `simple`, `gershgorin`, `lmi`, `tight`, or `interval`.
        rate: κ, `(*batch,)` or a number, in (0, 1].
        gauge: "literal", or "best": of the equal networks (a_i/c_i, c_i w_{1i}, …), for `simple` and `gershgorin`.
        bounds: of the box, for `interval`.

    Raises:
        CertifyError: an unknown condition or gauge, a number that is no rate, or `interval` without bounds.

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
    elif condition == "interval":
        nearest = _nearest_on_box(weights, kappa[..., 0], *bounds)
    else:
        positive = a * w1 > 0
        classes = torch.stack([torch.where(positive, w, 0.0), torch.where(positive, 0.0, w)])
        nearest = a.sign() * _shrink(size[None], classes, kappa / _times(condition)).amin(0)
    return _scale(weights._replace(a=nearest), condition, rate, gauge, bounds)


def retract(
    weights: ShallowWeights,
    condition: str = "tight",
    rate: Tensor | float = 0.999,
    gauge: str = "literal",
    bounds: Bounds | None = None,
) -> ShallowWeights:
    """The weights with a scaled down until they hold a condition at a rate; for `lmi` and `tight` one sign class alone.

    Weights that hold it come back as they are, so that every certified network is reached: used on free weights inside
    a forward pass this is a direct parametrisation. Arguments and errors as of `project`.

    >>> wide = ShallowWeights(torch.tensor([3.0, 1.0]), torch.ones(2), torch.zeros(2, 1), torch.zeros(2))
    >>> retract(wide, rate=1.0).a
    tensor([0.7500, 0.2500])
    """
    _check(condition, rate, gauge, bounds)
    return _scale(_within_gauge(weights, condition, gauge), condition, rate, gauge, bounds)


def project_jointly(
    weights: ShallowWeights, condition: str = "tight", rate: Tensor | float = 0.999, gauge: str = "best"
) -> ShallowWeights:
    """The weights with the nearest (a, w₁) that hold `lmi`, `tight`, or `simple` and `gershgorin` in their best gauge.

    Arguments and errors as of `project`; the literal `gershgorin` is not convex, and has none.

    >>> wide = ShallowWeights(torch.tensor([2.0]), torch.tensor([1.0]), torch.zeros(1, 1), torch.zeros(1))
    >>> near = project_jointly(wide, rate=1.0)
    >>> bool((near.a * near.w1 - 1).abs() < 1e-5)
    True
    """
    _check(condition, rate, gauge, None if condition != "interval" else ())
    a, w1, n = weights.a, weights.w1, weights.a.shape[-1]
    kappa = _inner(rate, a)
    if condition == "simple" and gauge == "literal":
        return _scale(_nearest_diamond(weights, kappa), condition, rate, gauge, None)
    if condition not in ("simple", "gershgorin", "lmi", "tight") or (condition == "gershgorin" and gauge == "literal"):
        raise CertifyError(
            f"project_jointly: found {condition!r} in its {gauge} gauge, expected lmi, tight, simple, or gershgorin in "
            "its best gauge: use project"
        )
    if condition == "simple":  # each neuron a class of its own
        sizes = _nearest_product(a.abs()[..., None], w1.abs()[..., None], (kappa / (4 * (n + 1)))[..., None])
        new_a, new_w = sizes[0][..., 0], sizes[1][..., 0]
    elif condition == "gershgorin":
        new_a, new_w = _nearest_product(a.abs(), w1.abs(), kappa / 2)
    else:
        positive, radius = a * w1 > 0, kappa / _times(condition)
        one = _nearest_product(*(torch.where(positive, x.abs(), 0.0) for x in (a, w1)), radius)
        other = _nearest_product(*(torch.where(positive, 0.0, x.abs()) for x in (a, w1)), radius)
        new_a, new_w = (torch.where(positive, x, y) for x, y in zip(one, other, strict=True))
    return _scale(weights._replace(a=a.sign() * new_a, w1=w1.sign() * new_w), condition, rate, gauge, None)


def _times(condition: str) -> int:
    """How many times K the rate of a condition is."""
    return {"lmi": 2, "tight": 1}[condition]


def _check(condition: str, rate: Tensor | float, gauge: str, bounds: Bounds | None) -> None:
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
    """κ less what rounding may add to a sum of n products, `(*batch,)`."""
    rate = torch.as_tensor(rate, dtype=a.dtype, device=a.device)
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

    def factor(found: Tensor) -> Tensor:  # (*batch, 1), 1 where the rate is kept
        return (kappa / found.maximum(kappa))[..., None]

    if condition in ("lmi", "tight"):
        times = _times(condition)
        up, down = (factor(times * extreme) for extreme in extreme_slopes(a, w1))
        return weights._replace(a=a * torch.where(a * w1 > 0, up, down))
    if condition == "interval":
        rounding = 4 * a.shape[-1] * torch.finfo(a.dtype).eps  # neurons that are always on may cancel
        found = conditions.interval(weights, *bounds).rate + rounding * (a * w1).abs().sum(-1)
    else:
        rates: dict[str, Callable] = conditions.BEST_GAUGE if gauge == "best" else conditions.CONDITIONS
        found = rates[condition](a, w1).rate
    return weights._replace(a=a * factor(found))


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
    """(1): the nearest sizes in the weighted ball; as they were where the cost is 0."""
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
    lanes = [_Prefixes(*(x[..., None, :] for x in side)) for side in (above, below)]
    (up, _), (down, _) = _thresholds(*lanes, kappa[..., None], S[..., None], W[..., None], places[..., None])
    excess = (up - down)[..., 0] - places
    low, high = (torch.where(excess >= 0, places, least), torch.where(excess <= 0, places, most))
    low, high = low.amax(-1, keepdim=True), high.amin(-1, keepdim=True)
    before = torch.where(excess >= 0, excess, torch.inf).amin(-1, keepdim=True)
    after = torch.where(excess <= 0, excess, -torch.inf).amax(-1, keepdim=True)
    share = torch.where(before > 0, before / (before - after), 0.0)  # NaN or 0 where the root is at an end
    return torch.where(before.isinf(), least, torch.where(after.isinf(), most, low + (high - low) * share))


def _nearest_product(x: Tensor, y: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """(3): the nearest sizes x, y ≥ 0, `(*batch, n)`, with Σ x y ≤ radius, `(*batch,)`. τ = 1 − θ by bisection."""
    total, gap, radius = x + y, (x - y).abs(), radius[..., None]

    def moved(tau: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        sums, gaps = total / (2 - tau), gap / tau
        return sums, gaps, gaps < sums

    def product(tau: Tensor) -> tuple[Tensor, Tensor]:  # Σ h l and its derivative by τ
        sums, gaps, kept = moved(tau)
        each = torch.where(kept, (sums - gaps) * (sums + gaps) / 4, 0.0)
        slope = torch.where(kept, (sums * sums / (2 - tau) + gaps * gaps / tau) / 2, 0.0)
        return each.sum(-1, keepdim=True), slope.sum(-1, keepdim=True)

    with torch.no_grad():
        low = torch.full_like(radius, torch.finfo(x.dtype).tiny ** 0.5).log()
        high = torch.zeros_like(low)
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            over = product(middle.exp())[0] > radius
            low, high = torch.where(over, low, middle), torch.where(over, middle, high)
        inside = (x * y).sum(-1, keepdim=True) <= radius
        tau = torch.where(inside, 1.0, low.exp())
        split = product(low.exp())[0] > radius  # only where x_i = y_i are left: θ = 1, and x_i + y_i is what counts
    found, slope = product(tau)
    tau = torch.where(inside | split, tau, tau - (found - radius) / slope.clamp(min=torch.finfo(x.dtype).tiny).detach())
    sums, gaps, kept = moved(tau)
    parted, tiny = split & (gap == 0), torch.finfo(x.dtype).tiny
    share = 4 * radius / torch.where(gap == 0, total * total / 4, 0.0).sum(-1, keepdim=True).clamp(min=radius * 4)
    gaps = torch.where(parted, total / 2 * (1 - share).clamp(min=tiny).sqrt(), gaps)
    moves = (kept | parted) & ~inside
    larger = torch.where(moves, (sums + gaps) / 2, x.maximum(y))
    smaller = torch.where(moves, (sums - gaps) / 2, torch.where(inside, x.minimum(y), 0.0))
    return torch.where(x >= y, larger, smaller), torch.where(x >= y, smaller, larger)


def _nearest_diamond(weights: ShallowWeights, kappa: Tensor) -> ShallowWeights:
    """The nearest (a_i, w_{1i}) with (n+1)|a_i|/κ + |w_{1i}| ≤ 1: the foot on the edge, or a corner."""
    a, w1 = weights.a, weights.w1
    x, y, room = a.abs(), w1.abs(), 1 - 8 * a.shape[-1] * torch.finfo(a.dtype).eps
    c = (a.shape[-1] + 1) / kappa[..., None]
    over = (c * x + y - room) / (c * c + 1)
    new_x, new_y = (x - c * over).clamp(min=0), y - over
    new_y = torch.where(new_x == 0, y.clamp(max=room), new_y)
    new_x = torch.where(new_y < 0, x.minimum(room / c), new_x)
    outside = over > 0
    new_x, new_y = torch.where(outside, new_x, x), torch.where(outside, new_y.clamp(min=0), y)
    return weights._replace(a=a.sign() * new_x, w1=w1.sign() * new_y)
