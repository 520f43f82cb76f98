"""Slopes on a box: against 120 digits of the decimal module, against points, and within their bounds' width."""

import random
import time
from decimal import Decimal, localcontext
from fractions import Fraction

import numpy as np
import pytest

from certify.networks.vector import RELU, VectorWeights, activation, check
from certify.proofs import vector_slopes
from certify.proofs.box_planes import Box, region
from certify.proofs.vector_exact import everywhere, rate
from certify.proofs.vector_slopes import (
    BITS,
    ONE,
    first_layer,
    intervals,
    layer,
    linear,
    lines,
    tanh_bounds,
    tanh_slope,
    through,
    value_bounds,
)
from tests.support import cases


def truth(z: Fraction) -> tuple[Decimal, Decimal]:
    """1 − tanh²z and tanh z, to 120 digits."""
    x = Decimal(z.numerator) / Decimal(z.denominator)
    E = (-2 * abs(x)).exp()
    return min(4 * E / (1 + E) ** 2, Decimal(1)), ((1 - E) / (1 + E)).copy_sign(x)


def drawn(source: random.Random) -> tuple[int, int, int]:
    """An interval of z in units of 2^−bits: points, tiny ones, and up to 160 wide, on both sides of 0."""
    bits = source.choice([0, 3, 53, 300])
    least = source.randint(-80 << bits, 80 << bits) >> source.choice([0, 0, 2, bits // 2, bits])
    return least, least + source.choice([0, 1, source.randint(0, 1 << bits), source.randint(0, 80 << bits)]), bits


def test_bounds_of_tanh_and_its_slope_hold_and_are_narrow():
    source, widest = random.Random(0), 0
    with localcontext() as context:
        context.prec, unit, margin = 120, Decimal(ONE), Decimal(10) ** -110
        for k in range(1500):
            least, most, bits = (0, 0, 5) if k == 0 else drawn(source)
            ends = [Fraction(least, 1 << bits), Fraction(most, 1 << bits)]
            slopes = [truth(z)[0] for z in ends]
            low, high = tanh_slope(least, most, bits)
            lowest, highest = min(slopes) + margin, Decimal(1) if least <= 0 <= most else max(slopes)
            assert low <= lowest * unit and highest * unit <= high <= ONE, (least, most, bits)
            down, up = tanh_bounds(most, bits)
            assert down <= truth(ends[1])[1] * unit <= up
            widest = max(widest, lowest * unit - low, high - highest * unit, up - down)
    assert widest <= 8  # units of 2^−96


def test_huge_arguments_are_cheap():
    started = time.process_time()
    for z in (10**6, 10**300, 1 << 4000):
        assert tanh_slope(z, z, 0) == (0, 4) and tanh_slope(-z, z, 0) == (0, ONE)
        assert tanh_bounds(z, 0) == (ONE - 2, ONE) and tanh_bounds(-z, 0) == (-ONE, 2 - ONE)
        assert tanh_slope(1, 1 + z, 2000)[1] <= ONE
    assert time.process_time() - started < 1


@pytest.mark.parametrize("name", ["relu", "leaky:1/3", "leaky:0.01", "tanh"])
@cases(100, 300)
def test_lines_lie_on_both_sides_of_the_activation(name, count):
    """At 40 points of each interval, exactly for relu and leaky."""
    phi, source = activation(name), random.Random(1)
    with localcontext() as context:
        context.prec, margin = 120, Decimal(10) ** -80
        for _ in range(count):
            least, most, bits = drawn(source)
            s, t, S, T = lines(phi, least, most, bits)
            for z in [least, most, *(source.randint(least, most) for _ in range(40))]:
                low, high = Fraction(s * z + t, ONE << bits), Fraction(S * z + T, ONE << bits)
                exact = Fraction(z, 1 << bits)
                if name == "tanh":
                    value = truth(exact)[1]
                    assert Decimal(low.numerator) / low.denominator <= value + margin
                    assert value - margin <= Decimal(high.numerator) / high.denominator
                else:
                    value = max(exact, phi.least * exact)
                    assert low <= value <= high
                    down, up = value_bounds(phi, z, bits)
                    assert Fraction(down, ONE << bits) <= value <= Fraction(up, ONE << bits)


def test_no_line_of_tanh_falls_even_where_the_bounds_of_its_values_do(monkeypatch):
    """Bounds may be too wide by some units. A slope below 0 would make the second layer's bounds wrong."""
    known = vector_slopes.tanh_bounds
    monkeypatch.setattr(
        vector_slopes, "tanh_bounds", lambda z, bits: (known(z, bits)[0] - 3 * (z % 2), known(z, bits)[1])
    )
    source = random.Random(2)
    for _ in range(200):
        bits = source.choice([100, 130, 200])
        least = 2 * source.randint(0, 20 << bits)
        for ends in ((least, least + 1), (-least - 1, -least)):
            s, t, S, T = lines(activation("tanh"), *ends, bits)
            assert s >= 0 and S >= 0
            for z in ends:
                low, high = vector_slopes.value_bounds(activation("tanh"), z, bits)
                assert s * z + t <= high and S * z + T >= low


def drawn_network(rng: np.random.Generator, deep: bool) -> tuple[VectorWeights, Box]:
    q, m, n, last = (int(k) for k in rng.integers((1, 0, 1, 1), (4, 3, 6, 5)))
    more = {"V": rng.normal(size=(last, n)), "c": rng.normal(size=last)} if deep else {}
    weights = VectorWeights(
        None, rng.normal(size=(q, last if deep else n)), rng.normal(size=(n, q)), rng.normal(size=(n, m)),
        rng.normal(size=n), **more,
    )  # fmt: skip
    lo = np.round(rng.uniform(-2, 1, q + m), 1)
    return check(weights), Box(lo, lo + rng.choice([0.1, 1.0, 2.0], q + m))


@pytest.mark.parametrize("name", ["relu", "leaky:1/3", "tanh"])
def test_intervals_hold_at_points_and_never_exceed_those_on_all_of_r(name):
    phi, rng, narrower = activation(name), np.random.default_rng(0), 0
    for k in range(40):
        weights, box = drawn_network(rng, deep=k % 2 == 1)
        found, widest = intervals(weights, phi, box), everywhere(weights, phi)
        y = rng.uniform(box.lo, box.hi, (200, len(box.lo)))
        z = y @ np.concatenate([weights.W, weights.W2], 1).T + weights.b
        for own, whole, c in zip(found, widest, (weights.V, None), strict=False):
            slopes = np.cosh(z) ** -2 if name == "tanh" else np.where(z > 0, 1.0, float(phi.least))
            for (low, high), (least, most), column in zip(own, whole, slopes.T, strict=True):
                assert least <= low <= high <= most
                assert float(low) - 1e-12 <= column.min() and column.max() <= float(high) + 1e-12
                narrower += high - low < most - least
            if c is not None:
                z = (np.tanh(z) if name == "tanh" else np.maximum(z, float(phi.least) * z)) @ c.T + weights.c
        assert rate(weights, found) <= rate(weights, widest)
    assert narrower > 40


@pytest.mark.parametrize("name", ["relu", "leaky:1/3", "tanh"])
def test_the_second_layer_is_bounded_on_the_box_better_than_by_intervals_alone(name):
    phi, rng, better = activation(name), np.random.default_rng(1), 0
    for _ in range(30):
        weights, box = drawn_network(rng, deep=True)
        here = region(box)
        first, ends = linear(first_layer(weights, box), here)
        outer, reached = through(phi, first, ends, layer(weights.V, weights.c), here)
        unit = float(1 << (outer.bits + here.bits))
        y = rng.uniform(box.lo, box.hi, (500, len(box.lo)))
        z = y @ np.concatenate([weights.W, weights.W2], 1).T + weights.b
        inner = [(np.tanh(k) if name == "tanh" else np.maximum(k, float(phi.least) * k)) for k in
                 (z, *np.array([[a / (1 << (first.bits + here.bits)) for a in pair] for pair in ends]).T)]  # fmt: skip
        z2 = inner[0] @ weights.V.T + weights.c
        centre, radius = (inner[1] + inner[2]) / 2, (inner[2] - inner[1]) / 2
        for i, (low, high) in enumerate(reached):
            assert low / unit <= z2[:, i].min() + 1e-12 and z2[:, i].max() - 1e-12 <= high / unit
            most = weights.V[i] @ centre + weights.c[i] + np.abs(weights.V[i]) @ radius
            assert high / unit <= most + 1e-9
            better += high / unit < most - 1e-6
    assert better > 20


def test_a_neuron_that_only_touches_zero_is_on_or_off():
    net = check(VectorWeights(None, [[1.0, 1.0, 1.0]], [[1.0], [-1.0], [1.0]], np.zeros((3, 0)), [0.0, 0.0, -0.5]))
    unit = Box(np.zeros(1), np.ones(1))
    assert [tuple(map(int, pair)) for pair in intervals(net, RELU, unit)[0]] == [(1, 1), (0, 0), (0, 1)]
    slope = intervals(net, activation("tanh"), unit)[0][0]
    assert (
        slope[1] == 1 and slope[0] == pytest.approx(0.4199743416140261, abs=1e-15) and slope[0].denominator <= 2**BITS
    )
