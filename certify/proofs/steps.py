"""One proof of contraction for all steps up to the largest: Euler steps of the flow that a network has learned.

Equations (1) and (2): `docs/certification.md#all-steps`. f_η is a network of the same kind: R_η = (1 − η) I + η R,
A_η = η A. In any norm the rate K(η) is convex in η, and K(0) = 1, so that one proof at η_max proves every smaller step.
In the ∞-norm, with c_rε = max [J ε]_r over all slopes (`certify.proofs.vector_exact`),

    K(η) = max(1 + η μ, −1 + η (1 + ν)),   μ = max_{ε_r = 1} c_rε − 1,   ν = max_{ε_r = −1} c_rε              (3)

So every η < 2/(1 + ν) contracts if μ < 0, and no step does if μ ≥ 0. Up to η = 2/(1 + ν − μ) the rate of (2) in time is
the greatest possible, −μ/h. With two hidden layers (3) bounds K(η) from above.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

from certify.networks.vector import VectorWeights
from certify.proofs.rational import Matrix, identity, matrix
from certify.proofs.vector_exact import Slopes, row_sums

BITS = 20  # after the point of the step that `short` gives


class Steps(NamedTuple):
    """μ and ν of (3)."""

    measure: Fraction  # μ
    reach: Fraction  # ν

    @property
    def largest(self) -> Fraction:
        """The least η that does not contract; every η in (0, largest) does. 0 where no step contracts."""
        return 2 / (1 + self.reach) if self.measure < 0 else Fraction(0)

    @property
    def fastest(self) -> Fraction:
        """The largest η up to which λ of (2) is −μ/h; 0 where no step contracts."""
        return 2 / (1 + self.reach - self.measure) if self.measure < 0 else Fraction(0)

    def rate(self, eta: Fraction) -> Fraction:
        """K(η) of (3)."""
        return max(1 + eta * self.measure, eta * (1 + self.reach) - 1)


def steps(weights: VectorWeights, slopes: Sequence[Slopes], norm: str = "inf", scaling: Matrix | None = None) -> Steps:
    """μ and ν, exact over all slopes; with two hidden layers bounds from above.

    Args:
        weights: of one network, checked.
        slopes: of each hidden layer, see `everywhere`.
        norm: "inf" or "one".
        scaling: T, `(q, q)`; the identity by default.

    Returns:
        μ and ν, fractions; `largest` is the least step of the network that does not contract.

    >>> from certify.networks.vector import RELU, ShallowWeights, of_shallow
    >>> from certify.proofs.vector_exact import everywhere
    >>> net = of_shallow(ShallowWeights([0.5, -0.25], [1.0, 1.0], [[], []], [0.0, 1.0]))
    >>> limits = steps(net, everywhere(net, RELU))  # P = ½, N = ¼
    >>> limits.measure, limits.reach, limits.largest
    (Fraction(-1, 2), Fraction(1, 4), Fraction(8, 5))
    """
    sums = row_sums(weights, slopes, norm, scaling)
    high = max(value for signs, values in sums for sign, value in zip(signs, values, strict=True) if sign > 0)
    low = max(value for signs, values in sums for sign, value in zip(signs, values, strict=True) if sign < 0)
    return Steps(high - 1, low)


def stepped(weights: VectorWeights, eta: Fraction) -> VectorWeights:
    """f_η of (1) exactly: its R and A are lists of rows of fractions, for the functions of
    `certify.proofs.vector_exact`.

    Args:
        weights: of one network with one or two hidden layers.
        eta: η, a number of steps of the network.

    Returns:
        The weights of f_η, with fractions.

    >>> net = VectorWeights([[0.0]], [[0.5]], [[1.0]], [[]], [0.0])
    >>> stepped(net, Fraction(1, 3)).R, stepped(net, Fraction(1, 3)).A
    ([[Fraction(2, 3)]], [[Fraction(1, 6)]])
    """
    R, A = matrix(weights.R), matrix(weights.A)
    direct = [
        [(1 - eta) * i + eta * x for i, x in zip(*rows, strict=True)] for rows in zip(identity(len(R)), R, strict=True)
    ]
    return weights._replace(R=direct, A=[[eta * x for x in row] for row in A])


def short(largest: Fraction, bits: int = BITS) -> Fraction | None:
    """A step below the supremum, with few digits: the η_max of a certificate. None where no step contracts."""
    if largest <= 0:
        return None
    while largest * 2**bits <= 1:
        bits += 8
    return Fraction(math.ceil(largest * 2**bits) - 1, 2**bits)
