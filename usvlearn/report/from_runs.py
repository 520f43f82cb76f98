"""From the folders of runs to their report.

The library knows no configuration: it is handed what makes an object of a node, and what aligns logs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console
from rich.progress import Progress

from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.evaluation.season import Season
from usvlearn.lock import Lock
from usvlearn.report.assembly import assemble, best_start, facts, simulations
from usvlearn.report.page import check_report_folder, write_report
from usvlearn.report.section import Section
from usvlearn.report.sections.parameters import Truth
from usvlearn.runs.saved import configuration, read_seasons, results
from usvlearn.signals import Fleet


class Tools(NamedTuple):
    """What a report needs beyond the library's own."""

    instantiate: Callable[..., Any]  # makes the object that a node of a configuration describes
    align: Callable[..., Fleet]  # recordings to a fleet, with the options of `align`
    truth: Callable[[Sequence[Mapping[str, Any]], float], Truth]  # of sources of data, and a declared mass, kg
    console: Console
    trust: str | Sequence[str] | None = None  # modules of the user's own that saved settings may name

    def say(self, text: str) -> None:
        """Print a line that is not to be broken, such as a command or a path."""
        self.console.print(text, soft_wrap=True)


def read(folders: Sequence[Path], tools: Tools, data: Any = None) -> tuple[Ensemble, list[Season], Truth]:
    """The ensemble of some runs, what they left of each boat, and the truth where it is known.

    Args:
        folders: of the runs, the oldest first.
        tools: see `Tools`.
        data: configuration of other logs of the same boats; by default those that the runs were made of.

    Raises:
        CheckpointError, ConfigError: what was saved cannot be read, or does not fit the data.
    """
    if data is not None and "_target_" not in data:
        raise ConfigError(f"data: found {', '.join(data)} alone, expected a file of configs/data: set data=NAME")
    settings = [configuration(folder, tools.trust) for folder in folders]
    last, sources = settings[-1], []
    for each in [found["data"] for found in settings] if data is None else [data]:
        if each not in sources:  # several folders of the same logs
            sources.append(each)
    try:
        combiners = tools.instantiate(last["combiners"], _convert_="all")
        ensemble = Ensemble(tools.instantiate(last["estimators"]), combiners, last.get("output"))
        with tools.console.status("reading and aligning"):
            fleets = [tools.align(tools.instantiate(each), **last["align"]) for each in sources]
    except (TypeError, AttributeError, KeyError, OverflowError, MemoryError) as error:
        what = f"{type(error).__name__}: {error}"
        raise CheckpointError(f"{folders[-1]}: its settings cannot be used ({what:.200}): make the run anew") from error
    truth = tools.truth(sources, last["vehicle"]["mass"]) if data is None else {}  # of the boats that were learned
    return ensemble, read_seasons(folders, ensemble, fleets), truth


def evaluate(
    folders: Sequence[Path],
    report: Path,
    tools: Tools,
    data: Any = None,
    more: Sequence[Section] = (),
    commands: Sequence[str] = (),
) -> Path:
    """Judge every parameter set of some runs and write the report; returns its page.

    Args:
        folders, tools, data: as of `read`.
        report: its folder.
        more: sections to begin with.
        commands: with which the report can be made again.
    """
    with Lock(report, "report"):
        check_report_folder(report)
        unfinished = [f"{folder} is not finished: judged as far as it is." for folder in folders if not results(folder)]
        ensemble, seasons, truth = read(folders, tools, data)
        with Progress(console=tools.console) as progress:
            bar = progress.add_task("simulating", total=simulations(ensemble, seasons))
            sections, errors = assemble(ensemble, seasons, truth, lambda steps: progress.update(bar, advance=steps))
        page = write_report(report, [*facts(seasons, folders), *unfinished], [*more, *sections], commands, errors)
    tools.say(f"report: {page}")
    return page


def start_of(folder: Path, tools: Tools) -> Path:
    """The parameter set of a finished run that serves all of its boats best (`best_start`)."""
    ensemble, seasons, _ = read([folder], tools)
    return best_start(ensemble, seasons)
