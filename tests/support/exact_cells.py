"""An oracle for rates on a box: the activation cells of a small network, enumerated in rational arithmetic.

A cell is a polytope, kept as its vertices, each with the set of the constraints that are tight there. A hyperplane cuts
the edges: the pairs of vertices whose common tight constraints have rank d − 1. No linear program and no tolerance is
needed, so that the oracle shares nothing with the search that it checks.
"""

from collections.abc import Iterator
from fractions import Fraction
from itertools import product

import numpy as np

from certify.networks.shallow import ShallowWeights
from certify.proofs.box_planes import Box


def exact_rate(weights: ShallowWeights, box: Box) -> Fraction:
    """The largest |slope| over the open cells that meet the box; every side of the box has a width."""
    a, w1, W2, b = (np.asarray(x, dtype=np.float64) for x in weights)
    forms, slopes = [], []
    for ai, wi, row, bi in zip(a.tolist(), w1.tolist(), W2.tolist(), b.tolist(), strict=True):
        if ai and wi:
            forms.append(tuple(map(Fraction, (wi, *row, bi))))
            slopes.append(Fraction(ai) * Fraction(wi))
    cells = _cells(forms, [*zip(map(Fraction, box.lo.tolist()), map(Fraction, box.hi.tolist()), strict=True)])
    return max(abs(sum(s for s, on in zip(slopes, signs, strict=True) if on)) for signs in cells)


def _cells(forms: list[tuple[Fraction, ...]], sides: list[tuple[Fraction, Fraction]]) -> Iterator[tuple[bool, ...]]:
    """The signs of all forms, the constant last, over each of their open cells in a box."""
    d = len(sides)
    unit = [tuple(Fraction(j == k) for k in range(d)) for j in range(d)]
    normals = [*unit, *unit, *(form[:-1] for form in forms)]  # of the lower sides, the upper sides, the hyperplanes
    corners = product(*([(lo, j), (hi, d + j)] for j, (lo, hi) in enumerate(sides)))
    pending = [((), [(tuple(x for x, _ in corner), frozenset(k for _, k in corner)) for corner in corners])]
    while pending:
        signs, vertices = pending.pop()
        if len(signs) == len(forms):
            yield signs
            continue
        k, (*normal, constant) = 2 * d + len(signs), forms[len(signs)]
        heights = [sum((c * x for c, x in zip(normal, y, strict=True)), constant) for y, _ in vertices]
        split = [
            _between(p, q, hp, hq, k)
            for (p, hp), (q, hq) in product(zip(vertices, heights, strict=True), repeat=2)
            if hp < 0 < hq and _rank([normals[j] for j in p[1] & q[1]]) == d - 1
        ]
        split += [(y, tight | {k}) for (y, tight), height in zip(vertices, heights, strict=True) if height == 0]
        for on in (False, True):
            side = [v for v, height in zip(vertices, heights, strict=True) if (height > 0 if on else height < 0)]
            if side:
                pending.append(((*signs, on), side + split))


def _between(p, q, hp: Fraction, hq: Fraction, plane: int):
    """Where the edge from p to q meets the plane."""
    share = hp / (hp - hq)
    return tuple(x + share * (y - x) for x, y in zip(p[0], q[0], strict=True)), (p[1] & q[1]) | {plane}


def _rank(rows: list[tuple[Fraction, ...]]) -> int:
    rows, rank = [list(row) for row in rows], 0
    for column in range(len(rows[0]) if rows else 0):
        pivot = next((k for k in range(rank, len(rows)) if rows[k][column]), None)
        if pivot is None:
            continue
        rows[rank], rows[pivot] = rows[pivot], rows[rank]
        for k in range(rank + 1, len(rows)):
            if rows[k][column]:
                share = rows[k][column] / rows[rank][column]
                rows[k] = [x - share * y for x, y in zip(rows[k], rows[rank], strict=True)]
        rank += 1
    return rank
