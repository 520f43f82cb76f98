"""Runs from which the tests start."""

from pathlib import Path

import pytest

from tests.support.commands import ran
from tests.support.recordings import recording
from tests.support.runs import TWO_MEMBERS
from usvlearn.logs.recordings import align_fleet


@pytest.fixture(scope="module")
def fleet():
    """Boat a has two runs, boat b one longer one."""
    return align_fleet([recording("a", "one", 6.0), recording("a", "two", 4.0), recording("b", "one", 9.0, speed=0.3)])


@pytest.fixture(scope="module")
def saved(tmp_path_factory) -> Path:
    """A finished run of one boat through three members."""
    folder = tmp_path_factory.mktemp("trust")
    ran(*TWO_MEMBERS, f"hydra.run.dir={folder}/run", folder=folder)
    return folder / "run"
