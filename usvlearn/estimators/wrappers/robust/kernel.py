"""Robust learning: what is done before and after the steps of its estimator, (1) and (2) of `state`."""

import numpy as np

from usvlearn.core.arrays import clamp, copy, finite
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.estimators.wrappers.robust.state import AT, Number


@jit
def start(node, s):
    """A segment starts."""
    s[node[AT.run]] = 0.0


@jit
def inflation(node, q):
    """The factor by which a covariance is inflated where a change is accepted."""
    return q[node[Row.NUMBERS] :][Number.INFLATION]


@jit
def within(node, s, q, surge, predicted):
    """y' of (1); whether the innovation is beyond the bound, is clipped, is the first of an accepted change."""
    numbers, run = q[node[Row.NUMBERS] :], s[node[AT.run]]
    innovation = surge - predicted
    bound = numbers[Number.THRESHOLD] * np.sqrt(s[node[AT.variance]])
    beyond = abs(innovation) > bound
    escapes = beyond and run >= numbers[Number.PATIENCE]
    first = escapes and run < numbers[Number.PATIENCE] + 1
    clips = beyond and not escapes
    return predicted + clamp(innovation, bound) if clips else surge, beyond, clips, first


@jit
def update_scale(node, s, q, innovation, beyond, clips, first, inner, backup):
    """The scale and the counts, (2); a sample that spoiled the estimator's state is undone."""
    numbers, square = q[node[Row.NUMBERS] :], innovation * innovation
    if not np.isfinite(square) or (not finite(inner) and finite(backup)):
        copy(inner, backup)
        s[node[AT.rejected]] += 1
        return
    variance = s[node[AT.variance]]
    bound = numbers[Number.THRESHOLD] * numbers[Number.THRESHOLD] * variance
    learned = variance + numbers[Number.SHARE] * (min(square, bound) / numbers[Number.MOMENT] - variance)
    s[node[AT.variance]] = max(learned, numbers[Number.VARIANCE_MIN])
    s[node[AT.run]] = s[node[AT.run]] + 1 if beyond else 0.0
    s[node[AT.clipped]] += clips
    s[node[AT.escaped]] += first
