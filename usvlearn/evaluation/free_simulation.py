"""Errors of free runs: the second half of a fleet's runs, simulated from commands alone; nothing is learned there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from usvlearn.errors import ConfigError
from usvlearn.signals import Fleet, masks

if TYPE_CHECKING:
    from usvlearn.estimators.ensemble.layer import Ensemble


class FreeErrors(NamedTuple):
    """Sums over the steps of each run."""

    errors: np.ndarray  # (runs, boats, estimators) of |simulated − measured|, m/s
    steps: np.ndarray  # (runs, boats) measured steps

    def mae(self, boats: Sequence[str], names: Sequence[str]) -> dict[str, dict[str, float | None]]:
        """By boat and estimator, m/s; None where a boat has no measured step."""
        total, count = self.errors.sum(0), self.steps.sum(0)
        return {
            boat: {name: float(total[lane, k] / count[lane]) if count[lane] else None for k, name in enumerate(names)}
            for lane, boat in enumerate(boats)
        }


def free_errors(ensemble: Ensemble, state: Any, fleet: Fleet, first: int) -> FreeErrors:
    """Simulate the runs from the index `first` on; the runs before have no steps in the result.

    A simulation that leaves ± `surge_max` of the ensemble errs by that limit there.

    Args:
        ensemble: an ensemble.
        state: leaves `(boats, …)`.
        fleet: aligned runs.
        first: index of the first run that is simulated.
    """
    import torch

    from usvlearn.rollouts import simulate, tensors

    limit, shape = ensemble.surge_max, (len(fleet.runs), len(fleet.boats))
    found = FreeErrors(np.zeros((*shape, len(ensemble.names))), np.zeros(shape, int))
    dtype = state.predictions.dtype
    with torch.no_grad():
        for index, run in enumerate(fleet.runs[first:], first):
            _, _, kept = simulate(ensemble, state, tensors(run.samples, dtype), record=["predictions"])
            learns = masks(run.samples, ensemble.surge_limit).learns
            predicted = np.nan_to_num(kept["predictions"].double().numpy(), nan=limit, posinf=limit, neginf=-limit)
            error = np.abs(predicted.clip(-limit, limit) - np.nan_to_num(run.samples.surge)[..., None])
            found.errors[index] = np.where(learns[..., None], error, 0.0).sum(0)
            found.steps[index] = learns.sum(0)
    return found


def middle(runs: Sequence[Any]) -> int:
    """How many runs are the first half."""
    return len(runs) // 2


def has_halves(fleet: Fleet, lane: int) -> bool:
    """Whether a boat has runs in both halves."""
    first = middle(fleet.runs)
    return all(any(run.lengths[lane] for run in half) for half in (fleet.runs[:first], fleet.runs[first:]))


def check_halves(fleet: Fleet) -> None:
    """Raise a ConfigError unless each boat has runs in both halves."""
    for lane, boat in enumerate(fleet.boats):
        if not has_halves(fleet, lane):
            raise ConfigError(
                f"objective: found free runs, and too few logs of {boat}, expected two or more of each boat, about as "
                "many as of the others: the first half is learned, the second one is simulated"
            )
