"""The joint EKF: equations (1) to (7) of `state`.

`predict` leaves g, w⁺ and e^(−h/τ_c) in `work`. A is the leaf `factor`.
"""

import numpy as np

from usvlearn.core.arrays import clamp, fill
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import COS, DT, LEFT, RIGHT, SIN, YAW_RATE
from usvlearn.estimators.augmented_ekf.kernel import (
    add_noise,
    blocks,
    correct,
    decay,
    inflate,
    isolate,
    limit,
    limit_lag,
)
from usvlearn.estimators.augmented_ekf.state import LONGEST, MOST, REST
from usvlearn.estimators.joint.change_detection_kernel import (
    detect,
    exchange,
    has_trial,
    judge,
    keep,
    likelihood,
    loosen_sides,
)
from usvlearn.estimators.joint.factored_kernel import add_current, seen, transition
from usvlearn.estimators.joint.state import (
    AGEING,
    AT,
    AT_TRIAL,
    CURRENT_VARIANCE,
    DROPPED,
    EAST,
    KAPPA,
    NORTH,
    SPEED_VARIANCE,
    THETA,
    B,
    Choice,
    E,
    Number,
    Vector,
    W,
)
from usvlearn.estimators.regressors.kernel import phi1
from usvlearn.estimators.ud_factorization.kernel import measure, project


@jit
def start(node, s, q, surge):
    """A segment starts."""
    s[node[AT.surge]] = surge
    s[node[AT.started]] = 1.0
    if has_trial(node):
        s[node[AT_TRIAL.statistic]] = s[node[AT_TRIAL.last]] = 0.0
        if not s[node[AT_TRIAL.tried]] > 0:
            s[node[AT_TRIAL.run]] = 0.0


@jit
def predict(node, s, q, x, work):
    """The speed, (3) and (4), twice."""
    predicted = forecast(node, s, q, x, work)
    return predicted, predicted


@jit
def coast(node, s, q, x, predicted, work):
    """The state after a prediction."""
    mean, A = blocks(node, s)
    before = shared(node, s)
    advance(node, s, q, x, mean, A, work)
    if has_trial(node) and s[node[AT_TRIAL.run]] > 0:
        second(node, s, q, x, 0.0, False, before, work)
        s[node[AT_TRIAL.run]] += 1


@jit
def free_step(node, s, q, x, work):
    """One step of an open-loop simulation: `predict`, and the leaves `frozen` after it; returns the speed, m/s."""
    n, commands = node[Row.SIZE], node[AT.commands]
    mean, predicted = s[node[AT.mean] : node[AT.mean] + n], forecast(node, s, q, x, work)
    if s[node[AT.started]] > 0:
        mean[B], s[node[AT.started]] = 0.0, 0.0
    move(mean, work[n], decay(x[DT], q[node[Row.NUMBERS] :][Number.DISTURBANCE_TIME]), work[n + 1])
    s[commands], s[commands + 1] = x[LEFT], x[RIGHT]
    return predicted


@jit
def learn(node, s, q, x, estimate, target, work):
    """The state after a measured speed."""
    tries, before = has_trial(node), shared(node, s)
    if tries and not s[node[AT_TRIAL.run]] > 0:
        keep(node, s)
    S, rest = update(node, s, q, x, estimate, target, work)
    leads = False
    if tries:
        if x[DT] > LONGEST:
            if s[node[AT_TRIAL.run]] > 0:
                second(node, s, q, x, target, True, before, work)
                s[node[AT_TRIAL.run]] += 1
        else:
            compare(node, s, q, x, (target - estimate) / np.sqrt(S), S, target, rest, before, work)
        leads = s[node[AT_TRIAL.leads]] > 0
    if x[DT] > LONGEST:
        start(node, s, q, target)
    elif s[node[AT.learned]] >= q[node[Row.NUMBERS] :][Number.ESTIMATE_EVERY] and not leads:
        read(node, s, s[node[AT.mean] + THETA : node[AT.mean] + node[Row.SIZE]])


@jit
def update(node, s, q, x, estimate, target, work):
    """One filter after a measurement, (3) to (7); returns S, and whether the boat was at rest."""
    n, numbers = node[Row.SIZE], q[node[Row.NUMBERS] :]
    mean, A = blocks(node, s)
    spread, rest = advance(node, s, q, x, mean, A, work)
    if x[DT] > LONGEST:
        return spread, rest
    S = correct(node, s, target - estimate, spread, numbers[Number.OUTLIER], rest, work)
    if not rest:
        s[node[AT.learned]] += x[DT]
    project_signs(mean, A, node[Choice.EVEN], work[2 * n : 3 * n])
    return S, rest


@jit
def shared(node, s):
    """What both filters of a trial read of the state before a step: whether it is a segment's first, commands, turn."""
    commands = node[AT.commands]
    return s[node[AT.started]], s[commands], s[commands + 1], s[node[AT.turn]]


@jit
def second(node, s, q, x, target, learns, before, work):
    """The step of the filter that does not predict, from `before`; returns its z, S, and whether it was at rest."""
    commands, deviation, learned = node[AT.commands], s[node[AT.deviation]], s[node[AT.learned]]
    s[node[AT.started]], s[commands], s[commands + 1], s[node[AT.turn]] = before
    exchange(node, s)
    predicted, z, S = forecast(node, s, q, x, work), 0.0, 1.0
    if learns:
        S, rest = update(node, s, q, x, predicted, target, work)
        z = (target - predicted) / np.sqrt(S)
    else:
        mean, A = blocks(node, s)
        S, rest = advance(node, s, q, x, mean, A, work)
    exchange(node, s)
    s[node[AT.deviation]], s[node[AT.learned]] = deviation, learned
    return z, S, rest


@jit
def compare(node, s, q, x, z, S, target, rest, before, work):
    """The trial after a measurement with the innovation z √S of the filter that predicts, (8) to (10)."""
    begins = False
    if not rest:
        s[node[AT_TRIAL.since]] += x[DT]
        begins = not s[node[AT_TRIAL.tried]] > 0 and detect(node, s, z)
    if begins:
        loosen_sides(node, s, q, work[: node[Row.SIZE]])
        s[node[AT_TRIAL.evidence]] = 0.0
    if not (begins or s[node[AT_TRIAL.run]] > 0):
        return
    other, spread, still = second(node, s, q, x, target, True, before, work)
    if not (rest or still):
        more = likelihood(other, spread) - likelihood(z, S)
        s[node[AT_TRIAL.evidence]] += -more if s[node[AT_TRIAL.leads]] > 0 else more
    s[node[AT_TRIAL.run]] += 1
    judge(node, s, q)


@jit
def inflate_covariance(node, s, q, factor):
    """P times `factor`, up to its limit."""
    inflate(node, s, q[node[Vector.VARIANCE] :], THETA, factor)


@jit
def forecast(node, s, q, x, work):
    """The prediction, m/s; g, w⁺ and e^(−h/τ_c) stay in `work`."""
    n, numbers, commands = node[Row.SIZE], q[node[Row.NUMBERS] :], node[AT.commands]
    mean, g = s[node[AT.mean] : node[AT.mean] + n], work[:n]
    along = x[COS] * mean[NORTH] + x[SIN] * mean[EAST]
    w, b, left, right = mean[W], mean[B], s[commands], s[commands + 1]
    if s[node[AT.started]] > 0:
        w, b, left, right = s[node[AT.surge]] - along, 0.0, x[LEFT], x[RIGHT]
    speed, moved = flow(node[Choice.EVEN], mean, w, b, left, right, x, g), decay(x[DT], numbers[Number.CURRENT_TIME])
    work[n], work[n + 1] = speed, moved
    return clamp(speed, MOST) + moved * along


@jit
def flow(even, mean, w, b, left_before, right_before, x, g):
    """w⁺ of (3); writes its gradient to x into g."""
    theta, kappa, mu, h = mean[THETA:KAPPA], mean[KAPPA:E], mean[-1], x[DT]
    speed, turn, sign = abs(w), abs(x[YAW_RATE]), 1.0 if w >= 0 else -1.0
    f = theta[0] * speed * w + theta[1] * w + theta[2] * turn * w + b
    J = 2 * theta[0] * speed + theta[1] + theta[2] * turn
    if even:
        f += mean[E] * w * w
        J += 2 * mean[E] * w
    late, later = 0.0, 0.0  # ∂f/∂μ, ∂J/∂μ
    for side in range(2):
        now, before = (x[LEFT], left_before) if side == 0 else (x[RIGHT], right_before)
        xi = (1 - mu) * now + mu * before
        size, alpha, beta, gamma = abs(xi), theta[3 + 3 * side], theta[4 + 3 * side], theta[5 + 3 * side]
        f += xi * (alpha + beta * size + gamma * speed + kappa[side] * xi * xi)
        J += gamma * xi * sign
        slope, bend = alpha + 2 * beta * size + gamma * speed + 3 * kappa[side] * xi * xi, gamma * sign
        if even:
            e = mean[E + 1 + 3 * side : E + 4 + 3 * side]
            f += e[0] * size + e[1] * xi * xi + e[2] * xi * w
            J += e[2] * xi
            slope += (e[0] if xi >= 0 else -e[0]) + 2 * e[1] * xi + e[2] * w
            bend += e[2]
        late += (before - now) * slope
        later += (before - now) * bend
    z = h * J
    z = 1.0 if z > 1 else z
    value, slope = phi1(z)
    by_f, by_J = h * value, h * h * slope * f
    g[W] = 1 + z * value + by_J * 2 * (theta[0] * sign + (mean[E] if even else 0.0))
    g[B], g[NORTH], g[EAST] = by_f, 0.0, 0.0
    g[THETA], g[THETA + 1] = by_f * speed * w + by_J * 2 * speed, by_f * w + by_J
    g[THETA + 2] = turn * (by_f * w + by_J)
    if even:
        g[E] = by_f * w * w + by_J * 2 * w
    for side in range(2):
        now, before = (x[LEFT], left_before) if side == 0 else (x[RIGHT], right_before)
        xi = (1 - mu) * now + mu * before
        size, k = abs(xi), THETA + 3 + 3 * side
        g[k], g[k + 1], g[k + 2] = by_f * xi, by_f * xi * size, xi * (by_f * speed + by_J * sign)
        g[KAPPA + side] = by_f * xi * xi * xi
        if even:
            k = E + 1 + 3 * side
            g[k], g[k + 1], g[k + 2] = by_f * size, by_f * xi * xi, xi * (by_f * w + by_J)
    g[-1] = by_f * late + by_J * later
    return w + by_f * f


@jit
def advance(node, s, q, x, mean, A, work):
    """The time update from what `forecast` left in `work`, where f and G stay; returns HᵀPH, and whether it rests."""
    n, numbers, h = node[Row.SIZE], q[node[Row.NUMBERS] :], x[DT]
    g, speed, current, noise = work[:n], work[n], work[n + 1], s[node[AT.noise]]
    if s[node[AT.started]] > 0:
        begin(mean, A, s[node[AT.surge]], noise, x, work[n + 2 :])
        s[node[AT.started]] = 0.0
    rest = x[LEFT] * x[LEFT] + x[RIGHT] * x[RIGHT] + mean[W] * mean[W] <= REST
    if rest:
        fill(g[THETA:], 0.0)
    slow = decay(h, numbers[Number.DISTURBANCE_TIME])
    transition(A, g, slow, current)
    add_current(A, numbers[Number.CURRENT] ** 2 * (1 - current * current))
    disturbance, drift_time, a = numbers[Number.DISTURBANCE], numbers[Number.DRIFT_TIME], work[n + 2 : 2 * n + 2]
    add_noise(node, s, A, q[node[Vector.VARIANCE] :], THETA, disturbance, drift_time, h, rest, a)
    limit(A, speed)
    move(mean, speed, slow, current)
    s[node[AT.commands]], s[node[AT.commands] + 1] = x[LEFT], x[RIGHT]
    spread = seen(A, x, work[:n], work[n : 2 * n])
    s[node[AT.deviation]] = np.sqrt(spread + noise)
    return spread, rest


@jit
def move(mean, speed, slow, current):
    """The states of (3), of which w⁺ is `speed`."""
    mean[B], mean[NORTH], mean[EAST] = mean[B] * slow, mean[NORTH] * current, mean[EAST] * current
    mean[W] = clamp(speed, MOST)


@jit
def begin(mean, A, surge, noise, x, work):
    """The start of a segment, with the heading of its first step."""
    n = len(mean)
    f, G, gain = work[:n], work[n : 2 * n], work[2 * n : 3 * n]
    isolate(A, SPEED_VARIANCE)
    add_current(A, CURRENT_VARIANCE)
    mean[W], mean[B] = surge - x[COS] * mean[NORTH] - x[SIN] * mean[EAST], 0.0
    seen(A, x, f, G)
    measure(A, f, G, noise, gain)


@jit
def project_signs(mean, A, even, t):
    """(7), and the limits of μ."""
    for i in range(THETA, THETA + 3):
        project(mean, A, i, i, 0.0, t)
    if even:
        for sign in (1.0, -1.0):
            project(mean, A, THETA, E, sign, t)
    limit_lag(mean)


@jit
def read(node, s, parameters):
    """One periodic estimate of the parameters."""
    m = len(parameters)
    reading, spread = s[node[AT.reading] : node[AT.reading] + m], s[node[AT.spread] : node[AT.spread] + m * m]
    s[node[AT.learned]] = 0.0
    s[node[AT.readings]] += 1
    if s[node[AT.readings]] <= DROPPED:
        return
    s[node[AT.weight]] = AGEING * s[node[AT.weight]] + 1
    share = 1 / s[node[AT.weight]]
    for i in range(m):
        for j in range(m):
            product = (parameters[i] - reading[i]) * (parameters[j] - reading[j])
            spread[i * m + j] = (1 - share) * (spread[i * m + j] + share * product)
    for i in range(m):
        reading[i] += share * (parameters[i] - reading[i])
