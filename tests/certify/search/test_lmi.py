"""Solvers agree with the closed forms, outside a band of 1e-5, and what they say is not taken for a proof."""

import sys
from fractions import Fraction

import cvxpy as cp
import numpy as np
import pytest
import torch
from scipy.optimize import linprog

from certify.errors import CertifyError
from certify.proofs import exact
from certify.search.lmi import LMI
from certify.training import conditions
from tests.support import cases

SCALE = {"lmi": 2, "exact": 1}  # the condition's rate is so many K
BAND = 1e-5


def exact_rate(a, w1) -> Fraction:
    """K, over the signs of the slopes."""
    s = [Fraction(x) * Fraction(y) for x, y in zip(a.tolist(), w1.tolist(), strict=True)]
    return max(sum(x for x in s if x > 0), sum(-x for x in s if x < 0), Fraction(0))


def networks(count: int, condition: str, sizes=(1, 2, 3, 8, 20), seed: int = 0):
    """Weights of spread sizes, some zero, with a rate on either side of 1, from 1e-5 to 0.8 away from it."""
    generator = np.random.default_rng(seed)
    while count:
        n = sizes[count % len(sizes)]
        a, w1 = generator.standard_normal((2, n)) * 10 ** generator.uniform(-2, 2, (2, n))
        for zeroed in (a, w1):
            zeroed[generator.random(n) < 0.1] = 0
        if rate := SCALE[condition] * float(exact_rate(a, w1)):
            away = generator.choice([-1, 1]) * 10 ** generator.uniform(-5, -0.1)
            yield a * (1 + away) / rate, w1
            count -= 1


def referee(condition: str, count: int, seed: int = 0) -> dict[str, int]:
    """Verdicts and smallest rates of many networks against K; the count of each verdict."""
    problems, counts = {}, {}
    for a, w1 in networks(count, condition, seed=seed):
        problem = problems.setdefault(len(a), LMI(len(a), condition))
        rate = SCALE[condition] * exact_rate(a, w1)
        found = problem.solve(a, w1)
        counts[found.verdict] = counts.get(found.verdict, 0) + 1
        if found.verdict == "certified":
            assert rate < 1
        if abs(rate - 1) > BAND:
            assert found.verdict == ("certified" if rate < 1 else "not certified"), (a, w1, found)
        smallest, proof = problem.smallest_rate(a, w1)
        assert abs(smallest / float(rate) - 1) <= 5e-6
        assert proof.verdict == "certified" and Fraction(proof.rate) > rate
    return counts


@pytest.mark.thorough
@pytest.mark.parametrize("condition", ["lmi", "exact"])
@cases(20, 40)
def test_solver_agrees_with_the_closed_form(condition, count):
    counts = referee(condition, count)
    assert min(counts["certified"], counts["not certified"]) > 0.2 * count


@pytest.mark.slow
@pytest.mark.parametrize("condition", ["lmi", "exact"])
def test_solver_agrees_with_the_closed_form_on_a_thousand(condition):
    counts = referee(condition, 1000, seed=1)
    assert min(counts["certified"], counts["not certified"]) > 300


def gershgorin_by_linear_program(a, w1) -> float:
    """The largest slack t of the paper's lemma over p and Λ ≥ 0, the row of neuron i relaxed by |1 − |w_{1i}||:

    λ_i (1 − |w_{1i}|) ≥ |a_i| + t |1 − |w_{1i}||,   2 − p ≥ Σ|a_i| + t,   p ≥ Σ λ_i |w_{1i}| + t
    """
    n, size, weight = len(a), np.abs(a), np.abs(w1)
    columns = np.zeros((n + 2, n + 2))  # of p, Λ, t
    columns[:n, 1:-1], columns[:n, -1] = -np.diag(1 - weight), np.abs(1 - weight)
    columns[n, [0, -1]] = 1
    columns[n + 1, 0], columns[n + 1, 1:-1], columns[n + 1, -1] = -1, weight, 1
    limits = np.concatenate([-size, [2 - size.sum(), 0]])
    bounds = [(None, None)] + [(0, None)] * n + [(None, 1)]
    options = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    found = linprog(-np.eye(n + 2)[-1], columns, limits, bounds=bounds, method="highs", options=options)
    return found.x[-1] if found.success else -np.inf  # with |w_1i| = 1 no t may do


def check_gershgorin(count: int, seed: int):
    generator, held = np.random.default_rng(seed), 0
    for _ in range(count):
        n = generator.integers(1, 9)
        a, w1 = generator.standard_normal(n), generator.uniform(-1, 1, n)
        if generator.random() < 0.1:
            w1[0] = generator.choice([-1, 1]) * (1 + abs(generator.standard_normal()))
        if generator.random() < 0.2:
            (a if generator.random() < 0.5 else w1)[-1] = 0
        half = (np.abs(a) / np.abs(1 - np.abs(w1))).sum() / 2
        if half > 0:
            a *= (1 + generator.choice([-1, 1]) * 10 ** generator.uniform(-4.9, -0.1)) / half
        t = gershgorin_by_linear_program(a, w1)
        margin = conditions.gershgorin(torch.from_numpy(a), torch.from_numpy(w1)).margin.item()
        rate = exact.conditions(a, w1)["gershgorin"].rate
        assert abs(margin) > BAND / 2 and (rate is None or abs(rate - 1) > BAND)
        assert (t > 0) == (margin > 0) == (rate is not None and rate < 1), (a, w1, t, margin)
        held += t > 0
    assert 0.25 * count < held < 0.75 * count


@cases(100, 300)
def test_gershgorin_is_the_lemma_with_the_best_multipliers(count):
    check_gershgorin(count, seed=0)


@pytest.mark.slow
def test_gershgorin_is_the_lemma_with_the_best_multipliers_on_five_thousand():
    check_gershgorin(5000, seed=1)


def test_lambda_is_without_bound_or_free_where_a_weight_is_zero():
    cases = {
        "w = 0 ≠ a": ([3.0, 0.4], [0.0, 1.0]),
        "dead, w > 1": ([0.0, 0.4], [5.0, 1.0]),
        "no neuron": ([0.0, 0.0], [0.0, 0.0]),
        "far apart": ([4e-9, 0.2], [1e8, -1e-8]),
        "tiny": ([1e-200, 0.3], [1e-200, 1.0]),
        "subnormal": ([1.0, 0.3], [1e-320, 1.0]),
    }
    for condition in ("lmi", "exact"):
        problem = LMI(2, condition)
        for name, (a, w1) in cases.items():
            a, w1 = np.array(a), np.array(w1)
            rate = SCALE[condition] * exact_rate(a, w1)
            found = problem.solve(a, w1)
            assert found.verdict == ("certified" if rate < 1 else "not certified"), name
            smallest, proof = problem.smallest_rate(a, w1)
            assert abs(smallest - float(rate)) <= 5e-6 * rate + 1e-4 * (rate == 0) and proof.verdict == "certified"
            near = problem.solve([30.0, 1 - 1e-5], [0.0, 1 / SCALE[condition]])
            assert near.verdict == "certified" and near.multipliers[0] > 1e5


def test_one_neuron_at_the_edge():
    for condition, factor in SCALE.items():
        problem = LMI(1, condition)
        verdicts = [problem.solve([(1 + away) / factor], [1.0]).verdict for away in (-1e-5, -1e-12, 0, 1e-12, 1e-5)]
        assert verdicts[0] == "certified" and verdicts[-1] == "not certified"
        assert verdicts[2] == verdicts[3] == "unknown", "no p and Λ prove it, and the solver cannot tell"


def test_margin_is_the_least_eigenvalue_and_no_multipliers_have_a_larger_one():
    generator = np.random.default_rng(0)
    for condition, corner in (("lmi", 1), ("exact", 2)):
        for a, w1 in networks(5, condition, sizes=(3,)):
            if not (a * w1).all():
                continue
            found = LMI(3, condition).solve(a, w1)
            c = np.sqrt(np.abs(a / w1))

            def least(p, multipliers, a=a / c, w1=w1 * c, corner=corner):
                arrow = np.vstack([-a, -w1 * multipliers])
                M = np.block([[np.diag([2 - p, p]), arrow], [arrow.T, corner * np.diag(multipliers)]])
                return np.linalg.eigvalsh(M)[0]

            best = found.multipliers / c**2
            assert abs(least(found.metric, best) - found.margin) < 1e-6
            for size in 10 ** generator.uniform(-4, 0, 300):
                other = best * np.exp(size * generator.standard_normal(3))
                assert least(found.metric + size * generator.standard_normal(), other) < found.margin + 1e-6


def test_a_network_and_its_rescaled_equal_have_one_verdict_and_margin():
    for condition in SCALE:
        problem = LMI(8, condition)
        for a, w1 in networks(5, condition, sizes=(8,)):
            c = 2.0 ** np.arange(-12, 12, 3)
            found, other = problem.solve(a, w1), problem.solve(a / c, w1 * c)
            assert found.verdict == other.verdict and abs(found.margin - other.margin) < 1e-6


def test_neurons_without_slope_leave_the_margin():
    a, w1 = [0.3, -0.2], [1.0, 0.5]
    for condition in SCALE:
        few, more = LMI(2, condition).solve(a, w1), LMI(5, condition).solve([*a, 3.0, 0.0, 0.0], [*w1, 0.0, 5.0, 0.0])
        assert few.verdict == more.verdict == "certified" and abs(few.margin - more.margin) < 1e-6


def test_rate_divides_a():
    problem = LMI(2, "exact")
    a, w1 = [1.0, 0.5], [0.5, -3.0]  # K = 1.5
    verdicts = [problem.solve(a, w1, rate).verdict for rate in (1.0, 1.4999, Fraction(15001, 10000), 2.0)]
    assert verdicts == ["not certified", "not certified", "certified", "certified"]


@cases(2, 4)
def test_problems_are_parametrised_and_solve_again_as_if_new(count):
    for strict in (True, False):
        old = LMI(3, "exact", strict=strict)
        assert old.problem.is_dcp(dpp=True) and old.rate_problem.is_dcp(dpp=True)
        for a, w1 in networks(count, "exact", sizes=(3,)):
            again, fresh = old.solve(a, w1), LMI(3, "exact", strict=strict).solve(a, w1)
            assert again.verdict == fresh.verdict
            if strict:
                assert abs(again.margin - fresh.margin) < 1e-7
                rates = old.smallest_rate(a, w1)[0], LMI(3, "exact").smallest_rate(a, w1)[0]
                np.testing.assert_allclose(*rates, rtol=1e-6)


def test_plain_feasibility_passes_what_does_not_contract():
    """The identity, relu(x) on x ≥ 0, and networks beyond the edge pass ⪰ 0 with 2Λ; none is called certified."""
    identity = LMI(1, "exact", strict=False).solve([1.0], [1.0])
    assert identity.verdict == "feasible" and abs(identity.margin) < 1e-7
    assert LMI(1, "exact").solve([1.0], [1.0]).verdict == "unknown"
    assert LMI(1, "lmi", strict=False).solve([1.0], [1.0]).verdict == "infeasible"  # Λ keeps its factor of two
    plain, strict = LMI(5, "exact", strict=False), LMI(5, "exact")
    words = {"optimal": "feasible", "optimal_inaccurate": "feasible", "infeasible": "infeasible"}
    for beyond, least in ((1e-8, 10), (1e-6, 0)):
        verdicts = []
        for seed in range(20):
            a, w1 = np.random.default_rng(seed).standard_normal((2, 5))
            a *= (1 + beyond) / float(exact_rate(a, w1))
            assert exact_rate(a, w1) > 1
            found = plain.solve(a, w1)
            assert found.verdict == words.get(found.status, "unknown")
            assert strict.solve(a, w1).verdict != "certified"
            verdicts.append(found.verdict)
        assert verdicts.count("feasible") >= least
    inside = plain.solve(0.9 * a, w1)
    assert inside.verdict == "feasible" and inside.metric > 0
    assert plain.solve(1.1 * a, w1).verdict == "infeasible"


def test_a_solver_that_lies_or_fails_leaves_it_unknown(monkeypatch, capfd):
    problem, truly = LMI(2, "exact"), cp.Problem.solve
    assert problem.solve([0.4, 0.4], [1.0, 1.0]).verdict == "certified"

    def lie(self, **options):
        truly(self, **options)
        for variable in self.variables():
            variable.save_value(2 * np.abs(variable.value))

    monkeypatch.setattr(cp.Problem, "solve", lie)
    found = problem.solve([0.4, 0.4], [1.0, 1.0])
    assert found.margin > 0 and found.status == "optimal" and found.verdict == "unknown"

    def nan(self, **options):
        truly(self, **options)
        for variable in self.variables():
            variable.save_value(np.nan * variable.value)

    monkeypatch.setattr(cp.Problem, "solve", nan)
    assert problem.solve([0.4, 0.4], [1.0, 1.0]).verdict == "unknown"

    def fail(self, **options):
        raise cp.SolverError("it failed\nat great length")

    monkeypatch.setattr(cp.Problem, "solve", fail)
    for strict in (problem, LMI(2, "lmi", strict=False)):
        found = strict.solve([0.4, 0.4], [1.0, 1.0])
        assert found.verdict == "unknown" and found.status == "SolverError: it failed"
        assert np.isnan(found.margin) and np.isnan(found.multipliers).all()  # not those of the solve before
    rate, found = problem.smallest_rate([0.4, 0.4], [1.0, 1.0])
    assert np.isnan(rate) and found.verdict == "unknown"
    assert capfd.readouterr() == ("", "")


def test_another_solver_by_name():
    if "SCS" not in cp.installed_solvers():
        pytest.skip("SCS is not installed")
    problem = LMI(2, "exact", "scs", eps_abs=1e-9, eps_rel=1e-9)
    assert problem.solve([0.5, 0.4], [1.0, 1.0]).verdict == "certified"
    assert problem.solve([0.5, 0.6], [1.0, 1.0]).verdict == "not certified"
    assert abs(problem.smallest_rate([0.5, 0.4], [1.0, 1.0])[0] - 0.9) < 1e-4


def test_what_is_not_there_is_told(monkeypatch):
    with pytest.raises(CertifyError, match=r"found NOPE, which is not installed: expected one of .*CLARABEL"):
        LMI(2, "exact", solver="nope")
    with pytest.raises(CertifyError, match=r"OSQP takes no semidefinite programs: expected one of .*CLARABEL"):
        LMI(2, "exact", solver="OSQP")
    with pytest.raises(CertifyError, match="found 'simple', expected lmi or exact"):
        LMI(2, "simple")
    with pytest.raises(CertifyError, match="found 0, expected 1 or more"):
        LMI(0)
    problem = LMI(2)
    for a, w1, told in (
        ([0.1], [0.1], "expected \\(2,\\)"),
        ([0.1, np.nan], [1, 1], "NaN or infinite"),
        ([1, 1], [1, np.inf], "NaN or infinite"),
        ([1e200, 1], [1e200, 1], "infinite values or products"),
    ):
        for call in (problem.solve, problem.smallest_rate):
            with pytest.raises(CertifyError, match=told):
                call(a, w1)
    with pytest.raises(CertifyError, match="infinite values or products"):
        problem.smallest_rate([1, 0], [1e-320, 1])
    for rate in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(CertifyError, match="expected a finite number above 0"):
            problem.solve([1, 1], [1, 1], rate)
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    with pytest.raises(CertifyError, match=r"pip install 'usvlearn\[lmi\]'"):
        LMI(2)
