"""What the first page of a report says of each boat: who it is, what was identified, how good it is, what is wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.samples import tree_map
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.joint.excitation_warnings import Quantity
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.evaluation.diagnostics import events, identified_boats
from usvlearn.evaluation.free_simulation import FreeRun
from usvlearn.evaluation.horizons import ensemble_scores
from usvlearn.evaluation.metrics import PERSISTENCE, scores
from usvlearn.evaluation.season import Season, SeasonRun

MAIN = {  # the quantities that are shown first, in words
    "steady_speed_full": "Steady speed at full ahead",
    "thrust_full_left": "Full thrust ahead of the left side",
    "thrust_full_right": "Full thrust ahead of the right side",
    "drag_half_speed": "Drag at half of that speed",
    "time_constant": "Time constant",
    "stopping_distance": "Stopping distance with thrusters off",
    "mass": "Mass",
}


class Ahead(NamedTuple):
    """Errors of the ensemble over one horizon."""

    what: str
    mae: float | None  # m/s
    skill: float | None
    coverage: float | None  # of the 90 % interval


class RunRow(NamedTuple):
    """A run in numbers."""

    name: str
    minutes: float  # in which the speed was measured
    speed: float | None  # m/s, the mean
    mae: float | None  # m/s, one step ahead
    free: float | None  # m/s, in an open-loop simulation
    learned: bool  # whether the open-loop simulation's parameters have learned from it


class Overview(NamedTuple):
    """One boat."""

    boat: str
    hours: float  # in which the speed was measured
    runs: Sequence[RunRow]
    identified: Identified | None
    ahead: Sequence[Ahead]  # the next step first; empty if no run was replayed
    free: float | None  # m/s, MAE of the open-loop simulations with parameters that have not learned from them
    fit: float | None  # percent, one step ahead (`usvlearn.evaluation.metrics.fit`)
    free_fit: float | None  # percent, of the same open-loop simulations
    events: Sequence[Mapping[str, Any]] | None  # None if nobody watched
    findings: Sequence[Mapping[str, Any]] | None  # of the data check; None if there was none
    batch: Mapping[str, Quantity] | None = None  # the quantities of a batch fit, if there is one
    doubted: bool = False  # whether something speaks against their use


def overviews(
    ensemble: Ensemble, seasons: Sequence[Season], free: Mapping[str, Sequence[FreeRun]], checks: Sequence[Any] = ()
) -> list[Overview]:
    """What is said of each boat.

    Args:
        ensemble: that was replayed.
        seasons: of all boats.
        free: each boat's open-loop simulations.
        checks: the lists of findings of data checks; None where there was none.
    """
    checks = [check for check in checks if isinstance(check, list)]
    findings = [each for check in checks for each in check if isinstance(each, Mapping)]
    return [
        _overview(
            ensemble,
            season,
            free[season.boat],
            [each for each in findings if each.get("boat") in (None, "", season.boat)] if checks else None,
        )
        for season in seasons
    ]


def _overview(
    ensemble: Ensemble, season: Season, free: Sequence[FreeRun], findings: Sequence[Mapping[str, Any]] | None
) -> Overview:
    column = ensemble.names.index(ensemble.output)
    rows = [_row(run, made, column) for run, made in zip(season.runs, free, strict=True)]
    unseen = [(row.free, int(run.steps.sum())) for run, row in zip(season.runs, rows, strict=True) if not row.learned]
    total = sum(steps for error, steps in unseen if error is not None)
    ahead, fit = _ahead(ensemble, season)
    fleet, published = season.replayed
    watched = [each for each in published if np.isfinite(each[2].get("thrusters", np.nan)).any()]
    last = tree_map(lambda leaf: leaf[-1:], season.state)
    return Overview(
        season.boat,
        sum(row.minutes for row in rows) / 60,
        rows,
        identified_boats(ensemble, last, [season.boat]).get(season.boat),
        ahead,
        sum(error * steps for error, steps in unseen if error is not None) / total if total else None,
        fit,
        _free_fit(season, free, column),
        events(fleet, published, ensemble.accommodated)[season.boat] if watched else None,
        findings,
    )


def _row(run: SeasonRun, free: FreeRun, column: int) -> RunRow:
    steps = run.steps
    surge = run.samples.surge[steps]
    made = run.published["predictions"][steps, column] if run.published else np.full(len(surge), np.nan)
    return RunRow(
        run.name,
        float(run.samples.inputs.dt[steps].sum()) / 60,
        _mean(surge),
        _mean(np.abs(made - surge)),
        _mean(np.abs(free.predictions[steps, column] - surge)),
        free.learned,
    )


def _mean(x: np.ndarray) -> float | None:
    """None where there is no number, or one is unknown."""
    return float(x.mean()) if len(x) and np.isfinite(x).all() else None


def _free_fit(season: Season, free: Sequence[FreeRun], column: int) -> float | None:
    """The fit of the open-loop simulations whose parameters have not learned from them; None without."""
    unseen = [(run, made) for run, made in zip(season.runs, free, strict=True) if not made.learned]
    predictions = [made.predictions[run.steps, column] for run, made in unseen]
    if not sum(map(len, predictions)):
        return None
    surge = np.concatenate([run.samples.surge[run.steps] for run, _ in unseen])
    found = scores(np.concatenate(predictions)[:, None], surge, ["free"])["free"]["fit"]
    return None if found is None else float(found)


def _ahead(ensemble: Ensemble, season: Season) -> tuple[list[Ahead], float | None]:
    """The errors one step ahead, and of the forecasts, if runs were replayed; the fit one step ahead."""
    runs = [run for run in season.runs if run.published]
    if not runs:
        return [], None
    names = list(dict.fromkeys(name for name in (PERSISTENCE, ensemble.output) if name in ensemble.names))
    places = [ensemble.names.index(name) for name in names]
    predictions = np.concatenate([run.published["predictions"][:, places] for run in runs])
    surge = np.concatenate([np.where(run.steps, run.samples.surge, np.nan) for run in runs])
    widths = [run.published["halfwidths"][:, places] for run in runs if "halfwidths" in run.published]
    row = scores(predictions, surge, names, np.concatenate(widths) if len(widths) == len(runs) else None)[names[-1]]
    found = [Ahead("the next step", row["mae"], row["skill"], row.get("coverage"))]
    kept = season._replace(runs=tuple(run for run in runs if "forecasts" in run.published))
    if kept.runs:
        ahead = ensemble_scores(ensemble, *kept.replayed).get(season.boat, {}).get(ensemble.output, {})
        found += [Ahead(f"{h} s", row["mae"], row["skill"], row.get("covers")) for h, row in ahead.items()]
    return found, row["fit"]
