"""The monitors of an ensemble: `layer.observe`, in place. Numbers in parentheses are equations of `state`."""

import numpy as np

from usvlearn.core.arrays import clamp, dot, fill
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import DT, LEFT, RIGHT, YAW_RATE
from usvlearn.estimators.ensemble.monitors.state import (
    APART,
    AT,
    DOUBTFUL,
    FEATURES,
    ROUNDING,
    SIGNIFICANT,
    THRUST,
    Number,
    Z,
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
    n, share = FEATURES, ROUNDING * np.finfo(moments.dtype).eps * moments[1, 1]
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
def observe_thrusters(node, s, q, inputs, work):
    """The evidence against each thruster: (3) to (6)."""
    q, at = q[node[Row.NUMBERS] :], AT.thrusters
    moments = s[node[at.moments] : node[at.moments] + Z * Z].reshape(Z, Z)
    before = s[node[at.before] : node[at.before] + 2]
    variance, evidence = s[node[at.variance]], s[node[at.evidence] : node[at.evidence] + 2]
    sums, raised = s[node[at.sums] : node[at.sums] + 4], s[node[at.raised] : node[at.raised] + 2]
    z, theta, solved = work[:Z], work[Z : 2 * Z], work[2 * Z : 3 * Z]
    L = work[3 * Z : 3 * Z + FEATURES * FEATURES].reshape(FEATURES, FEATURES)
    rate, left, right = inputs[YAW_RATE], inputs[LEFT], inputs[RIGHT]
    z[0], z[1], z[2], z[3], z[4], z[5] = rate, 1.0, before[0], before[1], left, right
    z[6], z[7] = left * abs(left), right * abs(right)
    z[8], z[9] = z[6] * abs(left), z[7] * abs(right)
    x = z[1:]
    solve_model(moments, q[Number.YAW_RIDGE], L, x, theta, solved)
    predicted, leverage = 0.0, 0.0
    for i in range(FEATURES):
        predicted += x[i] * theta[i]
        leverage += x[i] * solved[i]
    full_left = theta[3] + theta[5] + theta[7]  # F
    full_right = theta[4] + theta[6] + theta[8]
    e = rate - predicted
    misfit = 0.5 * q[Number.MISFIT] ** 2 * (full_left * full_left + full_right * full_right)
    precision = 1.0 / np.sqrt(misfit + (1 + q[Number.HORIZON] * leverage) * variance)  # 1/σ of (5)
    calm = np.exp(-max(evidence[0], evidence[1]) / q[Number.CALM])
    alarm = 0.0
    power = moments[4, 4] + moments[5, 5]
    apart = power - 2 * moments[4, 5] > APART * power
    for side in range(2):
        f = x[3 + side] * theta[3 + side] + x[5 + side] * theta[5 + side] + x[7 + side] * theta[7 + side]
        effect = clamp(f * precision, q[Number.EFFECT]) if apart else 0.0
        moment, weight = effect * clamp(e * precision, q[Number.CLIP]), effect * effect
        g = evidence[side] - q[Number.LOSS] * moment - 0.5 * q[Number.LOSS] ** 2 * weight  # (5)
        g = min(max(g, 0.0), 2 * q[Number.THRESHOLD])
        if g > 0:
            sums[2 * side] += moment
            sums[2 * side + 1] += weight
        if not g > 0 or not 1 + sums[2 * side] / (sums[2 * side + 1] + q[Number.DOUBT]) > q[Number.BACKWARDS]:
            g = sums[2 * side] = sums[2 * side + 1] = 0.0
        evidence[side] = g
        above = g + (1 - q[Number.CLEARED]) * q[Number.THRESHOLD] * raised[side] - q[Number.THRESHOLD]
        on = 1.0 if above > 0 else 0.0
        alarm = max(alarm, on - raised[side])
        raised[side] = on
    square = e * e
    light = variance / (variance + square / (q[Number.KNEE] * q[Number.KNEE]))
    weight = calm * np.sqrt(light)
    size = abs(left) + abs(right)
    keep = np.exp(-min(size, 1.0) * inputs[DT] / q[Number.YAW_MEMORY])  # only thrust makes it forget
    for i in range(Z):
        for j in range(Z):
            moments[i, j] = keep * moments[i, j] + weight * z[i] * z[j]
    moved = variance + calm * q[Number.YAW_RATE] * (square * light * q[Number.YAW_SPREAD] - variance)
    s[node[at.variance]] = max(moved, q[Number.YAW_FLOOR])
    before[1], before[0] = before[0], rate
    s[node[at.alarms]] += alarm
    s[node[at.since]] = (s[node[at.since]] + inputs[DT]) * (1 - alarm)


@jit
def effectiveness(node, s, q, side, work):
    """`layer.effectiveness` of a side: (6)."""
    q, at = q[node[Row.NUMBERS] :], AT.thrusters
    moments, sums = s[node[at.moments] : node[at.moments] + Z * Z].reshape(Z, Z), s[node[at.sums] + 2 * side :]
    theta, solved, full = work[:FEATURES], work[Z : Z + FEATURES], work[2 * Z : 2 * Z + FEATURES]
    L = work[3 * Z : 3 * Z + FEATURES * FEATURES].reshape(FEATURES, FEATURES)
    fill(full, 0.0)
    for i in range(THRUST + side, FEATURES, 2):
        full[i] = 1.0
    weight = sums[1] + q[Number.DOUBT]
    doubted = s[node[at.evidence] + side] > SIGNIFICANT or s[node[at.raised] + side] > 0
    lost = -sums[0] / weight if doubted else 0.0
    solve_model(moments, q[Number.YAW_RIDGE], L, full, theta, solved)
    effect, square = dot(full, theta), s[node[at.variance]] * dot(full, solved)
    doubtful = lost * lost * DOUBTFUL * DOUBTFUL * square / max(effect * effect, np.finfo(moments.dtype).tiny)
    return 1 - lost, np.sqrt(1 / weight + (doubtful if lost != 0 else 0.0))
