"""Conditions for x⁺ = aᵀ relu(w₁ x + W₂ u + b), x scalar, to contract, each in closed form.

Equations (1) to (4), from the narrowest to the widest: `docs/certification.md#one-state`; (5) is (4) on a box, where
neurons whose sign is fixed count as such. s_i = a_i w_{1i}; P and −N are the sums of the positive and of the negative
s_i. a and w₁ are `(*batch, n)` everywhere, margins and rates `(*batch,)`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from certify.networks.shallow import ShallowWeights


class Condition(NamedTuple):
    """The result of a condition for each network."""

    margin: Tensor  # (*batch,) > 0 where it holds
    rate: Tensor  # (*batch,) the smallest rate at which it holds; inf if there is none


def extreme_slopes(a: Tensor, w1: Tensor) -> tuple[Tensor, Tensor]:
    """P and N: over all activation patterns the slope of x ↦ x⁺ lies in [−N, P]."""
    s = a * w1
    return s.clamp(min=0).sum(-1), (-s).clamp(min=0).sum(-1)  # not P − Σ s_i, which cancels


def rate(a: Tensor, w1: Tensor) -> Tensor:
    """K = max(P, N), the exact contraction rate over all activation patterns."""
    P, N = extreme_slopes(a, w1)
    return P.maximum(N)


def simple(a: Tensor, w1: Tensor) -> Condition:
    """(1): the paper's theorem with p = 1, λ = 1/(n+1). It proves no rate K above ¼."""
    size, w = (a.shape[-1] + 1) * a.abs(), w1.abs()
    room = 1 - w
    rate = torch.where(room > 0, size / torch.where(room > 0, room, 1.0), torch.inf)
    return Condition(1 - (size + w).amax(-1), rate.amax(-1))


def gershgorin(a: Tensor, w1: Tensor) -> Condition:
    """(2): the paper's lemma, with the best p and Λ. It proves no rate K above ½."""
    room = 1 - w1.abs()
    safe = torch.where(room > 0, room, 1.0)
    half = (torch.where(room > 0, a.abs(), 0.0) / safe).sum(-1) / 2
    least = room.amin(-1)
    return Condition((1 - half).minimum(least), torch.where(least > 0, half, torch.inf))


def lmi(a: Tensor, w1: Tensor) -> Condition:
    """(3): the paper's LMI is feasible ⇔ 2K < 1. The factor is 2 because Λ in its corner allows slopes in [0, 2]."""
    twice = 2 * rate(a, w1)
    return Condition(1 - twice, twice)


def exact(a: Tensor, w1: Tensor) -> Condition:
    """(4): all activation patterns; no condition on (a, w₁) alone is weaker."""
    K = rate(a, w1)
    return Condition(1 - K, K)


def interval(weights: ShallowWeights, lo: Tensor, hi: Tensor) -> Condition:
    """(5): as `exact`, of the patterns that interval arithmetic cannot exclude on a box.

    lo and hi: the least and the greatest x, u₁ … u_m, `(1 + m,)` each.
    """
    always, never = fixed_signs(weights, lo, hi)
    s = weights.a * weights.w1
    on = torch.where(always, s, 0.0).sum(-1)
    free = torch.where(always | never, 0.0, s)
    K = (on + free.clamp(min=0).sum(-1)).maximum(-on + (-free).clamp(min=0).sum(-1))
    return Condition(1 - K, K)


def fixed_signs(weights: ShallowWeights, lo: Tensor, hi: Tensor) -> tuple[Tensor, Tensor]:
    """The neurons that are on everywhere in a box, and those that are off everywhere."""
    centre, radius = (lo + hi) / 2, (hi - lo) / 2
    w1, W2, b = weights.w1, weights.W2, weights.b
    z = w1 * centre[0] + W2 @ centre[1:] + b
    reach = w1.abs() * radius[0] + W2.abs() @ radius[1:]
    largest = lo.abs().maximum(hi.abs())
    rounding = 2 * (len(lo) + 2) * torch.finfo(z.dtype).eps
    reach = reach + rounding * (w1.abs() * largest[0] + W2.abs() @ largest[1:] + b.abs())
    return z > reach, z < -reach


def simple_best_gauge(a: Tensor, w1: Tensor) -> Condition:
    """(1) of the best of the equal networks (a_i/c_i, c_i w_{1i}, …), c > 0: 4(n+1) max |s_i| < 1."""
    rate = 4 * (a.shape[-1] + 1) * (a * w1).abs().amax(-1)
    return Condition(1 - rate, rate)


def gershgorin_best_gauge(a: Tensor, w1: Tensor) -> Condition:
    """(2) of the best of the equal networks: 2 Σ |s_i| < 1, at c_i = 1/(2|w_{1i}|)."""
    rate = 2 * (a * w1).abs().sum(-1)
    return Condition(1 - rate, rate)


CONDITIONS: dict[str, Callable[[Tensor, Tensor], Condition]] = {
    "simple": simple,
    "gershgorin": gershgorin,
    "lmi": lmi,
    "exact": exact,
}
BEST_GAUGE = {"simple": simple_best_gauge, "gershgorin": gershgorin_best_gauge}
