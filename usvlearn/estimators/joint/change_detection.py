"""The trial of the joint EKF in torch: equations (8) to (10) of `state`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn

from usvlearn.core.hyperparameters import Hyper, Positive, as_tensor, numbers
from usvlearn.core.samples import tree_map, where
from usvlearn.errors import ConfigError
from usvlearn.estimators.augmented_ekf.state import LONGEST
from usvlearn.estimators.joint import state as at
from usvlearn.estimators.joint.state import KAPPA, THETA, E, JointState, TrialState
from usvlearn.estimators.ud_factorization.layer import added, packed, unpacked, variances

if TYPE_CHECKING:
    from collections.abc import Callable


class Stepped(NamedTuple):
    """One filter after a measurement."""

    state: JointState
    predicted: Tensor  # (*batch,) m/s
    z: Tensor  # (*batch,) innovation in standard deviations
    S: Tensor  # (*batch,) its variance, m²/s²
    moves: Tensor  # (*batch,) bool: the boat was not at rest


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
            *leaves_of(state).values(), *[zero] * len(TrialState._fields[4:-5]),
            *[zero[..., None].expand(*zero.shape, m).clone()] * 2,
            *(torch.stack([leaf] * 2, axis) for leaf in (state.mean, state.factor, state.noise)),
        )  # fmt: skip

    def description(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Choices and numbers for a description."""
        named = {each.key: getattr(self, each.key) for each in at.FAMILY.last}
        return {"trial_steps": self.steps}, numbers(**named)

    def coasted(self, before: JointState, after: JointState, other: JointState) -> JointState:
        """The state after a step without a measurement: `after`, and the other filter's step where it runs."""
        trial = of(before)
        runs = trial.run > 0
        kept = chosen(runs, leaves_of(other), leaves_of(exchanged(before)))
        return after._replace(trial=trial._replace(**kept, run=trial.run + runs))

    def learned(
        self, before: JointState, first: Stepped, step: Callable[[JointState], Stepped], dt: Tensor, variance: Tensor
    ) -> JointState:
        """The state after a measurement: the filter that predicts the next speed, and the other one.

        Args:
            before: the step.
            first: the filter that predicts, after it.
            step: makes that step for the other filter.
            dt: s since the measurement before.
            variance: of the prior, `(m,)` or `(*batch, m)`.
        """
        trial, jumps = of(before), dt > LONGEST
        quiet, counts = ~(trial.run > 0), first.moves & ~jumps
        watched = counts & ~(trial.tried > 0)
        trial = chosen(watched, self._detected(trial, first.z), trial)
        begins = watched & quiet & (trial.statistic > at.SUSPECT)
        runs = begins | (trial.run > 0)
        kept = chosen(quiet, before, exchanged(before))
        second = step(chosen(begins, self._loosened(before, variance), kept))
        more = likelihood(second) - likelihood(first)
        more = torch.where(runs & counts & second.moves, torch.where(trial.leads > 0, -more, more), 0.0)
        trial = trial._replace(
            **chosen(runs, leaves_of(second.state), leaves_of(kept)),
            evidence=torch.where(begins, 0.0, trial.evidence) + more,
            run=trial.run + runs,
            since=trial.since + torch.where(counts, dt, 0.0),
            kept=where(begins, before.mean[..., THETA:], trial.kept),
        )
        state = first.state._replace(trial=trial)
        return chosen(runs & ~jumps, self._judged(state, trial), state)

    def started(self, state: JointState) -> JointState:
        """The state at the start of a segment."""
        trial, zero = of(state), torch.zeros_like(state.noise)
        run = torch.where(trial.tried > 0, trial.run, 0.0)
        return state._replace(trial=trial._replace(statistic=zero, last=zero, run=run))

    def _loosened(self, state: JointState, variance: Tensor) -> JointState:
        """A filter with the covariance (9)."""
        (U, D), n = unpacked(state.factor), state.mean.shape[-1]
        eye = torch.eye(n, dtype=D.dtype, device=D.device)
        for side in range(2):
            d = torch.where(side_of(side, state.mean), state.mean, 0.0)
            U, D = added(U, D, d, (self.side() ** 2).expand(state.noise.shape))
        room = (at.ROOM * variance - variances(U, D)[..., THETA:]).clamp(min=0)
        grown = torch.minimum((self.each()[..., None] * state.mean[..., THETA:]) ** 2, room)
        for i in range(THETA, n - 1):
            U, D = added(U, D, eye[i], grown[..., i - THETA])
        return state._replace(factor=packed(U, D))

    def _detected(self, trial: TrialState, z: Tensor) -> TrialState:
        """(8) after the innovation z."""
        same = z * trial.last > 0
        m = (torch.minimum(z.abs(), trial.last.abs()) ** 2).clamp(max=at.INNOVATION_MOST)
        g = (trial.statistic + torch.where(same, m, -m) - at.OFFSET - at.USUALLY * trial.usual).clamp(min=0)
        usual = torch.where(same, m.clamp(max=at.USUAL_MOST), 0.0)
        return trial._replace(
            usual=trial.usual + at.USUAL_SHARE * (usual - trial.usual),
            last=z,
            statistic=g,
            run=torch.where(g > at.SUSPECT, trial.run, 0.0),
        )

    def _judged(self, state: JointState, trial: TrialState) -> JointState:
        """The state after a trial began, was confirmed or dropped, or has another filter that predicts."""
        D, tries, leads = trial.evidence, trial.tried > 0, trial.leads > 0
        best = torch.where(tries, torch.maximum(trial.best, D), trial.best)
        confirmed = tries & (D > self.confirmed())
        lost = (self.dropped > D) | (best - self.fallen() > D) | (trial.tried > self.steps)
        dropped = tries & ~confirmed & lost
        above = ~tries & (trial.statistic > self.threshold()) & (state.updates > at.WARM)
        begins = above & (trial.run <= at.KEPT)
        on, ahead = begins | (tries & ~confirmed & ~lost), self.leads < D
        swaps = (confirmed & ~leads) | (dropped & leads) | (on & (ahead != leads))
        state = chosen(swaps, exchanged(state), state)
        trial = of(state)
        zero = torch.zeros_like(D)
        tried = torch.where(tries, trial.tried + 1, 1.0)
        goes_on = trial._replace(best=torch.where(tries, best, 0.0), tried=tried, leads=ahead.to(D.dtype))
        goes_on = goes_on._replace(early=(ahead & (at.TRUSTED >= D)).to(D.dtype))
        changed = ended(trial)._replace(changes=trial.changes + 1, since=zero, before=trial.kept)
        trial = chosen(on, goes_on, chosen(dropped | (above & ~begins), ended(trial), trial))
        return chosen(confirmed, anew(state)._replace(trial=changed), state._replace(trial=trial))


SWAPPED = ("mean", "factor", "noise", "updates")  # the leaves of a filter that has a second one
READINGS = ("learned", "readings", "weight", "reading", "spread")


def of(state: JointState) -> TrialState:
    """The trial of a filter that makes trials."""
    assert isinstance(state.trial, TrialState)
    return state.trial


def leaves_of(state: JointState) -> dict[str, Tensor]:
    """The leaves of the filter that predicts."""
    return {name: getattr(state, name) for name in SWAPPED}


def exchanged(state: JointState) -> JointState:
    """The state with the two filters in each other's place."""
    trial = of(state)
    other = {name: getattr(trial, name) for name in SWAPPED}
    return state._replace(**other, trial=trial._replace(**leaves_of(state)))


def chosen(mask: Tensor, new: Any, old: Any) -> Any:
    """`new` where `mask`, else `old`, of all leaves."""
    return tree_map(lambda x, y: x if x is y else where(mask, x, y), new, old)


def side_of(side: int, mean: Tensor) -> Tensor:
    """Which of the states are parameters of a side, those of d in (9), `(n,)`, bool."""
    n, k, e = mean.shape[-1], THETA + 3 + 3 * side, E + 1 + 3 * side
    own = torch.arange(n, device=mean.device)
    found = ((own >= k) & (own < k + 3)) | (own == KAPPA + side)
    return found | ((own >= e) & (own < e + 3)) if n > E + 1 else found


def ended(trial: TrialState) -> TrialState:
    """There is no trial, and nothing speaks for a change."""
    zero = torch.zeros_like(trial.run)
    return trial._replace(
        run=zero, tried=zero, leads=zero, early=zero, statistic=zero, last=zero, evidence=zero, best=zero
    )


def anew(state: JointState) -> JointState:
    """The periodic estimates begin."""
    zeros: dict[str, Any] = {name: torch.zeros_like(getattr(state, name)) for name in READINGS}
    return state._replace(**zeros)


def likelihood(step: Stepped) -> Tensor:
    """ℓ of (10)."""
    return -0.5 * (step.z * step.z).clamp(max=at.INNOVATION_MOST) - 0.5 * step.S.log()
