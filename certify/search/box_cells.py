"""The search of `certify.search.box` for the greatest slope over cells, where halving boxes is not enough.

Halving never ends at a point where more hyperplanes meet than there are coordinates: all of them cross every box around
it, although not all of their sign patterns occur. A small box is therefore split into cells, by the sign of one z at a
time. A linear program finds a point with the signs of a cell, or multipliers that prove that there is none. Its data
are computed in integers and rounded once, so a box may have any size. Where hyperplanes meet in a point, the
multipliers must cancel exactly, and they are solved for in fractions.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from certify.proofs.box_planes import Box, Planes, Region, excluded, region
from certify.search.box_search import Forms, Search, slopes_at

FAINT = 1e-9  # relative size below which a solver's number counts as zero
SHORT = (16, 4096, 10**8)  # denominators to which multipliers are rounded, to keep a proof short


def search_cells(search: Search, forms: Forms, queue: list[np.ndarray], rng: np.random.Generator) -> None:
    """Split boxes by the signs of z, the highest bound first, until all are closed.

    Each cell keeps a point with its signs. The next split is at a neuron whose sign at that point is not the one that
    the bound assumes. Then the point lies in one of the two new cells, and one linear program decides the other.
    """
    H, c, side, gain, start, error, slack, found = forms
    tie, stuck = itertools.count(), -math.inf
    heap: list[tuple] = []

    def push(node, signs, parted, ends, y):
        search.reached(slopes_at(forms, (H @ y + c)[None]), y[None])
        high, low = start + (signs >= 0) @ gain, start + (signs > 0) @ gain
        heapq.heappush(heap, (-max(high, -low) - slack, next(tie), node, signs, parted, ends, y, high >= -low))

    for _, lo, hi, signs, node in zip(*queue, strict=True):
        push(int(node), signs, (), (lo, hi), (lo + hi) / 2 + (hi - lo) * rng.uniform(-0.25, 0.25, len(lo)))
    while heap and not search.over():
        bound, _, node, signs, parted, (lo, hi), y, up = heapq.heappop(heap)
        if -bound <= search.threshold(search.best):
            search.closed = max(search.closed, -bound)
            heap.clear()  # the others' bounds are no higher
            break
        z = H @ y + c
        wrong = np.where((signs == 0) & ((z if up else -z) <= error), gain, 0.0)
        g = int(wrong.argmax()) if len(wrong) else 0
        if not wrong.any():  # the bound is the slope at y, up to rounding
            stuck = max(stuck, -bound)
            continue
        child = search.count
        search.count += 2
        search.splits[node] = f"z{found.neuron[g]}", child
        for k, sign in enumerate((-side[g], side[g])):
            inner, mu = y, None
            cell = (*parted, (g, int(sign)))
            if not sign * z[g] > error[g]:
                inner, mu = inner_point(forms, lo, hi, cell, rng)
            if mu:
                search.leaves[child + k] = "e" + ",".join(f"{found.neuron[i]}:{x}" for i, x in mu.items())
            elif inner is None:
                stuck = max(stuck, -bound)
            else:
                changed = signs.copy()
                changed[g] = sign
                push(child + k, changed, cell, (lo, hi), inner)
    search.open = max(stuck, -heap[0][0] if heap else -math.inf)


def inner_point(
    forms: Forms, lo: np.ndarray, hi: np.ndarray, parted: tuple[tuple[int, int], ...], rng: np.random.Generator
) -> tuple[np.ndarray | None, dict[int, int] | None]:
    """A point of a box with given signs of z, or multipliers that prove that there is none, or neither.

    The point is the deepest: with y = centre + radius v, |v_j| ≤ 1, and ρ_g the greatest change of z_g in the box,

        max t,   σ_g z_g(y) ≥ t ρ_g   for all g;   t ≤ 0 leaves no point.
    """
    from scipy.optimize import linprog

    H, c, side, _, _, error, _, found = forms
    here = region(Box(lo, hi))
    g = np.array([k for k, _ in parted])
    sigma = np.array([sign for _, sign in parted])
    signs = (sigma * side[g]).tolist()  # of the neurons' z
    rows, heights, changes = _scaled(found, here, g.tolist(), signs)
    solved = linprog(
        np.r_[np.zeros(len(lo)), -1.0],
        A_ub=np.c_[-rows, np.ones(len(g))],
        b_ub=heights,
        bounds=[(-1, 1)] * len(lo) + [(None, 1)],
        method="highs-ds",
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )
    if solved.x is None:
        return None, None
    depth = float(solved.x[-1])
    if depth > 1e-12:  # off the facets, where z of another neuron may be zero
        v = np.clip(solved.x[:-1], -1, 1)
        step = min(depth, 1.0) / 4
        y = (lo + hi) / 2 + (hi - lo) / 2 * ((1 - step) * v + step * rng.uniform(-1, 1, len(lo)))
        y = np.clip(y, lo, hi)
        if (sigma * (H[g] @ y + c[g]) > error[g]).all():
            return y, None
    dual = np.maximum(-solved.ineqlin.marginals, 0.0)
    if not dual.max() > 0:
        return None, None
    mu = _multipliers(found, here, g.tolist(), signs, dual, np.abs(dual @ rows) <= FAINT * dual.sum(), changes)
    return None, mu


def _scaled(found: Planes, here: Region, g: list[int], signs: list[int]) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """σ z as rows·v + heights over the box |v_j| ≤ 1, each divided by its change there, and those changes, integers."""
    widths, middles = list(map(int.__sub__, here.hi, here.lo)), list(map(int.__add__, here.hi, here.lo))
    rows, heights, changes = [], [], []
    for k, sign in zip(g, signs, strict=True):
        moves = list(map(int.__mul__, found.rows[k], widths))
        change = sum(map(abs, moves))
        middle = sum(map(int.__mul__, found.rows[k], middles)) + (found.constants[k] << (here.bits + 1))
        rows.append([sign * move / change for move in moves])
        heights.append(sign * middle / change)
        changes.append(change)
    return np.array(rows), np.array(heights), changes


def _multipliers(
    found: Planes,
    here: Region,
    g: list[int],
    signs: list[int],
    dual: np.ndarray,  # of the scaled rows
    still: np.ndarray,  # (1 + m,) bool: coordinates in which the rows cancel
    changes: list[int],
) -> dict[int, int] | None:
    """Integers near a solver's multipliers that prove that no point of the box has these signs: {plane: μ}.

    They are rounded to few digits if the proof still holds; otherwise they are chosen to cancel exactly.
    """
    near = [Fraction(float(x)) / change for x, change in zip(dual, changes, strict=True)]
    near = [x / max(near) for x in near]
    for finest in SHORT:
        mu = _whole([x.limit_denominator(finest) for x in near], g, signs)
        if excluded(found, here, mu):
            return mu
    used = [k for k in np.argsort(-dual, kind="stable").tolist() if dual[k] > FAINT * dual.max()]
    columns = [[signs[k] * found.rows[g[k]][j] for j in np.flatnonzero(still)] for k in used]
    exact = _cancelling(columns, [near[k] for k in used])
    mu = _whole(exact, [g[k] for k in used], [signs[k] for k in used])
    return mu if min(exact) >= 0 and excluded(found, here, mu) else None


def _whole(values: Sequence[Fraction], g: Sequence[int], signs: Sequence[int]) -> dict[int, int]:
    """The values, made integers by a common factor, with their signs."""
    unit = math.lcm(*(x.denominator for x in values))
    whole = [int(x * unit) for x in values]
    common = math.gcd(*whole) or 1
    return {k: sign * x // common for k, sign, x in zip(g, signs, whole, strict=True) if x}


def _cancelling(columns: list[list[int]], near: list[Fraction]) -> list[Fraction]:
    """x near the given ones, the largest first, with Σ x_k columns_k = 0 exactly, by Gaussian elimination.

    >>> _cancelling([[2, 0], [3, 1], [0, 3]], [Fraction(1), Fraction(-2, 3), Fraction(2, 9)])
    [Fraction(1, 1), Fraction(-2, 3), Fraction(2, 9)]
    """
    rows = [[Fraction(column[j]) for column in columns] for j in range(len(columns[0]))]
    pivots: dict[int, int] = {}  # column: row
    for k in reversed(range(len(columns))):  # the smallest depend on the largest
        row = next((r for r in range(len(rows)) if r not in pivots.values() and rows[r][k]), None)
        if row is None:
            continue
        rows[row] = [x / rows[row][k] for x in rows[row]]
        for r in range(len(rows)):
            if r != row and rows[r][k]:
                rows[r] = [x - rows[r][k] * y for x, y in zip(rows[r], rows[row], strict=True)]
        pivots[k] = row
    free = {k: x.limit_denominator(2**30) for k, x in enumerate(near) if k not in pivots}
    zero = Fraction(0)
    return [
        free[k] if k in free else -sum((rows[pivots[k]][i] * x for i, x in free.items()), zero)
        for k in range(len(near))
    ]
