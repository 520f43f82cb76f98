"""The yaw rate by the headings themselves: a Kalman filter, with the exact derivatives of its loss.

Equations (1) and (2): `docs/theory/identification.md#batch-fit-turning`. The parameters k₁, k₂, k_u, k_δ, b, d₀ … d₂,
τ_ξ, ξ₀ and ρ there are K1, K2, LOSS, RUDDER, BIAS, D0 … D2, LATE, DEAD and SIDE; τ_T is LAG, the factor astern ASTERN,
and H is Φ. PROCESS, COMPASS and GYRO are variances, OFFSET is that of a gyro, ZERO of the commands. Steps are
exponential.
"""

import numpy as np

from usvlearn.core.arrays import fill
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import DT, LEFT, MODE, PREDICT, RIGHT, ROW, SURGE

K1, K2, LOSS, RUDDER, BIAS, D0, D1, D2, LAG, LATE, DEAD, ASTERN, SIDE, PROCESS, COMPASS, GYRO, OFFSET, ZERO = range(18)
HEADING, RATE = ROW, ROW + 1  # places that follow those of a prepared sample: measured at the end of its step
PARAMETERS, ROBUST, UNKNOWN_RATE = 18, 4.0, 0.1  # count; deviations of z; (rad/s)² of a rate at the beginning


@jit
def thrust(p, xi, speed, slope):
    """τ of (1) and its derivative to ξ; writes those to the parameters."""
    size, alive = abs(xi), 1 - p[DEAD]
    fill(slope, 0.0)
    if not size > p[DEAD]:
        return 0.0, 0.0
    way, c, line = 1.0 if xi > 0 else -p[ASTERN], (size - p[DEAD]) / alive, p[K1] + p[LOSS] * speed
    steep, curve = (line + 2 * p[K2] * c) / alive, (line + p[K2] * c) * c
    slope[K1], slope[K2], slope[LOSS] = way * c, way * c * c, way * speed * c
    slope[DEAD], slope[ASTERN] = -way * steep * (1 - size) / alive, 0.0 if xi > 0 else -curve
    return way * curve, abs(way) * steep


@jit
def late(rows, k, place, by):
    """A command `by` seconds before that of step k, linear between steps, and its derivative to `by`."""
    h = rows[k, DT]
    at = min(max(k - by / h, 0.0), len(rows) - 1.0)
    below = min(int(at), len(rows) - 2)
    first, second = rows[below, place], rows[below + 1, place]
    return first + (at - below) * (second - first), (first - second) / h


@jit
def measured(x, X, P, D, i, z, noise, place, score, information, dz, dS):
    """L of one error z of ψ (i = 0) or r (i = 1), after which x = (ψ, r) and P = (P_ψψ, P_ψr, P_rr), with their
    derivatives X and D, are updated. `place` is that of the variance `noise`; dz and dS are memory.
    """
    a, b, m = 2 * i, 2 - 2 * i, len(dz)  # places in P of what is measured and of the other
    S, own, cross = P[a] + noise, P[a], P[1]
    size = abs(z) / np.sqrt(S)
    weight = 1.0 if size <= ROBUST else ROBUST / size
    gain, aside, error = own / S, cross / S, weight * z
    for j in range(m):
        dz[j], dS[j] = -X[i, j], D[a, j]
    dS[place] += 1.0
    dz[OFFSET] -= i
    for j in range(m):
        score[j] += error * dz[j] / S + 0.5 * (1 - weight * size * size) * dS[j] / S
        by_z, by_S = weight * dz[j] / S, 0.5 * dS[j] / (S * S)
        for k in range(j + 1):
            information[j, k] += by_z * dz[k] + by_S * dS[k]
    for j in range(m):
        moved = dz[j] if weight == 1.0 else 0.5 * error * dS[j] / S
        by_own, by_cross = (D[a, j] - gain * dS[j]) / S, (D[1, j] - aside * dS[j]) / S
        X[i, j] += by_own * error + gain * moved
        X[1 - i, j] += by_cross * error + aside * moved
        D[b, j] -= by_cross * cross + aside * D[1, j]
        D[1, j] -= by_own * cross + gain * D[1, j]
        D[a, j] -= by_own * own + gain * D[a, j]
    x[i], x[1 - i] = x[i] + gain * error, x[1 - i] + aside * error
    P[a], P[1], P[b] = own - gain * own, cross - gain * cross, P[b] - aside * cross
    return 0.5 * (np.log(S) + (size * size if weight == 1.0 else (2 * size - ROBUST) * ROBUST))


@jit(entry=True)
def turned(rows, p, score, information, rates, work):
    """L of (2), of a log or a part of one.

    `rows` are prepared samples, the speed as a share of the top speed, with heading and yaw rate of a gyro behind. The
    gradient of L, `(m,)`, and the lower half of H are added to. Predicted yaw rates and their variances, `(time, 2)`,
    NaN without step, are written. `work` is memory, `(12, m)`.
    """
    X, D, F, x, P, f = work[:2], work[2:5], work[5:7], work[7, :2], work[7, 2:5], work[7, 5:7]
    slope, dz, dJ, df, m = work[8], work[9], work[10], work[11], PARAMETERS
    known, loss = False, 0.0
    for k in range(len(rows)):
        row = rows[k]
        if not (known and row[MODE] >= PREDICT):
            known = row[HEADING] == row[HEADING]
            for i in range(8):
                fill(work[i], 0.0)
            x[0], P[0], P[2], D[0, COMPASS] = row[HEADING], p[COMPASS], UNKNOWN_RATE, 1.0
            rates[k, 0] = rates[k, 1] = np.nan
            continue
        step, speed, r = row[DT], abs(row[SURGE]), x[1]
        left, left_shift = late(rows, k, LEFT, p[LATE])
        right, right_shift = late(rows, k, RIGHT, p[LATE])
        decay = np.exp(-step / p[LAG])
        for i in range(2):
            tau, steep = thrust(p, left - p[ZERO] if i == 0 else right + p[ZERO], speed, slope)
            slope[LATE] = steep * (left_shift if i == 0 else right_shift)
            slope[ZERO] = -steep if i == 0 else steep
            for j in range(m):
                F[i, j] = decay * F[i, j] + (1 - decay) * slope[j]
            F[i, LAG] -= (tau - f[i]) * decay * step / (p[LAG] * p[LAG])
            f[i] += (1 - decay) * (tau - f[i])
        apart, push, size = left - right - 2 * p[ZERO], row[SURGE] * speed, abs(r)
        J = p[D0] + 2 * p[D1] * size + p[D2] * speed  # minus that of the exponential step
        A = np.exp(-J * step)
        g, half = (1 - A) / J, step * (1 + A) / 2
        bend = (step * A - g) / J
        force = f[0] - p[SIDE] * f[1] + p[RUDDER] * push * apart + p[BIAS] - (J - p[D1] * size) * r
        for j in range(m):
            df[j], dJ[j] = F[0, j] - p[SIDE] * F[1, j] - J * X[1, j], 2 * p[D1] * np.sign(r) * X[1, j]
        df[SIDE] -= f[1]
        df[RUDDER] += push * apart
        df[LATE] += p[RUDDER] * push * (left_shift - right_shift)
        df[ZERO] -= 2 * p[RUDDER] * push
        df[BIAS] += 1.0
        for place, by in ((D0, 1.0), (D1, size), (D2, speed)):
            df[place] -= by * r
            dJ[place] += 2 * by if place == D1 else by
        for j in range(m):
            new, dA, d1, d2 = X[1, j] + g * df[j] + force * bend * dJ[j], -step * A * dJ[j], D[1, j], D[2, j]
            X[0, j], X[1, j] = X[0, j] + step * (X[1, j] + new) / 2, new
            D[0, j] += (step * dA) * (P[1] + half * P[2]) + half * (2 * d1 + half * d2)
            D[1, j] = dA * (P[1] + half * P[2]) + A * (d1 + step * dA / 2 * P[2] + half * d2)
            D[2, j] = A * (2 * dA * P[2] + A * d2)
        x[0], x[1] = x[0] + step * (r + g * force / 2), r + g * force
        P[0], P[1], P[2] = P[0] + half * (2 * P[1] + half * P[2]), A * (P[1] + half * P[2]), A * A * P[2]
        for i, noise in ((0, step**3 / 3), (1, step**2 / 2), (2, step)):
            P[i] += p[PROCESS] * noise
            D[i, PROCESS] += noise
        rates[k, 0], rates[k, 1] = (r + x[1]) / 2, P[2]
        if row[HEADING] == row[HEADING]:
            z = (row[HEADING] - x[0] + np.pi) % (2 * np.pi) - np.pi
            loss += measured(x, X, P, D, 0, z, p[COMPASS], COMPASS, score, information, dz, dJ)
        if row[RATE] == row[RATE]:
            loss += measured(x, X, P, D, 1, row[RATE] - p[OFFSET] - x[1], p[GYRO], GYRO, score, information, dz, dJ)
    return loss
