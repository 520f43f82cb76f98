"""The online-step protocol: state in, state out; predict before you learn."""

from __future__ import annotations

import abc
import math
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from typing import Any, NamedTuple, final

import torch
from torch import Tensor, nn

from usvlearn.core.family import Family, Named, Parameters, ParameterVectors
from usvlearn.core.hyperparameters import numbers
from usvlearn.core.samples import PLAUSIBLE, Inputs, Sample, masks, tree_map, where
from usvlearn.errors import ConfigError

State = Any  # a tree (samples.py) of tensors with leaves (*batch, ...)


class Estimator(nn.Module, abc.ABC):
    """Predicts the surge speed one step ahead and learns from what was then measured.

    Three kinds of number: what is identified online lives in the *state* and is never written to `self`; what is
    tuned is a *hyperparameter* (`Positive`, `UnitInterval`), learnable by gradient and broadcast against the batch;
    what is known is a *constant* (a buffer). Every method is pure, so one object serves any batch of vehicles.

    A new estimator defines `init`, `predict` and `update`, `start` if its state remembers a speed, and `monitor` if
    it has diagnostics.

    Attributes:
        surge_limit: a measured speed at or beyond it, m/s, counts as missing.
        frozen: the leaves of the state, by dotted name, that an open-loop simulation needs; None: all of them.

    >>> from usvlearn import AID
    >>> aid, one = AID(mass=28.0), torch.tensor(1.0).double()
    >>> inputs = Inputs(one, one, 0 * one, 0 * one, 0.4 * one)
    >>> state = aid.start(aid.init(), one)
    >>> coasted, predicted = aid.predict(state, inputs)
    >>> learned = aid.update(state, inputs, 1.2 * one)
    >>> bool(aid.predict(learned, inputs)[1] > predicted)
    True
    """

    surge_limit: float = PLAUSIBLE
    frozen: tuple[str, ...] | None = None

    @abc.abstractmethod
    def init(self, batch: Sequence[int] = ()) -> State:
        """The state before the first sample.

        Args:
            batch: its shape, a count for each axis; () for one vehicle.

        Returns:
            The state, leaves `(*batch, ...)`.
        """

    @abc.abstractmethod
    def predict(self, state: State, inputs: Inputs) -> tuple[State, Tensor]:
        """Time update: one step on, without learning.

        Args:
            state: before the step.
            inputs: of the step, leaves `(*batch,)`.

        Returns:
            The state after the step, and the predicted surge, m/s, `(*batch,)`.
        """

    @abc.abstractmethod
    def update(self, state: State, inputs: Inputs, surge: Tensor) -> State:
        """Measurement update.

        Args:
            state: the one that was given to `predict`.
            inputs: of the step, leaves `(*batch,)`.
            surge: measured at the end of the step, m/s, `(*batch,)`.

        Returns:
            The state after the step.
        """

    def start(self, state: State, surge: Tensor) -> State:
        """Begin a segment: the next step departs from a measured speed; nothing is learned.

        Args:
            state: before.
            surge: measured, m/s, `(*batch,)`.

        Returns:
            The state that has this speed.
        """
        return state

    def learn(self, state: State, inputs: Inputs, surge: Tensor) -> tuple[State, Tensor]:
        """A step on which nothing is masked.

        An estimator whose `update` computes the prediction anyway overrides this, with the same result.

        Args:
            state: before the step.
            inputs: of the step, leaves `(*batch,)`.
            surge: measured at the end of the step, m/s, `(*batch,)`.

        Returns:
            The state of `update`, and the predicted surge of `predict`, m/s, `(*batch,)`.

        >>> from usvlearn import Persistence
        >>> rule, one = Persistence(), torch.tensor(1.0)
        >>> float(rule.learn(rule.start(rule.init(), one), None, 2 * one)[1])
        1.0
        """
        return self.update(state, inputs, surge), self.predict(state, inputs)[1]

    def description(self) -> dict[str, Any] | None:
        """The description by which the engine makes these steps in compiled code (`describe`).

        It is not inherited, since a subclass may change the steps: a subclass without its own runs in torch.

        Returns:
            Its kind, size, choices and numbers, as JSON stores them; None where there is no compiled code.

        >>> from usvlearn import Persistence
        >>> Persistence().description()
        {'kind': 'persistence', 'size': 0, 'numbers': {}}
        """
        return None

    def monitor(self, state: State) -> dict[str, Tensor]:
        """Diagnostics of a state, such as physical parameters and margins.

        Args:
            state: of this estimator.

        Returns:
            By name, `(*batch,)` each.

        >>> from usvlearn import AID
        >>> float(AID(mass=28.0).monitor(AID(mass=28.0).init())["drag_linear"])
        0.0
        """
        return {}

    @final  # type: ignore[misc]  # torch declares `forward` as an attribute, and every module defines it so
    def forward(self, state: State, sample: Sample) -> tuple[State, Tensor]:
        """Learn where measured, coast where not, hold where stale, take the speed where a segment starts.

        Returns the next state and the predicted surge, m/s, `(*batch,)`: NaN where no step was made.
        """
        return advance(self, state, clean(sample, self.surge_limit), EVERY)


class KernelEstimator(Estimator):
    """An estimator whose steps its kernel alone makes: no gradient passes through them, and no torch function.

    A subclass defines `init`, `description` and `monitor`. Its hyperparameters are not learnable.
    """

    def predict(self, state: State, inputs: Inputs) -> tuple[State, Tensor]:
        return self._step(state, inputs, torch.full_like(inputs.dt, math.nan), True, False)

    def update(self, state: State, inputs: Inputs, surge: Tensor) -> State:
        return self.learn(state, inputs, surge)[0]

    def learn(self, state: State, inputs: Inputs, surge: Tensor) -> tuple[State, Tensor]:
        return self._step(state, inputs, surge, True, True)

    def start(self, state: State, surge: Tensor) -> State:
        return self._step(state, Inputs(*[torch.zeros_like(surge)] * len(Inputs._fields)), surge, False, False)[0]

    def _step(self, state: State, inputs: Inputs, surge: Tensor, fresh: bool, measured: bool) -> tuple[State, Tensor]:
        self.check_step(state, inputs, surge)
        description = self.description()
        assert description is not None, "expected the description of a kernel"
        return kernel_step(description, state, inputs, surge, fresh, measured)

    def check_step(self, state: State, inputs: Inputs, surge: Tensor) -> None:
        """Raise a ConfigError where the kernel cannot make a step: not on the CPU, or for a gradient."""
        sample = Sample(inputs, surge, surge == 0, surge == 0)
        import_module("usvlearn.engine.backend").obstacle_of(self, state, sample, "cpu")


def kernel_step(
    description: dict[str, Any], state: State, inputs: Inputs, surge: Tensor, fresh: bool = True, measured: bool = True,
    given: Sequence[Tensor] = (),
) -> tuple[State, Tensor]:  # fmt: skip
    """One step by the kernels of a described estimator, without gradients: the state, and the prediction.

    The state of members that other code steps stays; their predictions, m/s, are `given`.
    """
    yes = torch.ones_like(surge, dtype=torch.bool)
    sample = Sample(inputs, surge, yes & fresh, yes & measured)
    rollouts = import_module("usvlearn.engine.rollouts")  # of a layer above this one
    return rollouts.kernel_step(description, state, sample, given)


def check_estimator(name: str, value: Any) -> Estimator:
    """Return `value` if it is an estimator, else raise a ConfigError."""
    if not isinstance(value, Estimator):
        raise ConfigError(f"{name}: found {value!r}, expected an estimator")
    return value


class Step(NamedTuple):
    """A sample whose masked values were replaced, and its masks. Leaves are `(*batch,)`."""

    inputs: Inputs  # 0 where no step is made
    surge: Tensor  # m/s, 0 where it is not known
    steps: Tensor  # bool: predict
    learns: Tensor  # bool: and learn
    starts: Tensor  # bool: take the speed


class Kinds(NamedTuple):
    """Which of the four cases occur in at least one batch element of a step."""

    learns: bool
    coasts: bool
    starts: bool
    holds: bool


EVERY = Kinds(True, True, True, True)


def clean(sample: Sample, surge_limit: float = PLAUSIBLE) -> Step:
    """Replace masked values before they are used, because a NaN would reach the gradients.

    `usvlearn.core.samples.masks` decides which values are masked.
    """
    steps, learns, starts, known = masks(sample, surge_limit)
    inputs = Inputs(*(torch.where(steps, x, 0.0) for x in sample.inputs))
    return Step(inputs, torch.where(known, sample.surge, 0.0), steps, learns, starts)


def advance(estimator: Estimator, state: State, step: Step, some: Kinds) -> tuple[State, Tensor]:
    """`Estimator.forward` of a clean sample; cases that occur in no batch element are skipped."""
    if some == Kinds(learns=True, coasts=False, starts=False, holds=False):
        return estimator.learn(state, step.inputs, step.surge)
    # Each state replaces those before it in the batch elements of its mask; the first has no mask.
    layers: list[tuple[Tensor | None, State]] = [(None, state)] if some.holds or not any(some) else []
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


def spec_of(part: Any) -> dict[str, Any] | None:
    """The description of an estimator, or of a part of one; None where its class has none, or a method was replaced."""
    changed = vars(part).keys() & {"predict", "update", "learn", "start", "combine", "forward"}
    return part.description() if "description" in vars(type(part)) and not changed else None


def has_kernel(member: Any) -> bool:
    """Whether compiled code makes the steps of a member of an ensemble."""
    description = spec_of(member) if isinstance(member, Estimator) else None
    return description is not None and description["kind"] != "ensemble"


def describe(family: Family[Any], part: Any, **own: Any) -> dict[str, Any]:
    """A description: the values of everything that a family declares, read from attributes of the same names.

    Values that are not attributes of the part, and `kind` and `size`, are `own`.
    """
    found = {"kind": own.get("kind", family.kinds[0]), "size": own.get("size", 0)}
    found |= {choice.key: _value(choice, part, own) for choice in family.choices}
    found["numbers"] = numbers_of(family.numbers, part, **own)
    return found | ({"vectors": numbers_of(family.vectors, part, **own)} if len(family.vectors) else {})


def numbers_of(declared: Iterable[Parameters | ParameterVectors], part: Any, **own: Any) -> dict[str, Any]:
    """The declared numbers as JSON values, from attributes of a part or from `own`."""
    return numbers(**{each.key: _value(each, part, own) for each in declared})


def _value(each: Named, part: Any, own: Mapping[str, Any]) -> Any:
    """What is declared, from `own` or an attribute; its default where that is None or, if there is one, missing."""
    value = own[each.key] if each.key in own else getattr(part, each.key, *([] if each.default is None else [None]))
    return each.default if value is None else value
