"""Replays a proof about a network on a box, in integers: nothing here trusts the search that found the proof.

A proof is a binary tree that divides the box, as text in preorder, its tokens separated by blanks:

    x, u1, u2, …   halve the box along that coordinate, at (lo + hi)/2 in binary64: the lower half's proof follows, then
                   the upper's; they cover the box wherever it is cut
    .              the bound holds here by interval arithmetic: each z_i lies in an interval on the box

A tree may come from anybody, so the effort is limited: a path has at most HALVINGS halvings, and the bounds of at most
WORK hyperplanes are computed. A tree beyond these limits is refused.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any, NamedTuple, Protocol

import numpy as np

from certify.networks.shallow import ShallowWeights
from certify.proofs.box_planes import Box, Planes, Region, forms, halved, integers, planes, region

HALVINGS = 1000  # on a path; each adds a bit to the box's integers
WORK = 4_000_000  # bounds of hyperplanes in a replay, about 2 s
CHORD = 64  # bits of a chord's slope, rounded up


def proves(weights: ShallowWeights, box: Box, tree: str, rate: float | Fraction) -> bool:
    """Whether a tree proves |slope| < rate at every point of the box where the slope is defined.

    The rate is then a Lipschitz constant of x ↦ f(x, u) on the box's interval of x, for every u of the box.
    """
    crossed = planes(weights, box)
    limit = math.ceil(Fraction(rate) * 2**crossed.slope_bits)  # an integer is below both or below neither
    return _replay(tree, box, _Slope(crossed, limit))


def proves_range(weights: ShallowWeights, box: Box, tree: str) -> bool:
    """Whether a tree, of box splits alone, proves that f maps the box into the box's interval of x.

    At a leaf relu(z) lies between αz, α = 0 or 1, and a chord; the bound is a linear function's extreme.
    """
    return _replay(tree, box, _Range(weights, box))


class _Statement(Protocol):
    """The statement that a tree proves: a state for each node, and whether a leaf proves it there."""

    work: int  # bounds of hyperplanes that were computed

    def start(self, here: Region) -> Any: ...
    def halve(self, state: Any, j: int, here: Region, half: Region) -> Any: ...
    def closes(self, here: Region, state: Any) -> bool: ...


class _Bounds(NamedTuple):
    """The bounds of the slope in a region, in the unit of above and below."""

    free: list[tuple[int, int, int]]  # planes whose sign is open, with the bounds of z
    high: int  # the greatest slope
    low: int  # the least


class _Slope:
    """−limit < slope < limit."""

    def __init__(self, planes: Planes, limit: int):
        self.planes, self.limit = planes, limit
        self.columns = [list(column) for column in zip(*planes.rows, strict=True)]
        self.work = 0

    def start(self, here: Region) -> _Bounds:
        rows, constants, above, below, *_ = self.planes
        bounds = [(g, *here.extremes(row, c)) for g, (row, c) in enumerate(zip(rows, constants, strict=True))]
        return self._settled(bounds, sum(map(max, above, below)), sum(map(min, above, below)))

    def halve(self, state: _Bounds, j: int, here: Region, half: Region) -> _Bounds:
        column = self.columns[j] if self.columns else []  # of a network without a slope
        return self._settled(halved(state.free, column, j, here, half), *state[1:])

    def closes(self, here: Region, state: _Bounds) -> bool:
        return -self.limit < state.low and state.high < self.limit

    def _settled(self, bounds: list[tuple[int, int, int]], high: int, low: int) -> _Bounds:
        """The same region, with the planes whose sign the bounds decide counted on that side."""
        self.work += len(bounds)
        free, above, below = [], self.planes.above, self.planes.below
        for each in bounds:
            g, least, most = each
            if least < 0 < most:
                free.append(each)
                continue
            value = above[g] if least >= 0 else below[g]
            high, low = high - max(above[g], below[g]) + value, low - min(above[g], below[g]) + value
        return _Bounds(free, high, low)


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

    def closes(self, here: Region, state: None) -> bool:
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
    for token in tokens:
        here, state = pending.pop()
        if token in coordinates:
            j = coordinates[token]
            halves = here.halves(j)
            if halves is None:
                return False
            pending += [(half, statement.halve(state, j, here, half)) for half in reversed(halves)]
        elif not statement.closes(here, state):
            return False
        if statement.work > WORK:
            return False
    return True


def _halvings(tokens: list[str], coordinates: dict[str, int]) -> int | None:
    """The most halvings on a path; None where the tokens are no tree."""
    pending, most = [0], 0
    for token in tokens:
        if not pending or (token != "." and token not in coordinates):
            return None
        count = pending.pop()
        if token in coordinates:
            most = max(most, count + 1)
            pending += [count + 1, count + 1]
    return None if pending else most
