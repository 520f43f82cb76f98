"""Bounds by linear programs on a box: they agree with exact cells, their proofs are exact, forged ones are refused."""

import sys
import time
from fractions import Fraction

import numpy as np
import pytest

from certify.networks.shallow import ShallowWeights
from certify.proofs.box_planes import Box, Planes, planes
from certify.proofs.box_proof import proves, proves_sum
from certify.proofs.certificate import make, verify
from certify.search import box_slopes
from certify.search.box import box, certify, operating_box, rate
from certify.search.box_search import Search, forms_of
from tests.support import few
from tests.support.exact_cells import exact_rate
from tests.support.networks import network, star


@pytest.fixture
def duals(monkeypatch):
    """Every box is searched by linear programs at once."""
    pytest.importorskip("highspy")
    monkeypatch.setattr(box_slopes, "programs_are_better", lambda *counts: True)
    monkeypatch.setattr(box_slopes, "FEW_BOXES", 0)
    monkeypatch.setattr(box_slopes, "LEFT", 0)


def counted(tree: str) -> int:
    return sum(token[0] == "d" for token in tree.split())


@pytest.mark.parametrize("seed", few(range(6), range(3), "thorough"))
def test_the_rate_by_programs_is_that_of_exact_cells(duals, seed):
    weights = network(7 + seed % 3, 1 + seed % 3, seed)
    over = operating_box(weights.W2.shape[1])
    truth = exact_rate(weights, over)
    found = rate(weights, over)
    assert found.closed and found.lower <= truth <= found.upper
    verdict = certify(weights, over, float(truth) * (1 + 1e-9))
    assert verdict.verdict == "certified" and verdict.tree.split()[0] == "s" and counted(verdict.tree)
    assert not proves(weights, over, verdict.tree, truth)


def test_programs_and_boxes_find_the_same_rate(monkeypatch):
    pytest.importorskip("highspy")
    weights, over = network(30, 6, 0), operating_box(6)
    by_programs = rate(weights, over, seconds=60)
    monkeypatch.setattr(box_slopes, "installed", lambda: False)
    by_cells = rate(weights, over, seconds=60)
    assert by_programs.closed and by_cells.closed and by_programs.nodes < by_cells.nodes
    assert by_programs.lower == pytest.approx(by_cells.lower, rel=2e-6)


def test_without_the_solver_the_verdict_is_the_same(monkeypatch):
    monkeypatch.setitem(sys.modules, "highspy", None)
    assert not box_slopes.installed()
    weights, over = network(14, 9, 1), operating_box(9)
    found = rate(weights, over)
    verdict = certify(weights, over, found.upper * 1.0001)
    assert found.closed and verdict.verdict == "certified" and not counted(verdict.tree)


def test_a_stopped_search_by_programs_gives_a_bracket(duals):
    weights, over = network(40, 6, 2), operating_box(6)
    truth = rate(weights, over, seconds=60)
    assert truth.closed
    for seconds in (0.0, 0.05, 0.1):
        found = rate(weights, over, seconds=seconds)
        assert found.lower <= truth.upper and truth.lower <= found.upper
    verdict = certify(weights, over, truth.upper * 1.0001, seconds=0.02)
    assert verdict.verdict == "unknown" and verdict.tree is None


def test_a_certificate_of_many_inputs_is_verified_without_a_solver(monkeypatch):
    pytest.importorskip("highspy")
    weights, over = network(30, 6, 1), operating_box(6)
    asked = 1.0001 * rate(weights, over).upper
    found = certify(weights, over, asked)
    assert found.verdict == "certified" and counted(found.tree) >= 5
    made = make(weights, "box", asked, over, found.tree)
    monkeypatch.setitem(sys.modules, "highspy", None)
    monkeypatch.setitem(sys.modules, "scipy", None)
    assert verify(made, weights).valid
    assert not verify(made, weights._replace(a=1.0001 * weights.a)).valid


# z₀ = x + u − 1, z₁ = x − u − 1, z₂ = 1 − 2x on x in [0, 1], u in [−1, 1]; z₀ and z₁ are never positive together
TRIPLE = Planes([0, 1, 2], [[1, 1], [1, -1], [-2, 0]], [-1, -1, 1], [4, 4, 4], [0, 0, 0], 0, 0)
SQUARE = Box(np.array([0.0, -1.0]), np.ones(2))


def truth_of(mu: dict[int, Fraction]) -> Fraction:
    """(2) of `box_proof` for TRIPLE on SQUARE, by its extremes at the corners: 12, raised, and the form's maximum."""
    raised = Fraction(0)
    for g, x in mu.items():
        z = [TRIPLE.rows[g][0] * a + TRIPLE.rows[g][1] * b + TRIPLE.constants[g] for a in (0, 1) for b in (-1, 1)]
        raised += max(4 + max(-x, 0) * max(z), 0 - max(x, 0) * min(z)) - 4
    corners = [
        sum(x * (TRIPLE.rows[g][0] * a + TRIPLE.rows[g][1] * b + TRIPLE.constants[g]) for g, x in mu.items())
        for a in (0, 1)
        for b in (-1, 1)
    ]
    return 12 + raised + max(corners)


def test_the_bound_of_a_leaf_is_exact():
    """A leaf holds for integers above (2), and not at it; at random multipliers of any sign."""
    rng, below = np.random.default_rng(0), 0
    for _ in range(300):
        divisor, k = int(rng.integers(1, 9)), rng.integers(-3, 15, 3)
        chosen = rng.permutation(3)[: rng.integers(1, 4)].tolist()
        bound = truth_of({g: Fraction(int(k[g]), divisor) for g in chosen})
        leaf = f"d{divisor}," + ",".join(f"{g}:{k[g]}" for g in chosen)
        most = int(bound // 1)
        assert proves_sum(TRIPLE, SQUARE, f"s {leaf} .", most + 1, -1)
        assert not proves_sum(TRIPLE, SQUARE, f"s {leaf} .", most, -1)
        below += bound < 12
    assert below > 5  # some are better than interval arithmetic


def test_a_leaf_proves_its_own_side_alone():
    leaf = "d1,2:0"
    assert proves_sum(TRIPLE, SQUARE, f"s {leaf} .", 13, -1) and not proves_sum(TRIPLE, SQUARE, f"s {leaf} .", 12, -1)
    assert not proves_sum(TRIPLE, SQUARE, leaf, 13, -1), "which side is not said"
    assert not proves_sum(TRIPLE, SQUARE, "s s . . .", 13, -1), "a statement is split once"
    assert not proves_sum(TRIPLE, SQUARE, "s . .", 13, 0) and not proves_sum(TRIPLE, SQUARE, "s . d1", 13, 0)
    for tree in ("s . .", "s x . . .", "s z0 . . ."):
        assert proves_sum(TRIPLE, SQUARE, tree, 13, -1) and not proves_sum(TRIPLE, SQUARE, tree, 12, -1)
    fewer = TRIPLE._replace(above=[-4, -4, -4])  # the least sum is −(the greatest of TRIPLE)
    assert truth_of(dict.fromkeys(range(3), Fraction(2))) == 10, "better than interval arithmetic"
    assert proves_sum(fewer, SQUARE, "s . d2,0:4,1:4,2:4", 1, -11)
    assert not proves_sum(fewer, SQUARE, "s . d2,0:4,1:4,2:4", 1, -10)
    assert not proves_sum(fewer, SQUARE, "s . d2,0:-4,1:-4,2:-4", 1, -11)


def test_a_tampered_proof_by_programs_is_refused(duals):
    weights, over = network(12, 2, 3), operating_box(2)
    found = rate(weights, over)
    asked = found.upper * 1.02
    tokens = certify(weights, over, asked).tree.split()
    tree = " ".join(tokens)
    assert counted(tree) >= 3 and proves(weights, over, tree, asked) and not proves(weights, over, tree, found.lower)
    for k, token in enumerate(tokens):
        assert not proves(weights, over, " ".join(tokens[:k] + tokens[k + 1 :]), asked)
        if token[0] != "d":
            continue
        divisor, *pairs = token.split(",")
        for other in (
            "d",
            "d0," + ",".join(pairs),
            "d-" + token[1:],
            "d0" + token[1:],
            "d" + "0" * 5000 + token[1:],
            token + ",",
            token + "," + pairs[0],  # a plane twice
            divisor + ",99:1",  # a neuron that does not exist
            ",".join([divisor, *(p.replace(":", ":-").replace("--", "") for p in pairs)]),  # the other direction
            ",".join([divisor, *(p + "000" for p in pairs)]),
            "d1000" + token,
            token.replace(":", ":+", 1),
            token.replace(":", "", 1),
            token.upper(),
        ):
            assert not proves(weights, over, " ".join([*tokens[:k], other, *tokens[k + 1 :]]), asked), other
    assert not proves(weights._replace(b=weights.b + 0.3), over, tree, asked)


@pytest.mark.thorough
def test_hostile_leaves_are_answered_soon(part):
    """A megabyte of leaves and splits of the statement: of many planes, of long numbers, and of none."""
    weights, over = network(200, 4, 0), operating_box(4)
    chain = 4_000 // part
    many = ",".join(f"{k}:1" for k in planes(weights, over).neuron)
    trees = {
        "empty leaves": "s " + "u1 d1 " * (150_000 // part) + "d1 .",
        "long numbers": "s " + "u1 " * 300 + ("d1,0:" + "9" * 1500 + " ") * 301 + ".",
        "long divisors": "s " + "u1 " * 300 + ("d" + "9" * 1500 + ",0:1 ") * 301 + ".",
        "too long a divisor": "s d" + "9" * 10**6 + " .",
        "many planes": "s " + "u1 " * 600 + (f"d7,{many} ") * 601 + ".",
        "splits of the statement": "s " * (300_000 // part) + ". " * (300_000 // part + 1),
        "statements in halves": "u1 " * 1000 + "s . . " * 1001,
        "splits, a chain": "s " + "".join(f"z{k % 200} . " for k in range(chain)) + ". .",
    }
    for name, tree in trees.items():
        started = time.process_time()
        proves(weights, over, tree, 0.9)
        assert time.process_time() - started < 1 + 3 / part, name  # all work takes 2 s and less on an idle machine


def test_a_tree_without_planes_is_replayed():
    still = ShallowWeights(np.ones(1), np.ones(1), np.zeros((1, 1)), np.full(1, -2.0))  # never on
    assert proves(still, operating_box(1), "s d1 d3", 1e-9) and not proves(still, operating_box(1), "s d1,0:1 .", 1.0)
    dead = still._replace(a=np.zeros(1))
    assert proves(dead, operating_box(1), "s d1 .", 1e-9) and not proves(dead, operating_box(1), "d1", 1e-9)


def test_planes_over_other_coordinates_are_searched_and_proved(duals):
    """The search takes planes, gains and a box; nothing in it is about the weights of a network."""
    rng = np.random.default_rng(5)
    rows, constants = rng.integers(-9, 10, (10, 3)).tolist(), rng.integers(-4, 5, 10).tolist()
    above, below = rng.integers(-6, 7, (2, 10)).tolist()
    found, cube = Planes(list(range(10)), rows, constants, above, below, 0, 0), Box(-np.ones(3), np.ones(3))
    points = rng.uniform(-1, 1, (200_000, 3))
    sums = np.where(points @ np.array(rows, float).T + constants > 0, above, below).sum(1)
    search = Search(lambda best: best + 0.5, np.inf, time.perf_counter() + 60)
    box_slopes.search_slopes(search, forms_of(found, cube), cube, 100_000)
    assert search.best >= np.abs(sums).max() and search.open == -np.inf
    most = round(search.best)
    assert proves_sum(found, cube, search.text(), most + 1, -most - 1)
    assert not proves_sum(found, cube, search.text(), most, -most)


def test_planes_through_one_point_are_excluded_exactly(duals):
    weights, over = star()
    found = certify(weights, over, rate=0.9)
    assert found.verdict == "certified" and rate(weights, over).upper == pytest.approx(0.8)
    assert not proves(weights, over, found.tree, 0.8)


@pytest.mark.parametrize(("n", "m"), [(10, 1), (12, 2), (12, 6)])
def test_a_network_without_biases_is_decided_by_programs(duals, n, m):
    rng = np.random.default_rng(0)
    a, w1 = rng.normal(size=(2, n))
    weights, over = ShallowWeights(a, w1, rng.normal(size=(n, m)), np.zeros(n)), operating_box(m)
    found = rate(weights, over, seconds=60)
    assert found.closed
    verdict = certify(weights, over, found.lower * (1 + 1e-9), seconds=60)
    assert verdict.verdict == "certified" and proves(weights, over, verdict.tree, verdict.rate)


def test_a_fixed_input_is_part_of_the_constant(duals):
    weights = network(10, 3, 4)
    folded = weights._replace(W2=weights.W2[:, :2], b=weights.b + 0.3 * weights.W2[:, 2])
    at = box("0:1,-1:1,-1:1,0.3:0.3", 3)
    found = rate(weights, at)
    assert found.closed and found.lower == pytest.approx(rate(folded, operating_box(2)).lower, abs=1e-15)
    verdict = certify(weights, at, found.upper * 1.001)
    assert verdict.verdict == "certified" and proves(weights, at, verdict.tree, verdict.rate)


@pytest.mark.parametrize("scale", few([1e-40, 1e-12, 1e12, 1e40], [1e-40, 1e12], "thorough"))
def test_a_scaled_network_has_the_scaled_rate(duals, scale):
    weights, over = network(12, 2, 1), operating_box(2)
    once, found = rate(weights, over), rate(weights._replace(a=scale * weights.a), over)
    assert found.closed and found.lower == pytest.approx(scale * once.lower, rel=1e-5)
    same = rate(ShallowWeights(weights.a, *(scale * x for x in weights[1:])), over)
    assert same.closed and same.lower == pytest.approx(scale * once.lower, rel=1e-5)
    asked = same.upper * 1.001
    assert certify(ShallowWeights(weights.a, *(scale * x for x in weights[1:])), over, asked).verdict == "certified"
