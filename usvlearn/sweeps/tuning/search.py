"""Search of hyperparameters by Optuna: a journal in the folder, in which a later process, and several at once, go on.

Each process takes a batch of trials and evaluates them as batch elements, until all together have completed the budget.
One process keeps to it exactly. Several may exceed it by what the others have in hand then.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from usvlearn.core.lock import Lock
from usvlearn.errors import ConfigError, MissingExtraError
from usvlearn.runs.files import JOURNAL, WORKERS
from usvlearn.runs.trust import check_setting
from usvlearn.sweeps.tuning.batches import Evaluation, Hyperparameter, Objective
from usvlearn.sweeps.tuning.methods import Fitted

STUDY = "tuning"


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
    folder: Path,
    facts: Mapping[str, Any],
    batch: int = 16,
    seed: int = 0,
) -> Fitted:
    """Run trials of a tree-structured Parzen estimator until all processes together have completed the budget.

    `facts` identify the search: another one must not continue in the folder. The seed of a process differs by the
    number of its first trial.
    """
    try:
        import optuna
        from optuna.storages import JournalStorage, journal
    except ImportError as error:
        raise MissingExtraError("optuna", "tune", "search") from error
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    batch = max(1, min(batch, objective.batch - 1))
    folder.mkdir(parents=True, exist_ok=True)
    lock: Any = _JournalLock(folder / JOURNAL)
    backend = journal.JournalFileBackend(str(folder / JOURNAL), lock)
    storage = JournalStorage(backend)
    study = optuna.create_study(storage=storage, study_name=STUDY, load_if_exists=True)
    identity = json.dumps(dict(facts), sort_keys=True)
    if study.user_attrs.get("facts", identity) != identity:
        raise ConfigError(
            f"{folder}: holds another estimator's, range's or fleet's search: choose another hydra.run.dir"
        )
    study.set_user_attr("facts", identity)
    default = {each.path: each.default for each in parameters}
    results: list[Evaluation] = []
    objective.advance(len(complete := _complete(study)))
    while len(complete) < evaluations or not results:
        trials = [study.ask() for _ in range(min(batch, evaluations - len(complete)))]
        if trials and not results:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)  # of what parts a batch
                study.sampler = optuna.samplers.TPESampler(seed=seed + trials[0].number, constant_liar=True)
        settings = [_setting(trial, parameters) for trial in trials]
        try:
            evaluated = objective([*settings, *([] if results else [default])])
        except BaseException:
            for trial in trials:  # which would count as running for ever
                study.tell(trial.number, state=optuna.trial.TrialState.FAIL)
            raise
        results = results or evaluated[-1:]
        for trial, evaluation in zip(trials, evaluated, strict=False):
            trial.set_user_attr("maes", [mae if math.isfinite(mae) else None for mae in evaluation.maes])
            trial.set_user_attr("runs", evaluation.runs)
            study.tell(trial.number, evaluation.mae)
        complete = _complete(study)
    for trial in complete:
        maes = tuple(math.inf if mae is None else mae for mae in trial.user_attrs["maes"])
        setting = check_setting(str(folder / JOURNAL), trial.user_attrs["setting"])
        results.append(Evaluation(setting, maes, trial.user_attrs.get("runs")))
    return Fitted(results, len(complete))


def _setting(trial: Any, parameters: Sequence[Hyperparameter]) -> dict[str, float]:
    """What a trial is to evaluate."""
    places = [trial.suggest_float(f"{each.kind.__name__}({each.path})", *each.span) for each in parameters]
    setting = {each.path: each.from_scale(x) for each, x in zip(parameters, places, strict=True)}
    trial.set_user_attr("setting", setting)
    return setting


def _complete(study: Any) -> list[Any]:
    return [trial for trial in study.get_trials(deepcopy=False) if trial.state.name == "COMPLETE"]
