"""The autocorrelation of errors one step ahead, by hand and of known processes."""

import numpy as np
import pytest

from usvlearn.report.sections.errors import autocorrelation


def test_white_errors_are_within_the_bounds_in_99_percent():
    rng, inside = np.random.default_rng(5), []
    for _ in range(200):
        found = autocorrelation([rng.normal(0.3, 2.0, 600)], 20)
        inside.append(np.abs(found.values) <= found.bounds)
    assert abs(np.mean(inside) - 0.99) < 3 * np.sqrt(0.01 * 0.99 / 4000)


def test_that_of_an_autoregression_is_a_power():
    """e_(i+1) = φ e_i + w has r(k) = φᵏ; runs are of one process, and of different lengths."""
    rng, phi = np.random.default_rng(6), 0.7
    errors = []
    for n in (60_000, 40_000):
        e = np.zeros(n)
        for i, w in enumerate(rng.normal(size=n - 1)):
            e[i + 1] = phi * e[i] + w
        errors.append(e)
    found = autocorrelation(errors, 8)
    np.testing.assert_allclose(found.values, phi ** np.arange(1, 9), atol=0.02)  # four deviations
    assert found.pairs.tolist() == [100_000 - 2 * k for k in range(1, 9)]


def test_segments_runs_and_steps_that_do_not_count_are_no_neighbours():
    """Between two segments the errors jump: pairs across it would be nearly uncorrelated or even negative."""
    e = np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    apart = autocorrelation([e[:3], e[3:]], 3)
    assert apart.values[:2] == pytest.approx([1.0, 1.0]) and apart.pairs.tolist() == [4, 2, 0]
    assert np.isnan(apart.values[2])
    assert autocorrelation([e], 3).values[2] == pytest.approx(-1.0)
    masked = e.copy()
    masked[1] = np.nan
    assert autocorrelation([masked[:3], masked[3:]], 3).pairs.tolist() == [2, 2, 0]


@pytest.mark.parametrize("errors", [[], [np.empty(0)], [np.full(4, np.nan)], [np.ones(4)], [np.ones(1)]])
def test_without_errors_that_differ_there_is_none(errors):
    found = autocorrelation(errors, 5)
    assert np.isnan(found.values).all() and np.isfinite(found.bounds).all()
