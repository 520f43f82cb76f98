"""What a run, a sweep or a tuning minimises: `output` of the configuration.

output=ensemble                 the MAE of this rule one step ahead
output=ensemble.forecast.10     that of its forecasts over 10 s, one of forecasts.horizons
output=ensemble.free            that of its free runs: the second half of each boat's runs, from commands alone, with
                                the parameters learned by the end of the first half
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from usvlearn.errors import ConfigError
from usvlearn.signals import Fleet, masks

if TYPE_CHECKING:
    from usvlearn.estimators.ensemble.layer import Ensemble

ONE_STEP, FORECAST, FREE = "mae", "forecast", "free"


class Measure(NamedTuple):
    """A rule of the ensemble, and which of its errors counts."""

    rule: str
    kind: str = ONE_STEP
    horizon: float = 0.0  # s, of FORECAST


def measure_of(output: Any) -> Measure:
    """What `output` names.

    Raises:
        ConfigError: it has another form.

    >>> measure_of("ensemble"), measure_of("ensemble.forecast.10")
    (Measure(rule='ensemble', kind='mae', horizon=0.0), Measure(rule='ensemble', kind='forecast', horizon=10.0))
    """
    rule, dot, kind = str(output).partition(".")
    if not dot:
        return Measure(rule)
    if kind == FREE:
        return Measure(rule, FREE)
    kind, _, horizon = kind.partition(".")
    try:
        if kind == FORECAST and float(horizon) > 0:
            return Measure(rule, FORECAST, float(horizon))
    except ValueError:
        pass
    raise ConfigError(f"output: found {output!r}, expected RULE, RULE.forecast.SECONDS or RULE.free")


def check_measure(measure: Measure, ensemble: Ensemble, fleet: Fleet) -> None:
    """Raise a ConfigError unless an ensemble makes what is measured, and there are enough runs."""
    if measure.kind == FORECAST:
        horizons = [] if ensemble.forecasts is None else ensemble.forecasts.horizons.tolist()
        if measure.horizon not in horizons:
            raise ConfigError(
                f"output: found a forecast over {measure.horizon:g} s, expected one of forecasts.horizons: "
                f"{', '.join(f'{h:g}' for h in horizons) or 'there are none'}"
            )
    if measure.kind == FREE:
        check_halves(fleet)


def check_halves(fleet: Fleet) -> None:
    """Raise a ConfigError unless each boat has runs in both halves."""
    first = middle(fleet.runs)
    for lane, boat in enumerate(fleet.boats):
        if not all(any(run.lengths[lane] for run in half) for half in (fleet.runs[:first], fleet.runs[first:])):
            raise ConfigError(
                f"output: found free runs, and too few logs of {boat}, expected two or more of each boat, about as "
                "many as of the others: the first half is learned, the second one is simulated"
            )


def free_mae(ensemble: Ensemble, state: Any, fleet: Fleet, first: int) -> dict[str, dict[str, float | None]]:
    """MAE of free runs by boat and estimator, m/s, from the run with index `first` on; nothing is learned.

    Args:
        ensemble: an ensemble.
        state: leaves `(boats, …)`.
        fleet: aligned runs.
        first: index of the first run that is simulated.

    Returns:
        None where a boat has no measured step. A simulation that leaves ± `surge_max` errs by that limit there.
    """
    import torch

    from usvlearn.rollouts import simulate, tensors

    limit, names = ensemble.surge_max, ensemble.names
    total, count = np.zeros((len(fleet.boats), len(names))), np.zeros(len(fleet.boats))
    dtype = state.predictions.dtype
    with torch.no_grad():
        for run in fleet.runs[first:]:
            _, _, kept = simulate(ensemble, state, tensors(run.samples, dtype), record=["predictions"])
            learns = masks(run.samples, ensemble.surge_limit).learns
            predicted = np.nan_to_num(kept["predictions"].double().numpy(), nan=limit, posinf=limit, neginf=-limit)
            error = np.abs(predicted.clip(-limit, limit) - np.nan_to_num(run.samples.surge)[..., None])
            total += np.where(learns[..., None], error, 0.0).sum(0)
            count += learns.sum(0)
    return {
        boat: {name: float(total[lane, k] / count[lane]) if count[lane] else None for k, name in enumerate(names)}
        for lane, boat in enumerate(fleet.boats)
    }


def middle(runs: Sequence[Any]) -> int:
    """How many runs are the first half."""
    return len(runs) // 2


def mean_of(errors: Mapping[str, Mapping[str, float | None]], name: str) -> float:
    """The mean over boats; NaN where one has none.

    >>> mean_of({"a": {"x": 0.1}, "b": {"x": 0.3}}, "x")
    0.2
    """
    found = [row[name] for row in errors.values()]
    known = [x for x in found if x is not None]
    return sum(known) / len(known) if known and len(known) == len(found) else float("nan")
