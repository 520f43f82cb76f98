"""Constant acceleration: the next increment is the last one. A second baseline, beside persistence.

v⁺ = v + dt v_dot,   v_dot = (v_meas − v_meas₋)/(t − t₋)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from usvlearn.core.family import NOT_NEGATIVE, POSITIVE, Family, Parameters, leaf

if TYPE_CHECKING:
    from torch import Tensor


class AccelerationState(NamedTuple):
    """The last two measurements, as speed and acceleration."""

    surge: Tensor  # (*batch,) speed from which the next step departs, m/s
    surge_dot: Tensor  # (*batch,) m/s²
    measured: Tensor  # (*batch,) last measured speed, m/s
    since: Tensor  # (*batch,) s since then


class Number(Parameters):
    """Limits."""

    SURGE_DOT_MAX = POSITIVE
    SURGE_MAX = POSITIVE


FAMILY = Family(
    ("acceleration",),
    lambda _: AccelerationState(surge=leaf(), surge_dot=leaf(), measured=leaf(), since=leaf(legal=NOT_NEGATIVE)),
    Number,
    frozen=("surge", "surge_dot"),
)
AT = FAMILY.at
