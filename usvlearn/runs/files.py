"""The files in a run's folder, and its index `runs.json`: which runs it was made from, and which files are its own.

docs/runs.md describes them, except for those of tunings and sweeps:

optuna.log        the trials of a search, written as they finish
workers/          locks of the processes that search together
job.json          the settings of a job of a sweep

A run removes only files that its index names, and writes through no link. Imports no torch, because the command asks
`check_own` before anything is written.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from usvlearn.core.checkpoint import LEFT, SUFFIX, load, write_atomically
from usvlearn.core.samples import Run, named_leaves
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.runs.prediction_files import BEGIN, PREDICTIONS, Position, named, position

CHECKPOINTS, RUNS, RESULTS = "checkpoints", "runs.json", "results.json"
TENSORBOARD, ERRORS, TUNING, JOURNAL = "tensorboard", "errors.csv", "tuning.json", "optuna.log"
WORKERS, JOB, HYDRA, PLANAR = "workers", "job.json", ".hydra", "planar"
ESTIMATOR, ESTIMATOR_BESIDE = "Ensemble", "Planar"  # the kinds of state in checkpoints
INDEXES = (RUNS, TUNING, JOURNAL, JOB)  # each says that the folder is that of a run, a tuning, a search, a job
INDEXED = (CHECKPOINTS, PREDICTIONS, TENSORBOARD, RESULTS, ERRORS)  # what is written after one of them


def save_results(folder: Path, results: Mapping[str, Any]) -> None:
    """Write `results.json`. NaN becomes null, because JSON has no NaN."""
    text = json.dumps(json.loads(json.dumps(results), parse_constant=lambda _: None), indent=2)
    write_atomically(folder / RESULTS, text.encode())


def runs_file(folder: Path) -> dict[str, Any]:
    """The content of `runs.json`: per boat, name, length and digest of each run; and the digest of the ensemble."""
    path = folder / RUNS
    try:
        content = json.loads(path.read_text())
        boats = {
            boat: [(str(name), int(length), str(key)) for name, length, key in runs]
            for boat, runs in content["boats"].items()
        }
        if any(length < 0 for runs in boats.values() for _, length, _ in runs):
            raise ValueError("a run has fewer than 0 steps")
        return {"boats": boats, "ensemble": str(content["ensemble"])}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise CheckpointError(f"{path}: is damaged ({error}): make the run anew") from error


def digest(run: Run, element: int) -> str:
    """A sha256 of one boat's samples."""
    total = hashlib.sha256()
    for name, leaf in named_leaves(run.samples):
        total.update(name.encode() + leaf[: run.lengths[element], element].tobytes())
    return total.hexdigest()


def number(folder: Path) -> int:
    """The number of a folder's run among the runs beside it; 0 if it has none."""
    try:
        number = json.loads((folder / RUNS).read_text())["began"]["number"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return 0
    return number if type(number) is int and 0 < number < 2**53 else 0


def begun(folder: Path) -> tuple[int, int, Position, str]:
    """A key that sorts the runs in one folder by when they began or last resumed.

    Clocks can be set back, so runs are numbered as they begin. Of two of one number the one that came further is later.
    """
    paths, rank = list((folder / CHECKPOINTS).glob(f"*/*{SUFFIX}")), number(folder)
    stamp = 0 if rank else max(path.stat().st_mtime_ns for path in [*paths, folder / RUNS])
    return rank, stamp, max(filter(None, map(position, paths)), default=BEGIN), folder.name


def same_run(folder: Path, runs: Mapping[str, Any]) -> bool:
    """Whether a folder was made by this ensemble from these runs, or the first of them, as `runs.json` has them."""
    try:
        old = json.loads((folder / RUNS).read_text())
        same = list(old["boats"]) == list(runs["boats"])
        same = same and (old["ensemble"] == runs["ensemble"] or _saved_ensemble(folder) == runs["ensemble"])
        return same and all(runs["boats"][boat][: len(first)] == first for boat, first in old["boats"].items())
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def ensemble_digest(configuration: Mapping[str, Any]) -> str:
    """A sha256 of what makes the ensemble of a run."""
    parts = [configuration.get(name) for name in ("estimators", "combiners", "forecasts", "conditional")]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _saved_ensemble(folder: Path) -> str:
    """The digest of the ensemble in a run's newest readable checkpoint, by the names of today; "" without one."""
    for path in sorted((folder / CHECKPOINTS).glob(f"*/*{SUFFIX}"), reverse=True):
        with suppress(CheckpointError):
            return ensemble_digest(load(path)[1].get("configuration") or {})
    return ""


def own_predictions(folder: Path) -> list[Path]:
    """The predictions that the index of a folder names, in order; none without an index."""
    try:
        boats = runs_file(folder)["boats"]
    except CheckpointError:
        return []
    return named(folder, longest(boats))


def longest(boats: Mapping[str, Sequence[tuple[str, int, str]]]) -> list[int]:
    """The steps of the longest boat in each run, of the boats in `runs.json`."""
    most = max(map(len, boats.values()), default=0)
    return [max(runs[k][1] for runs in boats.values() if k < len(runs)) for k in range(most)]


def check_own(folder: Path, option: str = "hydra.run.dir") -> None:
    """Refuse a folder for a run where a file has a name of a run's, but is a link or of no run."""
    for name in (*INDEXES, *INDEXED, HYDRA, WORKERS):
        for path in _all(folder / name):
            check_no_link(path, option)
    if any((folder / name).exists() for name in INDEXES):
        return
    for name in INDEXED:
        for path in _all(folder / name):
            begins = name == CHECKPOINTS and position(path) == BEGIN  # the checkpoint from which a run was to start
            if not (path.is_dir() or begins or LEFT.fullmatch(path.name)):
                raise no_run(path, option)


def check_no_link(path: Path, option: str) -> None:
    """Raise a ConfigError if a path is a link."""
    if path.is_symlink():
        raise ConfigError(f"{path}: found a link, through which nothing is written: choose another {option}")


def no_run(path: Path, option: str = "hydra.run.dir") -> ConfigError:
    """The error that a file belongs to no run."""
    return ConfigError(f"{path}: found a file of no run, where a run writes its own: choose another {option}")


def _all(path: Path) -> Iterator[Path]:
    """A file; or a folder, and all that is below it, behind no link. Nothing where there is nothing."""
    if os.path.lexists(path):
        yield path
        for at, folders, files in () if path.is_symlink() else os.walk(path):
            yield from (Path(at, name) for name in sorted((*folders, *files)))
