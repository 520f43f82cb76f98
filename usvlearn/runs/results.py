"""The content of `results.json` and of `errors.csv`: all that a run is judged by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from usvlearn.core.samples import Fleet
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.ensemble.state import EnsembleState
from usvlearn.estimators.planar.layer import Planar, PlanarState
from usvlearn.evaluation.by_run import as_csv, one_step_sums, run_errors
from usvlearn.evaluation.events import events
from usvlearn.evaluation.free_simulation import FreeErrors, free_errors, has_halves, middle
from usvlearn.evaluation.horizons import ensemble_sums, horizon_scores
from usvlearn.evaluation.identification import Truth, as_results, identified_boats, identified_planar_boats
from usvlearn.evaluation.measure import measure_of
from usvlearn.evaluation.metrics import fleet_scores
from usvlearn.evaluation.networks import verdicts
from usvlearn.evaluation.tracks import track_scores
from usvlearn.runs.prediction_files import Published


def judged(
    ensemble: Ensemble,
    fleet: Fleet,
    state: EnsembleState,
    published: Published,
    halfway: Callable[[int], EnsembleState | None],
    truth: Truth,
    objective: Any = None,
    horizons: Sequence[float] = (),
    planar: Planar | None = None,
    beside: PlanarState | None = None,
) -> tuple[dict[str, Any], str]:
    """Scores, events, what was identified, the networks' verdicts, the objective; and the errors of each run, as CSV.

    Args:
        ensemble: that has learned.
        fleet: what was replayed.
        state: at the end, leaves `(boats, …)`.
        published: what was predicted.
        halfway: the state after the first so many runs; None if they were not all replayed.
        truth: of simulated boats, to be written beside what was identified.
        objective: of the configuration.
        horizons: of tracks, s, if there are any.
        planar, beside: what learned sway and yaw rate, and its state at the end; None: nothing did.
    """
    if planar is None or beside is None:
        boats = identified_boats(ensemble, state, fleet.boats)
    else:
        boats = identified_planar_boats(planar, beside, fleet.boats)
    found: dict[str, Any] = {
        "boats": fleet_scores(fleet, published.only("predictions", "halfwidths"), ensemble.names, ensemble.surge_limit),
        "events": events(fleet, published.only("thrusters", "health"), ensemble.accommodated),
        "rejected": fleet.rejected,
        **as_results(boats, truth),
    }
    if (ahead := ensemble_sums(ensemble, fleet, published.only("forecasts", "forecast_halfwidths"))) is not None:
        found["forecast"] = horizon_scores(ahead, fleet.boats)
    if horizons:
        parts = (stretch.arrays["tracks"] for stretch in published.only("predictions", "tracks")
                 if "tracks" in stretch.arrays)  # fmt: skip
        found["tracks"] = track_scores(parts, horizons, fleet.boats)
    if (free := _free(ensemble, fleet, halfway)) is not None:
        found["free"] = free.mae(fleet.boats, ensemble.names)
        found["free_fit"] = free.fit(fleet.boats, ensemble.names)
    if networks := verdicts(ensemble, state, fleet.boats):
        found["network"] = {
            boat: {name: each.json() for name, each in members.items()} for boat, members in networks.items()
        }
    measure = measure_of(objective, ensemble.output)
    one_step = one_step_sums(fleet, published.only("predictions"), len(ensemble.names), ensemble.surge_limit)
    errors = as_csv(run_errors(fleet, ensemble.names, one_step, ahead, free), ensemble.names)
    return found | {"output": ensemble.output, "measure": str(measure), "objective": measure.value(found)}, errors


def _free(ensemble: Ensemble, fleet: Fleet, halfway: Callable[[int], EnsembleState | None]) -> FreeErrors | None:
    """Errors of open-loop simulations of the boats that have runs in both halves; None if there are none."""
    first = middle(fleet.runs)
    elements = [has_halves(fleet, element) for element in range(len(fleet.boats))]
    if not any(elements) or (state := halfway(first)) is None:
        return None
    found = free_errors(ensemble, state, fleet, first)
    found.steps[:, [not each for each in elements]] = 0
    return found
