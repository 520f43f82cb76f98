"""The jobs of a sweep: each is known by its settings, skipped once it is finished, gone on with, recorded if it fails.

job.json         the settings whose job the folder is, and how the command put them
results.json     what it found, or {"error": reason}
traceback.txt    of an error that nobody foresaw
"""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from typing import Any, NamedTuple

from usvlearn.checkpoint import write_atomically
from usvlearn.errors import ConfigError, MissingExtraError, UsvlearnError, bad_input, one_sentence
from usvlearn.evaluation.tables import differing, told
from usvlearn.learning.run_folder import RESULTS, RUNS, save_results

JOB, TRACEBACK = "job.json", "traceback.txt"
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
LAUNCHERS = {  # name -> its plugin, and the extra that brings it
    "basic": None,
    "joblib": ("hydra_joblib_launcher", "sweep"),
    **dict.fromkeys(["slurm", "submitit_slurm", "submitit_local"], ("hydra_submitit_launcher", "slurm")),
}


class Job(NamedTuple):
    """A run among others."""

    folder: Path
    settings: dict[str, str]  # what its command set, by key
    results: dict[str, Any]  # of results.json; {"error": reason} where it failed, {} where it did not finish


def check_launcher(arguments: Sequence[str]) -> None:
    """End with one sentence and code 2 unless the launcher that a command line names is known and installed.

    >>> check_launcher(["-m", "hydra/launcher=basic"])
    """
    with one_sentence():
        _check_launcher(arguments)


def _check_launcher(arguments: Sequence[str]) -> None:
    for argument in arguments:
        key, _, name = argument.partition("=")
        if key.lstrip("+") != "hydra/launcher" or name == "basic":
            continue
        plugin, extra = LAUNCHERS.get(name) or (f"hydra_{name}_launcher", None)
        if not (find_spec("hydra_plugins") and find_spec(f"hydra_plugins.{plugin}")):
            if extra is None:
                raise ConfigError(f"hydra/launcher: found {name!r}, expected one of {', '.join(LAUNCHERS)}")
            raise MissingExtraError(plugin.replace("_", "-"), extra, argument)
        if name.endswith("slurm") and which("srun") is None:
            raise ConfigError(f"{argument}: found no srun, expected a Slurm cluster: start it there, or take joblib")


def prepare_workers(root: Path) -> None:
    """Let the processes that a launcher starts compute with one thread each, and find the scripts in `root`."""
    os.environ |= dict.fromkeys(THREADS, "1")
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))


def check_sweep(folder: Path, load: Callable[[Path], Any], hydra: Mapping[str, Any]) -> None:
    """Raise where a folder holds the jobs of another sweep, before its notes are written over.

    Args:
        folder: of the sweep.
        load: reads a YAML file.
        hydra: the configuration of Hydra itself, as `multirun.yaml` keeps it of the sweep before.

    Raises:
        ConfigError: the command, or what its sweep sets, is not the one that began there.
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
    """By which a job is known: a sha256 of all its settings, in their order, which is that of the members.

    >>> digest({"dt": 0.4})[:8]
    'e33f88fb'
    """
    return hashlib.sha256(json.dumps(settings).encode()).hexdigest()


def run_job(
    folder: Path,
    settings: Mapping,
    overrides: Sequence[str],
    work: Callable[[str | None], float],
    wrapper: type[BaseException] = UsvlearnError,
) -> float:
    """Do one job of a sweep: nothing if it is finished, the rest if it was begun, all if it failed before.

    A folder that holds the job of other settings is left as it is. No error leaves this function: the other jobs go on.

    Args:
        folder: the job's own.
        settings: all of them; another value of any is another job.
        overrides: what the command set, for the person who meets the folder.
        work: does it, resuming from a folder or as its settings say (None); returns the objective.
        wrapper: of an error that was foreseen; see `usvlearn.errors.bad_input`.

    Returns:
        The objective, NaN where the job failed.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     run_job(Path(folder), {"dt": 0.4}, ["dt=0.4"], lambda resume: 0.03)
    0.03
    """
    if settings.get("resume") == "latest":
        print("error: resume=latest: a sweep goes on from where it stopped by itself: leave it out", file=sys.stderr)
        return float("nan")
    known, held, results = digest(settings), _read(folder / JOB), _read(folder / RESULTS)
    begun, done = (folder / RUNS).exists(), "boats" in results
    if held.get("settings", known) != known and (begun or done):
        print(f"error: {_foreign(folder, held, overrides)}", file=sys.stderr)
        return float("nan")
    if "settings" in held and done:
        print(f"finished before: {folder}")
        objective = results.get("objective")
        return float("nan") if objective is None else objective
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for old in (RESULTS, TRACEBACK):
            (folder / old).unlink(missing_ok=True)
        note = {"settings": known, "overrides": list(overrides)}
        write_atomically(folder / JOB, json.dumps(note, indent=2).encode())
        return work(str(folder) if begun else None)
    except Exception as error:
        cause, told = bad_input(error, wrapper), traceback.format_exc()
        with suppress(OSError):  # a folder that nobody can write to is known by what it lacks
            if cause is None:
                cause = f"{type(error).__name__}: {error} (see {folder / TRACEBACK})"
                write_atomically(folder / TRACEBACK, told.encode())
            save_results(folder, {"error": cause})
        print(f"error: {cause}", file=sys.stderr)
        return float("nan")


def jobs(folder: Path, load: Callable[[Path], Any]) -> list[Job]:
    """The runs below a folder, in the order of their names.

    Args:
        folder: of a sweep, or any that runs were written to.
        load: reads the YAML files that each run keeps of its configuration, as lists and dictionaries.

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
            results = {"error": _foreign(path, held, overrides)}  # Hydra has written its notes before anyone could look
        found.append(Job(path, _by_key(overrides), results))
    return found


def _by_key(overrides: Sequence[str]) -> dict[str, str]:
    return dict(text.partition("=")[::2] for text in overrides)


def _foreign(folder: Path, held: Mapping, overrides: Sequence[str]) -> str:
    """That a folder holds another job, and by what that one differs."""
    old, new = _by_key(held["overrides"]), _by_key(overrides)
    keys = differing([old, new])
    other = told(old, keys) if keys else "of configuration files that were another then"
    return f"{folder} holds another job, {other}: repeat the command that made it, or choose another hydra.sweep.dir"


def _read(path: Path) -> dict[str, Any]:
    """A JSON file; {} where there is none, {"error": …} where it is damaged."""
    try:
        found = json.loads(path.read_text())
        if not isinstance(found, dict):
            raise ValueError(f"found {type(found).__name__}, expected a dictionary")
        return found
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        return {"error": f"{path} is damaged ({error}): run the same command again to have it made anew"}
