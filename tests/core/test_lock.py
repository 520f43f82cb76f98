"""One process at a time writes to a folder; a process that was killed holds nothing."""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from tests.support.commands import ENVIRONMENT, SMALL, ran, sentence
from tests.support.configured import TWO_BOATS
from tests.support.runs import tools
from tests.support.studies import Recorder, made
from usvlearn.cli import train
from usvlearn.core.lock import NAME, Lock
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.report.build import evaluate
from usvlearn.sweeps.jobs import run_job

HOLD = "import sys, time; from pathlib import Path; from usvlearn.core.lock import Lock\n"
HOLD += "lock = Lock(Path(sys.argv[1]), 'x', shared=len(sys.argv) > 2); print('held', flush=True); time.sleep(60)"


def holder(folder: Path, *shared: str) -> subprocess.Popen:
    """Another process that holds the lock of a folder."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder), *shared], stdout=subprocess.PIPE, text=True, env=ENVIRONMENT
    )
    assert process.stdout.readline() == "held\n"
    return process


def ended(process: subprocess.Popen) -> None:
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_lock_is_refused_until_its_process_ends(tmp_path):
    process = holder(tmp_path / "run")
    for shared in (False, True):
        with pytest.raises(
            ConfigError, match=rf"run: process {process.pid} is writing there: .* another hydra\.run\.dir"
        ):
            Lock(tmp_path / "run", "hydra.run.dir", shared)
    ended(process)  # no chance to clean up
    assert (tmp_path / "run" / NAME).exists()
    with Lock(tmp_path / "run", "hydra.run.dir"):
        assert (tmp_path / "run" / NAME).read_text() == str(os.getpid())
    assert list((tmp_path / "run").iterdir()) == []


@pytest.mark.parametrize("what", ["link", "dangling link", "folder", "pipe"])
def test_a_lock_that_is_no_file_is_refused_and_no_link_is_followed(tmp_path, what):
    path, other = tmp_path / "run" / NAME, tmp_path / "other"
    path.parent.mkdir()
    if what == "link":
        other.write_text("kept")
    match what:
        case "folder":
            path.mkdir()
        case "pipe":
            os.mkfifo(path)
        case _:
            path.symlink_to(other)
    with pytest.raises(ConfigError, match=r"run/\.lock: found a link, a folder or the like"):
        Lock(path.parent, "report")
    assert other.read_text() == "kept" if what == "link" else not other.exists()


def test_a_lock_is_waited_for_until_its_process_is_killed(tmp_path):
    process = holder(tmp_path)
    began = time.monotonic()
    threading.Timer(0.3, process.kill).start()
    Lock(tmp_path, "x", wait=True).release()
    assert time.monotonic() - began > 0.2
    ended(process)


def test_a_shared_lock_is_held_by_several(tmp_path):
    process = holder(tmp_path, "shared")
    with Lock(tmp_path, "x", shared=True), Lock(tmp_path, "x", shared=True):
        with pytest.raises(ConfigError, match="is writing there"):
            Lock(tmp_path, "x")
    assert (tmp_path / NAME).exists()  # the other still holds it
    ended(process)
    with Lock(tmp_path, "x", shared=True):
        pass
    assert list(tmp_path.iterdir()) == []


def test_one_of_many_processes_gets_the_lock(tmp_path):
    """Each takes and releases it many times; no two have it at once, though its file comes and goes."""
    code = (
        "import os, sys; from pathlib import Path; from usvlearn.errors import ConfigError\n"
        "from usvlearn.core.lock import Lock\n"
        "folder, got = Path(sys.argv[1]), 0\n"
        "while got < 50:\n"
        "    try:\n"
        "        with Lock(folder, 'x'):\n"
        "            os.close(os.open(folder / 'mine', os.O_CREAT | os.O_EXCL)); got += 1; os.unlink(folder / 'mine')\n"
        "    except ConfigError:\n"
        "        pass\n"
    )
    processes = [subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], env=ENVIRONMENT) for _ in range(4)]
    assert [process.wait(timeout=60) for process in processes] == [0] * 4
    assert list(tmp_path.iterdir()) == []


def test_a_fork_does_not_give_the_lock_of_its_parent_back(tmp_path):
    lock = Lock(tmp_path, "x")
    if (child := os.fork()) == 0:
        lock.release()
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
    with pytest.raises(ConfigError):
        Lock(tmp_path, "x")
    lock.release()
    lock.release()
    assert list(tmp_path.iterdir()) == []


def test_a_file_system_without_locks_is_told(tmp_path, monkeypatch):
    def refuses(file, how):
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr("usvlearn.core.lock.fcntl.flock", refuses)
    with pytest.warns(UserWarning, match=r"cannot be locked \(Function not implemented\)"), Lock(tmp_path, "x"):
        pass


@pytest.mark.thorough
@pytest.mark.parametrize("more", [[], ["grid=aid"], ["search=aid"]], ids=["run", "tuned", "searched"])
def test_a_second_run_in_one_folder_is_refused(more, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    first = holder(tmp_path / "run")
    error = sentence(train.main, [*SMALL, *more, "hydra.run.dir=run"], monkeypatch, capsys)
    assert error.startswith(f"error: run: process {first.pid} is writing there: ")
    assert [path.name for path in (tmp_path / "run").iterdir()] == [NAME]
    ended(first)


def test_a_report_a_study_and_a_job_of_a_sweep_are_locked(tmp_path, capsys):
    report, study, job = (holder(tmp_path / name) for name in ("report", "study", "job"))
    with pytest.raises(ConfigError, match=rf"report: process {report.pid} is writing there: .*another report$"):
        evaluate([tmp_path], tmp_path / "report", tools())
    with pytest.raises(ConfigError, match=rf"study: process {study.pid} is writing there: .*another folder$"):
        made(tmp_path / "study", Recorder())
    objective = run_job(tmp_path / "job", {"a": 1}, [], lambda resume: 1.0)
    assert objective != objective and f"process {job.pid} is writing there" in capsys.readouterr().err
    for each, folder in ((report, "report"), (study, "study"), (job, "job")):
        assert [path.name for path in (tmp_path / folder).iterdir()] == [NAME]
        ended(each)
    with pytest.raises(CheckpointError, match="has no checkpoints"):
        evaluate([tmp_path], tmp_path / "report", tools())
    made(tmp_path / "study", Recorder())
    assert run_job(tmp_path / "job", {"a": 1}, [], lambda resume: 1.0) == 1.0
    assert not list(tmp_path.rglob(NAME))


@pytest.mark.thorough
def test_processes_that_search_together_share_the_folder(tmp_path):
    pytest.importorskip("optuna", reason="needs the package optuna")
    process = holder(tmp_path / "run", "shared")
    ran(*TWO_BOATS, "search=aid", "tuning.evaluations=2", "hydra.run.dir=run", folder=tmp_path)
    ended(process)
