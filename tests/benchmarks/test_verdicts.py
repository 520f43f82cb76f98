"""What the benchmark of verdicts measures beside certify: the nearest (a, w₁), and weights that are scaled down."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from verdicts import project_jointly, retract

from certify.networks.shallow import ShallowWeights
from certify.training.conditions import rate


def networks(count: int, n: int) -> ShallowWeights:
    generator = torch.Generator().manual_seed(5)
    a, w1 = 0.9 * torch.randn(2, count, n, generator=generator, dtype=torch.float64)
    return ShallowWeights(a, w1, torch.zeros(count, n, 1).double(), torch.zeros(count, n).double())


@pytest.mark.parametrize("function", [project_jointly, retract])
def test_the_rate_holds_and_what_held_it_stays(function):
    weights = networks(50, 6)
    near, held = function(weights, 0.6), rate(weights.a, weights.w1) <= 0.6
    assert (rate(near.a, near.w1) <= 0.6 + 1e-12).all() and not held.all()
    small = weights._replace(a=0.01 * weights.a)
    torch.testing.assert_close(function(small, 0.6).a, small.a, rtol=1e-14, atol=0)


def test_the_joint_projection_is_never_beaten():
    weights, rng = networks(6, 3), np.random.default_rng(0)
    near = project_jointly(weights, 0.6)

    def found_rate(x: np.ndarray) -> float:
        s = x[:3] * x[3:]
        return max(s[s > 0].sum(), -s[s < 0].sum())

    for k in range(6):
        start, found = (torch.cat([each.a[k], each.w1[k]]).numpy() for each in (weights, near))
        cost, costs = np.sum((found - start) ** 2), []
        for trial in range(4):
            guess = start * rng.uniform(-0.2, 1, 6) if trial else found
            limit = {"type": "ineq", "fun": lambda x: 0.6 - found_rate(x)}
            end = minimize(lambda x, start=start: np.sum((x - start) ** 2), guess, method="SLSQP", constraints=limit)
            costs += [end.fun] if found_rate(end.x) <= 0.6 + 1e-7 else []
        assert cost <= min(costs, default=np.inf) + 1e-5


def test_equal_sizes_are_split():
    """|a_i| = |w_i|: the nearest point is not symmetric once the bound is below a quarter of what stands there."""
    one = torch.ones(2, dtype=torch.float64)
    weights = ShallowWeights(one, one, torch.zeros(2, 1).double(), 0 * one)
    for kappa, expected in [(1.0, 1 / 2**0.5), (0.25, None)]:
        near = project_jointly(weights, kappa)
        assert abs(float((near.a * near.w1).sum()) - kappa) < 1e-10
        torch.testing.assert_close(near.a if expected else near.a + near.w1, (expected or 1.0) * one)
