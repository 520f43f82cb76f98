"""The report of a run, made anew once the run has a batch fit."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from usvlearn.errors import UsvlearnError, complain

REPORT = "report"  # in a run's folder, as `usvlearn evaluate` names it


def renew_report(folder: Path, console: Console, data: Mapping[str, Any] | None = None) -> Path | None:
    """Write `RUN/report`, with the section on the fit, as `usvlearn evaluate runs=RUN` does; returns its page.

    Without a report, such as without matplotlib, there is a warning, and None is returned: the fit itself is saved.

    Args:
        folder: of the run, in which `fit/BOAT.fit.json` is.
        console: shows how far it is.
        data: the configuration of the run's logs, where they have moved.
    """
    from usvlearn.cli.checked_alignment import CheckedAlignment
    from usvlearn.cli.settings import instantiate
    from usvlearn.logs.recordings import align_fleet
    from usvlearn.report.build import Tools, evaluate
    from usvlearn.runs.saved import configuration
    from usvlearn.simulate.truth import truth_of
    from usvlearn.sweeps.launchers import set_threads

    set_threads(1)
    try:
        own = configuration(folder)["data"]

        def made(node: Any, **options: Any) -> Any:
            return instantiate(dict(data) if data is not None and node == own else node, **options)

        checked = partial(CheckedAlignment, console=console)
        return evaluate([folder], folder / REPORT, Tools(made, align_fleet, truth_of, console, None, checked))
    except UsvlearnError as error:
        complain(f"warning: no report was made: {error}")
        return None
