"""Rates of vector states on a box: as by exact cells, above all points, proofs that forgeries do not pass."""

import time
from fractions import Fraction

import numpy as np
import pytest

from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights
from certify.networks.vector import RELU, VectorNetwork, VectorWeights, activation, check, forward, of_shallow
from certify.proofs import vector_box_proof, vector_statements
from certify.proofs.box_planes import Box
from certify.proofs.vector_box_proof import _halvings, bound, coordinates, proves, proves_range
from certify.proofs.vector_points import norm_at, value_at
from certify.proofs.vector_statements import slopes_on
from certify.search.box import box as parse_box
from certify.search.box import certify as certify_scalar
from certify.search.box import invariance as scalar_invariance
from certify.search.box import operating_box
from certify.search.box import rate as scalar_rate
from certify.search.vector_box import _witness, certify, invariance, rate
from certify.search.vector_box_search import Floats
from tests.support import few
from tests.support.networks import SCALING, network, star, value, vector_network


def test_one_state_with_relu_is_decided_as_by_the_scalar_search():
    for n, m, seed in ((5, 1, 0), (20, 2, 1), (20, 4, 2)):
        weights, over = network(n, m, seed), operating_box(m)
        K = scalar_rate(weights, over).upper
        for factor, verdict in ((1.01, "certified"), (0.99, "refuted")):
            other = certify_scalar(weights, over, factor * K)
            found = certify(of_shallow(weights), RELU, over, factor * K)
            assert found.verdict == other.verdict == verdict and found.invariant == other.invariant
    weights, over = star()  # where lines meet in a point, halving does not end
    assert certify(of_shallow(weights), RELU, over, 0.9, seconds=1.0).verdict == "unknown"
    pair = ShallowWeights(np.array([0.9, -0.9]), np.array([1.0, -1.0]), np.zeros((2, 0)), np.zeros(2))
    assert certify(of_shallow(pair), RELU, Box(-np.ones(1), np.ones(1)), 0.95).verdict == "certified"  # 0.9 x


@pytest.mark.parametrize("name, slope", [("relu", 0.0), ("leaky:1/4", 0.25)])
def test_a_neuron_that_is_off_keeps_the_least_slope(name, slope):
    weights = check(VectorWeights(None, [[1.0]], [[1.0]], np.zeros((1, 0)), [0.0]))
    found = rate(weights, activation(name), Box(np.array([-2.0]), np.array([-1.0])))
    assert found.lower == found.upper == slope


def test_the_depth_of_a_tree_is_that_of_its_longest_path():
    places = {"x0": 0, "u0": 1}
    for text, depth in ((".", 0), ("x0 . .", 1), ("x0 . u0 . .", 2), ("x0 u0 . . u0 . .", 2)):
        assert _halvings(text.split(), places) == depth
    assert _halvings(["x0", "."], places) is _halvings([".", "."], places) is None


@pytest.mark.parametrize("name", ["relu", "leaky:0.1"])
def test_a_climb_finds_the_best_point_of_each_line(name):
    """J changes at the hyperplanes alone: along the last coordinate no point has a larger norm."""
    rng = np.random.default_rng(4)
    weights = vector_network(rng, 2, 1, 8)
    over = Box(-np.ones(3), np.ones(3))
    net = Floats(weights, activation(name), over, "inf", None)
    found, y = net.climb(rng.uniform(-1, 1, (5, 3)), over, rng)
    for norm, point in zip(found, y, strict=True):
        line = np.repeat(point[None], 2000, 0)
        line[:, 2] = np.linspace(-1, 1, 2000)
        assert norm >= net.at(line).max() - 1e-12


def test_a_trajectory_pair_contracts_in_the_norm_of_a_certified_box():
    rng = np.random.default_rng(3)
    for name, last in (("relu", 0), ("tanh", 0), ("leaky:0.1", 3)):
        phi = activation(name)
        weights = vector_network(rng, 2, 1, 6, last)
        weights = weights._replace(A=weights.A / 4, R=np.zeros((2, 2)))
        box = Box(np.array([-2.0, -2.0, -1.0]), np.array([2.0, 2.0, 1.0]))
        found = certify(weights, phi, box, 0.95, "inf", SCALING, 5.0)
        assert found.verdict == "certified" and found.invariant == "yes", name
        assert proves_range(weights, phi, box, found.invariance_tree)
        T, y = np.array(SCALING, float), np.array([[2.0, -2.0, 0.0], [-2.0, 1.5, 0.0]])
        for _ in range(30):
            before = np.abs(T @ (y[0] - y[1])[:2]).max()
            y[:, 2] = rng.uniform(-1, 1)
            y[:, :2] = value(weights, phi, y)
            assert np.abs(y[:, :2]).max() <= 2 and np.abs(T @ (y[0] - y[1])[:2]).max() <= found.upper * before + 1e-15


@pytest.mark.parametrize(("name", "last"), [("relu", 0), ("leaky:0.1", 2), ("tanh", 0), ("tanh", 2)])
def test_invariance_is_proved_or_refuted_by_a_point(name, last):
    phi, rng, seen = activation(name), np.random.default_rng(0), set()
    for k in range(12):
        weights = vector_network(rng, 1 + k % 2, 1, 3, last)
        q = len(weights.R)
        if k % 3:
            weights = weights._replace(A=weights.A / 3, R=weights.R / 3)
        else:
            weights = weights._replace(A=3 * weights.A)
        box = Box(-np.ones(q + 1), np.ones(q + 1))
        told, tree, escape = invariance(weights, phi, box, 2.0)
        seen.add(told)
        y = rng.uniform(box.lo, box.hi, (2000, q + 1))
        if told == "yes":
            assert proves_range(weights, phi, box, tree) and np.abs(value(weights, phi, y)).max() <= 1
            beyond = weights._replace(A=3 * weights.A * (1 + 1 / np.abs(value(weights, phi, y)).max()))
            assert not proves_range(beyond, phi, box, tree)
        elif told == "no":
            values = value_at(weights, phi, escape)
            assert any(low > 1 or high < -1 for low, high in values)
            np.testing.assert_allclose(
                [float(low) for low, _ in values], value(weights, phi, escape[None])[0], rtol=1e-9
            )
    assert {"yes", "no"} <= seen


@pytest.mark.parametrize("step", few([4, 1], [4], "thorough"))
def test_a_forged_or_damaged_tree_is_refused(step):
    weights = vector_network(np.random.default_rng(2), 2, 1, 8)
    weights = weights._replace(b=weights.b / 2)
    box = Box(-np.ones(3), np.ones(3))
    K = rate(weights, RELU, box, gap=1e-6).upper
    found = certify(weights, RELU, box, K * 1.001)
    tokens = found.tree.split()
    assert found.verdict == "certified" and len(tokens) > 20

    def accepted(tree, rate=found.rate, net=weights, **more):
        return proves(net, RELU, box, tree, rate, **more)

    assert accepted(found.tree) and not accepted(found.tree, 0.99 * K)
    assert not accepted(found.tree, net=weights._replace(A=1.1 * weights.A))
    for k in range(0, len(tokens), step):
        assert not accepted(" ".join(tokens[:k] + tokens[k + 1 :]))
        for other in ("x", "x0", "x3", "x01", "u0", "u2", "z0", "e0:1", "..", "x1:0.5", "ü1"):
            assert not accepted(" ".join([*tokens[:k], other, *tokens[k + 1 :]]))
    cuts = [k for k in range(len(tokens) - 2) if tokens[k] != "." and tokens[k + 1] == tokens[k + 2] == "."]
    assert cuts and not any(accepted(" ".join([*tokens[:k], *tokens[k + 2 :]]), K * 1.0001) for k in cuts)
    for tree in ("", ". .", "x1", "x1 .", found.tree + " .", None, 7, b"."):
        assert (
            not accepted(tree)
            and not proves_range(weights, RELU, box, tree)
            and bound(weights, RELU, box, tree) is None
        )
    for other in (
        Box(np.zeros(2), np.ones(2)),
        Box(np.full(3, np.nan), np.ones(3)),
        Box(-np.ones(3), np.full(3, np.inf)),
        Box(np.ones(3), -np.ones(3)),
        Box(np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 1.0])),  # a state without a width
    ):
        assert not proves(weights, RELU, other, ".", 1e9) and not proves_range(weights, RELU, other, ".")


@pytest.mark.parametrize(("name", "last"), few([("relu", 0), ("tanh", 0), ("relu", 2)], [("relu", 0)], "thorough"))
def test_no_tree_proves_what_is_false(name, last):
    rng, phi = np.random.default_rng(0), activation(name)
    weights, box, accepted = vector_network(rng, 2, 1, 4, last), Box(-np.ones(3), np.ones(3)), 0
    found = rate(weights, phi, box, gap=0.01, seconds=1.0)
    real, below = found.tree.split(), Fraction(found.lower)

    def grown(depth):
        if depth == 0 or rng.random() < 0.3:
            return ["."]
        return [str(rng.choice(["x1", "x2", "u1"])), *grown(depth - 1), *grown(depth - 1)]

    for _ in range(100):
        changed = list(real)
        changed[rng.integers(len(real))] = str(rng.choice([".", "x1", "x2", "u1"]))
        for tree in (" ".join(grown(5)), " ".join(changed)):
            assert not proves(weights, phi, box, tree, below)
            accepted += proves(weights, phi, box, tree, 1.5 * found.upper)
    assert accepted


LONG = [
    pytest.param(name, last, marks=pytest.mark.slow)
    for name, last in (("leaky:0.1", 0), ("tanh", 0), ("tanh", 30), ("relu", 30))
]


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "last"), [("relu", 0), *LONG])
def test_hostile_trees_are_answered_soon(name, last, part):
    """Also where every leaf closes, and where an input can be halved 1000 times."""
    rng, phi = np.random.default_rng(0), activation(name)
    weights, box = vector_network(rng, 3, 2, 60, last), Box(np.array([-1.0, -1.0, -1.0, 0.0, 0.0]), np.ones(5))
    weights = weights._replace(A=weights.A / 1000, R=weights.R / 1000)
    names, many = coordinates(3, 2), 250_000 // part

    def full(depth: int) -> str:
        tree = "."
        for k in range(depth):
            tree = f"{names[k % 5]} {tree} {tree}"
        return tree

    trees = {
        "halvings, nested": "x1 " * many + ". " * (many + 1),
        "halvings, a chain": "x1 . " * many + ".",
        "as deep as allowed": "u1 " * 1000 + ". " * 1001,
        "a full tree": full(17 if part == 1 else 14),
        "a long name": "x" + "9" * 10**6 + " . .",
        "no tree": ". " * many,
        "blanks": " " * 10**6,
    }
    cases = [(text, answer) for text in trees for answer in (proves, proves_range)]
    if name != "relu" or last:  # the others cost the same for every network
        cases = [("a full tree", proves), ("as deep as allowed", proves_range)]
    for text, answer in cases:
        started = time.process_time()
        answer(weights, phi, box, trees[text], *([1e9] if answer is proves else []))
        assert time.process_time() - started < 2 + 10 / part, text  # all work takes 4 s and less on an idle machine
    assert not proves(weights, phi, box, "u1 " * 1001 + ". " * 1002, 1e9)


def test_numbers_of_any_size_are_exact():
    """Weights from 1e-300 to 1e150, and boxes far from 0."""
    small = check(VectorWeights([[0.5]], [[1e-300, 1e150]], [[1e300], [1e-150]], [[0.0], [0.0]], [0.0, -1e-150]))
    box = Box(np.array([0.0, 0.0]), np.array([1.0, 1e-300]))
    exact = Fraction(0.5) + Fraction(1e-300) * Fraction(1e300)
    assert bound(small, RELU, box, ".") == exact
    assert proves(small, RELU, box, ".", exact + Fraction(1, 2**4000)) and not proves(small, RELU, box, ".", exact)
    assert norm_at(small, RELU, [0.5, 0.0]) == exact and norm_at(small, activation("tanh"), [0.5, 0.0]) < exact


def test_refused_input_is_said():
    weights, box = vector_network(np.random.default_rng(0), 2, 1, 3), Box(-np.ones(3), np.ones(3))
    for arguments in (
        (weights, RELU, Box(np.zeros(2), np.ones(2))),
        (weights, RELU, Box(-np.ones(3), np.array([1.0, -1.0, 1.0]))),
        (weights, RELU, box, 0.0),
        (weights, RELU, box, float("nan")),
        (weights, RELU, box, 1.0, "two"),
        (weights, RELU, box, 1.0, "inf", [[Fraction(1), Fraction(1)], [Fraction(1), Fraction(1)]]),
        (weights._replace(A=1e80 * weights.A), RELU, box),
        (VectorWeights(*(None if x is None else x[None] for x in weights)), RELU, box),
    ):
        with pytest.raises(CertifyError):
            certify(*arguments)
    assert parse_box("0:1,-1:1,2:3", 1, 2).hi.tolist() == [1.0, 1.0, 3.0]
    with pytest.raises(CertifyError, match="x2"):
        parse_box("0:1,1:1,2:3", 1, 2)
    fixed = Box(np.array([-1.0, -1.0, 0.5]), np.array([1.0, 1.0, 0.5]))  # an input may be fixed
    assert certify(weights, RELU, fixed, 100.0).verdict == "certified"


@pytest.mark.parametrize("size", [0.5, 0.75, 1.0])
def test_a_map_that_touches_an_end_of_its_interval_stays_inside(size):
    """f is 0 on most of the box, and at most its size; bounds by chords just touch the upper end."""
    shallow = ShallowWeights(np.full(2, size), np.ones(2), np.array([[1.0], [-1.0]]), -np.ones(2))
    box = Box(np.array([0.0, -1.0]), np.ones(2))
    assert scalar_invariance(shallow, box)[0] == "yes"
    found = invariance(of_shallow(shallow), RELU, box)
    assert found[0] == "yes" and proves_range(of_shallow(shallow), RELU, box, found[1])
    beyond = shallow._replace(a=np.full(2, np.nextafter(1.0, 2)))
    assert scalar_invariance(beyond, box)[0] == invariance(of_shallow(beyond), RELU, box)[0] == "no"


@pytest.mark.parametrize("norm", ["inf", "one"])
def test_the_norm_at_a_point_is_that_of_the_jacobian_with_any_signs(norm):
    """R and A D W of both signs, by differences of f."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        layers = rng.normal(size=(2, 2)), rng.normal(size=(2, 5)), rng.normal(size=(5, 2))
        weights = check(VectorWeights(*layers, rng.normal(size=(5, 1)), rng.normal(size=5)))
        point, step = rng.normal(size=3), 1e-7
        ahead, behind = (
            forward(VectorNetwork("", weights), point[:2] + s * np.eye(2), point[2:]) for s in (step, -step)
        )
        J = (ahead - behind).T / (2 * step)
        expected = np.linalg.norm(J, np.inf if norm == "inf" else 1)
        assert float(norm_at(weights, RELU, point, norm)) == pytest.approx(expected, rel=1e-5)


def test_without_a_point_nothing_is_known_from_below():
    assert _witness(None, 2) == (0.0, None)


@pytest.fixture
def little_work(monkeypatch):
    """A replay of 1/60 of the usual length, so that it ends every search of a network with many neurons."""
    little = vector_statements.WORK // 60
    for module in (vector_statements, vector_box_proof):
        monkeypatch.setattr(module, "WORK", little)


SEARCHED = [("tanh", 0), ("relu", 3), ("tanh", 3), ("leaky:0.1", 0)]


@pytest.mark.usefixtures("little_work")
@pytest.mark.parametrize("name, last", few(SEARCHED, SEARCHED[:2], "thorough"))
def test_what_the_rate_has_proved_is_certified_when_it_is_asked_for(name, last):
    """Both searches halve as many boxes as a replay can take: the boxes whose bound is too high come first."""
    phi, over = activation(name), Box(-np.ones(4), np.ones(4))
    weights = vector_network(np.random.default_rng(11), 3, 1, 30, last)
    found = rate(weights, phi, over, gap=1e-6)
    nodes = slopes_on(weights, phi, over, "inf", None).nodes
    assert nodes - 1 <= len(found.tree.split()) <= nodes
    assert certify(weights, phi, over, found.upper * (1 + 1e-9)).verdict == "certified"


@pytest.mark.thorough
def test_a_tree_too_long_for_a_replay_is_cut_and_still_proves_something(monkeypatch):
    """As where more signs settle at a node than expected: what was halved first is a tree, too."""
    monkeypatch.setattr(vector_box_proof, "WORK", vector_statements.WORK // 40)
    monkeypatch.setattr(vector_statements, "WORK", vector_statements.WORK // 10)
    over = Box(-np.ones(5), np.ones(5))
    weights = vector_network(np.random.default_rng(12), 5, 0, 60)
    found = rate(weights, RELU, over)
    assert len(found.tree.split()) > 1 and found.upper < bound(weights, RELU, over, ".")
    assert bound(weights, RELU, over, found.tree) <= Fraction(found.upper)
