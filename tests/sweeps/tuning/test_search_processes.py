"""Four processes that search in one folder, and are killed at random: the budget is completed, each trial once."""

import json
import math
import multiprocessing
import random
import signal
import subprocess
import time
from collections import Counter
from pathlib import Path

import optuna
import pytest

from tests.support import few
from tests.support.commands import ENVIRONMENT, command
from tests.support.configured import TWO_BOATS
from usvlearn.core.hyperparameters import Positive
from usvlearn.sweeps.tuning import search
from usvlearn.sweeps.tuning.batches import Evaluation, Hyperparameter

pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
COMPLETE = 1  # Optuna's number of the state
SET_STATE = 6  # Optuna's number of the operation


class StandIn:
    """An objective that takes 90 ms, notes each evaluation, and never gives the same error twice."""

    batch = 16

    def __init__(self, notes: Path):
        self.notes, self.advance = notes, lambda work: None

    def __call__(self, settings):
        found = [Evaluation(setting, (random.SystemRandom().random(),)) for setting in settings]
        for _ in range(3):
            time.sleep(0.03)
            self.advance(len(settings) / 3)
        with self.notes.open("a") as file:
            file.write("".join(f"{each.setting['gain']!r} {each.mae!r}\n" for each in found))
        return found


def one_process(folder: Path, budget: int) -> None:
    search.STALE = 0.5
    gain = Hyperparameter("gain", Positive, 1.0, 0.01, 100.0)
    found, used = search.search(StandIn(folder / "notes.txt"), [gain], budget, folder / "run", {}, batch=3)
    (folder / f"found{multiprocessing.current_process().pid}.json").write_text(json.dumps([found[1:], used]))


def trials(folder: Path) -> list[optuna.trial.FrozenTrial]:
    backend = optuna.storages.journal.JournalFileBackend(str(folder / "optuna.log"))
    return optuna.load_study(study_name=search.STUDY, storage=optuna.storages.JournalStorage(backend)).trials


def completions(folder: Path) -> Counter:
    """How often the journal says of a trial that it is complete."""
    lines = map(json.loads, (folder / "optuna.log").read_text().splitlines())
    return Counter(line["trial_id"] for line in lines if line["op_code"] == SET_STATE and line["state"] == COMPLETE)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", few(range(2), [0]))
def test_processes_that_are_killed_lose_no_trial_and_complete_none_twice(seed, tmp_path):
    budget, kills, chance = 60, 0, random.Random(seed)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])

    def start():
        process = context.Process(target=one_process, args=(tmp_path, budget))
        process.start()
        return process

    processes = [start() for _ in range(4)]
    while not list(tmp_path.glob("found*.json")):
        time.sleep(chance.uniform(0, 0.08))
        place = chance.randrange(4)
        if kills < 20 and processes[place].is_alive():
            processes[place].kill()
            processes[place].join()
            processes[place], kills = start(), kills + 1
    for process in processes:
        process.join(60)
        assert process.exitcode == 0
    complete = [each for each in trials(tmp_path / "run") if each.state.name == "COMPLETE"]
    assert len(complete) == budget and kills > 5
    assert set(completions(tmp_path / "run").values()) == {1}
    evaluated = {tuple(map(float, line.split())) for line in (tmp_path / "notes.txt").read_text().splitlines()}
    own = [(each.user_attrs["setting"]["gain"], each.value) for each in complete]
    assert set(own) <= evaluated and len(set(own)) == budget  # the results of 60 evaluations, none of them replaced
    for path in tmp_path.glob("found*.json"):
        found, used = json.loads(path.read_text())
        assert used == budget and [(setting["gain"], maes[0]) for setting, maes in found] == own


def test_a_process_that_stood_still_goes_on_without_the_trial_that_was_given_back(tmp_path, monkeypatch):
    """Another process has given a trial back between the moment in which it was taken, and its setting."""
    ask, taken = optuna.Study.ask, []

    def slow(study):
        trial = ask(study)
        if not taken:
            study.tell(trial.number, state=optuna.trial.TrialState.FAIL)
        taken.append(trial.number)
        return trial

    monkeypatch.setattr(optuna.Study, "ask", slow)
    gain = Hyperparameter("gain", Positive, 1.0, 0.01, 100.0)
    found, used = search.search(StandIn(tmp_path / "notes.txt"), [gain], 4, tmp_path / "run", {}, batch=2)
    assert used == 4 and len(found) == 5 and taken == [0, 1, 2, 3, 4]


def test_a_line_that_a_killed_process_left_unfinished_is_removed_before_another_follows(tmp_path):
    """Also while other processes have the journal open."""
    gain = Hyperparameter("gain", Positive, 1.0, 0.01, 100.0)
    objective = StandIn(tmp_path / "notes.txt")
    journal, evaluate, begun = tmp_path / "run" / "optuna.log", objective.__call__, []

    def tears(settings):
        with journal.open("ab") as file:
            begun.append(file.write(b'{"op_code":8,"worker_id":"'))
        return evaluate(settings)

    tears.batch, tears.advance = 16, lambda work: None
    _, used = search.search(tears, [gain], 6, tmp_path / "run", {}, batch=2)
    assert used == 6 and len(begun) == 3 and len(completions(tmp_path / "run")) == 6


@pytest.mark.slow
def test_searches_of_the_command_that_are_killed_complete_the_budget(tmp_path):
    arguments = command(*TWO_BOATS, "search=aid", "tuning.evaluations=40", "tuning.trials=2", "hydra.run.dir=run")
    chance, folder, kills = random.Random(0), tmp_path / "run", 0

    def start():
        return subprocess.Popen(arguments, cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.DEVNULL)

    processes = [start() for _ in range(4)]
    while not (folder / "tuning.json").exists() and any(process.poll() is None for process in processes):
        time.sleep(chance.uniform(0.5, 2))
        place = chance.randrange(4)
        if kills < 12 and (folder / "optuna.log").exists() and processes[place].poll() is None:
            processes[place].kill()
            processes[place].wait()
            processes[place], kills = start(), kills + 1
    assert [process.wait(300) for process in processes] == [0, 0, 0, 0] and kills > 3
    complete = [each for each in trials(folder) if each.state.name == "COMPLETE"]
    assert len(complete) == 40 and set(completions(folder).values()) == {1}
    found = json.loads((folder / "tuning.json").read_text())
    assert found["evaluations"] == 40
    own = [(each.user_attrs["setting"], each.value) for each in complete]
    told = [(each["setting"], each["mae"]) for each in found["evaluated"][1:]]
    assert told == own
    assert math.isclose(found["best"]["mae"], min(found["default"]["mae"], *(each.value for each in complete)))
