"""Interval widths as a function of the manoeuvre, for the next step and for forecasts over each horizon.

One number for each horizon covers 90 % on average, and hardly half of the speeds where the commands change much. Here
the half-width depends on what is known before the speed is measured:

    spread = √Σ w_m (x_m − ŷ)²    of the members' predictions x_m about the prediction ŷ, with the weights w of the
                                  origin; of one step with equal weights. An inactive member counts as ŷ
    far                           the most that either command differs from that at the origin, until the due time
    group                         by the range of the mean command within this time: < .05, ≤ .25, or more

With ℓ, the running mean of the last errors, s is the error that is to be expected:

    s = max(c₀ ℓ + c₁ spread + c₂ far, .4 ℓ, 1 mm),    c ≥ 0                                               (1)
    half = w^(1 − a) v^a,    v = max(r_group s, 5 mm)                                                       (2)

w is the half-width that does not know the manoeuvre, which goes on to learn as before. The share a is 1 from 300 errors
on. Before, it follows the interval scores W of v and W₀ of w (Winkler 1972: 2 v + (2/α) (|e| − v)₊), running means of
those of the errors after the tenth, k′ = k − 10:

    a = ρ + (1 − ρ)/(1 + exp(2 − 2 √k′ (W₀ − W)/W₀)),    ρ = (k − 100)/200 within 0 … 1                    (3)

Where an error e has become known, with α the share that may miss, n the forecasts that are under way at the same time
(0 of one step), and miss = 1 where |e| > v, v of (2) with what is known now:

    log r_j ← log r_j + (1/(2 (9 + n)) + .05 [j = group]) (miss − α),    r within .1 … 30                  (4)
    ℓ ← ℓ + max(1/k, 1/50) (|e| − ℓ)                                                                       (5)
    A ← .999 A + f fᵀ/s²,    b ← .999 b + f min(|e|, 6 s)/s²,    f = (ℓ, spread, far), ℓ before (5)        (6)

and c minimizes cᵀA c/2 − bᵀc over c ≥ 0, approached by a sweep of coordinate descent after each error. These are least
squares with weights 1/s², because errors scatter in proportion to s. A and b begin as if c = (1, 0, 0) had been seen
ten times, with a ridge of 1.

A forecast keeps what (1) to (3) need as they were at its origin: errors that become known later do not enter. A plan
knows its commands, and its half-width is that of the present state.

The derivation is in `docs/theory/ensemble.md#conditional-intervals`.
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
