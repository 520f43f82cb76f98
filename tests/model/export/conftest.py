"""A small run of two boats, from which everything is exported."""

import shutil
import sys
import warnings

import pytest

from usvlearn.__main__ import main
from usvlearn.model.read_boats import read_boats


@pytest.fixture(scope="session")
def run(tmp_path_factory, finished):
    """The folder of a run in which a joint EKF reads, and a network learns."""
    return shutil.copytree(finished, tmp_path_factory.mktemp("exported") / "run")


@pytest.fixture(scope="session")
def boat(run):
    return read_boats(run)[0]


@pytest.fixture(autouse=True)
def arguments_of_the_program(monkeypatch):
    """Those of the tests again afterwards: the command sets its own."""
    monkeypatch.setattr(sys, "argv", ["usvlearn"])


@pytest.fixture
def told(capsys):
    """Calls the command; returns the one sentence of its error."""

    def call(*arguments) -> str:
        with pytest.raises(SystemExit) as ended, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            main(["export", *map(str, arguments)])
        assert ended.value.code == 2
        error = capsys.readouterr().err
        *others, said = error.splitlines()
        assert said.startswith("error: ") and all("compiling" in each for each in others), error
        return said

    return call
