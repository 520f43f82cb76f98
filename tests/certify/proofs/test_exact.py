"""Rational arithmetic decides what floats cannot, and agrees with minors, eigenvalues and patterns."""

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest

from certify.proofs import exact
from certify.proofs.exact import CORNER, Multipliers, definiteness, matrix, multipliers, proves
from certify.proofs.rounding import above, below, float_above, float_below
from tests.support import cases

ONE = Fraction(1)


def random_matrix(generator, n: int, entries: int = 3) -> np.ndarray:
    """Symmetric, integers; often singular."""
    M = generator.integers(-entries, entries + 1, (n, n))
    return M + M.T


def rationals(M) -> list[list[Fraction]]:
    return [[Fraction(x) for x in row] for row in np.asarray(M).tolist()]


def determinant(M: list[list[Fraction]]) -> Fraction:
    """By the first row."""
    if not M:
        return ONE
    return sum((-1) ** j * x * determinant([row[:j] + row[j + 1 :] for row in M[1:]]) for j, x in enumerate(M[0]))


def by_minors(M: list[list[Fraction]]) -> int:
    """Definiteness by Sylvester: all leading minors positive, all principal minors at least zero."""
    size = range(len(M))
    if all(determinant([row[:k] for row in M[:k]]) > 0 for k in range(1, len(M) + 1)):
        return 1
    subsets = itertools.chain.from_iterable(itertools.combinations(size, k) for k in range(1, len(M) + 1))
    return 0 if all(determinant([[M[i][j] for j in rows] for i in rows]) >= 0 for rows in subsets) else -1


def slope(a, w1) -> Fraction:
    """K, over all patterns."""
    s = [Fraction(float(x)) * Fraction(float(y)) for x, y in zip(a, w1, strict=True)]
    return max(abs(sum(part)) for k in range(len(s) + 1) for part in itertools.combinations(s, k))


def networks(count: int, seed: int = 0, sizes=(1, 2, 5, 12)):
    """Weights of spread sizes for which each condition holds for some; some are zero."""
    generator = np.random.default_rng(seed)
    for k in range(count):
        n = sizes[k % len(sizes)]
        a = generator.standard_normal(n) * 10 ** generator.uniform(-2, 1.5) / n
        w1 = generator.uniform(-1, 1, n) * 10 ** generator.uniform(-0.7, 0.1)
        a[generator.random(n) < 0.1] = 0
        w1[generator.random(n) < 0.1] = 0
        yield a, w1


def test_definiteness_agrees_with_the_minors():
    generator, counts = np.random.default_rng(0), {1: 0, 0: 0, -1: 0}
    for k in range(600):
        n = 1 + k % 4
        M = random_matrix(generator, n) + generator.integers(0, 9) * np.eye(n, dtype=int)
        if k % 3 == 0:  # a Gram matrix, singular where it has fewer columns than rows
            B = generator.integers(-2, 3, (n, generator.integers(1, 5)))
            M = B @ B.T
        kind = definiteness(rationals(M))
        assert kind == by_minors(rationals(M)), M
        counts[kind] += 1
    assert min(counts.values()) > 80


def test_definiteness_tells_a_singular_matrix_from_its_neighbours():
    """A Gram matrix of floats, exactly singular, whose least eigenvalue is rounding noise; ± 2⁻²⁰⁰ is seen."""
    generator = np.random.default_rng(2)
    for n in (2, 5, 9):
        B = [[Fraction(x) for x in row] for row in generator.standard_normal((n, n - 1)).tolist()]
        M = [[sum(x * y for x, y in zip(one, other, strict=True)) for other in B] for one in B]
        assert definiteness(M) == 0
        for tiny, expected in ((Fraction(1, 2**200), 1), (-Fraction(1, 2**200), -1)):
            assert (
                definiteness([[x + tiny * (i == j) for j, x in enumerate(row)] for i, row in enumerate(M)]) == expected
            )


def test_definiteness_of_a_zero_pivot():
    assert definiteness(rationals([[1, 0], [0, 0]])) == 0
    assert definiteness(rationals([[0, 1], [1, 0]])) == -1
    assert definiteness(rationals([[5, 1], [1, 0]])) == -1
    assert definiteness(rationals([[0, 0], [0, 0]])) == 0


def test_matrix_is_that_of_the_paper():
    a, w1, p, lam, rate = [0.5, -2.0], [1.5, 0.25], Fraction(3, 4), [Fraction(1, 3), Fraction(5)], Fraction(2, 7)
    for corner in (1, 2):
        M = np.array([[float(x) for x in row] for row in matrix(a, w1, p, lam, rate, corner)])
        L, a_, w_ = np.diag([1 / 3, 5]), np.array(a) / (2 / 7), np.array(w1)
        column = np.column_stack([-a_, -L @ w_])
        np.testing.assert_allclose(M, np.block([[np.diag([1.25, 0.75]), column.T], [column, corner * L]]), rtol=1e-15)


def test_conditions_are_those_of_the_paper():
    for a, w1 in networks(60, sizes=(1, 2, 5)):
        n, K = len(a), slope(a, w1)
        results = exact.conditions(a, w1)
        assert list(results) == list(CORNER)
        assert results["exact"] == (1 - K, K) and results["lmi"] == (1 - 2 * K, 2 * K)
        sizes = [(abs(Fraction(x)), abs(Fraction(y))) for x, y in zip(a.tolist(), w1.tolist(), strict=True)]
        assert (results["simple"].margin > 0) == all((n + 1) * x + y < 1 for x, y in sizes)
        inside = all(y < 1 for _, y in sizes)
        half = sum(x / (1 - y) for x, y in sizes) / 2 if inside else None
        assert (results["gershgorin"].margin > 0) == (inside and half < 1)
        assert results["gershgorin"].rate == half
        rate = results["simple"].rate
        assert (rate is None) == (not inside)
        if rate:
            assert max((n + 1) * x / rate + y for x, y in sizes) == 1
        P, N = exact.extreme_slopes(a, w1)
        assert max(P, N) == K and P - N == sum(
            Fraction(x) * Fraction(y) for x, y in zip(a.tolist(), w1.tolist(), strict=True)
        )


@pytest.mark.parametrize("condition", CORNER)
@pytest.mark.parametrize("rate", [ONE, Fraction(7, 8), Fraction(0.3)])
@cases(40, 80)
def test_closed_form_multipliers_prove_what_holds_and_nothing_else(condition, rate, count):
    held = 0
    for a, w1 in networks(count, seed=3):
        smallest = exact.conditions(a, w1)[condition].rate
        proof = multipliers(condition, a, w1, rate)
        assert (proof is not None) == (smallest is not None and smallest < rate)
        if proof is not None:
            assert proves(condition, a, w1, proof, rate)
            held += 1
        elif smallest is not None:  # what proves a larger rate proves no smaller one
            proof = multipliers(condition, a, w1, 2 * smallest)
            assert proves(condition, a, w1, proof, 2 * smallest) and not proves(condition, a, w1, proof, rate)
    assert 0.1 * count < held < 0.98 * count


@pytest.mark.parametrize("condition", CORNER)
def test_closed_form_multipliers_prove_up_to_the_edge(condition):
    cases = {
        "two signs": ([0.5, -0.25, 0.125], [0.5, 0.75, -0.25]),
        "a = 0": ([0.5, 0.0], [0.5, 0.75]),
        "w = 0": ([0.5, 0.25], [0.5, 0.0]),
        "both": ([0.5, 0.0, 0.25], [0.5, 0.0, 0.25]),
        "one": ([3.0], [0.25]),
    }
    tiny = Fraction(1, 10**30)
    for name, (a, w1) in cases.items():
        smallest = exact.conditions(a, w1)[condition].rate
        assert multipliers(condition, a, w1, smallest) is None
        assert multipliers(condition, a, w1, smallest * (1 - tiny)) is None
        rate = smallest * (1 + tiny)
        assert proves(condition, a, w1, multipliers(condition, a, w1, rate), rate), name


def test_nothing_is_proved_by_what_was_tampered_with():
    a, w1 = [0.2, -0.1], [0.3, 0.25]
    for condition in CORNER:
        good = multipliers(condition, a, w1)
        assert proves(condition, a, w1, good)
        lam = good.multipliers
        for bad in (
            Multipliers(Fraction(2), lam),
            Multipliers(Fraction(0), lam),
            Multipliers(-good.metric, lam),
            Multipliers(good.metric, [-lam[0], lam[1]]),
            Multipliers(good.metric, [Fraction(0), lam[1]]),
            Multipliers(good.metric, [1000 * lam[0], lam[1]]),
            Multipliers(good.metric, lam[:1]),
            Multipliers(good.metric, [*lam, lam[0]]),
        ):
            assert not proves(condition, a, w1, bad), (condition, bad)
        for rate in (Fraction(0), -ONE, Fraction(1, 1000)):
            assert not proves(condition, a, w1, good, rate)
        assert not proves(condition, [2.0, -0.1], w1, good)
    best = multipliers("gershgorin", a, w1)
    assert not proves("simple", a, w1, best), "the theorem's p and Λ are p = 1, λ = 1/(n + 1) and no others"
    gauge = [0.2 * 64, -0.1 * 64], [0.3 / 64, 0.25 / 64]
    assert proves("lmi", *gauge, multipliers("lmi", *gauge)) and multipliers("gershgorin", *gauge) is None
    assert not proves("gershgorin", *gauge, multipliers("lmi", *gauge)), "M ≻ 0 is not the lemma"
    for p in (Fraction(7, 4), Fraction(1, 8)):  # 2 − p ≤ Σ|a_i|, p ≤ Σ λ_i |w_i|
        proof = best._replace(metric=p, multipliers=[Fraction(1, 2)] * 2)
        assert proves("lmi", a, w1, proof) and not proves("gershgorin", a, w1, proof)


def test_two_lambda_and_semidefinite_passes_the_identity():
    """a = w₁ = 1, b = 0, a continuum of equilibria: M ⪰ 0 with 2Λ. So only ≻ proves, and Λ refuses it in any case."""
    a, w1 = [1.0], [1.0]
    assert definiteness(matrix(a, w1, ONE, [ONE], corner=2)) == 0
    assert not proves("exact", a, w1, Multipliers(ONE, [ONE])) and multipliers("exact", a, w1) is None
    for lam in np.linspace(0.01, 5, 50):
        for p in np.linspace(0, 2, 9):
            assert definiteness(matrix(a, w1, Fraction(p), [Fraction(lam)], corner=1)) == -1
            assert definiteness(matrix(a, w1, Fraction(p), [Fraction(lam)], corner=2)) < 1


def test_lists_arrays_and_single_floats_are_taken_exactly():
    a = np.array([0.1, 0.2], dtype=np.float32)
    assert exact.fractions(a) == [Fraction(float(a[0])), Fraction(float(a[1]))] != exact.fractions([0.1, 0.2])
    with pytest.raises(ValueError):
        exact.extreme_slopes([0.1], [0.1, 0.2])


def numbers(count: int):
    rng = np.random.default_rng(0)
    for _ in range(count):
        size = Fraction(10) ** int(rng.integers(-400, 400)) if rng.random() < 0.3 else 1
        yield size * Fraction(int(rng.integers(-(10**9), 10**9)), int(rng.integers(1, 10**9)))
    for k in (1, 27, 28, 29, 60, 1500):
        yield from (1 - Fraction(1, 10**k), 1 + Fraction(1, 10**k), Fraction(1, 10**k) - 1, -1 - Fraction(1, 10**k))


@cases(1000, 3000)
def test_decimals_bound_and_are_near(count):
    for x in numbers(count):
        for digits in (3, 7, 40):
            high, low = Fraction(above(x, digits)), Fraction(below(x, digits))
            assert low <= x <= high and (high - low) <= abs(x) * Fraction(2, 10 ** (digits - 1))
            assert high < 1 or x >= 1  # what is below 1 reads so


def test_floats_bound_and_are_the_nearest_that_do():
    for x in numbers(3000):
        high, low = float_above(x), float_below(x)
        assert low <= x <= high and (low == high == x or math.nextafter(low, math.inf) == high)


@pytest.mark.parametrize("size", [0, Fraction(1, 10**400)])  # the second is below every positive float
def test_no_bound_is_minus_zero(size):
    for x in (float_above(Fraction(-size)), float_below(Fraction(size))):
        assert x == 0 and math.copysign(1, x) == 1


@pytest.mark.parametrize("x", [0.0, 1.0, -1.0, 0.5, 100.0, 2.0**-10])
def test_what_is_short_stays_as_it_is(x):
    assert Fraction(above(x, 20)) == Fraction(below(x, 20)) == Fraction(x) == Fraction(float_above(Fraction(x)))
