"""What Gershgorin loses to the LMI: the theorem on drawn networks, in fractions, and beside solvers' answers."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from certify.analysis.families import initial_networks, random_networks, signed_networks
from certify.proofs import exact, gauge
from certify.proofs.gauge import loss

WEIGHTS = st.floats(-4, 4, allow_subnormal=False).map(lambda x: x if abs(x) > 1e-6 else 0.0)
NETWORKS = st.integers(1, 8).flatmap(
    lambda n: st.tuples(*(st.lists(WEIGHTS, min_size=n, max_size=n) for _ in range(2)))
)


def slopes(a, w1):
    return [Fraction(x) * Fraction(y) for x, y in zip(a, w1, strict=True)]


@pytest.mark.thorough
@settings(max_examples=300, deadline=None)
@given(NETWORKS)
def test_the_theorem(network):
    """σ/K from its definition lies in [1, 2], and no step of the proof fails."""
    s = slopes(*network)
    found = loss(*network)
    P, N = sum(x for x in s if x > 0), -sum(x for x in s if x < 0)
    if not any(s):
        assert found is None
        return
    assert found.ratio == sum(map(abs, s)) / max(P, N) and found.false == ()
    assert 1 <= found.ratio <= 2
    assert (found.ratio == 1) == (min(P, N) == 0) and (found.ratio == 2) == (P == N)
    n = len(s)
    assert Fraction(2 * (n + 1), n) <= found.simple <= 2 * (n + 1)
    assert 0 <= found.rarer <= Fraction(1, 2) and (found.rarer == 0) == (found.ratio == 1)


@pytest.mark.thorough
@settings(max_examples=200, deadline=None)
@given(NETWORKS, st.lists(st.fractions(Fraction(1, 50), 50), min_size=8, max_size=8))
def test_no_gauge_is_better_than_the_best(network, gauges):
    """Gershgorin's smallest rate after any rescaling is at least 2σ, simple's at least 4(n+1) max |s|."""
    a, w1 = (list(map(Fraction, x)) for x in network)
    if not any(slopes(a, w1)):
        return
    scaled = [x / c for x, c in zip(a, gauges, strict=False)], [x * c for x, c in zip(w1, gauges, strict=False)]
    found, best = exact.conditions(*map(np.array, scaled)), exact.best_gauge(*network)
    for name in ("gershgorin", "simple"):
        assert found[name].rate is None or found[name].rate >= best[name]
    assert loss(*map(np.array, scaled))[:3] == loss(*network)[:3]


@pytest.mark.thorough
@settings(max_examples=100, deadline=None)
@given(NETWORKS, st.data())
def test_no_metric_and_multipliers_prove_the_lmi_at_twice_K(network, data):
    """M ≻ 0 at κ = 2K for no p and Λ that are drawn, and for the closed form's just above."""
    a, w1 = network
    found = loss(a, w1)
    if found is None:
        return
    n, rate = len(a), exact.conditions(a, w1)["lmi"].rate
    positive = st.fractions(Fraction(1, 1000), 1000)
    metric, multipliers = data.draw(positive), data.draw(st.lists(positive, min_size=n, max_size=n))
    assert exact.definiteness(exact.matrix(a, w1, metric, multipliers, rate, 1)) < 1
    assert exact.proves("lmi", a, w1, exact.multipliers("lmi", a, w1, rate * 1.001), rate * Fraction(1.001))


@settings(max_examples=150, deadline=None)
@given(NETWORKS, st.floats(0.02, 1))
def test_gershgorin_alone_certifies_nothing(network, size):
    a, w1 = np.array(network[0]) * size, np.array(network[1])
    found = exact.conditions(a, w1)
    assert found["lmi"].margin > 0 or found["gershgorin"].margin <= 0
    assert found["lmi"].margin > 0 or exact.best_gauge(a, w1)["gershgorin"] >= 1


def test_the_extremes_are_attained():
    one, both = loss([1, 2, 3], [1, 1, 1]), loss([1, -1], [0.5, 0.5])
    assert (one.ratio, one.rarer, both.ratio, both.rarer) == (1, 0, 2, Fraction(1, 2))
    assert loss([1, 1, 1, 1], [1, 1, 1, 1]).simple == Fraction(2 * 5, 4)  # equal slopes: the least
    assert loss([1, 0, 0, 0], [1, 1, 1, 1]).simple == 2 * 5  # one slope: the most
    assert loss([0.0, 1.0], [1.0, 0.0]) is None


@pytest.mark.parametrize(
    ("name", "wrong", "fails"),
    [
        ("best_gauge", lambda a, w: {"gershgorin": 3 * sum(map(abs, slopes(a, w))), "simple": Fraction(99)},
         "Gershgorin reaches 2σ"),
        ("multipliers", lambda *_: None, "the LMI holds just above 2K"),
    ],
)  # fmt: skip
def test_a_false_closed_form_is_found(monkeypatch, name, wrong, fails):
    monkeypatch.setattr(gauge, name, wrong)
    assert any(each.startswith(fails) for each in loss([0.5, -0.25], [1.0, 0.5]).false)


def test_a_false_rate_of_the_lmi_is_found(monkeypatch):
    def narrower(a, w1):
        found = exact.conditions(a, w1)
        return {**found, "lmi": found["lmi"]._replace(rate=found["lmi"].rate * Fraction(3, 2))}

    monkeypatch.setattr(gauge, "conditions", narrower)
    assert "the LMI does not hold at 2K" in loss([0.5, -0.25], [1.0, 0.5]).false


def test_the_solver_finds_the_same_quotient():
    """By Clarabel's smallest rate, which knows no closed form."""
    pytest.importorskip("cvxpy")
    from certify.search.lmi import LMI

    problem = LMI(6, "lmi")
    for weights in random_networks(6, 6, np.random.default_rng(3)):
        rate, _ = problem.smallest_rate(weights.a, weights.w1)
        sigma = float(np.abs(weights.a * weights.w1).sum())
        assert 2 * sigma / rate == pytest.approx(float(loss(weights.a, weights.w1).ratio), rel=1e-4)


def test_signed_networks_have_as_many_signs_as_asked():
    rng = np.random.default_rng(0)
    for rarer in (0, 3, 5):
        found = [loss(w.a, w.w1) for w in signed_networks(4, 10, rarer, rng)]
        assert all(each.rarer == Fraction(rarer, 10) for each in found)
        assert all((each.ratio == 1) == (rarer == 0) for each in found)
    assert {w.W2.shape for w in initial_networks(2, 3, rng, inputs=6)} == {(3, 6)}
