"""Intervals of the slopes of φ, and linear bounds of the neurons, on a box of (x, u): in integers, rounded outward.

    z = W x + W₂ u + b  lies in [l, h] on the box, exactly. On it the slope φ′(z) lies in

    relu, leaky:α   [1, 1] where l ≥ 0, [α, α] where h ≤ 0, else [α, 1]       (relu: α = 0)
    tanh            [s(max(|l|, |h|)), s(distance of [l, h] from 0)],   s(z) = 1 − tanh²z = 4E/(1 + E)²,  E = e^(−2|z|)

s rises with E, and tanh|z| = (1 − E)/(1 + E) falls. So a bound of E on either side bounds both. e^(−t) = 2^(−k) e^(−r),
r = t − k ln 2 ∈ [0, 1), and Σ (−r)^n/n! alternates with falling terms, so that what is left out is smaller than the
first term left out. Every product is rounded down, and the sum of all these errors is added on either side.

With two hidden layers the argument of the second, V φ(z) + c, is bounded by a linear function of (x, u) on either side.
For that each φ(z) lies between two lines: a convex or concave φ between its chord and a tangent, and any φ between

    φ(m) + s (z − m) ± ω ρ,   m = (l + h)/2,  ρ ≥ |z − m|,  ω ≥ |φ′ − s|               (mean value theorem)     (1)

or two constants. All numbers are integers in units of a power of two. A line's slope is any integer, because its
constant is then chosen so that the line is a bound.
"""

from __future__ import annotations

from fractions import Fraction
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from certify.errors import CertifyError
from certify.networks.vector import Activation, VectorWeights
from certify.proofs.box_planes import Box, Region, integers, region
from certify.proofs.vector_exact import Slopes

BITS = 96  # after the point, of slopes and of tanh
ONE = 1 << BITS
GUARD = 16  # more bits within e^(−t)
FINE = 1 << (BITS + GUARD)
STEPS = 32  # of the table of e^(−k/STEPS) in [0, 1]
TANH = Activation("tanh", Fraction(0))
Ends = list[tuple[int, int]]  # the least and the greatest value of each neuron
Integers = NDArray[np.object_]  # Python integers of any size, which numpy multiplies and adds exactly


class Linear(NamedTuple):
    """low·(y, 1) ≤ z ≤ high·(y, 1) for all y = (x, u) of a region, neuron by neuron.

    Rows are in units of 2^−bits, and their last entries, the constants, in units of 2^−(bits + the region's bits).
    """

    low: Integers  # (n, q + m + 1)
    high: Integers  # (n, q + m + 1)
    bits: int


class Layer(NamedTuple):
    """z = rows·y + constants in integers: of the box's coordinates, or of the layer before."""

    rows: list[list[int]]
    constants: list[int]
    bits: int


def exp_bounds(t: int) -> tuple[int, int]:
    """Two integers between which e^(−t) lies, t ≥ 0, all in units of 2^−BITS.

    >>> exp_bounds(0), exp_bounds(10**6 << BITS)
    ((79228162514264337593543950335, 79228162514264337593543950336), (0, 1))
    """
    k, rest = divmod(t << GUARD, _log_two()[1])  # r is then not negative for either bound of ln 2
    if k > BITS:
        return 0, 1
    low, high = _exp_fine(rest + k * (_log_two()[1] - _log_two()[0]))[0], _exp_fine(rest)[1]
    return low >> (k + GUARD), min(-(-high >> (k + GUARD)), ONE)


def _exp_fine(r: int) -> tuple[int, int]:
    """Bounds of e^(−r), 0 ≤ r < 1, in units of 1/FINE, by the table and a series."""
    step, rest = divmod(r * STEPS, FINE)
    rest //= STEPS
    low, high = _exp_table(step)
    down, up = _exp_series(rest)
    # r − (step + rest)/… < 1 unit was cut off, which lowers e^(−r) by less than a unit
    return (low * down >> (BITS + GUARD)) - 1, -(-high * up >> (BITS + GUARD))


@cache
def _exp_table(step: int) -> tuple[int, int]:
    """Bounds of e^(−step/STEPS)."""
    return _exp_series(step * FINE // STEPS)


def _exp_series(r: int) -> tuple[int, int]:
    """Bounds of e^(−r), 0 ≤ r ≤ 1: each term is too small by at most 2 units, the rest below 3."""
    total, term, n = FINE, FINE, 0
    while term:
        n += 1
        term = term * r // (n << (BITS + GUARD))
        total += -term if n % 2 else term
    return total - 2 * n - 3, total + 2 * n + 3


@cache
def _log_two() -> tuple[int, int]:
    """Bounds of ln 2 = Σ 1/(k 2^k) in units of 1/FINE."""
    terms = [FINE // (k << k) for k in range(1, BITS + GUARD + 1)]
    return sum(terms), sum(terms) + len(terms) + 1


def _exp_twice(z: int, bits: int) -> tuple[int, int]:
    """Bounds of e^(−2z) for z ≥ 0 in units of 2^−bits."""
    t, rest = divmod(z << (BITS + 1), 1 << bits)
    low, high = exp_bounds(t)
    return (exp_bounds(t + 1)[0] if rest else low), high


def tanh_slope(least: int, most: int, bits: int) -> tuple[int, int]:
    """Bounds of 1 − tanh²z for all z of an interval in units of 2^−bits; they are in units of 2^−BITS.

    >>> tanh_slope(0, 0, 0)[1] == ONE, tanh_slope(-(10**6), 10**6, 0) == (0, ONE)
    (True, True)
    """
    far, near = max(abs(least), abs(most)), 0 if least <= 0 <= most else min(abs(least), abs(most))
    E = _exp_twice(far, bits)[0]
    low = (E << (2 * BITS + 2)) // (ONE + E) ** 2 if E else 0
    if not near:
        return low, ONE
    E = _exp_twice(near, bits)[1]
    return low, min(-(-(E << (2 * BITS + 2)) // (ONE + E) ** 2), ONE)


def tanh_bounds(z: int, bits: int) -> tuple[int, int]:
    """Bounds of tanh z, z in units of 2^−bits; they are in units of 2^−BITS.

    >>> tanh_bounds(0, 0)
    (0, 0)
    """
    if z == 0:
        return 0, 0
    low, high = _exp_twice(abs(z), bits)
    down, up = ((ONE - high) << BITS) // (ONE + high), -(-((ONE - low) << BITS) // (ONE + low))
    return (down, up) if z > 0 else (-up, -down)


@cache
def leak(phi: Activation) -> tuple[int, int]:
    """α in units of 2^−BITS, rounded down and up."""
    scaled = phi.least * ONE
    return scaled.__floor__(), scaled.__ceil__()


def slope_ends(phi: Activation, least: int, most: int, bits: int) -> tuple[int, int]:
    """Bounds of φ′ on an interval of z, in units of 2^−BITS."""
    if phi.name == "tanh":
        return tanh_slope(least, most, bits)
    low, high = leak(phi)
    return (ONE if least >= 0 else low), (high if most <= 0 and least < 0 else ONE)


def value_bounds(phi: Activation, z: int, bits: int) -> tuple[int, int]:
    """Bounds of φ(z), in units of 2^−(bits + BITS)."""
    if phi.name == "tanh":
        low, high = tanh_bounds(z, bits)
        return low << bits, high << bits
    if z >= 0:
        return z << BITS, z << BITS
    low, high = leak(phi)
    return z * high, z * low


def lines(phi: Activation, least: int, most: int, bits: int) -> tuple[int, int, int, int]:
    """s, t, s′, t′ with s z + t ≤ φ(z) ≤ s′ z + t′ on an interval; s in units of 2^−BITS, t of 2^−(bits + BITS).

    >>> from certify.networks.vector import RELU
    >>> [k / ONE for k in lines(RELU, -1, 3, 0)]
    [1.0, 0.0, 0.75, 0.75]
    """
    if phi.name == "tanh":
        if most <= 0:  # tanh is odd
            s, t, S, T = _tanh_lines(-most, -least, bits)
            return S, -T, s, -t
        return _tanh_lines(least, most, bits)
    flattest, steepest = slope_ends(phi, least, most, bits)
    (low, _), (_, high) = value_bounds(phi, least, bits), value_bounds(phi, most, bits)
    if least >= 0:
        return ONE, 0, ONE, 0
    chord = steepest if most <= 0 else (high - low) // (most - least)
    above = max(value_bounds(phi, z, bits)[1] - chord * z for z in (least, most))
    tangent = ONE if most > -least else flattest
    below = min(value_bounds(phi, z, bits)[0] - tangent * z for z in (least, most, min(most, 0)))
    return tangent, below, chord, above


def _tanh_lines(least: int, most: int, bits: int) -> tuple[int, int, int, int]:
    """The lines for tanh: a chord and a tangent where z ≥ 0, else (1) or constants."""
    phi = TANH
    (low, _), (_, high) = value_bounds(phi, least, bits), value_bounds(phi, most, bits)
    flattest, steepest = tanh_slope(least, most, bits)
    middle = (least + most) // 2
    down, up = value_bounds(phi, middle, bits)
    reach = max(most - middle, middle - least)
    if least >= 0 and most > least:  # concave
        # the bounds of two near points may fall, though tanh rises, and `through` needs a slope of 0 or more
        chord = max((value_bounds(phi, most, bits)[0] - low) // (most - least), 0)
        below = min(value_bounds(phi, z, bits)[0] - chord * z for z in (least, most))
        tangent, upper = tanh_slope(middle, middle, bits)
        return chord, below, tangent, up - tangent * middle + (upper - tangent) * reach
    slope = (flattest + steepest) // 2
    band = max(steepest - slope, slope - flattest) * reach
    if 2 * band >= high - low:
        return 0, low, 0, high
    return slope, down - slope * middle - band, slope, up - slope * middle + band


def first_layer(weights: VectorWeights, box: Box) -> Layer:
    """z of the first layer, in units fine enough that it is an integer at a corner of the box."""
    n, width = len(weights.b), len(box.lo)
    flat, bits = integers(np.concatenate([weights.W, weights.W2, weights.b[:, None]], 1))
    extra = integers([*np.asarray(box.lo), *np.asarray(box.hi)])[1]
    flat = [k << extra for k in flat]
    rows = [flat[i * (width + 1) : (i + 1) * (width + 1)] for i in range(n)]
    return Layer([row[:-1] for row in rows], [row[-1] for row in rows], bits + extra)


def layer(matrix: Any, constants: Any) -> Layer:
    """V φ + c, or A φ, of floats.

    Raises:
        CertifyError: fractions, which no power of two makes integers.
    """
    if np.asarray(matrix).dtype != np.float64:
        raise CertifyError(f"weights: found a matrix of {np.asarray(matrix).dtype}, expected float64")
    rows, width = np.asarray(matrix), np.shape(matrix)[1] + 1
    flat, bits = integers(np.concatenate([rows, np.asarray(constants)[:, None]], 1))
    split = [flat[i * width : (i + 1) * width] for i in range(len(rows))]
    return Layer([row[:-1] for row in split], [row[-1] for row in split], bits)


def linear(first: Layer, here: Region) -> tuple[Linear, Ends]:
    """The first layer's z, which is linear, and its ends in units of 2^−(bits + the region's bits)."""
    constants = [c << here.bits for c in first.constants]
    ends = [here.extremes(row, c) for row, c in zip(first.rows, first.constants, strict=True)]
    rows = whole([[*row, c] for row, c in zip(first.rows, constants, strict=True)])
    return Linear(rows, rows, first.bits), ends


def through(phi: Activation, before: Linear, ends: Ends, after: Layer, here: Region) -> tuple[Linear, Ends]:
    """Linear bounds of rows·φ(z) + constants, and its ends: those of the bounds, or of interval arithmetic."""
    bits = before.bits + here.bits
    known = whole([lines(phi, least, most, bits) for least, most in ends]).T
    low, high = known[0][:, None] * before.low, known[2][:, None] * before.high  # slopes are not negative
    low[:, -1] += known[1]
    high[:, -1] += known[3]
    least = whole([value_bounds(phi, each, bits)[0] for each, _ in ends])
    most = whole([value_bounds(phi, each, bits)[1] for _, each in ends])
    plus, minus = signed(whole(after.rows))
    offsets = whole([c << (BITS + bits) for c in after.constants])
    lower, upper = plus @ low + minus @ high, plus @ high + minus @ low
    lower[:, -1] += offsets
    upper[:, -1] += offsets
    bottom = np.maximum(smallest(lower, here), plus @ least + minus @ most + offsets)
    top = np.minimum(-smallest(-upper, here), plus @ most + minus @ least + offsets)
    reached = list(zip(bottom.tolist(), top.tolist(), strict=True))
    return Linear(lower, upper, after.bits + BITS + before.bits), reached


def whole(values: Any) -> Integers:
    """An array of Python integers."""
    return np.array(values, dtype=object)


def signed(X: Integers) -> tuple[Integers, Integers]:
    """The positive and the negative entries."""
    return np.maximum(X, 0), np.minimum(X, 0)


def smallest(rows: Integers, here: Region) -> Integers:
    """The least value of each row·(y, 1) on a region, `(n,)`."""
    plus, minus = signed(rows[:, :-1])
    least: Integers = plus @ whole(here.lo) + minus @ whole(here.hi) + rows[:, -1]
    return least


def intervals(weights: VectorWeights, phi: Activation, box: Box) -> list[Slopes]:
    """The interval of φ′ of every neuron, for each hidden layer: `slopes` of `certify.proofs.vector_exact.rate`.

    Args:
        weights: of one network, checked.
        phi: its activation.
        box: `(q + m,)`, x first.

    >>> from certify.networks.vector import activation, check
    >>> net = check(VectorWeights(None, [[0.5, -1.0]], [[1.0], [0.75]], np.zeros((2, 0)), [0.0, -1.0]))
    >>> [[tuple(map(float, pair)) for pair in each] for each in intervals(
    ...     net, activation("leaky:1/4"), Box(np.zeros(1), np.ones(1)))]
    [[(1.0, 1.0), (0.25, 0.25)]]
    """
    here, first = region(box), first_layer(weights, box)
    found, ends = linear(first, here)
    layers: list[Slopes] = [exact_slopes(phi, ends, found.bits + here.bits)]
    if weights.V is not None:
        found, ends = through(phi, found, ends, layer(weights.V, weights.c), here)
        layers.append(exact_slopes(phi, ends, found.bits + here.bits))
    return layers


def exact_slopes(phi: Activation, ends: Ends, bits: int) -> list[tuple[Fraction, Fraction]]:
    """The intervals of φ′; those of leaky hold α itself."""
    if phi.name != "tanh":
        return [
            (Fraction(1) if least >= 0 else phi.least, phi.least if most <= 0 and least < 0 else Fraction(1))
            for least, most in ends
        ]
    pairs = [slope_ends(phi, least, most, bits) for least, most in ends]
    return [(Fraction(low, ONE), Fraction(high, ONE)) for low, high in pairs]
