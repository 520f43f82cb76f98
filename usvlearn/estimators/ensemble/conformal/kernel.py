"""Prediction intervals: equation (1) of `state`, and widths as a function of the manoeuvre."""

import numpy as np

from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import LEFT, RIGHT
from usvlearn.estimators.ensemble.conformal.state import AT, FEW, Choice, Number
from usvlearn.estimators.ensemble.manoeuvre_intervals.kernel import (
    begin_path,
    extend_path,
    group_of,
    halfwidth_now,
    learn_error,
    moves_of,
)
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import FAR, PATH

FIRST, PLACE = AT.conditional.learned.coefficients, AT.conditional.path


@jit
def published(node, s, predictions, members, limit, row, spreads, out):
    """Write the half-widths of predictions, those of members first; infinite before FEW innovations."""
    for i in range(node[Row.SIZE]):
        out[i] = np.inf if s[node[AT.count] + i] < FEW else s[node[AT.halfwidth] + i]
    if node[Choice.CONDITIONAL] <= 0:
        return
    at, path = node[FIRST:], s[node[PLACE] : node[PLACE] + PATH]
    extend_path(path, row[LEFT], row[RIGHT])
    group = group_of(path)
    for i in range(node[Row.SIZE]):
        if abs(predictions[i]) < limit:
            spreads[i] = spread_about(predictions[i], predictions, members, limit)
            out[i] = halfwidth_now(s, at, i, s[node[AT.count] + i], out[i], spreads[i], path[FAR], group)


@jit
def spread_about(predicted, predictions, members, limit):
    """The root mean square of the active members' distances from a prediction."""
    total, active = 0.0, 0.0
    for m in range(members):
        if abs(predictions[m]) < limit:
            total += (predictions[m] - predicted) * (predictions[m] - predicted)
            active += 1
    return np.sqrt(total / max(active, 1.0))


@jit
def conformal(node, s, q, innovation, predictions, limit, row, spreads):
    """The intervals after innovations, in place."""
    k, numbers = node[Row.SIZE], q[node[Row.NUMBERS] :]
    halfwidth, count = s[node[AT.halfwidth] : node[AT.halfwidth] + k], s[node[AT.count] : node[AT.count] + k]
    conditional, at, path = node[Choice.CONDITIONAL] > 0, node[FIRST:], s[max(node[PLACE], 0) :]
    moves, alpha = moves_of(0.0, 1 - numbers[Number.COVERAGE]), 1 - numbers[Number.COVERAGE]
    seen, narrower, wider, group = -1.0, 1.0, 1.0, group_of(path) if conditional else 0
    for i in range(k):
        if np.isfinite(innovation[i]):
            count[i] += 1
            if count[i] != seen:  # usually it is the same for all
                seen = count[i]
                rate = numbers[Number.RATE] + numbers[Number.BOOST] / seen
                narrower = np.exp(-rate * (1 - numbers[Number.COVERAGE]))
                wider = np.exp(rate * numbers[Number.COVERAGE])
            if conditional and abs(predictions[i]) < limit:
                learn_error(
                    s, at, i, seen, abs(innovation[i]), halfwidth[i], spreads[i], path[FAR], group, moves, alpha
                )
            moved = halfwidth[i] * (wider if abs(innovation[i]) > halfwidth[i] else narrower)
            halfwidth[i] = max(moved, numbers[Number.LEAST])
    if conditional:
        begin_path(path, row[LEFT], row[RIGHT])
