"""The monitors of an ensemble: `layer.observe`, in place. Numbers in parentheses are equations of `state`."""

import numpy as np

from usvlearn.core.arrays import clamp, fill
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import COS, DT, LEFT, RIGHT, SIN, SURGE, YAW_RATE
from usvlearn.estimators.ensemble.monitors.state import (
    APART,
    AT,
    BLOCK,
    CELLS,
    LAGGED,
    LAST,
    LEVEL,
    LEVELS,
    MARGIN,
    NINETY,
    RAISED,
    REMEMBERED,
    ROUNDING,
    SIGNIFICANT,
    SLOW,
    SLOWLY,
    SQUARE,
    SURGES,
    THRUST,
    VARIANCE,
    YAW,
    Number,
)


@jit
def observe_innovations(node, s, q, innovation):
    """Whiteness: (1) and (2)."""
    k, q, at = node[Row.SIZE], q[node[Row.NUMBERS] :], AT.innovations
    moments = s[node[at.moments] : node[at.moments] + 4 * k].reshape(k, 4)
    scales, last = s[node[at.scale] : node[at.scale] + k], s[node[at.last] : node[at.last] + k]
    share, huber = 1 / q[Number.INNOVATION_MEMORY], q[Number.HUBER] * q[Number.HUBER]
    for i in range(k):
        e = innovation[i]
        if not np.isfinite(e):
            continue
        scale = scales[i]
        clipped = clamp(e, 3 * np.sqrt(scale))
        squared = min(e * e, huber * scale)
        scales[i] = max(
            scale + q[Number.HUBER_RATE] * (squared / q[Number.HUBER_MEAN] - scale), q[Number.LEAST_SCALE]
        )  # (2)
        row = moments[i]
        row[0] += share * (1.0 - row[0])
        row[1] += share * (clipped - row[1])
        row[2] += share * (clipped * clipped - row[2])
        row[3] += share * (clipped * last[i] - row[3])
        last[i] = clipped


@jit
def solve_model(moments, ridge, L, x, theta, solved):
    """ϑ of (4) into `theta`, (Σ w x xᵀ + R)⁻¹ x into `solved`, by Cholesky; the diagonal holds its inverse."""
    n, share = len(x), ROUNDING * np.finfo(moments.dtype).eps * moments[1, 1]
    for i in range(n):
        for j in range(i + 1):
            total = moments[i + 1, j + 1]
            if i == j:
                total += max(ridge, share * total)  # (7)
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j and not total > 0:
                fill(theta, 0.0)
                fill(solved, 0.0)
                return
            L[i, j] = 1.0 / np.sqrt(total) if i == j else total * L[j, j]
    for i in range(n):
        one, other = moments[i + 1, 0], x[i]
        for k in range(i):
            one -= L[i, k] * theta[k]
            other -= L[i, k] * solved[k]
        theta[i], solved[i] = one * L[i, i], other * L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            theta[i] -= L[k, i] * theta[k]
            solved[i] -= L[k, i] * solved[k]
        theta[i] *= L[i, i]
        solved[i] *= L[i, i]


@jit
def judge(moments, errors, q, z, full, effects, work):
    """Error of z[0] by (3) and (4), and what each side and both have made of it, into `effects`.

    Also: 1/σ of (5), the share of the errors' information that their colour leaves, and the slow error of (8).
    """
    n, x = len(z) - 1, z[1:]
    theta, solved, L = work[:n], work[n : 2 * n], work[2 * n : 2 * n + n * n].reshape(n, n)
    solve_model(moments, q[Number.YAW_RIDGE], L, x, theta, solved)
    e, leverage, misfit = z[0], 0.0, 0.0
    for i in range(n):
        e -= x[i] * theta[i]
        leverage += x[i] * solved[i]
    for side in range(2):
        k = THRUST + side
        effects[side] = x[k] * theta[k] + x[k + 2] * theta[k + 2] + x[k + 4] * theta[k + 4]
        misfit += abs(effects[side] * (theta[k] + theta[k + 2] + theta[k + 4] * full))  # times F
    effects[2] = effects[0] + effects[1]
    variance = errors[VARIANCE]
    precision = 1 / np.sqrt(0.5 * q[Number.MISFIT] ** 2 * misfit + (1 + q[Number.HORIZON] * leverage) * variance)
    colour = clamp(errors[LAGGED] / errors[SQUARE], 0.95) if errors[LAGGED] > 0 else 0.0
    slow = np.sqrt(q[Number.SLOWNESS] ** 2 * errors[LEVELS] + q[Number.UNSURE] * leverage * variance)
    return e, precision, (1 - colour) / (1 + colour), slow


@jit
def learn_model(moments, errors, q, z, e, floor, calm, keep, seconds):
    """The sums of (4), and the statistics of its errors; z lasted some seconds."""
    variance, square = errors[VARIANCE], e * e
    light = variance / (variance + square / (q[Number.KNEE] * q[Number.KNEE]))
    weight, share = calm * np.sqrt(light), min(calm * seconds / SLOWLY, 1.0)
    for i in range(len(z)):
        for j in range(len(z)):
            moments[i, j] = keep * moments[i, j] + weight * z[i] * z[j]
    moved = variance + calm * q[Number.YAW_RATE] * (square * light * q[Number.YAW_SPREAD] - variance)
    errors[VARIANCE] = max(moved, floor)
    e = clamp(e, 3 * np.sqrt(errors[VARIANCE]))
    errors[SQUARE] += share * (e * e - errors[SQUARE])
    errors[LAGGED] += share * (e * errors[LAST] - errors[LAGGED])
    errors[LAST] = e
    errors[LEVEL] += min(calm * seconds / SLOW, 1.0) * (e - errors[LEVEL])
    errors[LEVELS] += share * (errors[LEVEL] * errors[LEVEL] - errors[LEVELS])
    return square * light


@jit
def gather(sums, q, k, effect, e, precision, colour, slow, loss, g):
    """One sample of (5), (6) and (8) for a hypothesis: of the yaw rate (k = 0) or the surge (1). Returns g."""
    f = clamp(effect * precision, q[Number.EFFECT])
    moment, weight = colour * f * clamp(e * precision, q[Number.CLIP]), colour * f * f
    g = min(max(g - loss * moment - 0.5 * loss * loss * weight, 0.0), 2 * q[Number.THRESHOLD])
    old = min(REMEMBERED / (sums[1] + weight), 1.0) if weight > 0 else 1.0
    for i in range(4):
        sums[i] *= old
    sums[0] += moment
    sums[1] += weight
    sums[2 + k] += colour * f * precision * slow
    if not g > 0 or not 1 + sums[0] / (sums[1] + q[Number.DOUBT]) > q[Number.BACKWARDS]:
        fill(sums, 0.0)
        g = 0.0
    return g


@jit
def observe_thrusters(node, s, q, inputs, work):
    """The evidence against each thruster, and against both: (3) to (8)."""
    q, at, n = q[node[Row.NUMBERS] :], AT.thrusters, 1 + SURGES
    yaws = s[node[at.moments] : node[at.moments] + (1 + YAW) * (1 + YAW)].reshape(1 + YAW, 1 + YAW)
    surges = s[node[at.surges] : node[at.surges] + n * n].reshape(n, n)
    errors, before = s[node[at.errors] : node[at.errors] + 12].reshape(2, 6), s[node[at.before] : node[at.before] + 4]
    block, explained = s[node[at.block] : node[at.block] + SURGES - 2], s[node[at.explained] :]
    evidence, sums = s[node[at.evidence] : node[at.evidence] + 3], s[node[at.sums] : node[at.sums] + 12].reshape(3, 4)
    z, x, effects, rest = work[: 1 + YAW], work[1 + YAW : 1 + YAW + n], work[2 * n : 2 * n + 3], work[2 * n + 3 :]
    dt, rate, left, right, speed = inputs[DT], inputs[YAW_RATE], inputs[LEFT], inputs[RIGHT], before[2]
    calm = np.exp(-max(max(evidence[0], evidence[1]), evidence[2]) / q[Number.CALM])
    place = node[at.known] + CELLS * cell(left) + cell(right)
    inside, loss = s[place] >= q[Number.LEARNED], q[Number.LOSS]
    keep = np.exp(-min(abs(left) + abs(right), 1.0) * dt / q[Number.YAW_MEMORY])  # only thrust makes it forget
    z[0], z[1], z[2], z[3], z[4], z[5] = rate, 1.0, before[0], before[1], left, right
    z[6], z[7], z[8], z[9] = left * abs(left), right * abs(right), left * speed, right * speed
    z[10] = before[0] * speed
    e, precision, colour, slow = judge(yaws, errors[0], q, z, speed, effects, rest)
    power = yaws[4, 4] + yaws[5, 5]
    tells = power - 2 * yaws[4, 5] > APART * power and explained[0] < (1 - q[Number.EXPLAINED]) * explained[1]
    if inside and tells:
        for side in range(2):
            evidence[side] = gather(sums[side], q, 0, effects[side], e, precision, colour, slow, loss, evidence[side])
    made = (e + effects[2]) * (e + effects[2])
    square = learn_model(yaws, errors[0], q, z, e, q[Number.YAW_FLOOR], calm, keep, dt)
    share = min(calm * dt / SLOWLY, 1.0)
    explained[0] += share * (square - explained[0])
    explained[1] += share * (made - explained[1])
    block[0] += dt
    turned = inputs[SIN] * inputs[SIN] + inputs[COS] * inputs[COS] < 1.01  # else sine and cosine are not computed
    block[1], block[2] = block[1] + dt * left, block[2] + dt * right
    block[3], block[4] = block[3] + dt * left * abs(left), block[4] + dt * right * abs(right)
    block[5], block[6] = block[5] + dt * left * left, block[6] + dt * right * right
    block[7] += dt * abs(rate)
    if turned:
        block[8], block[9] = block[8] + dt * inputs[COS], block[9] + dt * inputs[SIN]
    if block[0] >= BLOCK - 1e-3:
        x[0], x[1], x[2], x[3] = inputs[SURGE], 1.0, before[3], before[3] * abs(before[3])
        for i in range(1, SURGES - 2):
            x[3 + i] = block[i] / block[0]
        x[10] *= before[3]
        e, precision, colour, slow = judge(surges, errors[1], q, x, 1.0, effects, rest)
        for k in range(3 if inside else 0):
            evidence[k] = gather(sums[k], q, 1, effects[k], e, precision, colour, slow, loss, evidence[k])
        keep = np.exp(-min(abs(x[4]) + abs(x[5]), 1.0) * block[0] / q[Number.YAW_MEMORY])
        learn_model(surges, errors[1], q, x, e, q[Number.SURGE_FLOOR], calm, keep, block[0])
        fill(block, 0.0)
        before[3] = inputs[SURGE]
    s[place] += calm * dt
    before[1], before[0], before[2] = before[0], rate, inputs[SURGE]
    alarm = decide(node, s, q, evidence, sums, dt)
    s[node[at.alarms]] += alarm
    s[node[at.since]] = (s[node[at.since]] + dt) * (1 - alarm)


@jit
def cell(command):
    """The part of −1 … 1 in which a command lies."""
    return min(max(int((command + 1) * CELLS / 2), 0), CELLS - 1)


@jit
def effectiveness(q, sums):
    """(6) and (8) of a hypothesis."""
    weight = sums[1] + q[Number.DOUBT]
    return 1 + sums[0] / weight, np.sqrt(1 / weight + (sums[2] * sums[2] + sums[3] * sums[3]) / (weight * weight))


@jit
def decide(node, s, q, evidence, sums, dt):
    """Which alarms are on, and the effectiveness of the sides; returns 1 where one begins, else 0."""
    at = AT.thrusters
    raised, share, deviation = s[node[at.raised] :], s[node[at.share] :], s[node[at.deviation] :]
    on, lost, first = raised[0] > 0 or raised[1] > 0, False, 0.0
    for k in range(3):
        value, spread = effectiveness(q, sums[k])
        least = (q[Number.BOTH] if k == 2 else q[Number.THRESHOLD]) * (q[Number.CLEARED] if on else 1.0)
        lost = lost or (evidence[k] > least and value + (NINETY if on else RAISED) * spread < 1)
    s[node[at.held]] = s[node[at.held]] + dt if lost else 0.0
    if not lost:
        raised[0] = raised[1] = 0.0
    elif on or s[node[at.held]] >= q[Number.HOLD]:
        first = 0.0 if on else 1.0
        worst = 0 if evidence[0] > evidence[1] else 1
        if evidence[worst] > max(evidence[1 - worst], evidence[2]) + MARGIN:
            raised[worst], raised[1 - worst] = 1.0, 0.0
        elif not on:
            raised[0] = raised[1] = 1.0
    both = raised[0] > 0 and raised[1] > 0
    for side in range(2):
        k = 2 if both else side
        value, deviation[side] = effectiveness(q, sums[k])
        share[side] = value if raised[side] > 0 or evidence[k] > SIGNIFICANT else 1.0
    return first
