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
from usvlearn.engine.forecasting import PLACE, freeze, step_frozen
from usvlearn.engine.planar_ellipses import ellipse, follow_surprise, keep_ellipses, publish_due
from usvlearn.estimators.ensemble.forecasts.kernel import between, combine, judged
from usvlearn.estimators.ensemble.forecasts.state import AT as FORECASTS
from usvlearn.estimators.ensemble.forecasts.state import EMPTY
from usvlearn.estimators.ensemble.forecasts.state import Choice as ForecastChoice
from usvlearn.estimators.ensemble.manoeuvre_intervals.kernel import begin_path, extend_path
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import PATH
from usvlearn.estimators.ensemble.state import Number as EnsembleNumber
from usvlearn.estimators.joint.state import EAST as CURRENT_EAST
from usvlearn.estimators.joint.state import NORTH as CURRENT_NORTH
from usvlearn.estimators.planar.state import (
    AT_EAST,
    AT_NORTH,
    BEFORE,
    BLOCK,
    C_EAST,
    C_NORTH,
    COMMANDS,
    COS_0,
    COUNT,
    DUE,
    DUES,
    EAST,
    EAST_0,
    ELAPSED,
    HEADING,
    HELD_COS,
    HELD_EAST,
    HELD_NORTH,
    HELD_SIN,
    HORIZON,
    HORIZON_COUNT,
    LENGTH,
    LIMIT,
    MEAN,
    MEASURED_SWAY,
    NORTH,
    NORTH_0,
    NUMBER,
    PROGRAM,
    PSI,
    PSI_0,
    R_0,
    REACH,
    RUN,
    SIN_0,
    SINCE,
    SLOTS,
    STATE,
    SURGE,
    SWAY,
    TRACK,
    TURN,
    U_0,
    UPDATES,
    USED,
    WEIGHTS,
    YAW,
    Q,
    R,
    U,
    V,
    W,
)
from usvlearn.estimators.planar.state import COS as COS_PSI
from usvlearn.estimators.planar.state import SIN as SIN_PSI

FOUND = 9  # of a plan's step: surge, sway, yaw rate, heading, north, east, and the covariance: NN, NE, EE


@jit
def axis_row(axis, head, s, row, pose, own):
    """Write the prepared sample of the sway or of the yaw rate, after the surge's step; returns its mode."""
    before, filtered = s[head[TRACK, BEFORE] :], s[head[SURGE, STATE] + head[SURGE, MEAN] :]
    own[LEFT], own[RIGHT], own[COS], own[YAW_RATE], own[DT] = row[LEFT], row[RIGHT], 0.0, before[0], row[DT]
    if axis == SWAY:
        psi, target = pose[HEADING], pose[MEASURED_SWAY]
        own[SIN] = before[2]
        target += filtered[CURRENT_NORTH] * np.sin(psi) - filtered[CURRENT_EAST] * np.cos(psi)  # (1)
    else:
        target = pose[TURN]
        own[SIN] = before[1]
    known, mode = abs(target) < LIMIT, row[MODE]
    own[TARGET] = target if known else 0.0
    if mode == LEARN or mode == PREDICT:
        return LEARN if known else PREDICT
    return START if mode == START and known else HOLD


@jit
def used(head, s):
    """Whether the sway has been measured often enough."""
    return s[head[SWAY, STATE] + head[SWAY, UPDATES]] >= USED


@jit
def end_step(head, s, row, pose):
    """Keep w, v and r at the end of a step, from which the next one departs."""
    before, mode = s[head[TRACK, BEFORE] :], row[MODE]
    filtered = s[head[SURGE, STATE] + head[SURGE, MEAN] :]
    if mode == HOLD:
        return
    last = before[2]
    if mode == START:
        along = 0.0
        if abs(pose[HEADING]) < np.inf:
            along = filtered[CURRENT_NORTH] * np.cos(pose[HEADING]) + filtered[CURRENT_EAST] * np.sin(pose[HEADING])
        before[0], before[1] = row[TARGET] - along, 0.0
        before[2] = pose[TURN] if abs(pose[TURN]) < LIMIT else 0.0
    else:
        before[0], before[3], before[4] = filtered[0], row[LEFT], row[RIGHT]
        before[1] = s[head[SWAY, STATE] + head[SWAY, MEAN]] if used(head, s) else 0.0
        before[2] = s[head[YAW, STATE] + head[YAW, MEAN]]
    turned = before[5] + row[DT] * (last + before[2]) / 2  # of the filter alone, where no heading came
    before[5] = pose[HEADING] if abs(pose[HEADING]) < np.inf else turned


@jit
def mixed(axis, program, head, q, slot, after, own, work):
    """One step of the frozen members of an axis, and what they predict together, `after` s from the origin."""
    table, numbers = program[head[axis, PROGRAM] :], q[head[axis, NUMBER] :]
    node = table[table[0, PLACE]]
    H, M, length = node[ForecastChoice.HORIZONS], node[ForecastChoice.MEMBERS], node[Row.SIZE]
    x, weights, rest = work[:M], work[M : 2 * M], work[2 * M :]
    limit = numbers[table[0, Row.NUMBERS] + EnsembleNumber.SURGE_MAX]
    block = slot[head[axis, BLOCK] : head[axis, BLOCK] + length]
    step_frozen(table, node, block, numbers, own, limit, x, rest)
    k, rise = between(node, numbers, after)
    below, above = slot[head[axis, WEIGHTS] + k * M :], slot[head[axis, WEIGHTS] + min(k + 1, H - 1) * M :]
    for m in range(M):
        weights[m] = (1 - rise) * below[m] + rise * above[m] if rise > 0 else below[m]
    return combine(node, numbers, weights, x)


@jit
def track_step(program, head, s, q, slot, left, right, h, own, work, judged):
    """(2): one step of a track, in place; `judged`: it will be compared with the way at the yaw rate of its origin."""
    u, v, r, w, psi = slot[U], slot[V], slot[R], slot[W], slot[PSI]
    north, east, sways = slot[C_NORTH], slot[C_EAST], used(head, s)
    after, ahead = slot[ELAPSED] + h, r
    own[LEFT], own[RIGHT], own[COS], own[DT], own[YAW_RATE] = left, right, 0.0, h, w
    along, aside, turned = u, 0.0, psi
    for axis in (YAW, SWAY, SURGE):
        if axis == YAW:
            own[SIN] = v
        elif axis == SWAY:
            own[SIN] = r
            if not sways:
                continue
        else:
            middle = (psi + turned) / 2
            own[SIN], own[COS], own[YAW_RATE] = np.sin(middle), np.cos(middle), (r + ahead) / 2
        predicted = mixed(axis, program, head, q, slot, after, own, work)
        if not abs(predicted) < LIMIT:
            continue
        if axis == YAW:
            ahead = predicted
            turned = psi + h * (r + ahead) / 2
        elif axis == SWAY:
            aside = predicted
        else:
            along = predicted
    c, d, cosine, sine = slot[COS_PSI], slot[SIN_PSI], np.cos(turned), np.sin(turned)
    lateral, other = (v - north * d + east * c, aside - north * sine + east * cosine) if sways else (0.0, 0.0)
    slot[AT_NORTH] += h / 2 * (c * u - d * lateral + cosine * along - sine * other)
    slot[AT_EAST] += h / 2 * (d * u + c * lateral + sine * along + cosine * other)
    if judged:
        held = slot[PSI_0] + slot[R_0] * after
        held_cosine, held_sine = np.cos(held), np.sin(held)
        slot[HELD_NORTH] += h / 2 * (slot[HELD_COS] * u + held_cosine * along)
        slot[HELD_EAST] += h / 2 * (slot[HELD_SIN] * u + held_sine * along)
        slot[HELD_COS], slot[HELD_SIN] = held_cosine, held_sine
    slot[COS_PSI], slot[SIN_PSI] = cosine, sine
    slot[RUN] += h * abs(u + along) / 2
    slot[U], slot[V], slot[R], slot[W], slot[PSI] = along, aside, ahead, along - north * cosine - east * sine, turned
    slot[ELAPSED] = after
    extend_path(slot[COMMANDS : COMMANDS + PATH], left, right)


@jit
def origin(program, head, s, q, slot, psi, surge):
    """Begin a track now, at a heading, rad, and a measured surge, m/s; all but its horizon and its position."""
    before, filtered = s[head[TRACK, BEFORE] :], s[head[SURGE, STATE] + head[SURGE, MEAN] :]
    fill(slot[:HORIZON], 0.0)
    slot[COS_0], slot[SIN_0], slot[PSI_0] = np.cos(psi), np.sin(psi), psi
    slot[COS_PSI], slot[SIN_PSI], slot[HELD_COS], slot[HELD_SIN] = slot[COS_0], slot[SIN_0], slot[COS_0], slot[SIN_0]
    slot[C_NORTH], slot[C_EAST] = filtered[CURRENT_NORTH], filtered[CURRENT_EAST]
    slot[U], slot[V], slot[R], slot[W], slot[PSI] = surge, before[1], before[2], before[0], psi
    slot[U_0], slot[R_0] = surge, before[2]
    begin_path(slot[COMMANDS : COMMANDS + PATH], before[3], before[4])
    for axis in range(3):
        table, own = program[head[axis, PROGRAM] :], s[head[axis, STATE] :]
        node = table[table[0, PLACE]]
        H, M, length = node[ForecastChoice.HORIZONS], node[ForecastChoice.MEMBERS], node[Row.SIZE]
        freeze(node, own, slot[head[axis, BLOCK] : head[axis, BLOCK] + length])
        for k in range(H):
            weights = own[node[FORECASTS.rule.weights] + judged(node, own, k) * M :]
            for m in range(M):
                slot[head[axis, WEIGHTS] + k * M + m] = weights[m]
    keep_ellipses(head, s, slot)


@jit
def forget_tracks(head, s, q):
    """No track is under way, and the next step may begin one of every horizon."""
    for i in range(head[TRACK, COUNT]):
        s[head[TRACK, SLOTS] + i * head[TRACK, LENGTH] + ELAPSED] = EMPTY
    for k in range(head[TRACK, HORIZON_COUNT]):
        s[head[TRACK, SINCE] + k] = q[head[TRACK, Q] + 2 + k]


@jit
def tracks(program, head, s, q, row, pose, work):
    """All tracks under way make one step with its commands; what is due is learned, and one may begin."""
    H, length, horizons = head[TRACK, HORIZON_COUNT], head[TRACK, LENGTH], q[head[TRACK, Q] + 2 :]
    fill(s[head[TRACK, DUES] : head[TRACK, DUES] + H * DUE], np.nan)
    mode, overlap = row[MODE], q[head[TRACK, Q] + 1]
    end_step(head, s, row, pose)
    if mode == HOLD or mode == START:
        forget_tracks(head, s, q)
        return
    follow_surprise(head, s, row, pose)
    own, rest, half, free = work[:ROW], work[ROW:], row[DT] / 2, -1
    for i in range(head[TRACK, COUNT]):
        slot = s[head[TRACK, SLOTS] + i * length : head[TRACK, SLOTS] + (i + 1) * length]
        if not slot[ELAPSED] >= 0:
            slot[ELAPSED], free = EMPTY, i
            continue
        start = slot[ELAPSED]
        track_step(program, head, s, q, slot, row[LEFT], row[RIGHT], row[DT], own, rest, True)
        for k in range(H):
            if start + half < horizons[k] <= slot[ELAPSED] + half:
                publish_due(head, s, q, slot, k, pose)
        if slot[ELAPSED] + half >= horizons[whole(slot[REACH], H)]:
            slot[ELAPSED], free = EMPTY, i
    for k in range(H):
        s[head[TRACK, SINCE] + k] += row[DT]
    if mode != LEARN or free < 0 or not abs(pose[HEADING]) + abs(pose[NORTH]) + abs(pose[EAST]) < np.inf:
        return
    if s[head[TRACK, SINCE]] + half < horizons[0] / overlap:
        return
    slot = s[head[TRACK, SLOTS] + free * length : head[TRACK, SLOTS] + (free + 1) * length]
    origin(program, head, s, q, slot, pose[HEADING], row[TARGET])
    reach = 0
    for k in range(H):
        if s[head[TRACK, SINCE] + k] + half >= horizons[k] / overlap:
            reach = k
    for k in range(reach + 1):
        s[head[TRACK, SINCE] + k] = 0.0
    slot[REACH], slot[NORTH_0], slot[EAST_0] = reach, pose[NORTH], pose[EAST]


@jit(entry=True)
def track_plan(program, head, s, q, slot, left, right, dt, found, work):
    """The track of a plan, from now; `found` is `(time, FOUND)`.

    `slot` is an array of a slot's length; `left`, `right` and `dt` are `(time,)`.
    """
    own, rest = work[:ROW], work[ROW:]
    filtered, psi = s[head[SURGE, STATE] + head[SURGE, MEAN] :], s[head[TRACK, BEFORE] + 5]
    along = filtered[CURRENT_NORTH] * np.cos(psi) + filtered[CURRENT_EAST] * np.sin(psi)
    origin(program, head, s, q, slot, psi, s[head[TRACK, BEFORE]] + along)
    for j in range(len(left)):
        track_step(program, head, s, q, slot, left[j], right[j], dt[j], own, rest, False)
        row = found[j]
        row[0], row[1], row[2], row[3] = slot[U], slot[V], slot[R], slot[PSI]
        if used(head, s):
            row[1] += slot[C_EAST] * slot[COS_PSI] - slot[C_NORTH] * slot[SIN_PSI]
        row[4], row[5] = slot[AT_NORTH], slot[AT_EAST]
        ellipse(head, q, slot, row[6:9])
