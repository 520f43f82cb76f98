"""The online-step protocol: state in, state out; predict before you learn."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, final

import torch
from torch import Tensor, nn

from usvlearn.backend import Record, choose, run, stack
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

    Attributes:
        surge_limit: a measured speed at or beyond it, m/s, counts as missing.
    """

    surge_limit: float = ABSURD

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
        return _advance(self, state, clean(sample, self.surge_limit), EVERY)


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


class Kinds(NamedTuple):
    """Which of the four happens to some lane in a step."""

    learns: bool
    coasts: bool
    starts: bool
    holds: bool


EVERY = Kinds(True, True, True, True)


def clean(sample: Sample, surge_limit: float = ABSURD) -> Step:
    """Replace whatever stands in a masked sample before it is computed with: NaN would reach the gradients.

    What is not finite, or beyond all measure, counts as missing; so does a speed at `surge_limit`, m/s, and beyond.
    """
    known, dt = sample.surge.abs() < surge_limit, sample.inputs.dt
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
    record: Record | None = None,
    detach_every: int | None = None,
    backend: str = "auto",
) -> tuple[State, Tensor, Any]:
    """Run an estimator over samples, predicting before learning.

    Args:
        estimator: any `Estimator`.
        state: the state to start from, leaves `(*batch, ...)`.
        samples: leaves `(time, *batch)`, of the estimator's dtype.
        record: names of leaves of the state (`named_leaves`), or a function that picks a tree of tensors from each new
            state.
        detach_every: truncates back-propagation every so many steps.
        backend: "kernel" makes the steps by compiled code, which has no gradients; "torch" by torch; "auto" by
            compiled code where no gradient is asked for, all is on the CPU, and the estimator has a kernel.

    Returns:
        The last state; the predictions, m/s, `(time, *batch)`; what `record` names or picked, stacked over time (or
        None).

    Raises:
        ShapeError: the samples' dtype or batch does not fit the state.
        ConfigError: `backend="kernel"` where that cannot be.

    >>> from usvlearn import AID, Inputs, Sample
    >>> t = torch.ones(50, dtype=torch.float64)
    >>> samples = Sample(Inputs(t, t, 0 * t, 0 * t, 0.4 * t), 1.5 * t, t > 0, t > 0)
    >>> aid = AID(mass=28.0)
    >>> state, surge, _ = rollout(aid, aid.init(), samples)
    >>> abs(float(surge[-1].detach()) - 1.5) < 0.01
    True
    """
    _check(state, samples)
    pick = _picking(record, state)
    if (description := choose(estimator, state, samples, backend)) is not None:
        return run(description, state, samples, record, free=False)
    return _run(estimator, state, clean(samples, estimator.surge_limit), pick, detach_every)


def simulate(
    estimator: Estimator, state: State, samples: Sample, record: Record | None = None, backend: str = "auto"
) -> tuple[State, Tensor, Any]:
    """Run an estimator free: from the inputs alone, learning nothing; the speed is told where a segment starts.

    Args:
        estimator, state, samples, record, backend: as of `rollout`; `samples.surge` counts only where `inputs.dt` is 0.

    Returns:
        As `rollout`. What `record` picks of a step that was not made is of the step before.

    Raises:
        ShapeError, ConfigError: as `rollout`.

    >>> from usvlearn import AID, Inputs, Sample
    >>> t = torch.ones(50, dtype=torch.float64)
    >>> samples = Sample(Inputs(t, t, 0 * t, 0 * t, 0.4 * t), 1.5 * t, t > 0, t > 0)
    >>> aid = AID(mass=28.0)
    >>> float(simulate(aid, aid.init(), samples)[1][-1])  # it has learned nothing, whatever was measured
    0.0
    """
    _check(state, samples)
    pick = _picking(record, state)
    if (description := choose(estimator, state, samples, backend)) is not None:
        return run(description, state, samples, record, free=True)
    steps = clean(samples, estimator.surge_limit)
    return _run(estimator, state, steps._replace(learns=torch.zeros_like(steps.learns)), pick)


def _run(estimator: Estimator, state: State, steps: Step, pick: Callable | None, detach_every: int | None = None):
    """All steps by torch; leaves of `steps` are `(time, *batch)`."""
    holds = ~(steps.steps | steps.starts)
    kinds = steps.learns, steps.steps & ~steps.learns, steps.starts, holds
    some = torch.stack([mask.reshape(len(mask), -1).any(1) for mask in kinds], 1).tolist()
    predictions, records = [], []
    for k, step in enumerate(_unbind(steps)):
        if detach_every and k % detach_every == 0:
            state = tree_map(Tensor.detach, state)
        state, surge = _advance(estimator, state, step, Kinds(*some[k]))
        predictions.append(surge)
        if pick is not None:
            records.append(pick(state))
    return state, torch.stack(predictions), (stack(records) if records else None)


def _advance(estimator: Estimator, state: State, step: Step, some: Kinds) -> tuple[State, Tensor]:
    """`Estimator.forward` of a clean sample, without what happens in no lane."""
    if some == Kinds(learns=True, coasts=False, starts=False, holds=False):
        return estimator.learn(state, step.inputs, step.surge)
    # Each layer covers those before it in its lanes, the first is everywhere.
    layers = [(None, state)] if some.holds or not any(some) else []
    if some.starts:
        layers.append((step.starts, estimator.start(state, step.surge)))
    surge = torch.full_like(step.surge, math.nan)
    if some.learns or some.coasts:
        coasted, predicted = estimator.predict(state, step.inputs)
        surge = torch.where(step.steps, predicted, math.nan)
        if some.coasts:
            layers.append((step.steps, coasted))
        if some.learns:
            target = torch.where(step.learns, step.surge, predicted.detach())
            layers.append((step.learns, estimator.update(state, step.inputs, target)))
    (_, result), *above = layers
    for mask, tree in above:
        result = tree_map(lambda new, old, mask=mask: where(mask, new, old), tree, result)
    return result, surge


def _picking(record: Record | None, state: State) -> Callable[[State], Any] | None:
    """What `record` names or picks, as a function of the state."""
    if record is None or callable(record):
        return record
    leaves = dict(named_leaves(state))
    if unknown := [name for name in record if name not in leaves]:
        raise ConfigError(f"record: found {unknown[0]!r}, expected names of the state's leaves: {', '.join(leaves)}")
    names = tuple(record)
    return lambda state: {name: leaf for name, leaf in named_leaves(state) if name in names}


def _unbind(steps: Step) -> Iterator[Step]:
    """What belongs to each time, one after the other."""
    inputs = zip(*(x.unbind(0) for x in steps.inputs), strict=True)
    for x, *y in zip(inputs, *(y.unbind(0) for y in steps[1:]), strict=True):
        yield Step(Inputs(*x), *y)


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
