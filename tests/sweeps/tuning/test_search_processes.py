"""Four processes that search in one folder, and are killed at random: the budget is completed, each trial once."""

import json
import multiprocessing
import random
import signal
import time
from collections import Counter
from pathlib import Path

import optuna
import pytest

from tests.support import few
from usvlearn.core.hyperparameters import Positive
from usvlearn.sweeps.tuning import search
from usvlearn.sweeps.tuning.batches import Evaluation, Hyperparameter

pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
COMPLETE = 1  # Optuna's number of the state
SET_STATE = 6  # Optuna's number of the operation
GAIN = Hyperparameter("gain", Positive, 1.0, 0.01, 100.0)


class StandIn:
    """An objective that takes 90 ms, notes each evaluation, and never gives the same error twice."""

    batch = 16

    def __init__(self, notes: Path):
        self.notes, self.advance = notes, lambda work: None

    def __call__(self, settings):
        evaluated = [Evaluation(setting, (random.SystemRandom().random(),)) for setting in settings]
        time.sleep(0.09)
        with self.notes.open("a") as file:
            file.write("".join(f"{each.setting['gain']!r} {each.mae!r}\n" for each in evaluated))
        return evaluated


def one_process(folder: Path, budget: int) -> None:
    evaluated, used, _ = search.search(StandIn(folder / "notes.txt"), [GAIN], budget, folder / "run", {}, batch=3)
    (folder / f"found{multiprocessing.current_process().pid}.json").write_text(json.dumps([evaluated[1:], used]))


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
    assert budget <= len(complete) <= budget + 3 * 3 and kills > 5  # by what the others had in hand
    assert set(completions(tmp_path / "run").values()) == {1}
    evaluated = {tuple(map(float, line.split())) for line in (tmp_path / "notes.txt").read_text().splitlines()}
    pairs = [(each.user_attrs["setting"]["gain"], each.value) for each in complete]
    assert set(pairs) <= evaluated and len(set(pairs)) == len(pairs)
    noted = [json.loads(path.read_text()) for path in tmp_path.glob("found*.json")]
    assert max(used for _, used in noted) == len(pairs)
    for listed, used in noted:
        assert used == len(listed) and {(setting["gain"], maes[0]) for setting, maes, _ in listed} <= set(pairs)


def test_a_line_that_a_killed_process_left_unfinished_is_removed_before_another_follows(tmp_path):
    """Also while other processes have the journal open."""
    objective = StandIn(tmp_path / "notes.txt")
    journal, evaluate, begun = tmp_path / "run" / "optuna.log", objective.__call__, []

    def tears(settings):
        with journal.open("ab") as file:
            begun.append(file.write(b'{"op_code":8,"worker_id":"'))
        return evaluate(settings)

    tears.batch, tears.advance = 16, lambda work: None
    assert search.search(tears, [GAIN], 6, tmp_path / "run", {}, batch=2).used == 6
    assert len(begun) == 3 and len(completions(tmp_path / "run")) == 6


def test_a_search_that_is_stopped_leaves_no_trial_that_counts_as_running(tmp_path):
    def stopped(settings):
        raise KeyboardInterrupt

    stopped.batch, stopped.advance = 16, lambda work: None
    with pytest.raises(KeyboardInterrupt):
        search.search(stopped, [GAIN], 6, tmp_path, {}, batch=2)
    assert [each.state.name for each in trials(tmp_path)] == ["FAIL", "FAIL"]
