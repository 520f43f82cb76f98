"""Sweeps on a real Slurm of this machine: arrays, resources, killed jobs, time limits, and jobs that are queued again.

These tests run with `-m slurm` where Slurm is installed; `.ci/slurm` does so.
"""

import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import pytest

from tests.support.commands import ENVIRONMENT, QUICK, assert_equal_runs, command, ran, table
from tests.support.slurm import Slurm, Unavailable

pytestmark = pytest.mark.slurm
pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
THREE = ["-m", "estimators.sift_map.memory=5,9,20", *QUICK, "data.hours=20", "save_minutes=2", "hydra.sweep.dir=sweep"]
ONE = ["-m", "estimators.sift_map.memory=5", *QUICK, "data.hours=70", "save_minutes=1", "hydra.sweep.dir=sweep"]
ON_SLURM = ["hydra/launcher=slurm", "hydra.launcher.mem_gb=1", "hydra.launcher.partition=night"]


@pytest.fixture(scope="module")
def slurm() -> Iterator[Slurm]:
    """A running cluster; its folder has a short name, because a socket's path is short."""
    with tempfile.TemporaryDirectory(prefix="slurm") as folder:
        cluster = Slurm(Path(folder))
        try:
            cluster.start()
            yield cluster
        except Unavailable as reason:
            (pytest.fail if os.environ.get("USVLEARN_SLURM") else pytest.skip)(str(reason))
        finally:
            cluster.stop()


@pytest.fixture(scope="module")
def expected(tmp_path_factory) -> Path:
    """The same sweep, uninterrupted, in one process."""
    folder = tmp_path_factory.mktemp("expected")
    ran(*THREE, folder=folder)
    return folder / "sweep"


@pytest.fixture(autouse=True)
def nothing_left(slurm) -> Iterator[None]:
    """No job or command of a test that failed disturbs the next."""
    yield
    for process in Sweeping.started:
        process.kill()
        process.wait()
        if process.stderr is not None:
            process.stderr.close()
    Sweeping.started.clear()
    slurm.end_jobs()


class Sweeping:
    """A sweep on the cluster, started as a user starts it."""

    started: ClassVar[list[subprocess.Popen]] = []

    def __init__(self, slurm: Slurm, folder: Path, *arguments: str, sweep: list[str] = THREE):
        self.slurm, self.sweep = slurm, folder / "sweep"
        self.process = subprocess.Popen(command(*sweep, *ON_SLURM, *arguments), cwd=folder, text=True,
                                        env=ENVIRONMENT | slurm.environment,
                                        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)  # fmt: skip

        self.started.append(self.process)

    def queued(self) -> list[str]:
        """The numbers of its jobs in Slurm, once they are there."""
        self.slurm.wait(self.slurm.jobs, "no job was queued")
        return sorted(self.slurm.jobs())

    def saves(self, job: int, sets: int) -> tuple[Path, int]:
        """Wait until an unfinished job has saved so many checkpoints; returns the first, and when it was written."""
        folder = self.sweep / str(job) / "checkpoints" / "heron"
        self.slurm.wait(lambda: len(list(folder.glob("*.safetensors"))) >= sets, "nothing was saved", 200)
        assert not (self.sweep / str(job) / "results.json").exists()
        first = min(folder.glob("*.safetensors"))
        return first, first.stat().st_mtime_ns

    def pid(self, job: int) -> int:
        return int((self.sweep / str(job) / ".lock").read_text())

    def ends(self, code: int) -> str:
        """What it has said on stderr when it ends, with this exit code."""
        _, error = self.process.communicate(timeout=300)
        assert self.process.returncode == code and "Traceback" not in error, error
        return error


def assert_complete(sweep: Path, expected: Path) -> None:
    """The jobs and the leaderboard are those of the sweep that was not interrupted."""
    ours, theirs = ([(row["job"], row["error"], row["objective"]) for row in table(each)] for each in (sweep, expected))
    assert ours == theirs
    for job, *_ in ours:
        assert_equal_runs(sweep / job, expected / job)


def test_a_sweep_is_one_array_with_the_resources_that_were_asked_for(slurm, expected, tmp_path):
    resources = ["hydra.launcher.timeout_min=7", "hydra.launcher.array_parallelism=1", "hydra.launcher.name=boats",
                 "+hydra.launcher.additional_parameters.nice=5"]  # fmt: skip
    sweep = Sweeping(slurm, tmp_path, *resources)
    numbers = sweep.queued()
    facts = [slurm.job(number) for number in numbers]
    assert [number.partition("_")[2] for number in numbers] == ["0", "1", "2"]
    assert len({each["ArrayJobId"] for each in facts}) == 1
    for each in facts:
        assert (each["Partition"], each["TimeLimit"], each["Nice"]) == ("night", "00:07:00", "5")
        assert (each["NumCPUs"], each["CPUs/Task"], each["MinMemoryNode"]) == ("1", "1", "1G")
        assert (each["JobName"], each["ArrayTaskThrottle"], each["Requeue"]) == ("boats", "1", "1")
    error = sweep.ends(0)
    assert "sacct" not in error, error
    assert_complete(sweep.sweep, expected)
    for job in "012":
        assert list(sweep.sweep.glob(f".submitit/*_{job}/*_log.err"))


def test_a_killed_job_is_named_and_the_same_command_continues_it(slurm, expected, tmp_path):
    sweep = Sweeping(slurm, tmp_path)
    first, written = sweep.saves(0, 3)
    os.kill(sweep.pid(0), signal.SIGKILL)
    error = sweep.ends(2)
    assert "error: job 0:" in error and "jobs [0] were killed; continue with: python" in error, error
    assert [row["job"] for row in table(sweep.sweep) if row["error"] == "did not finish"] == ["0"]
    stamps = {job: (sweep.sweep / job / "results.json").stat().st_mtime_ns for job in "12"}  # they were waited for
    again = Sweeping(slurm, tmp_path)
    again.ends(0)
    assert first.stat().st_mtime_ns == written  # what was saved is not made again
    assert stamps == {job: (sweep.sweep / job / "results.json").stat().st_mtime_ns for job in stamps}
    assert_complete(sweep.sweep, expected)


def test_a_job_that_reaches_its_time_limit_is_queued_again_and_finishes(slurm, tmp_path):
    """Slurm sends the signal of the limit, 20 to 50 s before one minute is over, to a job that takes about a minute."""
    (whole := tmp_path / "whole").mkdir()
    uninterrupted = subprocess.Popen(command(*ONE), cwd=whole, env=ENVIRONMENT, stdout=subprocess.DEVNULL)
    Sweeping.started.append(uninterrupted)
    sweep = Sweeping(slurm, tmp_path, "hydra.launcher.timeout_min=1", "hydra.launcher.signal_delay_s=20", sweep=ONE)
    (number,) = sweep.queued()
    first, written = sweep.saves(0, 3)
    sweep.ends(0)
    facts = slurm.job(number)
    assert int(facts["Restarts"]) >= 1 and facts["TimeLimit"] == "00:01:00" and facts["JobState"] == "COMPLETED"
    assert first.stat().st_mtime_ns == written
    assert uninterrupted.wait(120) == 0
    assert_complete(sweep.sweep, whole / "sweep")


def test_a_job_that_slurm_queues_again_continues(slurm, expected, tmp_path):
    sweep = Sweeping(slurm, tmp_path)
    number = sweep.queued()[0]
    first, written = sweep.saves(0, 3)
    slurm.call("scontrol", "requeue", number)
    sweep.ends(0)
    assert int(slurm.job(number)["Restarts"]) == 1 and first.stat().st_mtime_ns == written
    assert_complete(sweep.sweep, expected)


def test_a_command_that_is_stopped_leaves_its_jobs_and_says_so(slurm, tmp_path):
    sweep = Sweeping(slurm, tmp_path, "hydra.launcher.name=boats", sweep=ONE)
    numbers = sweep.queued()
    time.sleep(1)  # the command waits for its jobs
    sweep.process.send_signal(signal.SIGINT)
    error = sweep.ends(130)
    assert "scancel --name=boats ends; continue with: python" in error and slurm.jobs() == numbers
