"""Persistence in torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from usvlearn.core.protocol import Estimator, describe
from usvlearn.core.samples import Inputs
from usvlearn.estimators.baselines.persistence.state import FAMILY, PersistenceState


class Persistence(Estimator):
    """v⁺ = v, the baseline of every skill (`docs/theory/ensemble.md`, scores).

    >>> estimator = Persistence()
    >>> state = estimator.start(estimator.init(), torch.tensor(1.5))
    >>> estimator.predict(state, None)[1]
    tensor(1.5000)
    """

    rest: Tensor  # () 0, of the dtype and device of its states

    frozen = FAMILY.frozen

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("rest", torch.zeros((), dtype=torch.float64))

    def description(self) -> dict[str, Any]:
        return describe(FAMILY, self)

    def init(self, batch: Sequence[int] = ()) -> PersistenceState:
        return PersistenceState(self.rest.expand(tuple(batch)).clone())

    def predict(self, state: PersistenceState, inputs: Inputs) -> tuple[PersistenceState, Tensor]:
        return state, state.surge

    def update(self, state: PersistenceState, inputs: Inputs, surge: Tensor) -> PersistenceState:
        return PersistenceState(surge)

    def start(self, state: PersistenceState, surge: Tensor) -> PersistenceState:
        return PersistenceState(surge)
