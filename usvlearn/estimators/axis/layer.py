"""The axis EKF in torch: equations (1) to (4) of `state`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from usvlearn.core.hyperparameters import Hyper, Positive, as_tensor, check_broadcast
from usvlearn.core.protocol import Estimator, describe
from usvlearn.core.samples import Inputs, where
from usvlearn.errors import ConfigError
from usvlearn.estimators.augmented_ekf.layer import (
    advanced,
    corrected,
    decay,
    initial,
    isolated,
    limited,
    moved,
    noisy,
)
from usvlearn.estimators.augmented_ekf.state import FIRST_DISTURBANCE, LONGEST, MOST, NOISE, REST, B, FilterState, Y
from usvlearn.estimators.axis.state import CROSS, FAMILY, LINEAR, QUADRATIC, SIDE, SIZES, THETA, names
from usvlearn.estimators.regressors.layer import phi1
from usvlearn.estimators.ud_factorization.layer import packed, unpacked


class AxisEKF(Estimator):
    """Yaw rate or sway, a slow disturbance and the parameters in one extended Kalman filter; see `YawEKF`, `SwayEKF`.

    Derived in `docs/theory/identification.md#yaw-rate-and-sway`.

    Args:
        prior: mean of the parameters, `(m,)` or `(*batch, m)`.
        scale: their standard deviations, `(m,)` or `(*batch, m)`.
        disturbance: q_b, variance of the disturbance's noise in a step of 0.4 s, in units of σ²; broadcasts against the
            batch, as do the next three.
        disturbance_time: τ_b, s.
        drift_time: T_θ, s, after which the parameters' variance has grown by its prior.
        outlier: k, number of standard deviations beyond which a measurement is an outlier; None: none is.

    Raises:
        ConfigError: a number that must be positive is not.

    >>> from usvlearn import SwayEKF
    >>> isinstance(SwayEKF(surge_max=2.7), AxisEKF)
    True
    """

    kind: str
    prior: Tensor  # (m,) or (*batch, m)
    scale: Tensor
    outlier: Tensor
    signs: Tensor  # (3, n)

    frozen = FAMILY.frozen

    def __init__(
        self,
        prior: Tensor,
        scale: Tensor,
        disturbance: Hyper = 5.0,
        disturbance_time: Hyper = 1.0,
        drift_time: Hyper = 1e4,
        outlier: Hyper | None = 5.0,
    ):
        super().__init__()
        self.disturbance = Positive(disturbance, "disturbance")
        self.disturbance_time = Positive(disturbance_time, "disturbance_time")
        self.drift_time = Positive(drift_time, "drift_time")
        self.register_buffer("outlier", as_tensor(torch.inf if outlier is None else outlier, "outlier"))
        if not bool((self.outlier > 0).all()):
            raise ConfigError(f"outlier: found {self.outlier.tolist()}, expected a positive number of deviations")
        self.names = names(self.kind)
        self.register_buffer("prior", prior)
        self.register_buffer("scale", scale)
        self.register_buffer("signs", torch.eye(SIZES[self.kind], dtype=prior.dtype)[LINEAR : CROSS + 1])

    @property
    def variance(self) -> Tensor:
        """Prior variance of the parameters, `(m,)` or `(*batch, m)`."""
        return self.scale * self.scale

    def init(self, batch: Sequence[int] = ()) -> FilterState:
        batch = tuple(batch)
        check_broadcast(self, batch)
        zero = self.disturbance.log.new_zeros(batch)
        first = torch.stack([zero + NOISE**2, zero + FIRST_DISTURBANCE], -1)
        return initial(first, self.prior, self.variance)

    def predict(self, state: FilterState, inputs: Inputs) -> tuple[FilterState, Tensor]:
        after, predicted, *_ = self._advanced(state, inputs)
        return after, predicted

    def free_step(self, state: FilterState, inputs: Inputs) -> tuple[FilterState, Tensor]:
        """As `predict`, of the mean alone."""
        mean, predicted, *_ = self._ahead(state, inputs)
        return advanced(state, mean, inputs), predicted

    def update(self, state: FilterState, inputs: Inputs, surge: Tensor) -> FilterState:
        return self.learn(state, inputs, surge)[0]

    def learn(self, state: FilterState, inputs: Inputs, surge: Tensor) -> tuple[FilterState, Tensor]:
        ahead, predicted, U, D, f, moves = self._advanced(state, inputs)
        learned, _ = corrected(ahead, U, D, f, surge - predicted, self.outlier, self.signs, moves)
        jumps, again = inputs.dt > LONGEST, self.start(ahead, surge)
        return FilterState(*(where(jumps, new, old) for new, old in zip(again, learned, strict=True))), predicted

    def start(self, state: FilterState, surge: Tensor) -> FilterState:
        return state._replace(surge=surge, started=torch.ones_like(state.started))

    def description(self) -> dict[str, Any]:
        return describe(FAMILY, self, kind=self.kind, size=SIZES[self.kind])

    def monitor(self, state: FilterState) -> dict[str, Tensor]:
        shown = dict(zip(self.names, state.mean[..., THETA:].unbind(-1), strict=True))
        return shown | {"disturbance": state.mean[..., B], "noise": state.noise.sqrt(), "deviation": state.deviation}

    def _advanced(
        self, state: FilterState, inputs: Inputs
    ) -> tuple[FilterState, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The state after the time update, the prediction, U, D and f = UᵀH, and whether the boat was not at rest."""
        h, one = inputs.dt, torch.ones_like(inputs.dt)
        U, D = unpacked(state.factor)
        opened = isolated(U, D, state.noise)
        U, D = (where(state.started, new, old) for new, old in zip(opened, (U, D), strict=True))
        mean, predicted, ahead, g, y, slow = self._ahead(state, inputs)
        moves = inputs[0] ** 2 + inputs[1] ** 2 + inputs.yaw_rate**2 + y * y > REST
        g = torch.cat([g[..., :THETA], torch.where(moves[..., None], g[..., THETA:], 0.0)], -1)
        U, D = moved(U, D, g, torch.stack([one, slow, *[one] * len(self.names)], -1))
        U, D, turn = noisy(U, D, state, self.variance, self.disturbance(), self.drift_time(), h, moves)
        U, D = limited(U, D, ahead)
        f = U[..., Y, :]
        deviation = ((D * f * f).sum(-1) + state.noise).sqrt()
        after = advanced(state, mean, inputs)._replace(factor=packed(U, D), turn=turn, deviation=deviation)
        return after, predicted, U, D, f, moves

    def _ahead(self, state: FilterState, inputs: Inputs) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """x after (3), the prediction, y⁺, its gradient, the y from which it departs, and the decay of b."""
        y = torch.where(state.started, state.surge, state.mean[..., Y])
        b = torch.where(state.started, 0.0, state.mean[..., B])
        before = where(state.started, torch.stack([inputs[0], inputs[1]], -1), state.commands)
        ahead, g = flow(self.kind == "yaw", state.mean, y, b, before, inputs)
        slow = decay(inputs.dt, self.disturbance_time())
        predicted = ahead.clamp(-MOST, MOST)
        mean = torch.cat([torch.stack([predicted, b * slow], -1), state.mean[..., THETA:]], -1)
        return mean, predicted, ahead, g, y, slow


def flow(yaw: bool, mean: Tensor, y: Tensor, b: Tensor, before: Tensor, inputs: Inputs) -> tuple[Tensor, Tensor]:
    """y⁺ of (3), `(*batch,)`, and its gradient g to x, `(*batch, n)`.

    Args:
        yaw: whether y is the yaw rate.
        mean: x, `(*batch, n)`.
        y, b: from which it departs.
        before: commands of the step before, `(*batch, 2)`.
        inputs: of the step (`axis_inputs`).
    """
    left, right, other, u, h = inputs
    commands, mu = torch.stack([left, right], -1), mean[..., -1:]
    xi = (1 - mu) * commands + mu * before
    a, sign, along, zero = xi.abs(), torch.where(xi >= 0, 1.0, -1.0), u.abs(), torch.zeros_like(y)
    by_parameter = [zero + 1, y, y * y.abs(), along * y, u * other, other, u + zero]
    by_own = [zero, zero + 1, 2 * y.abs(), along + zero, zero, zero, zero]
    slope = zero[..., None]
    for side in range(2):
        x, size = xi[..., side], a[..., side]
        own = [x, x * size] + ([x * along, x**3, size, x * x] if yaw else [])
        slopes = [zero + 1, 2 * size]
        if yaw:
            slopes += [along + zero, 3 * x * x, sign[..., side], 2 * x]
        theta = mean[..., SIDE + len(own) * side : SIDE + len(own) * (side + 1)]
        slope = torch.cat([slope, (torch.stack(slopes, -1) * theta).sum(-1, keepdim=True)], -1)
        by_parameter += own
        by_own += [zero] * len(own)
    rows, own_rows, theta = torch.stack(by_parameter, -1), torch.stack(by_own, -1), mean[..., THETA:-1]
    f, J = (rows * theta).sum(-1) + b, (own_rows * theta).sum(-1)
    z = (h * J).clamp(max=1)
    value, bend = phi1(z)
    by_f, by_J = h * value, h * h * bend * f
    own = 1 + z * value + by_J * 2 * mean[..., QUADRATIC] * torch.where(y >= 0, 1.0, -1.0)
    late = ((before - commands) * slope[..., 1:]).sum(-1)
    others = by_f[..., None] * rows + by_J[..., None] * own_rows
    g = torch.cat([torch.stack([own, by_f], -1), others, (by_f * late)[..., None]], -1)
    return y + by_f * f, g


class YawEKF(AxisEKF):
    """The axis EKF of the yaw rate.

    The prior is a boat whose full differential thrust (left ahead, right astern) turns it to starboard, at `turn_max`
    after some seconds.

    Derived in `docs/theory/identification.md`.

    Args:
        surge_max: top speed, m/s.
        turn_max: yaw rate at full differential thrust, rad/s; 0.3 to 3 times the true one does.
        **options: the last four arguments of `AxisEKF`.

    >>> yaw = YawEKF(surge_max=2.7)
    >>> yaw.init((8,)).mean.shape
    torch.Size([8, 22])
    """

    kind = "yaw"
    TIME = 1.0  # s, time constant of the prior's boat

    def __init__(self, surge_max: Hyper, turn_max: Hyper = 1.0, **options: Any):
        u, r = torch.broadcast_tensors(positive("surge_max", surge_max), positive("turn_max", turn_max))
        zero, push = 0 * r, 0.75 * r / self.TIME
        prior = [zero, zero - 0.5 / self.TIME, -0.25 / (self.TIME * r), *[zero] * 4]
        scale = [0.1 * push, zero + 0.5 / self.TIME, 0.5 / (self.TIME * r), 0.5 / (self.TIME * u), 1 / u, zero + 1,
                 0.1 * push / u]  # fmt: skip
        for side in (1, -1):
            prior += [side * push / 2, side * push / 2, *[zero] * 4]
            scale += [push, push, 0.5 * push / u, push, 0.2 * push, 0.2 * push]
        prior, scale = [*prior, zero + 0.1], [*scale, zero + 0.3]
        super().__init__(torch.stack(prior, -1), torch.stack(scale, -1), **options)

    description = AxisEKF.description  # a subclass states its own, see `Estimator.description`


class SwayEKF(AxisEKF):
    """The axis EKF of the sway through the water.

    Derived in `docs/theory/identification.md`.

    Args:
        surge_max: top speed, m/s.
        **options: the last four arguments of `AxisEKF`.

    >>> SwayEKF(surge_max=2.7).init((8,)).mean.shape
    torch.Size([8, 14])
    """

    kind = "sway"
    TIME = 1.0  # s

    def __init__(self, surge_max: Hyper, **options: Any):
        u = positive("surge_max", surge_max)
        zero, most = 0 * u, 0.3 * u
        prior = [zero, zero - 0.5 / self.TIME, zero, zero, zero - 0.3, *[zero] * 6, zero + 0.1]
        scale = [zero + 0.02, zero + 0.5 / self.TIME, 0.5 / most, 0.5 / u, zero + 0.5, zero + 0.2, zero + 0.05,
                 *[zero + 0.1] * 4, zero + 0.3]  # fmt: skip
        super().__init__(torch.stack(prior, -1), torch.stack(scale, -1), **options)

    description = AxisEKF.description  # a subclass states its own, see `Estimator.description`


def positive(name: str, value: Hyper) -> Tensor:
    """A positive number or tensor, or a ConfigError."""
    found = as_tensor(value, name)
    if not bool((found > 0).all()):
        raise ConfigError(f"{name}: found {found.tolist()}, expected positive numbers")
    return found
