"""Intervals of shares and medians against their definitions, and by how often they hold the truth."""

import math

import numpy as np
import pytest

from certify.analysis.confidence import NORMAL, median, median_interval, wilson


@pytest.mark.parametrize(("count", "of"), [(0, 1), (1, 1), (3, 10), (0, 60), (59, 60), (500, 1000)])
def test_wilsons_interval_solves_its_equation(count, of):
    """Its ends are the p with |count/of − p| = z √(p (1 − p)/of)."""
    for p in wilson(count, of):
        assert 0 <= p <= 1
        assert abs(count / of - p) == pytest.approx(NORMAL * math.sqrt(p * (1 - p) / of), abs=1e-9)


@pytest.mark.parametrize("n", [6, 9, 30, 61])
def test_the_interval_of_the_median_is_the_narrowest_that_order_statistics_give(n):
    low, high = median_interval(range(1, n + 1))
    below = sum(math.comb(n, k) for k in range(low)) / 2**n  # P(B < low)
    assert below <= 0.025 < below + math.comb(n, low) / 2**n
    assert low + high == n + 1


def test_the_median_lies_in_its_interval_as_often_as_said():
    rng = np.random.default_rng(0)
    draws = rng.exponential(size=(2000, 25))
    held = sum(low <= math.log(2) <= high for low, high in map(median_interval, draws))
    assert 0.93 < held / 2000 < 0.98  # 25 draws: 95.7 %


def test_infinite_rates_have_a_median():
    values = [1.0, 2.0, 3.0, math.inf, math.inf, math.inf, math.inf]
    assert median(values) == math.inf and median(values[:5]) == 3.0 and median([1.0, math.inf]) == math.inf
    assert median_interval(values) == (1.0, math.inf) and median_interval([1.0] * 5) is None
