"""The inputs of a step by name, for models of other libraries, and estimators that make many steps in one call."""

from __future__ import annotations

import abc
from typing import Any, NamedTuple

import torch
from torch import Tensor

from usvlearn.core.protocol import Estimator, State, Step
from usvlearn.core.samples import Inputs


class X(NamedTuple):
    """The inputs of a model: numbers, arrays or tensors of one shape."""

    speed: Any  # m/s, from which the step departs: the measured one; where none was, the predicted one
    left: Any  # commands, shares of full scale
    right: Any
    mean: Any  # of both commands,
    mean_square: Any  # and of their squares with the commands' signs: thrust grows so
    sin: Any  # of the heading
    cos: Any
    yaw_rate: Any  # rad/s
    dt: Any  # s


def x_of(speed: Any, inputs: Inputs) -> X:
    """The inputs of a model that departs from a speed, m/s; tensors of one shape."""
    left, right, heading, yaw_rate, dt = inputs
    square = (left * left.abs() + right * right.abs()) / 2
    return X(speed, left, right, (left + right) / 2, square, heading.sin(), heading.cos(), yaw_rate, dt)


class Stretched(Estimator):
    """An estimator that makes steps `(time, *batch)` in one call, `stretch`; single steps are stretches of one.

    Its state has the leaf `surge`, from which the next step departs, m/s.
    """

    rest: Tensor  # () 0, of the dtype of its states

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("rest", torch.zeros((), dtype=torch.float64))

    @abc.abstractmethod
    def stretch(self, state: Any, steps: Step) -> tuple[Any, Tensor]:
        """The state after all steps, and predictions, m/s, `(time, *batch)`, NaN where none was; or a MemberError."""

    def start(self, state: Any, surge: Tensor) -> State:
        return state._replace(surge=surge.clone())

    def predict(self, state: Any, inputs: Inputs) -> tuple[State, Tensor]:
        return self.learn(state, inputs, None)

    def update(self, state: Any, inputs: Inputs, surge: Tensor) -> State:
        return self.learn(state, inputs, surge)[0]

    def learn(self, state: Any, inputs: Inputs, surge: Tensor | None) -> tuple[State, Tensor]:
        batched, yes = Inputs(*(x[None] for x in inputs)), torch.ones_like(inputs.dt, dtype=torch.bool)[None]
        target, no = torch.zeros_like(inputs.dt) if surge is None else surge, torch.zeros_like(yes)
        state, predicted = self.stretch(state, Step(batched, target[None], yes, no if surge is None else yes, no))
        return state, predicted[0]


def columns_of(steps: Step) -> tuple[Tensor, Tensor]:
    """What a stretch of several vehicles reads: `X` with the measured speed behind, `(time, vehicles, 10)`, and modes.

    The modes are those of prepared samples, `(time, vehicles)`: 0 nothing, 1 a start, 2 predict, 3 predict and learn.
    """
    mode = torch.where(steps.learns, 3, torch.where(steps.steps, 2, torch.where(steps.starts, 1, 0)))
    wide = torch.stack([*x_of(torch.zeros_like(steps.surge), steps.inputs), steps.surge], -1)
    return wide.reshape(len(wide), -1, wide.shape[-1]), mode.reshape(len(mode), -1)
