"""Memory of the step before, in torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor

from usvlearn.core.protocol import Estimator, check_estimator, numbers_of, spec_of
from usvlearn.core.samples import Inputs, named_leaves
from usvlearn.errors import check_positive
from usvlearn.estimators.regressors.layer import MemoryInputs
from usvlearn.estimators.wrappers.memory.state import FAMILY, MemoryState


class WithMemory(Estimator):
    """An estimator whose model has memory terms.

    Where a segment starts, the last acceleration is 0 and the last commands equal the present ones. Where the estimator
    coasts, the acceleration is that of its own estimate.

    Derived in `docs/theory/estimators.md`.

    Args:
        estimator: AID, RLS or SIFtRLS over `SurgeDynamics(memory=True)`.
        surge_dot_max: physical limit of the acceleration, m/s².

    Raises:
        ConfigError: no estimator, or a limit that is not positive.

    >>> from usvlearn import AID, SurgeDynamics
    >>> estimator = WithMemory(AID(model=SurgeDynamics(28.0, memory=True)))
    >>> estimator.init((3,)).inner.theta.shape
    torch.Size([3, 12])
    """

    def __init__(self, estimator: Estimator, surge_dot_max: float = 2.0):
        super().__init__()
        self.estimator = check_estimator("estimator of WithMemory", estimator)
        self.surge_dot_max = check_positive("surge_dot_max", surge_dot_max, "of m/s²")

    def init(self, batch: Sequence[int] = ()) -> MemoryState:
        inner = self.estimator.init(batch)
        zero = next(leaf for _, leaf in named_leaves(inner)).new_zeros(tuple(batch))
        known = torch.zeros_like(zero, dtype=torch.bool)
        return MemoryState(inner, zero, zero, zero, zero, zero, zero, known)

    def predict(self, state: MemoryState, inputs: Inputs) -> tuple[MemoryState, Tensor]:
        inner, surge = self.estimator.predict(state.inner, self._with_memory(state, inputs))
        return self._coasted(state, inputs, surge)._replace(inner=inner), surge

    @property
    def frozen(self) -> tuple[str, ...] | None:  # type: ignore[override]  # of the estimator within
        inner = self.estimator.frozen
        return None if inner is None else (*(f"inner.{name}" for name in inner), *(FAMILY.frozen or ()))

    def open_loop(self, state: MemoryState) -> MemoryState:
        return state._replace(inner=self.estimator.open_loop(state.inner))

    def free_step(self, state: MemoryState, inputs: Inputs) -> tuple[MemoryState, Tensor]:
        inner, surge = self.estimator.free_step(state.inner, self._with_memory(state, inputs))
        return self._coasted(state, inputs, surge)._replace(inner=inner), surge

    def update(self, state: MemoryState, inputs: Inputs, surge: Tensor) -> MemoryState:
        return self.learn(state, inputs, surge)[0]

    def learn(self, state: MemoryState, inputs: Inputs, surge: Tensor) -> tuple[MemoryState, Tensor]:
        inner, predicted = self.estimator.learn(state.inner, self._with_memory(state, inputs), surge)
        stepped = self._stepped(state, inputs)
        surge_dot = self._limited(surge - state.surge, stepped.since)
        since = torch.zeros_like(surge)
        return stepped._replace(inner=inner, surge_dot=surge_dot, surge=surge, since=since, estimate=surge), predicted

    def start(self, state: MemoryState, surge: Tensor) -> MemoryState:
        zero = torch.zeros_like(surge)
        known = torch.zeros_like(state.known)
        inner = self.estimator.start(state.inner, surge)
        return state._replace(inner=inner, surge_dot=zero, surge=surge, since=zero, estimate=surge, known=known)

    def inflate_covariance(self, state: MemoryState, factor: Tensor) -> MemoryState:
        return state._replace(inner=self.estimator.inflate_covariance(state.inner, factor))

    def description(self) -> dict[str, Any] | None:
        inner = spec_of(self.estimator)
        return inner and {"kind": "memory", "inner": inner, "numbers": numbers_of(FAMILY.numbers, self)}

    def monitor(self, state: MemoryState) -> dict[str, Tensor]:
        return self.estimator.monitor(state.inner)

    def _with_memory(self, state: MemoryState, inputs: Inputs) -> Inputs:
        left = torch.where(state.known, state.command_left, inputs.command_left)
        right = torch.where(state.known, state.command_right, inputs.command_right)
        with_memory = MemoryInputs(*inputs, state.surge_dot, left, right)
        return cast(Inputs, with_memory)  # which has the fields of `Inputs`, but cannot inherit them: a NamedTuple

    def _limited(self, change: Tensor, dt: Tensor) -> Tensor:
        return (change / torch.where(dt > 0, dt, 1.0)).clamp(-self.surge_dot_max, self.surge_dot_max)

    def _coasted(self, state: MemoryState, inputs: Inputs, surge: Tensor) -> MemoryState:
        surge_dot = self._limited(surge - state.estimate, inputs.dt)
        return self._stepped(state, inputs)._replace(surge_dot=surge_dot, estimate=surge)

    def _stepped(self, state: MemoryState, inputs: Inputs) -> MemoryState:
        return state._replace(
            since=state.since + inputs.dt,
            command_left=inputs.command_left,
            command_right=inputs.command_right,
            known=torch.ones_like(state.known),
        )
