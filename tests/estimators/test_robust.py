"""Robust: outliers clipped, changes let through, what is not finite refused; untouched where nothing is wrong."""

import math

import numpy as np
import pytest
import torch
from scipy import integrate, stats

from tests.support import at, leaves, random_samples
from usvlearn import AID, RLS, QuasiStatic, Robust, SIFtRLS, SurgeDynamics, rollout
from usvlearn.estimators.wrappers.robust.layer import clipped_moment, finite


class Level(QuasiStatic):
    """The model of a constant: φ = 1, so that RLS is the mean of the measurements."""

    names, signs = ("level",), (0,)

    def forward(self, surge, inputs):
        return torch.zeros_like(surge), torch.ones_like(surge)[..., None]


@pytest.mark.parametrize("c", [0.3, 1.0, 1.345, 4.0])
def test_moment_equals_quadrature(c):
    expected = integrate.quad(lambda z: min(z * z, c * c) * stats.norm.pdf(z), -12, 12, points=[-c, c])[0]
    assert clipped_moment(c) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("inner", [lambda: AID(28.0), lambda: RLS(), lambda: SIFtRLS(SurgeDynamics(28.0))])
def test_what_is_clean_is_learned_to_the_bit(inner):
    samples = random_samples(60, 2)
    robust, plain = Robust(inner(), threshold=50.0, scale=1.0), inner()
    end, surge, _ = rollout(robust, robust.init((2,)), samples)
    expected, expected_surge, _ = rollout(plain, plain.init((2,)), samples)
    assert torch.equal(surge, expected_surge)
    for name, leaf in leaves(expected).items():
        assert torch.equal(leaf, leaves(end.inner)[name]), name
    assert end.clipped.sum() == end.rejected.sum() == end.escaped.sum() == 0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize("run", [0.0, 5.0])
def test_what_is_not_finite_changes_nothing_but_the_count(value, run):
    """Given straight to `update`, also where the next sample would be believed whole; 1e300 overflows its square."""
    robust = Robust(SIFtRLS(SurgeDynamics(28.0)))
    samples = random_samples(10, 2)
    state, _, _ = rollout(robust, robust.init((2,)), samples)
    state = state._replace(run=torch.full((2,), run, dtype=torch.float64))
    bad = torch.stack([samples.surge[3, 0].new_tensor(value), samples.surge[3, 1]])
    after = robust.update(state, at(samples, 3).inputs, bad)
    good = robust.update(state, at(samples, 3).inputs, samples.surge[3])
    for name, leaf in leaves(after).items():
        assert leaf.isfinite().all(), name
        assert torch.equal(leaf[1], leaves(good)[name][1]), name
        if math.isfinite(value) and not run:
            continue  # an outlier like any other: clipped
        if name == "rejected":
            assert leaf[0] == leaves(state)[name][0] + 1
        else:
            assert torch.equal(leaf[0], leaves(state)[name][0]), name


def test_an_input_that_is_no_number_is_refused_too():
    robust, samples = Robust(AID(28.0)), random_samples(10)
    state, _, _ = rollout(robust, robust.init(), samples)
    inputs = at(samples, 4).inputs
    after = robust.update(state, inputs._replace(command_left=inputs.command_left * math.nan), samples.surge[4])
    assert after.rejected == 1
    for name, leaf in leaves(after._replace(rejected=state.rejected)).items():
        assert torch.equal(leaf, leaves(state)[name]), name


def test_counts_and_clips_equal_a_plain_loop():
    """A running mean, with patience 2 and missing speeds, in plain Python."""
    steps, c, b, inflation = 300, 2.0, 1 / 50, 3.0
    rng = np.random.default_rng(0)
    y = 0.1 * rng.standard_normal(steps) + 3.0 * (np.arange(steps) > 150)
    y[rng.random(steps) < 0.1] += 2.0
    y[rng.random(steps) < 0.1] = np.nan
    robust = Robust(RLS(Level(), forgetting=0.99, covariance=1.0), c, 2, inflation, 0.3, memory=50.0)
    samples = random_samples(steps)._replace(surge=torch.as_tensor(y))
    end, surge, _ = rollout(robust, robust.init(), samples)
    theta, P, variance, run, clipped, escaped, predictions = 0.0, 1.0, 0.09, 0, 0, 0, []
    for value in y:
        predictions.append(theta)
        if np.isnan(value):
            continue
        e, bound, seen = value - theta, c * math.sqrt(variance), None
        if abs(e) <= bound:
            run, seen = 0, e * e / clipped_moment(c)
        elif run < 2:
            run, clipped, seen = run + 1, clipped + 1, bound**2 / clipped_moment(c)
            e = math.copysign(bound, e)
        else:
            first, seen = run == 2, bound**2 / clipped_moment(c)
            run, escaped, P = run + 1, escaped + first, P * (inflation if first else 1)
        s = 0.99 + P
        theta, P = theta + P / s * e, (P - P * P / s) / 0.99
        variance = (1 - b) * variance + b * seen
    assert clipped > 10 and escaped > 0
    assert (end.clipped, end.escaped, end.rejected) == (clipped, escaped, 0)
    np.testing.assert_allclose(surge, predictions, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(end.variance, variance, rtol=1e-9)
    np.testing.assert_allclose(end.inner.covariance, [[P]], rtol=1e-9)


def test_a_scale_of_zero_never_is():
    """A log without noise: s stops at scale_min, and the least disturbance is not an outlier for ever."""
    robust = Robust(RLS(Level()), memory=10.0, scale_min=0.01)
    samples = random_samples(300)
    samples = samples._replace(surge=torch.zeros_like(samples.surge))
    end, _, _ = rollout(robust, robust.init(), samples)
    assert float(end.variance) == pytest.approx(1e-4)
    assert robust.update(end, at(samples, 0).inputs, samples.surge[0] + 0.039).clipped == end.clipped
    assert robust.update(end, at(samples, 0).inputs, samples.surge[0] + 0.041).clipped == end.clipped + 1


def test_finite_looks_at_every_element_of_every_leaf():
    tree = {"a": torch.zeros(2, 3), "b": torch.zeros(2, 3, 4, 4), "c": torch.ones(2, 3, dtype=torch.bool)}
    assert finite(tree, 2).all()
    tree["b"][1, 2, 3, 0] = -math.inf
    assert finite(tree, 2).tolist() == [[True] * 3, [True, True, False]]
    tree["a"][0, 0] = math.inf  # and inf − inf does not cancel out
    tree["b"][0, 0, 0, 0] = -math.inf
    assert finite(tree, 2).sum() == 4


def test_a_segments_start_forgets_the_run_of_clipped_samples():
    robust = Robust(AID(28.0))
    state = robust.init()._replace(run=torch.tensor(3.0, dtype=torch.float64))
    assert robust.start(state, torch.tensor(1.0, dtype=torch.float64)).run == 0


def test_a_state_that_was_spoiled_before_refuses_no_sample():
    samples, robust = random_samples(1), Robust(RLS(SurgeDynamics(28.0)))
    state = robust.init()
    state = state._replace(inner=state.inner._replace(factor=state.inner.factor * torch.nan))
    after = robust.update(state, at(samples.inputs, 0), samples.surge[0])
    assert after.rejected == 0 and after.variance.isfinite()
