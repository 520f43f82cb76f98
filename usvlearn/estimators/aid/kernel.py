"""Adaptive identification: the step of `estimators.aid`, equations (1) to (6) there."""

import numpy as np

from usvlearn.arrays import clamp, dot
from usvlearn.estimators.regressors.kernel import FEEDBACK, regressor
from usvlearn.family import FINITE, MODEST, NOT_NEGATIVE, POSITIVE, Family, Field, Range, Vector
from usvlearn.jit import jit
from usvlearn.rows import DT, HOLD, LEARN, MODE, START, SURGE

AID_NUMBERS = {
    "scale": MODEST, "surge_max": POSITIVE, "gain": POSITIVE, "leak": POSITIVE, "dead_zone": NOT_NEGATIVE,
    "floor": NOT_NEGATIVE, "sigma": NOT_NEGATIVE, "bound": POSITIVE,
}  # fmt: skip
SCALE, SURGE_MAX, GAIN, LEAK, DEAD_ZONE, FLOOR, SIGMA, BOUND = range(8)
AID_VECTORS = {
    "spread": NOT_NEGATIVE, "inverse_spread": NOT_NEGATIVE, "theta0": FINITE, "lower": Range(-np.inf, 0.0),
    "upper": Range(0.0, np.inf),
}  # fmt: skip
VECTORS = 8


def aid_fields(p):
    """The leaves of `AIDState`."""
    return {"theta": Field((p,)), "surge": Field(())}


AID_FAMILY = Family(
    aid_fields, AID_NUMBERS, {name: Vector(lambda p: p, legal) for name, legal in AID_VECTORS.items()},
    {"feedback": FEEDBACK}, size=None,
)  # fmt: skip


@jit
def adaptation(q, gamma):
    """The diagonal of Γ, (2)."""
    for i in range(len(gamma)):
        gamma[i] = q[GAIN] * (q[VECTORS + i] * q[VECTORS + i])


@jit
def learn_aid(block, q, gamma, phi, estimate, target, dt, feedback):
    """`AID.learn` on the leaves in `block`, with the diagonal of Γ."""
    p = len(phi)
    theta, inverse_spread, theta0 = block[:p], q[VECTORS + p : VECTORS + 2 * p], q[VECTORS + 2 * p : VECTORS + 3 * p]
    lower, upper = q[VECTORS + 3 * p : VECTORS + 4 * p], q[VECTORS + 4 * p : VECTORS + 5 * p]
    error = estimate - target
    outside = error - clamp(error, q[DEAD_ZONE]) if q[DEAD_ZONE] > 0 else error
    N = 0.0
    square = 0.0
    for i in range(p):
        N += phi[i] * (gamma[i] * phi[i])
        square += phi[i] * phi[i]
    step = outside / (1 + N) if square * q[SCALE] ** 2 >= q[FLOOR] else 0.0
    n = 0.0
    for i in range(p):
        moved = theta[i] - step * (gamma[i] * phi[i])  # (3)
        moved = lower[i] if moved < lower[i] else (upper[i] if moved > upper[i] else moved)
        theta[i] = moved
        distance = (moved - theta0[i]) * inverse_spread[i]
        n += distance * distance
    bound = q[BOUND]
    if q[SIGMA] > 0 and n > bound * bound:
        n = np.sqrt(n)
        rate = q[SIGMA] * min(n / bound - 1, 1.0)  # (4)
        leak = min(-np.expm1(-rate * dt), 1 - bound / n)
        for i in range(p):
            theta[i] -= leak * (theta[i] - theta0[i])  # (5)
    if feedback:
        target = clamp(target + (error - N * step) * np.exp(-q[LEAK] * dt), q[SURGE_MAX])  # (6)
    block[p] = target


@jit
def run_aid(block, q, terms, feedback, rows, free, predictions, picked, picks, work):
    """One lane of AID alone through all steps, as `step.run`."""
    p = len(block) - 1
    gamma, phi = work[:p], work[p : 2 * p]
    adaptation(q, gamma)
    for k in range(len(rows)):
        row = rows[k]
        predicted = np.nan
        if row[MODE] == START:
            block[p] = row[SURGE]
        elif row[MODE] != HOLD:
            estimate = regressor(terms, block[p], row, q[SCALE], phi) + dot(phi, block[:p])
            predicted = clamp(estimate, q[SURGE_MAX])
            if row[MODE] == LEARN and not free:
                learn_aid(block, q, gamma, phi, estimate, row[SURGE], row[DT], feedback)
            else:
                block[p] = predicted
        predictions[k] = predicted
        for i in range(len(picked)):
            picks[k, i] = block[picked[i]]
