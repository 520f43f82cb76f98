"""The axis EKF: its arguments, its first state, and its diagnostics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from usvlearn.core.hyperparameters import Hyper, Positive, as_tensor, check_broadcast
from usvlearn.core.protocol import KernelEstimator, describe
from usvlearn.errors import ConfigError
from usvlearn.estimators.augmented_ekf.layer import initial
from usvlearn.estimators.augmented_ekf.state import FIRST_DISTURBANCE, NOISE, B, FilterState
from usvlearn.estimators.axis.state import FAMILY, SIZES, THETA, names


class AxisEKF(KernelEstimator):
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
        self.disturbance = Positive(disturbance, "disturbance", learnable=False)
        self.disturbance_time = Positive(disturbance_time, "disturbance_time", learnable=False)
        self.drift_time = Positive(drift_time, "drift_time", learnable=False)
        self.register_buffer("outlier", as_tensor(torch.inf if outlier is None else outlier, "outlier"))
        if not bool((self.outlier > 0).all()):
            raise ConfigError(f"outlier: found {self.outlier.tolist()}, expected a positive number of deviations")
        self.names = names(self.kind)
        self.register_buffer("prior", prior)
        self.register_buffer("scale", scale)

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

    def description(self) -> dict[str, Any]:
        return describe(FAMILY, self, kind=self.kind, size=SIZES[self.kind])

    def monitor(self, state: FilterState) -> dict[str, Tensor]:
        shown = dict(zip(self.names, state.mean[..., THETA:].unbind(-1), strict=True))
        return shown | {"disturbance": state.mean[..., B], "noise": state.noise.sqrt(), "deviation": state.deviation}


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
    tensor = as_tensor(value, name)
    if not bool((tensor > 0).all()):
        raise ConfigError(f"{name}: found {tensor.tolist()}, expected positive numbers")
    return tensor
