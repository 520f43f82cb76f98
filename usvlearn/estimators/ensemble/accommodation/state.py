"""Fault accommodation (Blanke et al. 2016): what the monitor of the thrusters finds is given to the joint EKFs.

Where both commands move together, the speed cannot tell which side has lost thrust, and the yaw rate can
(`usvlearn.estimators.ensemble.monitors`). The speed tells better how much was lost. Both are joined here, for the
members of an ensemble that are joint EKFs with trials.

While nothing is wrong (no alarm, no fault, all evidence below 6), each of these filters copies its x, P and σ² every
`wait` s of update steps. The last two copies are kept, so that the older one, x⁻ and P⁻, was made before the thruster
failed. `after` s after an alarm, if it is still on, with the effectiveness η of the monitor and d as in (9) of the
joint EKF:

    x_side ← η x⁻_side,   other parameters ← x⁻,   P ← P⁻ + loose² d dᵀ                                   (1)

A new segment starts, because b and w may have absorbed the fault, and the periodic estimates begin anew. What a trial
has learned since the fault is replaced: it may have changed the wrong side. The thruster has recovered when the alarm
has ended, and the 90 % interval that the filters alone give reaches 1: x_side ← x⁻_side, P ← P + loose² d dᵀ.

From (1) on, the effectiveness is that of all sources together. That of a filter is the ratio of the thrust at full
command and the present speed w, of x to that of x⁻, with a = (1, 1, |w|, 1, 1, 1, w) on (α, β, γ, κ, e₁, e₂, e₃):

    η_j = aᵀx/aᵀx⁻,   s_j² = scale² aᵀPa/(aᵀx⁻)² + (1 − η_j)² aᵀP⁻a/(aᵀx⁻)² + floor²                     (2)

That of the monitor, while its alarm is on, has `monitor` times its standard deviation, because its samples in a fault
are not independent:

    1/s² = Σ 1/s_j²,   η = s² Σ η_j/s_j²                                                                  (3)

The derivation is in `docs/theory/ensemble.md#accommodation`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from usvlearn.core.family import NOT_NEGATIVE, UNIT, Family, Parameters, leaf

if TYPE_CHECKING:
    from torch import Tensor

# Chosen on simulated boats of seeds 61 and 62: losses to 70, 40 and 0 % on three kinds of missions.
WAIT, AFTER = 30.0, 10.0  # s
LOOSE = 0.3  # of (1)
SCALE, FLOOR = 1.5, 0.03  # of (2)
MONITOR = 1.4  # times the monitor's standard deviation


class AccommodationState(NamedTuple):
    """What was given to the filters. Sides are left, right."""

    calm: Tensor  # (*batch,) s of update steps, without those that show a fault, since the last copy
    handed: Tensor  # (*batch, 2) 1 where the filters have got an effectiveness, until the thruster recovers, else 0
    share: Tensor  # (*batch, 2) η of (3) there; the monitor's in an alarm before; else 1
    deviation: Tensor  # (*batch, 2) likewise, standard deviation; else 0


class Number(Parameters):
    """Numbers, named as the constants above."""

    WAIT = NOT_NEGATIVE
    AFTER = NOT_NEGATIVE
    LOOSE = NOT_NEGATIVE
    SCALE = NOT_NEGATIVE
    FLOOR = NOT_NEGATIVE
    MONITOR = NOT_NEGATIVE


FAMILY = Family(
    ("accommodation",),
    lambda size: AccommodationState(
        calm=leaf(legal=NOT_NEGATIVE),
        handed=leaf(2, legal=UNIT),
        share=leaf(2),
        deviation=leaf(2, legal=NOT_NEGATIVE),
    ),
    Number,
)
AT = FAMILY.at
