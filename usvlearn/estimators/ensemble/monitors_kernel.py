"""The monitors of an ensemble: `estimators.monitors.observe`, in place. Numbers in parentheses are equations there."""

import numpy as np

from usvlearn.arrays import clamp, fill
from usvlearn.family import FINITE, MOST, NOT_NEGATIVE, POSITIVE, UNIT, Field, Range
from usvlearn.jit import jit
from usvlearn.rows import DT, LEFT, RIGHT, YAW_RATE

MONITOR_NUMBERS = {
    "huber": POSITIVE, "huber_mean": POSITIVE, "huber_rate": UNIT, "least_scale": POSITIVE,
    "innovation_memory": Range(1.0, MOST),
    "yaw_memory": POSITIVE, "yaw_ridge": Range(1e-6, MOST), "yaw_floor": POSITIVE, "yaw_rate": UNIT, "knee": POSITIVE,
    "yaw_spread": NOT_NEGATIVE, "loss": NOT_NEGATIVE, "horizon": NOT_NEGATIVE, "misfit": NOT_NEGATIVE,
    "clip": POSITIVE, "effect": POSITIVE, "calm": POSITIVE, "threshold": POSITIVE, "backwards": FINITE,
    "doubt": POSITIVE, "cleared": UNIT,
}  # fmt: skip
HUBER, HUBER_MEAN, HUBER_RATE, LEAST_SCALE, INNOVATION_MEMORY = range(5)
YAW_MEMORY, YAW_RIDGE, YAW_FLOOR, YAW_SHARE, KNEE, YAW_SPREAD, LOSS, HORIZON = range(5, 13)
MISFIT, CLIP, EFFECT, CALM, THRESHOLD, BACKWARDS, DOUBT, CLEARED = range(13, 21)
FEATURES, THRUST, ROUNDING = 9, 3, 16
Z = FEATURES + 1


def monitor_fields(k):
    """The leaves of `MonitorState` for k columns."""
    innovations = {"moments": Field((k, 4)), "scale": Field((k,), POSITIVE), "last": Field((k,))}
    thrusters = {
        "moments": Field((Z, Z)), "variance": Field((), POSITIVE), "before": Field((2,)),
        "evidence": Field((2,), NOT_NEGATIVE), "sums": Field((2, 2)), "raised": Field((2,), UNIT),
        "alarms": Field((), NOT_NEGATIVE), "since": Field((), NOT_NEGATIVE),
    }  # fmt: skip
    parts = {"innovations": innovations, "thrusters": thrusters}
    return {f"{part}.{name}": each for part, fields in parts.items() for name, each in fields.items()}


@jit
def observe_innovations(s, innovation, k, q):
    """Whiteness: (1) and (2)."""
    moments, scales, last = s[: 4 * k].reshape(k, 4), s[4 * k : 5 * k], s[5 * k : 6 * k]
    share, huber = 1 / q[INNOVATION_MEMORY], q[HUBER] * q[HUBER]
    for i in range(k):
        e = innovation[i]
        if not np.isfinite(e):
            continue
        scale = scales[i]
        clipped = clamp(e, 3 * np.sqrt(scale))
        squared = min(e * e, huber * scale)
        scales[i] = max(scale + q[HUBER_RATE] * (squared / q[HUBER_MEAN] - scale), q[LEAST_SCALE])  # (2)
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
def observe_thrusters(s, inputs, q, work):
    """The evidence against each thruster: (3) to (6)."""
    moments, rest = s[: Z * Z].reshape(Z, Z), s[Z * Z :]
    variance, before, evidence, sums, raised = rest[0], rest[1:3], rest[3:5], rest[5:9], rest[9:11]
    z, theta, solved = work[:Z], work[Z : 2 * Z], work[2 * Z : 3 * Z]
    L = work[3 * Z : 3 * Z + FEATURES * FEATURES].reshape(FEATURES, FEATURES)
    rate, left, right = inputs[YAW_RATE], inputs[LEFT], inputs[RIGHT]
    z[0], z[1], z[2], z[3], z[4], z[5] = rate, 1.0, before[0], before[1], left, right
    z[6], z[7] = left * abs(left), right * abs(right)
    z[8], z[9] = z[6] * abs(left), z[7] * abs(right)
    x = z[1:]
    solve_model(moments, q[YAW_RIDGE], L, x, theta, solved)
    predicted, leverage = 0.0, 0.0
    for i in range(FEATURES):
        predicted += x[i] * theta[i]
        leverage += x[i] * solved[i]
    full_left = theta[3] + theta[5] + theta[7]  # F
    full_right = theta[4] + theta[6] + theta[8]
    e = rate - predicted
    misfit = 0.5 * q[MISFIT] ** 2 * (full_left * full_left + full_right * full_right)
    precision = 1.0 / np.sqrt(misfit + (1 + q[HORIZON] * leverage) * variance)  # 1/σ of (5)
    calm = np.exp(-max(evidence[0], evidence[1]) / q[CALM])
    alarm = 0.0
    for side in range(2):
        f = x[3 + side] * theta[3 + side] + x[5 + side] * theta[5 + side] + x[7 + side] * theta[7 + side]
        effect = clamp(f * precision, q[EFFECT])
        moment, weight = effect * clamp(e * precision, q[CLIP]), effect * effect
        g = evidence[side] - q[LOSS] * moment - 0.5 * q[LOSS] ** 2 * weight  # (5)
        g = min(max(g, 0.0), 2 * q[THRESHOLD])
        if g > 0:
            sums[2 * side] += moment
            sums[2 * side + 1] += weight
        if not g > 0 or not 1 + sums[2 * side] / (sums[2 * side + 1] + q[DOUBT]) > q[BACKWARDS]:
            g = sums[2 * side] = sums[2 * side + 1] = 0.0
        evidence[side] = g
        above = g + (1 - q[CLEARED]) * q[THRESHOLD] * raised[side] - q[THRESHOLD]
        on = 1.0 if above > 0 else 0.0
        alarm = max(alarm, on - raised[side])
        raised[side] = on
    square = e * e
    light = variance / (variance + square / (q[KNEE] * q[KNEE]))
    weight = calm * np.sqrt(light)
    size = abs(left) + abs(right)
    keep = np.exp(-min(size, 1.0) * inputs[DT] / q[YAW_MEMORY])  # only thrust makes it forget
    for i in range(Z):
        for j in range(Z):
            moments[i, j] = keep * moments[i, j] + weight * z[i] * z[j]
    moved = variance + calm * q[YAW_SHARE] * (square * light * q[YAW_SPREAD] - variance)
    rest[0] = max(moved, q[YAW_FLOOR])
    before[1], before[0] = before[0], rate
    rest[11] += alarm
    rest[12] = (rest[12] + inputs[DT]) * (1 - alarm)
