"""The ARX filter: the step of `layer`, equations (1) to (7) of `state`."""

import numpy as np

from usvlearn.arrays import clamp, copy, dot, fill
from usvlearn.estimators.arx.state import (
    AT,
    COMMANDS,
    EVEN_SQUARE,
    LONGEST,
    LOOSEST,
    NOISE_LEAST,
    NOISE_SHARE,
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
from usvlearn.family import Node
from usvlearn.jit import jit
from usvlearn.rows import DT, LEFT, RIGHT, YAW_RATE

GROUP = len(COMMANDS)


@jit
def start(node, s, q, surge):
    """`ARX.start`."""
    s[node[AT.surge]] = surge
    s[node[AT.started]] = 1.0
    fill(s[node[AT.past] : node[AT.past] + node[Node.SIZE]], 0.0)


@jit
def predict(node, s, q, x, work):
    """`ARX.predict`: the speed, and what it was before its limits; f stays in `work`."""
    p, surge, limit = node[Node.SIZE], s[node[AT.surge]], q[node[Node.NUMBERS] :][Number.SURGE_MAX]
    f = work[:p]
    features(node, s, x, clamp(surge, limit), f)
    estimate = surge + steps(x) * dot(f, s[node[AT.theta] : node[AT.theta] + p])
    return clamp(estimate, limit), estimate


@jit
def coast(node, s, q, x, predicted, work):
    """The state after `ARX.predict`: the deviation of its prediction, and its increment."""
    p = node[Node.SIZE]
    phi, g, h = work[p : 2 * p], work[2 * p : 3 * p], steps(x)
    for i in range(p):
        phi[i] = h * work[i]
    A = s[node[AT.factor] : node[AT.factor] + p * p].reshape(p, p)
    rotated(A, phi, g)
    s[node[AT.deviation]] = np.sqrt(s[node[AT.noise]] * (1.0 + variance(A, g)))
    remember(node, s, q, h, predicted, work)


@jit
def learn(node, s, q, x, estimate, target, work):
    """The state after `ARX.learn`."""
    p, numbers, prior = node[Node.SIZE], q[node[Node.NUMBERS] :], q[node[Vector.PRIOR] :]
    phi, g, b, h = work[p : 2 * p], work[2 * p : 3 * p], work[3 * p : 4 * p], steps(x)
    theta, A = s[node[AT.theta] : node[AT.theta] + p], s[node[AT.factor] : node[AT.factor] + p * p].reshape(p, p)
    for i in range(p):
        phi[i] = h * work[i]
    rotated(A, phi, g)
    S, noise, error, tails = 1.0 + variance(A, g), s[node[AT.noise]], target - estimate, numbers[Number.TAILS]
    s[node[AT.deviation]] = np.sqrt(noise * S)
    s[node[AT.rest]] = s[node[AT.rest]] + x[DT] if resting(x, work) else 0.0
    if s[node[AT.rest]] <= REST_TIME:
        seen = error * error / S
        weight = (1.0 + tails) / (1.0 + tails * seen / noise)
        gain = error / measurement(A, g, 1.0 / weight, b)
        for i in range(p):
            theta[i] += gain * b[i]
        if node[Choice.PROJECT] > 0:
            even, share = SQUARE, 0.0
            if node[Choice.EVEN] > 0:
                even, share = RATES + node[Choice.LAGS] + GROUP * (node[Choice.LAGS] + 1) + EVEN_SQUARE, 1.0
            slow(theta, A, SPEED, SPEED, 0.0, b)
            slow(theta, A, SQUARE, even, share, b)
            slow(theta, A, SQUARE, even, -share, b)
        turn = s[node[AT.turn]]
        k = int(turn) if 0 <= turn < p else 0  # a member that diverged may hold any number
        add(A, k, walked(A, k, prior[k], h * numbers[Number.WALK]), b)
        learned = noise + NOISE_SHARE * (weight * seen - noise)
        s[node[AT.turn]] = k + 1 if k + 1 < p else 0
        s[node[AT.noise]] = NOISE_LEAST**2 if learned < NOISE_LEAST**2 else learned
    remember(node, s, q, h, target, work)


@jit
def inflate_covariance(node, s, q, factor):
    """`ARX.inflate_covariance`: P times `factor`, up to its limit."""
    p, prior = node[Node.SIZE], q[node[Vector.PRIOR] :]
    A = s[node[AT.factor] : node[AT.factor] + p * p].reshape(p, p)
    first, trace = 0.0, 0.0
    for j in range(p):
        first += prior[j]
        trace += A[j, j] * (1.0 + (dot(A[j, :j], A[j, :j]) if j > 0 else 0.0))
    limit = LOOSEST * first / trace
    limit = 1.0 if limit < 1.0 else limit
    for j in range(p):
        A[j, j] *= limit if factor > limit else factor


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
    p, lags, limit = node[Node.SIZE], node[Choice.LAGS], q[node[Node.NUMBERS] :][Number.SURGE_MAX]
    past = s[node[AT.past] : node[AT.past] + p]
    copy(past, work[:p])
    if lags > 0:
        for i in range(RATES + 1, RATES + lags):
            past[i] = work[i - 1]
        past[RATES] = clamp((surge - s[node[AT.surge]]) / h, limit)
    s[node[AT.surge]] = surge
    s[node[AT.started]] = 0.0


@jit(reorder=True)
def rotated(A, phi, g):
    """g = Uᵀφ."""
    for j in range(len(phi)):
        total = phi[j]
        for i in range(j):
            total += A[j, i] * phi[i]
        g[j] = total


@jit
def variance(A, g):
    """φᵀPφ = gᵀDg."""
    total = 0.0
    for j in range(len(g)):
        total += A[j, j] * (g[j] * g[j])
    return total


@jit
def measurement(A, g, alpha, b):
    """P after a measurement, (5), with α_0 = `alpha`; b = Pφ of the P before; returns α_p."""
    for j in range(len(g)):
        d = A[j, j]
        G, share = d * g[j], -g[j] / alpha
        after = alpha + g[j] * G
        for i in range(j):
            u = A[j, i]
            A[j, i] = u + b[i] * share
            b[i] += u * G
        b[j] = G
        A[j, j] = d * (alpha / after)
        alpha = after
    return alpha


@jit
def slow(theta, A, i, j, share, b):
    """(7) of θ_i + share θ_j, i <= j."""
    value = theta[i] + share * theta[j]
    if not value > 0:
        return
    p, size = len(theta), 0.0
    fill(b, 0.0)
    for m in range(i, p):
        g = 1.0 if m == i else A[m, i]
        if m >= j:
            g += share * (1.0 if m == j else A[m, j])
        G = A[m, m] * g
        size += G * g
        for k in range(m):
            b[k] += A[m, k] * G
        b[m] += G
    for k in range(p):
        theta[k] -= b[k] * (value / size)


@jit
def walked(A, k, prior, share):
    """By how much P_kk grows, (4)."""
    p, own = len(A), A[k, k]
    for j in range(k + 1, p):
        own += A[j, j] * (A[j, k] * A[j, k])
    room = prior - own
    return min(p * share * prior, room) if room > 0 else 0.0


@jit
def add(A, k, q, a):
    """P_kk grows by q, (6)."""
    fill(a[:k], 0.0)
    a[k] = 1.0
    c = q
    for j in range(k, -1, -1):
        d = A[j, j]
        n = d + c * (a[j] * a[j])
        kept, share, own = d / n, c * a[j] / n, a[j]
        for i in range(j):
            u = A[j, i]
            A[j, i] = u * kept + share * a[i]
            a[i] -= own * u
        c *= kept
        A[j, j] = n
