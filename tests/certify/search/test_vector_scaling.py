"""The best scaling of a vector state: never worse than none, exact, and the best where the best is known."""

import time
from fractions import Fraction

import numpy as np
import pytest
from scipy.optimize import minimize

from certify.networks.vector import RELU, VectorWeights, activation, check
from certify.proofs import vector_exact as exact
from certify.search.vector_scaling import Scaling, Values, best_diagonal, best_scaling, starts
from tests.support import cases, few
from tests.support.vector_networks import draw, draw_scaling

PHI = ("relu", "leaky:1/8", "tanh")


def linear(R) -> VectorWeights:
    """x⁺ = R x, with one neuron that does nothing."""
    q = len(R)
    return check(VectorWeights(R, np.zeros((q, 1)), np.zeros((1, q)), [[0.0]], [0.0]))


def unscaled(weights, phi) -> Fraction:
    return min(exact.rate(weights, exact.everywhere(weights, phi), norm) for norm in exact.NORMS)


def test_floats_of_the_search_are_the_exact_rates():
    rng = np.random.default_rng(0)
    for case in range(60):
        weights = draw(rng, int(rng.integers(1, 5)), int(rng.integers(1, 8)), int(rng.integers(0, 4)))
        phi, T = activation(PHI[case % 3]), draw_scaling(rng, len(weights.R))
        for norm in exact.NORMS:
            rate = Values(weights, phi, norm).largest(np.array(T, dtype=float))
            expected = exact.rate(weights, exact.everywhere(weights, phi), norm, T)
            assert rate == pytest.approx(float(expected), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("norm", exact.NORMS)
def test_best_diagonal_is_the_spectral_radius_of_a_positive_matrix(norm):
    rng = np.random.default_rng(1)
    for q, size in ((1, 1.0), (2, 1.0), (3, 1e-9), (3, 1e9), (6, 1.0)):
        R = size * rng.uniform(0.1, 1, (q, q)) * 10 ** rng.uniform(-1, 1, (q, 1))
        values = Values(linear(R), RELU, norm)
        radius = np.abs(np.linalg.eigvals(R)).max()
        assert values.largest(np.diag(best_diagonal(values))) == pytest.approx(radius, rel=1e-6)


@pytest.mark.parametrize("norm", few(exact.NORMS, ["one"], "thorough"))
@cases(3, 6)
def test_no_other_diagonal_is_better(norm, count):
    """By a direct search over log t from the best one and from random ones."""
    rng = np.random.default_rng(2)
    for case in range(count):
        weights = draw(rng, 3, 6, 4 if case % 3 == 2 else 0)
        values = Values(weights, activation(PHI[case % 3]), norm)
        best = best_diagonal(Values(weights, activation(PHI[case % 3]), norm))
        K = values.largest(np.diag(best))
        for start in (np.log(best[1:] / best[0]), *rng.standard_normal((3, 2))):
            result = minimize(
                lambda t, values=values: values.largest(np.diag(np.exp([0.0, *t]))),
                start,
                method="Nelder-Mead",
                options={"xatol": 1e-9, "fatol": 1e-12, "maxiter": 2000},
            )
            assert K <= result.fun * (1 + 1e-5)


def test_full_scaling_finds_the_basis_of_a_linear_map():
    """Its rate is the spectral radius where the eigenvalues are real; the identity's is far above."""
    rng = np.random.default_rng(3)
    for q in (2, 3):
        basis = rng.standard_normal((q, q)) + 2 * np.eye(q)
        weights = linear(basis @ np.diag(rng.uniform(0.5, 0.9, q)) @ np.linalg.inv(basis))
        radius = np.abs(np.linalg.eigvals(weights.R)).max()
        scaling = best_scaling(weights, RELU)
        assert radius * (1 - 1e-9) <= scaling.rate <= radius * 1.01 and unscaled(weights, RELU) > 1.1 * scaling.rate


@pytest.mark.thorough
@cases(6, 9)
def test_best_scaling_is_exact_and_never_worse_than_none(count):
    rng, kinds = np.random.default_rng(4), set()
    for case in range(count):
        weights = draw(rng, int(rng.integers(1, 4)), int(rng.integers(1, 7)), int(rng.integers(0, 3)))
        phi = activation(PHI[case % 3])
        scaling = best_scaling(weights, phi)
        assert scaling.rate == exact.rate(weights, exact.everywhere(weights, phi), scaling.norm, scaling.T)
        diagonal = best_scaling(weights, phi, full=False)
        assert scaling.rate <= diagonal.rate <= unscaled(weights, phi)
        assert max(x.denominator for row in scaling.T for x in row) <= 2**24
        kinds.add(scaling.kind)
    assert {"none", "full"} <= kinds


@pytest.mark.thorough
def test_the_search_gives_the_same_result_again_and_ends_in_time():
    weights = draw(np.random.default_rng(5), 3, 6)
    assert best_scaling(weights, RELU, 60.0) == best_scaling(weights, RELU, 60.0)
    start = time.process_time()
    scaling = best_scaling(draw(np.random.default_rng(5), 6, 40), RELU, seconds=0.0)
    assert time.process_time() - start < 30 and scaling.kind in ("none", "diagonal")  # no search at all


@pytest.mark.parametrize("size", [1e-150, 1e-30, 1e30])
def test_weights_of_any_size(size):
    weights = draw(np.random.default_rng(6), 2, 4)
    weights = weights._replace(R=weights.R * 0, A=weights.A * size)
    scaling = best_scaling(weights, RELU)
    assert 0 < scaling.rate <= unscaled(weights, RELU)


def test_zero_slopes_have_the_rate_zero():
    assert best_scaling(linear(np.zeros((2, 2))), RELU) == Scaling("inf", exact.identity(2), Fraction(0), "none")


def test_the_search_starts_from_square_roots_of_a_metric():
    rng = np.random.default_rng(7)
    weights, root = draw(rng, 3, 10), rng.standard_normal((3, 3))
    values, P = Values(weights, RELU, "inf"), root @ root.T
    with_metric, without = (list(starts(weights, RELU, values, metric)) for metric in (P, None))
    roots = [T for T in with_metric if not any(np.array_equal(T, other) for other in without)]
    assert len(with_metric) == len(without) + len(roots) and len(roots) > 2
    for T in roots:
        np.testing.assert_allclose(T.T @ T, P, rtol=1e-9, atol=1e-12)
