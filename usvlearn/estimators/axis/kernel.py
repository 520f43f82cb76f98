"""The axis EKF: equations (1) to (4) of `state`.

`predict` leaves g and y⁺ in `work`. A is the leaf `factor`.
"""

import numpy as np

from usvlearn.core.arrays import clamp, fill
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import DT, LEFT, RIGHT, YAW_RATE
from usvlearn.core.prepared_samples import SIN as OTHER_INPUT
from usvlearn.estimators.augmented_ekf.kernel import (
    add_noise,
    blocks,
    correct,
    decay,
    first_row,
    inflate,
    isolate,
    limit,
    limit_lag,
)
from usvlearn.estimators.augmented_ekf.state import AT, LONGEST, MOST, REST, B, Y
from usvlearn.estimators.axis.state import (
    COUPLING,
    CROSS,
    KINDS,
    LINEAR,
    OTHER,
    QUADRATIC,
    SIDE,
    SURGE,
    THETA,
    Number,
    Vector,
)
from usvlearn.estimators.regressors.kernel import phi1
from usvlearn.estimators.ud_factorization.kernel import project

YAW = KINDS.index("yaw")


@jit
def start(node, s, q, surge):
    """A segment starts."""
    s[node[AT.surge]] = surge
    s[node[AT.started]] = 1.0


@jit
def predict(node, s, q, x, work):
    """y⁺ of (3), and the same before its limit."""
    n, commands = node[Row.SIZE], node[AT.commands]
    mean, g = s[node[AT.mean] : node[AT.mean] + n], work[:n]
    y, b, left, right = mean[Y], mean[B], s[commands], s[commands + 1]
    if s[node[AT.started]] > 0:
        y, b, left, right = s[node[AT.surge]], 0.0, x[LEFT], x[RIGHT]
    work[n] = flow(node[Row.KIND] == YAW, mean, y, b, left, right, x, g)
    predicted = clamp(work[n], MOST)
    return predicted, predicted


@jit
def coast(node, s, q, x, predicted, work):
    """The state after a prediction."""
    advance(node, s, q, x, work)


@jit
def free_step(node, s, q, x, work):
    """One step of an open-loop simulation: `predict`, and the leaves `frozen` after it."""
    commands = node[AT.commands]
    predicted, _ = predict(node, s, q, x, work)
    mean = s[node[AT.mean] : node[AT.mean] + node[Row.SIZE]]
    if s[node[AT.started]] > 0:
        mean[B], s[node[AT.started]] = 0.0, 0.0
    mean[Y], mean[B] = predicted, mean[B] * decay(x[DT], q[node[Row.NUMBERS] :][Number.DISTURBANCE_TIME])
    s[commands], s[commands + 1] = x[LEFT], x[RIGHT]
    return predicted


@jit
def learn(node, s, q, x, estimate, target, work):
    """The state after a measured y."""
    n, numbers = node[Row.SIZE], q[node[Row.NUMBERS] :]
    mean, A = blocks(node, s)
    spread, rest = advance(node, s, q, x, work)
    if x[DT] > LONGEST:
        start(node, s, q, target)
        return
    correct(node, s, target - estimate, spread, numbers[Number.OUTLIER], rest, work)
    for i in range(LINEAR, CROSS + 1):
        project(mean, A, i, i, 0.0, work[2 * n : 3 * n])
    limit_lag(mean)


@jit
def inflate_covariance(node, s, q, factor):
    """P times `factor`, up to its limit."""
    inflate(node, s, q[node[Vector.VARIANCE] :], THETA, factor)


@jit
def flow(yaw, mean, y, b, left_before, right_before, x, g):
    """y⁺ of (3); writes its gradient to x into g."""
    mu, h, other, u = mean[-1], x[DT], x[OTHER_INPUT], x[YAW_RATE]
    size, along, terms = abs(y), abs(u), 6 if yaw else 2
    f = b + mean[THETA] + (mean[LINEAR] + mean[QUADRATIC] * size + mean[CROSS] * along) * y
    f += mean[COUPLING] * (u * other) + mean[OTHER] * other + mean[SURGE] * u
    J, late = mean[LINEAR] + 2 * mean[QUADRATIC] * size + mean[CROSS] * along, 0.0  # late: ∂f/∂μ
    for side in range(2):
        now, before = (x[LEFT], left_before) if side == 0 else (x[RIGHT], right_before)
        xi = (1 - mu) * now + mu * before
        a, own = abs(xi), mean[SIDE + terms * side : SIDE + terms * (side + 1)]
        f += own[0] * xi + own[1] * (xi * a)
        slope = own[0] + 2 * own[1] * a
        if yaw:
            f += own[2] * (xi * along) + own[3] * (xi * xi * xi) + own[4] * a + own[5] * (xi * xi)
            slope += own[2] * along + 3 * own[3] * (xi * xi) + (own[4] if xi >= 0 else -own[4]) + 2 * own[5] * xi
        late += (before - now) * slope
    z = h * J
    z = 1.0 if z > 1 else z
    value, bend = phi1(z)
    by_f, by_J = h * value, h * h * bend * f
    g[Y] = 1 + z * value + by_J * 2 * mean[QUADRATIC] * (1.0 if y >= 0 else -1.0)
    g[B], g[THETA] = by_f, by_f
    g[LINEAR], g[QUADRATIC], g[CROSS] = by_f * y + by_J, by_f * y * size + by_J * 2 * size, along * (by_f * y + by_J)
    g[COUPLING], g[OTHER], g[SURGE] = by_f * (u * other), by_f * other, by_f * u
    for side in range(2):
        now, before = (x[LEFT], left_before) if side == 0 else (x[RIGHT], right_before)
        xi = (1 - mu) * now + mu * before
        a, k = abs(xi), SIDE + terms * side
        g[k], g[k + 1] = by_f * xi, by_f * (xi * a)
        if yaw:
            g[k + 2], g[k + 3] = by_f * (xi * along), by_f * (xi * xi * xi)
            g[k + 4], g[k + 5] = by_f * a, by_f * xi * xi
    g[-1] = by_f * late
    return y + by_f * f


@jit
def advance(node, s, q, x, work):
    """The time update from what `predict` left in `work`, where f and G stay; returns HᵀPH, and whether it rests."""
    n, numbers, h, commands = node[Row.SIZE], q[node[Row.NUMBERS] :], x[DT], node[AT.commands]
    mean, A = blocks(node, s)
    g, ahead, noise = work[:n], work[n], s[node[AT.noise]]
    if s[node[AT.started]] > 0:
        isolate(A, noise)
        mean[Y], mean[B], s[node[AT.started]] = s[node[AT.surge]], 0.0, 0.0
    rest = x[LEFT] * x[LEFT] + x[RIGHT] * x[RIGHT] + x[YAW_RATE] * x[YAW_RATE] + mean[Y] * mean[Y] <= REST
    if rest:
        fill(g[THETA:], 0.0)
    slow = decay(h, numbers[Number.DISTURBANCE_TIME])
    transition(A, g, slow)
    disturbance, drift_time, a = numbers[Number.DISTURBANCE], numbers[Number.DRIFT_TIME], work[n + 1 : 2 * n + 1]
    add_noise(node, s, A, q[node[Vector.VARIANCE] :], THETA, disturbance, drift_time, h, rest, a)
    limit(A, ahead)
    mean[Y], mean[B] = clamp(ahead, MOST), mean[B] * slow
    s[commands], s[commands + 1] = x[LEFT], x[RIGHT]
    f, G, spread = work[:n], work[n : 2 * n], A[Y, Y]
    f[Y], G[Y] = 1.0, A[Y, Y]
    for j in range(1, n):
        f[j], G[j] = A[j, Y], A[j, j] * A[j, Y]
        spread += f[j] * G[j]
    s[node[AT.deviation]] = np.sqrt(spread + noise)
    return spread, rest


@jit(reorder=True)
def transition(A, g, slow):
    """F P Fᵀ."""
    first_row(A, g)
    A[B, Y] /= slow
    for j in range(THETA, len(g)):
        A[j, B] *= slow
    A[Y, Y] *= g[Y] * g[Y]
    A[B, B] *= slow * slow
