"""Members that other code than kernels steps: torch, NumPy, another library.

A prediction of a member depends on the samples and its own state, never on other members. So each such member runs
alone over the samples, and the kernels of the ensemble read what it predicted: as if all stepped together, bit for bit.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from usvlearn.core.protocol import Estimator, State, Step, clean
from usvlearn.core.samples import (
    PLAUSIBLE,
    Inputs,
    PlanarSample,
    Sample,
    check_inputs,
    check_sample,
    named_leaves,
    one_number,
    rebuild,
    tree_map,
)
from usvlearn.engine.backend import (
    BACKENDS,
    array_of,
    arrays_of,
    description_of,
    of_kernels,
    out_of_reach,
    tensors_in,
)
from usvlearn.engine.parts import Description, external_in
from usvlearn.engine.run import Result, roll
from usvlearn.engine.single_steps import CompiledStepper, live_of
from usvlearn.engine.torch_steps import walk
from usvlearn.errors import ConfigError, MemberError, ShapeError, check_choice

Leaves = Mapping[str, np.ndarray]


class FirstPass:
    """Steps the external members of an ensemble, or of the surge of a boat in the plane, each alone.

    A member that raises, or returns what has another shape, ends: from that step on it predicts NaN, all numbers of its
    state are NaN, and the run goes on without it.

    Args:
        description: of the ensemble, or of the boat in the plane.
        members: estimators by name; those that are external count, and one that is missing predicts NaN.
        states: one of each, by name; their structure counts.

    Attributes:
        ended: the prefixes of the leaves of those that have ended.
    """

    def __init__(self, description: Description, members: Mapping[str, Estimator], states: Mapping[str, State]):
        self.axis = "surge." if "surge" in description else ""
        own = description.get("surge", description)
        self.limit = min(PLAUSIBLE, own["numbers"]["surge_max"])
        self.columns = external_in(description)
        self.members = {name: members[name] for name in self.columns if name in members}
        self._templates = {name: states[name] for name in self.members}
        for name, member in self.members.items():
            if cause := getattr(member, "cause", ""):
                warnings.warn(f"estimators.{name}: {cause}", stacklevel=3)
        self.ended, self._told, self._done = set[str](), set[str](), 0

    def prefix(self, name: str) -> str:
        """Of the leaves of a member."""
        return f"{self.axis}members.{name}."

    @torch.no_grad()
    def run(
        self, leaves: Leaves, samples: Sample, free: bool, record: Sequence[str]
    ) -> tuple[dict[str, np.ndarray], np.ndarray, dict[str, np.ndarray]]:
        """Run each over samples, arrays `(time, *batch)`.

        Returns:
            The leaves of their states at the end; what they predict, m/s, `(time, *batch, members)`; and those leaves
            that `record` names, `(time, *batch, …)`.
        """
        step = clean(tree_map(torch.as_tensor, samples), self.limit)
        if free:
            step = step._replace(learns=torch.zeros_like(step.learns))
        given = np.full((*step.surge.shape, len(self.columns)), np.nan, samples.surge.dtype)
        after, kept = dict[str, np.ndarray](), dict[str, np.ndarray]()
        for name, member in self.members.items():
            prefix = self.prefix(name)
            state = self._state(name, leaves)
            numbers = [leaf for _, leaf in named_leaves(state) if leaf.is_floating_point()]
            if numbers and all(bool(leaf.isnan().all()) for leaf in numbers):
                self.ended.add(prefix)
            picked = {key: list[Tensor]() for key in record if key.startswith(prefix)}
            if prefix not in self.ended:
                state, found = self._alone(name, member, state, step, picked)
                given[..., self.columns.index(name)] = array_of(found)
            own = {key: array_of(leaf) for key, leaf in named_leaves(state, prefix[:-1])}
            after |= own
            for key, each in picked.items():
                rest = len(step.surge) - len(each)
                kept[key] = np.stack([*map(array_of, each), *[own[key]] * rest])
        self._done += len(step.surge)
        return after, given, kept

    def _state(self, name: str, leaves: Leaves) -> State:
        prefix = self.prefix(name)
        own = {key: torch.as_tensor(leaf) for key, leaf in leaves.items() if key.startswith(prefix)}
        return rebuild(self._templates[name], own, prefix[:-1])

    def _alone(
        self, name: str, member: Any, state: State, steps: Step, picked: Mapping[str, list[Tensor]]
    ) -> tuple[State, Tensor]:
        """One member over all steps: the state at the end, and what it predicted, m/s."""
        before, step, found = state, len(steps.surge) - 1, torch.full_like(steps.surge, torch.nan)
        shapes = {key: leaf.shape for key, leaf in named_leaves(state)}
        try:
            if hasattr(member, "stretch") and not picked:
                state, found = member.stretch(state, steps)
            else:
                state, found = each_step(member, state, steps, picked, self.prefix(name)[:-1])
            for key, leaf in named_leaves(state):
                if leaf.shape != shapes.get(key):
                    raise ShapeError(f"its state {key} has the shape {tuple(leaf.shape)}, expected {shapes.get(key)}")
        except Exception as error:
            cause: BaseException | None = error
            if isinstance(error, MemberError):
                step, found, cause = error.step, error.predictions, error.__cause__
            self._tell(name, step, f"{type(cause).__name__}: {cause}: the run goes on without it from here")
            self.ended.add(self.prefix(name))
            return tree_map(lambda x: torch.full_like(x, torch.nan) if x.is_floating_point() else x, before), found
        lost = (steps.steps & ~found.isfinite()).reshape(len(found), -1).any(1).nonzero()
        if len(lost) and name not in self._told:
            self._tell(name, int(lost[0]), "it predicted no finite number: it is inactive there")
        return state, found

    def _tell(self, name: str, step: int, what: str) -> None:
        self._told.add(name)
        warnings.warn(f"estimators.{name}: step {self._done + step + 1:,}: {what}", stacklevel=2)


def each_step(
    member: Estimator, state: State, steps: Step, picked: Mapping[str, list[Tensor]], prefix: str
) -> tuple[State, Tensor]:
    """All steps of one member; `picked` takes leaves after each. Raises a MemberError, which knows the step."""
    found, walked, k = torch.full_like(steps.surge, torch.nan), walk(member, state, steps), 0
    try:
        for k in range(len(found)):
            state, surge = next(walked)
            if surge.shape != found[k].shape:
                raise ShapeError(f"it predicted the shape {tuple(surge.shape)}, expected {tuple(found[k].shape)}")
            found[k] = surge
            now = dict(named_leaves(state, prefix)) if picked else {}
            for key, each in picked.items():
                each.append(now[key])
    except Exception as error:
        raise MemberError(k, found) from error
    return state, found


def first_pass(description: Description, estimator: Any, state: Any) -> FirstPass | None:
    """The first pass of an ensemble or of a boat in the plane; None where kernels step all."""
    if not external_in(description):
        return None
    members = getattr(estimator, "surge", estimator).members
    return FirstPass(description, members, getattr(state, "surge", state).members)


def roll_both(
    first: FirstPass | None, description: Description, leaves: Leaves, samples: Sample | PlanarSample,
    free: bool = False, record: Sequence[str] = (), threads: int = 1, device: str = "cpu",
) -> Result:  # fmt: skip
    """`engine.run.roll`, after the first pass."""
    if first is None:
        return roll(description, leaves, samples, free, record, threads, device)
    own = samples.sample if isinstance(samples, PlanarSample) else samples
    after, given, kept = first.run(leaves, own, free, record)
    theirs = [name for name in record if name not in kept]
    result = roll(description, leaves, samples, free, theirs, threads, device, given)
    return Result({**result.leaves, **after}, result.predictions, {**result.record, **kept})


class BothStepper:
    """Single steps of an ensemble, or of a boat in the plane, with external members: as a `CompiledStepper`."""

    def __init__(self, first: FirstPass, kernels: CompiledStepper):
        self._first, self._kernels = first, kernels

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._kernels, name)

    @property
    def leaves(self) -> dict[str, np.ndarray]:
        """The state, copied."""
        return self._kernels.leaves

    @leaves.setter
    def leaves(self, leaves: Leaves) -> None:
        self._kernels.leaves = leaves

    def described(self, description: Description, leaves: Leaves) -> BothStepper:
        """The same, of another description."""
        return BothStepper(self._first, self._kernels.described(description, leaves))

    def step(self, sample: Sample | PlanarSample) -> Any:
        """Predict, then learn; returns the prediction, m/s: a float, or an array `(*batch,)`."""
        own = sample.sample if isinstance(sample, PlanarSample) else sample
        check_sample(sample, self.batch)
        with self._kernels.lock:
            after = self._hand_over(own, free=False)
            predicted = self._kernels.step(sample)
            self._kernels.others |= after
            return predicted

    def predict(self, inputs: Inputs) -> Any:
        """The prediction, m/s; the state stays as it is."""
        with self._kernels.lock:
            self._to_come(inputs)
            return self._kernels.predict(inputs)

    def predict_members(self, inputs: Inputs) -> tuple[np.ndarray, np.ndarray]:
        """What the ensemble predicts, and the half-widths, m/s, `(*batch, names)`; the state stays as it is."""
        with self._kernels.lock:
            self._to_come(inputs)
            return self._kernels.predict_members(inputs)

    def _to_come(self, inputs: Inputs) -> None:
        check_inputs(inputs, self.batch)
        self._hand_over(Sample(inputs, np.nan, True, False), free=True)

    def _hand_over(self, sample: Sample, free: bool) -> dict[str, np.ndarray]:
        """Step the external members, give the kernels what they predict; returns the leaves of their new states."""
        live = self._kernels

        def one(value: Any, kind: Any) -> np.ndarray:
            return np.broadcast_to(np.asarray(one_number(value), kind), live.batch)[None].copy()

        inputs, surge, fresh, measured = sample
        numbers = Inputs(*(one(x, live.plan.dtype) for x in inputs))
        step = Sample(numbers, one(surge, live.plan.dtype), one(fresh, bool), one(measured, bool))
        after, given, _ = self._first.run(live.others, step, free, ())
        live.given[:] = given.reshape(len(live.given), -1)
        return after


def stepper_of(description: Description, leaves: Leaves, estimator: Any, state: Any) -> Any:
    """What makes single steps of an estimator, or of a boat in the plane, in compiled code and by its own."""
    live, first = live_of(description, leaves), first_pass(description, estimator, state)
    return live if first is None else BothStepper(first, live)


def live(estimator: Estimator, state: Any, backend: str) -> Any:
    """What makes single steps of a state, or None where torch has to make them.

    Raises:
        ConfigError: as `choose`.
    """
    if check_choice("backend", backend, BACKENDS) == "torch":
        return None
    obstacle = out_of_reach([*tensors_in(state), *of_kernels(estimator)])
    if (description := description_of(estimator, obstacle, backend)) is None:
        return None
    return stepper_of(description, arrays_of(state), estimator, state)


def with_members(live: Any, description: Description, members: Mapping[str, Estimator]) -> Any:
    """The same with the external members of these names."""
    if unknown := sorted(members.keys() - {*external_in(description)}):
        expected = ", ".join(external_in(description)) or "none"
        raise ConfigError(f"members: found {unknown[0]}, expected those that other code steps: {expected}")
    states = {name: member.init(live.batch) for name, member in members.items()}
    return BothStepper(FirstPass(description, members, states), live) if members else live
