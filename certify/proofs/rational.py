"""Operations on matrices of fractions, which are lists of rows."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import numpy as np

ZERO, ONE = Fraction(0), Fraction(1)
Matrix = list[list[Fraction]]


def matrix(values: Any) -> Matrix:
    """The exact values of a matrix of floats, or of fractions: a list of rows, see `certify.proofs.steps.stepped`."""
    if isinstance(values, list) and any(isinstance(x, Fraction) for row in values for x in row):
        return [[Fraction(x) for x in row] for row in values]
    return [[Fraction(*x.as_integer_ratio()) for x in row] for row in np.asarray(values, dtype=np.float64).tolist()]


def identity(q: int) -> Matrix:
    return [[Fraction(i == j) for j in range(q)] for i in range(q)]


def product(X: Matrix, Y: Matrix) -> Matrix:
    """X Y."""
    columns = list(zip(*Y, strict=True))
    return [
        [sum((x * y for x, y in zip(row, column, strict=True) if x and y), ZERO) for column in columns] for row in X
    ]


def transposed(X: Matrix) -> Matrix:
    return [list(column) for column in zip(*X, strict=True)]


def inverse(X: Matrix) -> Matrix | None:
    """X⁻¹ by Gauss and Jordan; None of a singular matrix."""
    q = len(X)
    rows = [[*row, *unit] for row, unit in zip(X, identity(q), strict=True)]
    for k in range(q):
        pivot = next((i for i in range(k, q) if rows[i][k]), None)
        if pivot is None:
            return None
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [x / rows[k][k] for x in rows[k]]
        for i in range(q):
            if i != k and (factor := rows[i][k]):
                rows[i] = [x - factor * y for x, y in zip(rows[i], rows[k], strict=True)]
    return [row[q:] for row in rows]


def diagonal(X: Matrix) -> list[Fraction] | None:
    """The diagonal of a square matrix without zeros on it; None where another entry is not zero."""
    if any(bool(x) != (i == j) for i, row in enumerate(X) for j, x in enumerate(row)):
        return None
    return [row[i] for i, row in enumerate(X)]


def over_one_denominator(X: Matrix) -> tuple[list[list[int]], int]:
    """A matrix as integers and one denominator."""
    below = math.lcm(*(x.denominator for row in X for x in row)) if X else 1
    return [[x.numerator * (below // x.denominator) for x in row] for row in X], below
