"""Settings of one estimator as elements of one batch, and the error of each over a fleet's runs.

A setting has one batch element per boat: state and samples are `(settings, boats)`, the samples as views of the fleet's
own. The objective is the MAE over all measured steps, averaged over boats: one step ahead, predicted before learning,
or as `usvlearn.evaluation.objective` says, of forecasts over a horizon or of open-loop simulations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from usvlearn.core.hyperparameters import Positive, UnitInterval
from usvlearn.core.protocol import Estimator, clean
from usvlearn.core.samples import LIMIT, Fleet, named_leaves, tree_map
from usvlearn.engine.backend import array_of, arrays_of, description_of, tree_of
from usvlearn.engine.lanes import Lanes, most_lanes
from usvlearn.engine.program import program_for
from usvlearn.engine.rollouts import rollout, simulate, tensors
from usvlearn.engine.run import prepared
from usvlearn.errors import ConfigError
from usvlearn.estimators.ensemble.combiners.layer import Average
from usvlearn.estimators.ensemble.forecasts.layer import ForecastSettings
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.evaluation.free_simulation import middle
from usvlearn.evaluation.objective import FORECAST, FREE, Measure

Setting = dict[str, float]  # dotted path -> value
Build = Callable[[Mapping[str, Any]], Estimator]  # from numbers by dotted path
NEXT, DUE = Measure(""), "forecasts.predictions"  # the error one step ahead; the leaf with forecasts that are due
BATCH = 4096  # settings × boats in one batch, at most
CHUNK_STEPS, CHUNK_CELLS = 500, 2**20  # steps, and steps × elements, after which errors are added up


class Hyperparameter(NamedTuple):
    """A tuned number and its place."""

    path: str  # inside the estimator and its configuration
    kind: type[nn.Module]  # Positive: the scale is the logarithm; UnitInterval: the logit
    default: float
    low: float
    high: float

    def to_scale(self, value: float) -> float:
        """The place of a value on the scale."""
        return math.log(value) if self.kind is Positive else math.log(value) - math.log1p(-value)

    def value(self, x: float) -> float:
        """The value at a place on the scale."""
        return math.exp(min(x, 700.0)) if self.kind is Positive else 1 / (1 + math.exp(-x))

    def from_scale(self, x: float, digits: int = 4) -> float:
        """The legal value at a place on the scale, rounded to so many digits, as it is evaluated and shown."""
        value = self.value(x)
        if self.kind is Positive or x < 0:
            value = float(f"{value:.{digits}g}")
        else:  # digits of the distance to 1
            value = round(1 - float(f"{math.exp(-x) / (1 + math.exp(-x)):.{digits}g}"), 15)
        return min(max(value, self.low), self.high)

    def spaced(self, low: float, high: float, count: int) -> list[float]:
        """Values at equal distances from `low` to `high`, both on the scale; a single value is the middle."""
        places = [(low + high) / 2] if count == 1 else [low + (high - low) * k / (count - 1) for k in range(count)]
        return [self.from_scale(x, 4 if count <= 1000 else 8) for x in places]  # four would not tell more apart

    @property
    def span(self) -> tuple[float, float]:
        """The range on the scale."""
        return self.to_scale(self.low), self.to_scale(self.high)


class Evaluation(NamedTuple):
    """A setting and its errors."""

    setting: Mapping[str, Any]
    maes: tuple[float, ...]  # m/s, one for each boat; infinite if a prediction was not finite
    runs: list[list[float]] | None = None  # m/s, of each run and boat; NaN of one without steps that count

    @property
    def mae(self) -> float:
        """m/s, mean over boats."""
        return sum(self.maes) / len(self.maes)


def hyperparameter(
    estimator: Estimator, path: str, low: float | None = None, high: float | None = None, key: str | None = None
) -> Hyperparameter:
    """The hyperparameter at a dotted path, with its range; `key` is its name in an error."""
    key, known = key or path, hyperparameters(estimator)
    if path not in known:
        raise ConfigError(
            f"{key}: is no hyperparameter that can be tuned, expected one of {', '.join(known) or 'none'}"
        )
    part = known[path]
    values = part().detach().reshape(-1)
    if len(values) != 1:
        raise ConfigError(f"{key}: found {len(values)} values, expected one: a range is searched around one")
    # A number loses its last digits through the logarithm and back: 0.3, not 0.30000000000000004.
    default, kind = float(f"{values.item():.12g}"), type(part)
    low, high = (default if x is None else x for x in (low, high))
    for value in (low, high):
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ConfigError(f"{key}: found {value!r}, expected a number")
        kind(value, key)
    if low > high:
        raise ConfigError(f"{key}: found the range [{low}, {high}], expected the lower bound first")
    return Hyperparameter(path, kind, default, float(low), float(high))


def hyperparameters(estimator: Estimator) -> dict[str, Positive | UnitInterval]:
    """All numbers of an estimator that can be tuned, by path."""
    return {path: part for path, part in estimator.named_modules() if isinstance(part, Positive | UnitInterval)}


class BatchErrors(NamedTuple):
    """Sums over the steps of each run, and the state at the end."""

    errors: Tensor  # (runs, *settings, boats) of |error|, m/s
    steps: Tensor  # (runs, *settings, boats) that counted
    state: Any  # leaves (*settings, boats, …)

    @property
    def mae(self) -> Tensor:
        """m/s, `(*settings, boats)`; infinite if a prediction was not finite, so that it cannot win by the rest."""
        mean = self.errors.sum(0) / self.steps.sum(0)
        return torch.where(mean.isfinite(), mean, math.inf)


def element_errors(
    estimator: Estimator,
    fleet: Fleet,
    settings: Sequence[int] = (),
    advance: Callable[[float], None] = lambda share: None,
    measure: Measure = NEXT,
    device: str = "cpu",
) -> BatchErrors:
    """Errors of each setting on each run and boat; the state is carried from run to run.

    Its hyperparameters broadcast against the batch `(*settings, boats)`. `advance` receives the fraction completed
    since the last call. With the device "cuda" the kernels make the steps on a GPU.
    """
    batch, first = (*settings, len(fleet.boats)), middle(fleet.runs) if measure.kind == FREE else 0
    if measure.kind == FORECAST:
        like = next(chain(estimator.parameters(), estimator.buffers()), torch.zeros(()))
        ahead = ForecastSettings((measure.horizon,))
        top = max(LIMIT, getattr(estimator, "surge_max", LIMIT))  # a fast boat's
        estimator = Ensemble({"member": estimator}, {"own": Average()}, surge_max=top, watched=False, forecasts=ahead)
        ahead.to(like.device)
    length = max(1, min(CHUNK_STEPS, CHUNK_CELLS // math.prod(batch)))
    with torch.no_grad():
        state = estimator.init(batch)
        like = next(leaf for _, leaf in named_leaves(state) if leaf.is_floating_point())
        lanes, due = None, np.array([-1, -1])
        if device == "cuda":
            plan = program_for(description_of(estimator, None, "kernel") or {}, batch, array_of(like).dtype)
            lanes = Lanes(plan, plan.pack(arrays_of(state)))
            length, due = lanes.steps, plan.places(DUE)[0, :2] if DUE in plan.leaves else due
        errors, steps = [], []
        for index, run in enumerate(fleet.runs):
            free = measure.kind == FREE and index >= first
            stepped: Any = state if lanes is None else lanes.copied() if free else lanes
            total, count = like.new_zeros(batch), like.new_zeros(batch)
            samples = tensors(run.samples, like.dtype, like.device)
            for begin in range(0, len(run.time), length):
                part = tree_map(lambda x, a=begin: x[a : a + length], samples)
                step = clean(part, estimator.surge_limit)
                wide = tree_map(lambda x: x.reshape(len(x), *(1 for _ in settings), -1).expand(len(x), *batch), part)
                learns, surge = (x.reshape(len(x), *(1 for _ in settings), -1) for x in (step.learns, step.surge))
                if lanes is not None:
                    sums = stepped.run(*prepared(tree_map(array_of, wide), plan), free, due)[:2]
                    error, counted = (torch.from_numpy(x).reshape(batch) for x in sums)
                elif free:  # from the parameters at the end of the first half
                    stepped, predicted, _ = simulate(estimator, stepped, wide)
                elif measure.kind == FORECAST:
                    state, _, recorded = rollout(estimator, state, wide, record=[DUE])
                    predicted, persistence = recorded[DUE][..., 0, 0], recorded[DUE][..., 0, 1]
                    learns = learns & persistence.isfinite()  # a forecast became due
                else:
                    state, predicted, _ = rollout(estimator, state, wide)
                if lanes is None:
                    error = torch.where(learns, (predicted - surge).abs(), 0.0).sum(0)
                    counted = learns.expand(len(surge), *batch).sum(0)
                if index >= first:
                    total, count = total + error, count + counted
                advance(len(step.surge) / fleet.steps)
            errors.append(total)
            steps.append(count)
        totals = torch.stack(errors), torch.stack(steps)
        state = state if lanes is None else tree_of(state, plan.unpack(lanes.ends()))
    return BatchErrors(*totals, state.members["member"] if measure.kind == FORECAST else state)


def spread(estimator: Estimator, settings: Sequence[Setting]) -> Estimator:
    """The estimator with the settings as batch elements, `(settings, 1)`; a configuration of many takes minutes."""
    for path in settings[0]:
        old = estimator.get_submodule(path)
        batched = type(old)([[setting[path]] for setting in settings], old.name)
        estimator.set_submodule(path, batched.to(next(old.parameters())))
    return estimator


class Objective:
    """Evaluates settings over a fleet as batch elements, at most `elements` at once; on a GPU as many as fit."""

    def __init__(
        self,
        build: Build,
        fleet: Fleet,
        advance: Callable[[float], None] = lambda evaluations: None,
        elements: int = BATCH,
        measure: Measure = NEXT,
        device: str = "cpu",
    ):
        self.build, self.fleet, self.advance, self.measure, self.device = build, fleet, advance, measure, device
        if device == "cuda" and measure.kind != FORECAST:
            elements = most_lanes(description_of(build({}), None, "kernel") or {})
        self.batch = max(1, elements // len(fleet.boats))  # settings

    def __call__(self, settings: Sequence[Setting]) -> list[Evaluation]:
        """Each setting's MAE per boat."""
        evaluated = []
        for begin in range(0, len(settings), self.batch):
            part = settings[begin : begin + self.batch]
            estimator, advance = spread(self.build({}), part), partial(self._advance, len(part))
            device = self.device if len(part) > 1 else "cpu"  # numbers of a lane alone would be constants of its kernel
            errors = element_errors(estimator, self.fleet, (len(part),), advance, self.measure, device)
            maes, runs = errors.mae.tolist(), (errors.errors / errors.steps).moveaxis(1, 0).tolist()
            evaluated += [Evaluation(x, tuple(y), z) for x, y, z in zip(part, maes, runs, strict=True)]
        return evaluated

    def _advance(self, settings: int, share: float) -> None:
        self.advance(settings * share)
