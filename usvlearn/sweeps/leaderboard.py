"""The leaderboard of a sweep: a CSV table, and a row per job on TensorBoard's HPARAMS page."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from usvlearn.checkpoint import write_atomically
from usvlearn.errors import ConfigError
from usvlearn.evaluation.metrics import mean_mae
from usvlearn.evaluation.ranking import differing, ranked, ranked_by, scored
from usvlearn.report.tables import short_settings, sweep_table
from usvlearn.report.terminal import console
from usvlearn.sweeps.jobs import Job, jobs
from usvlearn.tensorboard import TensorBoardWriter

FOLDER, TABLE = "leaderboard", "leaderboard.csv"
LONGEST = 120  # characters of a row's name, which is a folder's


def leaderboard(folder: Path, load: Callable[[Path], Any]) -> bool:
    """Print and write the leaderboard of the runs below a folder; returns whether all are finished.

    Args:
        folder: of a sweep, or any other folder with runs.
        load: see `usvlearn.sweeps.jobs.jobs`.
    """
    found = _scored(jobs(folder, load))
    console().print(sweep_table([(job.settings, job.results) for job in found]))
    write_leaderboard(folder, found)
    return not any(map(_error, found))


def write_leaderboard(folder: Path, jobs: Sequence[Job]) -> None:
    """Write `leaderboard.csv` and `leaderboard/` into a folder; earlier ones are replaced.

    Nothing is written if the folder is itself a run.

    Args:
        folder: of the sweep.
        jobs: see `usvlearn.sweeps.jobs.jobs`; with results from `usvlearn.evaluation.ranking.scored`.

    Raises:
        ConfigError: the folder cannot be written to.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as name:
    ...     write_leaderboard(Path(name), [Job(Path(name, "0"), {"align.dt": "0.4"}, {"error": "bad"})])
    ...     print(Path(name, "leaderboard.csv").read_text())
    job,ranked_by,objective,seconds,error
    0,,,,bad
    <BLANKLINE>
    """
    if any(job.folder == folder for job in jobs):
        return
    try:
        write_atomically(folder / TABLE, _csv(folder, jobs).encode())
        _write_hparams(folder / FOLDER, folder, jobs)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot hold the leaderboard ({error}): make it writable") from error


def _scored(jobs: Sequence[Job]) -> list[Job]:
    """The jobs with the error that ranks them."""
    settings, results = [job.settings for job in jobs], [job.results for job in jobs]
    by = ranked_by(differing(settings), settings, results)
    return [job._replace(results=scored(job.results, by)) for job in jobs]


def _csv(folder: Path, jobs: Sequence[Job]) -> str:
    """One row per job, the best first: the settings that differ, the ranking member, the MAE of each estimator.

    An MAE is a mean over boats, m/s.
    """
    keys = differing([job.settings for job in jobs])
    names = _estimators(jobs)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["job", *keys, "ranked_by", "objective", *(f"mae/{name}" for name in names), "seconds", "error"])
    for job in ranked(jobs):
        maes = [_finite(_maes(job).get(name)) for name in names]
        by = job.results.get("ranked_by"), job.results.get("objective")
        numbers = [*by, *maes, job.results.get("seconds")]
        writer.writerow([_label(folder, job), *(job.settings.get(key) for key in keys), *numbers, _error(job)])
    return text.getvalue()


def _write_hparams(board: Path, folder: Path, jobs: Sequence[Job]) -> None:
    if board.is_symlink():  # a sweep may come from anybody
        raise ConfigError(f"{board} is a link to another folder: remove it")
    for old in board.glob("*/events.out.tfevents.*"):
        if not old.parent.is_symlink():
            old.unlink()
    for row in board.glob("*"):
        with suppress(OSError):  # other people's files stay
            row.rmdir()
    keys = differing([job.settings for job in jobs])
    for name, job in zip(_names(folder, jobs, keys), jobs, strict=True):
        settings = {key: _number(job.settings.get(key, "")) for key in keys or job.settings}
        numbers = {"objective": job.results.get("objective"), "seconds": job.results.get("seconds")}
        numbers |= {f"mae/{each}": _maes(job).get(each) for each in _estimators(jobs)}
        with TensorBoardWriter(board / name) as writer:
            # TensorBoard takes the columns from any of the rows, so all rows have the same ones
            writer.hparams(
                settings | {"ranked_by": job.results.get("ranked_by", ""), "job": _error(job) or "finished"},
                {key: float("nan") if value is None else value for key, value in numbers.items()},
            )


def _names(folder: Path, jobs: Sequence[Job], keys: Sequence[str]) -> list[str]:
    """A readable name per job that can name a folder; equal or shortened ones end in the job's own name."""
    full = [re.sub(r"[^\w.,=+ -]+", "_", short_settings(job.settings, keys)).strip(" .") for job in jobs]
    names = []
    for name, job in zip(full, jobs, strict=True):
        whole = name and len(name) <= LONGEST and full.count(name) == 1
        names.append(name if whole else f"{name[:LONGEST]} {_label(folder, job).replace('/', '_')}".strip())
    return names


def _label(folder: Path, job: Job) -> str:
    """The path of a job below the sweep's folder."""
    return job.folder.relative_to(folder).as_posix()


def _maes(job: Job) -> dict[str, float]:
    return mean_mae(job.results.get("boats", {}))


def _estimators(jobs: Sequence[Job]) -> list[str]:
    return list(dict.fromkeys(name for job in jobs for name in _maes(job)))


def _finite(number: float | None) -> float | None:
    return None if number != number else number


def _error(job: Job) -> str:
    return "" if "boats" in job.results else job.results.get("error", "did not finish")


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
