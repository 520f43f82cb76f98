"""Fault accommodation: the filters that use it, its first state, and its diagnostics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

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
from usvlearn.estimators.ensemble.monitors.state import ThrusterState
from usvlearn.estimators.joint.layer import JointEKF


def accommodated(members: Mapping[str, Any]) -> tuple[str, ...]:
    """The names of the members that get what the monitor finds: joint EKFs with trials, without a wrapper."""
    return tuple(name for name, member in members.items() if isinstance(member, JointEKF) and member.trial is not None)


def description() -> dict[str, float]:
    """The numbers of the kernel."""
    return {
        "wait": WAIT, "after": AFTER, "loose": LOOSE, "scale": SCALE, "floor": FLOOR, "monitor": MONITOR,
    }  # fmt: skip


def init(batch: Sequence[int], like: Tensor) -> AccommodationState:
    """Before the first sample, of the dtype and device of `like`."""
    zero = like.new_zeros(tuple(batch))
    two = like.new_zeros((*batch, 2))
    return AccommodationState(zero, two, two + 1, two)


def thrust_remaining(thrusters: ThrusterState, given: Any) -> tuple[Tensor, Tensor]:
    """The effectiveness of each thruster and its standard deviation, `(*batch, 2)` each; given {}, the monitor's."""
    share, deviation = effectiveness(thrusters)
    if not given:
        return share, deviation
    accommodated = (thrusters.raised > 0) | (given.handed > 0)
    return torch.where(accommodated, given.share, share), torch.where(accommodated, given.deviation, deviation)
