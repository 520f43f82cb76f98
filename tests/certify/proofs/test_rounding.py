"""Bounds are rounded to the side on which they stay true, and no farther than the digits ask."""

import math
from fractions import Fraction

import numpy as np
import pytest

from certify.proofs.rounding import above, below, float_above, float_below
from tests.support import cases


def numbers(count: int):
    rng = np.random.default_rng(0)
    for _ in range(count):
        size = Fraction(10) ** int(rng.integers(-400, 400)) if rng.random() < 0.3 else 1
        yield size * Fraction(int(rng.integers(-(10**9), 10**9)), int(rng.integers(1, 10**9)))
    for k in (1, 27, 28, 29, 60, 1500):
        yield from (1 - Fraction(1, 10**k), 1 + Fraction(1, 10**k), Fraction(1, 10**k) - 1, -1 - Fraction(1, 10**k))


@cases(1000, 3000)
def test_decimals_bound_and_are_near(count):
    for x in numbers(count):
        for digits in (3, 7, 40):
            high, low = Fraction(above(x, digits)), Fraction(below(x, digits))
            assert low <= x <= high and (high - low) <= abs(x) * Fraction(2, 10 ** (digits - 1))
            assert high < 1 or x >= 1  # what is below 1 reads so


def test_floats_bound_and_are_the_nearest_that_do():
    for x in numbers(3000):
        high, low = float_above(x), float_below(x)
        assert low <= x <= high and (low == high == x or math.nextafter(low, math.inf) == high)


@pytest.mark.parametrize("size", [0, Fraction(1, 10**400)])  # the second is below every positive float
def test_no_bound_is_minus_zero(size):
    for x in (float_above(Fraction(-size)), float_below(Fraction(size))):
        assert x == 0 and math.copysign(1, x) == 1


@pytest.mark.parametrize("x", [0.0, 1.0, -1.0, 0.5, 100.0, 2.0**-10])
def test_what_is_short_stays_as_it_is(x):
    assert Fraction(above(x, 20)) == Fraction(below(x, 20)) == Fraction(x) == Fraction(float_above(Fraction(x)))
