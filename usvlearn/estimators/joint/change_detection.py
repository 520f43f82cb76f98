"""The second filter of the joint EKF, which tests whether the boat has changed: its arguments and its first state."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from usvlearn.core.hyperparameters import Hyper, Positive, as_tensor
from usvlearn.errors import ConfigError
from usvlearn.estimators.joint.state import THETA, JointState, TrialState


class Trial(nn.Module):
    """A second filter that must prove itself after a change of the boat, and then replaces the first.

    The sum is that of Page 1954; the trial is derived in `docs/theory/estimators.md`, joint EKF.

    Args:
        threshold: of g, no unit: Page's sum of innovations that keep their sign, at which a trial begins.
        leads: evidence D, a logarithm of a likelihood ratio, no unit, above which the second filter predicts,
        confirmed: and above which it replaces the first; no unit.
        dropped: D below which a trial ends, no unit,
        fallen: and by how much D may fall below its greatest value; no unit.
        steps: the longest trial, a number of steps.
        side: s of (9), standard deviation of a factor of each side's thrust, no unit.
        each: r, that of each parameter, in units of its value, no unit.

    Raises:
        ConfigError: a number is not positive, or `leads` is not between `dropped` and `confirmed`.

    >>> from usvlearn import JointEKF
    >>> joint = JointEKF(surge_max=2.7, trial=Trial())
    >>> joint.init((8,)).trial.changes.shape
    torch.Size([8])
    """

    threshold: Positive
    confirmed: Positive
    fallen: Positive
    side: Positive
    each: Positive
    leads: Tensor
    dropped: Tensor

    def __init__(
        self,
        threshold: Hyper = 12.0,
        leads: Hyper = 5.0,
        confirmed: Hyper = 150.0,
        dropped: Hyper = -2.0,
        fallen: Hyper = 4.0,
        steps: int = 75,
        side: Hyper = 0.6,
        each: Hyper = 0.3,
    ):
        super().__init__()
        fixed = {"threshold": threshold, "confirmed": confirmed, "fallen": fallen, "side": side, "each": each}
        for name, value in fixed.items():
            setattr(self, name, Positive(value, f"trial.{name}", learnable=False))
        self.register_buffer("leads", as_tensor(leads, "trial.leads"))
        self.register_buffer("dropped", as_tensor(dropped, "trial.dropped"))
        between = (self.dropped < self.leads) & (self.leads < self.confirmed())
        if not bool(between.all()):
            raise ConfigError(
                f"trial.leads: found {self.leads.tolist()}, expected a number between trial.dropped, "
                f"{self.dropped.tolist()}, and trial.confirmed, {self.confirmed().tolist()}"
            )
        if not isinstance(steps, int) or not 1 <= steps <= 10**6:
            raise ConfigError(f"trial.steps: found {steps!r}, expected a whole number from 1 to 1000000")
        self.steps = steps

    def init(self, state: JointState) -> TrialState:
        """The state before the first sample, of a filter in `state`."""
        zero, m, axis = torch.zeros_like(state.noise), state.mean.shape[-1] - THETA, state.noise.dim()
        return TrialState(
            *[getattr(state, name) for name in SWAPPED], *[zero] * len(TrialState._fields[4:-5]),
            *[zero[..., None].expand(*zero.shape, m).clone()] * 2,
            *(torch.stack([leaf] * 2, axis) for leaf in (state.mean, state.factor, state.noise)),
        )  # fmt: skip

    def description(self) -> dict[str, Any]:
        """What a description of the filter states beside its own attributes."""
        return {"trial_steps": self.steps, **{name: getattr(self, name) for name in Trial.__annotations__}}


SWAPPED = ("mean", "factor", "noise", "updates")  # the leaves of a filter that has a second one


def of(state: JointState) -> TrialState:
    """The trial of a filter that makes trials."""
    assert isinstance(state.trial, TrialState)
    return state.trial
