"""`python -m certify` where a package is missing that only a part of it needs: one sentence says which."""

import sys

import numpy as np
import pytest

from certify.__main__ import main

NEEDED = {
    "rich": ["net.npz"],
    "torch": ["compare"],
    "cvxpy": ["net.npz", "--lmi"],
    "matplotlib": ["net.npz", "--plot", "map.png"],
}
IMPORTING = (
    "certify.display.printed",
    "certify.command.compare",
    "certify.training.conditions",
    "certify.analysis.families",
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
