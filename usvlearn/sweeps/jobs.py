"""The jobs of a sweep: identified by their settings, skipped if finished, resumed if begun, recorded if they fail.

In a job's folder:

job.json         all settings of the job, and those that the command gave
results.json     the results, or {"error": reason}
traceback.txt    of an unexpected error

In the sweep's folder:

sweep.json       the keys with several values, their values without the sweep, the objective
"""

from __future__ import annotations

import csv
import hashlib
import json
import math
import shlex
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from usvlearn.core.checkpoint import write_atomically
from usvlearn.core.lock import Lock
from usvlearn.errors import ConfigError, UsvlearnError, bad_input, printable
from usvlearn.evaluation.comparison import RunError, from_csv
from usvlearn.evaluation.objective import Measure, differing, measure_of, own_measure, ranked_by, scored
from usvlearn.report.tables import short_settings
from usvlearn.runs.files import ERRORS, JOB, RESULTS, RUNS, check_no_link, check_own, save_results

TRACEBACK, SWEEP = "traceback.txt", "sweep.json"


class Job(NamedTuple):
    """One run of a sweep."""

    folder: Path
    settings: dict[str, str]  # the settings of its command, by key
    results: dict[str, Any]  # of results.json; {"error": reason} if it failed, {} if it did not finish

    @property
    def finished(self) -> bool:
        return "boats" in self.results

    @property
    def failure(self) -> str:
        """Why it has no results; "" if it has."""
        return "" if self.finished else self.results.get("error", "did not finish")


class SweepNote(NamedTuple):
    """The content of `sweep.json`."""

    swept: tuple[str, ...] = ()  # keys with several values
    defaults: Mapping[str, str] = {}  # their values without the sweep, those that are known
    objective: str | None = None


def check_sweep(folder: Path, load: Callable[[Path], Any], hydra: Mapping[str, Any]) -> None:
    """Refuse a folder with the jobs of another sweep, links, or files of no job under the names of a job's."""
    held = folder / "multirun.yaml"
    check_no_link(held, "hydra.sweep.dir")
    for path in sorted(folder.glob("*")):
        if path.name.isdecimal():
            check_no_link(path, "hydra.sweep.dir")
            check_own(path, "hydra.sweep.dir")
    if not (held.exists() and any(folder.glob(f"*/{JOB}"))):
        return
    try:
        old = load(held)["hydra"]
        asked = [[sorted(each["overrides"]["task"]), each["sweeper"].get("params")] for each in (old, hydra)]
    except (KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{held}: is damaged ({error!r}): choose another hydra.sweep.dir") from error
    if asked[0] != asked[1]:
        raise ConfigError(
            f"{folder}: holds the jobs of another sweep, {shlex.join(old['overrides']['task'])}: repeat that command, "
            "or choose another hydra.sweep.dir"
        )


def digest(settings: Mapping) -> str:
    """The identity of a job: a sha256 of all its settings, in their order, which is that of the members."""
    return hashlib.sha256(json.dumps(settings).encode()).hexdigest()


def run_job(
    folder: Path,
    settings: Mapping,
    overrides: Sequence[str],
    work: Callable[[str | None], float],
    note: SweepNote = SweepNote(),  # noqa: B008  # a constant
) -> float:
    """Do one job of a sweep: nothing if it is finished, the rest if it was begun, everything if it failed before.

    A folder with a job of other settings, or in which another process works, is not changed. No error leaves this
    function, so the other jobs continue. `work` resumes from a folder, or as its settings say (None). The result ranks
    the job, less is better; NaN if it failed, or if that is unknown.
    """
    if settings.get("resume") == "latest":
        print("error: resume=latest: a sweep continues where it stopped without it: leave it out", file=sys.stderr)
        return float("nan")
    try:
        check_own(folder, "hydra.sweep.dir")
        lock = Lock(folder, "hydra.sweep.dir")
    except (UsvlearnError, OSError) as error:
        print(f"error: {bad_input(error) or error}", file=sys.stderr)
        return float("nan")
    with lock:
        return _run_job(folder, settings, overrides, work, note)


def _run_job(
    folder: Path, settings: Mapping, overrides: Sequence[str], work: Callable[[str | None], float], note: SweepNote
) -> float:
    """`run_job` in a folder that is locked."""
    known, held, results = digest(settings), _read(folder / JOB), _read(folder / RESULTS)
    begun, done = (folder / RUNS).exists(), "boats" in results
    if held.get("settings", known) != known and (begun or done):
        print(f"error: {_foreign(folder, held, overrides)}", file=sys.stderr)
        return float("nan")
    if "settings" in held and done:
        return _loss(results, note)
    try:
        for old in (RESULTS, TRACEBACK):
            (folder / old).unlink(missing_ok=True)
        noted = {"settings": known, "overrides": list(overrides)}
        write_atomically(folder / JOB, json.dumps(noted, indent=2).encode())
        objective = work(str(folder) if begun else None)
        return _loss({"objective": objective, **_read(folder / RESULTS)}, note)
    except Exception as error:
        cause, trace = bad_input(error), traceback.format_exc()
        with suppress(OSError):  # the missing results show that a folder was not writable
            if cause is None:
                cause = f"{type(error).__name__}: {error} (see {folder / TRACEBACK})"
                write_atomically(folder / TRACEBACK, trace.encode())
            save_results(folder, {"error": cause})
        return float("nan")


def ranked_alone(results: Mapping[str, Any], note: SweepNote) -> tuple[Measure, float | None]:
    """What ranks a job, and its value, before the other jobs are known."""
    result = scored(results, ranked_by(note.objective, note.swept, [results]))
    return own_measure(result), result.get("objective")


def _loss(results: Mapping[str, Any], note: SweepNote) -> float:
    measure, value = ranked_alone(results, note)
    loss = measure.loss(value)
    return loss if math.isfinite(loss) else float("nan")


def note_sweep(folder: Path, note: SweepNote) -> None:
    """Write `sweep.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(folder / SWEEP, json.dumps(note._asdict(), indent=2).encode())


def noted_sweep(folder: Path) -> SweepNote:
    """What `sweep.json` says; an empty note where it is missing or damaged."""
    content = _read(folder / SWEEP)
    swept, defaults, objective = (content.get(key) for key in SweepNote._fields)
    return SweepNote(
        tuple(map(str, swept)) if isinstance(swept, list) else (),
        {str(key): str(value) for key, value in defaults.items()} if isinstance(defaults, dict) else {},
        objective if isinstance(objective, str) else None,
    )


def errors_of(job: Job) -> Sequence[RunError]:
    """The errors of a job by run; none where they are missing or damaged."""
    try:
        return from_csv((job.folder / ERRORS).read_text())
    except (OSError, ValueError, csv.Error):
        return ()


def jobs(folder: Path, load: Callable[[Path], Any]) -> list[Job]:
    """The runs below a folder, in the order of their names; `load` reads a YAML file."""
    paths = [path.parents[1] for path in folder.glob("**/.hydra/overrides.yaml")]
    if not paths:
        raise ConfigError(f"runs: found no run below {str(folder)!r}, expected a folder that `train` has written")
    listed = []
    for path in sorted(paths, key=lambda path: (path.parent, len(path.name), path.name)):  # 2 before 10
        overrides = load(path / ".hydra" / "overrides.yaml")
        results, held = _read(path / RESULTS), _read(path / JOB)
        if "settings" in held and held["settings"] != digest(load(path / ".hydra" / "config.yaml")):
            results = {"error": _foreign(path, held, overrides)}  # Hydra has already written its records there
        listed.append(Job(path, by_key(overrides), results))
    return listed


def by_key(overrides: Sequence[str]) -> dict[str, str]:
    """The settings of a command line by key."""
    parts = (printable(str(text)).partition("=") for text in overrides)
    return {key: value for key, _, value in parts}


def _foreign(folder: Path, held: Mapping, overrides: Sequence[str]) -> str:
    """The message that a folder holds another job, and the settings that differ."""
    old, new = by_key(held["overrides"]), by_key(overrides)
    keys = differing([old, new])
    changes = short_settings(old, keys) if keys else "of configuration files that were another then"
    return f"{folder} holds another job, {changes}: repeat the command that made it, or choose another hydra.sweep.dir"


def check_results(results: Mapping[str, Any]) -> None:
    """Raise a ValueError unless what a leaderboard reads of `results.json` has its form: others may have written it."""
    tables = {"boats": 3, "forecast": 4, "free": 2}  # depth of the dictionaries: boat, method, horizon, score
    for name, depth in tables.items():
        if name in results and not _are_numbers(results[name], depth):
            raise ValueError(f"{name}: expected numbers by boat, method and score")
    for name in ("seconds", "objective"):
        if name in results and not _is_number(results[name]):
            raise ValueError(f"{name}: found {results[name]!r:.50}, expected a number")
    if "measure" in results:
        measure_of(str(results["measure"]), "")
    networks = results.get("network", {})
    verdicts = [x for members in networks.values() for x in members.values()]
    if not all(isinstance(x["contracting"], bool) and _is_number(x["rate"]) for x in verdicts):
        raise ValueError("network: expected a verdict and a rate by boat and network")


def _are_numbers(node: Any, depth: int) -> bool:
    """Whether a tree of so many dictionaries has numbers, or null, at its ends."""
    if depth == 0:
        return _is_number(node)
    return isinstance(node, dict) and all(_are_numbers(child, depth - 1) for child in node.values())


def _is_number(x: Any) -> bool:
    return x is None or isinstance(x, int | float)


def _read(path: Path) -> dict[str, Any]:
    """A JSON file; {} where there is none, {"error": …} where it is damaged."""
    try:
        content = json.loads(path.read_text())
        if not isinstance(content, dict):
            raise ValueError(f"found {type(content).__name__}, expected a dictionary")
        if path.name == RESULTS:
            check_results(content)
        if "settings" in content and not isinstance(content.get("overrides"), list):
            raise ValueError("overrides: expected a list")
        return content | {"error": printable(str(content["error"]))} if "error" in content else content
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, TypeError, KeyError, AttributeError, UsvlearnError, RecursionError) as error:
        return {"error": f"{path} is damaged ({error}): run the same command again"}
