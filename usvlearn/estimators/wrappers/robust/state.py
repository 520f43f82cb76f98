"""Robust learning around any estimator: clip outliers, refuse samples that are not finite, accept real changes.

With the innovation e = y − ŷ, its robust scale s and a threshold c, the estimator learns from y' in place of the
measurement y (Huber 1964):

    y' = ŷ + w e,   w = min(1, c s/|e|)                                                    (1)
    s² ← (1−b) s² + (b/β) min(e², c² s²),   β = E min(z², c²) of a standard normal z          (2)

so that s estimates the standard deviation of the innovations without outliers. The next step also departs from y',
because an outlier of the speed would otherwise spoil two increments.

*Escape.* After an outlier ordinary samples follow; after a change of the boat they do not. After `patience` samples in
a row beyond the bound, the next are not clipped until one lies within it, and the covariance is inflated once. The
scale still follows (2): an innovation that is not clipped there would open the bound to later outliers.

*Gate.* A sample that would make a finite state not finite leaves the estimator's state unchanged, bit for bit.

The derivation is in `docs/theory/estimators.md#robust`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from usvlearn.core.family import MOST, NOT_NEGATIVE, POSITIVE, UNIT, Family, Parameters, Range, leaf

if TYPE_CHECKING:
    from torch import Tensor


class RobustState(NamedTuple):
    """The estimator's state, the scale, and counts."""

    inner: Any
    variance: Tensor  # (*batch,) s², m²/s²
    run: Tensor  # (*batch,) samples beyond the bound in a row
    clipped: Tensor  # (*batch,) count of samples clipped
    rejected: Tensor  # (*batch,) count of samples refused because something was not finite
    escaped: Tensor  # (*batch,) count of changes accepted


class Number(Parameters):
    """Constants and hyperparameters."""

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
