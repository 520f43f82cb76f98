"""All sections of a report, from the saved data of a season."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from usvlearn.core.samples import tree_map
from usvlearn.engine.rollouts import stack
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.evaluation.crossval import FreeErrors, cross_validate
from usvlearn.evaluation.free_simulation import free_runs
from usvlearn.evaluation.members import explained, remarks
from usvlearn.evaluation.season import Season
from usvlearn.report.front import Front
from usvlearn.report.overview import overviews
from usvlearn.report.sections.cost import cost_section
from usvlearn.report.sections.cross import best_checkpoints, cross_section, fleet_matrices, fleet_section
from usvlearn.report.sections.errors import forecast_section, online_section, residual_section
from usvlearn.report.sections.events import events_section
from usvlearn.report.sections.fit import fit_section
from usvlearn.report.sections.fit_file import SavedFit
from usvlearn.report.sections.network import network_section
from usvlearn.report.sections.parameters import Truth, identified_section, parameters_section
from usvlearn.report.sections.section import Section
from usvlearn.report.sections.tracks import tracks_section
from usvlearn.report.track_maps import BoatTracks
from usvlearn.report.viewer_data import viewer_data


def simulations(ensemble: Ensemble, seasons: Sequence[Season]) -> int:
    """The steps that are simulated: every checkpoint and one more on every run of its boat, and one checkpoint per boat
    on all.
    """
    steps = {season.boat: sum(int(run.steps.sum()) for run in season.runs) for season in seasons}
    matrices = len(_compared(ensemble)) * len(seasons) * sum(steps.values()) if len(seasons) > 1 else 0
    return sum((len(season.own) + 1) * steps[season.boat] for season in seasons) + matrices


def facts(seasons: Sequence[Season], folders: Sequence[Path]) -> list[str]:
    """The data on which a report is based, one sentence each."""
    runs = [run for season in seasons for run in season.runs]
    hours = sum(float(run.samples.inputs.dt[run.steps].sum()) for run in runs) / 3600
    sets = sum(len(season.own) for season in seasons)
    boats = "1 boat" if len(seasons) == 1 else f"{len(seasons)} boats"
    return [
        f"{boats}, {len(runs)} runs, {hours:.1f} h measured, {sets} checkpoints, of {', '.join(map(str, folders))}."
    ]


def assemble(
    ensemble: Ensemble,
    seasons: Sequence[Season],
    truth: Truth,
    advance: Callable[[int], object] = lambda steps: None,
    known: Mapping[str, Mapping[str, float]] | None = None,
    fits: Mapping[str, SavedFit | str] | None = None,
    tracks: Mapping[str, BoatTracks] | None = None,
) -> tuple[list[Section], dict[str, FreeErrors]]:
    """Simulate, compare and draw.

    Args:
        ensemble: to which all checkpoints belong.
        seasons: of all boats.
        truth: true parameters of simulated boats (see `usvlearn.simulate.truth`), else empty.
        advance: receives the number of simulated steps, for a progress bar.
        known: true quantities of simulated boats at the end.
        fits: batch fits of the boats (`saved_fits`).
        tracks: of the boats (`saved_tracks`).

    Returns:
        The sections, what a boat's owner asks first, and the errors of every boat's cross-validation.
    """
    errors = {
        season.boat: cross_validate(ensemble, season.state, [run.samples for run in season.runs], advance=advance)
        for season in seasons
    }
    beside = remarks(ensemble)
    between = _between(ensemble, seasons, errors, advance) if len(seasons) > 1 else None
    # Runs of a simulated season are named after their mission: 001_convoy is the first.
    mission = {
        season.boat: np.array([int(run.name.partition("_")[0]) - 1 for run in season.runs])
        for season in seasons
        if season.boat in truth
    }
    sections: list[Section | None] = [
        fit_section(seasons, ensemble, fits or {}, known or {}),
        identified_section(seasons, ensemble, known or {}),
        forecast_section(seasons, ensemble),
        tracks_section(tracks or {}),
        events_section(seasons, ensemble),
        online_section(seasons, ensemble.names, beside, explained(ensemble)),
        residual_section(seasons, ensemble),
        cross_section(seasons, errors, beside),
        between,
        parameters_section(seasons, ensemble, truth, mission),
        network_section(seasons, ensemble, errors),
        cost_section(ensemble),
    ]
    return [section for section in sections if section is not None], errors


def front_of(
    ensemble: Ensemble,
    seasons: Sequence[Season],
    checks: Sequence[Any],
    advance: Callable[[int], object] = lambda steps: None,
    fits: Mapping[str, SavedFit | str] | None = None,
    tracks: Mapping[str, BoatTracks] | None = None,
) -> Front:
    """The first page: simulate each run free once.

    Args:
        ensemble, seasons, advance, fits, tracks: as of `assemble`.
        checks: findings of the data checks, as of `overviews`.
    """
    free = {}
    for season in seasons:
        free[season.boat] = list(free_runs(ensemble, season))
        advance(sum(int(run.steps.sum()) for run in season.runs))
    boats = [
        each._replace(batch=fit.quantities, doubted=bool(fit.doubts))
        if isinstance(fit := (fits or {}).get(each.boat), SavedFit)
        else each
        for each in overviews(ensemble, seasons, free, checks)
    ]
    return Front(boats, viewer_data(ensemble, seasons, free, tracks))


def best_start(ensemble: Ensemble, seasons: Sequence[Season]) -> Path:
    """The boat's last checkpoint whose open-loop simulations, on the runs of all boats, have the least MSE.

    Args:
        ensemble: to which the checkpoints belong.
        seasons: of all boats.
    """
    last = [len(season.own) - 1 for season in seasons]
    method = _compared(ensemble)[0]
    matrix = fleet_matrices(seasons, _each_on_all(ensemble, seasons, last), [method])[method]
    best = int(np.nanargmin(matrix.mean(1)))
    return seasons[best].paths[-1]


def _compared(ensemble: Ensemble) -> list[str]:
    """The methods by which boats are compared: the paper's average, if it exists, and the ensemble's output."""
    return list(dict.fromkeys(name for name in ("average", ensemble.output) if name in ensemble.names))


def _each_on_all(
    ensemble: Ensemble,
    seasons: Sequence[Season],
    chosen: Sequence[int],
    advance: Callable[[int], object] = lambda steps: None,
) -> dict[str, FreeErrors]:
    """The errors of one checkpoint of each boat on all runs of each boat."""
    states = [tree_map(lambda x, k=k: x[k], season.state) for season, k in zip(seasons, chosen, strict=True)]
    return {
        season.boat: cross_validate(ensemble, stack(states), [run.samples for run in season.runs], advance=advance)
        for season in seasons
    }


def _between(
    ensemble: Ensemble, seasons: Sequence[Season], errors: Mapping[str, FreeErrors], advance: Callable[[int], object]
) -> Section:
    matrices: dict[str, np.ndarray] = {}
    best: dict[str, list[float]] = {}
    for method in _compared(ensemble):
        chosen = best_checkpoints(seasons, errors, method)
        between = _each_on_all(ensemble, seasons, chosen, advance)
        matrices |= fleet_matrices(seasons, between, [method])
        best[method] = [float(season.hours[k]) for season, k in zip(seasons, chosen, strict=True)]
    return fleet_section(seasons, matrices, best)
