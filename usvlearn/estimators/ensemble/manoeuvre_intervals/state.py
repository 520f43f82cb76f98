"""Interval widths as a function of the manoeuvre, for the next step and for forecasts over each horizon.

Equations (1) to (6): `docs/theory/ensemble.md#conditional-intervals`. A forecast keeps what (1) to (3) need as they
were at its origin: errors that become known later do not enter. A plan knows its commands, and its half-width is that
of the present state.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from usvlearn.core.family import ANY, FINITE, NOT_NEGATIVE, POSITIVE, Family, Range, leaf

if TYPE_CHECKING:
    from torch import Tensor

FEATURES, GROUPS = 3, 3
LITTLE, MUCH = 0.05, 0.25  # of full scale, ranges of the mean command: where the groups end
FLOOR, LEAST = 0.4, 1e-3  # of (1); m/s
NARROWEST = 5e-3  # m/s, of (2)
SURE, RAMP, EVIDENCE, DOUBT = 100.0, 200.0, 2.0, 2.0  # of (3)
FIRST, OWN, COMMON, DELAY = 2.06, 0.05, 0.5, 9.0  # r before the first error; of (4)
SMALLEST, GREATEST = 0.1, 30.0  # r
QUICK, SLOW = 1 / 50, 1 / 200  # least shares of an error in ℓ, and of a score in W
KEPT, CLIP, PRIOR, RIDGE, TINY = 0.999, 6.0, 10.0, 1.0, 1e-20  # of (6)
PATH = 5  # numbers of a path
LEFT, RIGHT, LOW, HIGH, FAR = range(PATH)  # commands at the origin; range of the mean command, and far, since then
HELD = FEATURES + 1 + GROUPS + 1  # numbers that an origin keeps: c₀ ℓ, c₁, c₂; floor of s; r; a
DUE = 3  # spread, far, group of a forecast that is due


class LearnedState(NamedTuple):
    """What is learned of K half-widths."""

    coefficients: Tensor  # (*batch, K, 3) c; c₂ in m/s, the others without unit
    gram: Tensor  # (*batch, K, 3, 3) A
    moments: Tensor  # (*batch, K, 3) b
    level: Tensor  # (*batch, K) ℓ, m/s
    factors: Tensor  # (*batch, K, 3) r
    scores: Tensor  # (*batch, K, 2) W, W₀, m/s


class StepState(NamedTuple):
    """Of the intervals of the next step."""

    learned: LearnedState  # of the ensemble's columns and combiners
    path: Tensor  # (*batch, 5) of the commands since the last measured speed


class HorizonState(NamedTuple):
    """Of the forecasts over H horizons."""

    learned: LearnedState
    path: Tensor  # (*batch, 5) of the commands since the last measured speed
    paths: Tensor  # (*batch, slots, 5) since the origin
    held: Tensor  # (*batch, slots, H, 8) what (1) to (3) need, as at the origin
    due: Tensor  # (*batch, H, 3) spread, far, group of what was due in the last step; NaN where nothing was


def learned_leaves(k: int) -> Any:
    """The leaves of what is learned of k half-widths."""
    return LearnedState(
        coefficients=leaf(k, FEATURES, legal=NOT_NEGATIVE),
        gram=leaf(k, FEATURES, FEATURES, legal=NOT_NEGATIVE),
        moments=leaf(k, FEATURES, legal=NOT_NEGATIVE),
        level=leaf(k, legal=NOT_NEGATIVE),
        factors=leaf(k, GROUPS, legal=POSITIVE),
        scores=leaf(k, 2, legal=NOT_NEGATIVE),
    )


COMMAND = Range(-1e3, 1e3)  # `core.samples.PLAUSIBLE_INPUTS` bounds it more tightly


def _horizons(size: Any) -> HorizonState:
    slots, H = size if isinstance(size, tuple) else (1, 1)
    return HorizonState(
        learned=learned_leaves(H),
        path=leaf(PATH, legal=COMMAND),
        paths=leaf(slots, PATH, legal=COMMAND),
        held=leaf(slots, H, HELD, legal=FINITE),
        due=leaf(H, DUE, legal=ANY),
    )


FAMILY = Family(("conditional",), _horizons)
AT = FAMILY.at
