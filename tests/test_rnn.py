"""RNN: its written-out gradient equals autograd's and differences; its Adam equals torch's."""

from fractions import Fraction

import pytest
import torch
from torch.func import grad

from certify import exact
from certify.box_proof import Box, interval_rate
from certify.weights import ShallowWeights
from tests.conftest import random_samples
from usvlearn import RNN, rollout
from usvlearn.errors import ConfigError
from usvlearn.estimators.rnn import gradient, network, network_inputs
from usvlearn.signals import tree_map


def case(n: int, batch=(), seed: int = 0):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn((*batch, *shape), generator=generator, dtype=torch.float64)

    weights = ShallowWeights(normal(n) / n, normal(n), normal(n, 4), normal(n))
    return weights, normal(), normal(4), normal(), normal(), normal(4)


def flatten(w: ShallowWeights) -> torch.Tensor:
    return torch.cat([w.a, w.w1, w.W2.flatten(-2), w.b], -1)


def loss(weights, x, u, target, penalty, x_before, u_before, unbroken):
    """Equation (2) of the module, written down plainly."""
    if unbroken:
        x = network(weights, x_before, u_before)[0]
    predicted, n = network(weights, x, u)[0], len(weights.a)
    psi = (weights.a.abs() + weights.w1.abs() / (n + 1) > 1 / (n + 1)).to(x.dtype)
    return 0.5 * (predicted - target) ** 2 + penalty / 2 * (psi * (weights.a**2 + weights.w1**2)).sum()


@pytest.mark.parametrize("unbroken", [False, True])
@pytest.mark.parametrize("n", [1, 6, 20])
def test_gradient_equals_autograd_and_differences(n, unbroken):
    weights, x, u, target, x_before, u_before = case(n)
    penalty, flag = torch.tensor(0.3, dtype=torch.float64), torch.tensor(unbroken)
    found = gradient(weights, x, u, target, penalty, (x_before, u_before, flag))
    arguments = (x, u, target, penalty, x_before, u_before, unbroken)
    torch.testing.assert_close(found, flatten(grad(loss)(weights, *arguments)), rtol=1e-12, atol=1e-12)
    h, flat = 1e-6, flatten(weights)
    for k in range(7 * n):
        costs = []
        for sign in (1, -1):
            moved = flat.clone()
            moved[k] += sign * h
            a, w1, W2, b = moved.split((n, n, 4 * n, n))
            costs.append(loss(ShallowWeights(a, w1, W2.reshape(n, 4), b), *arguments))
        torch.testing.assert_close(found[k], (costs[0] - costs[1]) / (2 * h), rtol=1e-5, atol=1e-7)


def test_one_step_gradient_is_the_broken_one():
    weights, x, u, target, x_before, u_before = case(6, batch=(5,))
    penalty, broken = torch.tensor(0.1, dtype=torch.float64), torch.zeros(5, dtype=torch.bool)
    one = gradient(weights, x, u, target, penalty)
    torch.testing.assert_close(one, gradient(weights, x, u, target, penalty, (x_before, u_before, broken)))


@pytest.mark.parametrize("decay", [None, 7])
def test_adam_equals_torch(decay):
    rnn, samples = RNN(6, rate=0.01, stability="penalty", penalty=1e-3, decay=decay), random_samples(40)
    end, _, _ = rollout(rnn, rnn.init(), samples)
    start = rnn.init().weights
    weights = ShallowWeights(*(w.detach().clone().requires_grad_() for w in start))
    optimizer = torch.optim.Adam(list(weights), lr=0.01)
    v = torch.zeros((), dtype=torch.float64)
    for k in range(40):
        for group in optimizer.param_groups:
            group["lr"] = 0.01 if decay is None else 0.01 / (1 + k // decay) ** 0.5
        u = network_inputs(type(samples.inputs)(*(x[k] for x in samples.inputs)))
        optimizer.zero_grad()
        loss(weights, rnn.scale * v, u, rnn.scale * samples.surge[k], 1e-3, None, None, False).backward()
        optimizer.step()
        v = samples.surge[k]
    for found, expected in zip(end.weights, weights, strict=True):
        torch.testing.assert_close(found, expected.detach(), rtol=1e-10, atol=1e-12)


def test_unrolled_loss_starts_one_step_earlier_only_where_the_step_before_was_made():
    rnn, samples = RNN(6, unroll=2), random_samples(3)
    first, _, _ = rollout(rnn, rnn.init(), type(samples)(*map_time(samples, slice(0, 1))))
    assert bool(first.unbroken) and not bool(rnn.start(first, samples.surge[0]).unbroken)
    coasted, _ = rnn.predict(first, type(samples.inputs)(*(x[1] for x in samples.inputs)))
    assert not bool(coasted.unbroken)


def map_time(samples, part):
    return type(samples.inputs)(*(x[part] for x in samples.inputs)), *(x[part] for x in samples[1:])


def test_paper_size_and_seeded_weights():
    assert sum(w.numel() for w in RNN().init().weights) == 140
    same, other = RNN(seed=1).init().weights, RNN(seed=2).init().weights
    assert torch.equal(RNN(seed=1).init().weights.W2, same.W2) and not torch.equal(same.W2, other.W2)


def test_learns_a_constant_speed():
    rnn, samples = RNN(surge_max=3.0), random_samples(600)
    steady = samples._replace(surge=torch.full_like(samples.surge, 1.5))
    _, surge, _ = rollout(rnn, rnn.init(), steady)
    assert (surge[-50:] - 1.5).abs().mean() < 0.05


@pytest.mark.parametrize("wrong", [{"unroll": 3}, {"neurons": 0}, {"rate": 0.0}, {"surge_max": 0.0}, {"decay": 0}])
def test_illegal_hyperparameters_are_refused(wrong):
    with pytest.raises(ConfigError, match="expected"):
        RNN(**wrong)


@pytest.mark.parametrize("updates", [pytest.param(40, id="some"), pytest.param(2000, id="1e5", marks=pytest.mark.slow)])
@pytest.mark.parametrize("condition", ["simple", "gershgorin", "lmi", "tight", "interval"])
def test_projection_holds_exactly_after_every_update(condition, updates):
    """50 lanes with rates up to 1, outliers of 10⁴ m/s, stale and missing samples: no set beyond the rate, exactly."""
    rates = torch.logspace(-4, 0, 50, dtype=torch.float64)
    rnn, generator = RNN(condition=condition, rate=rates, decay=None), torch.Generator().manual_seed(0)
    samples = random_samples(updates, 50)
    wild = torch.rand(samples.surge.shape, generator=generator, dtype=torch.float64)
    surge = torch.where(wild < 0.02, 1e4 * torch.randn(wild.shape, generator=generator).double(), samples.surge)
    surge = torch.where(wild > 0.98, torch.nan, surge)
    with torch.no_grad():
        _, _, weights = rollout(rnn, rnn.init((50,)), samples._replace(surge=surge), record=lambda s: s.weights)
    a, w1 = (x.flatten(0, 1).numpy() for x in (weights.a, weights.w1))
    assert len(a) == 50 * updates and not (a[1:] == a[:-1]).all()
    if condition == "interval":
        W2, b = (x.flatten(0, 1).numpy() for x in (weights.W2, weights.b))
        box = Box(*rnn.bounds.numpy())
        found = [interval_rate(ShallowWeights(*each), box) for each in zip(a, w1, W2, b, strict=True)]
    else:
        found = [exact.conditions(*pair)[condition].rate for pair in zip(a, w1, strict=True)]
    assert all(rate is not None and rate <= Fraction(0.999) for rate in found)
    assert max(found) > 0.9  # it is at the edge that it has to hold


def test_two_networks_that_learn_alike_forget_how_they_started():
    """Equal updates and inputs from two speeds: the difference shrinks by κ at every step, while the weights move."""
    rnn, samples = RNN(feedback="estimate", rate=0.1, contraction_rate=0.9), random_samples(30, 2)
    state = rnn.init((2,))
    inputs = type(samples.inputs)(*(x[:, :1].expand(-1, 2) for x in samples.inputs))
    state = state._replace(surge=torch.tensor([-0.5, 1.5], dtype=torch.float64))
    before = 2.0
    for k in range(30):
        learned = rnn.update(state, type(inputs)(*(x[k] for x in inputs)), samples.surge[k, :1].expand(2))
        weights = tree_map(lambda w: w[:1].expand_as(w), learned.weights)  # the first lane's, for both
        state = state._replace(weights=weights)
        coasted, _ = rnn.predict(state, type(inputs)(*(x[k] for x in inputs)))
        after = float((coasted.surge[1] - coasted.surge[0]).detach().abs())
        assert after <= 0.9 * before + 1e-12
        state, before = coasted, after


def test_monitor_tells_margins_rate_time_constant_and_rest():
    rnn, samples = RNN(surge_max=2.0), random_samples(50, 3)
    state, _, _ = rollout(rnn, rnn.init((3,)), samples)
    told = rnn.monitor(state)
    K = told["contraction_rate"]
    torch.testing.assert_close(told["margin_tight"], 1 - K)
    torch.testing.assert_close(told["time_constant"], -state.dt / K.log())
    rest = torch.cat([state.inputs_before[:, :2], torch.zeros(3, 2).double()], -1)
    x = rnn.scale * told["equilibrium"].double()
    torch.testing.assert_close(network(state.weights, x, rest)[0], x)
    assert (told["equilibria"] == 1).all()  # a contraction has one
    broken = state._replace(weights=tree_map(lambda w: w * torch.nan, state.weights))
    assert rnn.monitor(broken)["equilibrium"].isnan().all()


@pytest.mark.parametrize(
    "wrong", [{"stability": "hope"}, {"condition": "loose"}, {"contraction_rate": 1.5}, {"gauge": "x"}]
)
def test_illegal_stability_is_refused(wrong):
    with pytest.raises(ConfigError, match="expected"):
        RNN(**wrong)
