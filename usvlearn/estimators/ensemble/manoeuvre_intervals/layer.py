"""Interval widths as a function of the manoeuvre, for the next step and for forecasts over each horizon.

No gradient passes through them: what is predicted does not depend on its interval.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from usvlearn.estimators.ensemble.conformal.state import FEW
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
    learned = init(batch, k, like)
    held = hold(learned, torch.zeros_like(learned.level))
    return HorizonState(
        learned=learned,
        path=like.new_zeros((*batch, at.PATH)),
        paths=like.new_zeros((*batch, slots, at.PATH)),
        held=held[..., None, :, :].expand(*batch, slots, k, at.HELD).clone(),
        due=like.new_full((*batch, k, at.DUE), math.nan),
    )


def opened(state: HorizonState, opens: Tensor, left: Tensor, right: Tensor, count: Tensor) -> HorizonState:
    """After a measured speed, in a step with these commands; `opens`, `(*batch, slots)`, where an origin begins."""
    path, held = begin_path(left, right), hold(state.learned, count)[..., None, :, :]
    return state._replace(
        path=path,
        paths=torch.where(opens[..., None], path[..., None, :], state.paths),
        held=torch.where(opens[..., None, None], held, state.held),
    )


def begin_path(left: Tensor, right: Tensor) -> Tensor:
    """A path that begins at these commands, `(…, 5)`."""
    mean = (left + right) / 2
    return torch.stack([left, right, mean, mean, torch.zeros_like(mean)], -1)


def extend_path(path: Tensor, left: Tensor, right: Tensor) -> Tensor:
    """A path after one more step with these commands, which are of the path's shape without the last axis."""
    first, second, low, high, far = path.unbind(-1)
    mean = (left + right) / 2
    far = torch.maximum(far, torch.maximum((left - first).abs(), (right - second).abs()))
    return torch.stack([first, second, torch.minimum(low, mean), torch.maximum(high, mean), far], -1)


def far_of(path: Tensor) -> Tensor:
    """The most that a command differs from that at the origin."""
    return path[..., at.FAR]


def group_of(path: Tensor) -> Tensor:
    """0, 1 or 2 by the range of the mean command, as numbers of the path's dtype."""
    moved = path[..., at.HIGH] - path[..., at.LOW]
    return (moved >= at.LITTLE).to(path.dtype) + (moved > at.MUCH).to(path.dtype)


def hold(state: LearnedState, count: Tensor) -> Tensor:
    """What (1) to (3) need after `count` errors, `(*batch, K, 8)`."""
    level, c = state.level[..., None], state.coefficients
    scales = torch.cat([c[..., :1] * level, c[..., 1:], (at.FLOOR * level).clamp(min=at.LEAST)], -1)
    own, before = state.scores[..., 0], state.scores[..., 1].clamp(min=at.NARROWEST)
    sure = ((count - at.SURE) / at.RAMP).clamp(0, 1)
    x = at.DOUBT - at.EVIDENCE * (count - FEW).clamp(min=0).sqrt() * (before - own) / before
    share = torch.where(sure >= 1, 1.0, sure + (1 - sure) / (1 + x.exp()))
    return torch.cat([scales, state.factors, share[..., None]], -1)


def halfwidth_held(held: Tensor, width: Tensor, spread: Tensor, far: Tensor, group: Tensor) -> Tensor:
    """(2), m/s, beside the half-width that does not know the manoeuvre; infinite with that."""
    own, a = _own(held, spread.detach(), far.detach(), group), held[..., -1]
    known = width.isfinite()
    mixed = ((1 - a) * torch.where(known, width, 1.0).log() + a * own.log()).exp()
    return torch.where(known, torch.where(a >= 1, own, mixed), width)


def learn_error(
    state: LearnedState,
    count: Tensor,
    e: Tensor,
    width: Tensor,
    spread: Tensor,
    far: Tensor,
    group: Tensor,
    overlap: float,
    alpha: float,
) -> LearnedState:
    """(3) to (6) after errors, m/s.

    Args:
        state: before.
        count: how many errors are known with these, `(*batch, K)`.
        e: absolute errors, likewise.
        width: half-widths that do not know the manoeuvre, as they were learned before these errors.
        spread, far, group: of the predictions that erred.
        overlap: n, how many forecasts are under way at the same time; 0 of one step.
        alpha: share that may miss.
    """
    e, width, spread, far = (x.detach() for x in (e, width, spread, far))
    expected = _expected(state, spread, far)
    own = (_of_group(state.factors, group) * expected).clamp(min=at.NARROWEST)
    widths = torch.stack([own, width], -1)
    scores = 2 * widths + 2 / alpha * (e[..., None] - widths).clamp(min=0)
    part = (1 / (count - FEW).clamp(min=1)).clamp(min=at.SLOW)[..., None]
    scores = torch.where((count > FEW)[..., None], state.scores + part * (scores - state.scores), state.scores)
    miss, places = (e > own).to(e.dtype) - alpha, torch.arange(at.GROUPS, device=e.device)
    rate = at.COMMON / (at.DELAY + overlap) + at.OWN * (places == group[..., None]).to(e.dtype)
    factors = (state.factors * (rate * miss[..., None]).exp()).clamp(at.SMALLEST, at.GREATEST)  # (4)
    level = state.level + (1 / count.clamp(min=1)).clamp(min=at.QUICK) * (e - state.level)  # (5)
    expected = torch.maximum(expected, at.FLOOR * level)
    weight, target = 1 / (expected * expected), torch.minimum(e, at.CLIP * expected)
    f = torch.stack([state.level, spread, far], -1)
    A = at.KEPT * state.gram + weight[..., None, None] * f[..., :, None] * f[..., None, :]  # (6)
    b = at.KEPT * state.moments + weight[..., None] * f * target[..., None]
    c = list(state.coefficients.unbind(-1))
    for i in range(at.FEATURES):
        rest = b[..., i]
        for j in range(at.FEATURES):
            rest = rest if j == i else rest - A[..., i, j] * c[j]
        c[i] = (rest * (1 / A[..., i, i].clamp(min=at.TINY))).clamp(min=0)
    return LearnedState(torch.stack(c, -1), A, b, level, factors, scores)


def _expected(state: LearnedState, spread: Tensor, far: Tensor) -> Tensor:
    """s of (1)."""
    c, level = state.coefficients, state.level
    return torch.maximum(c[..., 0] * level + c[..., 1] * spread + c[..., 2] * far, (at.FLOOR * level).clamp(at.LEAST))


def _own(held: Tensor, spread: Tensor, far: Tensor, group: Tensor) -> Tensor:
    """v of (2) of what an origin keeps."""
    c = held[..., : at.FEATURES]
    expected = torch.maximum(c[..., 0] + c[..., 1] * spread + c[..., 2] * far, held[..., at.FEATURES])
    return (_of_group(held[..., at.FEATURES + 1 : -1], group) * expected).clamp(min=at.NARROWEST)


def _of_group(factors: Tensor, group: Tensor) -> Tensor:
    """r of each group, `(…,)`; a group that is NaN, where nothing was due, counts as the first."""
    first, second, third = factors.unbind(-1)
    return torch.where(group > 1.5, third, torch.where(group > 0.5, second, first))
