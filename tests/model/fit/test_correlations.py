"""Correlations of errors: pairs by hand, lags that are found again, and bounds that hold 99 % where they should."""

import numpy as np
import pytest

from usvlearn.model.fit.correlations import BEFORE, REACH, autocorrelation, cross_correlation, lagged_sums

DT = 0.1


def held(rng: np.random.Generator, count: int) -> np.ndarray:
    """Commands that hold for 2 to 20 s."""
    steps = rng.integers(20, 200, count // 20 + 1)
    return np.repeat(rng.uniform(-0.5, 1.0, len(steps)), steps)[:count]


def slow(rng: np.random.Generator, count: int) -> np.ndarray:
    """Errors that are alike for some seconds, and noise."""
    errors, driven = np.zeros(count), rng.standard_normal(count)
    for k in range(1, count):
        errors[k] = 0.98 * errors[k - 1] + driven[k]
    return errors + 3 * rng.standard_normal(count)


def test_pairs_are_those_of_one_mission_on_its_clock():
    rng = np.random.default_rng(0)
    some = [rng.standard_normal(count) for count in (40, 3, 25)]
    some[0][10:30] = np.nan  # a gap
    other = [rng.standard_normal(len(x)) for x in some]
    sums, pairs = lagged_sums(some, other, 30)
    for k in range(31):
        products = np.concatenate([x[: len(x) - k] * y[k:] for x, y in zip(some, other, strict=True) if len(x) > k])
        assert sums[k] == pytest.approx(np.nansum(products), abs=1e-12) and pairs[k] == np.isfinite(products).sum()


def test_white_errors_are_within_the_bounds_as_often_as_these_say():
    rng, inside = np.random.default_rng(2), []
    for _ in range(30):
        errors = [rng.standard_normal(3000) for _ in range(3)]
        for each in errors:
            each[rng.random(3000) < 0.3] = np.nan
        result = autocorrelation(errors, DT)
        inside.append(np.mean(np.abs(result.values) <= result.bounds))
    assert np.mean(inside) == pytest.approx(0.99, abs=0.006)  # 3600 lags: three deviations are 0.005


def test_bounds_know_that_errors_and_commands_depend_on_themselves():
    rng, inside, narrow = np.random.default_rng(3), [], []
    for _ in range(30):
        errors, commands = [slow(rng, 3000) for _ in range(3)], [held(rng, 3000) for _ in range(3)]
        errors[0][500:900] = np.nan
        result = cross_correlation(errors, commands, DT)
        assert result.lags[0] == -BEFORE and result.lags[-1] == REACH
        inside.append(np.mean(np.abs(result.values) <= result.bounds))
        narrow.append(np.mean(np.abs(result.values) <= 2.58 / np.sqrt(9000)))
    assert np.mean(inside) == pytest.approx(0.99, abs=0.02)  # neighbouring lags are alike
    assert np.mean(narrow) < 0.6


@pytest.mark.parametrize("late", [-5.0, 0.0, 3.0, 40.0])
def test_an_error_that_lags_a_command_shows_at_its_lag(late):
    rng = np.random.default_rng(4)
    commands = [held(rng, 4000) for _ in range(3)]
    errors = [0.3 * np.roll(u, round(late / DT)) + 0.1 * rng.standard_normal(4000) for u in commands]
    result = cross_correlation(errors, commands, DT)
    most = np.nanargmax(np.abs(result.values))
    assert result.lags[most] == late and result.values[most] > 3 * result.bounds[most]


def test_a_slow_sensor_has_lags_where_it_measures():
    errors = [np.full(6000, np.nan)]
    errors[0][::10] = np.random.default_rng(5).standard_normal(600)  # once a second
    result = autocorrelation(errors, DT)
    assert (np.isfinite(result.values) == (result.lags % 1.0 == 0)).all()


def test_lags_near_the_length_of_missions_are_unknown_and_so_is_what_never_varies():
    rng = np.random.default_rng(6)
    short = [rng.standard_normal(310) for _ in range(5)]
    lags = autocorrelation(short, DT)
    assert np.isfinite(lags.values[lags.lags < 23]).all() and np.isnan(lags.values[lags.lags > 24]).all()
    still = [np.full(310, 0.1) for _ in short]
    for lags in (cross_correlation(short, still, DT), cross_correlation(still, short, DT)):
        assert np.isnan(lags.values).all() and np.isnan(lags.bounds).all()
    for lags in (autocorrelation([np.full(9, np.nan)], DT), cross_correlation([np.full(9, np.nan)], [np.ones(9)], DT)):
        assert np.isnan(lags.values).all()
