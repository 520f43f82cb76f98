"""What a first use needs is compiled by a process in the background; where that fails, all is as without it."""

import os
import re
import time
from pathlib import Path

import pytest

from usvlearn.core import jit
from usvlearn.engine import background_compile

COMPILES = """
import sys, time, pathlib
folder = pathlib.Path({folder!r})
(folder / "started").touch()
while not (folder / "go").exists():
    time.sleep(0.01)
for what in ("runs", "single steps"):
    time.sleep(0.3)
    (folder / f"kernels of {{what}}, {{sys.argv[1]}}").touch()
"""


@pytest.fixture
def marks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in which nothing is compiled."""
    monkeypatch.setattr(background_compile, "mark_of", lambda source, what: tmp_path / what)
    monkeypatch.setattr(jit, "mark_of", lambda source, what: tmp_path / what)
    monkeypatch.setattr(background_compile.os, "cpu_count", lambda: 2)
    monkeypatch.setattr(background_compile, "CHILD", COMPILES.format(folder=str(tmp_path)))
    return tmp_path


def until(path: Path) -> None:
    end = time.monotonic() + 60
    while not path.exists():
        assert time.monotonic() < end, f"{path} does not come"
        time.sleep(0.01)


def test_a_run_waits_for_the_process(marks, capfd):
    with background_compile.compile_ahead("float32") as process:
        until(marks / "started")
        (marks / "go").touch()
    assert (marks / "kernels of single steps, float32").exists() and process.returncode is not None
    said = capfd.readouterr().err
    assert re.match("usvlearn: compiling the kernels of single steps, float32, only once … [0-9]+ s; kept", said), said


def test_what_is_compiled_starts_no_process(marks):
    for each in ("runs", "single steps"):
        (marks / f"kernels of {each}, float64").touch()
    with background_compile.compile_ahead() as process:
        assert process is None
    with background_compile.compile_ahead(tracks=True) as process:
        assert process
        (marks / "go").touch()
    (marks / "kernels of tracks, float64").touch()
    with background_compile.compile_ahead(tracks=True) as process:
        assert process is None


def test_a_process_that_fails_keeps_nobody_waiting(marks, monkeypatch, capfd):
    monkeypatch.setattr(background_compile, "CHILD", "raise SystemExit('no kernels today')")
    with background_compile.compile_ahead() as process:
        process.wait()
    assert not (marks / "kernels of runs, float64").exists()
    assert "no kernels today" not in capfd.readouterr().err


def test_an_error_ends_the_process(marks):
    with pytest.raises(ValueError, match="of the job"), background_compile.compile_ahead() as process:
        until(marks / "started")
        raise ValueError("of the job")
    assert process.returncode is not None


@pytest.mark.parametrize("lacks", ["processors", "interpreter", "process"])
def test_without_another_process_nothing_is_different(marks, monkeypatch, lacks):
    if lacks == "processors":
        monkeypatch.setattr(background_compile.os, "cpu_count", lambda: None)
    elif lacks == "interpreter":
        monkeypatch.setattr(background_compile.sys, "executable", "")
    else:
        monkeypatch.setattr(background_compile.sys, "executable", os.devnull)
    with background_compile.compile_ahead() as process:
        assert process is None
