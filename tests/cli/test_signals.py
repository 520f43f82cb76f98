"""Ctrl-C and SIGTERM: the chunk is finished and saved, one line says how to go on, and so it goes on bit for bit."""

import json
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.support import ROOT, few
from tests.support.commands import ENVIRONMENT, QUICK, called, command, predictions, ran, results
from usvlearn.cli import evaluate, train
from usvlearn.cli.signals import Stopped, check_stopped, stoppable, stoppable_worker, until_stopped
from usvlearn.composition import alignment
from usvlearn.core import checkpoint
from usvlearn.runs.saved import results as finished
from usvlearn.runs.tensorboard import TensorBoardLogger
from usvlearn.sweeps.tuning.batches import Objective

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals are those of POSIX")
RUN = [*QUICK, "hydra.run.dir=run"]


def signalled(monkeypatch, owner, name: str, number: int, after: int = 0) -> None:
    """A signal arrives in a call of a function, after so many of them."""
    function, calls = getattr(owner, name), iter(range(10_000))

    def call(*arguments, **options):
        if next(calls) == after:
            signal.raise_signal(number)
        return function(*arguments, **options)

    monkeypatch.setattr(owner, name, call)


def again(error: str) -> list[str]:
    """The arguments of the command that the last line names."""
    return shlex.split(error.partition("continue with: ")[2])[2:]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A run that nothing stopped."""
    folder = tmp_path_factory.mktemp("whole")
    ran(*RUN, folder=folder)
    return folder / "run"


@pytest.mark.parametrize(
    ("number", "code", "chunks"),
    [
        pytest.param(signal.SIGINT, 130, 1, marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, 143, 3, marks=pytest.mark.thorough),
    ],
)
def test_a_replay_is_saved_and_goes_on_bit_for_bit(number, code, chunks, whole, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        signalled(patch, TensorBoardLogger, "show", number, after=chunks)
        ended, error = called(train.main, RUN, patch, capsys)
    assert ended == code and len(error.splitlines()) == 1
    assert error.startswith("stopped; continue with: ")
    partial = results(tmp_path / "run")
    assert partial.keys() == {"partial"} and finished(tmp_path / "run") == {}
    done = sum(map(len, predictions(tmp_path / "run")))
    assert partial["partial"]["steps"] == done == {1: 100, 3: 200}[chunks] < partial["partial"]["of"]
    assert partial["partial"]["boats"]["heron"]["aid"]["steps"] <= done
    for path in (tmp_path / "run" / "checkpoints").rglob("*.safetensors"):
        checkpoint.load(path)
    ended, _ = called(train.main, again(error), monkeypatch, capsys)
    assert ended == 0 and finished(tmp_path / "run")["boats"] == results(whole)["boats"]
    np.testing.assert_array_equal(*(np.concatenate(predictions(each)) for each in (tmp_path / "run", whole)))
    for path in (whole / "checkpoints").rglob("*.safetensors"):
        ours, theirs = (checkpoint.load(each)[0] for each in (tmp_path / "run" / path.relative_to(whole), path))
        assert all(np.array_equal(ours[name], theirs[name], equal_nan=True) for name in theirs), path.name


def test_before_the_replay_nothing_is_saved(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    signalled(monkeypatch, alignment, "align_fleet", signal.SIGTERM)
    code, error = called(train.main, RUN, monkeypatch, capsys)
    assert code == 143 and again(error) == RUN and len(error.splitlines()) == 1
    assert [path.name for path in (tmp_path / "run").iterdir()] == [".hydra"]


@pytest.mark.parametrize("way", few(["grid", "learn", "search"], ["grid"], "thorough"))
def test_tuning_ends_at_once_and_a_search_goes_on(way, tmp_path, monkeypatch, capsys):
    arguments = [f"{way}=aid", *QUICK, "tuning.evaluations=10", "tuning.trials=4", "hydra.run.dir=run"]
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        signalled(patch, Objective, "__call__", signal.SIGINT, after=1)
        code, error = called(train.main, arguments, patch, capsys)
    assert code == 130 and len(error.splitlines()) == 1
    absolute = f"hydra.run.dir={tmp_path}/run"  # where there is something to go on with
    assert sorted(again(error)) == sorted([*arguments[:-1], absolute if way == "search" else RUN[-1]])
    assert not (tmp_path / "run" / "tuning.json").exists()
    code, error = called(train.main, again(error), monkeypatch, capsys)
    assert code == 0, error
    assert json.loads((tmp_path / "run" / "tuning.json").read_text())["evaluations"] <= 10


@pytest.mark.thorough
def test_evaluation_ends_at_once(tmp_path, whole, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    signalled(monkeypatch, evaluate, "align_fleet", signal.SIGINT)
    code, error = called(evaluate.main, [f"runs={whole}", "report=report"], monkeypatch, capsys)
    assert code == 130 and again(error) == [f"runs={whole}", "report=report"] and not list(tmp_path.rglob("*.html"))


@pytest.mark.thorough
def test_a_sweep_shows_what_is_finished_and_goes_on(tmp_path, monkeypatch, capsys):
    arguments = ["-m", "estimators.sift_map.memory=5,9", *QUICK, "hydra.sweep.dir=sweep"]
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        signalled(patch, TensorBoardLogger, "finish", signal.SIGINT, after=1)
        code, error = called(train.main, arguments, patch, capsys)
    assert code == 130 and again(error) == arguments and len(error.splitlines()) == 1
    assert (tmp_path / "sweep" / "leaderboard.csv").exists()
    stamp = (tmp_path / "sweep" / "0" / "results.json").stat().st_mtime_ns
    code, error = called(train.main, again(error), monkeypatch, capsys)
    assert code == 0, error
    assert (tmp_path / "sweep" / "0" / "results.json").stat().st_mtime_ns == stamp and finished(
        tmp_path / "sweep" / "1"
    )


def test_a_signal_waits_for_the_chunk_and_not_for_the_first():
    saved, seen = [], []
    with pytest.raises(Stopped) as caught, stoppable():
        for chunk in until_stopped(iter(range(9)), lambda: saved.append(True)):
            seen.append(chunk)
            if chunk == 3:
                signal.raise_signal(signal.SIGTERM)
                seen.append("and used")
    assert seen == [0, 1, 2, 3, "and used"] and saved == [True] and caught.value.code == 143

    def compiling():
        signal.raise_signal(signal.SIGINT)
        yield 0

    with pytest.raises(Stopped) as caught, stoppable():
        list(until_stopped(compiling(), lambda: saved.append(True)))
    assert saved == [True] and caught.value.code == 130
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_signal_while_llvm_calls_python_is_handled_a_moment_later():
    """An error would be lost there, as in any callback from C."""
    reached = []

    def _raw_object_cache_notify():
        signal.raise_signal(signal.SIGINT)
        reached.append(True)

    with pytest.raises(Stopped) as caught, stoppable():
        _raw_object_cache_notify()
        for _ in range(500):
            time.sleep(0.01)
    assert reached and caught.value.code == 130


def script(body: str) -> subprocess.CompletedProcess:
    code = f"import os, signal, time\nfrom usvlearn.cli.signals import *\n{body}"
    environment = {**ENVIRONMENT, "PYTHONPATH": str(ROOT)}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)


def test_a_second_signal_ends_at_once():
    done = script(
        "with stoppable():\n"
        "    for _ in until_stopped(range(9), lambda: time.sleep(60)):\n"
        "        signal.raise_signal(signal.SIGINT)\n"
        "        signal.raise_signal(signal.SIGTERM)\n"
    )
    assert done.returncode == 143 and done.stderr == ""


def test_a_worker_heeds_its_program_alone_and_stays_alive():
    done = script(
        "for k in range(3):\n"
        "    try:\n"
        "        with stoppable_worker():\n"
        "            signal.raise_signal(signal.SIGINT)\n"
        "            if k: signal.raise_signal(signal.SIGTERM)\n"
        "            print(k)\n"
        "    except Stopped as stopped:\n"
        "        print(stopped)\n"
        "    if k: signal.raise_signal(signal.SIGTERM)\n"
    )
    assert done.returncode == 0 and done.stdout.split("\n") == ["0", "stopped", "stopped", ""]


@pytest.mark.parametrize(
    ("number", "block"),
    [(signal.SIGTERM, stoppable), (signal.SIGTERM, stoppable_worker), (signal.SIGINT, stoppable)],
)
def test_handlers_of_others_are_left_alone(number, block):
    """A background job of a shell script, for example, ignores SIGINT, and goes on to do so."""
    before = signal.signal(number, signal.SIG_IGN)
    try:
        with block():
            signal.raise_signal(number)
            check_stopped()
        assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        signal.signal(number, before)


@pytest.mark.skipif(not hasattr(signal, "SIGUSR2"), reason="this system has no SIGUSR2")
def test_the_command_that_queues_a_job_again_outlives_the_signal_to_all_its_processes():
    ended = [sys.executable, "-c", "import os, signal; os.kill(os.getpid(), signal.SIGTERM)"]

    def queue_again(number, frame):  # what submitit does at a time limit
        subprocess.check_call(ended)
        sys.exit(3)

    before = {number: signal.getsignal(number) for number in (signal.SIGUSR2, signal.SIGTERM, signal.SIGINT)}
    signal.signal(signal.SIGUSR2, queue_again)
    try:
        with pytest.raises(SystemExit), stoppable_worker():
            signal.raise_signal(signal.SIGUSR2)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


JOBLIB = ["-m", "estimators.sift_map.memory=5,9", *QUICK, "data.hours=40", "hydra.sweep.dir=sweep"]
JOBLIB += ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]


@pytest.mark.slow
def test_workers_of_a_sweep_that_is_stopped_finish_their_chunks(tmp_path):
    """The same command goes on. `tests/sweeps/test_launchers.py` kills a worker."""
    pytest.importorskip("joblib")
    environment = {**ENVIRONMENT, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(command(*JOBLIB), cwd=tmp_path, env=environment, text=True,
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE)  # fmt: skip
    while len({path.parts[-3] for path in tmp_path.glob("sweep/*/predictions/*.npz")}) < 2:
        assert process.poll() is None
        time.sleep(0.05)
    process.terminate()
    _, error = process.communicate(timeout=300)
    assert process.returncode == 143 and "Traceback" not in error
    last = error.strip().splitlines()[-1]
    assert last.startswith("stopped")
    assert sorted(again(last)) == sorted(JOBLIB) and (tmp_path / "sweep" / "leaderboard.csv").exists()
    assert all("partial" in results(tmp_path / "sweep" / job) for job in "01")
