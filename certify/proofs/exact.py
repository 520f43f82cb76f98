"""The conditions, and the definiteness of their matrices, in rational arithmetic: floats are rationals.

A network is called certified only after these functions have proved it, by M(p, Λ) ≻ 0, equation (1) of
`docs/certification.md#matrix`, with a rate κ and the corner c (1: the paper's matrix, slopes in [0, 2]; 2: the
slope-restricted one, slopes in [0, 1]), for some p and a diagonal Λ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from certify.networks.shallow import ShallowWeights
from certify.proofs.rounding import float_above, float_below

CORNER = {"simple": 1, "gershgorin": 1, "lmi": 1, "exact": 2}  # c of each condition's matrix
ZERO, ONE = Fraction(0), Fraction(1)
LONGEST_SUM = 1_000_000  # bits of a sum of fractions that a check of somebody's certificate works out


class Multipliers(NamedTuple):
    """A metric and multipliers for (1)."""

    metric: Fraction  # p
    multipliers: list[Fraction]  # Λ's diagonal, (n,)


def fractions(x: ArrayLike) -> list[Fraction]:
    """The exact values of numbers, `(n,)`: floats of any size, and integers."""
    return [Fraction(*value.as_integer_ratio()) for value in np.asarray(x).ravel().tolist()]


def extreme_slopes(a: ArrayLike, w1: ArrayLike) -> tuple[Fraction, Fraction]:
    """P and N exactly; a, w₁ are `(n,)`."""
    s = [ai * wi for ai, wi in zip(fractions(a), fractions(w1), strict=True)]
    return sum((x for x in s if x > 0), ZERO), sum((-x for x in s if x < 0), ZERO)


class Condition(NamedTuple):
    """Like `certify.training.conditions.Condition`, in exact fractions."""

    margin: Fraction  # > 0 where the condition holds
    rate: Fraction | None  # the smallest rate at which it holds; None if there is none


def conditions(a: ArrayLike, w1: ArrayLike) -> dict[str, Condition]:
    """The result of every condition of `certify.training.conditions` for one network, in exact arithmetic.

    Args:
        a: `(n,)`.
        w1: `(n,)`.

    Returns:
        The margin and the rate of each condition, fractions without a unit, by its name.

    >>> [(name, float(each.margin)) for name, each in conditions([0.5], [0.5]).items()]
    [('simple', -0.5), ('gershgorin', 0.5), ('lmi', 0.5), ('exact', 0.75)]
    """
    return {name: condition(name, a, w1) for name in CORNER}


def condition(name: str, a: ArrayLike, w1: ArrayLike) -> Condition:
    """The result of one of the `conditions`."""
    if name in ("lmi", "exact"):
        K = max(extreme_slopes(a, w1)) * (2 if name == "lmi" else 1)
        return Condition(1 - K, K)
    sizes = [(abs(ai), abs(wi)) for ai, wi in zip(fractions(a), fractions(w1), strict=True)]
    n, least = len(sizes), 1 - max(wi for _, wi in sizes)
    shares = [ai / (1 - wi) for ai, wi in sizes if wi < 1]
    if name == "simple":
        margin = 1 - max((n + 1) * ai + wi for ai, wi in sizes)
        return Condition(margin, (n + 1) * max(shares) if least > 0 else None)
    half = pairwise_sum(shares) / 2
    return Condition(min(1 - half, least), half if least > 0 else None)


class Verdict(NamedTuple):
    """What is proved of one network."""

    margins: dict[str, Fraction]  # of each condition, the narrowest first; > 0 where it holds
    rate: Fraction  # K, the exact rate over all activation patterns, per step

    @property
    def held(self) -> tuple[str, ...]:
        """The conditions that hold, the narrowest first; none if the network is not certified contracting."""
        return tuple(name for name, margin in self.margins.items() if margin > 0)

    @property
    def bound(self) -> float:
        """K, rounded so that the verdict stays true."""
        return (float_above if self.held else float_below)(self.rate)


def verdict(weights: ShallowWeights) -> Verdict | None:
    """The verdict on one network; None where a weight is not finite."""
    if not all(np.isfinite(each).all() for each in weights):
        return None
    results = conditions(weights.a, weights.w1)
    K = results["exact"].rate
    assert K is not None  # it holds at some rate
    return Verdict({name: each.margin for name, each in results.items()}, K)


def as_json(verdict: Verdict | None) -> dict[str, Any]:
    """A verdict as it is saved and published."""
    held = verdict.held if verdict else ()
    return {"contracting": bool(held), "condition": held[0] if held else None, "rate": verdict and verdict.bound}


def lemma_is_long(W: ArrayLike) -> bool:
    """Whether the sum of `gershgorin` over 1/(1 − ‖W_i‖₁) may take longer than about 2 s; W is `(n,)` or `(n, q)`.

    Its denominator can be as long as all these together.
    """
    rows = np.asarray(W)
    room = [1 - sum(map(abs, fractions(row)), ZERO) for row in rows.reshape(len(rows), -1)]
    return sum(x.numerator.bit_length() for x in room) * (rows.size // len(rows)) > LONGEST_SUM


def best_gauge(a: ArrayLike, w1: ArrayLike) -> dict[str, Fraction]:
    """The smallest rates of `simple` and `gershgorin` among the equal networks (a_i/c_i, c_i w_{1i}), exactly."""
    s = [abs(ai * wi) for ai, wi in zip(fractions(a), fractions(w1), strict=True)]
    return {"simple": 4 * (len(s) + 1) * max(s), "gershgorin": 2 * sum(s, ZERO)}


def multipliers(name: str, a: ArrayLike, w1: ArrayLike, rate: Fraction | float = ONE) -> Multipliers | None:
    """p and Λ that prove a condition at a rate, in closed form.

    Args:
        name: of the condition: `simple`, `gershgorin`, `lmi` or `exact`.
        a: `(n,)`.
        w1: `(n,)`.
        rate: κ, no unit.

    Returns:
        p and the diagonal of Λ; None where the condition does not hold at the rate.

    >>> multipliers("exact", [0.9], [1.0])
    Multipliers(metric=Fraction(1, 1), multipliers=[Fraction(8106479329266893, 9007199254740992)])
    """
    smallest, rate = condition(name, a, w1).rate, Fraction(rate)
    if smallest is None or not smallest < rate:
        return None
    n, c = len(np.asarray(a)), CORNER[name]
    sizes = [(abs(ai) / rate, abs(wi)) for ai, wi in zip(fractions(a), fractions(w1), strict=True)]
    if name == "simple":
        return Multipliers(ONE, [Fraction(1, n + 1)] * n)
    if name == "gershgorin":  # the slack of the lemma's sum is shared by the λ_i and both sides of p
        shares = [ai / (1 - wi) for ai, wi in sizes]
        quarter = power_below((2 - pairwise_sum(shares)) / 4)
        lam = [share + quarter / n for share in shares]
        least = pairwise_sum([x * wi for x, (_, wi) in zip(lam, sizes, strict=True)])
        return Multipliers((least // quarter + 1) * quarter, lam)
    # λ_i = |a_i|/(κ |w_i|); where one of the two is zero, a value that keeps its share of the slack below 1/(4n)
    slack = power_below(1 - smallest / rate)
    lam = []
    for ai, wi in sizes:
        if ai and wi:
            lam.append(ai / wi)
        elif ai:
            lam.append(4 * n * ai * ai / (c * slack))
        elif wi:
            lam.append(c * slack / (4 * n * wi * wi))
        else:
            lam.append(ONE)
    return Multipliers(ONE, lam)


def matrix(
    a: ArrayLike,
    w1: ArrayLike,
    metric: Fraction,
    multipliers: Sequence[Fraction],
    rate: Fraction = ONE,
    corner: int = 2,
) -> list[list[Fraction]]:
    """M of (1), a list of rows of fractions, (n + 2, n + 2)."""
    outputs, inputs, lam = fractions(a), fractions(w1), list(multipliers)
    n = len(outputs)
    M = [[ZERO] * (n + 2) for _ in range(n + 2)]
    M[0][0], M[1][1] = 2 - Fraction(metric), Fraction(metric)
    for i in range(n):
        M[0][i + 2] = M[i + 2][0] = -outputs[i] / rate
        M[1][i + 2] = M[i + 2][1] = -inputs[i] * lam[i]
        M[i + 2][i + 2] = corner * lam[i]
    return M


def definiteness(matrix: Sequence[Sequence[Fraction]], most: float = math.inf) -> int:
    """1: a symmetric matrix is positive definite; 0: positive semidefinite; −1: neither. By LDLᵀ, the last row first.

    Args:
        matrix: rows of fractions, symmetric.
        most: work, in about ns, after which −1 is returned.
    """
    rows = [{j: x for j, x in enumerate(row) if x} for row in matrix]
    definite, work = 1, 0.0
    for k in range(len(rows) - 1, -1, -1):
        row = rows[k]
        pivot = row.pop(k, ZERO)
        if pivot < 0 or (pivot == 0 and row):
            return -1
        if pivot == 0:
            definite = 0
        for i in row:
            del rows[i][k]
        for i, x in row.items():
            for j, y in row.items():
                before = rows[i].get(j, ZERO)
                work += _cost(before, x, y, pivot)
                if work > most:
                    return -1
                value = before - x * y / pivot
                if value:
                    rows[i][j] = value
                else:
                    rows[i].pop(j, None)
    return definite


def _cost(*values: Fraction) -> float:
    """About how many ns it takes to multiply and add fractions: their greatest common divisors take most of it."""
    bits = sum(x.denominator.bit_length() + x.numerator.bit_length() for x in values)
    return 4000 + 5 * bits + bits * bits / 4000


def proves(condition: str, a: ArrayLike, w1: ArrayLike, proof: Multipliers, rate: Fraction = ONE) -> bool:
    """Whether p and Λ prove a condition at a rate: (1) is positive definite, and the paper's inequalities hold.

    Args:
        condition: `simple`, `gershgorin`, `lmi` or `exact`.
        a: `(n,)`.
        w1: `(n,)`.
        proof: p and the diagonal of Λ, such as from `multipliers`.
        rate: κ, no unit.

    Returns:
        True after the proof, in rational arithmetic. False says nothing about other p and Λ.

    >>> proves("exact", [0.9], [1.0], multipliers("exact", [0.9], [1.0]))
    True
    """
    p, lam = Fraction(proof.metric), list(proof.multipliers)
    if rate <= 0 or len(lam) != len(np.asarray(a)) or not all(x > 0 for x in lam):
        return False
    if condition in ("simple", "gershgorin"):
        sizes = [(abs(ai) / rate, abs(wi)) for ai, wi in zip(fractions(a), fractions(w1), strict=True)]
        dominated = all(x > ai + x * wi for x, (ai, wi) in zip(lam, sizes, strict=True))
        first = 2 - p > pairwise_sum([ai for ai, _ in sizes])
        second = p > pairwise_sum([x * wi for x, (_, wi) in zip(lam, sizes, strict=True)])
        equal = condition == "gershgorin" or (p == 1 and all(x == Fraction(1, len(lam) + 1) for x in lam))
        if not (dominated and first and second and equal):
            return False
    return definiteness(matrix(a, w1, p, lam, rate, CORNER[condition])) == 1


def power_below(x: Fraction) -> Fraction:
    """A power of two in (x/4, x], so that a proof's fractions stay short."""
    bits = x.numerator.bit_length() - x.denominator.bit_length() - 1
    return Fraction(2) ** bits


def pairwise_sum(values: Sequence[Fraction]) -> Fraction:
    """The sum, pairwise, which keeps the denominators small."""
    values = list(values)
    while len(values) > 1:
        values = [sum(values[i : i + 2], ZERO) for i in range(0, len(values), 2)]
    return values[0] if values else ZERO
