"""A network's hyperplanes and boxes in integers: floats are integers over a power of two, so all of this is exact.

f(x, u) = aᵀ relu(z),  z = w₁ x + W₂ u + b,  (x, u) in a box
slope   = Σ_{z_i > 0} a_i w_{1i}                       where no z_i with a_i w_{1i} ≠ 0 is zero        (1)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from certify.networks.shallow import ShallowWeights


class Box(NamedTuple):
    """The intervals of x and the inputs. An input with lo = hi is fixed; x has a width: a rate compares two states."""

    lo: np.ndarray  # (1 + m,) x first, then u₁ … u_m
    hi: np.ndarray  # (1 + m,)


class Planes(NamedTuple):
    """The hyperplanes on which the slope changes; neurons that share one, from either side, are merged.

    A fixed input is part of the constant, so hyperplanes that coincide at that input are merged too.
    """

    rows: list[list[int]]  # (G, 1 + m) integers with which z = (row·(x, u) + constant) / 2^z_bits, of its first neuron
    constants: list[int]  # (G,)
    above: list[int]  # (G,) what the plane adds to the slope where z > 0, times 2^slope_bits
    below: list[int]  # (G,) and where z < 0
    z_bits: int
    slope_bits: int


def integers(values: Any) -> tuple[list[int], int]:
    """Integers k and an exponent e such that the floats are k / 2^e."""
    ratios = [value.as_integer_ratio() for value in np.asarray(values, dtype=np.float64).ravel().tolist()]
    bits = max((below.bit_length() for _, below in ratios), default=1) - 1
    return [above << (bits + 1 - below.bit_length()) for above, below in ratios], bits


def planes(weights: ShallowWeights, box: Box) -> Planes:
    """The merged hyperplanes of the neurons that matter for the slope, those with a_i w_{1i} ≠ 0."""
    a, a_bits = integers(weights.a)
    rows, constants, z_bits = forms(weights, box)
    w, w_bits = integers(weights.w1)
    lo, hi = np.asarray(box.lo), np.asarray(box.hi)
    fixed = [j for j in range(len(lo)) if lo[j] == hi[j]]
    values = [Fraction(float(lo[j])) for j in fixed]
    groups: dict[tuple[int, ...], int] = {}
    first: list[int] = []  # neuron of each
    merged = Planes([], [], [], [], z_bits, a_bits + w_bits)
    for i, row in enumerate(rows):
        s = a[i] * w[i]
        if not s:
            continue
        constant = constants[i]
        if fixed:
            constant += int(sum(row[j] * value for j, value in zip(fixed, values, strict=True)))
            row = [0 if j in fixed else k for j, k in enumerate(row)]
        unit = math.gcd(constant, *row)
        unit = unit if w[i] > 0 else -unit
        key = (constant // unit, *(k // unit for k in row))
        g = groups.setdefault(key, len(groups))
        if g == len(merged.rows):
            first.append(i)
            merged.rows.append(row)
            merged.constants.append(constant)
            merged.above.append(0)
            merged.below.append(0)
        (merged.above if w[i] * w[first[g]] > 0 else merged.below)[g] += s
    return merged


def value_at(weights: ShallowWeights, point: Any) -> Fraction:
    """f at a point (x, u), exactly; `(1 + m,)`."""
    a, a_bits = integers(weights.a)
    z, bits = _preactivations(weights, point)
    return Fraction(sum(ai * max(zi, 0) for ai, zi in zip(a, z, strict=True)), 1 << (a_bits + bits))


def slope_at(weights: ShallowWeights, point: Any) -> Fraction | None:
    """(1) at a point (x, u), exactly; None where it is not defined. The point refutes every rate up to |slope|."""
    (a, a_bits), (w, w_bits) = integers(weights.a), integers(weights.w1)
    total = 0
    for ai, wi, zi in zip(a, w, _preactivations(weights, point)[0], strict=True):
        if ai and wi and not zi:
            return None
        total += ai * wi if zi > 0 else 0
    return Fraction(total, 1 << (a_bits + w_bits))


def interval_rate(weights: ShallowWeights, box: Box) -> Fraction:
    """The largest |slope| that interval arithmetic on the whole box does not exclude: `proves` holds just above it."""
    crossed, here = planes(weights, box), region(box)
    high = low = 0
    for row, constant, above, below in zip(crossed.rows, crossed.constants, crossed.above, crossed.below, strict=True):
        least, most = here.extremes(row, constant)
        values = [above] if least >= 0 else [below] if most <= 0 else [above, below]
        high, low = high + max(values), low + min(values)
    return Fraction(max(high, -low), 1 << crossed.slope_bits)


class Region(NamedTuple):
    """A box in integers, in units of 2^−bits, with the floats that it was made from."""

    lo: list[int]
    hi: list[int]
    bits: int
    float_lo: list[float]
    float_hi: list[float]
    root_lo: int  # the whole box's interval of x
    root_hi: int

    def extremes(self, row: Sequence[int], constant: int) -> tuple[int, int]:
        """The least and greatest value of a form on the box, in units of the form's over 2^bits."""
        least = most = constant << self.bits
        for k, lo, hi in zip(row, self.lo, self.hi, strict=True):
            if k > 0:
                least, most = least + k * lo, most + k * hi
            elif k:
                least, most = least + k * hi, most + k * lo
        return least, most

    def halves(self, j: int) -> tuple[Region, Region] | None:
        """The two halves along a coordinate; None where no float lies between."""
        middle = (self.float_lo[j] + self.float_hi[j]) / 2
        if not self.float_lo[j] < middle < self.float_hi[j]:
            return None
        above, below = middle.as_integer_ratio()
        at = (above << self.bits) // below
        return (
            self._replace(hi=_with(self.hi, j, at), float_hi=_with(self.float_hi, j, middle)),
            self._replace(lo=_with(self.lo, j, at), float_lo=_with(self.float_lo, j, middle)),
        )


def region(box: Box, depth: int = 0) -> Region:
    """A box in integers fine enough for `depth` halvings: a float midpoint's unit is at least half its ends'."""
    float_lo, float_hi = np.asarray(box.lo).tolist(), np.asarray(box.hi).tolist()
    ends, bits = integers([*float_lo, *float_hi])
    ends = [k << depth for k in ends]
    lo, hi = ends[: len(float_lo)], ends[len(float_lo) :]
    return Region(lo, hi, bits + depth, float_lo, float_hi, lo[0], hi[0])


def halved(
    bounds: list[tuple[int, int, int]], column: Sequence[int], j: int, here: Region, half: Region
) -> list[tuple[int, int, int]]:
    """The bounds of forms on a half of a region along coordinate j: (form, least, greatest) each, from those on it.

    column: the coefficient of coordinate j in each form.
    """
    raised, lowered = half.lo[j] - here.lo[j], half.hi[j] - here.hi[j]
    narrowed = []
    for g, least, most in bounds:
        k = column[g]
        if k > 0:
            narrowed.append((g, least + k * raised, most + k * lowered))
        else:
            narrowed.append((g, least + k * lowered, most + k * raised))
    return narrowed


def _preactivations(weights: ShallowWeights, point: Any) -> tuple[list[int], int]:
    """z_i · 2^bits at a point, (n,)."""
    rows, constants, bits = forms(weights, Box(np.asarray(point), np.asarray(point)))
    y, y_bits = integers(point)
    z = [sum(map(int.__mul__, row, y)) + (constant << y_bits) for row, constant in zip(rows, constants, strict=True)]
    return z, bits + y_bits


def forms(weights: ShallowWeights, box: Box) -> tuple[list[list[int]], list[int], int]:
    """z as integer forms, in units fine enough that a form at a corner of the box is an integer."""
    n, m = np.asarray(weights.W2).shape
    flat, bits = integers(np.concatenate([weights.w1, np.ravel(weights.W2), weights.b]))
    extra = integers([*np.asarray(box.lo), *np.asarray(box.hi)])[1]
    flat = [k << extra for k in flat]
    rows = [[flat[i], *flat[n + i * m : n + (i + 1) * m]] for i in range(n)]
    return rows, flat[n + n * m :], bits + extra


def _with(values: list[Any], j: int, value: Any) -> list[Any]:
    changed = values.copy()
    changed[j] = value
    return changed
