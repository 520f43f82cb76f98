"""What fault accommodation does to a joint EKF, in torch: (1) and (2) of `usvlearn.estimators.ensemble.accommodation`.

States are those of filters that make trials. Masks are bool, `(*batch,)`; shares of both sides `(*batch, 2)`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from usvlearn.core.samples import where
from usvlearn.estimators.joint.change_detection import anew, chosen, ended, of, side_of
from usvlearn.estimators.joint.state import KAPPA, THETA, E, JointState, W
from usvlearn.estimators.ud_factorization.layer import added, packed, rotated, unpacked


def keep_past(state: JointState, mask: Tensor) -> JointState:
    """The state in which, where `mask`, the filter that predicts is copied; the copy before becomes the older one."""
    trial = of(state)
    now = {"past_mean": state.mean, "past_factor": state.factor, "past_noise": state.noise}
    axis, kept = state.noise.dim(), {}
    for name, leaf in now.items():
        before = getattr(trial, name)
        copies = torch.stack([before.select(axis, 1), leaf], axis)
        kept[name] = where(mask, copies, before)
    return state._replace(trial=trial._replace(**kept))


def hand_over(state: JointState, mask: Tensor, shares: Tensor, loose: float, surge: Tensor) -> JointState:
    """(1) where `mask`, of every side whose share is not 1; `surge` is the measured speed, m/s."""
    trial, axis = of(state), state.noise.dim()
    mean, factor, noise = (
        getattr(trial, name).select(axis, 0) for name in ("past_mean", "past_factor", "past_noise")
    )  # fmt: skip
    given = state._replace(mean=torch.cat([state.mean[..., :THETA], mean[..., THETA:]], -1), factor=factor, noise=noise)
    for side in range(2):
        share = shares[..., side]
        given = chosen(share != 1, given_side(given, side, share, loose), given)
    return chosen(mask, begun_anew(given, surge), state)


def give_back(state: JointState, mask: Tensor, side: int, loose: float, surge: Tensor) -> JointState:
    """A side's thruster has recovered where `mask`."""
    return chosen(mask, begun_anew(given_side(state, side, torch.ones_like(surge), loose), surge), state)


def given_side(state: JointState, side: int, share: Tensor, loose: float) -> JointState:
    """A side's parameters are `share` times the older ones, and P grows along them."""
    past = of(state).past_mean.select(state.noise.dim(), 0)
    places = side_of(side, past)
    d = torch.where(places, past, 0.0)
    factor = packed(*added(*unpacked(state.factor), d, torch.full_like(share, loose * loose)))
    return state._replace(mean=torch.where(places, share[..., None] * past, state.mean), factor=factor)


def begun_anew(state: JointState, surge: Tensor) -> JointState:
    """A segment and the periodic estimates begin, without a trial."""
    trial = ended(of(state))
    return anew(state)._replace(trial=trial, surge=surge, started=torch.ones_like(state.started))


def thrust_left(state: JointState, side: int, scale: float, floor: float) -> tuple[Tensor, Tensor]:
    """(2): η_j and s_j, which is infinite where the older parameters push backwards, `(*batch,)` each."""
    trial, axis, w = of(state), state.noise.dim(), state.mean[..., W]
    a, one = torch.zeros_like(state.mean), torch.ones_like(w)
    k = THETA + 3 + 3 * side
    a[..., k], a[..., k + 1], a[..., k + 2], a[..., KAPPA + side] = one, one, w.abs(), one
    if state.mean.shape[-1] > E + 1:
        e = E + 1 + 3 * side
        a[..., e], a[..., e + 1], a[..., e + 2] = one, one, w
    past, old = trial.past_mean.select(axis, 0), trial.past_factor.select(axis, 0)
    before, now = (a * past).sum(-1), (a * state.mean).sum(-1)
    ahead = before > 0
    share = torch.where(ahead, now / torch.where(ahead, before, 1.0), 1.0)
    spread, doubt = (_variance(a, factor) for factor in (state.factor, old))
    square = (scale * scale * spread + (1 - share) ** 2 * doubt) / torch.where(ahead, before * before, 1.0)
    return share, torch.where(ahead, (square + floor * floor).sqrt(), torch.inf)


def _variance(a: Tensor, factor: Tensor) -> Tensor:
    """aᵀPa, `(*batch,)`."""
    U, D = unpacked(factor)
    f = rotated(U, a)
    return (D * f * f).sum(-1)
