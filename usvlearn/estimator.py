"""The online-step protocol: state in, state out; predict before you learn."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, final

import torch
from torch import Tensor, nn

from usvlearn.errors import ConfigError, ShapeError
from usvlearn.signals import ABSURD, ABSURD_INPUTS, Inputs, Sample, named_leaves, tree_map, where

State = Any  # a tree (signals.py) of tensors with leaves (*batch, ...)


class Estimator(nn.Module, abc.ABC):
    """Predicts the surge speed one step ahead and learns from what was then measured.

    Three kinds of number: what is identified online lives in the *state* and is never written to `self`; what is
    tuned is a *hyperparameter* (`Positive`, `UnitInterval`), learnable by gradient and broadcast against the batch;
    what is known is a *constant* (a buffer). Every method is pure, so one object serves any batch of vehicles.

    A new estimator defines `init`, `predict` and `update`, `start` if its state remembers a speed, and `monitor` if
    there is something to watch.
    """

    @abc.abstractmethod
    def init(self, batch: Sequence[int] = ()) -> State:
        """The state before the first sample, leaves `(*batch, ...)`."""

    @abc.abstractmethod
    def predict(self, state: State, inputs: Inputs) -> tuple[State, Tensor]:
        """Time update: the state one step on, without learning, and the predicted surge, m/s, `(*batch,)`."""

    @abc.abstractmethod
    def update(self, state: State, inputs: Inputs, surge: Tensor) -> State:
        """Measurement update by `surge`, m/s, from the state that was given to `predict`."""

    def start(self, state: State, surge: Tensor) -> State:
        """The state with `surge`, m/s, as the speed from which the next step departs; nothing is learned."""
        return state

    def loosen(self, state: State, factor: Tensor) -> State:
        """The state, `factor` times as open to new samples (a covariance inflated); by default what it is."""
        return state

    def learn(self, state: State, inputs: Inputs, surge: Tensor) -> tuple[State, Tensor]:
        """A step on which nothing is masked: `update`'s state and `predict`'s surge.

        For an estimator whose `update` has predicted already to say so; no other result is allowed.
        """
        return self.update(state, inputs, surge), self.predict(state, inputs)[1]

    def kernel(self) -> dict[str, Any] | None:
        """What the compiled kernels need to know to make these steps (`kernels.plan`); None: torch makes them.

        It speaks for this very class: a subclass, whose steps may be others, has none unless it says so itself.
        """
        return None

    def monitor(self, state: State) -> dict[str, Tensor]:
        """What a person wants to see of a state, by name: physical parameters, margins; `(*batch,)` each."""
        return {}

    @final
    def forward(self, state: State, sample: Sample) -> tuple[State, Tensor]:
        """Learn where measured, coast where not, hold where stale, take the speed where a segment starts.

        Returns the next state and the predicted surge, m/s, `(*batch,)`: NaN where no step was made.
        """
        step = clean(sample)
        coasted, surge = self.predict(state, step.inputs)
        target = torch.where(step.learns, step.surge, surge.detach())
        learned = self.update(state, step.inputs, target)
        started = self.start(state, step.surge)

        def choose(learned: Tensor, coasted: Tensor, started: Tensor, held: Tensor) -> Tensor:
            return where(step.learns, learned, where(step.steps, coasted, where(step.starts, started, held)))

        return tree_map(choose, learned, coasted, started, state), torch.where(step.steps, surge, math.nan)


def described(part: Any) -> dict[str, Any] | None:
    """What `kernel` of an estimator, or of a part of one, says; None where its class says nothing.

    >>> from usvlearn import Persistence
    >>> described(Persistence())["kind"]
    'persistence'
    """
    return part.kernel() if "kernel" in vars(type(part)) else None


def check_estimator(name: str, value: Any) -> Estimator:
    """Return `value` if it is an estimator, else raise a ConfigError."""
    if not isinstance(value, Estimator):
        raise ConfigError(f"{name}: found {value!r}, expected an estimator")
    return value


class Step(NamedTuple):
    """A sample in which nothing can do harm, and what is to be made of it. Leaves are `(*batch,)`."""

    inputs: Inputs  # 0 where no step is made
    surge: Tensor  # m/s, 0 where it is not known
    steps: Tensor  # bool: predict
    learns: Tensor  # bool: and learn
    starts: Tensor  # bool: take the speed


def clean(sample: Sample) -> Step:
    """Replace whatever stands in a masked sample before it is computed with: NaN would reach the gradients.

    What is not finite, or beyond all measure, counts as missing.
    """
    known, dt = sample.surge.abs() < ABSURD, sample.inputs.dt
    steps = sample.fresh & (dt > 0)
    for x, limit in zip(sample.inputs, ABSURD_INPUTS, strict=True):
        steps = steps & (x.abs() < limit)
    inputs = Inputs(*(torch.where(steps, x, 0.0) for x in sample.inputs))
    surge = torch.where(known, sample.surge, 0.0)
    return Step(inputs, surge, steps, steps & sample.measured & known, (dt == 0) & known)


def rollout(
    estimator: Estimator,
    state: State,
    samples: Sample,
    record: Callable[[State], Any] | None = None,
    detach_every: int | None = None,
) -> tuple[State, Tensor, Any]:
    """Run an estimator over samples, predicting before learning.

    Args:
        estimator: any `Estimator`.
        state: the state to start from, leaves `(*batch, ...)`.
        samples: leaves `(time, *batch)`, of the estimator's dtype.
        record: picks a tree of tensors from each new state (parameters, members' predictions).
        detach_every: truncates back-propagation every so many steps.

    Returns:
        The last state; the predictions, m/s, `(time, *batch)`; what `record` picked, stacked over time (or None).

    Raises:
        ShapeError: the samples' dtype or batch does not fit the state.

    >>> from usvlearn import AID, Inputs, Sample
    >>> t = torch.ones(50, dtype=torch.float64)
    >>> samples = Sample(Inputs(t, t, 0 * t, 0 * t, 0.4 * t), 1.5 * t, t > 0, t > 0)
    >>> aid = AID(mass=28.0)
    >>> state, surge, _ = rollout(aid, aid.init(), samples)
    >>> abs(float(surge[-1].detach()) - 1.5) < 0.01
    True
    """
    _check(state, samples)
    learns = clean(samples).learns
    all_learn = learns.reshape(len(learns), -1).all(1).tolist()
    predictions, records = [], []
    for k, sample in enumerate(_unbind(samples)):
        if detach_every and k % detach_every == 0:
            state = tree_map(Tensor.detach, state)
        if all_learn[k]:  # what forward comes to when no lane is masked
            state, surge = estimator.learn(state, sample.inputs, sample.surge)
        else:
            state, surge = estimator(state, sample)
        predictions.append(surge)
        if record is not None:
            records.append(record(state))
    return state, torch.stack(predictions), (stack(records) if records else None)


def simulate(
    estimator: Estimator, state: State, samples: Sample, record: Callable[[State], Any] | None = None
) -> tuple[State, Tensor, Any]:
    """Run an estimator free: from the inputs alone, learning nothing; the speed is told where a segment starts.

    Args:
        estimator, state, samples, record: as of `rollout`; `samples.surge` counts only where `inputs.dt` is 0.

    Returns:
        As `rollout`. What `record` picks of a step that was not made is of the step before.

    Raises:
        ShapeError: as `rollout`.

    >>> from usvlearn import AID, Inputs, Sample
    >>> t = torch.ones(50, dtype=torch.float64)
    >>> samples = Sample(Inputs(t, t, 0 * t, 0 * t, 0.4 * t), 1.5 * t, t > 0, t > 0)
    >>> aid = AID(mass=28.0)
    >>> float(simulate(aid, aid.init(), samples)[1][-1])  # it has learned nothing, whatever was measured
    0.0
    """
    _check(state, samples)
    steps = clean(samples)
    all_step = steps.steps.reshape(len(steps.steps), -1).all(1).tolist()
    predictions, records = [], []
    for k, step in enumerate(_unbind(steps)):
        coasted, surge = estimator.predict(state, step.inputs)
        if all_step[k]:
            state = coasted
        else:
            state = tree_map(
                lambda coasted, started, held, step=step: where(step.steps, coasted, where(step.starts, started, held)),
                coasted,
                estimator.start(state, step.surge),
                state,
            )
            surge = torch.where(step.steps, surge, math.nan)
        predictions.append(surge)
        if record is not None:
            records.append(record(state))
    return state, torch.stack(predictions), (stack(records) if records else None)


def stack(trees: Sequence[Any]) -> Any:
    """Trees of tensors as one, with a first axis that counts them.

    >>> stack([{"theta": torch.zeros(2)}, {"theta": torch.ones(2)}])["theta"].shape
    torch.Size([2, 2])
    """
    return tree_map(lambda *leaves: torch.stack(leaves), *trees)


def _unbind(samples: Sample | Step) -> Iterator[Any]:
    """What belongs to each time, one after the other."""
    inputs = zip(*(x.unbind(0) for x in samples.inputs), strict=True)
    for x, *y in zip(inputs, *(y.unbind(0) for y in samples[1:]), strict=True):
        yield type(samples)(Inputs(*x), *y)


def _check(state: State, samples: Sample) -> None:
    """Raise a ShapeError unless the samples fit each other and the state."""
    expected, dtype = samples.surge.shape, getattr(samples.surge, "dtype", None)
    for name, leaf in named_leaves(samples):
        if not isinstance(leaf, Tensor):
            raise ShapeError(f"samples: {name} is {type(leaf).__name__}, expected a torch tensor: use torch.as_tensor")
        if leaf.shape != expected or len(expected) == 0 or len(leaf) == 0:
            raise ShapeError(
                f"samples: {name} has the shape {tuple(leaf.shape)}, surge {tuple(expected)}: expected (time, "
                "*batch), of at least one step, the same for all"
            )
        wanted = torch.bool if name in ("fresh", "measured") else dtype
        if leaf.dtype != wanted:
            raise ShapeError(f"samples: {name} is {leaf.dtype}, expected {wanted}: convert it with .to({wanted})")
    batch = tuple(expected[1:])
    for name, leaf in named_leaves(state):
        if leaf.is_floating_point() and leaf.dtype != dtype:
            raise ShapeError(
                f"samples are {dtype}, the state's {name} is {leaf.dtype}: convert the estimator with .to({dtype}) "
                "before init, or the samples"
            )
        if tuple(leaf.shape[: len(batch)]) != batch:
            raise ShapeError(
                f"samples have the batch {batch}, the state's {name} has the shape {tuple(leaf.shape)}: "
                f"make the state with estimator.init({batch})"
            )
