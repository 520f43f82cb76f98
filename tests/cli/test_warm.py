"""`usvlearn warm`: what it compiles is compiled no more, and what it is told wrongly ends in one sentence."""

import sys

import pytest

from tests.support import ROOT
from tests.support.commands import python, run
from usvlearn.__main__ import main
from usvlearn.cli import warm

NODE = """
from pathlib import Path
from usvlearn.live.session import Session
from usvlearn.live.start import Middleware, Options
names = ("command_left", "command_right", "heading", "surge")
options = Options(Path({folder!r}), mass=28.0, surge_max=2.7, record=True)
made = Middleware("test", "usvlearn.logs.formats.csv.table.Table", {{name: {{"name": name}} for name in names}})
with Session(options, made) as session:
    session.start()
    assert session.wait(60)
    steps = [each for k in range(600) for name in names for each in session.push(name, 1e9 + 0.1 * k, 0.5)]
    assert len(steps) > 100 and session.tick().contraction
"""


@pytest.mark.slow
def test_a_run_and_a_node_after_it_compile_nothing(tmp_path):
    cache = {"NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONPATH": str(ROOT)}
    first = run("warm", folder=tmp_path, script="usvlearn/__main__.py", **cache)
    assert first.returncode == 0 and first.stderr.count("usvlearn: compiling") == 9, first.stderr
    assert f"kept in {tmp_path / 'kept'}" in first.stdout
    files = sorted((tmp_path / "kept").rglob("*.nb*"))
    node = python(NODE.format(folder=str(tmp_path / "node")), **cache)
    assert node.stderr == "" and sorted((tmp_path / "kept").rglob("*.nb*")) == files
    second = run("data.hours=0.01", "hydra.run.dir=run", folder=tmp_path, **cache)
    assert second.returncode == 0 and "usvlearn: compiling" not in second.stderr, second.stderr
    assert sorted((tmp_path / "kept").rglob("*.nb*")) == files


def test_it_tells_where_the_code_is_kept(capsys, monkeypatch, tmp_path):
    calls, folders = [], [tmp_path / "kept", tmp_path / "kept", tmp_path / "temporary" / "usvlearn-0"]
    monkeypatch.setattr(warm, "warm", lambda live: calls.append(live) or folders[len(calls) - 1])
    monkeypatch.setattr(warm.tempfile, "gettempdir", lambda: str(tmp_path / "temporary"))
    monkeypatch.setattr(sys, "argv", ["usvlearn warm"])
    assert (warm.main(), warm.warm_live([])) == (0, 0) and calls == [False, True]
    assert capsys.readouterr() == (f"usvlearn: everything is compiled; it is kept in {folders[0]}\n" * 2, "")
    assert warm.main() == 0
    assert capsys.readouterr().err.startswith("warning: a restart of the computer empties this folder")


@pytest.mark.parametrize("argument, code", [("--help", 0), ("float64", 2)])
def test_it_takes_no_arguments(argument, code, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["usvlearn"])
    assert main(["warm", argument]) == code
    said = capsys.readouterr()
    assert "usage: usvlearn warm" in (said.err if code else said.out)
    assert not code or said.err.startswith("error: found 'float64', expected nothing")
