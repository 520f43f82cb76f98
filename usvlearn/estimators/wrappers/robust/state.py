"""Robust learning around any estimator: clip outliers, refuse samples that are not finite, accept real changes.

Equations (1) and (2), the escape and the gate: `docs/theory/estimators.md#robust`.
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
