"""The shallow ReLU network: the step of `layer`, with Adam and the paper's penalty. Equations are those of `state`.

The weights lie in the order of the gradient: a, w1, W2 row by row, b.
"""

import numpy as np

from usvlearn.core.arrays import clamp, copy, fill, whole
from usvlearn.core.family import ESTIMATE, Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import COS, DT, LEFT, RIGHT, SIN
from usvlearn.estimators.rnn.projection_kernel import project
from usvlearn.estimators.rnn.state import (
    AT,
    AT_REPLAY,
    BEGIN,
    INPUTS,
    KEPT,
    STRIDE,
    SURGE,
    TARGET,
    TURN,
    UNBROKEN,
    WEIGHTS,
    Choice,
    Condition,
    Number,
    Vector,
)

TWO = Choice.UNROLL.allowed.index(2)


@jit
def start(node, s, q, surge):
    """`RNN.start`."""
    s[node[AT.surge]] = surge
    s[node[AT.unbroken]] = 0.0


@jit
def predict(node, s, q, x, work):
    """`RNN.predict`: the speed, m/s, twice; u and z stay in `work`."""
    n, scale, u = node[Row.SIZE], q[node[Row.NUMBERS] :][Number.SCALE], work[:INPUTS]
    network_inputs(x, u)
    weights = s[node[AT.weights.a] : node[AT.weights.a] + WEIGHTS * n]
    surge = network(weights, scale * s[node[AT.surge]], u, work[INPUTS : INPUTS + n]) / scale
    return surge, surge


@jit
def coast(node, s, q, x, predicted, work):
    """The state after `RNN.predict`."""
    s[node[AT.surge]] = clamp(predicted, 2 * q[node[Row.NUMBERS] :][Number.SURGE_MAX])
    s[node[AT.unbroken]] = 0.0


@jit
def free_step(node, s, q, x, work):
    """One step of an open-loop simulation: `predict`, and the leaves `frozen` after it; returns the speed, m/s."""
    predicted, _ = predict(node, s, q, x, work)
    s[node[AT.surge]] = clamp(predicted, 2 * q[node[Row.NUMBERS] :][Number.SURGE_MAX])
    return predicted


@jit
def learn(node, s, q, x, estimate, target, work):
    """`RNN.update`."""
    n, numbers = node[Row.SIZE], q[node[Row.NUMBERS] :]
    count = WEIGHTS * n
    weights, h, surge = s[node[AT.weights.a] : node[AT.weights.a] + count], numbers[Number.SCALE], s[node[AT.surge]]
    u, z, rest = work[:INPUTS], work[INPUTS : INPUTS + n], work[INPUTS + n :]
    z_before, grad = rest[:n], rest[n : n + count]
    before = s[node[AT.inputs_before] : node[AT.inputs_before] + INPUTS]
    if node[Choice.UNROLL] == TWO and s[node[AT.unbroken]] > 0:
        unrolled(weights, h, s[node[AT.surge_before]], before, u, target, z_before, z, grad)
    else:
        e = estimate * h - h * target
        gradient(weights, z, h * surge, u, e, grad)
    descend(node, s, q, weights, grad, limited(weights, numbers, n, grad), rest)
    if node[Choice.REPLAY_SIZE] > 0:
        keep(node, s, u, surge, target)
        learn_again(node, s, q, weights, z, rest)
    s[node[AT.surge_before]] = surge
    feedback = node[Choice.FEEDBACK] == ESTIMATE
    s[node[AT.surge]] = clamp(estimate, 2 * numbers[Number.SURGE_MAX]) if feedback else target
    copy(before, u)
    s[node[AT.dt]] = x[DT]
    s[node[AT.unbroken]] = 1.0


@jit(inline=True)
def limited(weights, numbers, n, grad):
    """Add the penalty's gradient; returns the factor that limits the norm."""
    if numbers[Number.PENALTY] > 0:
        penalise(weights, numbers[Number.PENALTY], n, grad)
    return clip(grad, numbers[Number.CLIP]) if numbers[Number.CLIP] < np.inf else 1.0


@jit(inline=True)
def descend(node, s, q, weights, grad, factor, rest):
    """`RNN._descend` by a gradient times a factor."""
    n, numbers, count = node[Row.SIZE], q[node[Row.NUMBERS] :], len(grad)
    moment1, moment2 = s[node[AT.moment1] : node[AT.moment1] + count], s[node[AT.moment2] : node[AT.moment2] + count]
    ratios = q[node[Vector.RATE_RATIO] : node[Vector.RATE_RATIO] + count]
    adam(weights, moment1, moment2, grad, factor, ratios, numbers, s[node[AT.updates]])
    if node[Choice.CONDITION] != Condition.NONE:
        bounds = q[node[Vector.BOUNDS] : node[Vector.BOUNDS] + 2 * (1 + INPUTS)]
        project(weights, n, node[Choice.CONDITION], node[Choice.BEST], numbers[Number.CONTRACTION_RATE], bounds, rest)
    s[node[AT.updates]] += 1


@jit
def keep(node, s, u, surge, target):
    """`replay_buffer.added`."""
    size = node[Choice.REPLAY_SIZE]
    learned = whole(s[node[AT_REPLAY.learned]], 2 * size)
    sample = s[node[AT_REPLAY.samples] + KEPT * (learned % size) :]
    copy(sample[:INPUTS], u)
    sample[SURGE], sample[TARGET], sample[UNBROKEN] = surge, target, s[node[AT.unbroken]]
    s[node[AT_REPLAY.learned]] = learned + 1 if learned + 1 < 2 * size else size


@jit
def learn_again(node, s, q, weights, z, rest):
    """One step of `descend` by the mean gradient of the kept samples that are due."""
    n, numbers, steps = node[Row.SIZE], q[node[Row.NUMBERS] :], node[Choice.REPLAY_STEPS]
    count = WEIGHTS * n
    z_before, grad, total = rest[:n], rest[n : n + count], rest[n + count : n + 2 * count]
    fill(total, 0.0)
    for _ in range(steps):
        gradient_again(node, s, weights, numbers[Number.SCALE], z, z_before, grad)
        shrink = limited(weights, numbers, n, grad)
        for i in range(count):
            total[i] += grad[i] * shrink
    descend(node, s, q, weights, total, 1.0 / steps, rest)


@jit
def gradient_again(node, s, weights, h, z, z_before, grad):
    """The gradient of the next sample of `replay_buffer.due`."""
    size, samples = node[Choice.REPLAY_SIZE], s[node[AT_REPLAY.samples] :]
    learned, turn = whole(s[node[AT_REPLAY.learned]], 2 * size), whole(s[node[AT_REPLAY.turn]], TURN)
    place = turn * min(learned, size) // TURN
    s[node[AT_REPLAY.turn]] = (turn + STRIDE) % TURN
    sample = samples[KEPT * place : KEPT * (place + 1)]
    u, surge, target = sample[:INPUTS], sample[SURGE], sample[TARGET]
    if node[Choice.UNROLL] == TWO and sample[UNBROKEN] > 0 and place != learned % size:
        earlier = samples[KEPT * (place - 1 if place > 0 else size - 1) :]
        unrolled(weights, h, earlier[SURGE], earlier[:INPUTS], u, target, z_before, z, grad)
    else:
        e = network(weights, h * surge, u, z) - h * target
        gradient(weights, z, h * surge, u, e, grad)


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
        W2 = weights[n * BEGIN.W2 + INPUTS * i :]
        through = W2[0] * u[0] + W2[1] * u[1] + W2[2] * u[2] + W2[3] * u[3]
        z[i] = weights[n * BEGIN.w1 + i] * x + through + weights[n * BEGIN.b + i]
    for i in range(n):
        predicted += weights[n * BEGIN.a + i] * (0.0 if z[i] < 0 else z[i])
    return predicted


@jit
def unrolled(weights, h, surge_before, before, u, target, z_before, z, grad):
    """The gradient (3) of the loss two steps on."""
    x_before = h * surge_before
    between = network(weights, x_before, before, z_before)
    e = network(weights, between, u, z) - h * target
    slope = gradient(weights, z, between, u, e, grad)
    add_gradient(weights, z_before, x_before, before, e * slope, grad)


@jit
def gradient(weights, z, x, u, e, grad):
    """The gradient of the loss of one step, (3) without the step before; returns s."""
    n = len(z)
    slope = 0.0
    for i in range(n):
        on = z[i] > 0
        grad_z = e * weights[n * BEGIN.a + i] if on else 0.0
        slope += weights[n * BEGIN.a + i] * weights[n * BEGIN.w1 + i] if on else 0.0
        grad[n * BEGIN.a + i] = e * (z[i] if on else 0.0 * z[i])
        grad[n * BEGIN.w1 + i] = grad_z * x
        W2 = grad[n * BEGIN.W2 + INPUTS * i :]
        W2[0], W2[1], W2[2], W2[3] = grad_z * u[0], grad_z * u[1], grad_z * u[2], grad_z * u[3]
        grad[n * BEGIN.b + i] = grad_z
    return slope


@jit
def add_gradient(weights, z, x, u, through, grad):
    """Add what (3) says of the step before, with e s = `through`."""
    n = len(z)
    for i in range(n):
        if z[i] > 0:
            grad_z = through * weights[n * BEGIN.a + i]
            grad[n * BEGIN.a + i] += through * z[i]
            grad[n * BEGIN.w1 + i] += grad_z * x
            for j in range(INPUTS):
                grad[n * BEGIN.W2 + INPUTS * i + j] += grad_z * u[j]
            grad[n * BEGIN.b + i] += grad_z


@jit
def penalise(weights, penalty, n, grad):
    """Add the gradient of the paper's penalty, the second term of (2)."""
    bound = 1.0 / (n + 1)
    for i in range(n):
        if abs(weights[n * BEGIN.a + i]) + bound * abs(weights[n * BEGIN.w1 + i]) > bound:
            grad[n * BEGIN.a + i] += penalty * weights[n * BEGIN.a + i]
            grad[n * BEGIN.w1 + i] += penalty * weights[n * BEGIN.w1 + i]


@jit(reorder=True)
def clip(grad, limit):
    """What `layer.clipped` multiplies the gradient by."""
    total = 0.0
    for i in range(len(grad)):
        grad[i] = min(max(grad[i], -1e15), 1e15)
        total += grad[i] * grad[i]
    return 1.0 / np.sqrt(1 + total / (limit * limit))


@jit
def adam(weights, moment1, moment2, grad, shrink, ratios, numbers, updates):
    """One step of Adam by the gradient times `shrink`, at rates of these ratios."""
    count = updates + 1
    rate = numbers[Number.RATE]
    if numbers[Number.DECAY] < np.inf:
        rate /= np.sqrt(1 + np.floor(updates / numbers[Number.DECAY]))
    momentum, share2 = numbers[Number.MOMENTUM], numbers[Number.SHARE2]  # the latter is 1 − β₂
    epsilon, tiny = numbers[Number.EPSILON], numbers[Number.TINY]
    if momentum > 0:
        rate /= 1 - momentum**count
    correction = 1.0 / (1 - np.exp(count * numbers[Number.LOG_BETA2]))
    for i in range(len(grad)):
        g = grad[i] * shrink
        m = g + momentum * (moment1[i] - g)
        v = moment2[i] + share2 * (g * g - moment2[i])
        moment1[i], moment2[i] = m, v
        weights[i] -= rate * ratios[i] * m / (np.sqrt(max(v * correction, tiny)) + epsilon)
