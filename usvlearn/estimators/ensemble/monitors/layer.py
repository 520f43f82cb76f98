"""The monitors: their first state, and their diagnostics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from usvlearn.estimators.ensemble.monitors.state import (
    BACKWARDS,
    CALM,
    CLEARED,
    CLIP,
    DOUBT,
    DOUBTFUL,
    EFFECT,
    FIRST_SCALE,
    HORIZON,
    HUBER,
    HUBER_MEAN,
    HUBER_RATE,
    KNEE,
    LEAST_SCALE,
    LOSS,
    MISFIT,
    ROUNDING,
    SIGNIFICANT,
    THRESHOLD,
    THRUST,
    WHITE,
    YAW_FLOOR,
    YAW_MEMORY,
    YAW_RATE,
    YAW_RIDGE,
    YAW_SCALE,
    YAW_SPREAD,
    InnovationState,
    MonitorState,
    ThrusterState,
    Z,
)


class Whiteness(NamedTuple):
    """Lag-1 autocorrelation of innovation sequences. Leaves are `(*batch, k)`."""

    correlation: Tensor  # -1 ... 1
    band: Tensor  # white noise stays within ± this in 95 % of the cases
    samples: Tensor  # n of (1)


def excitation(factor: Tensor, prior: Tensor | float) -> Tensor:
    """The share of each parameter's first variance that the data have removed, 0 (a guess) to 1, `(*batch, p)`.

    The factor is a square root of the covariance, `(*batch, p, p)`; the prior is the diagonal of P₀.
    """
    return (1 - (factor * factor).sum(-1) / prior).clamp(0, 1)


def least_informed(factor: Tensor, prior: Tensor | float) -> tuple[Tensor, Tensor]:
    """The direction that the data inform least, and the share of its first variance that they have removed.

    The direction is of unit length in parameters over √P₀, `(*batch, p)`, its largest entry positive.
    """
    root = torch.as_tensor(prior, dtype=factor.dtype, device=factor.device).sqrt()
    vectors, values, _ = torch.linalg.svd(factor / root[..., None])
    direction = vectors[..., 0]
    largest = direction.take_along_dim(direction.abs().argmax(-1, keepdim=True), -1)
    return direction * largest.sign() + 0.0, (1 - values[..., 0] ** 2).clamp(0, 1)


def excitation_report(names: Sequence[str], factor: Tensor, prior: Tensor | float) -> dict[str, Tensor]:
    """`excitation_<parameter>` and `least_informed_<parameter>`, the entries of both, `(*batch,)` each."""
    share, direction = excitation(factor, prior).unbind(-1), least_informed(factor, prior)[0].unbind(-1)
    informed = {f"excitation_{name}": x for name, x in zip(names, share, strict=True)}
    return informed | {f"least_informed_{name}": x for name, x in zip(names, direction, strict=True)}


def description(threshold: float = THRESHOLD, memory: float = 500.0) -> dict[str, float]:
    """The numbers of the kernel."""
    innovations = {"huber": HUBER, "huber_mean": HUBER_MEAN, "huber_rate": HUBER_RATE, "least_scale": LEAST_SCALE**2}
    return innovations | {
        "innovation_memory": memory, "yaw_memory": YAW_MEMORY, "yaw_ridge": YAW_RIDGE, "yaw_floor": YAW_FLOOR**2,
        "yaw_rate": YAW_RATE, "knee": KNEE, "yaw_spread": YAW_SPREAD, "loss": LOSS, "horizon": HORIZON,
        "misfit": MISFIT, "clip": CLIP, "effect": EFFECT, "calm": CALM, "threshold": threshold, "backwards": BACKWARDS,
        "doubt": DOUBT, "cleared": CLEARED,
    }  # fmt: skip


def init(batch: Sequence[int], columns: int, like: Tensor) -> MonitorState:
    """The monitors before the first sample, of the dtype and device of `like`; `columns` innovation sequences."""
    b, k, zero = tuple(batch), columns, like.new_zeros
    innovations = InnovationState(zero((*b, k, 4)), zero((*b, k)) + FIRST_SCALE**2, zero((*b, k)))
    two = zero((*b, 2))
    yaw = zero((*b, Z, Z)), zero(b) + YAW_SCALE**2, two, two, zero((*b, 2, 2)), two, zero(b), zero(b)
    return MonitorState(innovations, ThrusterState(*yaw))


def whiteness(state: InnovationState, memory: float = 500.0) -> Whiteness:
    """Lag-1 autocorrelation, its 95 % band and the samples that count; 0, 1.96 and 0 before the first."""
    weight, *sums = state.moments.unbind(-1)
    mean, square, lagged = (x / weight.clamp(min=torch.finfo(weight.dtype).tiny) for x in sums)
    variance = square - mean * mean
    correlation = torch.where(variance > 0, (lagged - mean * mean) / torch.where(variance > 0, variance, 1.0), 0.0)
    samples = weight * (2 * memory - 1) / (2 - weight)  # (1)
    return Whiteness(correlation, WHITE / samples.clamp(min=1).sqrt(), samples)


def solve_model(moments: Tensor, columns: Tensor) -> Tensor:
    """ϑ of (4), and (Σ w x xᵀ + R)⁻¹ times columns, `(*batch, 9, 1 + n)`; 0 where there is no solution."""
    information = moments[..., 1:, 1:]
    share = ROUNDING * torch.finfo(moments.dtype).eps * information[..., :1, 0]
    ridge = (share * information.diagonal(dim1=-2, dim2=-1)).clamp(min=YAW_RIDGE)  # (7)
    root, broken = torch.linalg.cholesky_ex(information + ridge.diag_embed())
    right = torch.cat([moments[..., 1:, :1], columns.expand(*moments.shape[:-2], *columns.shape[-2:])], -1)
    return torch.cholesky_solve(right, root).masked_fill((broken > 0)[..., None, None], 0.0)


def effectiveness(state: ThrusterState) -> tuple[Tensor, Tensor]:
    """The share of each thruster's thrust that remains, by (6), and its standard deviation, `(*batch, 2)` each.

    It is 1 without an alarm where the evidence is below SIGNIFICANT: healthy thrusters show some evidence, too.
    """
    moment, weight = state.sums.unbind(-1)
    weight = weight + DOUBT
    lost = torch.where((state.evidence > SIGNIFICANT) | (state.raised > 0), -moment / weight, 0.0)
    full = torch.eye(2, dtype=weight.dtype, device=weight.device).repeat(3, 1)  # h of both sides
    full = torch.cat([full.new_zeros(THRUST, 2), full])
    solved = solve_model(state.moments, full)
    effect = (full * solved[..., :1]).sum(-2)  # F
    square = state.variance[..., None] * (full * solved[..., 1:]).sum(-2)
    unsure = DOUBTFUL**2 * square / (effect * effect).clamp(min=torch.finfo(weight.dtype).tiny)
    doubtful = torch.where(lost == 0, 0.0, lost * lost * unsure)
    return 1 - lost, (1 / weight + doubtful).sqrt()


def monitor_report(state: MonitorState, members: Sequence[str], memory: float = 500.0) -> dict[str, Tensor]:
    """Diagnostics by name, `(*batch,)` each; `members` names the columns."""
    white, thrusters = whiteness(state.innovations, memory), state.thrusters
    numbers = {
        "alarm": thrusters.raised.amax(-1),
        "alarms": thrusters.alarms,
        "since_alarm": thrusters.since,
        "whiteness_band": white.band.amax(-1),
    }
    columns = {
        "effectiveness": (("left", "right"), effectiveness(thrusters)[0]),
        "evidence": (("left", "right"), thrusters.evidence),
        "whiteness": (members, white.correlation),
        "scale": (members, state.innovations.scale.sqrt()),
    }
    for part, (names, values) in columns.items():
        numbers |= {f"{part}_{name}": value for name, value in zip(names, values.unbind(-1), strict=True)}
    return numbers
