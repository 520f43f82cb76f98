"""One step of one estimator, or of an ensemble; and runs of many lanes through many steps.

The table (`program`, whole numbers) says what there is: its first row is about the whole, then a row for each
estimator, then one for each rule. `q` holds the numbers that were tuned or are known, `s` the state of one lane.
"""

import numpy as np

from usvlearn.arrays import clamp, copy, dot, finite
from usvlearn.estimators.aid.kernel import AID_FAMILY, adaptation, learn_aid, run_aid
from usvlearn.estimators.ensemble.combiners_kernel import NUMBERS as RULE_NUMBERS
from usvlearn.estimators.ensemble.combiners_kernel import STATE as RULE_STATE
from usvlearn.estimators.ensemble.combiners_kernel import combine, conformal, fill_sleeping, learn_rule
from usvlearn.estimators.ensemble.monitors_kernel import observe_innovations, observe_thrusters
from usvlearn.estimators.least_squares.kernel import (
    LEAST_SQUARES,
    coast_least_squares,
    inflate_least_squares,
    learn_least_squares,
    project_signs,
)
from usvlearn.estimators.regressors.kernel import INPUTS, LEFT_BEFORE, MEMORY, RIGHT_BEFORE, SURGE_DOT, regressor
from usvlearn.estimators.rnn.kernel import RNN_FAMILY, UNBROKEN, coast_rnn, learn_rnn, predict_rnn
from usvlearn.estimators.rnn.kernel import SURGE as RNN_SURGE
from usvlearn.family import MOST, NOT_NEGATIVE, POSITIVE, UNIT, Family, Field, Range
from usvlearn.jit import jit
from usvlearn.rows import DT, HOLD, LEARN, LEFT, MODE, PREDICT, RIGHT, ROW, START, SURGE, prepare
from usvlearn.signals import PLAUSIBLE

RLS, SIFT, AID, RNN, PERSISTENCE, ACCELERATION = range(6)

# Places in the first row of the table, and in the row of an estimator.
(
    ESTIMATORS, RULES, NAMES, OUTPUT, PREDICTIONS, HALFWIDTHS, CONFORMAL, MONITORS,
    LIMIT, CONFORMAL_NUMBERS, MONITOR_NUMBERS, KEPT, HEADS,
) = range(13)  # fmt: skip
(
    KIND, SIZE, TERMS, ESTIMATE, STATE, NUMBERS, MEMORY_STATE, MEMORY_NUMBERS, ROBUST_STATE, ROBUST_NUMBERS, OUTER,
    SIGNS, ITERATIONS, CONDITION, BEST, UNROLL,
) = range(16)  # fmt: skip

MEMORY_FIELDS = {
    "surge_dot": Field(()), "surge": Field(()), "since": Field((), NOT_NEGATIVE), "estimate": Field(()),
    "command_left": Field(()), "command_right": Field(()), "known": Field((), UNIT, flag=True),
}  # fmt: skip
ACCELERATION_OF, MEASURED, SINCE, DEPARTS, LAST_LEFT, LAST_RIGHT, KNOWN = range(7)
ROBUST_FIELDS = {"variance": Field((), POSITIVE)} | dict.fromkeys(
    ("run", "clipped", "rejected", "escaped"), Field((), NOT_NEGATIVE)
)
VARIANCE, BEYOND, CLIPPED, REJECTED, ESCAPED = range(5)
ROBUST_PARAMETERS = {
    "threshold": POSITIVE, "patience": POSITIVE, "inflation": Range(1 - 1e-6, MOST), "share": UNIT,
    "variance_min": POSITIVE, "moment": POSITIVE,
}  # fmt: skip
THRESHOLD, PATIENCE, INFLATION, SHARE, VARIANCE_MIN, MOMENT = range(6)
ACCELERATION_FIELDS = dict.fromkeys(("surge", "surge_dot", "measured"), Field(())) | {"since": Field((), NOT_NEGATIVE)}
FAMILIES = {  # in the order of the constants above
    "rls": LEAST_SQUARES,
    "sift": LEAST_SQUARES,
    "aid": AID_FAMILY,
    "rnn": RNN_FAMILY,
    "persistence": Family(lambda _: {"surge": Field(())}),
    "acceleration": Family(lambda _: ACCELERATION_FIELDS, {"surge_dot_max": POSITIVE, "surge_max": POSITIVE}),
}
ENSEMBLE_PARAMETERS = {"surge_max": POSITIVE}
WRAPPERS = {
    "memory": Family(lambda _: MEMORY_FIELDS, {"surge_dot_max": POSITIVE}),
    "robust": Family(lambda _: ROBUST_FIELDS, ROBUST_PARAMETERS),
}

NAN = np.nan


@jit
def base_speed(node, s):
    """Where the speed stands from which the next step departs."""
    kind, p = node[KIND], node[SIZE]
    if kind == RLS or kind == SIFT:
        return node[STATE] + p + p * p
    if kind == AID:
        return node[STATE] + p
    return node[STATE] + 21 * p + RNN_SURGE if kind == RNN else node[STATE]


@jit
def start(node, s, surge):
    """`Estimator.start`."""
    kind, place = node[KIND], base_speed(node, s)
    s[place] = surge
    if kind == RNN:
        s[node[STATE] + 21 * node[SIZE] + UNBROKEN] = 0.0
    elif kind == ACCELERATION:
        s[place + 1], s[place + 2], s[place + 3] = 0.0, surge, 0.0
    if node[MEMORY_STATE] >= 0:
        memory = s[node[MEMORY_STATE] : node[MEMORY_STATE] + 7]
        memory[ACCELERATION_OF], memory[MEASURED], memory[SINCE] = 0.0, surge, 0.0
        memory[DEPARTS], memory[KNOWN] = surge, 0.0
    if node[ROBUST_STATE] >= 0:
        s[node[ROBUST_STATE] + BEYOND] = 0.0


@jit
def advance(node, s, q, row, learns, work, kept):
    """One estimator, one step on, its wrappers included; returns what it predicted, m/s."""
    kind, p, at = node[KIND], node[SIZE], node[STATE]
    numbers, x, rest = q[node[NUMBERS] :], row, work[INPUTS:]
    if node[TERMS] & MEMORY:
        x = work[:INPUTS]
        copy(x[:SURGE], row[:SURGE])
        memory = s[node[MEMORY_STATE] : node[MEMORY_STATE] + 7]
        known = memory[KNOWN] > 0
        x[SURGE_DOT] = memory[ACCELERATION_OF]
        x[LEFT_BEFORE] = memory[LAST_LEFT] if known else x[LEFT]
        x[RIGHT_BEFORE] = memory[LAST_RIGHT] if known else x[RIGHT]
    estimate = s[base_speed(node, s)]
    if kind == RNN:
        predicted = predict_rnn(s[at : at + 21 * p + 9], p, numbers, x, rest)
    elif kind == PERSISTENCE:
        predicted = estimate
    elif kind == ACCELERATION:
        predicted = clamp(estimate + x[DT] * s[at + 1], numbers[1])
    else:
        phi = rest[:p]
        estimate = regressor(node[TERMS], estimate, x, numbers[0], phi) + dot(phi, s[at : at + p])
        predicted = clamp(estimate, numbers[1])
    if not learns:
        coast(node, s, numbers, x, predicted, rest)
        if node[MEMORY_STATE] >= 0:
            remember(s[node[MEMORY_STATE] :], q[node[MEMORY_NUMBERS]], x, predicted, False)
        return predicted
    if node[ROBUST_STATE] < 0:
        learn(node, s, q, x, estimate, predicted, row[SURGE], rest)
        if node[MEMORY_STATE] >= 0:
            remember(s[node[MEMORY_STATE] :], q[node[MEMORY_NUMBERS]], x, row[SURGE], True)
    else:
        robust, c = s[node[ROBUST_STATE] :], q[node[ROBUST_NUMBERS] :]
        end = node[ROBUST_STATE] if node[OUTER] or node[MEMORY_STATE] < 0 else node[MEMORY_STATE]
        copy(kept[: end - at], s[at:end])
        target, beyond, clips, first = within(robust, c, row[SURGE], predicted)
        if first and (kind == RLS or kind == SIFT):
            inflate_least_squares(s[at : at + p + p * p], p, numbers, c[INFLATION])
        learn(node, s, q, x, estimate, predicted, target, rest)
        if node[MEMORY_STATE] >= 0:
            measured = target if node[OUTER] else row[SURGE]
            remember(s[node[MEMORY_STATE] :], q[node[MEMORY_NUMBERS]], x, measured, True)
        update_scale(robust, c, row[SURGE] - predicted, beyond, clips, first, s[at:end], kept[: end - at])
    return predicted


@jit
def coast(node, s, numbers, x, predicted, work):
    """The state after `Estimator.predict`."""
    kind, p, at = node[KIND], node[SIZE], node[STATE]
    if kind == RLS or kind == SIFT:
        coast_least_squares(s[at : at + p + p * p + 3], work[:p], predicted, work[p : 2 * p])
    elif kind == AID:
        s[at + p] = predicted
    elif kind == RNN:
        coast_rnn(s[at : at + 21 * p + 9], p, numbers, predicted)
    elif kind == ACCELERATION:
        s[at] = predicted
        s[at + 3] += x[DT]


@jit
def learn(node, s, q, x, estimate, predicted, target, work):
    """The state after `Estimator.update`, without its wrappers."""
    kind, p, at, feedback = node[KIND], node[SIZE], node[STATE], node[ESTIMATE]
    numbers = q[node[NUMBERS] :]
    if kind == RLS or kind == SIFT:
        block = s[at : at + p + p * p + 3]
        learn_least_squares(block, numbers, kind == RLS, work[:p], estimate, target, x[DT], feedback, work[p:])
        if node[ITERATIONS] > 0:
            signs = q[node[SIGNS] : node[SIGNS] + p]
            project_signs(block[:p], block[p : p + p * p].reshape(p, p), signs, node[ITERATIONS], work)
    elif kind == AID:
        gamma = work[p : 2 * p]
        adaptation(numbers, gamma)
        learn_aid(s[at : at + p + 1], numbers, gamma, work[:p], estimate, target, x[DT], feedback)
    elif kind == RNN:
        block = s[at : at + 21 * p + 9]
        learn_rnn(block, p, numbers, node[CONDITION], node[BEST], node[UNROLL], feedback, x, predicted, target, work)
    elif kind == PERSISTENCE:
        s[at] = target
    else:
        since = s[at + 3] + x[DT]
        change = (target - s[at + 2]) / (since if since > 0 else 1.0)
        s[at], s[at + 1], s[at + 2], s[at + 3] = target, clamp(change, numbers[0]), target, 0.0


@jit
def remember(memory, limit, x, surge, learned):
    """The step before, as `WithMemory` keeps it, after `surge` was measured (`learned`), or predicted."""
    memory[SINCE] += x[DT]
    span = memory[SINCE] if learned else x[DT]
    change = surge - memory[MEASURED if learned else DEPARTS]
    memory[ACCELERATION_OF] = clamp(change / (span if span > 0 else 1.0), limit)
    if learned:
        memory[MEASURED], memory[SINCE] = surge, 0.0
    memory[DEPARTS], memory[LAST_LEFT], memory[LAST_RIGHT], memory[KNOWN] = surge, x[LEFT], x[RIGHT], 1.0


@jit
def within(robust, c, surge, predicted):
    """What `Robust` lets its estimator learn, (1); whether it is beyond the bound, clipped, or a change's first."""
    innovation = surge - predicted
    bound = c[THRESHOLD] * np.sqrt(robust[VARIANCE])
    beyond = abs(innovation) > bound
    escapes = beyond and robust[BEYOND] >= c[PATIENCE]
    first = escapes and robust[BEYOND] < c[PATIENCE] + 1
    clips = beyond and not escapes
    return predicted + clamp(innovation, bound) if clips else surge, beyond, clips, first


@jit
def update_scale(robust, c, innovation, beyond, clips, first, inner, kept):
    """The scale and the counts of `Robust`, (2); a sample that spoiled the estimator's state is undone."""
    square = innovation * innovation
    if not np.isfinite(square) or (not finite(inner) and finite(kept)):
        copy(inner, kept)
        robust[REJECTED] += 1
        return
    variance, bound = robust[VARIANCE], c[THRESHOLD] * c[THRESHOLD] * robust[VARIANCE]
    robust[VARIANCE] = max(variance + c[SHARE] * (min(square, bound) / c[MOMENT] - variance), c[VARIANCE_MIN])
    robust[BEYOND] = robust[BEYOND] + 1 if beyond else 0.0
    robust[CLIPPED] += clips
    robust[ESCAPED] += first


@jit
def step(program, s, q, row, mode, work):
    """`Estimator.forward` of a prepared sample, in place; returns the prediction, m/s, NaN where no step was made."""
    whole = program[0]
    estimators = whole[ESTIMATORS]
    if mode == HOLD:
        return NAN
    if mode == START:
        for i in range(1, estimators + 1):
            start(program[i], s, row[SURGE])
        return NAN
    kept = work[whole[KEPT] :]
    if whole[RULES] == 0:
        return advance(program[1], s, q, row, mode == LEARN, work, kept)
    predictions = s[whole[PREDICTIONS] : whole[PREDICTIONS] + whole[NAMES]]
    for i in range(estimators):
        predictions[i] = advance(program[i + 1], s, q, row, mode == LEARN, work, kept)
    aggregate(program, s, q, predictions, row, mode == LEARN, work)
    return predictions[whole[OUTPUT]]


@jit
def aggregate(program, s, q, predictions, row, learns, work):
    """What an `Ensemble` does after its members: rules, intervals, monitors."""
    whole = program[0]
    n, names = whole[ESTIMATORS], whole[NAMES]
    awake, x, rest = work[:n], work[n : 2 * n], work[2 * n :]
    mask_diverged(predictions, q[whole[LIMIT]], awake)
    for r in range(whole[RULES]):
        rule = program[1 + n + r]
        own, numbers = s[rule[RULE_STATE] :], q[rule[RULE_NUMBERS] :]
        asleep = fill_sleeping(rule, own, numbers, awake, x)
        predictions[n + r] = combine(rule, own, numbers, x)
        if learns:
            learn_rule(rule, own, numbers, x, asleep, row[SURGE], row[DT], rest)
    halfwidth = s[whole[CONFORMAL] : whole[CONFORMAL] + names]
    copy(s[whole[HALFWIDTHS] : whole[HALFWIDTHS] + names], halfwidth)
    if learns:
        innovation = work[:names]
        for i in range(names):
            innovation[i] = row[SURGE] - predictions[i]
        count = s[whole[CONFORMAL] + names : whole[CONFORMAL] + 2 * names]
        conformal(halfwidth, count, innovation, q[whole[CONFORMAL_NUMBERS] :])
        if whole[MONITORS] >= 0:
            numbers = q[whole[MONITOR_NUMBERS] :]
            observe_innovations(s[whole[MONITORS] :], innovation, names, numbers)
            observe_thrusters(s[whole[MONITORS] + 6 * names :], row, numbers, work)


@jit
def mask_diverged(predictions, limit, awake):
    """The members' predictions, NaN where one sleeps."""
    for i in range(len(awake)):
        awake[i] = predictions[i] if abs(predictions[i]) < limit else NAN


@jit(entry=True)
def surge_limit(program, q):
    """`Estimator.surge_limit`."""
    return min(q[program[0, LIMIT]], PLAUSIBLE) if program[0, RULES] > 0 else PLAUSIBLE


@jit(entry=True)
def step_once(program, s, q, work, left, right, heading, yaw_rate, dt, surge, fresh, measured):
    """`step` of one sample as it came."""
    row, limit = work[-ROW:], surge_limit(program, q)
    prepare(left, right, heading, yaw_rate, dt, surge, fresh, measured, program[0, HEADS] > 0, limit, row)
    return step(program, s, q, row, row[MODE], work)


@jit(entry=True)
def run(program, states, q, rows, columns, free, picked, predictions, picks, work, first, last):
    """Lanes first … last − 1 through all steps, in place.

    Args:
        program: the table.
        states: (lanes, size).
        q: (lanes, numbers), or (1, numbers) for all.
        rows: prepared samples, (columns, time, ROW).
        columns: (lanes,) whose samples each lane sees.
        free: learn nothing.
        picked: places of a state that are written out after each step.
        predictions: (lanes, time), m/s, is written.
        picks: (lanes, time, picked), is written.
        work: as long as the table's owner says.
    """
    wrapped = program[1, MEMORY_STATE] >= 0 or program[1, ROBUST_STATE] >= 0
    bare = program[0, RULES] == 0 and program[1, KIND] == AID and not wrapped
    for lane in range(first, last):
        s, numbers = states[lane], q[lane if len(q) > 1 else 0]
        if bare:  # what is chosen for every step of others is chosen once
            own = s[: program[1, SIZE] + 1]
            run_aid(own, numbers, program[1, TERMS], program[1, ESTIMATE], rows[columns[lane]], free, predictions[lane],
                    picked, picks[lane], work)  # fmt: skip
            continue
        for k in range(rows.shape[1]):
            row = rows[columns[lane], k]
            mode = PREDICT if free and row[MODE] == LEARN else row[MODE]
            predictions[lane, k] = step(program, s, numbers, row, mode, work)
            for i in range(len(picked)):
                picks[lane, k, i] = s[picked[i]]
