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

import torch
from torch import Tensor, nn

from usvlearn.core.hyperparameters import Positive, UnitInterval
from usvlearn.core.protocol import Estimator, check_estimator, clean
from usvlearn.core.samples import LIMIT, Fleet, named_leaves, tree_map
from usvlearn.engine.rollouts import rollout, simulate, tensors
from usvlearn.errors import ConfigError
from usvlearn.estimators.ensemble.combiners.layer import Average
from usvlearn.estimators.ensemble.forecasts.layer import ForecastSettings
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.evaluation.free_simulation import middle
from usvlearn.evaluation.objective import FORECAST, FREE, Measure

Setting = dict[str, float]  # dotted path -> value
Build = Callable[[Mapping[str, Any]], Estimator]  # from values by dotted path; numbers, or a list (settings, 1) of them
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

    def from_scale(self, x: float) -> float:
        """The legal value at a place on the scale, rounded to four digits, as it is evaluated and shown."""
        value = self.value(x)
        if self.kind is Positive or x < 0:
            value = float(f"{value:.4g}")
        else:  # four digits of the distance to 1
            value = round(1 - float(f"{math.exp(-x) / (1 + math.exp(-x)):.4g}"), 15)
        return min(max(value, self.low), self.high)

    def spaced(self, low: float, high: float, count: int) -> list[float]:
        """Values at equal distances from `low` to `high`, both on the scale; a single value is the middle."""
        places = [(low + high) / 2] if count == 1 else [low + (high - low) * k / (count - 1) for k in range(count)]
        return [self.from_scale(x) for x in places]

    @property
    def span(self) -> tuple[float, float]:
        """The range on the scale."""
        return self.to_scale(self.low), self.to_scale(self.high)


class Evaluation(NamedTuple):
    """A setting and its errors."""

    setting: Mapping[str, Any]
    maes: tuple[float, ...]  # m/s, one for each boat; infinite if a prediction was not finite

    @property
    def mae(self) -> float:
        """m/s, mean over boats."""
        return sum(self.maes) / len(self.maes)


def hyperparameter(
    estimator: Estimator, path: str, low: float | None = None, high: float | None = None, key: str | None = None
) -> Hyperparameter:
    """The hyperparameter at a path of an estimator, with the range in which it is tuned.

    Args:
        estimator: with the default settings.
        path: dotted, as in its configuration.
        low, high: the range; by default only the default value.
        key: its name in an error; by default the path.

    Raises:
        ConfigError: there is no tunable number at the path, or the range is not legal.
    """
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


def check_one_estimator(name: str, value: Any) -> Estimator:
    """Return `value` if it is an estimator that can be tuned, else raise a ConfigError."""
    return check_estimator(name, value)


class BatchErrors(NamedTuple):
    """Sums over the steps of each run, and the state at the end."""

    errors: Tensor  # (runs, *settings, boats) of |error|, m/s
    steps: Tensor  # (runs, *settings, boats) that counted
    state: Any  # leaves (*settings, boats, …)

    @property
    def mae(self) -> Tensor:
        """m/s, `(*settings, boats)`; infinite if a prediction was not finite, so that a batch element cannot win by the
        rest.
        """
        found = self.errors.sum(0) / self.steps.sum(0)
        return torch.where(found.isfinite(), found, math.inf)


def element_errors(
    estimator: Estimator,
    fleet: Fleet,
    settings: Sequence[int] = (),
    advance: Callable[[float], None] = lambda share: None,
    measure: Measure = NEXT,
) -> BatchErrors:
    """Errors of each setting on each run and boat; the state is carried from run to run.

    Args:
        estimator: its hyperparameters broadcast against the batch `(*settings, boats)`; all is done on its device.
        fleet: aligned runs.
        settings: the batch before the boats.
        advance: receives the fraction completed since the last call.
        measure: which error counts.
    """
    batch, first = (*settings, len(fleet.boats)), middle(fleet.runs) if measure.kind == FREE else 0
    if measure.kind == FORECAST:
        own = next(chain(estimator.parameters(), estimator.buffers()), torch.zeros(()))
        ahead = ForecastSettings((measure.horizon,))
        top = max(LIMIT, getattr(estimator, "surge_max", LIMIT))  # a fast boat's
        estimator = Ensemble({"member": estimator}, {"own": Average()}, surge_max=top, watched=False, forecasts=ahead)
        ahead.to(own.device)
    length = max(1, min(CHUNK_STEPS, CHUNK_CELLS // math.prod(batch)))
    with torch.no_grad():
        state = estimator.init(batch)
        like = next(leaf for _, leaf in named_leaves(state) if leaf.is_floating_point())
        errors, steps = [], []
        for index, run in enumerate(fleet.runs):
            free = measure.kind == FREE and index >= first
            own = state
            total, count = like.new_zeros(batch), like.new_zeros(batch)
            samples = tensors(run.samples, like.dtype, like.device)
            for begin in range(0, len(run.time), length):
                part = tree_map(lambda x, a=begin: x[a : a + length], samples)
                step = clean(part, estimator.surge_limit)
                wide = tree_map(lambda x: x.reshape(len(x), *(1 for _ in settings), -1).expand(len(x), *batch), part)
                learns, surge = (x.reshape(len(x), *(1 for _ in settings), -1) for x in (step.learns, step.surge))
                if free:  # from the parameters at the end of the first half
                    own, predicted, _ = simulate(estimator, own, wide)
                elif measure.kind == FORECAST:
                    state, _, kept = rollout(estimator, state, wide, record=[DUE])
                    predicted, persistence = kept[DUE][..., 0, 0], kept[DUE][..., 0, 1]
                    learns = learns & persistence.isfinite()  # a forecast became due
                else:
                    state, predicted, _ = rollout(estimator, state, wide)
                if index >= first:
                    total += torch.where(learns, (predicted - surge).abs(), 0.0).sum(0)
                    count += learns.expand(len(surge), *batch).sum(0)
                advance(len(step.surge) / fleet.steps)
            errors.append(total)
            steps.append(count)
        made = torch.stack(errors), torch.stack(steps)
    return BatchErrors(*made, state.members["member"] if measure.kind == FORECAST else state)


class Objective:
    """Evaluates settings of one estimator over a fleet, as batch elements.

    Args:
        build: makes the estimator.
        fleet: aligned runs.
        advance: receives the number of evaluations completed since the last call, as a float.
        batch elements: settings × boats in one batch, at most.
        measure: which error counts.
    """

    def __init__(
        self,
        build: Build,
        fleet: Fleet,
        advance: Callable[[float], None] = lambda evaluations: None,
        elements: int = BATCH,
        measure: Measure = NEXT,
    ):
        self.build, self.fleet, self.advance, self.measure = build, fleet, advance, measure
        self.batch = max(1, elements // len(fleet.boats))  # settings

    def __call__(self, settings: Sequence[Setting]) -> list[Evaluation]:
        """Each setting's MAE per boat."""
        found = []
        for begin in range(0, len(settings), self.batch):
            part = settings[begin : begin + self.batch]
            estimator = self.build({path: [[setting[path]] for setting in part] for path in part[0]})
            advance = partial(self._advance, len(part))
            maes = element_errors(estimator, self.fleet, (len(part),), advance, measure=self.measure).mae
            found += [Evaluation(setting, tuple(row)) for setting, row in zip(part, maes.tolist(), strict=True)]
        return found

    def _advance(self, settings: int, share: float) -> None:
        self.advance(settings * share)
