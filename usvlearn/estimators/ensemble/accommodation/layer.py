"""Fault accommodation in torch: equations (1) to (3) of `state`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from usvlearn.core.events import NINETY
from usvlearn.estimators.ensemble.accommodation.state import (
    AFTER,
    FLOOR,
    LOOSE,
    MONITOR,
    SCALE,
    WAIT,
    AccommodationState,
)
from usvlearn.estimators.ensemble.monitors.layer import effectiveness
from usvlearn.estimators.ensemble.monitors.state import SIGNIFICANT, ThrusterState
from usvlearn.estimators.joint.accommodation import give_back, hand_over, keep_past, thrust_left
from usvlearn.estimators.joint.layer import JointEKF


def accommodated(members: Mapping[str, Any]) -> tuple[str, ...]:
    """The names of the members that get what the monitor finds: joint EKFs with trials, without a wrapper."""
    return tuple(name for name, member in members.items() if isinstance(member, JointEKF) and member.trial is not None)


def description() -> dict[str, float]:
    """The numbers of `accommodate`, for its kernel."""
    return {
        "wait": WAIT, "after": AFTER, "loose": LOOSE, "scale": SCALE, "floor": FLOOR, "monitor": MONITOR,
    }  # fmt: skip


def init(batch: Sequence[int], like: Tensor) -> AccommodationState:
    """Before the first sample, of the dtype and device of `like`."""
    zero = like.new_zeros(tuple(batch))
    two = like.new_zeros((*batch, 2))
    return AccommodationState(zero, two, two + 1, two)


def accommodate(
    state: AccommodationState, joints: Mapping[str, Any], thrusters: ThrusterState, dt: Tensor, surge: Tensor
) -> tuple[AccommodationState, dict[str, Any]]:
    """The next state, and the states of the filters after a measurement.

    Args:
        state: before it.
        joints: states of the filters by name.
        thrusters: what the monitor has found.
        dt: s, of the step, `(*batch,)`.
        surge: measured, m/s, `(*batch,)`.
    """
    on, handed = thrusters.raised > 0, state.handed > 0
    alone, spread = effectiveness(thrusters)
    new = on & ~handed & (thrusters.since >= AFTER)[..., None]
    value, width = fused(_sources(joints))
    healed = handed & ~on & (value + NINETY * width >= 1)
    shares = torch.where(new, alone.clamp(min=0), torch.where(healed, 1.0, state.share))
    handed = (handed | new) & ~healed
    quiet = ~(on | handed).any(-1) & (thrusters.evidence < SIGNIFICANT).all(-1)
    calm = state.calm + torch.where(quiet, dt, 0.0)
    copies = quiet & (calm >= WAIT)
    found = {}
    for name, joint in joints.items():
        for side in range(2):
            joint = give_back(joint, healed[..., side], side, LOOSE, surge)
        found[name] = keep_past(hand_over(joint, new.any(-1), shares, LOOSE, surge), copies)
    told = torch.where(on, MONITOR * spread, torch.inf)
    value, width = fused([(alone, told), *_sources(found)])
    return AccommodationState(
        torch.where(copies, 0.0, calm),
        handed.to(surge.dtype),
        torch.where(handed, value, torch.where(on, alone, 1.0)),
        torch.where(handed, width, torch.where(on, spread, 0.0)),
    ), found


def _sources(joints: Mapping[str, Any]) -> list[tuple[Tensor, Tensor]]:
    """(2) of each filter, `(*batch, 2)` each."""
    found = []
    for joint in joints.values():
        left = [thrust_left(joint, side, SCALE, FLOOR) for side in range(2)]
        found.append((torch.stack([x for x, _ in left], -1), torch.stack([s for _, s in left], -1)))
    return found


def thrust_remaining(thrusters: ThrusterState, given: Any) -> tuple[Tensor, Tensor]:
    """The effectiveness of each thruster and its standard deviation, `(*batch, 2)` each.

    Args:
        thrusters: the monitor's.
        given: an `AccommodationState`, or {}: then the monitor alone tells.
    """
    share, deviation = effectiveness(thrusters)
    if not given:
        return share, deviation
    told = (thrusters.raised > 0) | (given.handed > 0)
    return torch.where(told, given.share, share), torch.where(told, given.deviation, deviation)


def fused(sources: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """(3) from values and standard deviations; what is not finite counts as unknown. 1 ± 1 where all is unknown."""
    total = moment = torch.zeros_like(sources[0][0])
    for value, deviation in sources:
        known = value.isfinite() & deviation.isfinite() & (deviation > 0)
        weight = torch.where(known, 1 / (deviation * deviation), 0.0)
        total = total + weight
        moment = moment + weight * torch.where(known, value, 0.0)
    some = total > 0
    safe = torch.where(some, total, 1.0)
    return torch.where(some, moment / safe, 1.0), 1 / safe.sqrt()
