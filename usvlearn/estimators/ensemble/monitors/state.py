"""Monitors: which parameters the data inform, whether innovations are white, whether a thruster has failed.

Equations (1) to (8) and their sources: `docs/theory/ensemble.md#monitors`. Two models watch: of the yaw rate in each
step, and of the speed after each two seconds. Where the factorisation of (4) breaks down in spite of the ridge (7),
a model says nothing in that step: ϑ = 0.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from usvlearn.core.family import FINITE, MOST, NOT_NEGATIVE, POSITIVE, UNIT, Family, Parameters, Range, leaf

if TYPE_CHECKING:
    from torch import Tensor

WHITE = 1.96  # standard deviations of a 95 % band
HUBER, HUBER_MEAN, HUBER_RATE = 1.345, 0.71016, 0.005  # c, κ and b of (2)
FIRST_SCALE, LEAST_SCALE = 0.05, 1e-6  # m/s, s of the innovations before the first, and its least

# Chosen on simulated boats, healthy in gusts and currents and with losses; the floors on real ones.
YAW_MEMORY = 1800.0  # s at full thrust
YAW_RIDGE = 0.01  # ρ of (7): ϑ is 0 within ten standard deviations of the noise
YAW_SCALE = 0.1  # rad/s and m/s, s of (5) before the first sample
YAW_FLOOR = 0.02  # rad/s, least s of (5): wind and waves turn a boat by more than a good compass errs
SURGE_FLOOR = 0.03  # m/s, likewise
YAW_RATE = 0.01  # share by which s² moves in a step
KNEE = 2.0  # standard deviations about which a sample begins to count less
YAW_SPREAD = 1.5  # 1/E z²/(1 + z²/KNEE²), z standard normal
LOSS = 0.5  # d of (5): a loss of less than half of it never alarms
HORIZON = 5.0  # N of (5), steps
MISFIT = 0.18  # η of (5)
CLIP = 6.0  # limit of e and f_i, in σ
CALM = 3.0  # a sample counts exp(−g/CALM) in (4)
SIGNIFICANT = 6.0  # a g below it says nothing of the effectiveness
THRESHOLD, BOTH = 18.0, 20.0  # of g, for a side and for both
BACKWARDS = -0.25  # least effectiveness that a thruster may have
DOUBT = 3.0  # the effectiveness is 1 ± 1/√DOUBT before the first sample
REMEMBERED = 60.0  # weight that (6) remembers at most, so that a recovery is seen
CLEARED = 0.25  # share of the threshold under which g ends an alarm
RAISED, NINETY = 2.0, 1.645  # standard deviations by which the effectiveness is below 1: to raise an alarm, to keep it
HOLD, WAITS, LEAVE = 4.0, 30.0, 10.0  # s it holds: before an alarm, of both where the yaw rate tells, before its end
MARGIN = 3.0  # of g, by which one side excels
BLOCK = 2.0  # s between two speeds of the model of the surge
SLOW, SLOWLY = 10.0, 300.0  # s, of the mean error that is called slow; of the memory for colour and slow errors
BEGUN = 40.0  # samples that a model has learned from before its errors tell of their colour
SLOW_SCALE = 0.03  # rad/s and m/s, of slow errors before the first sample
SLOWNESS = 1.0  # times a slow error's deviation that may persist
COLOURED = 0.2  # autocorrelation of the yaw rate's errors from which its model tells nothing
EXPLAINED = 0.3  # least share of the variance that the commands make of the yaw rate
YAW, SURGES = 9, 12  # features x of (3)
THRUST = 3  # place of the first feature of the commands, which are three of each side in turn
ROUNDING = 16  # of (7)
APART = 1e-4  # share of Σ w (ξ_L² + ξ_R²), from which Σ w (ξ_L − ξ_R)² tells the sides apart
VARIANCE, SQUARE, LAGGED, LAST, LEVEL, LEVELS = range(6)  # columns of `errors`


class InnovationState(NamedTuple):
    """Running statistics of k innovation sequences, one per column."""

    moments: Tensor  # (*batch, k, 4) weighted sums of 1, e (m/s), e² and e e₋ (m²/s²)
    scale: Tensor  # (*batch, k) s² of (2), m²/s²
    last: Tensor  # (*batch, k) e₋, m/s


class ThrusterState(NamedTuple):
    """The models of yaw rate and surge, and the evidence against left, right and both thrusters."""

    moments: Tensor  # (*batch, 10, 10) Σ w z zᵀ, z = [r, x]
    surges: Tensor  # (*batch, 13, 13) likewise, z = [v, x]
    errors: Tensor  # (*batch, 2, 6) of yaw rate and surge: s² of (5); E e², E e e₋, e₋, slow error, its mean square
    theta: Tensor  # (*batch, 9) ϑ of (4) of the yaw rate, when a block ended
    root: Tensor  # (*batch, 9, 9) Cholesky factor of Φ then, 1 over its diagonal
    before: Tensor  # (*batch, 3) yaw rate one and two steps ago, rad/s, speed as the block began, m/s
    block: Tensor  # (*batch, 10) s of the block so far, and integrals of the features over it
    explained: Tensor  # (*batch, 2) mean square of e, and of e and what the commands make, rad²/s²
    evidence: Tensor  # (*batch, 3) g of (5)
    sums: Tensor  # (*batch, 3, 4) both sums of (6), and what slow errors of both models make, since g was 0
    held: Tensor  # (*batch, 3) s for which the evidence and the interval say otherwise than `raised`
    together: Tensor  # (*batch,) 1 where both sides are blamed at once, else 0
    raised: Tensor  # (*batch, 2) 1 where an alarm of the left or right side is on, else 0
    share: Tensor  # (*batch, 2) effectiveness of each side, (6); 1 without evidence
    deviation: Tensor  # (*batch, 2) its standard deviation, (8)
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
    SURGE_FLOOR = POSITIVE  # m²/s²
    YAW_RATE = UNIT
    KNEE = POSITIVE
    YAW_SPREAD = NOT_NEGATIVE
    LOSS = NOT_NEGATIVE
    HORIZON = NOT_NEGATIVE
    MISFIT = NOT_NEGATIVE
    CLIP = POSITIVE
    CALM = POSITIVE
    THRESHOLD = POSITIVE
    BOTH = POSITIVE
    BACKWARDS = FINITE
    DOUBT = POSITIVE
    CLEARED = UNIT
    HOLD = NOT_NEGATIVE
    WAITS = NOT_NEGATIVE
    LEAVE = NOT_NEGATIVE
    SLOWNESS = NOT_NEGATIVE
    COLOURED = NOT_NEGATIVE
    EXPLAINED = UNIT


FAMILY = Family(
    ("monitors",),
    lambda k: MonitorState(
        InnovationState(moments=leaf(k, 4), scale=leaf(k, legal=POSITIVE), last=leaf(k)),
        ThrusterState(
            moments=leaf(1 + YAW, 1 + YAW),
            surges=leaf(1 + SURGES, 1 + SURGES),
            errors=leaf(2, 6),
            theta=leaf(YAW),
            root=leaf(YAW, YAW),
            before=leaf(3),
            block=leaf(SURGES - 2),
            explained=leaf(2, legal=NOT_NEGATIVE),
            evidence=leaf(3, legal=NOT_NEGATIVE),
            sums=leaf(3, 4),
            held=leaf(3, legal=NOT_NEGATIVE),
            together=leaf(legal=UNIT),
            raised=leaf(2, legal=UNIT),
            share=leaf(2),
            deviation=leaf(2, legal=NOT_NEGATIVE),
            alarms=leaf(legal=NOT_NEGATIVE),
            since=leaf(legal=NOT_NEGATIVE),
        ),
    ),
    Number,
    work=lambda k: YAW + 4 + 3 * SURGES + 4 + SURGES**2,
)
AT = FAMILY.at
