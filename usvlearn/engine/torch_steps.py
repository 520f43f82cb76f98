"""Single steps of one state by torch, for estimators without compiled code, and the choice between the two."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from usvlearn.core.forecasts import NONE
from usvlearn.core.protocol import EVERY, Estimator, Kinds, State, Step, advance, clean
from usvlearn.core.samples import Inputs, Sample, check_inputs, check_sample, one_number, tree_map
from usvlearn.engine.backend import array_of, arrays_of, is_transformed, tensors_in, tree_of
from usvlearn.errors import ConfigError


class TorchStepper:
    """The steps of one state by torch, without gradients, on numbers of any type; as `CompiledStepper`."""

    def __init__(self, estimator: Estimator, batch: Sequence[int]):
        self.estimator, self.batch = estimator, tuple(batch)
        self.state = tree_map(Tensor.detach, estimator.init(batch))
        self._like = next(leaf for leaf in tensors_in(self.state) if leaf.is_floating_point())

    @property
    def leaves(self) -> dict[str, np.ndarray]:
        return arrays_of(self.state)

    @leaves.setter
    def leaves(self, leaves: dict[str, np.ndarray]) -> None:
        self.state = self.tree(leaves)

    def tree(self, leaves: dict[str, np.ndarray]) -> Any:
        """A state like its own, from leaves by dotted name."""
        return tree_of(self.state, leaves, self._like.device)

    @torch.no_grad()
    def predict(self, inputs: Inputs) -> float | np.ndarray:
        check_inputs(inputs, self.batch)
        return _plain(self.estimator.predict(self.state, Inputs(*map(self._wide, inputs)))[1])

    @torch.no_grad()
    def step(self, sample: Sample) -> float | np.ndarray:
        check_sample(sample, self.batch)
        inputs, surge, *given = sample
        known = (self._wide(mask, torch.bool) for mask in given)
        sample = Sample(Inputs(*map(self._wide, inputs)), self._wide(surge), *known)
        step = clean(sample, self.estimator.surge_limit)
        masks = step.learns, step.steps & ~step.learns, step.starts, ~(step.steps | step.starts)
        some = Kinds(*(bool(mask.any()) for mask in masks))
        self.state, predicted = advance(self.estimator, self.state, step, some)
        return _plain(predicted)

    def leaf(self, name: str) -> np.ndarray:
        return self.leaves[name]

    def last_predictions(self) -> tuple[np.ndarray, np.ndarray]:
        return self._pair(self.state)

    @torch.no_grad()
    def predict_members(self, inputs: Inputs) -> tuple[np.ndarray, np.ndarray]:
        check_inputs(inputs, self.batch)
        return self._pair(self.estimator.predict(self.state, Inputs(*map(self._wide, inputs)))[0])

    @staticmethod
    def _pair(state: Any) -> tuple[np.ndarray, np.ndarray]:
        return array_of(state.predictions), array_of(state.halfwidths)

    @torch.no_grad()
    def forecast(self, inputs: Inputs) -> tuple[np.ndarray, np.ndarray]:
        estimator: Any = self.estimator
        if not hasattr(estimator, "forecast"):
            raise ConfigError(NONE)
        plan = Inputs(*(torch.tensor(x, dtype=self._like.dtype, device=self._like.device) for x in inputs))
        surge, width = estimator.forecast(self.state, plan)
        return array_of(surge), array_of(width)

    def _wide(self, value: Any, dtype: torch.dtype | None = None) -> Tensor:
        like = self._like
        return torch.as_tensor(one_number(value), dtype=dtype or like.dtype, device=like.device).expand(self.batch)


def walk(estimator: Estimator, state: State, steps: Step) -> Iterator[tuple[State, Tensor]]:
    """All steps by torch, leaves `(time, *batch)`: the state after each, and the prediction, m/s, `(*batch,)`."""
    holds = ~(steps.steps | steps.starts)
    kinds = steps.learns, steps.steps & ~steps.learns, steps.starts, holds
    occur = torch.stack([mask.reshape(len(mask), -1).any(1) for mask in kinds], 1)
    # Read once for all steps, because reading waits for an accelerator; where there are no values, all are assumed.
    known = not occur.is_meta and not is_transformed(occur)
    some = [Kinds(*each) for each in occur.tolist()] if known else [EVERY] * len(occur)
    inputs = zip(*(x.unbind(0) for x in steps.inputs), strict=True)
    for values, *others, kind in zip(inputs, *(x.unbind(0) for x in steps[1:]), some, strict=True):
        state, surge = advance(estimator, state, Step(Inputs(*values), *others), kind)
        yield state, surge


def _plain(predicted: Tensor) -> float | np.ndarray:
    return array_of(predicted) if predicted.ndim else predicted.item()
