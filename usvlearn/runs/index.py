"""The index of a run's folder, `runs.json`: which runs it was made from, and which files there are its own.

A run removes only files that its index names, and writes through no link. Imports no torch, because the command asks
`check_own` before anything is written.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from usvlearn.core.checkpoint import LEFT, SUFFIX, load
from usvlearn.core.samples import Run, named_leaves
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.runs.file_names import (
    CHECKPOINTS,
    ERRORS,
    HYDRA,
    JOB,
    JOURNAL,
    PREDICTIONS,
    RESULTS,
    RUNS,
    TENSORBOARD,
    TUNING,
    WORKERS,
)  # fmt: skip
from usvlearn.runs.prediction_files import BEGIN, Position, named, position

INDEXES = (RUNS, TUNING, JOURNAL, JOB)  # each says that the folder is that of a run, a tuning, a search, a job
INDEXED = (CHECKPOINTS, PREDICTIONS, TENSORBOARD, RESULTS, ERRORS)  # what is written after one of them


def runs_file(folder: Path) -> dict[str, Any]:
    """The identity of a run: per boat, name, length and digest of each run; and the digest of the ensemble.

    Raises:
        CheckpointError: the file is missing or damaged.
    """
    path = folder / RUNS
    try:
        found = json.loads(path.read_text())
        boats = {
            boat: [(str(name), int(length), str(key)) for name, length, key in runs]
            for boat, runs in found["boats"].items()
        }
        if any(length < 0 for runs in boats.values() for _, length, _ in runs):
            raise ValueError("a run has fewer than 0 steps")
        return {"boats": boats, "ensemble": str(found["ensemble"])}
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
        found = json.loads((folder / RUNS).read_text())["began"]["number"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return 0
    return found if type(found) is int and 0 < found < 2**53 else 0


def begun(folder: Path) -> tuple[int, int, Position, str]:
    """A key that sorts the runs in one folder by when they began or last resumed.

    Clocks can be set back, so runs are numbered as they begin. Of two runs with the same number, the one that came
    further is the later.
    """
    found, own = list((folder / CHECKPOINTS).glob(f"*/*{SUFFIX}")), number(folder)
    stamp = 0 if own else max(path.stat().st_mtime_ns for path in [*found, folder / RUNS])
    return own, stamp, max(filter(None, map(position, found)), default=BEGIN), folder.name


def same_run(folder: Path, runs: Mapping[str, Any]) -> bool:
    """Whether a folder was made from these samples, or from the first of these runs, by this ensemble.

    Args:
        folder: of a run.
        runs: what `runs.json` would say of the new one.
    """
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
        boats = runs_file(folder)["boats"].values()
    except CheckpointError:
        return []
    most = max(map(len, boats), default=0)
    return named(folder, [max(runs[k][1] for runs in boats if k < len(runs)) for k in range(most)])


def check_own(folder: Path, option: str = "hydra.run.dir") -> None:
    """Check before anything is written that a run may write to a folder.

    Args:
        folder: of the run; it need not exist.
        option: by which the user can choose another one.

    Raises:
        ConfigError: a file or folder there with a name of a run's is a link, or belongs to no run.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as made:
    ...     check_own(Path(made))
    ...     Path(made, "predictions").mkdir()
    ...     Path(made, "predictions", "mine.npz").touch()
    ...     try:
    ...         check_own(Path(made))
    ...     except ConfigError as error:
    ...         print(str(error).removeprefix(made))
    /predictions/mine.npz: found a file of no run, where a run writes its own: choose another hydra.run.dir
    """
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
