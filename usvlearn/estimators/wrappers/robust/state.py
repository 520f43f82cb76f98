"""Robust learning around any estimator: outliers are clipped, what is not finite is refused, real changes get through.

With the innovation e = y − ŷ, a robust scale s of it and a threshold c, the estimator learns from the measurement that
Huber's function leaves (Huber 1964):

    y' = ŷ + w e,   w = min(1, c s/|e|)                                                    (1)
    s² ← (1−b) s² + (b/β) min(e², c² s²),   β = E min(z², c²) of a standard normal z          (2)

so that s estimates the standard deviation of what is no outlier. The next step departs from y', too: an outlier of the
speed would else spoil two increments.

*Escape.* An outlier is followed by ordinary samples, a change is not: after `patience` samples beyond the bound in a
row the next are taken whole, until one lies within it, and the estimator is loosened once (a covariance is inflated).
The scale follows by (2): to take a change whole for it, too, would open the bound to the outliers after it.

*Gate.* A sample after which what was finite would not be leaves the estimator's state as it was, bit for bit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from usvlearn.family import MOST, NOT_NEGATIVE, POSITIVE, UNIT, Family, Numbers, Range, leaf

if TYPE_CHECKING:
    from torch import Tensor


class RobustState(NamedTuple):
    """The estimator's state, the scale, and what was done."""

    inner: Any
    variance: Tensor  # (*batch,) s², m²/s²
    run: Tensor  # (*batch,) samples beyond the bound in a row
    clipped: Tensor  # (*batch,) count of samples clipped
    rejected: Tensor  # (*batch,) count of samples refused because something was not finite
    escaped: Tensor  # (*batch,) count of changes taken whole


class Number(Numbers):
    """What it is told."""

    THRESHOLD = POSITIVE  # c
    PATIENCE = POSITIVE  # samples
    INFLATION = Range(1 - 1e-6, MOST)
    SHARE = UNIT  # b
    VARIANCE_MIN = POSITIVE  # m²/s²
    MOMENT = POSITIVE  # β


FAMILY = Family(
    ("robust",),
    lambda _: RobustState(
        inner={},
        variance=leaf(legal=POSITIVE),
        run=leaf(legal=NOT_NEGATIVE),
        clipped=leaf(legal=NOT_NEGATIVE),
        rejected=leaf(legal=NOT_NEGATIVE),
        escaped=leaf(legal=NOT_NEGATIVE),
    ),
    Number,
)
AT = FAMILY.at
