"""The inequality of a vector state: its rates against closed forms and another program, and every proof exactly."""

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest

from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights
from certify.networks.vector import RELU, VectorWeights, activation, of_shallow
from certify.proofs import vector_exact as exact
from certify.search.vector_balance import balance
from certify.search.vector_lmi import smallest_rate
from tests.support import few
from tests.support.vector_networks import draw, spectral

PHI = ("relu", "leaky:1/8", "tanh")
NEAR = 2e-5  # relative distance of the proved rate from the smallest


def slopes(weights, phi) -> np.ndarray:
    """J of every choice of least and greatest slopes, in floats."""
    ends = (float(phi.least), 1.0)
    layers = [weights.W] if weights.V is None else [weights.W, weights.V]
    matrices = [np.eye(len(weights.R))]
    for X in layers:
        chosen = list(itertools.product(ends, repeat=len(X)))
        matrices = [np.array(d)[:, None] * (X @ J) for J in matrices for d in chosen]
    return weights.R + weights.A @ np.array(matrices)


def checked(weights, phi, answer, most=1):
    """A certified answer proves its κ, which is near the solver's rate."""
    assert answer.proof is not None
    assert exact.proves(weights, phi, answer.proof, answer.kappa, Fraction(most))
    assert answer.rate < answer.kappa <= answer.rate * (1 + NEAR)


def test_one_state_has_the_exact_rate():
    """max(P, N), at q = 1 also that of the ∞-norm, with a skip connection and leaky slopes, too."""
    rng = np.random.default_rng(0)
    for case in range(12):
        weights, phi = draw(rng, 1, int(rng.integers(1, 9))), activation(PHI[case % 3])
        answer = smallest_rate(weights, phi)
        checked(weights, phi, answer)
        K = float(exact.rate(weights, exact.everywhere(weights, phi)))
        assert answer.rate == pytest.approx(K, rel=1e-5) if K else answer.rate < 0.01  # a κ is above 0
    a, w1 = rng.standard_normal((2, 20))
    weights = of_shallow(ShallowWeights(a, w1, np.zeros((20, 0)), np.zeros(20)))
    K = exact.rate(weights, exact.everywhere(weights, RELU))
    assert smallest_rate(weights, RELU).rate == pytest.approx(float(K), rel=1e-5)


@pytest.mark.parametrize("cases", [12, pytest.param(300, marks=pytest.mark.slow)])
def test_rate_lies_between_enumeration_and_is_proved(cases):
    """In the norm of its P no pattern is above κ, and none has a spectral radius above the rate."""
    rng, two = np.random.default_rng(cases), 0
    for case in range(cases):
        second = int(rng.integers(1, 5)) if case % 3 == 0 else 0
        weights, phi = draw(rng, int(rng.integers(1, 5)), int(rng.integers(1, 6)), second), activation(PHI[case % 3])
        answer = smallest_rate(weights, phi)
        checked(weights, phi, answer)
        J = slopes(weights, phi)
        assert spectral(J, answer.proof.metric) <= float(answer.kappa) * (1 + 1e-9)
        assert np.abs(np.linalg.eigvals(J)).max() <= float(answer.kappa) * (1 + 1e-9)
        two += second > 0
    assert two


@pytest.mark.parametrize("q", few([1, 2, 3, 6], [1, 3], "thorough"))
def test_the_papers_multipliers_double_the_rate(q):
    """Slopes in [0, 2] are twice those in [0, 1], so that with R = 0 every J doubles."""
    rng = np.random.default_rng(q)
    weights = draw(rng, q, 6)
    weights = weights._replace(R=0 * weights.R)
    single, double = (smallest_rate(weights, RELU, most) for most in (1, 2))
    checked(weights, RELU, single)
    checked(weights, RELU, double, most=2)
    assert double.rate == pytest.approx(2 * single.rate, rel=1e-5)


def edge(name: str) -> VectorWeights:
    weights = draw(np.random.default_rng(9), 3, 5, 3 if name.startswith("two") else 0)
    A, W, R = (np.array(x) for x in (weights.A, weights.W, weights.R))
    if "input" in name:
        W[1] = 0
    if "output" in name:
        A[:, 0] = 0
    if "row" in name:
        A[2] = R[2] = 0
    if "column" in name:
        W[:, 0] = R[:, 0] = 0
    if "no slope" in name:
        A, R = 0 * A, 0 * R
    if "unstable" in name:
        R = R + 3 * np.eye(3)
    if "rank one" in name:
        W, A = np.outer(np.ones(len(W)), W[0]), np.outer(A[:, 0], np.ones(A.shape[1]))
    if "Jordan" in name:
        R = 0.9 * np.eye(3) + np.eye(3, k=1)
        A = 0 * A
    size = 1e80 if "huge" in name else 1e-80 if "tiny" in name else 1.0
    gauge = 10.0 ** np.arange(-30, 30, 60 / len(W))[: len(W)] if "gauge" in name else np.ones(len(W))
    if weights.V is None:
        A = A / gauge
    else:
        weights = weights._replace(V=weights.V / gauge)
    return weights._replace(A=A * size, W=gauge[:, None] * W, R=R * (0 if size != 1 else 1))


DEGENERATE = list(itertools.product(
    ("input", "output", "input, output", "row", "column", "no slope", "unstable", "rank one", "huge", "tiny", "gauge"),
    ("one", "two"),
))  # fmt: skip


@pytest.mark.parametrize(("name", "layers"), few(DEGENERATE, [*DEGENERATE[::4], *DEGENERATE[3::4]], "thorough"))
def test_degenerate_networks_are_proved(layers, name):
    weights = edge(f"{layers}, {name}")
    answer = smallest_rate(weights, RELU)
    checked(weights, RELU, answer)
    assert spectral(slopes(weights, RELU), answer.proof.metric) <= float(answer.kappa) * (1 + 1e-6)
    if name == "unstable":
        assert answer.rate > 2


def test_a_rate_that_no_metric_attains_is_approached():
    """A Jordan block has its spectral radius as an infimum."""
    weights = edge("one, Jordan")
    answer = smallest_rate(weights, RELU)
    assert answer.proof is not None and exact.proves(weights, RELU, answer.proof, answer.kappa)
    assert 0.9 < answer.kappa < 1.0


def test_balancing_is_undone_exactly():
    """P and Λ of the balanced network prove the rate of the weights as given: both are the same inequality."""
    weights = edge("one, gauge")
    balanced = balance(weights)
    assert all(math.frexp(x)[0] == 0.5 for c in (balanced.state, *balanced.neurons) for x in c)
    T, C, s = np.diag(balanced.state), balanced.neurons[0], balanced.size
    np.testing.assert_array_equal(balanced.layers[0], C[:, None] * weights.W / balanced.state)
    np.testing.assert_array_equal(balanced.layers[1], T @ weights.A / C / s)
    np.testing.assert_array_equal(balanced.R, T @ weights.R / balanced.state / s)
    ratios = np.abs(balanced.layers[0]).max(1) / np.abs(balanced.layers[1]).max(0)
    assert 0.2 < ratios.min() and ratios.max() < 5


def test_proofs_are_short():
    weights = draw(np.random.default_rng(10), 3, 8)
    answer = smallest_rate(weights, RELU)
    numbers = [x for row in (*answer.proof.metric, *answer.proof.multipliers) for x in row]
    assert max(x.numerator.bit_length() for x in numbers) < 40 and answer.kappa.numerator.bit_length() <= 26


def test_another_solver_agrees_and_a_failing_one_is_a_status():
    weights = draw(np.random.default_rng(12), 2, 3)
    answer, other = smallest_rate(weights, RELU), smallest_rate(weights, RELU, solver="scs")
    assert other.rate == pytest.approx(answer.rate, rel=0.02)
    if other.proof is not None:
        assert exact.proves(weights, RELU, other.proof, other.kappa)


def test_a_solver_that_answers_nonsense_proves_nothing(monkeypatch):
    from certify.search.vector_lmi import Program

    weights = draw(np.random.default_rng(13), 2, 3)
    for answer in (None, np.full(7, np.nan), np.ones(7), -np.ones(7), np.zeros(7)):
        monkeypatch.setattr(Program, "_by_clarabel", lambda self, kappa, answer=answer: (answer, "Nonsense"))
        first = smallest_rate(weights, RELU)
        assert first.status == "Nonsense"
        if first.proof is not None:  # by chance P = Λ = 1 may do, for a large κ
            assert exact.proves(weights, RELU, first.proof, first.kappa)
        else:
            assert first.kappa is None


def test_bad_input_is_refused():
    weights = draw(np.random.default_rng(14), 2, 3)
    batch = VectorWeights(*(None if x is None else np.stack([x, x]) for x in weights))
    for call, message in (
        (lambda: smallest_rate(batch, RELU), "batch"),
        (lambda: smallest_rate(weights, RELU, most=3), "most"),
        (lambda: smallest_rate(weights._replace(W=weights.W[:2]), RELU), "shapes"),
        (lambda: smallest_rate(weights._replace(A=weights.A * np.nan), RELU), "A"),
        (lambda: smallest_rate(weights, RELU, solver="nothing"), "not installed"),
        (lambda: smallest_rate(weights, RELU, solver="osqp"), "semidefinite"),
    ):
        with pytest.raises(CertifyError, match=message):
            call()
