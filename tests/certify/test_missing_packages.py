"""Packages that only a part of certify needs: imported there alone, and one sentence says which is missing."""

import subprocess
import sys

import numpy as np
import pytest

from certify.__main__ import main

NEEDED = {
    "rich": ["net.npz"],
    "scipy": ["compare", "net.npz"],
    "cvxpy": ["net.npz", "--lmi", "--solver", "SCS"],
    "clarabel": ["net.npz", "--lmi"],
    "matplotlib": ["net.npz", "--plot", "map.png"],
}
IMPORTING = (
    "certify.display.tables",
    "certify.command.compare",
    "certify.training.conditions",
    "certify.training.projections",
)


@pytest.mark.parametrize("package", NEEDED)
def test_certify_names_the_package_that_is_missing(package, tmp_path, monkeypatch, capsys):
    np.savez(tmp_path / "net.npz", a=[0.5, 0.2], w1=[1.0, -1.0], W2=[[0.1], [0.2]], b=[0.0, 0.1])
    monkeypatch.chdir(tmp_path)
    loaded = [name for name in sys.modules if name.startswith((f"{package}.", *IMPORTING))]
    for name in loaded:  # what was imported before must not help
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    assert main(NEEDED[package]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and package in error and "pip install" in error
    assert len(error.splitlines()) == 1


def test_no_search_and_no_proof_imports_a_solver_with_its_module():
    names = "search.box search.recurrent search.vector_lmi search.vector_scaling proofs.steps"
    modules = ", ".join(f"certify.{name}" for name in names.split())
    later = {"scipy", "torch", "cvxpy", "clarabel", "usvlearn"}
    code = f"import sys, {modules}; print({later} & {{*sys.modules}})"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"
