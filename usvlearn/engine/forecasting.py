"""Forecasts of an ensemble in compiled code: steps of the frozen members, and plans.

The row of the forecasts is followed by the place of the first slot, the rows of the M frozen members, the columns of
their predictions, and, for each leaf that is copied at an origin, its place in the state, its place in a slot, its
length, the place of a leaf that is copied instead of it, and that of the flag that tells when (−1 without).
"""

import numpy as np

from usvlearn.core.arrays import copy, fill, whole
from usvlearn.core.family import WIDTH, Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import DT, LEFT, RIGHT, ROW, SURGE, prepare
from usvlearn.engine.dispatch_tables import free_step
from usvlearn.estimators.ensemble.forecasts.fit_kernel import fitted_step
from usvlearn.estimators.ensemble.forecasts.kernel import (
    begin_again,
    combine,
    extend_paths,
    fill_slot,
    halfwidth_after,
    learn_due,
    publish,
    weights_after,
)
from usvlearn.estimators.ensemble.forecasts.state import AT, EMPTY, Choice, Vector
from usvlearn.estimators.ensemble.manoeuvre_intervals.kernel import extend_path
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import AT as KNOWN
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import DUE, PATH


@jit
def freeze(node, s, slot):
    """Copy what the members' open-loop simulations need into the numbers of a slot."""
    tail = node[WIDTH + 1 + 2 * node[Choice.MEMBERS] :]
    for i in range(tail[0]):
        source, place, length = tail[1 + 5 * i], tail[2 + 5 * i], tail[3 + 5 * i]
        other, flag = tail[4 + 5 * i], tail[5 + 5 * i]
        if flag >= 0 and s[flag] > 0:
            source = other
        for k in range(length):
            slot[place + k] = s[source + k]


@jit
def step_frozen(program, node, slot, q, row, limit, x, work):
    """One step of all members of a slot; writes their predictions, NaN where one is inactive."""
    fitted = node[Choice.MEMBERS] - 1 if node[Choice.FIT] >= 0 else -1
    for m in range(node[Choice.MEMBERS]):
        member = program[node[WIDTH + 1 + m]]
        if m == fitted:
            predicted = fitted_step(member, slot, q, q[node[Choice.FIT] :], row)
        else:
            predicted = free_step(member, slot, q, row, work)
        x[m] = predicted if abs(predicted) < limit else np.nan


@jit
def forget_forecasts(node, s, q):
    """A segment starts: what is under way is dropped, and the next measured step is an origin of every horizon."""
    H = node[Choice.HORIZONS]
    fill(s[node[AT.elapsed] : node[AT.elapsed] + node[Choice.SLOTS]], EMPTY)
    copy(s[node[AT.since] : node[AT.since] + H], q[node[Vector.HORIZONS] : node[Vector.HORIZONS] + H])
    s[node[AT.coasted]] = 0.0


@jit
def forecast_step(program, node, s, q, row, learns, limit, work):
    """All that is under way makes a step; what is due is published and, with a measured speed, learned."""
    slots, H, M = node[Choice.SLOTS], node[Choice.HORIZONS], node[Choice.MEMBERS]
    begin, block = node[WIDTH], node[Row.SIZE]
    horizons, half, x, rest = q[node[Vector.HORIZONS] :], row[DT] / 2, work[:M], work[M:]
    known, knows = program[max(program[0, Row.CONDITIONAL], 0)], program[0, Row.CONDITIONAL] >= 0
    if knows:
        extend_paths(node, known, s, row[LEFT], row[RIGHT])
        fill(s[known[KNOWN.due] : known[KNOWN.due] + H * DUE], np.nan)
    fill(s[node[AT.predictions] : node[AT.predictions] + H * (M + 2)], np.nan)
    fill(s[node[AT.halfwidths] : node[AT.halfwidths] + H], np.nan)
    for slot in range(slots):
        before = s[node[AT.elapsed] + slot]
        if not before >= 0:
            s[node[AT.elapsed] + slot] = EMPTY
            continue
        step_frozen(program, node, s[begin + slot * block : begin + (slot + 1) * block], q, row, limit, x, rest)
        after = before + row[DT]
        for k in range(H):
            if before + half < horizons[k] <= after + half:
                publish(node, known, knows, s, q, slot, k, x)
        end = horizons[whole(s[node[AT.reach] + slot], H)]
        s[node[AT.elapsed] + slot] = EMPTY if after + half >= end else after
    for k in range(H):
        s[node[AT.since] + k] += row[DT]
    if not learns:
        s[node[AT.coasted]] += row[DT]
        return
    learn_due(node, known, knows, s, q, row[SURGE], row[DT], work)
    s[node[AT.coasted]] = 0.0
    if knows:
        begin_again(known, s, row[LEFT], row[RIGHT])
    for slot in range(slots):
        if s[node[AT.elapsed] + slot] < 0:
            freeze(node, s, s[begin + slot * block : begin + (slot + 1) * block])
            fill_slot(node, known, knows, s, q, slot, row[SURGE], half)
            break


@jit(entry=True)
def forecast_plan(program, s, q, left, right, heading, yaw_rate, dt, heads, limit, slot, out, work):
    """Forecast the steps of a plan, arrays `(time,)`: writes predictions and half-widths, m/s, `(time, 2)`.

    `heads`: whether a member needs the heading. `slot` is an array of the length of a slot.
    """
    node = program[program[0, Row.FORECASTS]]
    elapsed = s[node[AT.coasted]]
    M = node[Choice.MEMBERS]
    x, weights, path = work[:M], work[M : 2 * M], work[2 * M : 2 * M + PATH]
    rest, row = work[2 * M + PATH :], work[-ROW:]
    known, knows = program[max(program[0, Row.CONDITIONAL], 0)], program[0, Row.CONDITIONAL] >= 0
    if knows:
        copy(path, s[known[KNOWN.path] : known[KNOWN.path] + PATH])
    freeze(node, s, slot)
    for k in range(len(left)):
        prepare(left[k], right[k], heading[k], yaw_rate[k], dt[k], np.nan, True, False, heads, limit, row)
        step_frozen(program, node, slot, q, row, limit, x, rest)
        elapsed += dt[k]
        weights_after(node, s, q, elapsed, weights)
        out[k, 0] = combine(node, q, weights, x)
        if knows:
            extend_path(path, row[LEFT], row[RIGHT])
        out[k, 1] = halfwidth_after(node, known, knows, s, q, elapsed, weights, x, out[k, 0], path)


@jit
def coasted(node, s, q, predictions, dt, limit, work):
    """The ensemble's prediction without measured speed: with the weights of the time since the last one."""
    M = node[Choice.MEMBERS]
    x, weights = work[:M], work[M : 2 * M]
    for m in range(M):
        prediction = predictions[node[WIDTH + 1 + M + m]]
        x[m] = prediction if abs(prediction) < limit else np.nan
    weights_after(node, s, q, s[node[AT.coasted]] + dt, weights)
    return combine(node, q, weights, x)
