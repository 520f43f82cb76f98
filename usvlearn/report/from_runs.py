"""From the folders of runs to their report.

The library does not use Hydra: it receives functions that build objects from configuration nodes and that align logs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console

from usvlearn.core.lock import Lock
from usvlearn.core.samples import Fleet, speed_limit
from usvlearn.core.unconfirmed import Questions, unconfirmed
from usvlearn.display.activity_bar import Activity
from usvlearn.display.terminal import show
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.evaluation.season import Season
from usvlearn.report.assembly import assemble, best_start, facts, front_of, simulations
from usvlearn.report.page import check_report_folder, write_report
from usvlearn.report.sections.fit_file import saved_fits
from usvlearn.report.sections.parameters import Truth
from usvlearn.report.sections.section import Section
from usvlearn.report.track_maps import saved_tracks
from usvlearn.runs.saved import configuration, data_check, questions_of_runs, read_seasons, results


class Tools(NamedTuple):
    """Functions that a report needs from the command."""

    instantiate: Callable[..., Any]  # makes the object that a configuration node describes
    align: Callable[..., Fleet]  # recordings to a fleet, with the options of `align`
    truth: Callable[[Sequence[Mapping[str, Any]], float], Truth]  # of sources of data, and a declared mass, kg
    console: Console
    trust: str | Sequence[str] | None = None  # the user's own modules that saved settings may name
    checked: Callable[[Mapping[str, Any]], Any] | None = None  # `align` with a data check, for a configuration

    def say(self, text: str) -> None:
        """Print a line, such as a command or a path."""
        show(text, to=self.console)


def read(folders: Sequence[Path], tools: Tools, data: Any = None) -> tuple[Ensemble, list[Season], Truth]:
    """The ensemble of some runs, the season of each boat, and the true parameters if they are known.

    Args:
        folders: of the runs, the oldest first.
        tools: see `Tools`.
        data: configuration of other logs of the same boats; by default the logs of the runs.

    Raises:
        CheckpointError, ConfigError: the saved files cannot be read, or do not fit the data.
    """
    ensemble, fleets, truth = _built(folders, tools, data)
    return ensemble, read_seasons(folders, ensemble, fleets), truth


def _built(folders: Sequence[Path], tools: Tools, data: Any) -> tuple[Ensemble, list[Fleet], Truth]:
    """The ensemble, the aligned logs and the truth; arguments and errors as of `read`."""
    if data is not None and "_target_" not in data:
        raise ConfigError(f"data: found {', '.join(data)} alone, expected a file of configs/data: set data=NAME")
    settings = [configuration(folder, tools.trust) for folder in folders]
    last, sources = settings[-1], []
    for each in [found["data"] for found in settings] if data is None else [data]:
        if each not in sources:  # several folders may have used the same logs
            sources.append(each)
    try:
        combiners = tools.instantiate(last["combiners"], _convert_="all")
        forecasts = last.get("forecasts") and tools.instantiate(last["forecasts"])
        output = str(last["output"]).partition(".")[0] if last.get("output") else None  # older ones named a measure
        members, knows = tools.instantiate(last["estimators"]), bool(last.get("conditional", False))
        limit = speed_limit(last["vehicle"]["surge_max"])
        ensemble = Ensemble(members, combiners, output, surge_max=limit, forecasts=forecasts, conditional=knows)
        with Activity(tools.console):
            fleets = [tools.align(tools.instantiate(each), **last["align"]) for each in sources]
    except (TypeError, AttributeError, KeyError, OverflowError, MemoryError) as error:
        what = f"{type(error).__name__}: {error}"
        raise CheckpointError(f"{folders[-1]}: its settings cannot be used ({what:.200}): run it again") from error
    truth = tools.truth(sources, last["vehicle"]["mass"]) if data is None else {}  # only for the logs of the runs
    return ensemble, fleets, truth


def evaluate(
    folders: Sequence[Path],
    report: Path,
    tools: Tools,
    data: Any = None,
    more: Sequence[Section] = (),
    commands: Sequence[str] = (),
    paper: bool = False,
    asked: Questions | None = None,
) -> Path:
    """Judge every checkpoint of some runs and write the report; returns its page.

    Args:
        folders, tools, data: as of `read`.
        report: its folder.
        more: sections to put first.
        commands: that make the report again.
        paper: whether the paper's results stand beside those found here.
        asked: the open questions of the other logs.
    """
    with Lock(report, "report"):
        check_report_folder(report)
        found = [results(folder) for folder in folders]
        unfinished = [
            f"{folder} is not finished: the report covers the finished part."
            for folder, finished in zip(folders, found, strict=True)
            if not finished
        ]
        checks = [data_check(folder) for folder in folders]
        told = unconfirmed(questions_of_runs(folders, tools.trust) | (asked or {}))
        if data is not None and tools.checked is not None:
            align = tools.checked({**configuration(folders[-1], tools.trust), "data": data})
            ensemble, fleets, truth = _built(folders, tools._replace(align=align), data)
            checks = [align.json]
        else:
            ensemble, fleets, truth = _built(folders, tools, data)
        seasons = read_seasons(folders, ensemble, fleets)
        with Activity(tools.console) as activity:
            activity.begin("simulating each checkpoint on each run", total=simulations(ensemble, seasons))
            known = known_quantities(found[-1]) if data is None else {}
            fits = saved_fits(folders, [season.boat for season in seasons]) if data is None else {}
            tracks = saved_tracks(folders, found, seasons, fleets) if data is None else {}
            sections, errors = assemble(ensemble, seasons, truth, activity.advance, known, fits, tracks)
            front = front_of(ensemble, seasons, checks, activity.advance, fits, tracks)
            activity.begin("drawing the report")
            other = "Judged on other logs than those of the runs from which the boats learned."
            notes = [*unfinished, *([] if data is None else [other])]
            parts = [section if paper else section._replace(paper="") for section in (*more, *sections)]
            said = [*facts(seasons, folders), *told, *notes]
            front = front._replace(notes=notes, unconfirmed=told)
            page = write_report(report, said, parts, commands, errors, front)
    tools.say(f"report: {page}")
    return page


def known_quantities(found: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """The true quantities of simulated boats that a run's results contain.

    >>> known_quantities({"identified": {"heron": {"mass": {"value": 27.0, "truth": 28.0}, "lag": {"value": 1.0}}}})
    {'heron': {'mass': 28.0}}
    """
    return {
        boat: {name: each["truth"] for name, each in quantities.items() if each.get("truth") is not None}
        for boat, quantities in found.get("identified", {}).items()
    }


def start_of(folder: Path, tools: Tools) -> Path:
    """The checkpoint of a finished run that is best for all of its boats (`best_start`)."""
    ensemble, seasons, _ = read([folder], tools)
    return best_start(ensemble, seasons)
