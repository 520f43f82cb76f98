"""Intervals for shares and medians of independent draws."""

from __future__ import annotations

import math
from collections.abc import Sequence

NORMAL = 1.959963984540054  # the 97.5 % quantile of the normal distribution: intervals of 95 %
OUTSIDE = 0.025  # on each side


def wilson(count: int, of: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share (Wilson 1927), from `count` successes in `of` independent draws.

    >>> [round(x, 3) for x in wilson(0, 60)], [round(x, 3) for x in wilson(30, 60)]
    ([0.0, 0.06], [0.377, 0.623])
    """
    share, square = count / of, NORMAL**2
    middle = (share + square / (2 * of)) / (1 + square / of)
    half = NORMAL / (1 + square / of) * math.sqrt(share * (1 - share) / of + square / (4 * of * of))
    return (0.0 if count == 0 else middle - half), (1.0 if count == of else middle + half)


def median(values: Sequence[float]) -> float:
    """The median; infinite values are allowed.

    >>> median([3.0, 1.0]), median([1.0, math.inf, math.inf])
    (2.0, inf)
    """
    ordered = sorted(values)
    low, high = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    return low if low == high else (low + high) / 2


def median_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """The 95 % interval of the median that order statistics give, for any distribution; None for fewer than 6 draws.

    The median lies below the k-th smallest of n values with the probability P(B < k), B binomial (n, ½). k is the
    largest with P(B < k) ≤ 0.025.

    >>> median_interval(range(1, 7)), median_interval(range(5)), median_interval(range(1, 61))
    ((1, 6), None, (22, 39))
    """
    ordered, n = sorted(values), len(values)
    k, below = 0, 0.0
    while k < n and (below := below + math.exp(_log_binomial(n, k) - n * math.log(2))) <= OUTSIDE:
        k += 1
    return None if k == 0 else (ordered[k - 1], ordered[n - k])


def _log_binomial(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
