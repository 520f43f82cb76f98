"""The steps of sway and yaw rate beside the surge's, and tracks: equations (1) and (2) of `estimators.planar.state`.

`head` is the table of places of `estimators.planar.state`: a row for each axis, and one for the track. Programs, states
and numbers of the axes lie one behind the other.
"""

import numpy as np

from usvlearn.core.arrays import fill, whole
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import COS, DT, HOLD, LEARN, LEFT, MODE, PREDICT, RIGHT, ROW, SIN, START, YAW_RATE
from usvlearn.core.prepared_samples import SURGE as TARGET
from usvlearn.engine.forecasting import freeze, step_frozen
from usvlearn.estimators.ensemble.forecasts.kernel import between, combine, judged
from usvlearn.estimators.ensemble.forecasts.state import AT as FORECASTS
from usvlearn.estimators.ensemble.forecasts.state import EMPTY
from usvlearn.estimators.ensemble.forecasts.state import Choice as ForecastChoice
from usvlearn.estimators.ensemble.manoeuvre_intervals.kernel import begin_path, extend_path
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import PATH
from usvlearn.estimators.ensemble.state import Number as EnsembleNumber
from usvlearn.estimators.joint.state import EAST as CURRENT_EAST
from usvlearn.estimators.joint.state import NORTH as CURRENT_NORTH
from usvlearn.estimators.planar import state as at
from usvlearn.estimators.planar.ellipses_kernel import ellipse, follow_surprise, keep_ellipses, publish_due

FOUND = 9  # of a plan's step: surge, sway, yaw rate, heading, north, east, and the covariance: NN, NE, EE


@jit
def axis_row(axis, head, s, row, pose, own):
    """Write the prepared sample of the sway or of the yaw rate, after the surge's step; returns its mode."""
    before, filtered = s[head[at.TRACK, at.BEFORE] :], s[head[at.SURGE, at.STATE] + head[at.SURGE, at.MEAN] :]
    own[LEFT], own[RIGHT], own[COS], own[YAW_RATE], own[DT] = row[LEFT], row[RIGHT], 0.0, before[0], row[DT]
    if axis == at.SWAY:
        psi, target = pose[at.HEADING], pose[at.MEASURED_SWAY]
        own[SIN] = before[2]
        target += filtered[CURRENT_NORTH] * np.sin(psi) - filtered[CURRENT_EAST] * np.cos(psi)  # (1)
    else:
        target = pose[at.TURN]
        own[SIN] = before[1]
    known, mode = abs(target) < at.LIMIT, row[MODE]
    own[TARGET] = target if known else 0.0
    if mode == LEARN or mode == PREDICT:
        return LEARN if known else PREDICT
    return START if mode == START and known else HOLD


@jit
def used(head, s):
    """Whether the sway has been measured often enough."""
    return s[head[at.SWAY, at.STATE] + head[at.SWAY, at.UPDATES]] >= at.USED


@jit
def end_step(head, s, row, pose):
    """Keep w, v and r at the end of a step, from which the next one departs."""
    before, mode = s[head[at.TRACK, at.BEFORE] :], row[MODE]
    filtered = s[head[at.SURGE, at.STATE] + head[at.SURGE, at.MEAN] :]
    if mode == HOLD:
        return
    last = before[2]
    if mode == START:
        along = 0.0
        if abs(pose[at.HEADING]) < np.inf:
            north, east = np.cos(pose[at.HEADING]), np.sin(pose[at.HEADING])
            along = filtered[CURRENT_NORTH] * north + filtered[CURRENT_EAST] * east
        before[0], before[1] = row[TARGET] - along, 0.0
        before[2] = pose[at.TURN] if abs(pose[at.TURN]) < at.LIMIT else 0.0
    else:
        before[0], before[3], before[4] = filtered[0], row[LEFT], row[RIGHT]
        before[1] = s[head[at.SWAY, at.STATE] + head[at.SWAY, at.MEAN]] if used(head, s) else 0.0
        before[2] = s[head[at.YAW, at.STATE] + head[at.YAW, at.MEAN]]
    turned = before[5] + row[DT] * (last + before[2]) / 2  # of the filter alone, where no heading came
    before[5] = pose[at.HEADING] if abs(pose[at.HEADING]) < np.inf else turned


@jit
def mixed(axis, program, head, q, slot, after, own, work):
    """One step of the frozen members of an axis, and what they predict together, `after` s from the origin."""
    table, numbers = program[head[axis, at.PROGRAM] :], q[head[axis, at.NUMBER] :]
    node = table[table[0, Row.FORECASTS]]
    H, M, length = node[ForecastChoice.HORIZONS], node[ForecastChoice.MEMBERS], node[Row.SIZE]
    x, weights, rest = work[:M], work[M : 2 * M], work[2 * M :]
    limit = numbers[table[0, Row.NUMBERS] + EnsembleNumber.SURGE_MAX]
    block = slot[head[axis, at.BLOCK] : head[axis, at.BLOCK] + length]
    step_frozen(table, node, block, numbers, own, limit, x, rest)
    k, rise = between(node, numbers, after)
    below, above = slot[head[axis, at.WEIGHTS] + k * M :], slot[head[axis, at.WEIGHTS] + min(k + 1, H - 1) * M :]
    for m in range(M):
        weights[m] = (1 - rise) * below[m] + rise * above[m] if rise > 0 else below[m]
    return combine(node, numbers, weights, x)


@jit
def track_step(program, head, s, q, slot, left, right, h, own, work, judged):
    """(2): one step of a track, in place; `judged`: it will be compared with the way at the yaw rate of its origin."""
    u, v, r, w, psi = slot[at.U], slot[at.V], slot[at.R], slot[at.W], slot[at.PSI]
    north, east, sways = slot[at.C_NORTH], slot[at.C_EAST], used(head, s)
    after, ahead = slot[at.ELAPSED] + h, r
    own[LEFT], own[RIGHT], own[COS], own[DT], own[YAW_RATE] = left, right, 0.0, h, w
    along, aside, turned = u, 0.0, psi
    for axis in (at.YAW, at.SWAY, at.SURGE):
        if axis == at.YAW:
            own[SIN] = v
        elif axis == at.SWAY:
            own[SIN] = r
            if not sways:
                continue
        else:
            middle = (psi + turned) / 2
            own[SIN], own[COS], own[YAW_RATE] = np.sin(middle), np.cos(middle), (r + ahead) / 2
        predicted = mixed(axis, program, head, q, slot, after, own, work)
        if not abs(predicted) < at.LIMIT:
            continue
        if axis == at.YAW:
            ahead = predicted
            turned = psi + h * (r + ahead) / 2
        elif axis == at.SWAY:
            aside = predicted
        else:
            along = predicted
    c, d, cosine, sine = slot[at.COS], slot[at.SIN], np.cos(turned), np.sin(turned)
    lateral, other = (v - north * d + east * c, aside - north * sine + east * cosine) if sways else (0.0, 0.0)
    slot[at.AT_NORTH] += h / 2 * (c * u - d * lateral + cosine * along - sine * other)
    slot[at.AT_EAST] += h / 2 * (d * u + c * lateral + sine * along + cosine * other)
    if judged:
        held = slot[at.PSI_0] + slot[at.R_0] * after
        held_cosine, held_sine = np.cos(held), np.sin(held)
        slot[at.HELD_NORTH] += h / 2 * (slot[at.HELD_COS] * u + held_cosine * along)
        slot[at.HELD_EAST] += h / 2 * (slot[at.HELD_SIN] * u + held_sine * along)
        slot[at.HELD_COS], slot[at.HELD_SIN] = held_cosine, held_sine
    slot[at.COS], slot[at.SIN] = cosine, sine
    slot[at.RUN] += h * abs(u + along) / 2
    slot[at.U], slot[at.V], slot[at.R], slot[at.PSI] = along, aside, ahead, turned
    slot[at.W] = along - north * cosine - east * sine
    slot[at.ELAPSED] = after
    extend_path(slot[at.COMMANDS : at.COMMANDS + PATH], left, right)


@jit
def origin(program, head, s, q, slot, psi, surge):
    """Begin a track now, at a heading, rad, and a measured surge, m/s; all but its horizon and its position."""
    before, filtered = s[head[at.TRACK, at.BEFORE] :], s[head[at.SURGE, at.STATE] + head[at.SURGE, at.MEAN] :]
    fill(slot[: at.HORIZON], 0.0)
    slot[at.COS_0], slot[at.SIN_0], slot[at.PSI_0] = np.cos(psi), np.sin(psi), psi
    slot[at.COS], slot[at.HELD_COS] = slot[at.COS_0], slot[at.COS_0]
    slot[at.SIN], slot[at.HELD_SIN] = slot[at.SIN_0], slot[at.SIN_0]
    slot[at.C_NORTH], slot[at.C_EAST] = filtered[CURRENT_NORTH], filtered[CURRENT_EAST]
    slot[at.U], slot[at.V], slot[at.R], slot[at.W], slot[at.PSI] = surge, before[1], before[2], before[0], psi
    slot[at.U_0], slot[at.R_0] = surge, before[2]
    begin_path(slot[at.COMMANDS : at.COMMANDS + PATH], before[3], before[4])
    for axis in range(3):
        table, own = program[head[axis, at.PROGRAM] :], s[head[axis, at.STATE] :]
        node = table[table[0, Row.FORECASTS]]
        H, M, length = node[ForecastChoice.HORIZONS], node[ForecastChoice.MEMBERS], node[Row.SIZE]
        freeze(node, own, slot[head[axis, at.BLOCK] : head[axis, at.BLOCK] + length])
        for k in range(H):
            weights = own[node[FORECASTS.rule.weights] + judged(node, own, k) * M :]
            for m in range(M):
                slot[head[axis, at.WEIGHTS] + k * M + m] = weights[m]
    keep_ellipses(head, s, slot)


@jit
def forget_tracks(head, s, q):
    """No track is under way, and the next step may begin one of every horizon."""
    track = head[at.TRACK]
    for i in range(track[at.COUNT]):
        s[track[at.SLOTS] + i * track[at.LENGTH] + at.ELAPSED] = EMPTY
    for k in range(track[at.HORIZON_COUNT]):
        s[track[at.SINCE] + k] = q[track[at.Q] + 2 + k]


@jit
def tracks(program, head, s, q, row, pose, work):
    """All tracks under way make one step with its commands; what is due is learned, and one may begin."""
    track = head[at.TRACK]
    H, length, horizons = track[at.HORIZON_COUNT], track[at.LENGTH], q[track[at.Q] + 2 :]
    fill(s[track[at.DUES] : track[at.DUES] + H * at.DUE], np.nan)
    mode, overlap = row[MODE], q[track[at.Q] + 1]
    end_step(head, s, row, pose)
    if mode == HOLD or mode == START:
        forget_tracks(head, s, q)
        return
    follow_surprise(head, s, row, pose)
    own, rest, half, free = work[:ROW], work[ROW:], row[DT] / 2, -1
    for i in range(track[at.COUNT]):
        slot = s[track[at.SLOTS] + i * length : track[at.SLOTS] + (i + 1) * length]
        if not slot[at.ELAPSED] >= 0:
            slot[at.ELAPSED], free = EMPTY, i
            continue
        start = slot[at.ELAPSED]
        track_step(program, head, s, q, slot, row[LEFT], row[RIGHT], row[DT], own, rest, True)
        for k in range(H):
            if start + half < horizons[k] <= slot[at.ELAPSED] + half:
                publish_due(head, s, q, slot, k, pose)
        if slot[at.ELAPSED] + half >= horizons[whole(slot[at.REACH], H)]:
            slot[at.ELAPSED], free = EMPTY, i
    for k in range(H):
        s[track[at.SINCE] + k] += row[DT]
    if mode != LEARN or free < 0 or not abs(pose[at.HEADING]) + abs(pose[at.NORTH]) + abs(pose[at.EAST]) < np.inf:
        return
    if s[track[at.SINCE]] + half < horizons[0] / overlap:
        return
    slot = s[track[at.SLOTS] + free * length : track[at.SLOTS] + (free + 1) * length]
    origin(program, head, s, q, slot, pose[at.HEADING], row[TARGET])
    reach = 0
    for k in range(H):
        if s[track[at.SINCE] + k] + half >= horizons[k] / overlap:
            reach = k
    for k in range(reach + 1):
        s[track[at.SINCE] + k] = 0.0
    slot[at.REACH], slot[at.NORTH_0], slot[at.EAST_0] = reach, pose[at.NORTH], pose[at.EAST]


@jit(entry=True)
def track_plan(program, head, s, q, slot, left, right, dt, out, work):
    """The track of a plan, from now; `out` is `(time, FOUND)`.

    `slot` is an array of a slot's length; `left`, `right` and `dt` are `(time,)`.
    """
    own, rest = work[:ROW], work[ROW:]
    filtered, psi = s[head[at.SURGE, at.STATE] + head[at.SURGE, at.MEAN] :], s[head[at.TRACK, at.BEFORE] + 5]
    along = filtered[CURRENT_NORTH] * np.cos(psi) + filtered[CURRENT_EAST] * np.sin(psi)
    origin(program, head, s, q, slot, psi, s[head[at.TRACK, at.BEFORE]] + along)
    for j in range(len(left)):
        track_step(program, head, s, q, slot, left[j], right[j], dt[j], own, rest, False)
        row = out[j]
        row[0], row[1], row[2], row[3] = slot[at.U], slot[at.V], slot[at.R], slot[at.PSI]
        if used(head, s):
            row[1] += slot[at.C_EAST] * slot[at.COS] - slot[at.C_NORTH] * slot[at.SIN]
        row[4], row[5] = slot[at.AT_NORTH], slot[at.AT_EAST]
        ellipse(head, q, slot, row[6:9])
