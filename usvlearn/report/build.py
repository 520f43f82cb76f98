"""Builds the report of runs from their folders: all sections from the saved data of a season.

The library does not use Hydra: it receives functions that build objects from configuration nodes and that align logs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from usvlearn.core.lock import Lock
from usvlearn.core.samples import Fleet, tree_map
from usvlearn.core.unconfirmed import Questions, unconfirmed
from usvlearn.display.terminal import Activity, show
from usvlearn.engine.rollouts import stack
from usvlearn.errors import CheckpointError, ConfigError, UsvlearnError
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.evaluation.crossval import FreeErrors, cross_validate
from usvlearn.evaluation.diagnostics import explained, remarks
from usvlearn.evaluation.free_simulation import free_runs
from usvlearn.evaluation.season import Season
from usvlearn.report.front import MAIN, Front, overviews
from usvlearn.report.page import check_report_folder, write_report
from usvlearn.report.sections.cross import best_checkpoints, cross_section, fleet_matrices, fleet_section
from usvlearn.report.sections.errors import forecast_section, online_section, residual_section
from usvlearn.report.sections.events import events_section
from usvlearn.report.sections.fit import fit_section
from usvlearn.report.sections.fit_file import FOLDER as FIT
from usvlearn.report.sections.fit_file import SavedFit, saved_fits
from usvlearn.report.sections.network import network_section
from usvlearn.report.sections.parameters import cost_section, identified_section
from usvlearn.report.sections.section import Section
from usvlearn.report.sections.tracks import tracks_section
from usvlearn.report.summary import of_one_command, summary, undetermined
from usvlearn.report.tables import quoted
from usvlearn.report.track_maps import BoatTracks, saved_tracks
from usvlearn.report.viewer import viewer_data
from usvlearn.runs.files import CHECKPOINTS
from usvlearn.runs.saved import configuration, data_check, questions_of_runs, read_seasons, results


class Tools(NamedTuple):
    """Functions that a report needs from the command."""

    instantiate: Callable[..., Any]  # makes the object that a configuration node describes
    ensemble: Callable[[Mapping[str, Any]], Ensemble]  # that a configuration describes
    align: Callable[..., Fleet]  # recordings to a fleet, with the options of `align`
    console: Console
    trust: str | Sequence[str] | None = None  # the user's own modules that saved settings may name
    checked: Callable[[Mapping[str, Any]], Any] | None = None  # `align` with a data check, for a configuration

    def say(self, text: str) -> None:
        """Print a line, such as a command or a path."""
        show(text, to=self.console)


def read(folders: Sequence[Path], tools: Tools, data: Any = None) -> tuple[Ensemble, list[Season]]:
    """The ensemble of some runs, the oldest first, and the season of each boat, in their logs or in those of `data`."""
    ensemble, fleets = _built(folders, tools, data)
    return ensemble, read_seasons(folders, ensemble, fleets)


def _built(folders: Sequence[Path], tools: Tools, data: Any) -> tuple[Ensemble, list[Fleet]]:
    """The ensemble and the aligned logs; arguments as of `read`."""
    if data is not None and "_target_" not in data:
        raise ConfigError(f"data: found {', '.join(data)} alone, expected a file of configs/data: set data=NAME")
    settings = [configuration(folder, tools.trust) for folder in folders]
    last, sources = settings[-1], []
    for each in [setting["data"] for setting in settings] if data is None else [data]:
        if each not in sources:  # several folders may have used the same logs
            sources.append(each)
    try:
        ensemble = tools.ensemble(last)
        with Activity(tools.console):
            fleets = [tools.align(tools.instantiate(each), **last["align"]) for each in sources]
    except (TypeError, AttributeError, KeyError, OverflowError, MemoryError) as error:
        what = f"{type(error).__name__}: {error}"
        raise CheckpointError(f"{folders[-1]}: its settings cannot be used ({what:.200}): run it again") from error
    return ensemble, fleets


def evaluate(
    folders: Sequence[Path],
    report: Path,
    tools: Tools,
    data: Any = None,
    commands: Sequence[str] = (),
    paper: bool = False,
    asked: Questions | None = None,
    animate: bool = False,
    latex: bool = False,
) -> Path:
    """Judge every checkpoint of some runs and write the report, which names `commands`; returns its page.

    With `animate` also a GIF of the tracks of each boat; with `latex` also what a paper needs.
    """
    with Lock(report, "report"):
        check_report_folder(report)
        outcomes = [results(folder) for folder in folders]
        unfinished = [
            f"{folder} is not finished: the report covers the finished part."
            for folder, finished in zip(folders, outcomes, strict=True)
            if not finished
        ]
        checks = [data_check(folder) for folder in folders]
        questions = questions_of_runs(folders, tools.trust) | (asked or {})
        lines = unconfirmed(questions)
        if data is not None and tools.checked is not None:
            align = tools.checked({**configuration(folders[-1], tools.trust), "data": data})
            ensemble, fleets = _built(folders, tools._replace(align=align), data)
            checks = [align.json]
        else:
            ensemble, fleets = _built(folders, tools, data)
        seasons = read_seasons(folders, ensemble, fleets)
        with Activity(tools.console) as activity:
            activity.begin("simulating each checkpoint on each run", total=simulations(ensemble, seasons))
            known = known_quantities(outcomes[-1]) if data is None else {}
            fits = saved_fits(folders, [season.boat for season in seasons]) if data is None else {}
            tracks = saved_tracks(folders, outcomes, seasons, fleets) if data is None else {}
            sections, errors = assemble(ensemble, seasons, activity.advance, known, fits, tracks)
            front = front_of(ensemble, seasons, checks, activity.advance, fits, tracks)
            activity.begin("drawing the report")
            elsewhere = "Judged on other logs than those of the runs from which the boats learned."
            notes = [*unfinished, *([] if data is None else [elsewhere])]
            parts = [section if paper else section._replace(paper="") for section in sections]
            said = [*facts(seasons, folders), *lines, *notes]
            front = front._replace(notes=notes, unconfirmed=lines)
            page = write_report(report, said, parts, commands, errors, front)
            beside = _films(report, tracks, activity) if animate else []
            beside += _latex(report, folders[-1], sections, front) if latex else []
    for line in beside:
        tools.say(line)
    boats = {each.boat: each.quantities for each in front.boats}
    lines = summary(outcomes[-1], questions, boats) if data is None and outcomes[-1] else []
    next_one = f"usvlearn {'plan' if undetermined(boats, MAIN) else 'controller'} {quoted(folders[-1])}"
    show("", *lines, f"report       {page}", f"next         {next_one}", to=tools.console)
    return page


def _films(report: Path, tracks: Mapping[str, BoatTracks], activity: Activity) -> list[str]:
    """Write the animation of each boat's tracks; lines for the terminal."""
    from usvlearn.display.tensorboard import folder_names
    from usvlearn.report.animation import write_animation

    missions = {boat: each.mission for boat, each in tracks.items() if each.mission is not None and each.mission.ahead}
    if not missions:
        return ["no animation: the runs have no tracks, which need headings and positions or speeds (planar=true)"]
    activity.begin("drawing the animation")
    names = folder_names(missions)
    return [
        f"animation: {write_animation(report / 'figures' / f'tracks_{name}.gif', mission, boat)}"
        for name, (boat, mission) in zip(names, missions.items(), strict=True)
    ]


def _latex(report: Path, run: Path, sections: Sequence[Section], front: Front) -> list[str]:
    """Write LaTeX, figures and tables for a paper; lines for the terminal."""
    from usvlearn.model.read_boats import read_boats
    from usvlearn.report.latex import write_latex

    said, boats = [], []
    try:
        boats = read_boats(run / FIT if (run / FIT / CHECKPOINTS).is_dir() else run)
    except UsvlearnError as error:
        said = [f"no equation of the model: {error}"]
    quantities = {each.boat: each.batch or each.identified or {} for each in front.boats}
    first, *others = write_latex(report / "paper", sections, quantities, boats)
    return [*said, f"LaTeX: {first}, and {len(others)} figures, tables and equations beside it"]


def known_quantities(results: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """The true quantities of simulated boats that a run's results contain."""
    return {
        boat: {name: each["truth"] for name, each in quantities.items() if each.get("truth") is not None}
        for boat, quantities in results.get("identified", {}).items()
    }


def start_of(folder: Path, tools: Tools) -> Path:
    """The checkpoint of a finished run that is best for all of its boats (`best_start`)."""
    ensemble, seasons = read([folder], tools)
    return best_start(ensemble, seasons)


def simulations(ensemble: Ensemble, seasons: Sequence[Season]) -> int:
    """The steps that are simulated: every checkpoint and one more on every run of its boat, and one per boat on all."""
    steps = {season.boat: sum(int(run.steps.sum()) for run in season.runs) for season in seasons}
    matrices = len(_compared(ensemble)) * len(seasons) * sum(steps.values()) if len(seasons) > 1 else 0
    return sum((len(season.saved_in) + 1) * steps[season.boat] for season in seasons) + matrices


def facts(seasons: Sequence[Season], folders: Sequence[Path]) -> list[str]:
    """The data on which a report is based, one sentence each."""
    runs = [run for season in seasons for run in season.runs]
    hours = sum(float(run.samples.inputs.dt[run.steps].sum()) for run in runs) / 3600
    count = sum(len(season.saved_in) for season in seasons)
    boats = "1 boat" if len(seasons) == 1 else f"{len(seasons)} boats"
    return [
        f"{boats}, {len(runs)} runs, {hours:.1f} h measured, {count} checkpoints, of {', '.join(map(str, folders))}."
    ]


def assemble(
    ensemble: Ensemble,
    seasons: Sequence[Season],
    advance: Callable[[int], object] = lambda steps: None,
    known: Mapping[str, Mapping[str, float]] | None = None,
    fits: Mapping[str, SavedFit | str] | None = None,
    tracks: Mapping[str, BoatTracks] | None = None,
) -> tuple[list[Section], dict[str, FreeErrors]]:
    """Simulate, compare and draw: the sections, what is said first, and the errors of every cross-validation."""
    errors = {
        season.boat: cross_validate(ensemble, season.state, [run.samples for run in season.runs], advance=advance)
        for season in seasons
    }
    beside = remarks(ensemble)
    between = _between(ensemble, seasons, errors, advance) if len(seasons) > 1 else None
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
    """The first page: simulate each run free once."""
    free = {}
    for season in seasons:
        free[season.boat] = list(free_runs(ensemble, season))
        advance(sum(int(run.steps.sum()) for run in season.runs))
    boats = [
        each._replace(batch=of_one_command(fit.quantities, fit.lacks), doubted=bool(fit.doubts))
        if isinstance(fit := (fits or {}).get(each.boat), SavedFit)
        else each
        for each in overviews(ensemble, seasons, free, checks)
    ]
    return Front(boats, viewer_data(ensemble, seasons, free, tracks))


def best_start(ensemble: Ensemble, seasons: Sequence[Season]) -> Path:
    """The boat's last checkpoint whose open-loop simulations, on the runs of all boats, have the least MSE."""
    last = [len(season.saved_in) - 1 for season in seasons]
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
