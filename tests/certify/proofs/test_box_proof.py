"""Proofs on a box: they are exact, tampered ones are refused, hostile ones answered soon, and no solver is needed."""

import time

import numpy as np
import pytest

from certify.networks.shallow import ShallowWeights
from certify.proofs.box_planes import Box
from certify.proofs.box_proof import proves, proves_range
from certify.search.box import certify, operating_box, rate
from tests.support.networks import network, star


def test_a_proof_about_a_common_point_is_exact_and_a_tampered_one_is_refused():
    weights, over = star()
    found = certify(weights, over, rate=0.9)
    assert found.verdict == "certified" and " e" in found.tree and proves(weights, over, found.tree, 0.9)
    assert found.lower == pytest.approx(0.8) and rate(weights, over).upper == pytest.approx(0.8)
    tokens = found.tree.split()
    assert not proves(weights, over, found.tree, 0.8)
    for k, token in enumerate(tokens):
        without = tokens[:k] + tokens[k + 1 :]
        assert not proves(weights, over, " ".join(without), 0.9)
        if token[0] == "e":
            for other in (".", "e", "e0:0", token.replace(":", ":-"), token.split(",")[0], "e9:1", "x . .", "z0 . ."):
                assert not proves(weights, over, " ".join([*tokens[:k], other, *tokens[k + 1 :]]), 0.9)
    for tree in ("", ". .", "u2 . .", "u0 . .", "y . .", "z7 . .", found.tree + " .", None):
        assert not proves(weights, over, tree, 0.9)
    assert not proves(weights._replace(b=weights.b + 1e-12), over, found.tree, 0.9)  # a cell opens around the point
    assert not proves(weights._replace(a=1.2 * weights.a), over, found.tree, 0.9)


def test_a_tree_of_halves_is_refused_for_other_weights_or_another_rate():
    weights, over = network(20, 4, 0), operating_box(4)
    found = certify(weights, over, rate=0.1795)
    tokens = found.tree.split()
    assert found.verdict == "certified" and len(tokens) > 100
    assert not proves(weights, over, found.tree, 0.17)
    assert not proves(weights._replace(a=1.01 * weights.a), over, found.tree, 0.1795)
    cuts = [k for k in range(len(tokens) - 2) if tokens[k][0] in "xu" and tokens[k + 1] == tokens[k + 2] == "."]
    assert cuts and not any(proves(weights, over, " ".join(tokens[:k] + tokens[k + 2 :]), 0.1795) for k in cuts[:20])


@pytest.mark.thorough
def test_no_tree_proves_what_is_false():
    """Trees at random, from the right tokens and others, at a rate just below the truth, and real ones changed."""
    weights, over = star()
    rng, accepted = np.random.default_rng(0), 0
    real = certify(weights, over, rate=0.9).tree.split()
    leaves = [token for token in real if token[0] == "e"] + [".", "e0:1,1:1,2:2", "e0:1,1:1,2:1", "e0:-1,1:-1,2:-2"]

    def grown(depth):
        if depth == 0 or rng.random() < 0.3:
            return [str(rng.choice(leaves))]
        return [str(rng.choice(["x", "u1", "z0", "z1", "z2"])), *grown(depth - 1), *grown(depth - 1)]

    for _ in range(500):
        changed = list(real)
        changed[rng.integers(len(real))] = str(rng.choice([*leaves, "x", "u1", "z0", "z1", "z2"]))
        for tree in (" ".join(grown(6)), " ".join(changed)):
            assert not proves(weights, over, tree, 0.7999)
            accepted += proves(weights, over, tree, 0.81)
    assert accepted


def test_hostile_trees_are_answered_soon(part):
    """A megabyte of text: chains, full trees, long numbers, and neurons that stay open in every box."""
    n, many, over = 200, 250_000 // part, operating_box(4)
    rng = np.random.default_rng(0)
    wide = ShallowWeights(*rng.normal(size=(2, n)) / 30, rng.normal(size=(n, 4)), rng.normal(size=n) / 10)
    steep = np.linspace(0.499, 0.501, n)  # z_i = x − steep_i: no halving of an input decides it
    still = ShallowWeights(np.full(n, 0.5 / n), np.ones(n), np.zeros((n, 4)), -steep)

    def full(depth: int) -> str:
        tree = "."
        for k in range(depth):
            tree = f"u{k % 4 + 1} {tree} {tree}"
        return tree

    trees = {
        "one neuron again and again": "z0 . " * many + ".",
        "one neuron, nested": "z0 " * many + ". " * (many + 1),
        "halvings, nested": "x " * many + ". " * (many + 1),
        "halvings, a chain": "x . " * many + ".",
        "halvings, as deep as allowed": "u1 " * 1000 + ". " * 1001,
        "a full tree": full(17 if part == 1 else 14),
        "a long multiplier": "z0 e0:-" + "9" * 10**6 + " .",
        "many multipliers": "z0 e" + ",".join(["0:-1"] * many) + " .",
        "a long name": "z" + "9" * 10**6 + " . .",
        "no tree": ". " * many,
        "blanks": " " * 10**6,
    }
    for name, tree in trees.items():
        for check in (lambda w, t: proves(w, over, t, 0.9), lambda w, t: proves_range(w, over, t)):
            started = time.process_time()
            check(still if "u1" in tree else wide, tree)
            assert time.process_time() - started < 1 + 3 / part, name  # all work takes 2 s and less on an idle machine
    still = ShallowWeights(*(x[:20] for x in still))
    for tree in (
        "z0 z0 . . .",
        "z0 . z0 . .",
        "z0 . u1 . z0 . .",
        "z00 . .",
        "z+1 . .",
        "u01 . .",
        "u1 " * 1001 + ". " * 1002,
    ):
        assert not proves(still, over, tree, 0.9)
    assert proves(still, over, "z0 . z1 . .", 0.9) and proves(still, over, "u1 " * 1000 + ". " * 1001, 0.9)


def test_a_network_without_a_slope_is_proved_with_any_tree():
    still = ShallowWeights(np.zeros(2), np.ones(2), np.zeros((2, 1)), np.zeros(2))
    over = Box(np.zeros(2), np.ones(2))
    assert proves(still, over, "x . .", 0.1) and proves(still, over, ".", 0.1)
