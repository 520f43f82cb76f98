"""Robust: outliers clipped, changes let through, what is not finite refused; untouched where nothing is wrong."""

import math

import numpy as np
import pytest
import torch
from scipy import integrate, stats

from tests.support import few, random_samples
from usvlearn import AID, RLS, Inputs, QuasiStatic, Robust, SIFtRLS, SurgeDynamics, WithMemory, rollout
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.errors import ConfigError
from usvlearn.estimators.wrappers.robust.layer import clipped_moment, finite

TRUTH = torch.tensor([0.8, -0.5, 0.3, 1.2], dtype=torch.float64)


class Linear(QuasiStatic):
    """v = φᵀθ with the inputs themselves as regressors, which are independent of each other."""

    names, signs = ("left", "right", "heading", "yaw_rate"), (0,) * 4

    def forward(self, surge, inputs):
        return torch.zeros_like(surge), torch.stack(inputs[:4], -1)


class Level(QuasiStatic):
    """The model of a constant: φ = 1, so that RLS is the mean of the measurements."""

    names, signs = ("level",), (0,)

    def forward(self, surge, inputs):
        return torch.zeros_like(surge), torch.ones_like(surge)[..., None]


def leaves(tree):
    return dict(named_leaves(tree))


def at(samples, k):
    return tree_map(lambda x: x[k], samples)


def linear(steps: int, *batch: int, share: float = 0.0, seed: int = 0, truth=TRUTH):
    """Samples of the linear model: noise of 0.05 m/s, and a share of gross outliers, 100 times that."""
    samples = random_samples(steps, *batch)
    generator = torch.Generator().manual_seed(seed)

    def normal():
        return torch.randn(steps, *batch, generator=generator, dtype=torch.float64)

    inputs = samples.inputs._replace(**{name: normal() for name in Inputs._fields[:4]})
    gross = torch.rand(steps, *batch, generator=generator) < share
    surge = torch.stack(inputs[:4], -1) @ truth + 0.05 * normal() + 5.0 * gross * normal().sign()
    return samples._replace(inputs=inputs, surge=surge)


@pytest.mark.parametrize("c", [0.3, 1.0, 1.345, 4.0])
def test_moment_equals_quadrature(c):
    expected = integrate.quad(lambda z: min(z * z, c * c) * stats.norm.pdf(z), -12, 12, points=[-c, c])[0]
    assert clipped_moment(c) == pytest.approx(expected, rel=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize(("threshold", "patience"), few([(1.345, 8), (4.0, 2)], [(4.0, 2)], "thorough"))
def test_scale_is_the_standard_deviation_of_what_is_no_outlier(threshold, patience):
    """With 2 % of gross outliers the plain deviation is 0.7 m/s; that of the rest, 0.05.

    An outlier counts as c²s², so that s² = σ² (1 + share c²/β); locally the share may be 4 %.
    """
    clean, gross = linear(1500, 2), linear(1500, 2, share=0.02)
    samples = tree_map(lambda x, y: torch.cat([x, y], 1), clean, gross)
    robust = Robust(SIFtRLS(Linear(), memory=400.0), threshold, patience, scale=1.0, memory=100.0)
    with torch.no_grad():
        _, _, scale = rollout(robust, robust.init((4,)), samples, record=lambda s: s.variance.sqrt())
    scale = scale[-700:].mean(0)
    torch.testing.assert_close(scale[:2], torch.full_like(scale[:2], 0.05), rtol=0.06, atol=0)
    most = 0.05 * math.sqrt(1 + 0.04 * threshold**2 / clipped_moment(threshold)) * 1.06
    assert (scale[2:] > 0.05).all() and (scale[2:] < most).all()


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
    robust = Robust(WithMemory(SIFtRLS(SurgeDynamics(28.0, memory=True))))
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


@pytest.mark.slow
def test_outliers_move_the_parameters_little():
    """2 % of gross outliers, 100 deviations each: the estimates of least squares without them deviate by 0.001.

    With c = 1.345 every sixth clean sample is clipped: it takes eight in a row to tell a change, and a first scale
    that is no smaller than the first innovations, which would else be clipped for good. With a patience of 1 two
    outliers in a row, as there are once in 2500 samples here, are taken for a change.
    """
    samples, found = linear(2000, 3, share=0.02), {}
    for name, estimator in {
        "plain": SIFtRLS(Linear(), memory=1e6),
        "huber": Robust(SIFtRLS(Linear(), memory=1e6), threshold=1.345, patience=8, scale=1.0),
        "gross": Robust(SIFtRLS(Linear(), memory=1e6), threshold=4.0, patience=2),
    }.items():
        with torch.no_grad():
            end, _, _ = rollout(estimator, estimator.init((3,)), samples)
        found[name] = (getattr(end, "inner", end).theta - TRUTH).abs().amax(-1)
    assert found["huber"].max() < 0.01 and found["gross"].max() < 0.01
    assert found["plain"].min() > 0.01


def test_counts_and_clips_equal_a_plain_loop():
    """A running mean, with patience 2 and missing speeds, in plain Python."""
    steps, c, b, inflation = 300, 2.0, 1 / 50, 3.0
    rng = np.random.default_rng(0)
    y = 0.1 * rng.standard_normal(steps) + 3.0 * (np.arange(steps) > 150)
    y[rng.random(steps) < 0.1] += 2.0
    y[rng.random(steps) < 0.1] = np.nan
    robust = Robust(RLS(Level(), forgetting=0.99, covariance=1.0), c, 2, inflation, 0.3, memory=50.0)
    samples = random_samples(steps)._replace(surge=torch.as_tensor(y))
    with torch.no_grad():
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


def test_a_change_gets_through_and_opens_the_covariance():
    """The level jumps by 40 σ: one sample is clipped, the next believed; a lone outlier never is."""
    generator = torch.Generator().manual_seed(0)
    samples = random_samples(302, 2)
    surge = 0.05 * torch.randn(302, 2, generator=generator, dtype=torch.float64)
    surge[300:, 0] += 2.0  # batch element 0 changes for good
    surge[300, 1] += 2.0  # batch element 1 has one outlier
    robust, calm = (Robust(RLS(Level()), patience=1, inflation=inflation) for inflation in (4.0, 1.0))
    inputs = at(samples, 0).inputs
    with torch.no_grad():
        before, _, _ = rollout(robust, robust.init((2,)), tree_map(lambda x: x[:300], samples._replace(surge=surge)))
        first = robust.update(before, inputs, surge[300])
        second, second_calm = (x.update(first, inputs, surge[301]) for x in (robust, calm))
    assert (first.clipped - before.clipped).tolist() == [1, 1] and torch.equal(first.escaped, before.escaped)
    assert (second.escaped - before.escaped).tolist() == [1, 0] and second.run.tolist() == [2, 0]
    # information along the one direction: (r/4)⁺ = λ r/4 + 1 in place of λ r + 1
    r, opened, kept = (1 / s.inner.covariance[:, 0, 0] for s in (first, second, second_calm))
    torch.testing.assert_close(opened, 0.995 * r / torch.tensor([4.0, 1.0]) + 1)
    torch.testing.assert_close(kept, 0.995 * r + 1)
    # the scale follows a change by what is clipped, and no faster
    assert 1 < second.variance[0] / first.variance[0] < 1.1 and second.variance[1] < first.variance[1]


@pytest.mark.thorough
def test_elements_are_clipped_each_by_its_own_scale():
    samples = linear(300, 2, share=0.03)
    samples = samples._replace(surge=samples.surge * torch.tensor([1.0, 10.0]))
    robust = Robust(SIFtRLS(Linear()), scale=[0.1, 2.0])
    end, surge, _ = rollout(robust, robust.init((2,)), samples)
    for element in range(2):
        alone = Robust(SIFtRLS(Linear()), scale=[0.1, 2.0][element])
        one, one_surge, _ = rollout(alone, alone.init(), tree_map(lambda x, i=element: x[:, i], samples))
        torch.testing.assert_close(surge[:, element], one_surge, rtol=1e-10, atol=1e-10)
        assert (end.clipped[element], end.escaped[element]) == (one.clipped, one.escaped) and one.clipped > 0


def test_a_scale_of_zero_never_is():
    """A log without noise: s stops at scale_min, and the least disturbance is not an outlier for ever."""
    robust = Robust(RLS(Level()), memory=10.0, scale_min=0.01)
    samples = random_samples(300)
    samples = samples._replace(surge=torch.zeros_like(samples.surge))
    with torch.no_grad():
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


@pytest.mark.parametrize(
    "wrong",
    [{"threshold": 0.0}, {"patience": 0}, {"patience": 1.5}, {"inflation": 0.5}, {"scale": 0.0}, {"memory": 0.5},
     {"scale_min": 0.0}],
)  # fmt: skip
def test_illegal_hyperparameters_are_refused(wrong):
    with pytest.raises(ConfigError, match="expected"):
        Robust(AID(28.0), **wrong)


def test_a_segments_start_forgets_the_run_of_clipped_samples():
    robust = Robust(AID(28.0))
    state = robust.init()._replace(run=torch.tensor(3.0, dtype=torch.float64))
    assert robust.start(state, torch.tensor(1.0, dtype=torch.float64)).run == 0


def test_a_state_that_was_spoiled_before_refuses_no_sample():
    samples, robust = random_samples(1), Robust(RLS(SurgeDynamics(28.0)))
    state = robust.init()
    state = state._replace(inner=state.inner._replace(factor=state.inner.factor * torch.nan))
    after = robust.update(state, Inputs(*(x[0] for x in samples.inputs)), samples.surge[0])
    assert after.rejected == 0 and after.variance.isfinite()
