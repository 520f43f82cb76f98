"""The ARX filter: equations (1) to (4) of `state`."""

import numpy as np

from usvlearn.core.arrays import clamp, copy, dot, fill, whole
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import DT, LEFT, RIGHT, YAW_RATE
from usvlearn.estimators.arx.state import (
    AT,
    COMMANDS,
    EVEN_SQUARE,
    LONGEST,
    RATES,
    REST_SQUARE,
    REST_TIME,
    SPEED,
    SQUARE,
    STEP,
    Choice,
    Number,
    Vector,
)
from usvlearn.estimators.least_squares.state import LOOSEST, NOISE_LEAST, NOISE_SHARE
from usvlearn.estimators.ud_factorization.kernel import add, loosen, measure, project, rotated, variance, walked

GROUP = len(COMMANDS)


@jit
def start(node, s, q, surge):
    """A segment starts."""
    s[node[AT.surge]] = surge
    s[node[AT.started]] = 1.0
    fill(s[node[AT.past] : node[AT.past] + node[Row.SIZE]], 0.0)


@jit
def predict(node, s, q, x, work):
    """The speed, and what it was before its limits; f stays in `work`."""
    p, surge, limit = node[Row.SIZE], s[node[AT.surge]], q[node[Row.NUMBERS] :][Number.SURGE_MAX]
    f = work[:p]
    features(node, s, x, clamp(surge, limit), f)
    estimate = surge + steps(x) * dot(f, s[node[AT.theta] : node[AT.theta] + p])
    return clamp(estimate, limit), estimate


@jit
def coast(node, s, q, x, predicted, work):
    """The state after a prediction: its deviation, and its increment."""
    p, h = node[Row.SIZE], steps(x)
    phi, g, G = work[p : 2 * p], work[2 * p : 3 * p], work[3 * p : 4 * p]
    for i in range(p):
        phi[i] = h * work[i]
    A = s[node[AT.factor] : node[AT.factor] + p * p].reshape(p, p)
    s[node[AT.deviation]] = np.sqrt(s[node[AT.noise]] * (1.0 + rotated(A, phi, g, G)))
    remember(node, s, q, h, predicted, work)


@jit
def free_step(node, s, q, x, work):
    """One step of an open-loop simulation: `predict`, and the leaves `frozen` after it; returns the speed, m/s."""
    predicted, _ = predict(node, s, q, x, work)
    remember(node, s, q, steps(x), predicted, work)
    return predicted


@jit
def learn(node, s, q, x, estimate, target, work):
    """The state after a measured speed."""
    p, numbers, prior = node[Row.SIZE], q[node[Row.NUMBERS] :], q[node[Vector.PRIOR] :]
    phi, g, G, gain = work[p : 2 * p], work[2 * p : 3 * p], work[3 * p : 4 * p], work[4 * p : 5 * p]
    theta, A = s[node[AT.theta] : node[AT.theta] + p], s[node[AT.factor] : node[AT.factor] + p * p].reshape(p, p)
    h, noise, error, tails = steps(x), s[node[AT.noise]], target - estimate, numbers[Number.TAILS]
    for i in range(p):
        phi[i] = h * work[i]
    S = 1.0 + rotated(A, phi, g, G)
    s[node[AT.deviation]] = np.sqrt(noise * S)
    s[node[AT.rest]] = s[node[AT.rest]] + x[DT] if resting(x, work) else 0.0
    if s[node[AT.rest]] <= REST_TIME:
        seen = error * error / S
        weight = (1.0 + tails) / (1.0 + tails * seen / noise)
        share = error / measure(A, g, G, 1.0 / weight, gain)
        for i in range(p):
            theta[i] += share * gain[i]
        if node[Choice.PROJECT] > 0:
            even, share = SQUARE, 0.0
            if node[Choice.EVEN] > 0:
                even, share = RATES + node[Choice.LAGS] + GROUP * (node[Choice.LAGS] + 1) + EVEN_SQUARE, 1.0
            project(theta, A, SPEED, SPEED, 0.0, gain)
            project(theta, A, SQUARE, even, share, gain)
            project(theta, A, SQUARE, even, -share, gain)
        k = whole(s[node[AT.turn]], p)
        add(A, k, walked(A, k, prior[k], len(A) * (h * numbers[Number.WALK]) * prior[k]), gain)
        learned = noise + NOISE_SHARE * (weight * seen - noise)
        s[node[AT.turn]] = k + 1 if k + 1 < p else 0
        s[node[AT.noise]] = NOISE_LEAST**2 if learned < NOISE_LEAST**2 else learned
    remember(node, s, q, h, target, work)


@jit
def inflate_covariance(node, s, q, factor):
    """P times `factor`, up to its limit."""
    p, prior = node[Row.SIZE], q[node[Vector.PRIOR] :]
    A = s[node[AT.factor] : node[AT.factor] + p * p].reshape(p, p)
    first, trace = 0.0, 0.0
    for j in range(p):
        first += prior[j]
        trace += variance(A, j)
    loosen(A, factor, LOOSEST * first / trace)


@jit
def steps(x):
    """h of (1)."""
    return min(x[DT] / STEP, LONGEST)


@jit
def resting(x, f):
    """Whether the boat rests; f[1] is its speed."""
    return x[LEFT] * x[LEFT] + x[RIGHT] * x[RIGHT] + f[1] * f[1] < REST_SQUARE


@jit
def features(node, s, x, v, f):
    """Write f of (1) at the speed v."""
    left, right, yaw_rate, lags = x[LEFT], x[RIGHT], x[YAW_RATE], node[Choice.LAGS]
    past, started = s[node[AT.past] : node[AT.past] + len(f)], s[node[AT.started]] > 0
    f[0], f[1], f[2], f[3] = 1.0, v, v * abs(v), abs(yaw_rate) * v
    for i in range(RATES, RATES + lags):
        f[i] = past[i]
    at = RATES + lags
    f[at], f[at + 1], f[at + 2], f[at + 3] = left + right, left - right, left * abs(left), right * abs(right)
    for i in range(at + GROUP, at + GROUP * (lags + 1)):
        f[i] = f[i - GROUP] if started else past[i - GROUP]
    at += GROUP * (lags + 1)
    if node[Choice.EVEN] > 0:
        f[at], f[at + 1] = abs(left) + abs(right), left * left + right * right
        f[at + 2], f[at + 3] = v * v, (left + right) * v
        at += 4
    if node[Choice.TURNING] > 0:
        f[at], f[at + 1] = yaw_rate, 0.0 if started else yaw_rate - past[at]
        at += 2
    if node[Choice.THRUST_SPEED] > 0:
        f[at], f[at + 1] = left * abs(v), right * abs(v)


@jit
def remember(node, s, q, h, surge, work):
    """Keep f in `work` and the increment to the speed from which the next step departs."""
    p, lags, limit = node[Row.SIZE], node[Choice.LAGS], q[node[Row.NUMBERS] :][Number.SURGE_MAX]
    past = s[node[AT.past] : node[AT.past] + p]
    copy(past, work[:p])
    if lags > 0:
        for i in range(RATES + 1, RATES + lags):
            past[i] = work[i - 1]
        past[RATES] = clamp((surge - s[node[AT.surge]]) / h, limit)
    s[node[AT.surge]] = surge
    s[node[AT.started]] = 0.0
