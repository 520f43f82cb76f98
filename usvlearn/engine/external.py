"""Makes the steps of members that have no kernel: torch, NumPy, another library.

A prediction of a member depends on the samples and its own state, never on other members. So each such member runs
alone over the samples, and the kernels of the ensemble read what it predicted: as if all stepped together, bit for bit.
"""

from __future__ import annotations

import re
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
from usvlearn.engine.backend import BACKENDS, array_of, arrays_of, description_of, of_kernels, out_of_reach, tensors_in
from usvlearn.engine.parts import Description, external_in
from usvlearn.engine.run import Result, roll
from usvlearn.engine.single_steps import CompiledStepper, live_of
from usvlearn.engine.torch_steps import walk
from usvlearn.errors import ConfigError, MemberError, ShapeError, check_choice

Leaves = Mapping[str, np.ndarray]
PAINT, LONGEST = re.compile(r"\x1b\[[\d;]*m"), 300  # of what others raise: colours of a terminal, and characters


class FirstPass:
    """Steps the external members of an ensemble, or of the surge of a boat in the plane, each alone.

    A member that raises, or returns what has another shape, ends: from that step on it predicts NaN, all numbers of its
    state are NaN, and the run goes on without it. One that is missing predicts NaN. Of the states the structure counts.
    """

    def __init__(self, description: Description, members: Mapping[str, Estimator], states: Mapping[str, State]):
        axis, surge = ("surge.", description["surge"]) if "surge" in description else ("", description)
        self._limit, self._names = min(PLAUSIBLE, surge["numbers"]["surge_max"]), external_in(description)
        self._members: dict[str, Any] = {name: members[name] for name in self._names if name in members}
        self._states, self._prefix = states, {name: f"{axis}members.{name}" for name in self._names}
        self.ended, self._told = dict[str, str](), set[str]()  # prefix of leaves -> what happened; names
        self.done = 0  # steps
        for name, member in self._members.items():
            if cause := getattr(member, "cause", ""):
                warnings.warn(f"estimators.{name}: {cause}", stacklevel=3)

    @torch.no_grad()
    def run(self, leaves: Leaves, samples: Sample, free: bool) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """The leaves after samples, arrays `(time, *batch)`, and the predictions, m/s, `(time, *batch, members)`."""
        steps = clean(tree_map(torch.as_tensor, samples), self._limit)
        if free:
            steps = steps._replace(learns=torch.zeros_like(steps.learns))
        given = np.full((*steps.surge.shape, len(self._names)), np.nan, samples.surge.dtype)
        after = dict[str, np.ndarray]()
        for name, member in self._members.items():
            prefix = self._prefix[name]
            tensors = {key: torch.as_tensor(leaf) for key, leaf in leaves.items() if key.startswith(f"{prefix}.")}
            state = rebuild(self._states[name], tensors, prefix)
            numbers = [leaf for leaf in tensors.values() if leaf.is_floating_point()]
            if numbers and all(bool(leaf.isnan().all()) for leaf in numbers):
                self.ended.setdefault(f"{prefix}.", f"estimators.{name}: it failed before: the run goes on without it")
            else:
                self.ended.pop(f"{prefix}.", None)
                state, predicted = self._alone(name, member, state, steps)
                given[..., self._names.index(name)] = array_of(predicted)
            after |= {key: array_of(leaf) for key, leaf in named_leaves(state, prefix)}
        self.done += len(steps.surge)
        return after, given

    def recorded(
        self, leaves: Leaves, samples: Sample, free: bool, record: Sequence[str]
    ) -> tuple[dict[str, np.ndarray], np.ndarray, dict[str, np.ndarray]]:
        """`run`, and after each step the leaves of external members that `record` names, `(time, *batch, …)`."""
        names = [name for name in record if name.startswith(tuple(f"{each}." for each in self._prefix.values()))]
        if not names:
            return *self.run(leaves, samples, free), {}
        after, given, records = dict(leaves), list[np.ndarray](), list[dict[str, np.ndarray]]()
        for k in range(len(samples.surge)):
            after, predicted = self.run(after, tree_map(lambda x, k=k: x[k : k + 1], samples), free)
            given.append(predicted)
            records.append({name: after[name] for name in names})
        return after, np.concatenate(given), {name: np.stack([each[name] for each in records]) for name in names}

    def _alone(self, name: str, member: Any, before: State, steps: Step) -> tuple[State, Tensor]:
        """One member over all steps: the state at the end, and what it predicted, m/s."""
        stretch = getattr(member, "stretch", None)
        try:
            state, predicted = stretch(before, steps) if stretch else each_step(member, before, steps)
            shapes = ({key: tuple(leaf.shape) for key, leaf in named_leaves(tree)} for tree in (state, before))
            if (now := next(shapes)) != (was := next(shapes)):
                raise ShapeError(f"its state has the shapes {now}, expected {was}")
        except Exception as error:
            cause: BaseException | None = error
            step, predicted = len(steps.surge) - 1, torch.full_like(steps.surge, torch.nan)
            if isinstance(error, MemberError):
                step, predicted, cause = error.step, error.predictions, error.__cause__
            what = " ".join(PAINT.sub("", f"{type(cause).__name__}: {cause}").split())[:LONGEST]
            told = self._tell(name, step, f"{what}: the run goes on without it from here")
            self.ended[f"{self._prefix[name]}."] = told
            return tree_map(lambda x: torch.full_like(x, torch.nan) if x.is_floating_point() else x, before), predicted
        lost = (steps.steps & ~predicted.isfinite()).reshape(len(predicted), -1).any(1).nonzero()
        if len(lost) and name not in self._told:
            self._tell(name, int(lost[0]), "it predicted no finite number: it is inactive there")
        return state, predicted

    def _tell(self, name: str, step: int, what: str) -> str:
        self._told.add(name)
        warnings.warn(told := f"estimators.{name}: step {self.done + step + 1:,}: {what}", stacklevel=2)
        return told


def each_step(member: Estimator, begin: State, steps: Step) -> tuple[State, Tensor]:
    """All steps of one member by torch; raises a MemberError, which knows the step."""
    state, predictions, batch = begin, list[Tensor](), steps.surge.shape[1:]
    try:
        for each in walk(member, begin, steps):
            state, surge = each
            if surge.shape != batch:
                raise ShapeError(f"it predicted the shape {tuple(surge.shape)}, expected {tuple(batch)}")
            predictions.append(surge)
    except Exception as error:
        rest = torch.full_like(steps.surge[len(predictions) :], torch.nan)
        raise MemberError(len(predictions), torch.cat([*(x[None] for x in predictions), rest])) from error
    return state, torch.stack(predictions)


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
    plain = samples.sample if isinstance(samples, PlanarSample) else samples
    after, given, recorded = first.recorded(leaves, plain, free, record)
    theirs = [name for name in record if name not in recorded]
    result = roll(description, leaves, samples, free, theirs, threads, device, given)
    return Result({**result.leaves, **after}, result.predictions, {**result.record, **recorded})


class BothStepper:
    """Single steps of an ensemble, or of a boat in the plane, with external members: as a `CompiledStepper`."""

    def __init__(self, first: FirstPass, kernels: CompiledStepper):
        self._first, self._kernels, self.ended = first, kernels, first.ended

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
        plain = sample.sample if isinstance(sample, PlanarSample) else sample
        check_sample(sample, self.batch)
        with self._kernels.lock:
            after = self._hand_over(plain, free=False)
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
        self._first.done -= 1

    def _hand_over(self, sample: Sample, free: bool) -> dict[str, np.ndarray]:
        """Step the external members, give the kernels what they predict; returns the leaves of their new states."""
        live = self._kernels

        def one(value: Any, kind: Any) -> np.ndarray:
            return np.broadcast_to(np.asarray(one_number(value), kind), live.batch)[None].copy()

        inputs, surge, fresh, measured = sample
        numbers = Inputs(*(one(x, live.plan.dtype) for x in inputs))
        step = Sample(numbers, one(surge, live.plan.dtype), one(fresh, bool), one(measured, bool))
        after, given = self._first.run(live.others, step, free)
        live.given[:] = given.reshape(len(live.given), -1)
        return after


def live(estimator: Estimator, state: Any, backend: str) -> Any:
    """What makes single steps of a state, or None where torch has to make them; a ConfigError as of `choose`."""
    if check_choice("backend", backend, BACKENDS) == "torch":
        return None
    description = description_of(estimator, out_of_reach([*tensors_in(state), *of_kernels(estimator)]), backend)
    return None if description is None else both(description, estimator, state)


def both(description: Description, estimator: Any, state: Any) -> Any:
    """What makes single steps of an estimator, or of a boat in the plane, with its external members."""
    live, first = live_of(description, arrays_of(state)), first_pass(description, estimator, state)
    return live if first is None else BothStepper(first, live)


def with_members(live: Any, description: Description, members: Mapping[str, Estimator]) -> Any:
    """The same with the external members of these names."""
    if unknown := sorted(members.keys() - {*external_in(description)}):
        expected = ", ".join(external_in(description)) or "none"
        raise ConfigError(f"members: found {unknown[0]}, expected those that other code steps: {expected}")
    states = {name: member.init(live.batch) for name, member in members.items()}
    return BothStepper(FirstPass(description, members, states), live) if members else live
