"""The jobs of a sweep: which of their parameter sets are judged, and a row for each job and network.

DIR/JOB/job.json       {"overrides": ["key=value", …]}: the settings of its command
DIR/JOB/results.json   {"boats": {boat: {estimator: {"mae": m/s}}}, "free": {boat: {estimator: m/s}}} or {"error": text}
DIR/JOB/checkpoints/BOAT/RRRRR_SSSSSSS.safetensors      after S steps of run R

A folder is that of a sweep if one of the folders in it holds a `job.json`, which no other command writes. These files
may come from anybody: what is damaged is reported, and the rest is used.
"""

from __future__ import annotations

import json
import math
import os
import re
import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from certify.errors import CertifyError, quoted, shortened
from certify.weights import Network, below, matched

JOB, RESULTS, CHECKPOINTS = "job.json", "results.json", "checkpoints"
SEED = "seed"  # the key whose values are repetitions of one job
LARGEST_FILE = 2**26  # bytes of a JSON file that is read


class Job(NamedTuple):
    """One job of a sweep."""

    name: str  # of its folder; with the sweep's if several are given
    folder: Path
    settings: dict[str, str] | None  # of its command, by key; None if they cannot be read
    free: dict[str, Any]  # MAE of free runs by boat and estimator, m/s
    mae: dict[str, Any]  # MAE one step ahead, likewise
    sets: list[Path]  # all parameter sets; those of a boat in the order in which they were saved
    state: str  # "finished", "not finished", or "failed: reason"
    damaged: list[str]  # a sentence for each of its JSON files that cannot be used

    @property
    def last(self) -> list[Path]:
        """The last parameter set of each boat."""
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
    if not all(map(_is_sweep, sweeps)):
        return []
    found = []
    for sweep in sweeps:
        folders = [each for each in sweep.iterdir() if _is_folder(each) and _is_job(each)]
        for folder in sorted(folders, key=lambda each: _numbers(each.name)):
            found.append(_job(folder, printable(folder.name if len(sweeps) == 1 else os.path.relpath(folder))))
    return found


def chosen(jobs: Sequence[Job], every: bool = False) -> list[Path]:
    """The parameter sets that are judged: the last of each boat, or all, of the jobs that did not fail.

    Raises:
        CertifyError: there is none.
    """
    found = [path for job in jobs if not job.failed for path in (job.sets if every else job.last)]
    if not found:
        first = jobs[0]
        raise CertifyError(
            f"{first.folder.parent}: none of its {len(jobs)} jobs holds a parameter set (job {first.name}: "
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
    held, results = (_read(folder / file, damaged) for file in (JOB, RESULTS))
    settings = None
    if isinstance(overrides := held.get("overrides"), list) and all(isinstance(each, str) for each in overrides):
        parts = (printable(each).lstrip("+~").partition("=") for each in overrides)
        settings = {key: value for key, _, value in parts}
    elif not damaged:
        problem = "no list of overrides" if held else "nothing"
        damaged.append(f"{folder / JOB}: found {problem}, expected the settings of the job: repeat its command")
    state = "finished" if "boats" in results else "not finished"
    if "error" in results:
        state = f"failed: {printable(shortened(results['error']))}"
    sets = [path for path in below(folder) if path.is_relative_to(folder / CHECKPOINTS)]
    sets.sort(key=lambda path: (path.parent, _numbers(path.name)))
    errors = []
    for key in ("free", "boats"):
        table = results.get(key, {})
        problem = _problem(table, key)
        if problem:
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
    try:
        return type(value) in (int, float) and 0 <= value and math.isfinite(value)
    except OverflowError:  # an integer that no float can hold
        return False


def printable(text: str) -> str:
    r"""Text from a file, with characters that would control the terminal escaped.

    >>> print(printable("found \x1b[2J"))
    found \x1b[2J
    """
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)


def differing(settings: Iterable[Mapping[str, str] | None]) -> list[str]:
    """The keys whose values are not the same in all jobs whose settings are known.

    >>> differing([{"dt": "0.4", "gain": "1"}, {"dt": "0.4", "gain": "3"}, None])
    ['gain']
    """
    known = [each for each in settings if each is not None]
    keys = dict.fromkeys(key for each in known for key in each)
    return [key for key in keys if len({each.get(key) for each in known}) > 1]


def rows(
    jobs: Sequence[Job], networks: Sequence[Network], found: Sequence[Mapping[str, Any]], held: Sequence[bool]
) -> list[dict[str, Any]]:
    """A row for each network of a job, or of jobs that differ only in their seed.

    First those of which every judged set holds, then by the error of free runs, or one step ahead without free runs.

    Args:
        jobs: of the sweep.
        networks: the judged parameter sets of these jobs.
        found: see `certify.assess.assess`, for each.
        held: whether the asked condition holds, for each.

    Returns:
        Counts of sets by condition; `rate`, the largest exact rate K; errors in m/s, mean over boats, then mean and
        sample deviation over seeds, None where a boat lacks it.
    """
    keys = differing(job.settings for job in jobs)
    groups: dict[tuple[str, Any], dict[int, list[int]]] = {}  # network, settings -> job -> sets
    for k, network in enumerate(networks):
        j = next(j for j, job in enumerate(jobs) if network.path.startswith(str(job.folder) + os.sep))
        groups.setdefault((estimator(network), _repeated(jobs[j], keys)), {}).setdefault(j, []).append(k)
    made = []
    for (name, _), members in groups.items():
        sets = [k for each in members.values() for k in each]
        own = [jobs[j] for j in members]
        free = [_mean_over_boats(job.free, name) for job in own]
        mae = [_mean_over_boats(job.mae, name) for job in own]
        settings = own[0].settings
        row: dict[str, Any] = {
            "jobs": [job.name for job in own],
            "settings": None if settings is None else {key: settings.get(key) for key in keys if key != SEED},
            "network": name,
            "sets": len(sets),
            "certified": {name: sum(found[k]["certified"][name] for k in sets) for name in found[sets[0]]["certified"]},
            "holds": all(held[k] for k in sets),
            "rate": max(found[k]["rate"] for k in sets),
            "rates": [max(found[k]["rate"] for k in each) for each in members.values()],
            **dict(zip(("free", "free_deviation"), _over_seeds(free), strict=True)),
            **dict(zip(("mae", "mae_deviation"), _over_seeds(mae), strict=True)),
        }
        if "box" in found[sets[0]]:
            boxes = [found[k]["box"] for k in sets]
            row["certified"] |= {
                "interval": sum(box["interval"] == "certified" for box in boxes),
                "box": sum(box["verdict"] == "certified" for box in boxes),
            }
            row["box_rate"] = max(box["bracket"][1] for box in boxes)
        made.append({**row, "paths": [networks[k].path for k in sets]})
    return sorted(made, key=lambda row: (not row["holds"], *_by_error(row["free"]), *_by_error(row["mae"])))


def unjudged(jobs: Sequence[Job], judged: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The jobs without a row: their settings that differ, and the reason."""
    seen = {name for row in judged for name in row["jobs"]}
    keys = differing(job.settings for job in jobs)
    return [
        {
            "jobs": [job.name],
            "settings": None if job.settings is None else {key: job.settings.get(key) for key in keys},
            "error": job.state if job.failed or not job.sets else "no parameter set could be judged",
        }
        for job in jobs
        if job.name not in seen
    ]


def _repeated(job: Job, keys: Sequence[str]) -> Any:
    """What jobs of one row have in common: their settings without the seed, or the job's own name."""
    if SEED not in keys or job.settings is None or SEED not in job.settings:
        return job.name
    return tuple((key, job.settings.get(key)) for key in keys if key != SEED)


def _by_error(error: float | None) -> tuple[bool, float]:
    return error is None, error or 0.0


def estimator(network: Network) -> str:
    """The member of the ensemble that a network is, as errors are named, and its lane if it has several.

    >>> estimator(Network("", None, "members.rnn.weights[1]")), estimator(Network("", None, ""))
    ('rnn[1]', 'network')
    """
    found = re.match(r"members\.([^.\[]+)[^\[]*(\[.*\])?$", network.tensors)
    return printable(found[1] + (found[2] or "") if found else network.tensors or "network")


def _mean_over_boats(table: Mapping[str, Mapping[str, float | None]], name: str) -> float | None:
    """The mean; None if there is none, or if the estimator diverged on a boat."""
    known = [row[name] for row in table.values() if name in row]
    numbers = [x for x in known if x is not None]
    return statistics.fmean(numbers) if numbers and len(numbers) == len(known) else None


def _over_seeds(errors: Sequence[float | None]) -> tuple[float | None, float | None]:
    """Mean and sample deviation; no mean if one is missing, no deviation of a single one.

    >>> _over_seeds([0.25, 0.75]), _over_seeds([0.25]), _over_seeds([0.25, None])
    ((0.5, 0.3535533905932738), (0.25, None), (None, None))
    """
    known = [x for x in errors if x is not None]
    if len(known) < len(errors):
        return None, None
    return statistics.fmean(known), statistics.stdev(known) if len(known) > 1 else None


def narrowest(row: Mapping[str, Any]) -> str | None:
    """The first condition, from the narrowest to the widest, that all sets of a row hold; None if there is none.

    >>> narrowest({"sets": 2, "certified": {"simple": 0, "gershgorin": 1, "lmi": 2, "tight": 2}})
    'lmi'
    """
    return next((name for name, count in row["certified"].items() if count == row["sets"]), None)
