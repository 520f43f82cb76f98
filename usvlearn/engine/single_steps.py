"""Single steps of one state aboard a boat: each is one call of compiled code, on numbers of any type."""

from __future__ import annotations

import math
import os
import threading
import weakref
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numba.core.errors import NumbaError

from usvlearn.core.family import Row
from usvlearn.core.forecasts import NONE, Track, plan_inputs, track_of
from usvlearn.core.samples import Inputs, PlanarSample, Sample, check_sample, one_number
from usvlearn.engine import dispatch as step
from usvlearn.engine.first_use import COMPILING, compile_planar, compile_plans, compile_steps
from usvlearn.engine.forecasting import forecast_plan
from usvlearn.engine.parts import Description, batch_of, leaves_of
from usvlearn.engine.planar import FOUND, track_plan
from usvlearn.engine.program import program_for
from usvlearn.errors import ConfigError
from usvlearn.estimators.planar.state import POSE

LIVE, UNKNOWN = step.step_once, (math.nan,) * POSE
NOT_PLAIN = TypeError, ValueError, OverflowError, NumbaError  # of what a compiled step cannot take as a number
Element = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]  # its first arguments: program, state, numbers, work
ALIVE: weakref.WeakSet[CompiledStepper] = weakref.WeakSet()  # a fork waits for the steps of all of them
WAITING: list[CompiledStepper] = []  # a fork holds the locks of these


class CompiledStepper:
    """Makes one described estimator's steps in place; leaves are all float64 or all float32, but for flags."""

    prefix = ""  # of the leaves of an ensemble of the surge

    def __init__(self, description: Description, leaves: Mapping[str, np.ndarray]):
        self._description, self.lock = description, threading.RLock()  # all steps share one work array
        first = next(x for x in leaves.values() if x.dtype != bool)
        self.plan = program_for(description, batch_of(leaves_of(description), leaves), first.dtype)
        self.states = self.plan.pack(leaves)
        self.others = {name: leaf for name, leaf in leaves.items() if name not in self.plan.leaves}  # of other code
        self._spare = self.states.copy()  # `predict` steps this copy
        external = self.plan.external
        self._work = np.empty((len(self.states) if external else 1, self.plan.work), first.dtype)
        self.given = self._work[:, self.plan.work - external :]  # what other code predicts of the next step, m/s
        self.given[:] = np.nan
        self._steps, self._predictions = self._arguments(self.states), self._arguments(self._spare)
        self.current = True  # whether the state is known to be the present one
        with COMPILING:
            ALIVE.add(self)
        compile_steps(first.dtype)

    def __reduce__(self) -> tuple[Any, ...]:  # `_steps` holds views of `states`: a copy must make its own
        return type(self), (self._description, self.leaves)

    def described(self, description: Description, leaves: Mapping[str, np.ndarray]) -> Any:
        """The same, of another description."""
        stepper = type(self)(description, leaves)
        stepper.current = self.current
        return stepper

    @property
    def batch(self) -> tuple[int, ...]:
        return self.plan.batch

    @property
    def leaves(self) -> dict[str, np.ndarray]:
        """The state, copied, between two steps of any thread."""
        with self.lock:
            return {name: leaf.copy() for name, leaf in (self.plan.unpack(self.states) | self.others).items()}

    @leaves.setter
    def leaves(self, leaves: Mapping[str, np.ndarray]) -> None:
        packed = self.plan.pack(leaves)
        with self.lock:
            self.states[:] = packed
            self.others = {name: leaf for name, leaf in leaves.items() if name not in self.plan.leaves}

    def leaf(self, name: str) -> np.ndarray:
        """One leaf of the state, copied."""
        with self.lock:
            if name in self.others:
                return self.others[name].copy()
            return self.plan.typed(name, self.plan.view(self.states, name).copy())

    def step(self, sample: Sample | PlanarSample) -> Any:
        """Predict, then learn; returns the prediction, m/s: a float, or an array `(*batch,)`."""
        if isinstance(sample, PlanarSample):  # of which the surge's part is used
            sample = sample.sample
        with self.lock:
            self.current = True
            return self._advance(self._steps, *sample)

    def predict(self, inputs: Inputs) -> Any:
        """The prediction, m/s; the state stays as it is."""
        with self.lock:
            np.copyto(self._spare, self.states)
            return self._advance(self._predictions, inputs, np.nan, True, False)

    def last_predictions(self) -> tuple[np.ndarray, np.ndarray]:
        """What an ensemble predicted in the last step, and the half-widths of the intervals, m/s, `(*batch, names)`."""
        with self.lock:
            return self._pair(self.states)

    def predict_members(self, inputs: Inputs) -> tuple[np.ndarray, np.ndarray]:
        """What an ensemble predicts, and the half-widths, m/s, `(*batch, names)`; the state stays as it is."""
        with self.lock:
            self.predict(inputs)
            return self._pair(self._spare)

    def _pair(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        predictions, widths = (
            self.plan.view(states, f"{self.prefix}{name}").copy() for name in ("predictions", "halfwidths")
        )
        return predictions, widths

    def forecast(self, inputs: Inputs) -> tuple[np.ndarray, np.ndarray]:
        """Predictions and half-widths of a plan, m/s, `(time, *batch)`; a ConfigError without forecasts."""
        plan, dtype = self.plan, self.plan.dtype
        if not self._description.get("surge", self._description).get("forecasts"):
            raise ConfigError(NONE)
        compile_plans(dtype)
        steps, elements = len(inputs.dt), plan.elements
        out, slot = np.empty((elements, steps, 2), dtype), np.empty(plan.slot, dtype)
        current = self.current
        columns = [np.ascontiguousarray(x.reshape(steps, elements).T, dtype) for x in inputs]
        heads, limit = bool(plan.program[0, Row.HEADS] > 0), step.surge_limit(plan.program, plan.numbers[0])
        with self.lock:
            for element, (program, s, q, work) in enumerate(self._steps):
                left, right, heading, yaw_rate, dt = (x[element] for x in columns)
                forecast_plan(program, s, q, left, right, heading, yaw_rate, dt, heads, limit, slot, out[element], work)
        if not current:
            out[..., 1] = np.inf
        if not plan.batch:
            return out[0, :, 0], out[0, :, 1]
        wide = np.moveaxis(out, 0, 1).reshape(steps, *plan.batch, 2)
        return wide[..., 0], wide[..., 1]

    def _arguments(self, states: np.ndarray) -> list[Element]:
        """The first arguments of each batch element's step; those of the sample follow."""
        numbers = self.plan.numbers if len(self.plan.numbers) > 1 else [self.plan.numbers[0]] * len(states)
        works = self._work if len(self._work) > 1 else [self._work[0]] * len(states)
        return [(self.plan.program, *each) for each in zip(states, numbers, works, strict=True)]

    def _advance(self, elements: list[Element], inputs: Inputs, surge: Any, fresh: Any, measured: Any) -> Any:
        if not self.plan.batch and type(fresh) is bool is type(measured):  # compiled code takes any number for a bool
            left, right, heading, yaw_rate, dt = inputs
            try:
                return LIVE(*elements[0], left, right, heading, yaw_rate, dt, surge, fresh, measured)
            except NOT_PLAIN:
                pass
        return self._checked(elements, Sample(inputs, surge, fresh, measured))

    def _checked(self, elements: list[Element], sample: Sample, pose: Sequence[Any] = ()) -> Any:
        """The steps of all batch elements, of numbers of any type."""
        batch = self.plan.batch
        check_sample(PlanarSample(sample, *pose) if pose else sample, batch)
        inputs, surge, fresh, measured = sample
        fields = map(one_number, (*inputs, surge, *pose, fresh, measured))
        wide = [np.broadcast_to(np.asarray(x), batch).reshape(-1).tolist() for x in fields]
        predictions = []
        for element, (*numbers, fresh, measured) in zip(elements, zip(*wide, strict=True), strict=True):
            plain = (*map(float, numbers[:6]), bool(fresh), bool(measured))
            predictions.append(self._once(element, plain, numbers[6:]))
        return np.array(predictions, self.plan.dtype).reshape(batch) if batch else predictions[0]

    def _once(self, element: Any, sample: Any, pose: Sequence[Any]) -> Any:
        return LIVE(*element, *sample)


class PlanarStepper(CompiledStepper):
    """A `CompiledStepper` of a `Planar`; its surge is the first in its states."""

    prefix = "surge."

    def __init__(self, description: Description, leaves: Mapping[str, np.ndarray]):
        super().__init__(description, leaves)
        compile_planar(self.plan.dtype)
        self._pose = np.empty(POSE, self.plan.dtype)

    def step(self, sample: Sample | PlanarSample) -> Any:
        """Predict, then learn; returns the prediction of the surge, m/s. A `Sample` alone measures nothing else."""
        plain, pose = (sample, UNKNOWN) if isinstance(sample, Sample) else (sample.sample, sample[1:])
        with self.lock:
            self.current = True
            if not self.plan.batch and type(plain.fresh) is bool is type(plain.measured):
                with suppress(*NOT_PLAIN):
                    return self._once(self._steps[0], (*plain.inputs, *plain[1:]), pose)
            return self._checked(self._steps, plain, pose)

    def _once(self, element: Any, sample: Any, pose: Sequence[Any]) -> Any:
        program, *others = element
        self._pose[:] = pose
        arguments: Any = (program, self.plan.head, *others, *sample, self._pose)
        return step.step_planar(*arguments)

    def track(self, commands: Any, dt: float) -> Track:
        """Where the boat will be under a plan; `Online.forecast`."""
        plan, (left, right, _, _, lengths) = self.plan, plan_inputs(commands, 0.0, 0.0, dt, self.plan.batch)
        steps, count = len(left), plan.elements
        left, right, lengths = (
            np.ascontiguousarray(x.reshape(steps, count).T, plan.dtype) for x in (left, right, lengths)
        )
        out, slot = np.empty((count, steps, FOUND), plan.dtype), np.empty(plan.length, plan.dtype)
        with self.lock:
            for k, (program, s, q, work) in enumerate(self._steps):
                track_plan(program, plan.head, s, q, slot, left[k], right[k], lengths[k], out[k], work)
        if not self.current:
            out[..., 6:] = np.inf, 0.0, np.inf
        return track_of(np.moveaxis(out, 0, 1).reshape(steps, *plan.batch, FOUND), lengths[0])


def live_of(description: Description, leaves: Mapping[str, np.ndarray]) -> CompiledStepper:
    """What makes single steps of a described estimator, or of a boat in the plane, in compiled code."""
    return (PlanarStepper if description["kind"] == "planar" else CompiledStepper)(description, leaves)


def _before_fork() -> None:
    """Wait for all steps, so that a child gets no half-made state and no lock held by a thread that it lacks."""
    COMPILING.acquire()
    WAITING.extend(ALIVE)
    for live in WAITING:
        live.lock.acquire()


def _after_fork() -> None:
    while WAITING:
        WAITING.pop().lock.release()
    COMPILING.release()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork, after_in_parent=_after_fork, after_in_child=_after_fork)
