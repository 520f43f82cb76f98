"""Monitors: which parameters the data inform, whether innovations are white, whether a thruster has failed.

Equations (1) to (7) and their sources: `docs/theory/ensemble.md#monitors`. Where the factorisation of (4) breaks down
in spite of the ridge (7), the model says nothing in that step: ϑ = 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from usvlearn.core.family import FINITE, MOST, NOT_NEGATIVE, POSITIVE, UNIT, Family, Parameters, Range, leaf

if TYPE_CHECKING:
    from torch import Tensor

WHITE = 1.96  # standard deviations of a 95 % band
HUBER, HUBER_MEAN, HUBER_RATE = 1.345, 0.71016, 0.005  # c, κ and b of (2)
FIRST_SCALE, LEAST_SCALE = 0.05, 1e-6  # m/s, s of the innovations before the first, and its least

# Chosen on simulated boats of five plants, healthy in gusts and with losses; the floor on a real one.
YAW_MEMORY = 1800.0  # s at full thrust
YAW_RIDGE = 0.01  # ρ of (7): ϑ is 0 within ten standard deviations of the noise
YAW_SCALE = 0.1  # rad/s, s of (5) before the first sample
YAW_FLOOR = 0.05  # rad/s, least s of (5): wind and waves turn a boat by more than a good compass errs
YAW_RATE = 0.01  # share by which s² moves in a step
KNEE = 2.0  # standard deviations about which a sample begins to count less
YAW_SPREAD = 1.5  # 1/E z²/(1 + z²/KNEE²), z standard normal
LOSS = 0.5  # d of (5): a loss of less than half of it never alarms
HORIZON = 5.0  # N of (5), steps
MISFIT = 0.14  # η of (5)
CLIP, EFFECT = 5.0, 6.0  # limits of e and f_i, in σ: one sample moves g by at most d CLIP EFFECT
CALM = 3.0  # a sample counts exp(−g/CALM) in (4)
SIGNIFICANT = 6.0  # a g below it says nothing of the effectiveness
DOUBTFUL = 2.0  # standard deviations of F by which the effectiveness is unsure
THRESHOLD = 20.0  # of g
BACKWARDS = -0.25  # least effectiveness that a thruster may have
DOUBT = 10.0  # the effectiveness is 1 ± 1/√DOUBT before the first sample
CLEARED = 0.25  # share of the threshold under which g ends an alarm
FEATURES = 9  # x of (3)
Z = 1 + FEATURES  # z of (3): the yaw rate, and x
THRUST = 3  # place of the first feature of the commands
ROUNDING = 16  # of (7)
APART = 1e-4  # share of Σ w (ξ_L² + ξ_R²), from which Σ w (ξ_L − ξ_R)² tells the sides apart


class InnovationState(NamedTuple):
    """Running statistics of k innovation sequences, one per column."""

    moments: Tensor  # (*batch, k, 4) weighted sums of 1, e (m/s), e² and e e₋ (m²/s²)
    scale: Tensor  # (*batch, k) s² of (2), m²/s²
    last: Tensor  # (*batch, k) e₋, m/s


class ThrusterState(NamedTuple):
    """The model of the yaw rate and the evidence against each thruster. Sides are left, right."""

    moments: Tensor  # (*batch, Z, Z) Σ w z zᵀ, z = [r, x]
    variance: Tensor  # (*batch,) s² of (5), rad²/s²
    before: Tensor  # (*batch, 2) yaw rate one and two steps ago, rad/s
    evidence: Tensor  # (*batch, 2) g of (5)
    sums: Tensor  # (*batch, 2, 2) side, both sums of (6) since g was 0
    raised: Tensor  # (*batch, 2) 1 where an alarm is on, else 0
    alarms: Tensor  # (*batch,) count of alarms so far
    since: Tensor  # (*batch,) s of update steps since the last alarm, or since the start where there was none


class MonitorState(NamedTuple):
    """The state of `observe`."""

    innovations: InnovationState
    thrusters: ThrusterState


class Number(Parameters):
    """Numbers of the monitors, named as the constants above."""

    HUBER = POSITIVE
    HUBER_MEAN = POSITIVE
    HUBER_RATE = UNIT
    LEAST_SCALE = POSITIVE  # m²/s²
    INNOVATION_MEMORY = Range(1.0, MOST)  # 1/α, steps
    YAW_MEMORY = POSITIVE
    YAW_RIDGE = Range(1e-6, MOST)
    YAW_FLOOR = POSITIVE  # rad²/s²
    YAW_RATE = UNIT
    KNEE = POSITIVE
    YAW_SPREAD = NOT_NEGATIVE
    LOSS = NOT_NEGATIVE
    HORIZON = NOT_NEGATIVE
    MISFIT = NOT_NEGATIVE
    CLIP = POSITIVE
    EFFECT = POSITIVE
    CALM = POSITIVE
    THRESHOLD = POSITIVE
    BACKWARDS = FINITE
    DOUBT = POSITIVE
    CLEARED = UNIT


FAMILY = Family(
    ("monitors",),
    lambda k: MonitorState(
        InnovationState(moments=leaf(k, 4), scale=leaf(k, legal=POSITIVE), last=leaf(k)),
        ThrusterState(
            moments=leaf(Z, Z),
            variance=leaf(legal=POSITIVE),
            before=leaf(2),
            evidence=leaf(2, legal=NOT_NEGATIVE),
            sums=leaf(2, 2),
            raised=leaf(2, legal=UNIT),
            alarms=leaf(legal=NOT_NEGATIVE),
            since=leaf(legal=NOT_NEGATIVE),
        ),
    ),
    Number,
    work=lambda k: 3 * Z + FEATURES**2,
)
AT = FAMILY.at
