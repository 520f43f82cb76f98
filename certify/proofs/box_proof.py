"""Replay of a proof about a network on a box, in integers: nothing here trusts the search that found the proof.

A proof is a binary tree that divides the box, as text in preorder, its tokens separated by blanks:

    x, u1, u2, …   halve the box along that coordinate, at (lo + hi)/2 in binary64: the lower half's proof follows, then
                   the upper's; they cover the box wherever it is cut
    z4             split the region by the sign of z of neuron 4: first z < 0, then z > 0
    .              the bound holds here by interval arithmetic on the box, with the signs of z fixed so far
    e4:3,7:-2      no point of the box's interior has these signs: μ = (3, −2) has the signs that z₄ and z₇ were given,
                   so Σ μ_i z_i > 0 would follow, but its maximum over the box is ≤ 0 (Farkas)
    s              split the statement, at most once on a path: first slope < rate, then slope > −rate
    d8,4:3,7:-2    below an s, the bound holds here by (2) with μ₄ = 3/8, μ₇ = −2/8, the other μ_i = 0

Let z_i lie in [L_i, U_i] on the box of a region and add α_i to the slope where z_i > 0 and β_i where z_i < 0. Split
neurons have a known sign σ_i, free ones have L_i < 0 < U_i. On the region, for any μ with μ_i σ_i ≥ 0 at split neurons,

    slope ≤ Σ_known (α_i or β_i) + Σ_free max(α_i + max(−μ_i, 0) U_i, β_i − max(μ_i, 0) L_i) + max_box Σ μ_i z_i     (2)

because α_i − μ_i z_i and β_i − μ_i z_i are at most these where z_i > 0 and where z_i < 0, and 0 ≤ μ_i z_i at split
neurons. The least slope is bounded by the same with the signs of α and β changed. μ = 0 is interval arithmetic.

A tree may come from anybody, so the effort is limited: a path has at most HALVINGS halvings and splits at no neuron
twice, a multiplier has at most DIGITS digits, and the bounds of at most WORK hyperplanes are computed. A tree beyond
these limits is refused.
"""

from __future__ import annotations

import math
import re
from fractions import Fraction
from typing import Any, NamedTuple, Protocol

import numpy as np

from certify.networks.shallow import ShallowWeights
from certify.proofs.box_planes import Box, Planes, Region, combined, excluded, forms, halved, integers, planes, region

HALVINGS = 1000  # on a path; each adds a bit to the box's integers
DIGITS = 1500  # of a multiplier
WORK = 4_000_000  # bounds of hyperplanes in a replay, about 2 s
CHORD = 64  # bits of a chord's slope, rounded up
MULTIPLIER = re.compile(rf"([0-9]{{1,9}}):(-?[0-9]{{1,{DIGITS}}})")
DIVISOR = re.compile(rf"[1-9][0-9]{{0,{DIGITS - 1}}}")


def proves(weights: ShallowWeights, box: Box, tree: str, rate: float | Fraction) -> bool:
    """Whether a tree proves |slope| < rate at every point of the box where the slope is defined.

    The rate is then a Lipschitz constant of x ↦ f(x, u) on the box's interval of x, for every u of the box.

    >>> half = ShallowWeights(np.array([0.5]), np.array([1.0]), np.zeros((1, 0)), np.zeros(1))
    >>> unit = Box(np.zeros(1), np.ones(1))
    >>> proves(half, unit, ".", 0.6), proves(half, unit, ".", 0.5), proves(half, unit, "x .", 0.6)
    (True, False, False)
    """
    found = planes(weights, box)
    limit = math.ceil(Fraction(rate) * 2**found.slope_bits)  # an integer is below both or below neither
    return proves_sum(found, box, tree, limit, -limit)


def proves_sum(found: Planes, box: Box, tree: str, most: int, least: int) -> bool:
    """Whether a tree proves least < Σ_{z_g > 0} above_g + Σ_{z_g < 0} below_g < most where no z_g is zero.

    Args:
        found: hyperplanes over any number of coordinates, those of the box; see `box_planes.Planes`.
        box: of these coordinates.
        tree: the proof; it names the coordinates x, u1, u2, … in their order.
        most: in the unit of above and below.
        least: likewise.

    >>> fold = Planes([0], [[1]], [0], [3], [1], 0, 0)
    >>> line = Box(-np.ones(1), np.ones(1))
    >>> proves_sum(fold, line, ".", 4, 0), proves_sum(fold, line, ".", 3, 0), proves_sum(fold, line, "s . .", 4, 1)
    (True, False, False)
    """
    return _replay(tree, box, _Sums(found, most, least))


def proves_range(weights: ShallowWeights, box: Box, tree: str) -> bool:
    """Whether a tree, of box splits alone, proves that f maps the box into the box's interval of x.

    At a leaf relu(z) lies between αz, α = 0 or 1, and a chord; the bound is a linear function's extreme.

    >>> identity = ShallowWeights(np.ones(1), np.ones(1), np.zeros((1, 0)), np.zeros(1))
    >>> proves_range(identity, Box(np.zeros(1), np.ones(1)), ".")
    True
    >>> proves_range(identity, Box(-np.ones(1), np.zeros(1)), ".")
    True
    >>> proves_range(identity._replace(b=np.ones(1)), Box(np.zeros(1), np.ones(1)), ".")
    False
    """
    return _replay(tree, box, _Range(weights, box))


class _Refused(Exception):
    """The tree proves nothing."""


class _Statement(Protocol):
    """The statement that a tree proves: a state for each node, and whether a leaf proves it there."""

    work: int  # bounds of hyperplanes that were computed

    def start(self, here: Region) -> Any: ...
    def halve(self, state: Any, j: int, here: Region, half: Region) -> Any: ...
    def part(self, state: Any, name: str) -> tuple[Any, ...]: ...
    def closes(self, here: Region, state: Any, token: str) -> bool: ...


class _Sum(NamedTuple):
    """The bounds of the sum in a region, in the unit of above and below."""

    free: list[tuple[int, int, int]]  # planes whose sign is open, with the bounds of z
    high: int  # the greatest sum
    low: int  # the least
    signs: dict[int, int]  # of the planes at which the region was split
    sides: tuple[int, ...]  # what is to be proved: 1, that the sum is below `most`, and −1, that it is above `least`


class _Sums:
    """least < Σ_{z_g > 0} above_g + Σ_{z_g < 0} below_g < most: the slope's size is below a rate."""

    def __init__(self, found: Planes, most: int, least: int):
        self.planes, self.most, self.least = found, most, least
        self.names = {f"z{neuron}": g for g, neuron in enumerate(found.neuron)}
        self.columns = [list(column) for column in zip(*found.rows, strict=True)]
        self.work = 0

    def start(self, here: Region) -> _Sum:
        _, rows, constants, above, below, *_ = self.planes
        bounds = [(g, *here.extremes(row, c)) for g, (row, c) in enumerate(zip(rows, constants, strict=True))]
        return self._settled(bounds, sum(map(max, above, below)), sum(map(min, above, below)), {}, (1, -1))

    def halve(self, state: _Sum, j: int, here: Region, half: Region) -> _Sum:
        column = self.columns[j] if self.columns else []  # of a network without a slope
        return self._settled(halved(state.free, column, j, here, half), *state[1:])

    def part(self, state: _Sum, name: str) -> tuple[_Sum, _Sum]:
        if name == "s":
            self.work += len(state.free) + 1
            if len(state.sides) < 2:
                raise _Refused
            return state._replace(sides=(1,)), state._replace(sides=(-1,))
        g = self.names[name]
        if g in state.signs:
            raise _Refused
        self.work += len(state.free) + len(state.signs)
        above, below = self.planes.above[g], self.planes.below[g]
        free = [each for each in state.free if each[0] != g]
        if len(free) == len(state.free):
            return state._replace(signs={**state.signs, g: -1}), state._replace(signs={**state.signs, g: 1})
        high, low = state.high - max(above, below), state.low - min(above, below)
        return (
            _Sum(free, high + below, low + below, {**state.signs, g: -1}, state.sides),
            _Sum(free, high + above, low + above, {**state.signs, g: 1}, state.sides),
        )

    def closes(self, here: Region, state: _Sum, token: str) -> bool:
        if token == ".":
            return all(state.high < self.most if side > 0 else self.least < state.low for side in state.sides)
        divisor, *texts = token.split(",") if token[0] == "d" else ("e1", *token[1:].split(","))
        pairs = [MULTIPLIER.fullmatch(text) for text in texts]
        matched = [pair for pair in pairs if pair is not None]
        if len(matched) < len(pairs) or not DIVISOR.fullmatch(divisor[1:]):
            return False
        multipliers = {self.names[f"z{pair[1]}"]: int(pair[2]) for pair in matched}
        self.work += len(pairs)
        if len(multipliers) < len(pairs):
            return False
        if token[0] == "d":
            return self._bounded(here, state, int(divisor[1:]), multipliers)
        signed = all(mu * state.signs[g] > 0 for g, mu in multipliers.items())
        return signed and excluded(self.planes, here, multipliers)

    def _bounded(self, here: Region, state: _Sum, divisor: int, multipliers: dict[int, int]) -> bool:
        """Whether (2) bounds the sum on the one side that is left, with μ over the divisor."""
        self.work += len(state.free) + len(multipliers) + 1
        if len(state.sides) != 1:
            return False
        (side,) = state.sides
        unit = divisor << (self.planes.z_bits + here.bits)  # of the sum; the products μ z are in units of 1/unit
        total, bounds = (state.high if side > 0 else -state.low) * unit, {g: ends for g, *ends in state.free}
        for g, mu in multipliers.items():
            if g in state.signs:
                if mu * state.signs[g] < 0:
                    return False
                continue
            least, most = bounds[g]
            above, below = side * self.planes.above[g] * unit, side * self.planes.below[g] * unit
            shifted = (
                max(above, below - ((mu * least) << self.planes.slope_bits))
                if mu > 0
                else max(above - ((mu * most) << self.planes.slope_bits), below)
            )
            total += shifted - max(above, below)
        if multipliers:
            total += here.extremes(*combined(self.planes, multipliers))[1] << self.planes.slope_bits
        return total < (self.most if side > 0 else -self.least) * unit

    def _settled(
        self, bounds: list[tuple[int, int, int]], high: int, low: int, signs: dict[int, int], sides: tuple[int, ...]
    ) -> _Sum:
        """The same region, with the planes whose sign the bounds decide counted on that side."""
        self.work += len(bounds)
        free, (above, below) = [], self.planes[3:5]
        for each in bounds:
            g, least, most = each
            if least < 0 < most:
                free.append(each)
                continue
            value = above[g] if least >= 0 else below[g]
            high, low = high - max(above[g], below[g]) + value, low - min(above[g], below[g]) + value
        return _Sum(free, high, low, signs, sides)


class _Range:
    """f stays in the box's interval of x. Its nodes have no state."""

    def __init__(self, weights: ShallowWeights, box: Box):
        self.a, self.a_bits = integers(weights.a)
        self.rows, self.constants, self.z_bits = forms(weights, box)
        self.work = 0

    def start(self, here: Region) -> None:
        return None

    def halve(self, state: None, j: int, here: Region, half: Region) -> None:
        return None

    def part(self, state: None, name: str) -> tuple[None, None]:
        raise _Refused

    def closes(self, here: Region, state: None, token: str) -> bool:
        if token != ".":
            return False
        one, width = 1 << CHORD, len(here.lo)
        self.work += (1 + width) * len(self.rows)
        upper, lower = [0] * (width + 1), [0] * (width + 1)  # linear functions, the constant last
        for ai, row, constant in zip(self.a, self.rows, self.constants, strict=True):
            least, most = here.extremes(row, constant)
            if not ai or most <= 0:
                continue
            chord = one if least >= 0 else -(-most * one // (most - least))
            support = one if most > -least else 0
            over, under = (upper, lower) if ai > 0 else (lower, upper)
            for total, slope, shift in ((over, chord, min(least, 0)), (under, support, 0)):
                for j, k in enumerate(row):
                    total[j] += ai * slope * k
                total[-1] += ai * slope * ((constant << here.bits) - shift)
        unit = self.a_bits + CHORD + self.z_bits  # of a form's value, above the region's own bits
        most = sum(k * (here.hi[j] if k > 0 else here.lo[j]) for j, k in enumerate(upper[:-1])) + upper[-1]
        least = sum(k * (here.lo[j] if k > 0 else here.hi[j]) for j, k in enumerate(lower[:-1])) + lower[-1]
        return here.root_lo << unit <= least and most <= here.root_hi << unit


def _replay(tree: str, box: Box, statement: _Statement) -> bool:
    """Whether the text is one complete tree and every leaf proves the statement."""
    tokens = tree.split() if isinstance(tree, str) and tree.isascii() else []
    coordinates = {"x": 0, **{f"u{j}": j for j in range(1, len(box.lo))}}
    halvings = _halvings(tokens, coordinates)
    if halvings is None or halvings > HALVINGS or not (np.isfinite(box.lo).all() and np.isfinite(box.hi).all()):
        return False
    whole = region(box, halvings)
    pending = [(whole, statement.start(whole))]
    try:
        for token in tokens:
            here, state = pending.pop()
            if token in coordinates:
                j = coordinates[token]
                halves = here.halves(j)
                if halves is None:
                    return False
                pending += [(half, statement.halve(state, j, here, half)) for half in reversed(halves)]
            elif token[0] in "zs":
                pending += [(here, side) for side in reversed(statement.part(state, token))]
            elif token[0] not in ".ed" or not statement.closes(here, state, token):
                return False
            if statement.work > WORK:
                return False
    except (_Refused, KeyError):  # a neuron that does not exist, or was split before, or was not split
        return False
    return True


def _halvings(tokens: list[str], coordinates: dict[str, int]) -> int | None:
    """The most halvings on a path; None where the tokens are no tree."""
    pending, most = [0], 0
    for token in tokens:
        if not pending:
            return None
        count = pending.pop()
        if token in coordinates:
            count += 1
            most = max(most, count)
        if token[0] not in ".ed":
            pending += [count, count]
    return None if pending else most
