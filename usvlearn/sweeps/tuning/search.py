"""Search of hyperparameters by Optuna: a journal in the folder, resumable, with one budget for several processes.

Each process takes a batch of trials and evaluates them as batch elements. Trials are numbered over all processes. A
trial counts if fewer trials than the budget have a lower number and were not given back. Each process touches a file
while it works (its heartbeat). When that file is old, the process was killed, and its unfinished trials are given back.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from usvlearn.core.lock import Lock
from usvlearn.errors import ConfigError, MissingExtraError
from usvlearn.runs.files import JOURNAL, WORKERS
from usvlearn.runs.trust import check_setting
from usvlearn.sweeps.tuning.batches import Evaluation, Hyperparameter, Objective

STALE = 60.0  # s without a heartbeat after which a process counts as dead; a chunk of steps takes a few s
STUDY = "tuning"


class _Worker:
    """One process that works on a folder: its number and its heartbeat."""

    def __init__(self, folder: Path):
        self.folder, self.number = folder, 0
        folder.mkdir(parents=True, exist_ok=True)
        while True:
            with contextlib.suppress(FileExistsError):
                (folder / str(self.number)).touch(exist_ok=False)
                return
            self.number += 1

    def live(self) -> None:
        (self.folder / str(self.number)).touch()

    def dead(self, number: int) -> bool:
        """Whether another process has had no heartbeat for a long time."""
        try:
            return time.time() - (self.folder / str(number)).stat().st_mtime > STALE
        except FileNotFoundError:
            return True

    def end(self) -> None:
        """Count as dead at once, so that unfinished trials are given back."""
        os.utime(self.folder / str(self.number), (0, 0))


class _JournalLock:
    """The lock under which a process adds lines to the journal.

    The system releases it when the process is killed, so no other process waits for a dead one. A line that a killed
    process, or a full disk, has left unfinished is removed before another follows: Optuna could not read on after it.
    """

    def __init__(self, journal: Path):
        self.journal = journal
        self.acquire()  # an unfinished line is removed before the journal is first read
        self.release()

    def acquire(self) -> bool:
        self._lock = Lock(self.journal.parent / WORKERS, "hydra.run.dir", wait=True)
        with self.journal.open("a+b") as file:
            size = file.tell()
            file.seek(max(0, size - 1))
            if file.read(1) not in (b"", b"\n"):
                file.seek(0)
                file.truncate(file.read().rfind(b"\n") + 1)
        return True

    def release(self) -> None:
        self._lock.release()


def search(
    objective: Objective,
    parameters: Sequence[Hyperparameter],
    evaluations: int,
    folder: str | Path,
    facts: Mapping[str, Any],
    batch: int = 16,
    seed: int = 0,
) -> tuple[list[Evaluation], int]:
    """Run trials of a tree-structured Parzen estimator until all processes together have completed the budget.

    Args:
        objective: evaluates settings.
        parameters: the hyperparameters that are searched.
        evaluations: the budget.
        folder: of the journal.
        facts: JSON values that identify the search; another search must not continue in the same folder.
        batch: trials that are evaluated as elements of one batch.
        seed: of the sampler, the same for every process.

    Returns:
        All evaluations, the default first; and their number without it.

    Raises:
        MissingExtraError: Optuna is not installed.
        ConfigError: the folder holds another search.
    """
    optuna = _optuna()
    batch = max(1, min(batch, objective.batch - 1))
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    journal = optuna.storages.journal
    backend = journal.JournalFileBackend(str(folder / JOURNAL), _JournalLock(folder / JOURNAL))
    storage = optuna.storages.JournalStorage(backend)
    study = optuna.create_study(storage=storage, study_name=STUDY, load_if_exists=True)
    identity = json.dumps(dict(facts), sort_keys=True)
    if study.user_attrs.get("facts", identity) != identity:
        raise ConfigError(
            f"{folder}: holds another estimator's, range's or fleet's search: choose another hydra.run.dir"
        )
    study.set_user_attr("facts", identity)
    worker, advance = _Worker(folder / WORKERS), objective.advance
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)  # of constant_liar, that parts a batch
        study.sampler = optuna.samplers.TPESampler(seed=seed + worker.number, constant_liar=True)

    def alive(work: float) -> None:
        worker.live()
        advance(work)

    objective.advance = alive
    default = {each.path: each.default for each in parameters}
    found: list[Evaluation] = []
    done = len(_complete(study))
    advance(done)
    try:
        while done < evaluations or not found:
            trials = list(_taken(study, parameters, worker, evaluations, batch))
            if not trials and found:  # other processes have taken the rest, or have died with it
                time.sleep(0.2)
                _give_back(study, worker)
                done = len(_complete(study))
                continue
            settings = [trial.user_attrs["setting"] for trial in trials]
            evaluated = objective([*settings, *([] if found else [default])])
            found, evaluated = found or evaluated[-1:], evaluated[: len(trials)]
            for trial, evaluation in zip(trials, evaluated, strict=True):
                finite = [mae if math.isfinite(mae) else None for mae in evaluation.maes]
                with contextlib.suppress(optuna.exceptions.UpdateFinishedTrialError):  # it was given back meanwhile
                    trial.set_user_attr("maes", finite)
                    study.tell(trial.number, evaluation.mae, skip_if_finished=True)
            done = len(_complete(study))
    finally:
        objective.advance = advance
        worker.end()
    for trial in _complete(study)[:evaluations]:
        maes = tuple(math.inf if mae is None else mae for mae in trial.user_attrs["maes"])
        found.append(Evaluation(check_setting(str(folder / JOURNAL), trial.user_attrs["setting"]), maes))
    return found, len(found) - 1


def _taken(
    study: Any, parameters: Sequence[Hyperparameter], worker: _Worker, evaluations: int, most: int
) -> Iterator[Any]:
    """Trials within the budget, even if other processes take some at the same time."""
    from optuna.exceptions import UpdateFinishedTrialError
    from optuna.trial import TrialState

    for _ in range(most):
        if _counted(study) >= evaluations:
            return
        worker.live()
        trial = study.ask()
        try:
            trial.set_user_attr("worker", worker.number)
            if _counted(study, trial.number) >= evaluations:
                study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)
                return
            places = {each.path: trial.suggest_float(f"{each.kind.__name__}({each.path})", *each.span)
                      for each in parameters}  # fmt: skip
            setting = {each.path: each.from_scale(places[each.path]) for each in parameters}
            trial.set_user_attr("setting", setting)
        except UpdateFinishedTrialError:  # this process stood still, and another has given the trial back
            continue
        yield trial


def _counted(study: Any, before: float = math.inf) -> int:
    """The number of complete or running trials with a lower number."""
    trials = study.get_trials(deepcopy=False)
    return sum(trial.number < before and trial.state.name in ("RUNNING", "COMPLETE") for trial in trials)


def _complete(study: Any) -> list[Any]:
    return [trial for trial in study.get_trials(deepcopy=False) if trial.state.name == "COMPLETE"]


def _give_back(study: Any, worker: _Worker) -> None:
    """Mark the unfinished trials of dead processes as failed."""
    from optuna.trial import TrialState

    for trial in study.get_trials(deepcopy=False):
        number = trial.user_attrs.get("worker")  # None for a moment after it was taken
        unsigned = number is None and time.time() - trial.datetime_start.timestamp() > STALE
        if trial.state.name == "RUNNING" and (unsigned or (number is not None and worker.dead(number))):
            with contextlib.suppress(ValueError, RuntimeError):  # another process was faster
                study.tell(trial.number, state=TrialState.FAIL)


def _optuna() -> Any:
    try:
        import optuna
    except ImportError as error:
        raise MissingExtraError("optuna", "tune", "search") from error
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return optuna
