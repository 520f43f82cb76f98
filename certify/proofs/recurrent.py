"""The contraction of h⁺ = φ(W h + W₂ u + b), slopes of φ in [0, 1], in integers.

Equations (1) and (2): `docs/certification.md#torch-rnn`. The inputs, W₂ and b do not matter. (1) is exact over all D.
With a diagonal P the best Λ is P, since λ²/(2λ − p) ≥ p. Then (2) is κ² P − WᵀPW ≻ 0: a scaled spectral norm.

Proof of M ≻ 0: some X near the inverse of the Cholesky factor of M makes X M Xᵀ, an exact integer matrix, strictly
dominated by its diagonal. So X M Xᵀ ≻ 0, hence X is regular, and M ≻ 0. The floats that propose X prove nothing. The
numbers do not grow, as they do in LDLᵀ: 64 states take a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike

from certify.proofs.rational import Matrix, over_one_denominator

BITS = 53  # of the entries of X


def diagonal_rate(W: Matrix, norm: str, scaling: Sequence[Fraction]) -> Fraction:
    """(1) in a norm, "inf" or "one", for the diagonal of a regular T."""
    columns, weights = (W, [1 / t for t in scaling]) if norm == "inf" else (zip(*W, strict=True), scaling)
    (whole,), _ = over_one_denominator([list(map(abs, weights))])
    rows, unit = over_one_denominator([list(map(abs, column)) for column in columns])
    return max(Fraction(sum(map(int.__mul__, row, whole)), unit * size) for row, size in zip(rows, whole, strict=True))


def proves(W: ArrayLike, metric: Matrix, multipliers: Sequence[Fraction], kappa: Fraction) -> bool:
    """Whether P and Λ prove the rate κ by (2).

    Args:
        W: `(n, n)` floats.
        metric: P, `(n, n)`, symmetric.
        multipliers: the diagonal of Λ, `(n,)`.
        kappa: κ, above 0, no unit.

    Returns:
        True after the proof, in integers. False says nothing about other P and Λ.

    >>> one, zero = Fraction(1), Fraction(0)
    >>> proves([[0.0, 0.5], [0.5, 0.0]], [[one, zero], [zero, one]], [one, one], Fraction(51, 100))
    True
    """
    n, (V, unit) = len(metric), _whole(W)
    rows, _ = over_one_denominator([*metric, list(multipliers)])
    P, lam = np.array(rows[:-1], dtype=object), np.array(rows[-1], dtype=object)
    square, share = (kappa * kappa).as_integer_ratio()
    if (P == np.diag(lam)).all():
        return positive_definite(square * unit**2 * P - share * (V.T @ (lam[:, None] * V)))
    M = np.zeros((2 * n, 2 * n), dtype=object)
    M[:n, :n], M[n:, n:] = square * unit * P, share * unit * (2 * np.diag(lam) - P)
    M[n:, :n] = -share * lam[:, None] * V
    M[:n, n:] = M[n:, :n].T
    return positive_definite(M)


def positive_definite(M: np.ndarray) -> bool:
    """Whether a symmetric matrix of integers is proved positive definite; False says nothing."""
    n, diagonal = len(M), np.diag(M).tolist()
    if min(diagonal) <= 0:
        return False
    half = [x.bit_length() // 2 for x in diagonal]
    try:
        near = np.array([[M[i, j] / (1 << (half[i] + half[j])) for j in range(n)] for i in range(n)])
        X = np.linalg.inv(np.linalg.cholesky(near))
        largest = max(half)
        whole = [[int(x * 2.0**BITS) << (largest - shift) for x, shift in zip(row, half, strict=True)] for row in X]
    except (np.linalg.LinAlgError, OverflowError, ValueError):
        return False
    Y = np.array(whole, dtype=object)
    Y = Y @ M @ Y.T
    return all(2 * Y[i, i] > sum(map(abs, Y[i])) for i in range(n))


def effort(W: ArrayLike, numbers: Sequence[Fraction], products: float) -> float:
    """About how many ns so many products take, told before a check from the sizes of W and of a proof's numbers."""
    bits, below = 0, 1
    for x in numbers:
        bits = max(bits, x.numerator.bit_length())
        if below % x.denominator:
            below = below * x.denominator
        if below.bit_length() > 2**14:  # hostile: numbers of one proof have one short denominator
            return float("inf")
    V, unit = _whole(W)
    bits += 3 * below.bit_length() + unit.bit_length() + max((abs(x).bit_length() for x in V.flat), default=0)
    return products * (80 + bits**2 / 4000)


def _whole(W: ArrayLike) -> tuple[np.ndarray, int]:
    """Integers and their common denominator, a power of two."""
    ratios = [x.as_integer_ratio() for x in np.asarray(W, dtype=np.float64).ravel().tolist()]
    unit = max(below for _, below in ratios)
    return np.array([above * (unit // below) for above, below in ratios], dtype=object).reshape(np.shape(W)), unit
