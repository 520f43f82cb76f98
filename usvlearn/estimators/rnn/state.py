"""A shallow ReLU recurrent network with one state, learned online by Adam (paper, section IV-B).

Equations (1) to (5) and their sources: `docs/theory/estimators.md#rnn`. After every update the weights go to the
nearest that hold a condition of `certify.training.conditions` at the rate κ (`docs/certification.md`): two trajectories
with equal inputs and the same sequence of weights then approach each other by the factor κ at every step.
"""

from __future__ import annotations

from enum import IntEnum
from itertools import accumulate
from math import inf, log, prod
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from certify.networks.shallow import ShallowWeights
from usvlearn.core.family import (
    BELOW_ONE,
    FACTOR,
    FEEDBACK,
    FINITE,
    MODEST,
    NOT_NEGATIVE,
    POSITIVE,
    POSITIVE_OR_INFINITE,
    UNIT,
    Family,
    Options,
    Parameters,
    ParameterVectors,
    Range,
    leaf,
)

if TYPE_CHECKING:
    from torch import Tensor

INPUTS = 4  # in u
BETA2, EPSILON = 0.999, 1e-8  # Adam's, as the paper has them
MOST_NEURONS = 10_000  # no boat needs more, and more would fill the memory
MOST_KEPT, MOST_STEPS = 100_000, 1000  # samples, and how many are learned again per step; likewise
KEPT = INPUTS + 3  # numbers of a kept sample
SURGE, TARGET, UNBROKEN = range(INPUTS, KEPT)  # their places, after u
TURN, STRIDE = 2**20, 648055  # of (5); c is exact in float32


class Replay(NamedTuple):
    """The M samples that were learned last. A new one takes the place of the oldest."""

    samples: Tensor  # (*batch, M, 7) u; m/s: from which it departs, learned; whether the step before led there
    learned: Tensor  # (*batch,) count of samples so far, which goes from 2M back to M; the next one's place is mod M
    turn: Tensor  # (*batch,) c of (5)


class RNNState(NamedTuple):
    """The weights, Adam's moments, the step before for the unrolled loss, and the samples for replay."""

    weights: ShallowWeights  # a, w1, b (*batch, n), W2 (*batch, n, 4)
    moment1: Tensor  # (*batch, 7n) Adam's mean gradient, in the order a, w1, W2 (row by row), b
    moment2: Tensor  # (*batch, 7n) Adam's mean squared gradient
    updates: Tensor  # (*batch,) count of updates
    surge: Tensor  # (*batch,) speed from which the next step departs, m/s
    surge_before: Tensor  # (*batch,) speed one step earlier, m/s
    inputs_before: Tensor  # (*batch, 4) u of that step
    dt: Tensor  # (*batch,) s, of that step
    unbroken: Tensor  # (*batch,) bool: that step led to `surge`
    replay: Replay | dict[str, Any]  # {} without replay


def weights(n: int) -> ShallowWeights:
    """The leaves of the weights of n neurons."""
    return ShallowWeights(a=leaf(n), w1=leaf(n), W2=leaf(n, INPUTS), b=leaf(n))


# The weights of n neurons lie one behind the other, as do gradients and moments. Sizes and beginnings, divided by n:
SIZES = ShallowWeights(*(prod(each.shape) for each in weights(1)))
BEGIN, WEIGHTS = ShallowWeights(*accumulate(SIZES[:-1], initial=0)), sum(SIZES)


class Condition(IntEnum):
    """The condition that the weights are projected onto."""

    NONE = 0
    SIMPLE = 1
    GERSHGORIN = 2
    LMI = 3
    EXACT = 4
    INTERVAL = 5


class Number(Parameters):
    """Constants and hyperparameters."""

    SCALE = MODEST  # h, s/m
    SURGE_MAX = POSITIVE
    RATE = POSITIVE
    DECAY = POSITIVE_OR_INFINITE, inf
    MOMENTUM = BELOW_ONE
    CLIP = POSITIVE_OR_INFINITE, inf
    CONTRACTION_RATE = FACTOR, 1.0
    PENALTY = NOT_NEGATIVE, 0.0
    SHARE2 = UNIT, 1 - BETA2
    LOG_BETA2 = Range(-100.0, -1e-6), log(BETA2)
    EPSILON = POSITIVE, EPSILON
    TINY = UNIT


class Vector(ParameterVectors):
    """The box of `interval`, least and then greatest x and u; the relative rate of each weight."""

    BOUNDS = FINITE, lambda n: 2 * (1 + INPUTS)
    RATE_RATIO = NOT_NEGATIVE, lambda n: WEIGHTS * n


class Choice(Options):
    """Choices."""

    FEEDBACK = FEEDBACK
    UNROLL = 1, 2
    CONDITION = tuple(each.name.lower() for each in Condition)
    BEST = False, True
    REPLAY_SIZE = Range(0, MOST_KEPT), 0
    REPLAY_STEPS = Range(1, MOST_STEPS), 8
    ACTIVATION = ("relu",)  # by which `certify` knows φ


def replay(count: int) -> Replay | dict[str, Any]:
    """The leaves of so many samples."""
    if count == 0:
        return {}
    last, turn = (leaf(legal=Range(0.0, end - 1, index=True)) for end in (2.0 * count, TURN))
    return Replay(samples=leaf(count, KEPT), learned=last, turn=turn)


FAMILY = Family(
    ("rnn",),
    lambda n, count: RNNState(
        weights=weights(n),
        moment1=leaf(WEIGHTS * n),
        moment2=leaf(WEIGHTS * n, legal=NOT_NEGATIVE),
        updates=leaf(legal=NOT_NEGATIVE),
        surge=leaf(),
        surge_before=leaf(),
        inputs_before=leaf(INPUTS),
        dt=leaf(),
        unbroken=leaf(legal=UNIT, flag=True),
        replay=replay(count),
    ),
    Number,
    Choice,
    Vector,
    size=Range(1, 100_000),
    lengths=(Choice.REPLAY_SIZE,),
    work=lambda n: INPUTS + 16 * n,
    heading=lambda own: True,
    frozen=("weights.a", "weights.w1", "weights.W2", "weights.b", "surge"),
)
AT = FAMILY.at
AT_REPLAY = cast("Replay", AT.replay)
