"""Constant acceleration in torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from usvlearn.core.protocol import Estimator, describe
from usvlearn.core.samples import Inputs
from usvlearn.errors import check_positive
from usvlearn.estimators.baselines.acceleration.state import FAMILY, AccelerationState


class Acceleration(Estimator):
    """v⁺ = v + dt·surge_dot, with the acceleration between the last two measured speeds; a baseline of
    `docs/theory/ensemble.md`, scores.

    Args:
        surge_dot_max: physical limit of the acceleration, m/s².
        surge_max: physical limit of the prediction, m/s.

    Raises:
        ConfigError: a limit that is not positive.

    >>> estimator = Acceleration()
    >>> inputs = Inputs(*map(torch.tensor, (0.0, 0.0, 0.0, 0.0, 0.4)))
    >>> state = estimator.update(estimator.init(), inputs, torch.tensor(0.2))
    >>> estimator.predict(state, inputs)[1]
    tensor(0.4000, dtype=torch.float64)
    """

    rest: Tensor  # () 0, of the dtype and device of its states

    frozen = FAMILY.frozen

    def __init__(self, surge_dot_max: float = 2.0, surge_max: float = 10.0):
        super().__init__()
        self.surge_dot_max = check_positive("surge_dot_max", surge_dot_max, "of m/s²")
        self.surge_max = check_positive("surge_max", surge_max, "of m/s")
        self.register_buffer("rest", torch.zeros((), dtype=torch.float64))

    def description(self) -> dict[str, Any]:
        return describe(FAMILY, self)

    def init(self, batch: Sequence[int] = ()) -> AccelerationState:
        return AccelerationState(*(self.rest.expand(tuple(batch)).clone() for _ in range(4)))

    def predict(self, state: AccelerationState, inputs: Inputs) -> tuple[AccelerationState, Tensor]:
        surge = (state.surge + inputs.dt * state.surge_dot).clamp(-self.surge_max, self.surge_max)
        return state._replace(surge=surge, since=state.since + inputs.dt), surge

    def update(self, state: AccelerationState, inputs: Inputs, surge: Tensor) -> AccelerationState:
        since = state.since + inputs.dt
        surge_dot = (surge - state.measured) / torch.where(since > 0, since, 1.0)
        limited = surge_dot.clamp(-self.surge_dot_max, self.surge_dot_max)
        return AccelerationState(surge, limited, surge, torch.zeros_like(since))

    def start(self, state: AccelerationState, surge: Tensor) -> AccelerationState:
        zero = torch.zeros_like(surge)
        return AccelerationState(surge, zero, surge, zero)
