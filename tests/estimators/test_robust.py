"""Robust: outliers clipped, changes let through, what is not finite refused; untouched where nothing is wrong."""

import math

import numpy as np
import pytest
import torch
from scipy import integrate, stats

from tests.support import at, leaves, random_samples
from tests.support.kernel_cases import mission
from usvlearn import AID, RLS, RNN, Persistence, Robust, SIFtRLS, SurgeDynamics, rollout
from usvlearn.estimators.wrappers.robust.layer import clipped_moment


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


def test_a_sample_that_spoils_the_state_changes_nothing_but_the_count():
    """The steps of Adam overflow where the rate is 1e308."""
    robust, samples = Robust(RNN(6, rate=1e308, stability="none"), threshold=100.0), mission(60)
    end, _, states = rollout(robust, robust.init(), samples, lambda state: state)
    refused = end.rejected > states.rejected[0]
    assert refused and all(leaf.isfinite().all() for leaf in leaves(end).values())
    for k in (states.rejected.diff() > 0).nonzero()[:, 0]:
        before, after = at(states, int(k)), at(states, int(k) + 1)
        assert all(torch.equal(leaf, leaves(before.inner)[name]) for name, leaf in leaves(after.inner).items())


def test_counts_and_clips_equal_a_plain_loop():
    """Around persistence, with patience 2 and missing speeds, in plain Python."""
    steps, c, b = 300, 2.0, 1 / 50
    rng = np.random.default_rng(0)
    y = 0.1 * rng.standard_normal(steps) + 3.0 * (np.arange(steps) > 150)
    y[rng.random(steps) < 0.1] += 2.0
    y[rng.random(steps) < 0.1] = np.nan
    robust = Robust(Persistence(), c, 2, scale=0.3, memory=50.0)
    samples = random_samples(steps)._replace(surge=torch.as_tensor(y))
    end, surge, _ = rollout(robust, robust.init(), samples)
    last, variance, run, clipped, escaped, predictions = 0.0, 0.09, 0, 0, 0, []
    for value in y:
        predictions.append(last)
        if np.isnan(value):
            continue
        e, bound, seen = value - last, c * math.sqrt(variance), None
        if abs(e) <= bound:
            run, seen = 0, e * e / clipped_moment(c)
        elif run < 2:
            run, clipped, seen = run + 1, clipped + 1, bound**2 / clipped_moment(c)
            e = math.copysign(bound, e)
        else:
            first, seen = run == 2, bound**2 / clipped_moment(c)
            run, escaped = run + 1, escaped + first
        last += e
        variance = (1 - b) * variance + b * seen
    assert clipped > 10 and escaped > 0
    assert (end.clipped, end.escaped, end.rejected) == (clipped, escaped, 0)
    np.testing.assert_allclose(surge, predictions, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(end.variance, variance, rtol=1e-9)


def test_a_scale_of_zero_never_is():
    """A log without noise: s stops at scale_min, and the least disturbance is not an outlier for ever."""
    robust = Robust(Persistence(), memory=10.0, scale_min=0.01)
    samples = random_samples(300)
    samples = samples._replace(surge=torch.zeros_like(samples.surge))
    end, _, _ = rollout(robust, robust.init(), samples)
    assert float(end.variance) == pytest.approx(1e-4)
    assert robust.update(end, at(samples, 0).inputs, samples.surge[0] + 0.039).clipped == end.clipped
    assert robust.update(end, at(samples, 0).inputs, samples.surge[0] + 0.041).clipped == end.clipped + 1


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
