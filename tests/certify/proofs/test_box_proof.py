"""Proofs on a box: they are exact, tampered ones are refused, hostile ones answered soon, and no solver is needed."""

import time

import numpy as np

from certify.networks.shallow import ShallowWeights
from certify.proofs.box_planes import Box
from certify.proofs.box_proof import proves, proves_range
from certify.search.box import certify, operating_box
from tests.support.networks import network


def test_a_tree_of_halves_is_refused_for_other_weights_or_another_rate():
    weights, over = network(20, 4, 0), operating_box(4)
    found = certify(weights, over, rate=0.1795)
    tokens = found.tree.split()
    assert found.verdict == "certified" and len(tokens) > 100
    assert not proves(weights, over, found.tree, 0.17)
    assert not proves(weights._replace(a=1.01 * weights.a), over, found.tree, 0.1795)
    cuts = [k for k in range(len(tokens) - 2) if tokens[k][0] in "xu" and tokens[k + 1] == tokens[k + 2] == "."]
    assert cuts and not any(proves(weights, over, " ".join(tokens[:k] + tokens[k + 2 :]), 0.1795) for k in cuts[:20])


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
        "halvings, nested": "x " * many + ". " * (many + 1),
        "halvings, a chain": "x . " * many + ".",
        "halvings, as deep as allowed": "u1 " * 1000 + ". " * 1001,
        "a full tree": full(17 if part == 1 else 14),
        "a long name": "u" + "9" * 10**6 + " . .",
        "no tree": ". " * many,
        "blanks": " " * 10**6,
    }
    for name, tree in trees.items():
        for check in (lambda w, t: proves(w, over, t, 0.9), lambda w, t: proves_range(w, over, t)):
            started = time.process_time()
            check(still if "u1" in tree else wide, tree)
            assert time.process_time() - started < 1 + 3 / part, name  # all work takes 2 s and less on an idle machine
    still = ShallowWeights(*(x[:20] for x in still))
    for tree in ("z0 . .", "u01 . .", "u5 . .", "", ". .", None, "u1 " * 1001 + ". " * 1002):
        assert not proves(still, over, tree, 0.9)
    assert proves(still, over, "u1 " * 1000 + ". " * 1001, 0.9)


def test_a_network_without_a_slope_is_proved_with_any_tree():
    still = ShallowWeights(np.zeros(2), np.ones(2), np.zeros((2, 1)), np.zeros(2))
    over = Box(np.zeros(2), np.ones(2))
    assert proves(still, over, "x . .", 0.1) and proves(still, over, ".", 0.1)
