"""The leaderboard of a sweep: printed, and written as CSV, Markdown, figures and a page of TensorBoard.

leaderboard.csv   one row per setting, all digits      leaderboard.md    the same with four digits
leaderboard.png   the objective against the swept keys (extra plot)
settings.png      a row per setting, sorted: its jobs, its mean, its interval (extra plot)
leaderboard/      one row and one learning curve per setting, for TensorBoard
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from usvlearn.core.checkpoint import write_atomically
from usvlearn.core.unconfirmed import SECTION, unconfirmed
from usvlearn.display.figures import attempted, rendered
from usvlearn.display.terminal import console, show
from usvlearn.errors import ConfigError, MissingExtraError
from usvlearn.evaluation.objective import Measure, differing, own_objective, ranked_by, scored
from usvlearn.report.tables import board_lines, from_here
from usvlearn.runs.files import check_no_link
from usvlearn.sweeps.figures import settings_figure, sweep_figure
from usvlearn.sweeps.jobs import SWEEP, Job, jobs, noted_sweep
from usvlearn.sweeps.ranking import Standing, standings
from usvlearn.sweeps.seeds import SEED
from usvlearn.sweeps.table import printed, result_table
from usvlearn.sweeps.tensorboard import write_board

FOLDER, TABLE, TEXT = "leaderboard", "leaderboard.csv", "leaderboard.md"
FIGURES = {"settings": settings_figure, "leaderboard": sweep_figure}


def leaderboard(folder: Path, load: Callable[[Path], Any], objective: Any = None) -> bool:
    """Print and write the leaderboard of the runs below a folder; returns whether all are finished.

    Args:
        folder: of a sweep, or any other folder with runs.
        load: see `usvlearn.sweeps.jobs.jobs`.
        objective: that ranks; by default that of the sweep (`usvlearn.evaluation.objective.ranked_by`).

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
    asked = {each["key"]: each for one in done for each in one.get(SECTION, ())}
    console().print(printed(folder, ranks, keys, by))
    show(*unconfirmed(asked))
    if files := write_leaderboard(folder, found, ranks, by):
        console().print("", *last_lines(folder, files), sep="\n", soft_wrap=True)
    return all(job.finished for job in found)


def write_leaderboard(
    folder: Path, jobs: Sequence[Job], ranks: Sequence[Standing] | None = None, measure: Measure | None = None
) -> list[str]:
    """Write all files into a folder; earlier ones are replaced. Nothing is written if the folder is itself a run.

    Returns the names of the files, without the page of TensorBoard.

    Args:
        folder: of the sweep.
        jobs: see `usvlearn.sweeps.jobs.jobs`; with results from `usvlearn.evaluation.objective.scored`.
        ranks: see `usvlearn.sweeps.ranking.standings`; by default those without known default values.
        measure: what ranks them; None if each job's own output does.

    Raises:
        ConfigError: the folder cannot be written to, or a file there with the name of one of these is another's.
    """
    if any(job.folder == folder for job in jobs):
        return []
    check_own_board(folder, "folder")
    keys = [key for key in differing([job.settings for job in jobs]) if key != SEED]
    ranks = standings(jobs, measure, {}) if ranks is None else ranks
    made = result_table(folder, ranks, keys)
    try:
        write_atomically(folder / TABLE, made.csv().encode())
        write_atomically(folder / TEXT, made.markdown().encode())
        figures = _figures(ranks, keys, measure)
        for name in FIGURES.keys() - figures.keys():
            (folder / f"{name}.png").unlink(missing_ok=True)
        for name, png in figures.items():
            write_atomically(folder / f"{name}.png", png)
        write_board(folder / FOLDER, ranks, figures)
    except OSError as cause:
        raise ConfigError(f"{folder}: cannot hold the leaderboard ({cause}): make it writable") from cause
    return [TABLE, TEXT, *(f"{name}.png" for name in figures)]


def check_own_board(folder: Path, option: str) -> None:
    """Check before anything is written that a leaderboard's files may be written into a folder.

    Raises:
        ConfigError: one of these files is a link, or the folder holds one, but no leaderboard and no sweep.
    """
    files = [folder / name for name in (TABLE, TEXT, *(f"{name}.png" for name in FIGURES))]
    for path in files:
        check_no_link(path, option)
    if (folder / SWEEP).is_file() or (files[0].is_file() and files[0].read_bytes().startswith(b"rank,job,")):
        return
    for path in files:
        if path.is_file():
            raise ConfigError(
                f"{path}: found a file of no leaderboard, where one is written: move it, or choose another {option}"
            )


def last_lines(folder: Path, files: Sequence[str]) -> list[str]:
    """The last lines of a sweep: its files, and the command that shows more."""
    return [f"files        {from_here(folder)}: {', '.join(files)}", *board_lines(folder / FOLDER, "#hparams")]


def _figures(ranks: Sequence[Standing], keys: Sequence[str], measure: Measure | None) -> dict[str, bytes]:
    """The figures as PNG, those that show something; {}, with a warning, without matplotlib."""
    try:
        drawn = {name: attempted(partial(draw, ranks, keys, measure), name, rendered) for name, draw in FIGURES.items()}
    except MissingExtraError as cause:
        warnings.warn(f"no figure of the sweep: {cause}", stacklevel=2)
        return {}
    return {name: png for name, png in drawn.items() if png is not None}
