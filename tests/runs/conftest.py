"""Runs from which the tests start."""

from pathlib import Path

import pytest

from tests.support.commands import run
from tests.support.recordings import recording
from usvlearn.logs.recordings import align_fleet

SMALL = [
    "~estimators.rnn", "~estimators.joint", "~estimators.joint_quick", "~estimators.arx", "~estimators.reader",
    "~combiners.ensemble", "~combiners.weighted", "output=average", "combiners.average.members=[aid,sift_map]",
    "forecasts=null", "data.hours=0.05", "data.mission_minutes=1.5", "data.n=1",
]  # fmt: skip


@pytest.fixture(scope="module")
def fleet():
    """Boat a has two runs, boat b one longer one."""
    return align_fleet([recording("a", "one", 6.0), recording("a", "two", 4.0), recording("b", "one", 9.0, speed=0.3)])


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    """A finished run of one boat through three members."""
    folder = tmp_path_factory.mktemp("trust")
    done = run(*SMALL, f"hydra.run.dir={folder}/run", folder=folder)
    assert done.returncode == 0, done.stderr
    return folder / "run"
