"""The ARX filter: its arguments, its first state, and its diagnostics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from usvlearn.core.hyperparameters import Hyper, Positive, as_tensor, check_broadcast
from usvlearn.core.protocol import KernelEstimator, describe
from usvlearn.errors import ConfigError, check_positive
from usvlearn.estimators.arx.state import FAMILY, MOST_LAGS, ARXState, deviations
from usvlearn.estimators.least_squares.state import NOISE


class ARX(KernelEstimator):
    """Predicts the increment of the speed from the last increments and commands; learns by a Kalman filter.

    The weights of outliers are those of West 1981; the filter is derived in `docs/theory/estimators.md`.

    Args:
        lags: L, the number of increments and of earlier commands that the prediction uses.
        even: adds four features that are the same forwards and backwards.
        turning: adds the yaw rate and its change.
        thrust_speed: adds each side's command times |v|.
        project: keeps the weights of the drag where drag slows the boat, so that open-loop simulations do not run away.
        scale: s, of the prior deviations of the weights, as multiples of the noise; broadcasts against the batch.
        walk: variance by which the weights walk in 0.4 s, as a share of the prior's; broadcasts against the batch.
        degrees: ν of Student's t distribution of the noise, no unit; broadcasts against the batch. None and infinity:
            Gaussian noise.
        surge_max: physical limit of the prediction, m/s.

    Raises:
        ConfigError: a number outside its range, or an option that is neither true nor false.

    >>> arx = ARX(lags=3)
    >>> len(arx.names), arx.init((8,)).factor.shape
    (27, torch.Size([8, 27, 27]))
    """

    ratios: Tensor  # (p,) prior deviations over `scale`

    frozen = FAMILY.frozen

    def __init__(
        self,
        lags: int = 3,
        even: bool = True,
        turning: bool = False,
        thrust_speed: bool = False,
        project: bool = True,
        scale: Hyper = 0.3,
        walk: Hyper = 3e-4,
        degrees: Hyper | None = 5.0,
        surge_max: float = 10.0,
    ):
        super().__init__()
        if isinstance(lags, bool) or not (isinstance(lags, int) and 0 <= lags <= MOST_LAGS):
            raise ConfigError(f"lags: found {lags!r}, expected a whole number, 0 … {MOST_LAGS}")
        options = {"even": even, "turning": turning, "thrust_speed": thrust_speed, "project": project}
        for name, value in options.items():
            if not isinstance(value, bool):
                raise ConfigError(f"{name}: found {value!r}, expected true or false")
        self.lags, self.even, self.turning, self.thrust_speed, self.project = lags, *options.values()
        self.surge_max = check_positive("surge_max", surge_max, "of m/s")
        self.scale, self.walk = Positive(scale, "scale", learnable=False), Positive(walk, "walk", learnable=False)
        degrees = None if isinstance(degrees, float) and degrees == math.inf else degrees
        self.degrees = None if degrees is None else Positive(degrees, "degrees", learnable=False)
        scales = deviations(lags, even, turning, thrust_speed)
        self.names = tuple(scales)
        self.register_buffer("ratios", as_tensor(list(scales.values())))

    def init(self, batch: Sequence[int] = ()) -> ARXState:
        check_broadcast(self, tuple(batch))
        p, zero = len(self.names), self.ratios.new_zeros(tuple(batch))
        zeros, noise = self.ratios.new_zeros((*batch, p)), torch.full_like(zero, NOISE**2)
        factor = torch.diag_embed(self.prior).expand(*batch, p, p)
        started = torch.ones_like(zero, dtype=torch.bool)
        return ARXState(zeros, factor, zeros, zero, noise, zero, zero, zero, started)

    def description(self) -> dict[str, Any]:
        return describe(FAMILY, self, size=len(self.names), tails=0.0 if self.degrees is None else 1 / self.degrees())

    def monitor(self, state: ARXState) -> dict[str, Tensor]:
        D, one = state.factor.diagonal(dim1=-2, dim2=-1), torch.eye(len(self.names), dtype=state.factor.dtype)
        U = state.factor.mT.triu(1) + one.to(state.factor.device)
        trace = (U * U * D[..., None, :]).sum(-1).sum(-1)  # of P = U D Uᵀ
        weights = dict(zip(self.names, state.theta.unbind(-1), strict=True))
        return {**weights, "covariance_trace": trace, "deviation": state.deviation}

    @property
    def prior(self) -> Tensor:
        """The diagonal of P₀, `(p,)` or `(*batch, p)`."""
        return (self.scale()[..., None] * self.ratios) ** 2
