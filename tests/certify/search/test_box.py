"""Rates, invariance and their proofs on a box; `tests/fuzz/test_boxes.py` compares rates with exact enumerations."""

import time

import numpy as np
import pytest
from scipy.optimize import linprog

from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights
from certify.proofs import box_proof
from certify.proofs.box_planes import Box, planes, value_at
from certify.proofs.box_proof import proves, proves_range
from certify.search.box import box, certify, invariance, operating_box, rate
from tests.support import few
from tests.support.exact_cells import exact_rate
from tests.support.networks import network, star


def degenerate(seed: int) -> ShallowWeights:
    """Small integers: hyperplanes through common points and on faces; some rows are repeated, some turned round."""
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(2, 9)), int(rng.integers(0, 3))
    rows = rng.integers(-2, 3, (n, m + 2)).astype(float)
    for i in range(1, n):
        if rng.random() < 0.3:
            rows[i] = rows[rng.integers(i)] * rng.choice([1.0, 2.0, -1.0, -0.5])
    if rng.random() < 0.5:  # all through one dyadic point of the box
        point = np.r_[rng.choice([0.0, 0.5, 1.0]), rng.choice([-1.0, 0.0, 0.5], m)]
        rows[:, -1] = -rows[:, :-1] @ point
    return ShallowWeights(rng.integers(-3, 4, n) / 8, rows[:, 0], rows[:, 1:-1], rows[:, -1])


def cells(weights: ShallowWeights, over, matters: np.ndarray) -> list[tuple]:
    """The sign patterns of some neurons that a linear program reaches in the box with a margin, sign by sign."""
    H, c = np.c_[weights.w1, weights.W2][matters], weights.b[matters]
    centre, radius = (over.lo + over.hi) / 2, (over.hi - over.lo) / 2
    H, c = H * radius, H @ centre + c
    size = np.abs(H).sum(1)
    H, c = H / size[:, None], c / size

    def reached(signs):
        k, signs = len(signs), np.array(signs)
        A, least = np.c_[-signs[:, None] * H[:k], np.ones(k)], signs * c[:k]
        limits = [(-1, 1)] * H.shape[1] + [(None, 1)]
        return linprog(np.r_[np.zeros(H.shape[1]), -1], A_ub=A, b_ub=least, bounds=limits).x[-1] > 1e-9

    patterns: list[tuple] = [()]
    for _ in c:
        patterns = [(*signs, v) for signs in patterns for v in (-1.0, 1.0) if reached((*signs, v))]
    return patterns


def test_neurons_on_one_hyperplane_count_once():
    x, nothing = np.array([1.0, 1.0]), np.zeros((2, 0))
    cancel = ShallowWeights(np.array([1.0, -1.0]), x, nothing, np.array([-0.5, -0.5]))
    pair = ShallowWeights(np.array([0.9, -0.9]), np.array([1.0, -1.0]), nothing, np.array([-0.25, 0.25]))
    third = ShallowWeights(np.array([1.0, -3.0]), np.array([3.0, 1.0]), nothing, np.array([-1.5, -0.5]))
    assert rate(cancel, operating_box(0)).upper < 1e-12 and rate(cancel, operating_box(0)).witness is None
    assert rate(third, operating_box(0)).upper < 1e-12
    bracket = rate(pair, operating_box(0))
    assert bracket.lower == 0.9 and bracket.upper == pytest.approx(0.9, rel=1e-12)
    assert len(planes(pair, operating_box(0)).rows) == 1


def test_a_fixed_input_is_folded_into_the_constant():
    weights = network(8, 2, 3)
    folded = weights._replace(W2=weights.W2[:, :1], b=weights.b + 0.3 * weights.W2[:, 1])
    at, free = rate(weights, box("0:1,-1:1,0.3:0.3", 2)), rate(folded, operating_box(1))
    assert at.closed and at.lower == pytest.approx(free.lower, abs=1e-15) and at.witness.u[1] == 0.3
    one, c = np.ones(2), np.array([-0.5, -0.5])
    meet = ShallowWeights(np.array([1.0, -1.0]), one, np.array([[1.0], [-1.0]]), c)  # one hyperplane, at u = 0 alone
    assert rate(meet, box("0:1,0:0", 1)).upper < 1e-12 and rate(meet, box("0:1,-1e-9:0", 1)).lower == 1.0


def test_one_neuron():
    for b, expected in ((-0.5, 0.75), (0.5, 0.75), (-2.0, 0.0), (0.0, 0.75)):
        weights = ShallowWeights(np.array([-0.75]), np.ones(1), np.zeros((1, 1)), np.array([b]))
        bracket = rate(weights, operating_box(1))
        assert bracket.lower == expected and bracket.upper == pytest.approx(expected, abs=1e-12) and bracket.closed
        verdict = certify(weights, operating_box(1), rate=0.75)
        assert verdict.verdict == ("refuted" if expected else "certified")


def test_a_search_that_is_stopped_gives_a_bracket():
    weights, over = network(20, 4, 4), operating_box(4)
    whole = rate(weights, over)
    assert whole.closed
    truth = whole.lower
    for seconds in (0.0, 0.005):
        bracket = rate(weights, over, seconds=seconds)
        assert bracket.lower <= truth * (1 + 1e-12) and truth <= bracket.upper
    assert not rate(weights, over, seconds=0.0).closed
    verdict = certify(weights, over, rate=truth * 1.0001, seconds=0.0)
    assert verdict.verdict == "unknown" and verdict.tree is None and verdict.lower <= truth <= verdict.upper


def ends_of(weights: ShallowWeights, over) -> tuple[float, float]:
    """The least and the greatest x⁺ on a box: those of the vertices of the cells."""
    H = np.c_[weights.w1, weights.W2]
    moves = H.any(1)
    still, ends = float(weights.a[~moves] @ np.maximum(weights.b[~moves], 0)), []
    for signs in cells(weights, over, moves):
        on, signs = np.array(signs) > 0, np.array(signs)
        slope, height = weights.a[moves][on] @ H[moves][on], weights.a[moves][on] @ weights.b[moves][on] + still
        limits = dict(A_ub=-signs[:, None] * H[moves], b_ub=signs * weights.b[moves], bounds=np.c_[over.lo, over.hi])
        ends += [side * linprog(side * slope, **limits).fun + height for side in (1, -1)]
    return min(ends), max(ends)


@pytest.mark.parametrize("seed", few(range(8), range(4), "thorough"))
def test_invariance_is_decided_as_by_the_vertices_of_the_cells(seed):
    """Of the network, and of networks whose output is scaled and shifted to just inside and just beyond [0, 1]."""
    weights = degenerate(seed) if seed % 2 else network(5, 1, seed)
    over = operating_box(weights.W2.shape[1])
    least, greatest = ends_of(weights, over)
    drawn = [(weights, least, greatest)]
    for below, above in ((1e-5, 1e-5), (-1e-5, 1e-5), (1e-5, -1e-5)):  # the room that is left at 0 and at 1
        scale = (1 - below - above) / max(greatest - least, 1e-3)
        a, w1, W2, b = weights
        shift = np.array([below - scale * least])
        moved = ShallowWeights(np.r_[scale * a, shift], np.r_[w1, 0.0], np.r_[W2, 0 * W2[:1]], np.r_[b, 1.0])
        drawn.append((moved, *(scale * end + shift[0] for end in (least, greatest))))
    verdicts = []
    for each, low, high in drawn:
        verdict, tree, escape = invariance(each, over)
        if low < -1e-9 or high > 1 + 1e-9:
            assert verdict == "no" and not 0 <= value_at(each, escape) <= 1
            assert (over.lo <= escape).all() and (escape <= over.hi).all() and tree is None
        else:
            assert verdict == "yes" and proves_range(each, over, tree)
        verdicts.append(verdict)
    assert greatest - least < 1e-3 or verdicts[1:] == ["yes", "no", "no"]


def test_invariance_is_exact_at_its_edge():
    one, nothing = np.ones(1), np.zeros((1, 0))
    identity = ShallowWeights(one, one, nothing, 0 * one)
    assert invariance(identity, operating_box(0)) == ("yes", ".", None)
    assert certify(identity, operating_box(0)).verdict == "refuted"  # invariant, and no contraction
    assert invariance(identity._replace(a=np.nextafter(one, 2)), operating_box(0))[0] == "no"
    assert invariance(identity._replace(a=np.nextafter(one, 0)), operating_box(0))[0] == "yes"
    assert not proves_range(identity._replace(a=np.nextafter(one, 2)), operating_box(0), ". ")
    assert invariance(identity._replace(a=-one), box("-1:0", 0))[0] == "yes"
    tent = ShallowWeights(np.array([2.0, -4.0]), np.ones(2), np.zeros((2, 0)), np.array([0.0, -0.5]))
    verdict, tree, _ = invariance(tent, operating_box(0))  # on to [0, 1], its top in the middle
    assert verdict == "yes" and tree == "x . ." and not proves_range(tent, operating_box(0), ".")
    for other in ("x .", "z0 . .", "", "x . . ."):
        assert not proves_range(tent, operating_box(0), other)
    assert invariance(tent, operating_box(0), seconds=-1.0)[0] == "unknown"


def test_the_operating_boxes():
    assert operating_box(4).lo.tolist() == [0, 0, 0, -1, -1] and operating_box(4).hi.tolist() == [1] * 5
    assert operating_box(2).lo.tolist() == [0, -1, -1]
    given = box("0:1,0:1,0:1,-1:1,-1:1", 4)
    assert all((x == y).all() for x, y in zip(given, operating_box(4), strict=True))
    assert all((x == y).all() for x, y in zip(box([(0, 1)] * 3 + [(-1, 1)] * 2, 4), given, strict=True))


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ("1:0,0:1", "lo ≤ hi"),
        ("0:1,2:1", "u1, expected lo ≤ hi"),
        ("0:1", "found 1 intervals, expected 2"),
        ("0:1,0:1,0:1", "found 3 intervals"),
        ("0:inf,0:1", "finite"),
        ("0:1,nan:1", "finite"),
        ("0:1,a:b", "two numbers"),
        ("0:1,1", "two numbers"),
        ("0:1,0:1:2", "two numbers"),
        ("", "found 1 intervals"),
        ("0.5:0.5,0:1", "lo < hi"),
        ([(0, 1), 3], "two numbers"),
    ],
)
def test_a_bad_box_is_told_in_a_sentence(given, says):
    with pytest.raises(CertifyError, match=says):
        box(given, 1)


def test_other_bad_input_is_told_in_a_sentence():
    weights, over = star()
    with pytest.raises(CertifyError, match=r"expected 1 \+ m = 2"):
        rate(weights, operating_box(2))
    with pytest.raises(CertifyError, match="NaN"):
        rate(weights._replace(a=weights.a * np.nan), over)
    with pytest.raises(CertifyError, match="one network"):
        rate(ShallowWeights(*(np.stack([x, x]) for x in weights)), over)
    with pytest.raises(CertifyError, match="size 1e\\+200"):
        rate(weights._replace(a=weights.a + 1e200), over)
    with pytest.raises(CertifyError, match="above 0"):
        certify(weights, over, rate=0.0)


def test_hyperplanes_through_one_point_stay_open_and_nothing_false_is_said():
    """Without biases all of them cross every box around the origin: no halving decides."""
    rng = np.random.default_rng(0)
    a, w1 = rng.normal(size=(2, 12))
    weights, over = ShallowWeights(a, w1, rng.normal(size=(12, 2)), np.zeros(12)), operating_box(2)
    truth = float(exact_rate(weights, over))
    bracket = rate(weights, over)
    assert bracket.lower <= truth * (1 + 1e-12) and truth <= bracket.upper and not bracket.closed
    verdict = certify(weights, over, truth * (1 + 1e-9))
    assert verdict.verdict == "unknown" and verdict.tree is None


def test_a_tree_of_halves_is_refused_for_other_weights_or_another_rate():
    weights, over = network(20, 4, 0), operating_box(4)
    result = certify(weights, over, rate=0.1795)
    tokens = result.tree.split()
    assert result.verdict == "certified" and len(tokens) > 100
    assert not proves(weights, over, result.tree, 0.17)
    assert not proves(weights._replace(a=1.01 * weights.a), over, result.tree, 0.1795)
    cuts = [k for k in range(len(tokens) - 2) if tokens[k][0] in "xu" and tokens[k + 1] == tokens[k + 2] == "."]
    assert cuts and not any(proves(weights, over, " ".join(tokens[:k] + tokens[k + 2 :]), 0.1795) for k in cuts[:20])


@pytest.fixture(params=[10, pytest.param(1, marks=pytest.mark.thorough)])
def part(request, monkeypatch) -> int:
    """A tenth of the size and of the work of a replay by default; the thorough tests take all of both."""
    monkeypatch.setattr(box_proof, "WORK", box_proof.WORK // request.param)
    return request.param


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
