"""The leaderboard of a sweep: printed, and written as CSV, Markdown, a figure and a page of TensorBoard.

leaderboard.csv   one row per setting, all digits      leaderboard.md    the same with four digits
leaderboard.png   the objective against the swept keys (extra plot)
leaderboard/      one row per job on TensorBoard's HPARAMS page
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from usvlearn.checkpoint import write_atomically
from usvlearn.errors import ConfigError, MissingExtraError
from usvlearn.evaluation.measure import Measure
from usvlearn.evaluation.ranking import differing, own_objective, ranked_by, scored
from usvlearn.report.terminal import console
from usvlearn.sweeps.board import write_board
from usvlearn.sweeps.jobs import Job, jobs, noted_sweep
from usvlearn.sweeps.panels import sweep_figure
from usvlearn.sweeps.seeds import SEED
from usvlearn.sweeps.standings import Standing, standings
from usvlearn.sweeps.table import printed, result_table

FOLDER, TABLE, TEXT, FIGURE = "leaderboard", "leaderboard.csv", "leaderboard.md", "leaderboard.png"


def leaderboard(folder: Path, load: Callable[[Path], Any], objective: Any = None) -> bool:
    """Print and write the leaderboard of the runs below a folder; returns whether all are finished.

    Args:
        folder: of a sweep, or any other folder with runs.
        load: see `usvlearn.sweeps.jobs.jobs`.
        objective: that ranks; by default that of the sweep (`usvlearn.evaluation.ranking.ranked_by`).

    Raises:
        ConfigError: there is no run, none has measured the objective, or the folder cannot be written to.
    """
    found, note = jobs(folder, load), noted_sweep(folder)
    keys = differing([job.settings for job in found])
    done = [job.results for job in found if job.finished]
    by = ranked_by(objective or note.objective or own_objective(done), note.swept or keys, done)
    if objective is not None and by is not None and not any(map(by.known, done)):
        raise ConfigError(
            f"objective: found {objective}, which no finished job of {folder} has measured: see boats, forecast and "
            "free in their results.json"
        )
    found = [job._replace(results=scored(job.results, by)) for job in found]
    ranks = standings(found, by, note.defaults)
    keys = [key for key in keys if key != SEED]
    console().print(printed(folder, ranks, keys, by))
    write_leaderboard(folder, found, ranks, by)
    return all(job.finished for job in found)


def write_leaderboard(
    folder: Path, jobs: Sequence[Job], ranks: Sequence[Standing] | None = None, measure: Measure | None = None
) -> None:
    """Write all files into a folder; earlier ones are replaced. Nothing is written if the folder is itself a run.

    Args:
        folder: of the sweep.
        jobs: see `usvlearn.sweeps.jobs.jobs`; with results from `usvlearn.evaluation.ranking.scored`.
        ranks: see `usvlearn.sweeps.standings.standings`; by default those without known default values.
        measure: what ranks them; None if each job's own output does.

    Raises:
        ConfigError: the folder cannot be written to.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as name:
    ...     job = Job(Path(name, "0"), {"align.dt": "0.4"}, {"error": "bad"})
    ...     write_leaderboard(Path(name), [job])
    ...     print(Path(name, "leaderboard.csv").read_text().splitlines()[1])
    1,0,,m/s,,,0,False,,,,,,,,bad
    """
    if any(job.folder == folder for job in jobs):
        return
    keys = [key for key in differing([job.settings for job in jobs]) if key != SEED]
    ranks = standings(jobs, measure, {}) if ranks is None else ranks
    made = result_table(folder, ranks, keys)
    try:
        write_atomically(folder / TABLE, made.csv().encode())
        write_atomically(folder / TEXT, made.markdown().encode())
        figure = _figure(ranks, keys, measure)
        if figure is None:
            (folder / FIGURE).unlink(missing_ok=True)
        else:
            write_atomically(folder / FIGURE, figure)
        write_board(folder / FOLDER, folder, jobs, figure)
    except OSError as cause:
        raise ConfigError(f"{folder}: cannot hold the leaderboard ({cause}): make it writable") from cause


def _figure(ranks: Sequence[Standing], keys: Sequence[str], measure: Measure | None) -> bytes | None:
    """The figure as PNG; None, with a warning, without matplotlib."""
    try:
        return sweep_figure(ranks, keys, measure)
    except MissingExtraError as cause:
        warnings.warn(f"no figure of the sweep: {cause}", stacklevel=2)
        return None
