"""The comparison: what its families are, what it counts, and that its tables and picture say it."""

import json

import numpy as np
import pytest

from certify import exact
from certify.__main__ import main
from certify.assess import solver
from certify.compare import examine, paper_tests, summarise, truncated_equilibria
from certify.equilibria import equilibria
from certify.families import initial_networks, random_networks, trained_networks
from certify.weights import ShallowWeights


def test_families_are_what_they_are_called():
    rng = np.random.default_rng(0)
    K = [float(exact.conditions(w.a, w.w1)["tight"].rate) for w in random_networks(40, 8, rng)]
    assert 0.03 <= min(K) < 0.1 and 1 < max(K) <= 3
    assert all(np.abs(w.a).max() <= 8**-0.5 and np.abs(w.W2).max() <= 5**-0.5 for w in initial_networks(5, 8, rng))
    slopes = []
    for weights in trained_networks(3, 20, rng, dt=0.4, steps=800):  # it learned a hull: a slope just below 1
        x, u = np.array([0.1, 0.3]), np.array([0.5, 1.0, 0.6, 0.6])
        y = np.maximum(weights.w1 * x[:, None] + weights.W2 @ u + weights.b, 0) @ weights.a
        slopes.append((y[1] - y[0]) / 0.2)
        v = 2 * 2.0 * 0.3
        expected = v + 0.4 * (-0.125 * v * v - 0.05 * v + 2 * (0.25 * (0.6 + 0.36) - 0.1 * 0.6 * v))
        assert y[1] == pytest.approx(expected / 4, abs=0.03)
    assert 0.7 < np.mean(slopes) < 1.0


def test_summary_counts_what_was_examined():
    rng = np.random.default_rng(1)
    networks = random_networks(12, 4, rng)
    rows = [examine(w, solver(), 2.0) for w in networks]
    told = summarise(rows)
    shares = [told[tier]["share"] for tier in ("simple", "gershgorin", "lmi", "tight", "interval", "box")]
    assert shares == sorted(shares) and shares[3] == np.mean([row["K"] < 1 for row in rows])
    assert told["box"]["conservatism"] == pytest.approx(1)
    assert told["lmi"]["conservatism"] >= 2 - 1e-9 and told["tight"]["conservatism"] >= 1 - 1e-9
    assert told["lmi"]["disagreements"] == told["tight"]["disagreements"] == 0
    assert all(row["K_box"][0] <= row["K"] + 1e-12 for row in rows)
    for row in rows:
        assert row["closed"] and row["K_box"][1] - row["K_box"][0] <= 1e-5 * row["K_box"][1]
    assert not examine(random_networks(1, 40, rng)[0], None, 1e-6)["closed"]  # too little time
    rows[0]["solved"]["tight"]["verdict"] = "unknown" if rows[0]["certified"]["tight"] else "certified"
    assert summarise(rows)["tight"]["disagreements"] == 1


def test_the_papers_tests_literally_and_mended():
    class Choices:
        corner, order, knots, solver = "both", "both", "both", "CLARABEL"

    networks = [w for w in random_networks(60, 6, np.random.default_rng(2)) if np.abs(w.a * w.w1).sum() > 0]
    rows = {row["test"]: row for row in paper_tests(networks, Choices)}
    assert rows["M ⪰ 0, 2Λ"]["identity"] and not rows["M ≻ 0, 2Λ"]["identity"]
    assert not rows["M ⪰ 0, Λ"]["identity"] and not rows["M ≻ 0, Λ"]["identity"]
    assert rows["M ≻ 0, Λ"]["beyond"][0] == rows["M ≻ 0, 2Λ"]["beyond"][0] == 0
    assert rows["M ⪰ 0, 2Λ"]["beyond"][0] > 0  # the solver's word, where no such network contracts
    assert rows["M ⪰ 0, 2Λ"]["contracting"] == 0 < rows["M ⪰ 0, Λ"]["contracting"]
    assert all(rows[key]["inside"][0] == rows[key]["inside"][1] for key in rows if key.startswith("M"))
    assert (
        rows["equilibria at u = 0, all knots"]["wrong"][0] == 0 < rows["equilibria at u = 0, knots i < n"]["wrong"][0]
    )
    Choices.corner, Choices.order, Choices.knots = "lambda", "strict", "all"
    assert [row["test"] for row in paper_tests(networks[:3], Choices)] == ["M ≻ 0, Λ", "equilibria at u = 0, all knots"]


def test_truncated_equilibria_are_right_where_the_last_neuron_has_no_knot():
    weights = ShallowWeights([1.5, 0.1], [1.0, 0.0], np.zeros((2, 1)), [-0.25, 1.0])
    weights = ShallowWeights(*map(np.asarray, weights))
    found = [each.x for each in equilibria(weights, [0.0])]
    assert truncated_equilibria(weights) == pytest.approx(found)
    turned = ShallowWeights(*(x[::-1] for x in weights))  # the same map, its only knot last
    assert len(truncated_equilibria(turned)) != len(found)


def test_the_command(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    np.savez(tmp_path / "own.npz", a=[0.9], w1=[1.0], W2=np.zeros((1, 4)), b=[0.5])
    options = ["--networks", "3", "--neurons", "4", "--sizes", "4,6", "--seconds", "0.5"]
    assert main(["compare", str(tmp_path / "own.npz"), *options, "--plot", str(tmp_path / "c.png")]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 160
    for part in ("random: 3 networks", "given: 1 networks", "LMI again", "M ⪰ 0, 2Λ", "simple", "box"):
        assert part in text
    assert (tmp_path / "c.png").stat().st_size > 10_000
    assert main(["compare", *options, "--no-lmi", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result["families"]) == {"random", "initialised", "trained, dt 0.4 s"} and result["paper"] == []
    assert [row["n"] for row in result["timings"]] == [4, 6] and result["timings"][0]["lmi_again"] is None
