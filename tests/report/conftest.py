"""A run that all tests of reports look at."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.support import made_once
from tests.support.commands import run
from usvlearn.report.page import _drawing


@pytest.fixture(autouse=True)
def one_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page that a test makes times each step in one pass, which is a second less."""
    monkeypatch.setattr("usvlearn.report.sections.parameters.PASSES", 1)


@pytest.fixture
def drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A page whose figures are all its first one, for tests of its words: drawing is most of a report's time."""
    made: list[tuple[str, bytes]] = []

    def first(name: str, figure: Any) -> tuple[str, bytes]:
        if not made:
            made.append(_drawing(name, figure))
        return made[0]

    monkeypatch.setattr("usvlearn.report.page._drawing", first)


@pytest.fixture(scope="session")
def saved(tmp_path_factory, finished) -> Path:
    """A finished run and its report; nobody changes it."""

    def make(folder: Path) -> None:
        shutil.copytree(finished, folder / "run")
        done = run(f"runs={folder}/run", folder=folder, script="evaluate.py")
        assert done.returncode == 0, done.stderr
        assert f"{folder}/run/report/index.html" in done.stdout.replace("\n", "")

    return made_once(tmp_path_factory, "saved", make) / "run"
