"""One step of one estimator or of an ensemble, and runs of many batch elements through many steps.

The table (`program`, integers) lists the parts: the first row describes the whole; then comes a row for each estimator,
one for each combiner, and one for each wrapper and other part of an ensemble. `q` holds the tuned and known numbers,
`s` the state of one batch element.
"""

import numpy as np

from usvlearn.core.arrays import copy
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import DT, HOLD, LEARN, MODE, PREDICT, ROW, START, SURGE, prepare
from usvlearn.core.samples import PLAUSIBLE
from usvlearn.engine.dispatch_tables import ALONE, INFLATES, coast, inflate_covariance, learn, predict, run_alone
from usvlearn.engine.dispatch_tables import start as start_estimator
from usvlearn.engine.forecasting import coasted, forecast_step, forget_forecasts
from usvlearn.engine.planar import axis_row, tracks
from usvlearn.estimators.ensemble.accommodation.kernel import accommodate
from usvlearn.estimators.ensemble.combiners.kernel import combine, fill_inactive, learn_rule
from usvlearn.estimators.ensemble.conformal.kernel import conformal, published
from usvlearn.estimators.ensemble.forecasts.state import AT as FORECAST
from usvlearn.estimators.ensemble.monitors.kernel import observe_innovations, observe_thrusters
from usvlearn.estimators.ensemble.state import AT, Number
from usvlearn.estimators.planar.state import NUMBER, PROGRAM, STATE
from usvlearn.estimators.wrappers.robust.kernel import inflation, update_scale, within
from usvlearn.estimators.wrappers.robust.kernel import start as start_robust

NAN, COASTED = np.nan, FORECAST.coasted


@jit
def start(program, node, s, q, surge):
    """`Estimator.start`, wrappers included."""
    start_estimator(node, s, q, surge)
    if node[Row.ROBUST] >= 0:
        start_robust(program[node[Row.ROBUST]], s)


@jit
def advance(program, node, s, q, row, learns, work, backup):
    """One estimator, one step on, its wrappers included; returns what it predicted, m/s."""
    predicted, estimate = predict(node, s, q, row, work)
    if not learns:
        coast(node, s, q, row, predicted, work)
        return predicted
    if node[Row.ROBUST] < 0:
        learn(node, s, q, row, estimate, row[SURGE], work)
        return predicted
    wrapper, state = program[node[Row.ROBUST]], s[node[Row.BEGIN] : node[Row.END]]
    before = backup[: len(state)]
    copy(before, state)
    target, beyond, clips, first = within(wrapper, s, q, row[SURGE], predicted)
    if first and INFLATES >> node[Row.FAMILY] & 1:
        inflate_covariance(node, s, q, inflation(wrapper, q))
    learn(node, s, q, row, estimate, target, work)
    update_scale(wrapper, s, q, row[SURGE] - predicted, beyond, clips, first, state, before)
    return predicted


@jit
def step(program, s, q, row, mode, work):
    """`Estimator.forward` of a prepared sample, in place; returns the prediction, m/s, NaN where no step was made."""
    whole = program[0]
    estimators = whole[Row.ESTIMATORS]
    if mode == HOLD:
        return NAN
    if mode == START:
        for i in range(1, estimators + 1):
            start(program, program[i], s, q, row[SURGE])
        if whole[Row.RULES] > 0 and whole[Row.FORECASTS] >= 0:
            forget_forecasts(program[whole[Row.FORECASTS]], s, q)
        return NAN
    backup = work[whole[Row.KEPT] :]
    if whole[Row.RULES] == 0:
        return advance(program, program[1], s, q, row, mode == LEARN, work, backup)
    predictions = s[whole[AT.predictions] : whole[AT.predictions] + whole[Row.NAMES]]
    for i in range(estimators):
        predictions[i] = advance(program, program[i + 1], s, q, row, mode == LEARN, work, backup)
    aggregate(program, s, q, predictions, row, mode == LEARN, work)
    if whole[Row.FORECASTS] >= 0:
        limit = surge_max(program, q)
        forecast_step(program, program[whole[Row.FORECASTS]], s, q, row, mode == LEARN, limit, work)
    return predictions[whole[Row.OUTPUT]]


@jit
def aggregate(program, s, q, predictions, row, learns, work):
    """The steps of an `Ensemble` after those of its members: combiners, intervals, monitors, accommodation."""
    whole = program[0]
    n, names = whole[Row.ESTIMATORS], whole[Row.NAMES]
    active, x, rest = work[:n], work[n : 2 * n], work[2 * n :]
    mask_diverged(predictions, surge_max(program, q), active)
    for r in range(whole[Row.RULES]):
        rule = program[1 + n + r]
        inactive = fill_inactive(rule, s, q, active, x)
        predictions[n + r] = combine(rule, s, q, x)
        if learns:
            learn_rule(rule, s, q, x, inactive, row[SURGE], row[DT], rest)
    if whole[Row.FORECASTS] >= 0 and s[program[whole[Row.FORECASTS], COASTED]] > 0:
        forecasts = program[whole[Row.FORECASTS]]
        predictions[whole[Row.OUTPUT]] = coasted(forecasts, s, q, predictions, row[DT], surge_max(program, q), work)
    intervals = program[whole[Row.CONFORMAL]]
    limit, spreads = surge_max(program, q), work[2 * names : 3 * names]
    published(intervals, s, predictions, n, limit, row, spreads, s[whole[AT.halfwidths] :])
    if learns:
        innovation, rest = work[:names], work[names:]
        for i in range(names):
            innovation[i] = row[SURGE] - predictions[i]
        conformal(intervals, s, q, innovation, predictions, limit, row, spreads)
        if whole[Row.MONITORS] >= 0:
            monitors = program[whole[Row.MONITORS]]
            observe_innovations(monitors, s, q, innovation)
            observe_thrusters(monitors, s, q, row, rest)
            if whole[Row.ACCOMMODATION] >= 0:
                accommodate(program, program[whole[Row.ACCOMMODATION]], monitors, s, q, row, rest)


@jit
def surge_max(program, q):
    """`Ensemble.surge_max`."""
    return q[program[0, Row.NUMBERS] :][Number.SURGE_MAX]


@jit
def mask_diverged(predictions, limit, active):
    """Write the members' predictions, NaN where one has diverged (it is inactive)."""
    for i in range(len(active)):
        active[i] = predictions[i] if abs(predictions[i]) < limit else NAN


@jit
def row_begin(program, work):
    """Where the room for a prepared sample begins, at the end of the work array, with the predictions of other code."""
    return len(work) - ROW - program[0, Row.EXTERNAL]


@jit(entry=True)
def surge_limit(program, q):
    """`Estimator.surge_limit`."""
    return min(surge_max(program, q), PLAUSIBLE) if program[0, Row.RULES] > 0 else PLAUSIBLE


@jit(entry=True)
def step_once(program, s, q, work, left, right, heading, yaw_rate, dt, surge, fresh, measured):
    """`step` of one sample that is not prepared."""
    row, limit = work[row_begin(program, work) :], surge_limit(program, q)
    prepare(left, right, heading, yaw_rate, dt, surge, fresh, measured, program[0, Row.HEADS] > 0, limit, row)
    return step(program, s, q, row, row[MODE], work)


@jit
def steps(program, head, s, q, row, pose, mode, work):
    """One step of all axes; returns the prediction of the surge, m/s."""
    predicted, axes, end = NAN, len(head) - 1, row_begin(program, work)
    prepared = work[end - ROW : end]
    for axis in range(max(axes, 1)):
        if axis > 0:
            mode = axis_row(axis, head, s, row, pose, prepared)
        at, x = head[axis], row if axis == 0 else prepared
        prediction = step(program[at[PROGRAM] :], s[at[STATE] :], q[at[NUMBER] :], x, mode, work)
        if axis == 0:
            predicted = prediction
    if axes > 0:
        tracks(program, head, s, q, row, pose, work)
    return predicted


@jit(entry=True)
def step_planar(program, head, s, q, work, left, right, heading, yaw_rate, dt, surge, fresh, measured, pose):
    """`steps` of one sample that is not prepared."""
    row, limit = work[row_begin(program, work) :], surge_limit(program, q)
    prepare(left, right, heading, yaw_rate, dt, surge, fresh, measured, program[0, Row.HEADS] > 0, limit, row)
    return steps(program, head, s, q, row, pose, row[MODE], work)


@jit(entry=True)
def run(program, head, states, q, rows, poses, columns, free, picked, predictions, picks, work, first, last):
    """Batch elements first … last − 1 through all steps, in place.

    Args:
        program: the table.
        head: places of the axes and of the tracks, (4, …); (1, …), zeros, of the surge alone.
        states: (elements, size).
        q: (elements, numbers), or (1, numbers) for all.
        rows: prepared samples, (columns, time, ROW), and behind each what other code predicts.
        poses: what is measured at the end of each step, (columns, time, 5); of the surge alone (1, 1, 0).
        free: whether nothing is learned.
        picked: places of the state that are recorded after each step.
        predictions, picks: (elements, time), m/s, and (elements, time, picked), are written.
        work: array of length `Program.work`.
    """
    node = program[1]
    bare = program[0, Row.RULES] == 0 and node[Row.ROBUST] < 0 and ALONE >> node[Row.FAMILY] & 1
    planar = len(head) > 1
    for element in range(first, last):
        s, numbers = states[element], q[element if len(q) > 1 else 0]
        if bare:  # its family has a loop of its own over all steps
            run_alone(
                node, s, numbers, rows[columns[element]], free, predictions[element], picked, picks[element], work
            )
            continue
        for k in range(rows.shape[1]):
            row = rows[columns[element], k]
            mode = PREDICT if free and row[MODE] == LEARN else row[MODE]
            pose = poses[columns[element], k] if planar else row
            predictions[element, k] = steps(program, head, s, numbers, row, pose, mode, work)
            for i in range(len(picked)):
                picks[element, k, i] = s[picked[i]]
