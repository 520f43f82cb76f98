"""What is bounded on a leaf of `certify.proofs.vector_box_proof`, in integers: the rate with one or two layers, and the
range.

A statement keeps a state for each node of the tree. With one hidden layer of relu or leaky it holds the hyperplanes
that cross the box, so that a halving costs little; the other bounds are computed at the leaves alone.
"""

from __future__ import annotations

import itertools
import math
from fractions import Fraction
from typing import Any, NamedTuple, Protocol

import numpy as np

from certify.networks.vector import Activation, VectorWeights
from certify.proofs.box_planes import Box, Region, halved, region
from certify.proofs.vector_exact import Matrix, changed, over_one_denominator, transposed
from certify.proofs.vector_slopes import (
    BITS,
    Ends,
    Integers,
    Layer,
    first_layer,
    layer,
    linear,
    signed,
    slope_ends,
    smallest,
    tanh_slope,
    through,
    whole,
)

WORK = 24_000_000  # products in a replay, about 4 s
TANH = 100  # products that cost as much as a tanh, or its slope, at a point
NODE = 30  # and as a node of the tree


class Statement(Protocol):
    """What is bounded: a state for each node, and a bound at each leaf, in units of 1/unit."""

    unit: int
    work: int
    nodes: int  # of a tree whose replay takes at most WORK: an estimate for `_Patterns`, certain for the others

    def start(self, here: Region) -> Any: ...
    def halve(self, state: Any, j: int, here: Region, half: Region) -> Any: ...
    def leaf(self, here: Region, state: Any) -> int: ...


class Gains(NamedTuple):
    """[J ε]_r of one hidden layer, for all pairs (r, ε): start + Σ_g d_g gain_g, in units of 1/unit.

    With relu and leaky d_g is 1 where z_g > 0, else 0; with tanh it is φ′(z_g).
    """

    planes: Layer  # (G,) z_g
    start: list[int]  # (q 2^q,)
    gain: list[list[int]]  # (G, q 2^q)
    unit: int


def gains(weights: VectorWeights, phi: Activation, box: Box, norm: str, scaling: Matrix | None) -> Gains:
    """The merged hyperplanes of the neurons that change J, and what each adds."""
    R, A, W = changed(weights, scaling)
    q, first = len(R), first_layer(weights, box)
    fixed = [j for j in range(len(box.lo)) if box.lo[j] == box.hi[j]]
    values = {j: Fraction(float(box.lo[j])) for j in fixed}
    groups: dict[tuple[int, ...], list[Matrix]] = {}
    planes: dict[tuple[int, ...], tuple[list[int], int]] = {}
    for i, (row, constant) in enumerate(zip(first.rows, first.constants, strict=True)):
        part = [[a[i] * w for w in W[i]] for a in A]  # what the neuron adds to J where its slope is 1
        if not any(map(any, part)):
            continue
        constant += int(sum(row[j] * value for j, value in values.items()))
        row = [0 if j in values else k for j, k in enumerate(row)]
        sign = next((k for k in row if k), 1) > 0
        size = math.gcd(constant, *row) if phi.name != "tanh" else 1  # tanh′ is even, but not homogeneous
        size = size if sign else -size
        key = (constant // size, *(k // size for k in row))
        if key not in groups:
            groups[key] = [[[Fraction(0)] * q for _ in range(q)] for _ in range(2)]
            planes[key] = ([k if sign else -k for k in row], constant if sign else -constant)
        slopes = (Fraction(0), Fraction(1)) if phi.name == "tanh" else (phi.least, Fraction(1))
        for total, slope in zip(groups[key], slopes if sign or phi.name == "tanh" else slopes[::-1], strict=True):
            for target, own in zip(total, part, strict=True):
                for k, x in enumerate(own):
                    target[k] += slope * x
    base, steps = R, []
    for low, high in groups.values():
        base = [[x + y for x, y in zip(*pair, strict=True)] for pair in zip(base, low, strict=True)]
        steps.append([[y - x for x, y in zip(*pair, strict=True)] for pair in zip(low, high, strict=True)])
    if norm == "one":
        base, steps = transposed(base), [transposed(step) for step in steps]
    unit = math.lcm(*(x.denominator for X in (base, *steps) for row in X for x in row))
    start, *gain = [
        _signed_sums([[x.numerator * (unit // x.denominator) for x in row] for row in X]) for X in (base, *steps)
    ]
    kept = list(planes.values())
    return Gains(Layer([row for row, _ in kept], [c for _, c in kept], first.bits), start, gain, unit)


def _signed_sums(X: list[list[int]]) -> list[int]:
    """[X ε]_r for all (r, ε)."""
    signs = list(itertools.product((-1, 1), repeat=len(X)))
    return [sum(x * sign for x, sign in zip(row, each, strict=True)) for row in X for each in signs]


def slopes_on(
    weights: VectorWeights, phi: Activation, box: Box, norm: str, scaling: Matrix | None
) -> _Patterns | _Tanh | _Deep:
    """The statement that the rate is bounded."""
    if weights.V is not None:
        return _Deep(weights, phi, box, norm, scaling)
    return (_Tanh if phi.name == "tanh" else _Patterns)(gains(weights, phi, box, norm, scaling))


class _Crossed(NamedTuple):
    """A region's open hyperplanes, with the bounds of z, and the bound of each (r, ε)."""

    free: list[tuple[int, int, int]]
    high: list[int]


class _Patterns:
    """(1) for relu and leaky, kept up to date from node to node."""

    def __init__(self, found: Gains):
        self.planes, start, gain, self.unit = found
        self.top = [s + sum(max(g, 0) for g in column) for s, *column in zip(start, *gain, strict=True)]
        self.on = [[min(g, 0) for g in each] for each in gain]  # what a sign that is settled changes
        self.off = [[-max(g, 0) for g in each] for each in gain]
        self.columns = [list(column) for column in zip(*self.planes.rows, strict=True)]
        self.nodes = WORK // (NODE + 4 * len(gain) + (len(gain) + 4) * len(start) // 20)  # a node settles about G/20
        self.work = 0

    def start(self, here: Region) -> _Crossed:
        rows, constants, _ = self.planes
        self.work += len(rows) * len(here.lo)
        ends = [(g, *here.extremes(row, c)) for g, (row, c) in enumerate(zip(rows, constants, strict=True))]
        return self._settled(ends, self.top)

    def halve(self, state: _Crossed, j: int, here: Region, half: Region) -> _Crossed:
        column = self.columns[j] if self.columns else []
        return self._settled(halved(state.free, column, j, here, half), state.high)

    def leaf(self, here: Region, state: _Crossed) -> int:
        return max(state.high)

    def _settled(self, ends: list[tuple[int, int, int]], high: list[int]) -> _Crossed:
        self.work += 4 * len(ends)
        free = []
        for each in ends:
            g, least, most = each
            if least < 0 < most:
                free.append(each)
                continue
            high = list(map(int.__add__, high, (self.on if least >= 0 else self.off)[g]))
            self.work += len(high)
        return _Crossed(free, high)


class _Tanh:
    """(1) for tanh, computed at each leaf."""

    def __init__(self, found: Gains):
        self.planes, start, gain, unit = found
        self.base = [k << BITS for k in start]
        self.gain, self.unit = gain, unit << BITS
        self.cost = 2 * NODE + len(gain) * (len(start) + 2 * TANH)
        self.nodes = _nodes(self.cost)
        self.work = 0

    def start(self, here: Region) -> None:
        return None

    def halve(self, state: None, j: int, here: Region, half: Region) -> None:
        return None

    def leaf(self, here: Region, state: None) -> int:
        rows, constants, bits = self.planes
        self.work += self.cost
        total = self.base
        for row, constant, gain in zip(rows, constants, self.gain, strict=True):
            low, high = tanh_slope(*here.extremes(row, constant), bits + here.bits)
            total = [x + k * (high if k > 0 else low) for x, k in zip(total, gain, strict=True)]
        return max(total)


class _Deep:
    """The bound for two hidden layers, computed at each leaf: −ε gives the negative of both ends."""

    def __init__(self, weights: VectorWeights, phi: Activation, box: Box, norm: str, scaling: Matrix | None):
        R, A, W = changed(weights, scaling)
        self.phi, self.first, self.second = phi, first_layer(weights, box), layer(weights.V, weights.c)
        V = [[Fraction(k, 1 << self.second.bits) for k in row] for row in self.second.rows]
        self.turned = norm == "one"
        if self.turned:
            R, W, V, A = transposed(R), transposed(A), transposed(V), transposed(W)
        q = len(R)
        signs = whole([(1, *each) for each in itertools.product((-1, 1), repeat=q - 1)]).T  # (q, 2^(q−1))
        (R_rows, r_unit), (W_rows, w_unit), (V_rows, v_unit), (A_rows, a_unit) = map(_integers, (R, W, V, A))
        self.unit = (r_unit * w_unit * v_unit * a_unit) << (2 * BITS)
        self.direct = (R_rows @ signs) * (self.unit // r_unit)
        self.moved = signed((W_rows @ signs) * r_unit)
        self.V, self.A = signed(V_rows), signed(A_rows)
        n, last, width = len(weights.b), len(weights.c), len(box.lo)
        each = 8 * TANH if phi.name == "tanh" else 250
        self.cost = 2 * NODE + (2 * n * last * (width + 3) + 2 * len(signs.T) * (n + q) * last) // 2 + (n + last) * each
        self.nodes = _nodes(self.cost)
        self.work = 0

    def start(self, here: Region) -> None:
        return None

    def halve(self, state: None, j: int, here: Region, half: Region) -> None:
        return None

    def leaf(self, here: Region, state: None) -> int:
        self.work += self.cost
        inner, ends = linear(self.first, here)
        first = _slopes(self.phi, ends, inner.bits + here.bits)
        outer, ends = through(self.phi, inner, ends, self.second, here)
        second = _slopes(self.phi, ends, outer.bits + here.bits)
        if self.turned:
            first, second = second, first
        least, most = _moved(self.moved, first)
        least, most = _combined(self.V, least, most)
        least, most = _moved(signed(least), second)[0], _moved(signed(most), second)[1]
        least, most = _combined(self.A, least, most)
        return int(max((most + self.direct).max(), (-least - self.direct).max()))


class Range:
    """f stays in the box's intervals of x: a leaf's bound is 0 or 1, below or above the limit 1."""

    unit = 1

    def __init__(self, weights: VectorWeights, phi: Activation, box: Box):
        self.phi, self.first, self.q = phi, first_layer(weights, box), len(weights.R)
        zero = np.zeros(self.q)
        joint = layer(np.concatenate([weights.A, weights.R], 1), zero)  # in common units
        n = weights.A.shape[1]
        self.last = Layer([row[:n] for row in joint.rows], joint.constants, joint.bits)
        zeros = [0] * (len(box.lo) - self.q + 1)
        self.direct = whole([[*row[n:], *zeros] for row in joint.rows])  # R, as rows of `Linear`
        self.second = None if weights.V is None else layer(weights.V, weights.c)
        widths = [len(self.first.rows), *([] if self.second is None else [len(self.second.rows)]), self.q]
        each = 8 * TANH if phi.name == "tanh" else 250
        self.cost = 2 * NODE + sum((len(box.lo) + 3) * k * j + each * k for k, j in itertools.pairwise(widths))
        self.nodes = _nodes(self.cost)
        self.root = region(box)
        self.work = 0

    def start(self, here: Region) -> None:
        return None

    def halve(self, state: None, j: int, here: Region, half: Region) -> None:
        return None

    def leaf(self, here: Region, state: None) -> int:
        self.work += self.cost
        found, ends = linear(self.first, here)
        if self.second is not None:
            found, ends = through(self.phi, found, ends, self.second, here)
        found, ends = through(self.phi, found, ends, self.last, here)
        moved = self.direct << (found.bits - self.last.bits)  # R x, in units of the rows
        straight = list(zip(smallest(moved, here).tolist(), (-smallest(-moved, here)).tolist(), strict=True))
        under = smallest(found.low + moved, here).tolist()
        over = (-smallest(-found.high - moved, here)).tolist()
        depth = here.bits - self.root.bits + found.bits
        for r, (low, high) in enumerate(straight):  # by the lines, or by intervals
            least, most = max(under[r], ends[r][0] + low), min(over[r], ends[r][1] + high)
            if least < self.root.lo[r] << depth or most > self.root.hi[r] << depth:
                return 1
        return 0


def _nodes(cost: int) -> int:
    """The most nodes n of a tree with (n + 1)/2 leaves of this cost: NODE n + cost (n + 1)/2 ≤ WORK."""
    return max((2 * WORK - cost) // (2 * NODE + cost), 1)


def _slopes(phi: Activation, ends: Ends, bits: int) -> tuple[Integers, Integers]:
    """The least and the greatest slope of each neuron, `(n, 1)`."""
    found = whole([slope_ends(phi, least, most, bits) for least, most in ends])
    return found[:, :1], found[:, 1:]


def _moved(signs: tuple[Integers, Integers], slopes: tuple[Integers, Integers]) -> tuple[Integers, Integers]:
    """The ends of d k, for the positive and the negative parts of k and intervals of d ≥ 0."""
    (plus, minus), (low, high) = signs, slopes
    return low * plus + high * minus, high * plus + low * minus


def _combined(parts: tuple[Integers, Integers], least: Integers, most: Integers) -> tuple[Integers, Integers]:
    """The ends of X y for the positive and the negative parts of X and intervals of y."""
    plus, minus = parts
    return plus @ least + minus @ most, plus @ most + minus @ least


def _integers(X: Matrix) -> tuple[Integers, int]:
    """Integers in an array, and one denominator."""
    rows, below = over_one_denominator(X)
    return whole(rows), below
