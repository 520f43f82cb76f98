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
from certify.networks.vector import Activation, VectorWeights
from certify.proofs.box_planes import Box
from certify.proofs.vector_exact import Matrix, identity, inverse
from certify.proofs.vector_exact import product as times


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


def exact_norm(weights: VectorWeights, phi: Activation, box: Box, norm: str, scaling: Matrix | None = None) -> Fraction:
    """The largest ‖T J T⁻¹‖ of a network with one hidden layer of relu or leaky over the same cells."""
    T = identity(len(weights.R)) if scaling is None else scaling
    R, A, W, W2, b = (_exact(x) for x in (weights.R, weights.A, weights.W, weights.W2, weights.b[:, None]))
    back, sizes = inverse(T), []
    forms = [(*w, *w2, *constant) for w, w2, constant in zip(W, W2, b, strict=True)]
    crossing = [i for i, form in enumerate(forms) if any(form[:-1])]
    for signs in _cells([forms[i] for i in crossing], [*zip(*(_exact([x])[0] for x in box), strict=True)]):
        slope = {i: Fraction(1) if on else phi.least for i, on in zip(crossing, signs, strict=True)}
        moved = [[slope.get(i, Fraction(0)) * x for x in row] for i, row in enumerate(W)]
        J = [[x + y for x, y in zip(*rows, strict=True)] for rows in zip(R, times(A, moved), strict=True)]
        J = times(times(T, J), back)
        sizes += [sum(map(abs, row)) for row in (J if norm == "inf" else zip(*J, strict=True))]
    return max(sizes)


def _exact(x: np.ndarray) -> list[list[Fraction]]:
    return [[Fraction(value) for value in row] for row in np.asarray(x, dtype=np.float64).tolist()]


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
