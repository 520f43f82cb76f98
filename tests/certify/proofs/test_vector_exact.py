"""The closed forms for a vector state against all activation patterns, linear programs and trajectories."""

import itertools
from fractions import Fraction

import numpy as np
import pytest
from scipy.optimize import linprog

from certify.errors import CertifyError
from certify.networks.vector import RELU, activation
from certify.proofs import vector_exact as exact
from tests.support import few
from tests.support.vector_networks import draw, draw_scaling, spectral

PHI = ("relu", "leaky:1/8", "tanh")


def patterns(weights, phi):
    """J of every choice of the least and the greatest slopes, exactly."""
    ends = (phi.least, phi.most)
    R, W, A = exact.matrix(weights.R), exact.matrix(weights.W), exact.matrix(weights.A)
    V = None if weights.V is None else exact.matrix(weights.V)

    def chosen(X):
        for d in itertools.product(ends, repeat=len(X)):
            yield [[slope * x for x in row] for slope, row in zip(d, X, strict=True)]

    for first in chosen(W):
        for through in [first] if V is None else chosen(exact.product(V, first)):
            moved = exact.product(A, through)
            yield [[x + y for x, y in zip(*rows, strict=True)] for rows in zip(R, moved, strict=True)]


def norm_of(J, norm, T):
    J = exact.product(exact.product(T, J), exact.inverse(T))
    return max(sum(abs(x) for x in row) for row in (J if norm == "inf" else exact.transposed(J)))


def enumerated(weights, phi, norm, T):
    return max(norm_of(J, norm, T) for J in patterns(weights, phi))


@pytest.mark.parametrize("q", few([1, 2, 3, 4], [1, 3], "thorough"))
@pytest.mark.parametrize("norm", exact.NORMS)
def test_rate_is_the_largest_norm_over_all_patterns(q, norm):
    rng = np.random.default_rng(q)
    for case in range(8):
        weights, phi = draw(rng, q, int(rng.integers(1, 6))), activation(PHI[case % 3])
        T = draw_scaling(rng, q) if case % 2 else exact.identity(q)
        rate = exact.rate(weights, exact.everywhere(weights, phi), norm, T)
        assert rate == enumerated(weights, phi, norm, T)


@pytest.mark.parametrize("norm", exact.NORMS)
def test_two_layers_are_bounded_from_above(norm):
    rng, ratios = np.random.default_rng(5), []
    for case in range(16):
        weights = draw(rng, int(rng.integers(1, 4)), int(rng.integers(1, 5)), int(rng.integers(1, 4)))
        phi, T = activation(PHI[case % 3]), draw_scaling(rng, len(weights.R))
        rate = exact.rate(weights, exact.everywhere(weights, phi), norm, T)
        most = enumerated(weights, phi, norm, T)
        assert rate >= most
        ratios.append(float(rate / most) if most else 1.0)
    assert min(ratios) < 1.0001 and max(ratios) < 10  # sharp for some, and never far


def test_singular_scaling_is_refused():
    weights = draw(np.random.default_rng(0), 2, 3)
    with pytest.raises(CertifyError, match="singular"):
        exact.rate(weights, exact.everywhere(weights, RELU), "inf", [[Fraction(1)] * 2] * 2)


def lemma_by_linear_program(weights) -> float:
    """The smallest factor h on 2 for which p_r and λ_i ≥ 0 dominate: λ_i (1 − ‖W_i‖₁) ≥ ‖A_·i‖₁,

    p_r ≥ Σ_k |R_kr| + Σ_i λ_i |W_ir|,   2h − p_r ≥ Σ_k |R_rk| + Σ_i |A_ri|.
    """
    R, A, W = np.abs(weights.R), np.abs(weights.A), np.abs(weights.W)
    q, n = A.shape
    rows, limits = [], []
    for i in range(n):
        row = np.zeros(q + n + 1)
        row[q + i] = -(1 - W[i].sum())
        rows.append(row)
        limits.append(-A[:, i].sum())
    for r in range(q):
        first, second = np.zeros((2, q + n + 1))
        first[r], first[q : q + n] = -1, W[:, r]
        second[r], second[-1] = 1, -2
        rows += [first, second]
        limits += [-R[:, r].sum(), -R[r].sum() - A[r].sum()]
    solution = linprog(np.eye(q + n + 1)[-1], np.array(rows), limits, bounds=[(0, None)] * (q + n + 1), method="highs")
    return solution.x[-1] if solution.success else np.inf


@pytest.mark.parametrize("cases", [120, pytest.param(2000, marks=pytest.mark.slow)])
def test_gershgorin_is_the_lemma_with_the_best_multipliers(cases):
    rng, without = np.random.default_rng(cases), 0
    for _ in range(cases):
        q, n = int(rng.integers(1, 5)), int(rng.integers(1, 9))
        weights = draw(rng, q, n)
        W = weights.W / np.abs(weights.W).sum(1).clip(1e-9, None)[:, None] * rng.uniform(0, 1.05, (n, 1))
        weights = weights._replace(W=W)
        margin, half = exact.gershgorin(weights)
        if half is None:
            without += 1
            assert margin <= 0 and np.abs(W).sum(1).max() >= 1 - 1e-12
            continue
        assert margin == min(1 - half, 1 - max(sum(abs(Fraction(x)) for x in row) for row in W.tolist()))
        assert lemma_by_linear_program(weights) == pytest.approx(float(half), rel=1e-6, abs=1e-9)
    assert 0 < without < cases / 2


@pytest.mark.parametrize("cases", [60, pytest.param(1000, marks=pytest.mark.slow)])
def test_gershgorin_has_a_proof_of_every_larger_rate(cases):
    rng, proved = np.random.default_rng(cases), 0
    for _ in range(cases):
        q, n = int(rng.integers(1, 5)), int(rng.integers(1, 9))
        weights = draw(rng, q, n)
        weights = weights._replace(W=weights.W / (np.abs(weights.W).sum() + 1) * 1.5)
        half = exact.gershgorin(weights)[1]
        if half is None or half == 0:
            continue
        kappa = half * (1 + Fraction(1, int(rng.choice([1, 2, 10, 10**3, 10**9]))))
        proof = exact.gershgorin_proof(weights, kappa)
        assert exact.proves(weights, RELU, proof, kappa, Fraction(2))
        assert all(x == 0 for r, row in enumerate(proof.metric) for c, x in enumerate(row) if r != c)
        assert exact.gershgorin_proof(weights, half) is None
        proved += 1
    assert proved > cases / 2


def test_gershgorin_has_no_proof_for_two_layers_or_large_rows():
    rng = np.random.default_rng(0)
    assert exact.gershgorin_proof(draw(rng, 2, 3, 2), Fraction(10**9)) is None
    wide = draw(rng, 2, 3)
    assert exact.gershgorin_proof(wide._replace(W=wide.W * 1e3), Fraction(10**9)) is None


def test_a_proof_bounds_the_norm_of_every_pattern():
    """With any P ≻ 0 and Λ ≻ 0 for which M ≻ 0."""
    rng, accepted = np.random.default_rng(3), 0
    for case in range(150):
        q, n, second = int(rng.integers(1, 4)), int(rng.integers(1, 5)), int(rng.integers(0, 4))
        weights, phi = draw(rng, q, n, second), activation(PHI[case % 3])
        root = rng.standard_normal((q, q))
        P = exact.matrix(root @ root.T + np.eye(q))
        P = [[(x + y) / 2 for x, y in zip(*rows, strict=True)] for rows in zip(P, exact.transposed(P), strict=True)]
        sizes = [n] if not second else [n, second]
        lam = [[Fraction(float(x)) for x in rng.uniform(0.1, 3, size)] for size in sizes]
        kappa = Fraction(float(10 ** rng.uniform(0, 3)))
        if not exact.proves(weights, phi, exact.Proof(P, lam), kappa):
            continue
        accepted += 1
        slopes = np.array([[[float(x) for x in row] for row in J] for J in patterns(weights, phi)])
        assert spectral(slopes, P) <= float(kappa) * (1 + 1e-9)
    assert 10 < accepted < 150


def test_proofs_that_do_not_fit_are_refused():
    weights, one = draw(np.random.default_rng(1), 2, 3), Fraction(1)
    P, lam = exact.identity(2), [[one] * 3]
    big = Fraction(10**6)
    small = weights._replace(A=weights.A * 1e-3, W=weights.W * 1e-3)
    assert exact.proves(small, RELU, exact.Proof(P, lam), big)
    for wrong in (
        exact.Proof(P[:1], lam),
        exact.Proof([[one, one], [Fraction(0), one]], lam),
        exact.Proof(P, [[one] * 2]),
        exact.Proof(P, [[one, one, Fraction(0)]]),
        exact.Proof(P, [lam[0], lam[0]]),
        exact.Proof([[-x for x in row] for row in P], lam),
    ):
        assert not exact.proves(small, RELU, wrong, big)
    assert not exact.proves(small, RELU, exact.Proof(P, lam), -big)
