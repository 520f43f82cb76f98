"""Velocities from positions, compiled by numba: the Kalman filter of `usvlearn.logs.channels.derived_surge`."""

from __future__ import annotations

import math

import numpy as np

from usvlearn.core.jit import jit

DENSITY = 0.1  # q, m²/s³: accelerations of some 0.2 m/s² that last some seconds
NOISE, PRIOR, CLIP = 0.1, 20.0, 25.0  # m, first guess of sqrt(r); positions that it counts for; most of a square / r
COPY = 1.1  # s, within which an equal position is a copy
OUTAGE = 5.0  # s without a position, after which the filter starts anew
OUTLIER = 36.0  # squared innovation over its variance, of a position that is left out
ROW = 3  # positions that are left out in a row, at most
SURE = 0.5  # m/s, standard deviation of the speed, above which none is given


@jit(entry=True, memory=True)
def velocities(time, north, east):
    """Velocities north and east, `(2, n)`; see `usvlearn.logs.channels.derived_surge.filtered`."""
    velocity = np.full((2, len(time)), np.nan)
    taken, missed = -math.inf, 0  # time of the last position that was used; outliers in a row
    p, v, last = np.zeros(2), np.zeros(2), np.zeros(2)
    pp, pv, vv = 0.0, 0.0, 0.0  # covariance, equal for both axes
    noise, count = NOISE**2, PRIOR  # r
    recent, stamps, known = np.zeros((2, 3)), np.zeros(3), 0  # the last three positions
    for k in range(len(time)):
        h, z0, z1 = time[k] - taken, north[k], east[k]
        if not (math.isfinite(z0) and math.isfinite(z1) and math.isfinite(time[k])) or h <= 0:
            if h < -OUTAGE:
                taken = -math.inf  # the clock was set back
            continue
        if z0 == last[0] and z1 == last[1] and h < COPY:
            continue
        last[0], last[1] = z0, z1
        if h > OUTAGE:
            p[0], p[1] = z0, z1
            v[:] = 0.0
            pp, pv, vv = noise, 0.0, 100.0
            taken, missed, known = time[k], 0, 0
        else:
            p += v * h
            pp += 2 * h * pv + h * h * vv + DENSITY * h**3 / 3
            pv += h * vv + DENSITY * h * h / 2
            vv += DENSITY * h
            total = pp + noise
            e0, e1 = z0 - p[0], z1 - p[1]
            if (e0 * e0 + e1 * e1) / 2 > OUTLIER * total and missed < ROW:
                missed += 1
                taken = time[k]
                continue
            if missed >= ROW:  # not outliers: the position has jumped
                p[0], p[1] = z0, z1
                pp, pv, vv = noise, 0.0, vv + 1.0
                known = 0
            else:
                p += pp / total * np.array([e0, e1])
                v += pv / total * np.array([e0, e1])
                vv -= pv * pv / total
                pv -= pp * pv / total
                pp -= pp * pp / total
            missed, taken = 0, time[k]
        if known == 3:
            w = _weights(stamps, time[k])
            size = 1.0 + w[0] ** 2 + w[1] ** 2 + w[2] ** 2
            d0 = z0 - w[0] * recent[0, 0] - w[1] * recent[0, 1] - w[2] * recent[0, 2]
            d1 = z1 - w[0] * recent[1, 0] - w[1] * recent[1, 1] - w[2] * recent[1, 2]
            square = min((d0 * d0 + d1 * d1) / (2 * size), CLIP * noise)
            count = min(count + 1, 500.0)
            noise += (square - noise) / count
            noise = max(noise, 1e-6)
        for j in range(2):
            recent[:, j] = recent[:, j + 1]
            stamps[j] = stamps[j + 1]
        recent[0, 2], recent[1, 2], stamps[2] = z0, z1, time[k]
        known = min(known + 1, 3)
        if vv < SURE**2:
            velocity[0, k], velocity[1, k] = v[0], v[1]
    return velocity


@jit
def _weights(stamps, t):
    """Of three positions in the parabola through them, at a time: Lagrange's polynomials."""
    a, b, c = stamps[0], stamps[1], stamps[2]
    return (
        (t - b) * (t - c) / ((a - b) * (a - c)),
        (t - a) * (t - c) / ((b - a) * (b - c)),
        (t - a) * (t - b) / ((c - a) * (c - b)),
    )
