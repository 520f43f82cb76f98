"""The steps that the joint EKF and the axis EKF share; the equations are those of `usvlearn.estimators.joint.state`.

What each step calls is inlined: the compiler inlines by itself what one place calls, and here there are two.
`node` is the row of a filter whose state begins with the leaves of `FilterState`. A is the leaf `factor`.
"""

import numpy as np

from usvlearn.core.arrays import whole
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.estimators.augmented_ekf.state import (
    AT,
    DECAYED,
    EVERY,
    LAG_LEAST,
    LAG_MOST,
    LONGEST,
    LOOSEST,
    MOST,
    NOISE_COUNT,
    NOISE_LEAST,
    NOISE_MOST,
    NOISE_SHARE,
    OWN_NOISE,
    STEP,
    B,
    Y,
)
from usvlearn.estimators.ud_factorization.kernel import add, loosen, measure, variance, walked


@jit(inline=True)
def blocks(node, s):
    """x and A."""
    n = node[Row.SIZE]
    return s[node[AT.mean] : node[AT.mean] + n], s[node[AT.factor] : node[AT.factor] + n * n].reshape(n, n)


@jit
def decay(dt, time):
    """e^(−h/τ)."""
    return np.exp(-min(dt / time, DECAYED))


@jit
def isolate(A, alone):
    """The start of a segment: P loses all that joins y and b to others, and P_yy becomes `alone`."""
    disturbed = variance(A, B)
    for j in range(1, len(A)):
        A[j, Y] = 0.0
    for j in range(2, len(A)):
        A[j, B] = 0.0
    A[Y, Y], A[B, B] = alone, disturbed


@jit(inline=True, reorder=True)
def first_row(A, g):
    """The first row of F U, which is g U, in the place of that of U; the rest of F P Fᵀ is scales."""
    for j in range(1, len(g)):
        total = g[j]
        for i in range(j):
            total += g[i] * A[j, i]
        A[j, Y] = total


@jit
def add_slow(A, c, slow, fast):
    """P + c a aᵀ with a = [fast, slow, 0, …]."""
    d, u = A[B, B], A[B, Y]
    larger = d + c * slow * slow
    inverse = 1 / larger
    keep, beta = d * inverse, c * slow * inverse
    A[B, B], A[B, Y] = larger, u * keep + beta * fast
    fast -= slow * u
    A[Y, Y] += c * keep * fast * fast


@jit(inline=True)
def add_noise(node, s, A, prior, first, disturbance, drift_time, h, rest, a):
    """The noise of a step of h, s: of y, of b, and of one parameter where it is one's turn.

    `prior` are variances of the parameters, which begin at the place `first` of x; a is memory, of the length of x.
    """
    noise, span, parameters = s[node[AT.noise]], min(h, LONGEST) / STEP, node[Row.SIZE] - first
    add_slow(A, disturbance * noise * span, 1.0, 0.0)
    A[Y, Y] += OWN_NOISE * noise * span
    turn = s[node[AT.turn]]
    k = whole(turn, EVERY * parameters)
    if k == turn and k % EVERY == 0 and not rest:
        share = EVERY * parameters * (STEP * span) / drift_time
        i, variance = first + k // EVERY, prior[k // EVERY]
        add(A, i, walked(A, i, variance, share * variance), a)
    s[node[AT.turn]] = turn + 1 if 0 <= turn + 1 < EVERY * parameters else 0.0


@jit(inline=True)
def limit(A, ahead):
    """The variance of a y⁺ that is beyond its limit."""
    if abs(ahead) >= MOST:
        for j in range(1, len(A)):
            A[j, Y] = 0.0
        A[Y, Y] = MOST * MOST


@jit(inline=True)
def correct(node, s, error, spread, outlier, rest, work):
    """x, P and σ² after a measurement with this innovation, (5) and (6); f and G are in `work`. Returns S."""
    n, noise, k = node[Row.SIZE], s[node[AT.noise]], outlier
    mean, A = blocks(node, s)
    f, G, gain = work[:n], work[n : 2 * n], work[2 * n : 3 * n]
    square, S = error * error, spread + noise
    alpha = measure(A, f, G, square / (k * k) - spread if square > k * k * S else noise, gain)
    for i in range(n):
        mean[i] += gain[i] * (error / alpha)
    if not rest:
        s[node[AT.updates]] += 1
        share = max(NOISE_SHARE, 1 / (s[node[AT.updates]] + NOISE_COUNT))
        learned = noise * (1 + share * (min(square / S, NOISE_MOST) - 1))  # (6)
        s[node[AT.noise]] = NOISE_LEAST**2 if learned < NOISE_LEAST**2 else learned
    return S


@jit(inline=True)
def limit_lag(mean):
    """The limits of μ."""
    mu = mean[-1]
    mean[-1] = LAG_LEAST if mu < LAG_LEAST else (LAG_MOST if mu > LAG_MOST else mu)


@jit
def inflate(node, s, prior, first, factor):
    """P times `factor`, up to its limit; `prior` and `first` as of `add_noise`."""
    n, A, total = node[Row.SIZE], blocks(node, s)[1], 0.0
    for i in range(first, n):
        total += variance(A, i) / prior[i - first]
    loosen(A, factor, LOOSEST * (n - first) / total)
