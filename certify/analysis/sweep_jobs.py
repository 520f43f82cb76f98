"""The jobs of a sweep: their settings, their errors, and which of their checkpoints are judged.

DIR/JOB/job.json       {"overrides": ["key=value", …]}: the settings of its command
DIR/JOB/results.json   {"boats": {boat: {estimator: {"mae": m/s}}}, "free": {boat: {estimator: m/s}}} or {"error": text}
DIR/JOB/checkpoints/BOAT/RRRRR_SSSSSSS.safetensors      after S steps of run R

A folder is that of a sweep if one of the folders in it holds a `job.json`, which no other command writes. These files
may come from anybody: what is damaged is reported, and the rest is used.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from certify.errors import CertifyError, quoted, shortened
from certify.networks.shallow import below, matched

JOB, RESULTS, CHECKPOINTS = "job.json", "results.json", "checkpoints"
LARGEST_FILE = 2**26  # bytes of a JSON file that is read
LARGEST_ERROR = 1e6  # m/s
LONGEST = 400  # characters of a reason


class Job(NamedTuple):
    """One job of a sweep."""

    name: str  # of its folder; with that of the sweep if several are given
    folder: Path
    settings: dict[str, str] | None  # of its command, by key; None if they cannot be read
    free: dict[str, Any]  # MAE of open-loop simulations by boat and estimator, m/s
    mae: dict[str, Any]  # MAE one step ahead, likewise
    sets: list[Path]  # all checkpoints; those of a boat in the order in which they were saved
    state: str  # "finished", "not finished", or "failed: reason"
    damaged: list[str]  # a sentence for each of its JSON files that cannot be used

    @property
    def last(self) -> list[Path]:
        """The last checkpoint of each boat."""
        return list({path.parent: path for path in self.sets}.values())

    @property
    def failed(self) -> bool:
        return self.state.startswith("failed")


def jobs(paths: Iterable[str | Path]) -> list[Job]:
    """The jobs of sweeps, in the order of their numbers; none unless every path is the folder of a sweep.

    Raises:
        CertifyError: a path names nothing.

    >>> jobs(["certify"])
    []
    """
    sweeps = list(dict.fromkeys(matched(paths)))
    if not sweeps or not all(map(_is_sweep, sweeps)):
        return []
    shared = os.path.commonpath(list(map(os.path.abspath, sweeps)))
    found = []
    for sweep in sweeps:
        folders = [each for each in sweep.iterdir() if _is_folder(each) and _is_job(each)]
        for folder in sorted(folders, key=lambda each: _numbers(each.name)):
            found.append(_job(folder, printable(os.path.relpath(folder, shared))))
    return found


def chosen(jobs: Sequence[Job], every: bool = False) -> list[Path]:
    """The checkpoints that are judged: the last of each boat, or all, of the jobs that did not fail.

    Raises:
        CertifyError: there is none.
    """
    found = [path for job in jobs if not job.failed for path in (job.sets if every else job.last)]
    if not found:
        first = jobs[0]
        raise CertifyError(
            f"{first.folder.parent}: none of its {len(jobs)} jobs holds a checkpoint (job {first.name}: "
            f"{first.state}): repeat the command of the sweep"
        )
    return found


def _is_sweep(path: Path) -> bool:
    return path.is_dir() and any(os.path.lexists(each / JOB) for each in path.iterdir() if _is_folder(each))


def _is_folder(path: Path) -> bool:
    """Whether it is a folder, and no link to one elsewhere."""
    return path.is_dir() and not path.is_symlink()


def _is_job(folder: Path) -> bool:
    return any(os.path.lexists(folder / name) for name in (JOB, RESULTS, CHECKPOINTS))


def _numbers(name: str) -> tuple[list[int], str]:
    """The key that sorts 2 before 10."""
    return [int(digits) for digits in re.findall(r"[0-9]+", name)], name


def _job(folder: Path, name: str) -> Job:
    damaged: list[str] = []
    held, settings = _read(folder / JOB, damaged), None
    if isinstance(overrides := held.get("overrides"), list) and all(isinstance(each, str) for each in overrides):
        parts = (printable(each).lstrip("+~").partition("=") for each in overrides)
        settings = {key: value for key, _, value in parts}
    elif not damaged:
        problem = "no list of overrides" if held else "nothing"
        damaged.append(f"{folder / JOB}: found {problem}, expected the settings of the job: repeat its command")
    results = _read(folder / RESULTS, damaged)
    state = "finished" if "boats" in results else "not finished"
    if "error" in results:
        state = f"failed: {printable(' '.join(str(results['error']).split()))[:LONGEST]}"
    sets = [path for path in below(folder) if path.is_relative_to(folder / CHECKPOINTS)]
    sets.sort(key=lambda path: (path.parent, _numbers(path.name)))
    errors = []
    for key in ("free", "boats"):
        table = {} if results.get(key) is None else results[key]
        if problem := _problem(table, key):
            damaged.append(f"{folder / RESULTS}: {key}: found {problem}, expected errors in m/s: repeat the job")
        errors.append({} if problem else table)
    mae = {boat: {name: scores.get("mae") for name, scores in row.items()} for boat, row in errors[1].items()}
    return Job(name, folder, settings, errors[0], mae, sets, state, damaged)


def _read(path: Path, damaged: list[str]) -> dict[str, Any]:
    """A JSON object; an empty one if there is no such file, or if it cannot be used, which is added to `damaged`."""
    try:
        if path.is_symlink() or not path.is_file():
            if os.path.lexists(path):
                raise ValueError("found a link or no file, expected a file")
            return {}
        if (size := path.stat().st_size) > LARGEST_FILE:
            raise ValueError(f"found {size / 1e6:.0f} MB, expected {LARGEST_FILE / 1e6:.0f} MB at most")
        found = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(found, dict):
            raise ValueError(f"found {type(found).__name__}, expected a JSON object")
    except (OSError, ValueError, RecursionError) as error:
        damaged.append(f"{path}: cannot be read ({shortened(error)}): repeat the job")
        return {}
    return found


def _problem(table: Any, key: str) -> str:
    """What in a table of errors, by boat and estimator, is no error; "" if nothing is."""
    rows = list(table.values()) if isinstance(table, dict) else [table]
    for row in rows:
        if not isinstance(row, dict):
            return quoted(row)
        for value in row.values():
            if key == "boats" and not isinstance(value, dict):
                return quoted(value)
            number = value.get("mae") if key == "boats" else value
            if number is not None and not _is_error(number):
                return quoted(number)
    return ""


def _is_error(value: Any) -> bool:
    return type(value) in (int, float) and 0 <= value <= LARGEST_ERROR


def printable(text: str) -> str:
    r"""Text from a file, with characters that would control the terminal escaped.

    >>> print(printable("found \x1b[2J"))
    found \x1b[2J
    """
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)
