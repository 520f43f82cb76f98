"""Single steps of a boat in the plane, as `usvlearn.engine.single_steps` makes those of the surge, and its tracks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numba.core.errors import NumbaError

from usvlearn.core.forecasts import Track, plan_commands, track_of
from usvlearn.core.samples import PlanarSample, Sample, check_sample, one_number
from usvlearn.engine import dispatch
from usvlearn.engine.first_use import compile_planar
from usvlearn.engine.parts import Description
from usvlearn.engine.planar import FOUND, track_plan
from usvlearn.engine.program import Program
from usvlearn.engine.single_steps import CompiledStepper
from usvlearn.errors import ShapeError
from usvlearn.estimators.planar.state import POSE

UNKNOWN = np.full(POSE, math.nan)


class PlanarLive(CompiledStepper):
    """A `CompiledStepper` of a `Planar`. The surge lies first in its states, where the base class expects it.

    Args:
        description: of a `Planar` (`Planar.description`).
        leaves: of its state.
    """

    def __init__(self, description: Description, leaves: Mapping[str, np.ndarray]):
        super().__init__(description, leaves)
        compile_planar(self.plan.dtype)
        self._pose = np.empty(POSE, self.plan.dtype)

    def step(self, sample: Sample | PlanarSample) -> Any:
        """Predict, then learn; returns the prediction of the surge, m/s. A `Sample` alone measures nothing else."""
        if isinstance(sample, Sample):
            sample = PlanarSample(sample, *[math.nan] * POSE)
        if not self.plan.batch and (predicted := self._plain(sample)) is not None:
            return predicted
        inputs, surge, fresh, measured = sample.sample
        check_sample(sample.sample, self.plan.batch)
        poses = [
            _wide(name, value, self.plan) for name, value in zip(PlanarSample._fields[1:], sample[1:], strict=True)
        ]
        numbers = [np.broadcast_to(np.asarray(one_number(x), float), self.plan.batch).ravel() for x in (*inputs, surge)]
        masks = [np.broadcast_to(np.asarray(one_number(x), bool), self.plan.batch).ravel() for x in (fresh, measured)]
        found = np.empty(self.plan.elements)
        with self._lock:
            self.current = True
            for k in range(len(found)):
                *own, speed = (float(x[k]) for x in numbers)
                found[k] = self._element(k, own, speed, bool(masks[0][k]), bool(masks[1][k]), [x[k] for x in poses])
        return float(found[0]) if not self.plan.batch else found.reshape(self.plan.batch)

    def _plain(self, sample: PlanarSample) -> float | None:
        """`step` of plain numbers; None where some are of other types, and nothing is done."""
        inputs, surge, fresh, measured = sample.sample
        if not type(fresh) is bool is type(measured) or not all(type(x) is float for x in sample[1:]):
            return None
        with self._lock:
            try:
                found = self._element(0, inputs, surge, fresh, measured, sample[1:])
            except (TypeError, ValueError, OverflowError, NumbaError):
                return None
            self.current = True
        return found

    def _element(
        self, k: int, inputs: Sequence[float], surge: float, fresh: bool, measured: bool, pose: Sequence[float]
    ) -> float:
        """One step of one batch element."""
        program, s, q, work = self._steps[k]
        left, right, heading, yaw_rate, dt = inputs
        self._pose[:] = pose
        return dispatch.step_planar(
            program, self.plan.head, s, q, work, left, right, heading, yaw_rate, dt, surge, fresh, measured, self._pose
        )

    def track(self, commands: Any, dt: float) -> Track:
        """Where the boat will be under a plan; `Online.forecast`."""
        plan = self.plan
        left, right, lengths = plan_commands(commands, dt, plan.batch)
        steps, count = len(left), plan.elements
        left, right, lengths = (
            np.ascontiguousarray(x.reshape(steps, count).T, plan.dtype) for x in (left, right, lengths)
        )
        found, slot = np.empty((count, steps, FOUND), plan.dtype), np.empty(plan.length, plan.dtype)
        with self._lock:
            for k, (program, s, q, work) in enumerate(self._steps):
                track_plan(program, plan.head, s, q, slot, left[k], right[k], lengths[k], found[k], work)
        if not self.current:
            found[..., 6:] = np.inf, 0.0, np.inf
        wide = np.moveaxis(found, 0, 1).reshape(steps, *plan.batch, FOUND)
        return track_of(wide, lengths[0])

    def _pair(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        predictions, widths = (self.plan.view(states, f"surge.{name}").copy() for name in ("predictions", "halfwidths"))
        return predictions, widths


def _wide(name: str, value: Any, plan: Program) -> np.ndarray:
    """A measured number for each batch element."""
    try:
        found = np.asarray(one_number(value), float)
        return np.broadcast_to(found, plan.batch).ravel()
    except (TypeError, ValueError) as error:
        if isinstance(error, TypeError) or "broadcast" not in str(error):
            raise TypeError(f"{name}: found {value!r:.80}, expected a number (NaN where there is none)") from error
        raise ShapeError(f"{name}: found the shape {np.shape(value)}, expected one number or {plan.batch}") from error
