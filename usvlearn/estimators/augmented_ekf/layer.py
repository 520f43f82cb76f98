"""The steps that the joint EKF and the axis EKF share, in torch.

The equations are those of `usvlearn.estimators.joint.state`. m is the number of parameters.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeVar

import torch
from torch import Tensor

from usvlearn.core.samples import Inputs
from usvlearn.estimators.augmented_ekf import state as at
from usvlearn.estimators.augmented_ekf.state import B, FilterState, Y
from usvlearn.estimators.ud_factorization.layer import (
    added,
    measured,
    packed,
    projected,
    unit,
    variances,
)

if TYPE_CHECKING:
    from usvlearn.estimators.joint.state import JointState

State = TypeVar("State", "FilterState", "JointState")


def initial(first: Tensor, prior: Tensor, variance: Tensor) -> FilterState:
    """The leaves before the first step.

    Args:
        first: variances of what stands before the parameters in x, `(*batch, n − m)`.
        prior, variance: means and variances of the parameters, `(*batch, m)` or what broadcasts.
    """
    batch, zero = first.shape[:-1], torch.zeros_like(first[..., 0])
    wide = (*batch, prior.shape[-1])
    return FilterState(
        mean=torch.cat([torch.zeros_like(first), prior.expand(wide)], -1),
        factor=torch.diag_embed(torch.cat([first, variance.expand(wide)], -1)),
        noise=zero + at.NOISE**2,
        updates=zero,
        surge=zero,
        started=zero > 0,
        commands=torch.stack([zero, zero], -1),
        turn=zero,
        deviation=zero,
    )


def decay(dt: Tensor, time: Tensor) -> Tensor:
    """e^(−h/τ)."""
    return (-(dt / time).clamp(max=at.DECAYED)).exp()


def isolated(U: Tensor, D: Tensor, own: Tensor) -> tuple[Tensor, Tensor]:
    """The start of a segment: P without all that joins y and b to others, and with P_yy `own`, `(*batch,)`."""
    eye = _eye(D)
    first = torch.stack([own, variances(U, D)[..., B]], -1)
    return unit(U * (1 - eye[Y] - eye[B])[:, None]), torch.cat([first, D[..., 2:]], -1)


def moved(U: Tensor, D: Tensor, g: Tensor, decays: Tensor) -> tuple[Tensor, Tensor]:
    """F P Fᵀ, where F has the first row g and the decays on the rest of its diagonal.

    Args:
        U, D: of P.
        g: `(*batch, n)`.
        decays: `(*batch, n)`, the first 1.
    """
    first = (g[..., None] * U).sum(-2, keepdim=True) / decays[..., None, :]
    others = U[..., 1:, :] * decays[..., 1:, None] / decays[..., None, :]
    scales = torch.cat([g[..., :1], decays[..., 1:]], -1)
    return unit(torch.cat([first, others], -2)), D * scales * scales


def noisy(
    U: Tensor,
    D: Tensor,
    state: State,
    variance: Tensor,
    disturbance: Tensor,
    drift_time: Tensor,
    h: Tensor,
    moves: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """P after the noise of a step: of y, of b, and of one parameter where it is one's turn; and the next turn.

    Args:
        U, D: of P.
        state: before the step.
        variance: prior variances of the parameters, `(*batch, m)` or `(m,)`.
        disturbance, drift_time: q_b, T_θ.
        h: length of the step, s.
        moves: whether the boat is not at rest.
    """
    eye, span, m = _eye(D), h.clamp(max=at.LONGEST) / at.STEP, variance.shape[-1]
    U, D = added(U, D, eye[B], disturbance * state.noise * span)
    D = D + (at.OWN_NOISE * state.noise * span)[..., None] * eye[Y]
    walks = at.EVERY * torch.arange(m, dtype=D.dtype, device=D.device) == state.turn[..., None]
    share, own = at.EVERY * m * (at.STEP * span) / drift_time, variances(U, D)[..., -m:]
    grown = torch.minimum(share[..., None] * variance, (variance - own).clamp(min=0))
    growth = torch.where(walks & moves[..., None], grown, 0.0).sum(-1)
    before = torch.zeros_like(walks[..., :1]).expand(*walks.shape[:-1], D.shape[-1] - m)
    U, D = added(U, D, torch.cat([before, walks], -1).to(D.dtype), growth)
    return U, D, torch.where(state.turn + 1 < at.EVERY * m, state.turn + 1, 0.0)


def limited(U: Tensor, D: Tensor, ahead: Tensor) -> tuple[Tensor, Tensor]:
    """P where y⁺ is beyond its limit."""
    eye, beyond = _eye(D), ahead.abs() >= at.MOST
    U = torch.where(beyond[..., None, None], unit(U * (1 - eye[Y])[:, None]), U)
    return U, torch.where(beyond[..., None], torch.where(eye[Y] > 0, at.MOST**2, D), D)


def advanced(state: State, mean: Tensor, inputs: Inputs) -> State:
    """The state with x after a step, and its commands."""
    commands = torch.stack([inputs.command_left, inputs.command_right], -1)
    return state._replace(mean=mean, started=torch.zeros_like(state.started), commands=commands)


def corrected(
    state: State, U: Tensor, D: Tensor, f: Tensor, error: Tensor, outlier: Tensor, signs: Tensor, moves: Tensor
) -> tuple[State, Tensor]:
    """The state after a measurement, (5) to (7), and S.

    Args:
        state: after the time update.
        U, D: of its P.
        f: UᵀH, `(*batch, n)`.
        error: the innovation, `(*batch,)`.
        outlier: k.
        signs: each d of (7), `(…, n)`.
        moves: whether the boat is not at rest.
    """
    spread, noise = (D * f * f).sum(-1), state.noise
    square, S = error * error, spread + noise
    limit = outlier * outlier
    wild = square > limit * S
    U, D, gain, alpha = measured(U, D, f, torch.where(wild, square / limit - spread, noise))  # (5)
    mean = state.mean + gain * (error / alpha)[..., None]
    updates = state.updates + moves
    share = (1 / (updates + at.NOISE_COUNT)).clamp(min=at.NOISE_SHARE)
    heard = noise * (1 + share * ((square / S).clamp(max=at.NOISE_MOST) - 1))  # (6)
    for d in signs:
        mean = projected(mean, U, D, d)  # (7)
    mean = torch.cat([mean[..., :-1], mean[..., -1:].clamp(at.LAG_LEAST, at.LAG_MOST)], -1)
    noise = torch.where(moves, heard.clamp(min=at.NOISE_LEAST**2), noise)
    return state._replace(mean=mean, factor=packed(U, D), noise=noise, updates=updates), S


def _eye(D: Tensor) -> Tensor:
    return torch.eye(D.shape[-1], dtype=D.dtype, device=D.device)
