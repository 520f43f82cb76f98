"""The contraction of a network with a vector state, in rational arithmetic: floats are rationals.

Equations (1) to (3): `docs/certification.md#vector-states`. (2) is exact over all activation patterns, since each term
of [J ε]_r is largest at one end of its d_i, whatever the others are. K_1 is K_∞ of the transposed matrices. With two
hidden layers the first layer's interval is propagated to the second, for each ε; the result bounds the rate from above.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

from certify.errors import CertifyError
from certify.networks.vector import Activation, VectorWeights, is_recurrent
from certify.proofs import recurrent
from certify.proofs.exact import definiteness, pairwise_sum, power_below
from certify.proofs.rational import (
    ZERO,
    Matrix,
    diagonal,
    identity,
    inverse,
    matrix,
    over_one_denominator,
    product,
    transposed,
)

Slopes = Sequence[tuple[Fraction, Fraction]]  # the least and the greatest slope of each neuron of a layer
NORMS = ("inf", "one")
WORK = 5e9  # of LDLᵀ, in about ns: a proof from elsewhere may have numbers of any length


class Proof(NamedTuple):
    """P and the multipliers of (3)."""

    metric: Matrix  # (q, q)
    multipliers: list[list[Fraction]]  # the diagonals of Λ₀ and, with two hidden layers, of Λ₁


def everywhere(weights: VectorWeights, phi: Activation) -> list[Slopes]:
    """The slopes of φ on all of ℝ, for each hidden layer."""
    layers = [weights.b] if weights.c is None else [weights.b, weights.c]
    return [[(phi.least, phi.most)] * len(layer) for layer in layers]


def changed(weights: VectorWeights, scaling: Matrix | None = None) -> tuple[Matrix, Matrix, Matrix]:
    """T R T⁻¹, T A and W T⁻¹ exactly: the matrices of the state T x; a CertifyError if T is singular."""
    R, A, W = matrix(weights.R), matrix(weights.A), matrix(weights.W)
    if scaling is None:
        return R, A, W
    back = inverse(scaling)
    if back is None:
        raise CertifyError("scaling: found a singular T, expected a regular one")
    return product(product(scaling, R), back), product(scaling, A), product(W, back)


def rate(
    weights: VectorWeights, slopes: Sequence[Slopes], norm: str = "inf", scaling: Matrix | None = None
) -> Fraction:
    """K of (2), over all slopes; with two hidden layers a bound of it.

    Args:
        weights: of one network, checked.
        slopes: of each hidden layer, see `everywhere`.
        norm: "inf" or "one".
        scaling: T, `(q, q)`; the identity by default.

    Returns:
        K, an exact fraction without a unit.

    Raises:
        CertifyError: T is singular.

    >>> from certify.networks.vector import RELU, check
    >>> net = check(VectorWeights(None, [[0.5, -1.0]], [[1.0], [0.75]], [[], []], [0.0, 0.0]))
    >>> rate(net, everywhere(net, RELU))
    Fraction(3, 4)
    """
    t = diagonal(identity(len(weights.W[0])) if scaling is None else scaling)
    if is_recurrent(weights) and t is not None:
        [(_, most), *_], *_ = slopes
        return most * recurrent.diagonal_rate(matrix(weights.W), norm, t)
    return max(value for _, values in row_sums(weights, slopes, norm, scaling) for value in values)


def row_sums(
    weights: VectorWeights, slopes: Sequence[Slopes], norm: str = "inf", scaling: Matrix | None = None
) -> list[tuple[tuple[int, ...], list[Fraction]]]:
    """For each ε the greatest [J ε]_r of all r, whose maximum is (2); with two hidden layers bounds of them.

    Arguments and errors are those of `rate`. Computed in integers over common denominators.
    """
    R, A, W = changed(weights, scaling)
    middle = [] if weights.V is None else [matrix(weights.V)]
    layers, ranges = [W, *middle, A], list(slopes)
    if norm == "one":
        R, layers, ranges = transposed(R), [transposed(X) for X in reversed(layers)], ranges[::-1]
    direct, unit = over_one_denominator(R)
    integers = [over_one_denominator(X) for X in layers]
    ends = []
    for each in ranges:
        flat, below = over_one_denominator([[x for pair in each for x in pair]])
        ends.append((list(zip(flat[0][::2], flat[0][1::2], strict=True)), below))
    whole = math.prod([below for _, below in integers]) * math.prod([below for _, below in ends])
    sums = []
    for signs in itertools.product((-1, 1), repeat=len(R)):
        least = greatest = [sum(x for x in _signed(row, signs)) for row in integers[0][0]]
        for (X, _), (bounds, _) in zip(integers[1:], ends, strict=True):
            pairs = [
                (min(lo * x, hi * x), max(lo * y, hi * y))
                for (lo, hi), x, y in zip(bounds, least, greatest, strict=True)
            ]
            least = [sum(k * (x if k > 0 else y) for k, (x, y) in zip(row, pairs, strict=True)) for row in X]
            greatest = [sum(k * (y if k > 0 else x) for k, (x, y) in zip(row, pairs, strict=True)) for row in X]
        values = [sum(_signed(row, signs)) * whole + y * unit for row, y in zip(direct, greatest, strict=True)]
        sums.append((signs, [Fraction(value, whole * unit) for value in values]))
    return sums


def _signed(row: Sequence[int], signs: Sequence[int]) -> list[int]:
    return [x if sign > 0 else -x for x, sign in zip(row, signs, strict=True)]


def gershgorin(weights: VectorWeights) -> tuple[Fraction, Fraction | None]:
    """The paper's lemma for a vector state.

    With one hidden layer of relu, ‖W_i‖₁ < 1 for all i, and for all r

        Σ_k (|R_rk| + |R_kr|) + Σ_i |A_ri| + Σ_i |W_ir| ‖A_·i‖₁ / (1 − ‖W_i‖₁) < 2.

    Args:
        weights: of one network, checked.

    Returns:
        Its margin, and the smallest rate at which it holds, no unit; None in place of the rate if there is none.

    >>> from certify.networks.vector import check
    >>> gershgorin(check(VectorWeights(None, [[0.5]], [[0.5]], [[]], [0.0])))
    (Fraction(1, 2), Fraction(1, 2))
    """
    R, A, W = ([[abs(x) for x in row] for row in matrix(X)] for X in (weights.R, weights.A, weights.W))
    columns, room = [sum(column, ZERO) for column in zip(*A, strict=True)], [1 - sum(row, ZERO) for row in W]
    least = min(room)
    sums = []
    for r, (row, row_R) in enumerate(zip(A, R, strict=True)):
        total = sum(row_R, ZERO) + sum((other[r] for other in R), ZERO) + sum(row, ZERO)
        shares = [w[r] * column / left for w, column, left in zip(W, columns, room, strict=True) if left > 0]
        sums.append(total + pairwise_sum(shares))
    half = max(sums) / 2
    return min(1 - half, least), half if least > 0 else None


def gershgorin_proof(weights: VectorWeights, kappa: Fraction) -> Proof | None:
    """P and Λ that prove a rate for β = 2 where the lemma holds at it; None where it does not, or with two layers.

    At the rate κ the lemma makes [2I − P, R/κ, A/κ; ·, P, −WᵀΛ; ·, ·, Λ] strictly dominated by its diagonal for some
    diagonal P and Λ: its sums leave a slack, which is shared by λ_i and both sides of p_r. As 2 − p ≤ 1/p, the matrix
    with P⁻¹ in place of 2I − P is positive definite, too. Scaled by P, κ I and κ I, it is (3) with κ²Λ/2 for Λ.
    """
    half = None if weights.V is not None else gershgorin(weights)[1]
    if half is None or not half < kappa:
        return None
    R, A, W = ([[abs(x) for x in row] for row in matrix(X)] for X in (weights.R, weights.A, weights.W))
    slack = power_below((2 - 2 * half / kappa) / 4)
    unit = slack / 2 ** len(W).bit_length()  # at most slack/n
    shares = [
        sum(column, ZERO) / kappa / (1 - sum(row, ZERO)) for column, row in zip(zip(*A, strict=True), W, strict=True)
    ]
    lam = [(share // (unit / 2) + 1) * unit / 2 for share in shares]
    metric = identity(len(R))
    for r in range(len(R)):
        least = sum((row[r] for row in R), ZERO) / kappa + sum((w[r] * x for w, x in zip(W, lam, strict=True)), ZERO)
        metric[r][r] = (least // slack + 1) * slack
    return Proof(metric, [[kappa * kappa * x / 2 for x in lam]])


def inequality(
    weights: VectorWeights, phi: Activation, proof: Proof, kappa: Fraction, most: Fraction | None = None
) -> Matrix:
    """M of (3); `most` is β, by default φ's greatest slope."""
    P, lam = proof.metric, proof.multipliers
    alpha, beta = phi.least, phi.most if most is None else most
    R, A, W = matrix(weights.R), matrix(weights.A), matrix(weights.W)
    q, n = len(R), len(W)
    widths = [q, q, n] + ([] if weights.V is None else [len(lam[1])])
    starts = [0, *itertools.accumulate(widths)]
    M = [[ZERO] * starts[-1] for _ in range(starts[-1])]

    def put(i: int, j: int, block: Matrix) -> None:
        for r, row in enumerate(block):
            for c, x in enumerate(row):
                if x:
                    M[starts[i] + r][starts[j] + c] += x
                    if i != j:
                        M[starts[j] + c][starts[i] + r] += x

    put(0, 0, P)
    put(0, 1, product(P, R))
    put(0, len(widths) - 1, product(P, A))
    put(1, 1, [[kappa * kappa * x for x in row] for row in P])
    for k, X in enumerate([W] if weights.V is None else [W, matrix(weights.V)]):
        weighted = [[x * y for x in row] for row, y in zip(X, lam[k], strict=True)]  # Λ X
        for i, y in enumerate(lam[k], starts[2 + k]):
            M[i][i] += 2 * y
        put(1 + k, 2 + k, [[-(alpha + beta) * x for x in row] for row in transposed(weighted)])
        if alpha * beta:
            put(1 + k, 1 + k, [[2 * alpha * beta * x for x in row] for row in product(transposed(X), weighted)])
    return M


def effort(weights: VectorWeights, scaling: Matrix | None = None, norm: str = "inf") -> float:
    """About how many ns it takes to check a proof, told from the sizes and before any work: compare with `WORK`.

    It is that of a rate (2) in a norm with T, `(q, q)`; without it, of M (3), before its LDLᵀ.
    """
    q, n, last = len(weights.R), len(weights.b), 0 if weights.c is None else len(weights.c)
    if is_recurrent(weights) and scaling is not None and (t := diagonal(scaling)) is not None:
        return recurrent.effort(weights.W, [1 / x for x in t] if norm == "inf" else t, 16.0 * q * q)
    if scaling is None:
        return 150.0 * (2 * q + n + last) ** 2
    back = inverse(scaling)
    if back is None:
        raise CertifyError("scaling: found a singular T, expected a regular one")
    numbers = [*itertools.chain(*scaling), *itertools.chain(*back)]
    bits = 106 + sum(over_one_denominator(X)[1].bit_length() for X in (scaling, back))
    bits += max(x.numerator.bit_length() - x.denominator.bit_length() for x in numbers)
    fractions, whole = 2 * n * q * q, float(2 ** (q + 1) * (n * q + (n + q) * last))
    return fractions * (4000 + 5 * bits + bits**2 / 4000) + whole * (100 + bits**2 / 4000)


def proves(
    weights: VectorWeights, phi: Activation, proof: Proof, kappa: Fraction, most: Fraction | None = None
) -> bool:
    """Whether P and Λ prove the rate κ: shapes that fit, Λ ≻ 0, M ≻ 0 (3), which contains P ≻ 0.

    Args:
        weights: of one network, checked.
        phi: its activation.
        proof: P and Λ.
        kappa: the rate κ, no unit.
        most: β, the largest slope of φ, no unit; by default that of `phi`.

    Returns:
        True after the proof, in rational arithmetic. False also where LDLᵀ takes longer than about 5 s.

    >>> from certify.networks.vector import RELU, check
    >>> net = check(VectorWeights(None, [[0.5]], [[1.0]], [[]], [0.0]))
    >>> half = Proof([[Fraction(1)]], [[Fraction(1, 2)]])
    >>> proves(net, RELU, half, Fraction(3, 4)), proves(net, RELU, half, Fraction(1, 2))
    (True, False)
    """
    q, sizes = len(weights.R), [len(weights.b)] + ([] if weights.c is None else [len(weights.c)])
    P = proof.metric
    if kappa <= 0 or len(P) != q or any(len(row) != q for row in P) or P != transposed(P):
        return False
    if [len(each) for each in proof.multipliers] != sizes or not all(x > 0 for each in proof.multipliers for x in each):
        return False
    if is_recurrent(weights) and (phi.most if most is None else most) <= 1:
        numbers, (lam,) = [kappa * kappa, *itertools.chain(*P, *proof.multipliers)], proof.multipliers
        products = q**3 * (3.0 if diagonal(P) == lam else 16.0)
        return recurrent.effort(weights.W, numbers, products) <= WORK and recurrent.proves(weights.W, P, lam, kappa)
    return definiteness(inequality(weights, phi, proof, kappa, most), WORK) == 1
