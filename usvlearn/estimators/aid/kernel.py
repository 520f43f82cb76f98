"""Adaptive identification: the step of `layer`, equations (1) to (6) of `state`."""

import numpy as np

from usvlearn.core.arrays import clamp, dot
from usvlearn.core.family import ESTIMATE, Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import DT, HOLD, LEARN, MODE, START, SURGE
from usvlearn.estimators.aid.state import AT, Choice, Number, Vector
from usvlearn.estimators.regressors.kernel import regressor


@jit
def start(node, s, q, surge):
    """`AID.start`."""
    s[node[AT.surge]] = surge


@jit
def predict(node, s, q, x, work):
    """`AID.predict`: the speed, (1), and what it was before its limits; φ stays in `work`."""
    p, numbers = node[Row.SIZE], q[node[Row.NUMBERS] :]
    phi, theta = work[:p], s[node[AT.theta] : node[AT.theta] + p]
    base = regressor(node[Choice.TERMS], s[node[AT.surge]], x, numbers[Number.SCALE], theta, phi)
    estimate = base + dot(phi, theta)
    return clamp(estimate, numbers[Number.SURGE_MAX]), estimate


@jit
def coast(node, s, q, x, predicted, work):
    """The state after `AID.predict`."""
    s[node[AT.surge]] = predicted


@jit
def learn(node, s, q, x, estimate, target, work):
    """The state after `AID.learn`."""
    p, numbers = node[Row.SIZE], q[node[Row.NUMBERS] :]
    phi, gamma, theta = work[:p], work[p : 2 * p], s[node[AT.theta] : node[AT.theta] + p]
    adaptation(numbers, q[node[Vector.SPREAD] :], gamma)
    inverse_spread, theta0 = q[node[Vector.INVERSE_SPREAD] :], q[node[Vector.THETA0] :]
    lower, upper, feedback = q[node[Vector.LOWER] :], q[node[Vector.UPPER] :], node[Choice.FEEDBACK] == ESTIMATE
    s[node[AT.surge]] = adapt(
        theta, numbers, gamma, inverse_spread, theta0, lower, upper, feedback, phi, estimate, target, x[DT]
    )


@jit
def adaptation(numbers, spread, gamma):
    """The diagonal of Γ, (2)."""
    for i in range(len(gamma)):
        gamma[i] = numbers[Number.GAIN] * (spread[i] * spread[i])


@jit
def adapt(theta, numbers, gamma, inverse_spread, theta0, lower, upper, feedback, phi, estimate, target, dt):
    """Equations (3) to (6), with the diagonal of Γ. Changes θ, returns the speed from which the next step departs."""
    p, dead_zone, sigma, bound = len(phi), numbers[Number.DEAD_ZONE], numbers[Number.SIGMA], numbers[Number.BOUND]
    error = estimate - target
    outside = error - clamp(error, dead_zone) if dead_zone > 0 else error
    N = 0.0
    square = 0.0
    for i in range(p):
        N += phi[i] * (gamma[i] * phi[i])
        square += phi[i] * phi[i]
    step = outside / (1 + N) if square * numbers[Number.SCALE] ** 2 >= numbers[Number.FLOOR] else 0.0
    n = 0.0
    for i in range(p):
        moved = theta[i] - step * (gamma[i] * phi[i])  # (3)
        moved = lower[i] if moved < lower[i] else (upper[i] if moved > upper[i] else moved)
        theta[i] = moved
        distance = (moved - theta0[i]) * inverse_spread[i]
        n += distance * distance
    if sigma > 0 and n > bound * bound:
        n = np.sqrt(n)
        rate = sigma * min(n / bound - 1, 1.0)  # (4)
        leak = min(-np.expm1(-rate * dt), 1 - bound / n)
        for i in range(p):
            theta[i] -= leak * (theta[i] - theta0[i])  # (5)
    if feedback:  # (6)
        return clamp(target + (error - N * step) * np.exp(-numbers[Number.LEAK] * dt), numbers[Number.SURGE_MAX])
    return target


@jit
def run_alone(node, s, q, rows, free, predictions, picked, picks, work):
    """One batch element of AID alone through all steps, as `engine.dispatch.run` does; constants are read once."""
    p, numbers = node[Row.SIZE], q[node[Row.NUMBERS] :]
    phi, gamma, theta = work[:p], work[p : 2 * p], s[node[AT.theta] : node[AT.theta] + p]
    adaptation(numbers, q[node[Vector.SPREAD] :], gamma)
    inverse_spread, theta0 = q[node[Vector.INVERSE_SPREAD] :], q[node[Vector.THETA0] :]
    lower, upper, feedback = q[node[Vector.LOWER] :], q[node[Vector.UPPER] :], node[Choice.FEEDBACK] == ESTIMATE
    terms, at = node[Choice.TERMS], node[AT.surge]
    for k in range(len(rows)):
        row = rows[k]
        predicted = np.nan
        if row[MODE] == START:
            s[at] = row[SURGE]
        elif row[MODE] != HOLD:
            estimate = regressor(terms, s[at], row, numbers[Number.SCALE], theta, phi) + dot(phi, theta)
            predicted = clamp(estimate, numbers[Number.SURGE_MAX])
            if row[MODE] == LEARN and not free:
                target, dt = row[SURGE], row[DT]
                s[at] = adapt(
                    theta, numbers, gamma, inverse_spread, theta0, lower, upper, feedback, phi, estimate, target, dt
                )
            else:
                s[at] = predicted
        predictions[k] = predicted
        for i in range(len(picked)):
            picks[k, i] = s[picked[i]]
