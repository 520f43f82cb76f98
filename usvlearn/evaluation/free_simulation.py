"""Simulates runs in open loop, from commands alone and without learning; errors over the second half of the runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from usvlearn.core.samples import Fleet, masks, tree_map
from usvlearn.errors import ConfigError
from usvlearn.evaluation.metrics import fit
from usvlearn.evaluation.season import Season

if TYPE_CHECKING:
    from usvlearn.estimators.ensemble.layer import Ensemble


class FreeErrors(NamedTuple):
    """Sums over the steps of each run."""

    errors: np.ndarray  # (runs, boats, estimators) of |simulated − measured|, m/s
    steps: np.ndarray  # (runs, boats) measured steps
    squares: np.ndarray  # (runs, boats, estimators) of their squares, m²/s²
    speeds: np.ndarray  # (runs, boats, 2) of the measured speed, m/s, and its square

    def fit(self, boats: Sequence[str], names: Sequence[str]) -> dict[str, dict[str, float | None]]:
        """By boat and estimator, percent (`usvlearn.evaluation.metrics.fit`); None where it is unknown."""
        squares, speeds = self.squares.sum(0), self.speeds.sum(0)
        spread = speeds[:, 1] - speeds[:, 0] ** 2 / np.maximum(self.steps.sum(0), 1)
        return self._each(boats, names, lambda element, k: fit(squares[element, k], spread[element]))

    def mae(self, boats: Sequence[str], names: Sequence[str]) -> dict[str, dict[str, float | None]]:
        """By boat and estimator, m/s; None where a boat has no measured step."""
        total, count = self.errors.sum(0), self.steps.sum(0)
        return self._each(boats, names, lambda element, k: float(total[element, k] / count[element]))

    def _each(
        self, boats: Sequence[str], names: Sequence[str], value: Callable[[int, int], float | None]
    ) -> dict[str, dict[str, float | None]]:
        count = self.steps.sum(0)
        return {
            boat: {name: value(element, k) if count[element] else None for k, name in enumerate(names)}
            for element, boat in enumerate(boats)
        }


def free_errors(ensemble: Ensemble, state: Any, fleet: Fleet, first: int) -> FreeErrors:
    """Simulate the runs from the index `first` on; the runs before have no steps. `state` has leaves `(boats, …)`.

    A simulation that leaves ± `surge_max` of the ensemble errs by that limit there.
    """
    import torch

    from usvlearn.engine.rollouts import simulate, tensors

    limit, shape = ensemble.surge_max, (len(fleet.runs), len(fleet.boats))
    by_estimator = (*shape, len(ensemble.names))
    sums = FreeErrors(np.zeros(by_estimator), np.zeros(shape, int), np.zeros(by_estimator), np.zeros((*shape, 2)))
    dtype = state.predictions.dtype
    with torch.no_grad():
        for index, run in enumerate(fleet.runs[first:], first):
            _, _, recorded = simulate(ensemble, state, tensors(run.samples, dtype), record=["predictions"])
            learns = masks(run.samples, ensemble.surge_limit).learns
            predicted = np.nan_to_num(recorded["predictions"].double().numpy(), nan=limit, posinf=limit, neginf=-limit)
            surge = np.where(learns, run.samples.surge, 0.0)
            error = np.where(learns[..., None], np.abs(predicted.clip(-limit, limit) - surge[..., None]), 0.0)
            sums.errors[index], sums.squares[index] = error.sum(0), (error * error).sum(0)
            sums.speeds[index] = np.stack([surge.sum(0), (surge * surge).sum(0)], -1)
            sums.steps[index] = learns.sum(0)
    return sums


class FreeRun(NamedTuple):
    """A run of one boat, simulated with parameters that were saved before it."""

    predictions: np.ndarray  # (time, estimators) m/s, within ± surge_max; NaN where no step was made
    learned: bool  # whether no parameters were saved before it, so that these have learned from it


def free_runs(ensemble: Ensemble, season: Season) -> Iterator[FreeRun]:
    """Simulate each run of a boat with the newest parameters of `Season.checkpoint_before`."""
    import torch

    from usvlearn.engine.rollouts import simulate, tensors

    limit = ensemble.surge_max
    for k, run in enumerate(season.runs):
        chosen, learned = season.checkpoint_before(k)
        state = tree_map(lambda x, one=chosen: x[one : one + 1], season.state)
        samples = tree_map(lambda x: x[:, None], run.samples)
        with torch.no_grad():
            _, _, saved = simulate(ensemble, state, tensors(samples, state.predictions.dtype), record=["predictions"])
        speed = np.nan_to_num(saved["predictions"][:, 0].double().numpy(), nan=limit, posinf=limit, neginf=-limit)
        mask = masks(run.samples, ensemble.surge_limit).steps[:, None]
        yield FreeRun(np.where(mask, speed.clip(-limit, limit), np.nan), learned)


def middle(runs: Sequence[Any]) -> int:
    """How many runs are the first half."""
    return len(runs) // 2


def has_halves(fleet: Fleet, element: int) -> bool:
    """Whether a boat has runs in both halves."""
    first = middle(fleet.runs)
    return all(any(run.lengths[element] for run in half) for half in (fleet.runs[:first], fleet.runs[first:]))


def check_halves(fleet: Fleet) -> None:
    """Raise a ConfigError unless each boat has runs in both halves."""
    for element, boat in enumerate(fleet.boats):
        if not has_halves(fleet, element):
            raise ConfigError(
                f"objective: found open-loop simulations, and too few logs of {boat}, expected two or more of each "
                "boat, about as many as of the others: the first half is learned, the second one is simulated"
            )
