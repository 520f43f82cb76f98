"""A run that all tests of reports look at."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support import made_once
from tests.support.commands import ran


@pytest.fixture(scope="package", autouse=True)
def one_pass() -> Iterator[None]:
    """A page that a test makes times each step in one pass, which is a second less."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("usvlearn.report.sections.parameters.PASSES", 1)
        yield


@pytest.fixture(scope="session")
def saved(tmp_path_factory, finished) -> Path:
    """A finished run and its report; nobody changes it."""

    def make(folder: Path) -> None:
        shutil.copytree(finished, folder / "run")
        done = ran(f"runs={folder}/run", folder=folder, script="evaluate.py")
        assert f"{folder}/run/report/index.html" in done.stdout.replace("\n", "")

    return made_once(tmp_path_factory, "saved", make) / "run"
