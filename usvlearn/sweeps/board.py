"""The page of a sweep in TensorBoard: rows of jobs and of settings on HPARAMS, and their learning curves."""

from __future__ import annotations

import glob
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usvlearn.display.event_file import EVENTS, Setting, TensorBoardWriter, folder_name, folder_names
from usvlearn.errors import ConfigError
from usvlearn.evaluation.metrics import mean
from usvlearn.evaluation.ranking import differing
from usvlearn.report.tables import short_settings
from usvlearn.runs.layout import TENSORBOARD
from usvlearn.runs.tensorboard.board_tags import MAE, number, results_of
from usvlearn.sweeps.jobs import Job
from usvlearn.sweeps.seeds import SEED
from usvlearn.sweeps.standings import Standing

MOST_KEYS = 5  # columns of settings that the page shows at first
MOST_POINTS = 100  # of a learning curve
MEAN = "mean"  # the kind of the rows of settings
OBJECTIVE, REST, ROWS = "objective", "other settings", "row"


class Row(NamedTuple):
    """A row of HPARAMS, and a run of TIME SERIES: a job, or the mean over the jobs of a setting."""

    name: str
    settings: dict[str, str]
    results: dict[str, float]  # by title
    curve: Sequence[tuple[int, float]]
    failed: bool


def write_board(
    board: Path,
    folder: Path,
    jobs: Sequence[Job],
    ranks: Sequence[Standing] = (),
    figures: Mapping[str, bytes] | None = None,
) -> None:
    """Write the page; an earlier one is replaced.

    Where a setting has several seeds, the settings come first, in their order, as means over the seeds that finished;
    the column ROWS tells them from jobs.

    The columns are the settings that differ, then the results that are known, of the ranking member where it has them,
    else of the output. The page shows five settings at first, so of more than five the rest share the last column.

    Args:
        board: folder of the page.
        folder: of the sweep.
        jobs: see `usvlearn.sweeps.jobs.jobs`; with results from `usvlearn.evaluation.ranking.scored`.
        ranks: the settings in their order, of `usvlearn.sweeps.standings.standings`.
        figures: PNG by name, for the IMAGES page.

    Raises:
        ConfigError: the folder is a link.
        OSError: it cannot be written to.
    """
    _clear(board)
    keys = differing([job.settings for job in jobs])
    names = job_names(folder, jobs, keys)
    of_jobs = [
        Row(name, _row(job.settings, keys), _results(job), learning_curve(job), not job.finished)
        for name, job in zip(names, jobs, strict=True)
    ]
    rows = of_jobs
    if of_settings := _of_settings(ranks, jobs, of_jobs, keys):
        kinds = [*[MEAN] * len(of_settings), *["job"] * len(of_jobs)]
        both = zip(kinds, [*of_settings, *of_jobs], strict=True)
        rows = [row._replace(settings={ROWS: kind, **row.settings}) for kind, row in both]
    columns = {
        key: _alike({k: row.settings[key] for k, row in enumerate(rows) if key in row.settings})
        for key in dict.fromkeys(chain(*(row.settings for row in rows)))
    }
    titles = _titles([row.results for row in of_jobs], {_ranked_by(job) for job in jobs if job.finished})
    with TensorBoardWriter(board, [row.name for row in rows]) as writer:
        writer.columns({key: list(values.values()) for key, values in columns.items()}, dict(titles.values()))
        for k, row in enumerate(rows):
            settings = {key: values[k] for key, values in columns.items() if k in values}
            writer.session(settings, row.name, row.results.get("seconds"), row.failed)
            writer.scalars({titles[title][0]: x for title, x in row.results.items() if title in titles}, 0, row.name)
            for step, mae in row.curve:
                writer.scalars({f"1 overview/{MAE}": mae}, step, row.name)
        failed = [job for job in jobs if not job.finished]
        if failed:
            told = (f"- {short_settings(job.settings, keys)}: {job.failure}" for job in failed)
            writer.text("failed jobs", "\n".join(told))
        for name, png in (figures or {}).items():
            writer.image(name, png)


def _of_settings(
    ranks: Sequence[Standing], jobs: Sequence[Job], of_jobs: Sequence[Row], keys: Sequence[str]
) -> list[Row]:
    """A row per setting, the best first, with means over its jobs that finished; none if no setting has several."""
    if all(each.done < 2 for each in ranks):
        return []
    names = folder_names(  # + is sorted before the numbers of the jobs
        f"+{MEAN} {rank:0{len(str(len(ranks)))}d} {short_settings(each.settings, list(each.settings))}"
        for rank, each in enumerate(ranks, 1)
    )
    by_folder, rows = {job.folder: row for job, row in zip(jobs, of_jobs, strict=True)}, []
    for name, each in zip(names, ranks, strict=True):
        own = [by_folder[job.folder] for job in each.jobs if job.finished]
        titles = dict.fromkeys(chain(*(row.results for row in own)))
        means = {title: mean(row.results.get(title) for row in own) for title in titles}
        known = {title: x for title, x in means.items() if x is not None}
        rows.append(Row(name, _row(each.settings, [key for key in keys if key != SEED]), known,
                        _mean_curve([row.curve for row in own]), not own))  # fmt: skip
    return rows


def _mean_curve(curves: Sequence[Sequence[tuple[int, float]]]) -> list[tuple[int, float]]:
    """The mean of curves where all are known, at the steps of the first.

    >>> _mean_curve([[(0, 1.0), (10, 2.0), (20, 3.0)], [(5, 2.0), (15, 4.0)]])
    [(10, 2.5)]
    >>> _mean_curve([[(0, 1.0)], []])
    []
    """
    if not curves or not all(curves):
        return []
    first, last = max(curve[0][0] for curve in curves), min(curve[-1][0] for curve in curves)
    steps = [step for step, _ in curves[0] if first <= step <= last]
    values = np.mean([np.interp(steps, [at for at, _ in curve], [x for _, x in curve]) for curve in curves], 0)
    return list(zip(steps, values.tolist(), strict=True))


def job_names(folder: Path, jobs: Sequence[Job], keys: Sequence[str]) -> list[str]:
    """A name per job that can name a folder: its path below the sweep's folder, and its settings.

    Numbers have equal lengths, because TensorBoard sorts the rows by their names.
    """
    paths = [job.folder.relative_to(folder).as_posix() for job in jobs]
    width = max((len(path) for path in paths if path.isdecimal()), default=0)
    paths = [path.zfill(width) if path.isdecimal() else path for path in paths]
    return folder_names([f"{path} {short_settings(job.settings, keys)}" for path, job in zip(paths, jobs, strict=True)])


def learning_curve(job: Job) -> list[tuple[int, float]]:
    """Run time, s, and the rolling MAE, m/s, of the job's ranking member or else its output, of its first boat.

    There are at most MOST_POINTS. A job that failed, or whose files are damaged, has those that can be read.
    """
    from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader
    from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]  # generated

    boat = folder_name(next(iter(job.results.get("boats", {})), "_"))
    run = f"{boat}/{folder_name(_ranked_by(job).partition('.')[0])}"
    paths = (job.folder / TENSORBOARD).glob(f"**/{glob.escape(run)}/{EVENTS}.*")
    found: dict[int, float] = {}
    for path in sorted(paths):
        for raw in RawEventFileLoader(str(path)).Load():
            event = Event.FromString(raw)
            found.update((event.step, x.simple_value) for x in event.summary.value if x.tag == f"1 overview/{MAE}")
    steps = sorted(found)
    shown = np.unique(np.linspace(0, len(steps) - 1, min(MOST_POINTS, len(steps))).astype(int))
    return [(steps[k], found[steps[k]]) for k in shown]


def _clear(board: Path) -> None:
    """Remove an earlier page."""
    if board.is_symlink():  # a sweep may come from anybody
        raise ConfigError(f"{board} is a link to another folder: remove it")
    for pattern in (
        f"{EVENTS}.{'[0-9]' * 10}",
        f"*/{EVENTS}.{'[0-9]' * 10}",
    ):  # as usvlearn.display.event_file names them
        for old in board.glob(pattern):
            if not old.parent.is_symlink():
                old.unlink()
    for row in board.glob("*"):
        with suppress(OSError):  # other people's files stay
            row.rmdir()


def _row(settings: Mapping[str, str], keys: Sequence[str]) -> dict[str, str]:
    """The settings of a job in its columns; all of them if no job differs."""
    shown = list(keys or settings)
    if len(shown) <= MOST_KEYS:
        return {key: settings[key] for key in shown if key in settings}
    first, rest = shown[: MOST_KEYS - 1], shown[MOST_KEYS - 1 :]
    more = {key: settings[key] for key in rest if key in settings}
    return {key: settings[key] for key in first if key in settings} | (
        {REST: short_settings(more, rest)} if more else {}
    )


def _alike(texts: dict[int, str]) -> dict[int, Setting]:
    """The values of a column by job: numbers if all are, else texts."""
    numbers = {k: number(text) for k, text in texts.items()}
    return {**texts} if any(isinstance(x, str) for x in numbers.values()) else numbers


def _ranked_by(job: Job) -> str:
    return str(job.results.get("measure") or job.results.get("output", ""))


def _results(job: Job) -> dict[str, float]:
    """The results of a job by title, the objective first; {} of one that failed."""
    if not job.finished:
        return {}
    found, objective = results_of(job.results, _ranked_by(job).partition(".")[0]), job.results.get("objective")
    return ({} if objective is None or objective != objective else {OBJECTIVE: float(objective)}) | found


def _titles(results: Sequence[Mapping[str, float]], by: Collection[str]) -> dict[str, tuple[str, str]]:
    """The tag and the head of the column of each result that some job has.

    The result that is the objective is not shown twice. What is the same for all jobs comes last.

    Args:
        results: of the jobs, by title.
        by: whose error the objective is.
    """
    titles = list(dict.fromkeys(chain(*sorted(results, key=len, reverse=True))))
    columns = {title: [row.get(title) for row in results] for title in titles}
    same = next((title for title in titles[1:] if titles[0] == OBJECTIVE and columns[title] == columns[OBJECTIVE]), "")
    shown = sorted((each for each in titles if each != same), key=lambda each: len({*columns[each]} - {None}) < 2)
    heads = {OBJECTIVE: f"{OBJECTIVE}: {', '.join(sorted(by))}" + (" (m/s)" if "m/s" in same else "")}
    return {each: (f"8 results/{k} {each}", heads.get(each, each)) for k, each in enumerate(shown, 1)}
