"""Fault accommodation: what the monitor of the thrusters finds is given to the joint EKFs.

Equations (1) to (3) and their source: `docs/theory/ensemble.md#accommodation`.
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
    """Numbers; by default they are the constants above."""

    WAIT = NOT_NEGATIVE, WAIT
    AFTER = NOT_NEGATIVE, AFTER
    LOOSE = NOT_NEGATIVE, LOOSE
    SCALE = NOT_NEGATIVE, SCALE
    FLOOR = NOT_NEGATIVE, FLOOR
    MONITOR = NOT_NEGATIVE, MONITOR


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
