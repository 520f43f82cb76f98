"""python -m certify for networks with a vector state: verdicts, certificates, and what is refused."""

import json
from fractions import Fraction

import numpy as np
import pytest

from certify.__main__ import main
from tests.support.vector_networks import network


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def save(changed=None, **options) -> None:
    """net.npz, a network of these options with some weights changed."""
    weights = {**network(np.random.default_rng(6), **options).weights._asdict(), **(changed or {})}
    np.savez("net.npz", **{key: x for key, x in weights.items() if x is not None})


def test_the_command_certifies_writes_and_verifies(tmp_path, capsys):
    save(q=3, n=8)
    np.savez("one.npz", a=[0.5, -0.2], w1=[1.0, 0.5], W2=[[0.0], [1.0]], b=[0.0, 0.1])
    assert main(["net.npz", "one.npz", "--certificate", "proofs"]) == 0
    printed = capsys.readouterr().out
    assert "1 of 1 with a vector state certified contracting" in printed and "1 of 1 certified contracting" in printed
    proofs = sorted(map(str, tmp_path.glob("proofs/*.json")))
    assert len(proofs) == 2 and main(["--verify", *proofs]) == 0
    assert main(["net.npz", "one.npz", "--verify", *proofs]) == 0
    assert main(["one.npz", "--verify", *proofs]) == 1
    capsys.readouterr()
    assert main(["net.npz", "one.npz", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row.get("states") for row in rows] == [None, 3] and rows[1]["rates"]["exact"] < 1


def test_the_command_takes_other_activations(tmp_path, capsys):
    save()
    assert main(["net.npz", "--activation", "leaky:0.2", "--certificate", "proofs"]) == 0
    proof = str(next(tmp_path.glob("proofs/*.json")))
    assert main(["--verify", proof]) == 0
    assert main(["net.npz", "--activation", "relu", "--verify", proof]) == 1
    assert "leaky:1/5" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("two", "arguments", "words"),
    [
        (False, ["--condition", "simple"], "one state"),
        (False, ["--condition", "interval"], "one state"),
        (False, ["--input", "0,0"], "one state"),
        (False, ["--condition", "box"], "one state"),
        (False, ["--box", "0:1"], "one state"),
        (False, ["--plot", "map.png"], "one state"),
        (False, ["--lmi", "--solver", "NONE"], "not installed"),
        (True, ["--condition", "gershgorin"], "is for"),
        (True, ["--condition", "lmi", "--activation", "tanh"], "is for"),
        *((False, ["--activation", wrong], "activation") for wrong in ("gelu", "leaky", "leaky:2", "leaky:-1")),
        (False, ["--activation", "leaky:" + "1" * 100], "activation"),
    ],
)
def test_options_that_do_not_fit_a_vector_state_are_refused(two, arguments, words, capsys):
    save(two=two)
    assert main(["net.npz", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error and len(error.splitlines()) == 1


@pytest.mark.parametrize(
    "changed",
    [
        {"R": np.eye(3)},
        {"A": np.ones((2, 3))},
        {"b": np.full(4, np.nan)},
        {"W": np.ones((4, 7)), "A": np.ones((7, 4)), "R": None},
        {"V": np.ones((3, 4))},
        {"c": np.ones(3)},
        {"W2": np.ones(4)},
        {"A": np.full((2, 4), 1e200)},
        {"A": None},
    ],
)
def test_damaged_weights_are_refused_in_one_sentence(changed, capsys):
    save(changed)
    assert main(["net.npz"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: net.npz") and len(error.splitlines()) == 1


def test_steps_say_nothing_about_the_step_of_the_network(tmp_path, capsys):
    """A network that does not contract at its own step may contract at smaller ones; its verdict stays the same."""
    np.savez("swings.npz", A=[[0.1]], W=[[1.0]], W2=[[0.0]], b=[0.0], R=[[-1.5]])
    assert main(["swings.npz", "--steps", "--json", "--certificate", "proofs"]) == 1
    row = json.loads(capsys.readouterr().out)[0]
    assert row["rates"]["exact"] == 1.5 and not row["certified"]["exact"] and row["rate"] is None
    assert Fraction(row["steps"]["largest"]) == Fraction(4, 5)
    assert [path.name for path in tmp_path.glob("proofs/*")] == ["swings.steps.json"]
    assert main(["--verify", "proofs/swings.steps.json"]) == 0
    capsys.readouterr()
    assert main(["swings.npz"]) == 1 and "--lmi searches for it" in capsys.readouterr().out


def test_a_certificate_of_steps_is_written_beside_the_other(tmp_path, capsys):
    np.savez("one.npz", a=[0.5, -0.2], w1=[1.0, 0.5], W2=[[0.0], [1.0]], b=[0.0, 0.1])
    assert main(["one.npz", "--json"]) == 0 and main(["one.npz", "--steps", "--json", "--certificate", "proofs"]) == 0
    plain, stepped = (json.loads(text)[0] for text in capsys.readouterr().out.replace("]\n[", "]\0[").split("\0"))
    assert plain["time_constant"] == pytest.approx(stepped["time_constant"], rel=1e-5)
    assert {path.name for path in tmp_path.glob("proofs/*")} == {"one.exact.json", "one.steps.json"}


def test_steps_too_long_to_write_are_left_out(tmp_path, capsys):
    np.savez("huge.npz", A=[[0.1]], W=[[1.0]], W2=[[0.0]], b=[0.0], R=[[-1e140]])
    assert main(["huge.npz", "--steps"]) == 1
    assert main(["huge.npz", "--dt", "1e308"]) == 2 and "--dt" in capsys.readouterr().err
