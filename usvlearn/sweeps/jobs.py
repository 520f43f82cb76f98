"""The jobs of a sweep: identified by their settings, skipped if finished, resumed if begun, recorded if they fail.

job.json         all settings of the job, and those that the command gave
results.json     the results, or {"error": reason}
traceback.txt    of an unexpected error
"""

from __future__ import annotations

import hashlib
import json
import shlex
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from usvlearn.checkpoint import write_atomically
from usvlearn.errors import ConfigError, UsvlearnError, bad_input, printable
from usvlearn.evaluation.ranking import differing, ranked_by, scored
from usvlearn.lock import Lock
from usvlearn.report.tables import short_settings
from usvlearn.runs.layout import RESULTS, RUNS, save_results

JOB, TRACEBACK = "job.json", "traceback.txt"


class Job(NamedTuple):
    """One run of a sweep."""

    folder: Path
    settings: dict[str, str]  # the settings of its command, by key
    results: dict[str, Any]  # of results.json; {"error": reason} if it failed, {} if it did not finish


def check_sweep(folder: Path, load: Callable[[Path], Any], hydra: Mapping[str, Any]) -> None:
    """Raise an error if a folder holds the jobs of another sweep, before its records are overwritten.

    Args:
        folder: of the sweep.
        load: reads a YAML file.
        hydra: the configuration of Hydra itself, which `multirun.yaml` contains for the earlier sweep.

    Raises:
        ConfigError: the command, or the settings of its sweep, differ from those that began there.
    """
    held = folder / "multirun.yaml"
    if not (held.exists() and any(folder.glob(f"*/{JOB}"))):
        return
    old = load(held)["hydra"]
    asked = [[sorted(each["overrides"]["task"]), each["sweeper"].get("params")] for each in (old, hydra)]
    if asked[0] != asked[1]:
        raise ConfigError(
            f"{folder}: holds the jobs of another sweep, {shlex.join(old['overrides']['task'])}: repeat that command, "
            "or choose another hydra.sweep.dir"
        )


def digest(settings: Mapping) -> str:
    """The identity of a job: a sha256 of all its settings, in their order, which is that of the members.

    >>> digest({"dt": 0.4})[:8]
    'e33f88fb'
    """
    return hashlib.sha256(json.dumps(settings).encode()).hexdigest()


def run_job(
    folder: Path,
    settings: Mapping,
    overrides: Sequence[str],
    work: Callable[[str | None], float],
    swept: Sequence[str] = (),
) -> float:
    """Do one job of a sweep: nothing if it is finished, the rest if it was begun, everything if it failed before.

    A folder with a job of other settings, or in which another process works, is not changed. No error leaves this
    function, so the other jobs continue.

    Args:
        folder: the job's own.
        settings: all settings; a different value of any is a different job.
        overrides: the settings of the command, for people who read the folder.
        work: does the job, resuming from a folder or as its settings say (None); returns its own objective.
        swept: the keys to which the sweep gives several values.

    Returns:
        The error that ranks the job in the leaderboard, NaN if it failed.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     run_job(Path(folder), {"dt": 0.4}, ["dt=0.4"], lambda resume: 0.03)
    0.03
    """
    if settings.get("resume") == "latest":
        print("error: resume=latest: a sweep continues where it stopped without it: leave it out", file=sys.stderr)
        return float("nan")
    try:
        lock = Lock(folder, "hydra.sweep.dir")
    except (UsvlearnError, OSError) as error:
        print(f"error: {bad_input(error) or error}", file=sys.stderr)
        return float("nan")
    with lock:
        return _run_job(folder, settings, overrides, work, swept)


def _run_job(
    folder: Path,
    settings: Mapping,
    overrides: Sequence[str],
    work: Callable[[str | None], float],
    swept: Sequence[str],
) -> float:
    """`run_job` in a folder that is locked."""
    known, held, results = digest(settings), _read(folder / JOB), _read(folder / RESULTS)
    begun, done = (folder / RUNS).exists(), "boats" in results
    if held.get("settings", known) != known and (begun or done):
        print(f"error: {_foreign(folder, held, overrides)}", file=sys.stderr)
        return float("nan")
    if "settings" in held and done:
        print(f"finished before: {folder}")
        return _objective(results, overrides, swept)
    try:
        for old in (RESULTS, TRACEBACK):
            (folder / old).unlink(missing_ok=True)
        note = {"settings": known, "overrides": list(overrides)}
        write_atomically(folder / JOB, json.dumps(note, indent=2).encode())
        made = work(str(folder) if begun else None)
        return _objective({"objective": made, **_read(folder / RESULTS)}, overrides, swept)
    except Exception as error:
        cause, trace = bad_input(error), traceback.format_exc()
        with suppress(OSError):  # the missing results show that a folder was not writable
            if cause is None:
                cause = f"{type(error).__name__}: {error} (see {folder / TRACEBACK})"
                write_atomically(folder / TRACEBACK, trace.encode())
            save_results(folder, {"error": cause})
        print(f"error: {cause}", file=sys.stderr)
        return float("nan")


def _objective(results: Mapping[str, Any], overrides: Sequence[str], swept: Sequence[str]) -> float:
    found = scored(results, ranked_by(swept, [_by_key(overrides)], [results])).get("objective")
    return float("nan") if found is None else found


def jobs(folder: Path, load: Callable[[Path], Any]) -> list[Job]:
    """The runs below a folder, in the order of their names.

    Args:
        folder: of a sweep, or any other folder with runs.
        load: reads the YAML files of each run's configuration, as lists and dictionaries.

    Raises:
        ConfigError: there is none.

    >>> jobs(Path("nowhere"), json.loads)
    Traceback (most recent call last):
    usvlearn.errors.ConfigError: runs: found no run below 'nowhere', expected a folder that train.py has written
    """
    paths = [path.parents[1] for path in folder.glob("**/.hydra/overrides.yaml")]
    if not paths:
        raise ConfigError(f"runs: found no run below {str(folder)!r}, expected a folder that train.py has written")
    found = []
    for path in sorted(paths, key=lambda path: (path.parent, len(path.name), path.name)):  # 2 before 10
        overrides = load(path / ".hydra" / "overrides.yaml")
        results, held = _read(path / RESULTS), _read(path / JOB)
        if "settings" in held and held["settings"] != digest(load(path / ".hydra" / "config.yaml")):
            results = {"error": _foreign(path, held, overrides)}  # Hydra has already written its records there
        found.append(Job(path, _by_key(overrides), results))
    return found


def _by_key(overrides: Sequence[str]) -> dict[str, str]:
    parts = (printable(str(text)).partition("=") for text in overrides)
    return {key: value for key, _, value in parts}


def _foreign(folder: Path, held: Mapping, overrides: Sequence[str]) -> str:
    """The message that a folder holds another job, and the settings that differ."""
    old, new = _by_key(held["overrides"]), _by_key(overrides)
    keys = differing([old, new])
    other = short_settings(old, keys) if keys else "of configuration files that were another then"
    return f"{folder} holds another job, {other}: repeat the command that made it, or choose another hydra.sweep.dir"


def _are_scores(boats: Any) -> bool:
    """Whether these are numbers, or null, by boat, method and score."""
    tables = list(boats.values()) if isinstance(boats, dict) else [None]
    rows = [row for table in tables for row in (table.values() if isinstance(table, dict) else [None])]
    return all(
        isinstance(row, dict) and all(x is None or isinstance(x, int | float) for x in row.values()) for row in rows
    )


def _read(path: Path) -> dict[str, Any]:
    """A JSON file; {} where there is none, {"error": …} where it is damaged."""
    try:
        found = json.loads(path.read_text())
        if not isinstance(found, dict):
            raise ValueError(f"found {type(found).__name__}, expected a dictionary")
        if "boats" in found and not _are_scores(found["boats"]):
            raise ValueError("boats: expected numbers by boat, method and score")
        if "settings" in found and not isinstance(found.get("overrides"), list):
            raise ValueError("overrides: expected a list")
        return found | {"error": printable(str(found["error"]))} if "error" in found else found
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, RecursionError) as error:
        return {"error": f"{path} is damaged ({error}): run the same command again"}
