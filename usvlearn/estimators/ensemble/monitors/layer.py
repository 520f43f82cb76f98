"""The monitors: their first state, and their diagnostics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from usvlearn.estimators.ensemble.monitors import state as at
from usvlearn.estimators.ensemble.monitors.state import InnovationState, MonitorState, Number, ThrusterState


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


def description(threshold: float = at.THRESHOLD, memory: float = 500.0) -> dict[str, float]:
    """The numbers of the kernel: the constants of those names, and variances for standard deviations."""
    found = {number.key: getattr(at, number.name) for number in Number if number is not Number.INNOVATION_MEMORY}
    squares = {name: found[name] ** 2 for name in ("least_scale", "yaw_floor", "surge_floor")}
    return found | squares | {"innovation_memory": memory, "threshold": threshold}


def init(batch: Sequence[int], columns: int, like: Tensor) -> MonitorState:
    """The monitors before the first sample, of the dtype and device of `like`; `columns` innovation sequences."""
    b, k, zero = tuple(batch), columns, like.new_zeros
    innovations = InnovationState(zero((*b, k, 4)), zero((*b, k)) + at.FIRST_SCALE**2, zero((*b, k)))
    errors, two, none = zero((*b, 2, 6)), zero((*b, 2)), zero(b)
    errors[..., at.VARIANCE], errors[..., at.LEVELS] = at.YAW_SCALE**2, at.SLOW_SCALE**2
    models = zero((*b, 1 + at.YAW, 1 + at.YAW)), zero((*b, 1 + at.SURGES, 1 + at.SURGES)), errors
    solved = zero((*b, at.YAW)), zero((*b, at.YAW, at.YAW)), zero((*b, 3))
    seen = zero((*b, at.SURGES - 2)), two, zero((*b, 3)), zero((*b, 3, 4)), zero((*b, 3)), none
    thrusters = ThrusterState(*models, *solved, *seen, two, two + 1, two + at.DOUBT**-0.5, none, none)
    return MonitorState(innovations, thrusters)


def whiteness(state: InnovationState, memory: float = 500.0) -> Whiteness:
    """Lag-1 autocorrelation, its 95 % band and the samples that count; 0, 1.96 and 0 before the first."""
    weight, *sums = state.moments.unbind(-1)
    mean, square, lagged = (x / weight.clamp(min=torch.finfo(weight.dtype).tiny) for x in sums)
    variance = square - mean * mean
    correlation = torch.where(variance > 0, (lagged - mean * mean) / torch.where(variance > 0, variance, 1.0), 0.0)
    samples = weight * (2 * memory - 1) / (2 - weight)  # (1)
    return Whiteness(correlation, at.WHITE / samples.clamp(min=1).sqrt(), samples)


def effectiveness(state: ThrusterState) -> tuple[Tensor, Tensor]:
    """The share of each thruster's thrust that remains, by (6), and its standard deviation, `(*batch, 2)` each.

    It is 1 without an alarm where the evidence is below SIGNIFICANT: healthy thrusters show some evidence, too.
    """
    return state.share, state.deviation


def yaw_explained(state: ThrusterState) -> Tensor:
    """The share of the yaw rate's variance, without its own past, that the commands explain, `(*batch,)`.

    It is 0 before the first turn, and where the errors of the model are not white.
    """
    (error, made), errors = state.explained.unbind(-1), state.errors[..., 0, :]
    white = errors[..., at.LAGGED] <= at.COLOURED * errors[..., at.SQUARE]
    return torch.where((made > 0) & white, 1 - error / made, 0.0)


def monitor_report(state: MonitorState, members: Sequence[str], memory: float = 500.0) -> dict[str, Tensor]:
    """Diagnostics by name, `(*batch,)` each; `members` names the columns."""
    white, thrusters = whiteness(state.innovations, memory), state.thrusters
    numbers = {
        "alarm": thrusters.raised.amax(-1),
        "alarms": thrusters.alarms,
        "since_alarm": thrusters.since,
        "yaw_explained": yaw_explained(thrusters),
        "whiteness_band": white.band.amax(-1),
    }
    columns = {
        "effectiveness": (("left", "right"), effectiveness(thrusters)[0]),
        "evidence": (("left", "right", "both"), thrusters.evidence),
        "whiteness": (members, white.correlation),
        "scale": (members, state.innovations.scale.sqrt()),
    }
    for part, (names, values) in columns.items():
        numbers |= {f"{part}_{name}": value for name, value in zip(names, values.unbind(-1), strict=True)}
    return numbers
