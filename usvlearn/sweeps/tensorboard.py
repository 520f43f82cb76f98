"""The page of a sweep in TensorBoard: for each setting a row of HPARAMS, means over its seeds."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from usvlearn.display.tensorboard import EVENTS, Setting, TensorBoardWriter, folder_names
from usvlearn.errors import ConfigError
from usvlearn.evaluation.metrics import mean
from usvlearn.report.tables import short_settings
from usvlearn.runs.compared import number, results_of
from usvlearn.sweeps.jobs import Job
from usvlearn.sweeps.ranking import Standing

MOST_KEYS = 5  # columns of settings that the page shows at first
OBJECTIVE, REST, RATE = "objective", "other settings", "contraction rate"  # RATE: of `results_of`


class Row(NamedTuple):
    """A row of HPARAMS."""

    name: str
    settings: dict[str, str]
    results: dict[str, float]  # by title
    failed: bool


def write_board(board: Path, ranks: Sequence[Standing], figures: Mapping[str, bytes] | None = None) -> None:
    """Write the page; an earlier one is replaced.

    The columns are the settings that differ, then the results that are known, of the ranking member where it has them,
    else of the output. The page shows five settings at first, so of more than five the rest share the last column.
    """
    _clear(board)
    width = len(str(len(ranks)))  # TensorBoard sorts the rows by their names
    names = folder_names(
        f"{rank:0{width}d} {short_settings(each.settings, list(each.settings)) or each.jobs[0].folder.name}"
        for rank, each in enumerate(ranks, 1)
    )
    rows = [_row(name, each) for name, each in zip(names, ranks, strict=True)]
    columns = {
        key: _alike({k: row.settings[key] for k, row in enumerate(rows) if key in row.settings})
        for key in dict.fromkeys(chain(*(row.settings for row in rows)))
    }
    every = [job for each in ranks for job in each.jobs]
    titles = _titles([row.results for row in rows], {_ranked_by(job) for job in every if job.finished})
    with TensorBoardWriter(board, names) as writer:
        writer.columns({key: list(values.values()) for key, values in columns.items()}, dict(titles.values()))
        for k, row in enumerate(rows):
            settings = {key: values[k] for key, values in columns.items() if k in values}
            writer.session(settings, row.name, row.results.get("seconds"), row.failed)
            writer.scalars({titles[title][0]: x for title, x in row.results.items() if title in titles}, 0, row.name)
        if failed := [job for job in every if not job.finished]:
            lines = (f"- {short_settings(job.settings, list(job.settings))}: {job.failure}" for job in failed)
            writer.text("failed jobs", "\n".join(lines))
        for name, png in (figures or {}).items():
            writer.image(name, png)


def _row(name: str, each: Standing) -> Row:
    """The row of a setting, with means over its jobs that finished."""
    shown = list(each.settings)
    if len(shown) > MOST_KEYS:
        rest = shown[MOST_KEYS - 1 :]
        settings = {key: each.settings[key] for key in shown[: MOST_KEYS - 1]}
        settings[REST] = short_settings({key: each.settings[key] for key in rest}, rest)
    else:
        settings = dict(each.settings)
    done = [job for job in each.jobs if job.finished]
    results = [_results(job) for job in done]
    means = {title: mean(row.get(title) for row in results) for title in dict.fromkeys(chain(*results))}
    known = {title: x for title, x in (means | {RATE: each.rate}).items() if x is not None}  # a rate is the largest
    return Row(name, settings, known, not done)


def _clear(board: Path) -> None:
    """Remove an earlier page."""
    if board.is_symlink():  # a sweep may come from anybody
        raise ConfigError(f"{board} is a link to another folder: remove it")
    for old in [*board.glob(f"{EVENTS}.*"), *board.glob(f"*/{EVENTS}.*")]:
        if not old.parent.is_symlink():
            old.unlink()
    for row in board.glob("*"):
        with suppress(OSError):  # other people's files stay
            row.rmdir()


def _alike(texts: dict[int, str]) -> dict[int, Setting]:
    """The values of a column by row: numbers if all are, else texts."""
    numbers = {k: number(text) for k, text in texts.items()}
    return {**texts} if any(isinstance(x, str) for x in numbers.values()) else numbers


def _ranked_by(job: Job) -> str:
    return str(job.results.get("measure") or job.results.get("output", ""))


def _results(job: Job) -> dict[str, float]:
    """The results of a job by title, the objective first."""
    titled, objective = results_of(job.results, _ranked_by(job).partition(".")[0]), job.results.get("objective")
    return ({} if objective is None or objective != objective else {OBJECTIVE: float(objective)}) | titled


def _titles(results: Sequence[Mapping[str, float]], by: Collection[str]) -> dict[str, tuple[str, str]]:
    """The tag and the head of the column of each result that some setting has.

    The result that is the objective is not shown twice. What is the same for all settings comes last.
    """
    titles = list(dict.fromkeys(chain(*sorted(results, key=len, reverse=True))))
    columns = {title: [row.get(title) for row in results] for title in titles}
    same = next((title for title in titles[1:] if titles[0] == OBJECTIVE and columns[title] == columns[OBJECTIVE]), "")
    shown = sorted((each for each in titles if each != same), key=lambda each: len({*columns[each]} - {None}) < 2)
    heads = {OBJECTIVE: f"{OBJECTIVE}: {', '.join(sorted(by))}" + (" (m/s)" if "m/s" in same else "")}
    return {each: (f"8 results/{k} {each}", heads.get(each, each)) for k, each in enumerate(shown, 1)}
