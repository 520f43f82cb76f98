"""The closed forms of the conditions, against what they stand for: patterns, matrices, equal networks, boxes."""

import itertools
from fractions import Fraction

import numpy as np
import pytest
import torch

from certify.networks.shallow import ShallowWeights
from certify.proofs import exact as proofs
from certify.training.conditions import BEST_GAUGE, CONDITIONS, exact, fixed_signs, interval
from tests.support.placement import on_device

EPS = torch.finfo(torch.float64).eps
BOX = torch.tensor([0.0, -1, 0.25]).double(), torch.tensor([0.5, 1, 0.75]).double()


def networks(*batch: int, n: int = 6, m: int = 2, seed: int = 0) -> ShallowWeights:
    """Networks of spread sizes, some for which every condition holds and some for which none does."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*batch, *shape, generator=generator, dtype=torch.float64)

    def spread(low, high):
        return 10 ** (low + (high - low) * torch.rand(*batch, 1, generator=generator, dtype=torch.float64))

    w1 = (2 * torch.rand(*batch, n, generator=generator, dtype=torch.float64) - 1) * spread(-0.7, 0.2)
    return ShallowWeights(normal(n) * spread(-1.5, 1.2) / n, w1, normal(n, m), normal(n))


def patterns(n: int) -> torch.Tensor:
    """All activation patterns, (2ⁿ, n)."""
    return torch.tensor(list(itertools.product([0.0, 1.0], repeat=n)), dtype=torch.float64)


def results(weights: ShallowWeights) -> dict:
    values = {name: condition(weights.a, weights.w1) for name, condition in CONDITIONS.items()}
    return values | {"interval": interval(weights, *BOX)}


@pytest.mark.parametrize("name", BEST_GAUGE)
def test_best_gauge_is_the_best_of_the_equal_networks(name):
    a, w1, *_ = networks(200, seed=6)
    best, literal = BEST_GAUGE[name](a, w1), CONDITIONS[name]
    c = 1 / (2 * w1.abs())
    torch.testing.assert_close(literal(a / c, w1 * c).rate, best.rate, rtol=1e-13, atol=0)
    generator = torch.Generator().manual_seed(0)
    for size in (0.01, 0.1, 1.0):
        for centre in (c, torch.ones(6)):
            gauge = centre * (size * torch.randn(50, 200, 6, generator=generator, dtype=torch.float64)).exp()
            assert (literal(a / gauge, w1 * gauge).rate >= best.rate * (1 - 1e-13)).all()
    differ = (best.margin > 0) & (literal(a, w1).margin <= 0)
    assert differ.any(), "the literal condition depends on the gauge"


def corner_signs(weights: ShallowWeights) -> tuple[torch.Tensor, torch.Tensor]:
    """Neurons that are on at every corner of the box, and off at every corner."""
    corners = torch.tensor(list(itertools.product(*zip(*map(torch.Tensor.tolist, BOX), strict=True))))
    z = torch.einsum("...n,c->...nc", weights.w1, corners[:, 0].double()) + weights.b[..., None]
    z = z + weights.W2 @ corners[:, 1:].double().mT
    return (z > 0).all(-1), (z < 0).all(-1)


def test_interval_is_the_largest_slope_over_the_patterns_that_it_cannot_exclude():
    weights = networks(200, seed=7)
    on, off = corner_signs(weights)
    for signs, expected in zip(fixed_signs(weights, *BOX), (on, off), strict=True):
        assert signs.equal(expected) and 100 < signs.sum() < 1100
    d = patterns(6)[:, None]
    d = torch.where(on, 1.0, torch.where(off, 0.0, d))
    largest = (d * weights.a * weights.w1).sum(-1).abs().amax(0)
    torch.testing.assert_close(interval(weights, *BOX).rate, largest, rtol=1e-12, atol=1e-13)


def test_a_sign_that_rounding_may_turn_is_not_fixed():
    """At x = u = 1, z = 0.1 x + 0.2 u − 0.3 is zero, 5e-17, or 2e-17: floats cannot tell."""
    one, point = torch.ones(1).double(), torch.ones(2).double()
    for b in (-0.3, -(0.1 + 0.2)):
        weights = ShallowWeights(one, 0.1 * one, 0.2 * one[:, None], b * one)
        assert not any(sign.any() for sign in fixed_signs(weights, point, point))
        assert interval(weights, point, point).rate == 0.1


def test_rates_equal_the_exact_ones_to_rounding():
    for n in (1, 2, 7, 30):
        a, w1, *_ = networks(20, n=n, seed=11)
        for k in range(20):
            for name, expected in proofs.conditions(a[k].numpy(), w1[k].numpy()).items():
                value = CONDITIONS[name](a[k], w1[k])
                rounding = 4 * (n + 4) * EPS
                assert abs(Fraction(value.margin.item()) - expected.margin) <= rounding * (1 + abs(expected.margin))
                if expected.rate is None:
                    assert value.rate == torch.inf
                else:
                    assert abs(Fraction(value.rate.item()) - expected.rate) <= rounding * expected.rate


def test_gradients():
    weights = networks(3, seed=12)
    a, w1 = (x.clone().requires_grad_() for x in (weights.a, 0.4 * weights.w1))
    for condition in (*CONDITIONS.values(), *BEST_GAUGE.values()):
        assert torch.autograd.gradcheck(condition, (a, w1))
    assert torch.autograd.gradcheck(lambda a, w1: interval(weights._replace(a=a, w1=w1), *BOX), (a, w1))


def test_gradients_are_finite_where_no_rate_is():
    a, w1 = torch.tensor([0.3, 0.0, -0.2, 0.1]), torch.tensor([1.0, 2.0, -1.0, 0.0])
    for condition, field in itertools.product(CONDITIONS.values(), ("margin", "rate")):
        leaves = a.clone().requires_grad_(), w1.clone().requires_grad_()
        getattr(condition(*leaves), field).backward()
        assert all(leaf.grad.isfinite().all() for leaf in leaves)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_batches_are_networks_one_by_one(batch):
    weights = networks(*batch, seed=13)
    batched = results(weights)
    for each in (*batched.values(), *(gauge(weights.a, weights.w1) for gauge in BEST_GAUGE.values())):
        assert each.margin.shape == each.rate.shape == batch
    for index in np.ndindex(batch):
        alone = results(ShallowWeights(*(x[index] for x in weights)))
        for name, each in alone.items():
            assert each.margin == batched[name].margin[index] and each.rate == batched[name].rate[index]


def test_the_identity_holds_at_no_condition():
    """a = w₁ = 1, b = 0 is x⁺ = x for x ≥ 0: K = 1 to the last bit, which a non-strict test would pass."""
    one = torch.ones(1)
    for condition in (*CONDITIONS.values(), *BEST_GAUGE.values()):
        assert condition(one, one).margin <= 0
    assert exact(one, one).margin == 0


@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_conditions_stay_on_the_device_of_the_weights(batch):
    """`meta` stands for an accelerator (`tests/estimators/test_devices.py`)."""
    there, box = ShallowWeights(*(x.to("meta") for x in networks(*batch))), [x.to("meta") for x in BOX]
    with on_device():
        values = [each(there.a, there.w1) for each in (*CONDITIONS.values(), *BEST_GAUGE.values())]
        values.append(interval(there, *box))
    assert all(x.is_meta and x.shape == batch and x.dtype == torch.float64 for each in values for x in each)
