"""What Gershgorin's lemma loses to the paper's LMI: the theorem, its proof, and its check for a network, in fractions.

With s_i = a_i w_{1i}, P = Σ max(s_i, 0), N = Σ max(−s_i, 0), K = max(P, N) > 0 and σ = Σ |s_i| = P + N:

    best-gauge Gershgorin / LMI = 2σ/2K = σ/K = 1 + min(P, N)/max(P, N) ∈ [1, 2],  = 1 ⇔ all s_i ≠ 0 have one sign   (1)
    best-gauge simple / LMI = 2(n + 1) max |s_i|/K ∈ [2(n + 1)/n, 2(n + 1)]                                          (2)

Each side of the quotients is the smallest rate at which the condition holds. `PROOF` proves both.
"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from certify.proofs.exact import ONE, ZERO, best_gauge, conditions, fractions, multipliers, proves

STATEMENT = (
    "The smallest rate that Gershgorin's lemma proves in its best gauge is σ/K times that of the LMI. This lies "
    "between 1 and 2 for every network and every n, and is 1 exactly where all sᵢ ≠ 0 have one sign."
)
PROOF = (
    "Let sᵢ = aᵢ w₁ᵢ, P the sum of the positive sᵢ, −N that of the negative ones, K = max(P, N) > 0 and σ = Σ "
    "|sᵢ| = P + N. A condition holds at the rate κ if it holds with a/κ in place of a.",
    "Gershgorin: the lemma holds at κ if |w₁ᵢ| < 1 for all i and Σ |aᵢ|/(1 − |w₁ᵢ|) < 2κ. A gauge replaces "
    "(aᵢ, w₁ᵢ) by (aᵢ/cᵢ, cᵢ w₁ᵢ), cᵢ > 0, which changes neither the network nor sᵢ. Where w₁ᵢ ≠ 0, "
    "the term is |sᵢ|/(|w₁ᵢ|(1 − |w₁ᵢ|)) ≥ 4 |sᵢ|, with equality at |w₁ᵢ| = ½. Where w₁ᵢ = 0 it is "
    "|aᵢ|/cᵢ, which can be made as small as one likes. So the smallest rate over all gauges is 4σ/2 = 2σ.",
    "LMI: take v = (1, y, z), y = ±1, and zᵢ = 2 w₁ᵢ y for the sᵢ in the larger of both sums, else 0. All "
    "terms of p and Λ in vᵀMv cancel, and vᵀMv = 2 − 4K/κ for one of the two signs. So κ > 2K is necessary. It is "
    "sufficient: with p = 1, λᵢ = |aᵢ|/(κ |w₁ᵢ|) and S = Σ sᵢ, eliminating Λ leaves the matrix [1 − σ/κ, "
    "−S/κ; −S/κ, 1 − σ/κ], which is positive definite if σ + |S| = 2K < κ. A neuron with sᵢ = 0 takes a λᵢ so "
    "large, or so small, that its share vanishes. So the smallest rate is 2K.",
    "The quotient is 2σ/2K = (P + N)/max(P, N) = 1 + min(P, N)/max(P, N). It lies in [1, 2], and is 1 if and only "
    "if P or N is 0. ∎",
    "simple: by the same inequality its smallest rate over all gauges is 4(n + 1) max |sᵢ|, which is 2(n + 1) max "
    "|sᵢ|/K times that of the LMI. K is at least max |sᵢ| and at most n max |sᵢ|, so the quotient lies between "
    "2(n + 1)/n and 2(n + 1), and no bound holds for all n. ∎",
)
JUST_ABOVE = 1 + Fraction(1, 2**20)  # of the smallest rate, where multipliers are proved
HALF = Fraction(1, 2)


class Loss(NamedTuple):
    """What the conditions in their best gauge lose to the LMI on one network.

    >>> loss([0.5, 0.25], [1.0, 1.0]).ratio
    Fraction(1, 1)
    """

    ratio: Fraction  # σ/K, best-gauge Gershgorin over LMI; no unit
    simple: Fraction  # best-gauge simple over LMI; no unit
    rarer: Fraction  # share of the s_i ≠ 0 that have the rarer sign, 0 … ½
    false: tuple[str, ...]  # statements of the proof that do not hold on it; none


def loss(a: ArrayLike, w1: ArrayLike) -> Loss | None:
    """(1) and (2) for one network, each step of the proof evaluated in fractions.

    Args:
        a: `(n,)`.
        w1: `(n,)`.

    Returns:
        What is lost. None where K = 0: the network has no slope, and every condition holds in some gauge at every rate.

    >>> found = loss([0.5, -0.25], [1.0, 1.0])
    >>> found.ratio, found.simple, found.rarer, found.false
    (Fraction(3, 2), Fraction(6, 1), Fraction(1, 2), ())
    """
    outputs, inputs = fractions(a), fractions(w1)
    s = [ai * wi for ai, wi in zip(outputs, inputs, strict=True)]
    n, P, N = len(s), sum((x for x in s if x > 0), ZERO), sum((-x for x in s if x < 0), ZERO)
    K, sigma = max(P, N), P + N
    if K == 0:
        return None
    given, best = conditions(a, w1), best_gauge(a, w1)
    lmi = given["lmi"].rate
    assert lmi is not None  # it holds at some rate
    in_gauge = conditions(np.array([2 * abs(x) for x in s]), np.array([HALF if x else ZERO for x in s]))  # of fractions
    proof = multipliers("lmi", a, w1, lmi * JUST_ABOVE)
    ratio, simple = best["gershgorin"] / lmi, best["simple"] / lmi
    signs = [x > 0 for x in s if x]
    statements = {
        "Gershgorin reaches 2σ in the gauge |w| = ½": in_gauge["gershgorin"].rate == best["gershgorin"] == 2 * sigma,
        "simple reaches 4(n+1) max|s| in the gauge |w| = ½": in_gauge["simple"].rate == best["simple"],
        "no smaller rate as given": all(
            (rate := given[name].rate) is None or rate >= best[name] for name in ("gershgorin", "simple")
        ),
        "the LMI holds just above 2K": proof is not None and proves("lmi", a, w1, proof, lmi * JUST_ABOVE),
        "the LMI does not hold at 2K": lmi == 2 * K and _refuted(outputs, inputs, lmi),
        "the ratio is σ/K": ratio == sigma / K == 1 + min(P, N) / K,
        "the ratio lies in [1, 2]": 1 <= ratio <= 2,
        "it is 1 for one sign alone": (ratio == 1) == (len(set(signs)) == 1),
        "simple loses 2(n+1)/n to 2(n+1)": Fraction(2 * (n + 1), n) <= simple <= 2 * (n + 1),
    }
    rarer = Fraction(min(sum(signs), len(signs) - sum(signs)), len(signs))
    return Loss(ratio, simple, rarer, tuple(name for name, holds in statements.items() if not holds))


def _refuted(a: list[Fraction], w1: list[Fraction], rate: Fraction) -> bool:
    """Whether a vector v shows that no p and Λ make M positive definite at a rate, with Λ in the corner.

    vᵀMv = 2 − p + p y² − (2/κ) Σ a_i z_i + Σ λ_i z_i (z_i − 2 w_{1i} y) is linear in p and each λ_i, so its value for
    all of them follows from the constant and the coefficients, which must be 0.
    """
    for y in (ONE, -ONE):
        z = [2 * wi * y if ai * wi * y > 0 else ZERO for ai, wi in zip(a, w1, strict=True)]
        constant = 2 - 2 * sum((ai * zi for ai, zi in zip(a, z, strict=True)), ZERO) / rate
        of_metric = y * y - 1
        of_multipliers = [zi * (zi - 2 * wi * y) for zi, wi in zip(z, w1, strict=True)]
        if constant <= 0 and of_metric == 0 and not any(of_multipliers):
            return True
    return False
