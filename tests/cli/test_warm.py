"""`usvlearn warm`: what it compiles is compiled no more, and what it is told wrongly ends in one sentence."""

import sys

import pytest

from tests.support import ROOT
from tests.support.commands import run
from usvlearn.__main__ import main


def test_a_run_after_it_compiles_nothing(tmp_path):
    kept = {"NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONPATH": str(ROOT)}
    first = run("warm", folder=tmp_path, script="usvlearn/__main__.py", **kept)
    assert first.returncode == 0 and first.stderr.count("usvlearn: compiling") == 4, first.stderr
    assert f"kept in {tmp_path / 'kept'}" in first.stdout
    second = run("data.hours=0.01", "hydra.run.dir=run", folder=tmp_path, **kept)
    assert second.returncode == 0 and "usvlearn: compiling" not in second.stderr, second.stderr


@pytest.mark.parametrize("argument, code", [("--help", 0), ("float64", 2)])
def test_other_arguments(argument, code, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["usvlearn"])
    assert main(["warm", argument]) == code
    said = capsys.readouterr()
    assert "usage: usvlearn warm [float32]" in (said.err if code else said.out)
    assert not code or said.err.startswith("error: found 'float64', expected nothing or float32")
