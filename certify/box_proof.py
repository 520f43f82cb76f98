"""Replay of a proof about a network on a box, in integers: nothing here trusts the search that found the proof.

A proof is a binary tree that divides the box, as text in preorder, its tokens separated by blanks:

    x, u1, u2, …   halve the box along that coordinate, at (lo + hi)/2 in binary64: the lower half's proof follows, then
                   the upper's; they cover the box wherever it is cut
    z4             split the region by the sign of z of neuron 4: first z < 0, then z > 0
    .              the bound holds here by interval arithmetic on the box, with the signs of z fixed so far
    e4:3,7:-2      no point of the box's interior has these signs: μ = (3, −2) has the signs that z₄ and z₇ were given,
                   so Σ μ_i z_i > 0 would follow, but its maximum over the box is ≤ 0 (Farkas)

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

from certify.box_planes import Box, Region, excluded, forms, integers, planes, region
from certify.weights import ShallowWeights

HALVINGS = 1000  # on a path; each adds a bit to the box's integers
DIGITS = 1500  # of a multiplier
WORK = 4_000_000  # bounds of hyperplanes in a replay, about 2 s
CHORD = 64  # bits of a chord's slope, rounded up
MULTIPLIER = re.compile(rf"([0-9]{{1,9}}):(-?[0-9]{{1,{DIGITS}}})")


def proves(weights: ShallowWeights, box: Box, tree: str, rate: float | Fraction) -> bool:
    """Whether a tree proves |slope| < rate at every point of the box where the slope is defined.

    The rate is then a Lipschitz constant of x ↦ f(x, u) on the box's interval of x, for every u of the box.

    >>> half = ShallowWeights(np.array([0.5]), np.array([1.0]), np.zeros((1, 0)), np.zeros(1))
    >>> unit = Box(np.zeros(1), np.ones(1))
    >>> proves(half, unit, ".", 0.6), proves(half, unit, ".", 0.5), proves(half, unit, "x .", 0.6)
    (True, False, False)
    """
    return _replay(tree, box, _Slopes(weights, box, Fraction(rate)))


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


class _Slope(NamedTuple):
    """The bounds of the slope in a region, in units of 2^−slope_bits."""

    free: list[tuple[int, int, int]]  # planes whose sign is open, with the bounds of z
    high: int  # the greatest slope
    low: int  # the least
    signs: dict[int, int]  # of the planes at which the region was split


class _Slopes:
    """|slope| < rate."""

    def __init__(self, weights: ShallowWeights, box: Box, rate: Fraction):
        self.planes = planes(weights, box)
        self.limit: int = math.ceil(rate * 2**self.planes.slope_bits)  # an integer is below both or below neither
        self.names = {f"z{neuron}": g for g, neuron in enumerate(self.planes.neuron)}
        self.columns = [list(column) for column in zip(*self.planes.rows, strict=True)]
        self.work = 0

    def start(self, here: Region) -> _Slope:
        _, rows, constants, above, below, *_ = self.planes
        bounds = [(g, *here.extremes(row, c)) for g, (row, c) in enumerate(zip(rows, constants, strict=True))]
        return self._settled(bounds, sum(map(max, above, below)), sum(map(min, above, below)), {})

    def halve(self, state: _Slope, j: int, here: Region, half: Region) -> _Slope:
        column, raised, lowered = self.columns[j], half.lo[j] - here.lo[j], half.hi[j] - here.hi[j]
        bounds = []
        for g, least, most in state.free:
            k = column[g]
            if k > 0:
                bounds.append((g, least + k * raised, most + k * lowered))
            else:
                bounds.append((g, least + k * lowered, most + k * raised))
        return self._settled(bounds, *state[1:])

    def part(self, state: _Slope, name: str) -> tuple[_Slope, _Slope]:
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
            _Slope(free, high + below, low + below, {**state.signs, g: -1}),
            _Slope(free, high + above, low + above, {**state.signs, g: 1}),
        )

    def closes(self, here: Region, state: _Slope, token: str) -> bool:
        if token == ".":
            return state.high < self.limit and -state.low < self.limit
        pairs = [MULTIPLIER.fullmatch(pair) for pair in token[1:].split(",")]
        matched = [pair for pair in pairs if pair is not None]
        if len(matched) < len(pairs):
            return False
        multipliers = {self.names[f"z{pair[1]}"]: int(pair[2]) for pair in matched}
        self.work += len(pairs)
        signed = all(mu * state.signs[g] > 0 for g, mu in multipliers.items())
        return len(multipliers) == len(pairs) and signed and excluded(self.planes, here, multipliers)

    def _settled(self, bounds: list[tuple[int, int, int]], high: int, low: int, signs: dict[int, int]) -> _Slope:
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
        return _Slope(free, high, low, signs)


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
            elif token[0] == "z":
                pending += [(here, side) for side in reversed(statement.part(state, token))]
            elif token[0] not in ".e" or not statement.closes(here, state, token):
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
        if token[0] not in ".e":
            pending += [count, count]
    return None if pending else most
