"""Interval widths as a function of the manoeuvre, for the next step and for forecasts over each horizon.

`at` is the part of a row that contains the places of a `LearnedState`; k is the index of a half-width.
"""

import numpy as np

from usvlearn.core.jit import jit
from usvlearn.estimators.ensemble.conformal.state import FEW
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import (
    CLIP,
    COMMON,
    DELAY,
    DOUBT,
    EVIDENCE,
    FAR,
    FEATURES,
    FLOOR,
    GREATEST,
    GROUPS,
    HELD,
    HIGH,
    KEPT,
    LEAST,
    LEFT,
    LITTLE,
    LOW,
    MUCH,
    NARROWEST,
    OWN,
    QUICK,
    RAMP,
    RIGHT,
    SLOW,
    SMALLEST,
    SURE,
    TINY,
    LearnedState,
)

COEFFICIENTS, GRAM, MOMENTS, LEVEL, FACTORS, SCORES = range(len(LearnedState._fields))


@jit
def begin_path(path, left, right):
    """A path that begins at these commands."""
    path[LEFT], path[RIGHT], path[LOW], path[HIGH] = left, right, (left + right) / 2, (left + right) / 2
    path[FAR] = 0.0


@jit
def extend_path(path, left, right):
    """A path after one more step with these commands."""
    mean = (left + right) / 2
    path[LOW], path[HIGH] = min(path[LOW], mean), max(path[HIGH], mean)
    path[FAR] = max(path[FAR], max(abs(left - path[LEFT]), abs(right - path[RIGHT])))


@jit
def group_of(path):
    """0, 1 or 2 by the range of the mean command."""
    moved = path[HIGH] - path[LOW]
    return (1 if moved >= LITTLE else 0) + (1 if moved > MUCH else 0)


@jit
def share(s, at, k, count):
    """a of (3)."""
    sure = min(max((count - SURE) / RAMP, 0.0), 1.0)
    if sure >= 1:
        return 1.0
    scores = s[at[SCORES] + 2 * k :]
    before = max(scores[1], NARROWEST)
    x = DOUBT - EVIDENCE * np.sqrt(max(count - FEW, 0.0)) * (before - scores[0]) / before
    return sure + (1 - sure) / (1 + np.exp(x))


@jit
def hold(s, at, k, count, held):
    """Write what (1) to (3) need, as it is now."""
    c, level = s[at[COEFFICIENTS] + FEATURES * k :], s[at[LEVEL] + k]
    held[0], held[1], held[2] = c[0] * level, c[1], c[2]
    held[FEATURES] = max(FLOOR * level, LEAST)
    for j in range(GROUPS):
        held[FEATURES + 1 + j] = s[at[FACTORS] + GROUPS * k + j]
    held[HELD - 1] = share(s, at, k, count)


@jit
def mix(width, learned, a):
    """(2): w, v and a; infinite where w is."""
    if not np.isfinite(width) or a >= 1:
        return learned if np.isfinite(width) else width
    return np.exp((1 - a) * np.log(width) + a * np.log(learned))


@jit
def halfwidth_held(held, width, spread, far, group):
    """(2) of what an origin keeps, beside the half-width that does not know the manoeuvre."""
    expected = max(held[0] + held[1] * spread + held[2] * far, held[FEATURES])
    return mix(width, max(held[FEATURES + 1 + group] * expected, NARROWEST), held[HELD - 1])


@jit
def expected_error(s, at, k, spread, far):
    """s of (1)."""
    c, level = s[at[COEFFICIENTS] + FEATURES * k :], s[at[LEVEL] + k]
    return max(c[0] * level + c[1] * spread + c[2] * far, max(FLOOR * level, LEAST))


@jit
def halfwidth_now(s, at, k, count, width, spread, far, group):
    """(2) of the present state, likewise."""
    learned = s[at[FACTORS] + GROUPS * k + group] * expected_error(s, at, k, spread, far)
    return mix(width, max(learned, NARROWEST), share(s, at, k, count))


@jit
def moves_of(overlap, alpha):
    """The factors of (4) after a hit and after a miss: of the other groups, of the own one."""
    rate = COMMON / (DELAY + overlap)
    return (
        np.exp(-rate * alpha),
        np.exp(-(rate + OWN) * alpha),
        np.exp(rate * (1 - alpha)),
        np.exp((rate + OWN) * (1 - alpha)),
    )


@jit
def learn_error(s, at, k, count, e, width, spread, far, group, moves, alpha):
    """(3) to (6) after the error e, m/s, the `count`-th; `width` does not know the manoeuvre."""
    c, factors = s[at[COEFFICIENTS] + FEATURES * k :], s[at[FACTORS] + GROUPS * k :]
    level, scores = s[at[LEVEL] + k], s[at[SCORES] + 2 * k :]
    expected = expected_error(s, at, k, spread, far)
    learned = max(factors[group] * expected, NARROWEST)
    if count > FEW:
        part = max(1 / (count - FEW), SLOW)
        scores[0] += part * (2 * learned + 2 / alpha * max(e - learned, 0.0) - scores[0])
        scores[1] += part * (2 * width + 2 / alpha * max(e - width, 0.0) - scores[1])
    common, alone = (moves[2], moves[3]) if e > learned else (moves[0], moves[1])
    for j in range(GROUPS):
        factors[j] = min(max(factors[j] * (alone if j == group else common), SMALLEST), GREATEST)  # (4)
    after = level + max(1 / count, QUICK) * (e - level)
    s[at[LEVEL] + k] = after  # (5)
    expected = max(expected, FLOOR * after)
    weight, target = 1 / (expected * expected), min(e, CLIP * expected)
    A, b = s[at[GRAM] + FEATURES * FEATURES * k :], s[at[MOMENTS] + FEATURES * k :]
    for i in range(FEATURES):
        f = level if i == 0 else (spread if i == 1 else far)
        for j in range(FEATURES):
            other = level if j == 0 else (spread if j == 1 else far)
            A[FEATURES * i + j] = KEPT * A[FEATURES * i + j] + weight * f * other  # (6)
        b[i] = KEPT * b[i] + weight * f * target
    first, second, third = 1 / max(A[0], TINY), 1 / max(A[4], TINY), 1 / max(A[8], TINY)
    c[0] = max((b[0] - A[1] * c[1] - A[2] * c[2]) * first, 0.0)
    c[1] = max((b[1] - A[3] * c[0] - A[5] * c[2]) * second, 0.0)
    c[2] = max((b[2] - A[6] * c[0] - A[7] * c[1]) * third, 0.0)
