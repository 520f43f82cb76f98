"""The shallow ReLU network: the step of `estimators.rnn`, with Adam and the paper's penalty.

The weights lie in the order of the gradient: a, w1, W2 row by row, b.
"""

import numpy as np

from usvlearn.arrays import clamp, copy
from usvlearn.estimators.regressors.kernel import FEEDBACK
from usvlearn.estimators.rnn.projection_kernel import CONDITIONS, NONE, project
from usvlearn.family import (
    BELOW_ONE,
    FACTOR,
    FINITE,
    MODEST,
    NOT_NEGATIVE,
    POSITIVE,
    POSITIVE_OR_INFINITE,
    UNIT,
    Family,
    Field,
    Range,
    Vector,
)
from usvlearn.jit import jit
from usvlearn.rows import COS, DT, LEFT, RIGHT, SIN

RNN_NUMBERS = {
    "scale": MODEST, "surge_max": POSITIVE, "rate": POSITIVE, "decay": POSITIVE_OR_INFINITE, "momentum": BELOW_ONE,
    "clip": POSITIVE_OR_INFINITE, "contraction_rate": FACTOR, "penalty": NOT_NEGATIVE, "share2": UNIT,
    "log_beta2": Range(-100.0, -1e-6), "epsilon": POSITIVE, "tiny": UNIT,
}  # fmt: skip
SCALE, SURGE_MAX, RATE, DECAY, MOMENTUM, CLIP, KAPPA, PENALTY, SHARE2, LOG_BETA2, EPSILON, TINY = range(12)
BOUNDS = 12  # least and greatest x, u of the box, ten numbers
RATIOS = 22  # relative rates, 7n numbers


def rnn_fields(n):
    """The leaves of `RNNState`."""
    weights = {"weights.a": (n,), "weights.w1": (n,), "weights.W2": (n, 4), "weights.b": (n,), "moment1": (7 * n,)}
    speeds = {"surge": (), "surge_before": (), "inputs_before": (4,), "dt": ()}
    return {
        **{name: Field(shape) for name, shape in weights.items()},
        "moment2": Field((7 * n,), NOT_NEGATIVE), "updates": Field((), NOT_NEGATIVE),
        **{name: Field(shape) for name, shape in speeds.items()},
        "unbroken": Field((), UNIT, flag=True),
    }  # fmt: skip


RNN_FAMILY = Family(
    rnn_fields, RNN_NUMBERS,
    {"bounds": Vector(lambda _: 10, FINITE), "rate_ratio": Vector(lambda n: 7 * n, NOT_NEGATIVE)},
    {"feedback": FEEDBACK, "unroll": (1, 2), "condition": CONDITIONS, "best": (False, True)}, Range(1, 100_000),
)  # fmt: skip


# Places behind the weights and the moments, from 21 n on.
UPDATES, SURGE, SURGE_BEFORE, INPUTS_BEFORE, LAST_DT, UNBROKEN = 0, 1, 2, 3, 7, 8


@jit
def network_inputs(x, u):
    """u of (1)."""
    u[0], u[1], u[2], u[3] = 0.5 + 0.5 * x[SIN], 0.5 + 0.5 * x[COS], x[LEFT], x[RIGHT]


@jit
def network(weights, x, u, z):
    """x⁺ of (1); z is written."""
    n = len(z)
    predicted = 0.0
    for i in range(n):
        W2 = weights[2 * n + 4 * i : 2 * n + 4 * i + 4]
        z[i] = weights[n + i] * x + (W2[0] * u[0] + W2[1] * u[1] + W2[2] * u[2] + W2[3] * u[3]) + weights[6 * n + i]
    for i in range(n):
        predicted += weights[i] * (0.0 if z[i] < 0 else z[i])
    return predicted


@jit
def gradient(weights, z, x, u, e, grad):
    """The gradient of the loss of one step, (3) without the step before; returns s."""
    n = len(z)
    slope = 0.0
    for i in range(n):
        on = z[i] > 0
        grad_z = e * weights[i] if on else 0.0
        slope += weights[i] * weights[n + i] if on else 0.0
        grad[i] = e * (z[i] if on else 0.0 * z[i])
        grad[n + i] = grad_z * x
        W2 = grad[2 * n + 4 * i : 2 * n + 4 * i + 4]
        W2[0], W2[1], W2[2], W2[3] = grad_z * u[0], grad_z * u[1], grad_z * u[2], grad_z * u[3]
        grad[6 * n + i] = grad_z
    return slope


@jit
def add_gradient(weights, z, x, u, through, grad):
    """Add what (3) says of the step before, with e s = `through`."""
    n = len(z)
    for i in range(n):
        if z[i] > 0:
            grad_z = through * weights[i]
            grad[i] += through * z[i]
            grad[n + i] += grad_z * x
            for j in range(4):
                grad[2 * n + 4 * i + j] += grad_z * u[j]
            grad[6 * n + i] += grad_z


@jit
def penalise(weights, penalty, n, grad):
    """Add the gradient of the paper's penalty, the second term of (2)."""
    bound = 1.0 / (n + 1)
    for i in range(n):
        if abs(weights[i]) + bound * abs(weights[n + i]) > bound:
            grad[i] += penalty * weights[i]
            grad[n + i] += penalty * weights[n + i]


@jit(reorder=True)
def clip(grad, limit):
    """What `rnn.clipped` multiplies the gradient by."""
    total = 0.0
    for i in range(len(grad)):
        grad[i] = min(max(grad[i], -1e15), 1e15)
        total += grad[i] * grad[i]
    return 1.0 / np.sqrt(1 + total / (limit * limit))


@jit
def adam(weights, moment1, moment2, grad, shrink, q, updates):
    """One step of Adam by the gradient times `shrink`."""
    count = updates + 1
    rate = q[RATE]
    if q[DECAY] < np.inf:
        rate /= np.sqrt(1 + np.floor(updates / q[DECAY]))
    momentum, share2, epsilon, tiny = q[MOMENTUM], q[SHARE2], q[EPSILON], q[TINY]  # share2 is 1 − β₂
    if momentum > 0:
        rate /= 1 - momentum**count
    correction = 1.0 / (1 - np.exp(count * q[LOG_BETA2]))
    ratios = q[RATIOS : RATIOS + len(grad)]
    for i in range(len(grad)):
        g = grad[i] * shrink
        m = g + momentum * (moment1[i] - g)
        v = moment2[i] + share2 * (g * g - moment2[i])
        moment1[i], moment2[i] = m, v
        weights[i] -= rate * ratios[i] * m / (np.sqrt(max(v * correction, tiny)) + epsilon)


@jit
def predict_rnn(block, n, q, x, work):
    """`RNN.predict`'s speed, m/s; u and z stay in `work`."""
    u = work[:4]
    network_inputs(x, u)
    return network(block[: 7 * n], q[SCALE] * block[21 * n + SURGE], u, work[4 : 4 + n]) / q[SCALE]


@jit
def coast_rnn(block, n, q, surge):
    """The state after `predict`."""
    block[21 * n + SURGE] = clamp(surge, 2 * q[SURGE_MAX])
    block[21 * n + UNBROKEN] = 0.0


@jit
def learn_rnn(block, n, q, condition, best, unroll, feedback, x, surge, target, work):
    """`RNN.update` after `predict_rnn` on the leaves in `block`; `surge` is what that predicted."""
    weights, rest = block[: 7 * n], block[21 * n :]
    u, z, z_before, grad = work[:4], work[4 : 4 + n], work[4 + n : 4 + 2 * n], work[4 + 2 * n : 4 + 9 * n]
    h = q[SCALE]
    start = h * rest[SURGE]
    if unroll and rest[UNBROKEN] > 0:
        before = rest[INPUTS_BEFORE : INPUTS_BEFORE + 4]
        between = network(weights, h * rest[SURGE_BEFORE], before, z_before)
        e = network(weights, between, u, z) - h * target
        s = gradient(weights, z, between, u, e, grad)
        add_gradient(weights, z_before, h * rest[SURGE_BEFORE], before, e * s, grad)
    else:
        e = surge * h - h * target
        gradient(weights, z, start, u, e, grad)
    if q[PENALTY] > 0:
        penalise(weights, q[PENALTY], n, grad)
    shrink = clip(grad, q[CLIP]) if q[CLIP] < np.inf else 1.0
    adam(weights, block[7 * n : 14 * n], block[14 * n : 21 * n], grad, shrink, q, rest[UPDATES])
    if condition != NONE:
        project(weights, n, condition, best, q[KAPPA], q[BOUNDS : BOUNDS + 10], work[4 + n :])
    rest[UPDATES] += 1
    rest[SURGE_BEFORE] = rest[SURGE]
    rest[SURGE] = clamp(surge, 2 * q[SURGE_MAX]) if feedback else target
    copy(rest[INPUTS_BEFORE : INPUTS_BEFORE + 4], u)
    rest[LAST_DT] = x[DT]
    rest[UNBROKEN] = 1.0
