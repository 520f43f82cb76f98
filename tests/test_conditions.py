"""The closed forms of the contraction margins, against what they stand for."""

import itertools

import numpy as np
import torch

from certify.conditions import rate, simple_margin, tight_margin


def networks(count: int, n: int, seed: int = 0):
    generator = torch.Generator().manual_seed(seed)
    return tuple(torch.randn(count, n, generator=generator, dtype=torch.float64) / n**0.5 for _ in range(2))


def test_rate_is_the_largest_slope_over_all_patterns():
    a, w1 = networks(50, 6)
    patterns = torch.tensor(list(itertools.product([0.0, 1.0], repeat=6)), dtype=torch.float64)
    slopes = (a * w1) @ patterns.mT
    torch.testing.assert_close(rate(a, w1), slopes.abs().amax(-1))
    torch.testing.assert_close(tight_margin(a, w1), 1 - slopes.abs().amax(-1))


def test_simple_is_sufficient_for_the_papers_matrix():
    """Where `simple` holds, M of the paper is positive definite with p = 1, λ = 1/(n+1), and so `tight` holds."""
    a, w1 = networks(4000, 3, seed=1)
    a, w1 = 0.3 * a, 0.8 * w1
    margins, n = simple_margin(a, w1), 3
    held = margins > 0
    assert 100 < held.sum() < 3900
    for ai, wi in zip(a[held].numpy(), w1[held].numpy(), strict=True):
        lam = np.eye(n) / (n + 1)
        M = np.block([[np.eye(2), np.vstack([-ai, -wi @ lam])], [np.column_stack([-ai, -lam @ wi]), lam]])
        assert np.linalg.eigvalsh(M).min() > 0
    assert (rate(a, w1)[held] < n / (4 * (n + 1))).all()


def test_two_networks_on_either_side():
    inside, outside = torch.tensor([0.2, -0.2]), torch.tensor([0.4, -0.2])
    w1 = torch.tensor([0.3, 0.3])
    torch.testing.assert_close(simple_margin(inside, w1), torch.tensor(0.1))
    assert simple_margin(outside, w1) < 0 < tight_margin(outside, w1)
