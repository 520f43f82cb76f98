"""Recursive least squares and SIFt-RLS: the steps of `rls` and `sift`.

S is lower triangular. S T, T as in equation (2) of `state`, is made in place along each row from its end: with the sums
w = Σ_{k>j} S_ik x_k that the row has passed, S_ij ← S_ij T_jj + y_j w. What stands at its beginning is (S x)_i.
"""

import numpy as np

from usvlearn.core.arrays import clamp, dot, fill
from usvlearn.core.family import ESTIMATE, Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import DT
from usvlearn.estimators.least_squares.state import AT, RLS, Choice, Number
from usvlearn.estimators.regressors.kernel import regressor


@jit
def start(node, s, q, surge):
    """`LeastSquares.start`."""
    s[node[AT.surge]] = surge


@jit
def predict(node, s, q, x, work):
    """`LeastSquares.predict`: the speed, and what it was before its limits; φ stays in `work`."""
    p, numbers = node[Row.SIZE], q[node[Row.NUMBERS] :]
    phi, theta = work[:p], s[node[AT.theta] : node[AT.theta] + p]
    base = regressor(node[Choice.TERMS], s[node[AT.surge]], x, numbers[Number.SCALE], theta, phi)
    estimate = base + dot(phi, theta)
    return clamp(estimate, numbers[Number.SURGE_MAX]), estimate


@jit
def coast(node, s, q, x, predicted, work):
    """The state after `LeastSquares.predict`: the speed, and the deviation of its prediction."""
    p = node[Row.SIZE]
    spread = 1.0 + rotated(s[node[AT.factor] : node[AT.factor] + p * p].reshape(p, p), work[:p], work[p : 2 * p])
    s[node[AT.surge]] = predicted
    s[node[AT.deviation]] = np.sqrt(s[node[AT.noise]] * spread)


@jit
def free_step(node, s, q, x, work):
    """One step of an open-loop simulation: `predict`, and the leaves `frozen` after it; returns the speed, m/s."""
    predicted, _ = predict(node, s, q, x, work)
    s[node[AT.surge]] = predicted
    return predicted


@jit
def learn(node, s, q, x, estimate, target, work):
    """The state after `LeastSquares.learn`."""
    p, numbers = node[Row.SIZE], q[node[Row.NUMBERS] :]
    theta, S = s[node[AT.theta] : node[AT.theta] + p], s[node[AT.factor] : node[AT.factor] + p * p].reshape(p, p)
    phi, f, rest = work[:p], work[p : 2 * p], work[2 * p :]
    innovation = target - estimate
    spread = 1.0 + rotated(S, phi, f)
    noise = s[node[AT.noise]]
    if node[Row.KIND] == RLS:
        lam, trace_max = numbers[Number.FORGETTING], numbers[Number.TRACE_MAX]
        forget(theta, S, f, innovation, lam, trace_max, rest[p : 2 * p], rest[2 * p : 3 * p])
    else:
        squared = dot(phi, phi) * numbers[Number.SCALE] ** 2
        if squared >= numbers[Number.FLOOR] and squared > 0:
            lam = np.exp(-min(x[DT] / numbers[Number.MEMORY], numbers[Number.LONGEST]))
            sift(theta, S, phi, f, innovation, lam, rest[:p], rest[p : 2 * p], rest[2 * p : 3 * p],
                 rest[3 * p : 4 * p], rest[4 * p : 5 * p])  # fmt: skip
    seen = innovation * innovation / spread
    if not seen <= 16 * noise:  # NaN is passed on, as torch.minimum does
        seen = 16 * noise if seen > 16 * noise else seen
    learned = noise + numbers[Number.NOISE_SHARE] * (seen - noise)
    departs = clamp(estimate, numbers[Number.SURGE_MAX]) if node[Choice.FEEDBACK] == ESTIMATE else target
    s[node[AT.surge]] = departs
    s[node[AT.noise]] = numbers[Number.NOISE_LEAST] if learned < numbers[Number.NOISE_LEAST] else learned
    s[node[AT.deviation]] = np.sqrt(noise * spread)


@jit
def inflate_covariance(node, s, q, factor):
    """`LeastSquares.inflate_covariance`: P times `factor`, up to its limit."""
    p, numbers = node[Row.SIZE], q[node[Row.NUMBERS] :]
    S = s[node[AT.factor] : node[AT.factor] + p * p]
    limit = numbers[Number.LOOSEST] * numbers[Number.PRIOR] / dot(S, S)
    limit = 1.0 if limit < 1.0 else limit
    growth = np.sqrt(limit if factor > limit else factor)
    for i in range(len(S)):
        S[i] *= growth


@jit
def rotated(S, phi, f):
    """f = Sᵀφ; returns fᵀf."""
    fill(f, 0.0)
    for i in range(len(phi)):
        for j in range(i + 1):
            f[j] += S[i, j] * phi[i]
    return dot(f, f)


@jit
def measurement(f, lam, diagonal, below):
    """T of a measurement update, (2) of `state`: its diagonal, and what stands below it over f_i; returns s."""
    alpha = lam
    for j in range(len(f) - 1, -1, -1):
        after = alpha
        alpha += f[j] * f[j]
        inverse = 1.0 / np.sqrt(alpha * after)
        diagonal[j] = after * inverse
        below[j] = -f[j] * inverse
    return alpha


@jit
def forget(theta, S, f, innovation, lam, trace_max, diagonal, below):
    """One step of exponential forgetting, (1) and (2) of `state`, with f = Sᵀφ."""
    p = len(theta)
    gain = innovation / measurement(f, lam, diagonal, below)
    trace = 0.0
    for i in range(p):
        w = 0.0
        for j in range(i, -1, -1):
            old = S[i, j]
            new = old * diagonal[j] + below[j] * w
            w += old * f[j]
            S[i, j] = new
            trace += new * new
        theta[i] += gain * w
    if trace < trace_max * lam:
        growth = 1.0 / np.sqrt(lam)
        for i in range(p):
            for j in range(i + 1):
                S[i, j] *= growth


@jit
def sift(theta, S, phi, f, innovation, lam, x, opens, opens_below, diagonal, below):
    """One step of SIFt-RLS, (1) and (2) of `sift`, with f = Sᵀφ, which it changes; both updates in one pass over S."""
    p = len(theta)
    q = 0.0
    for i in range(p):
        rest = phi[i]
        for j in range(i):
            rest -= S[i, j] * x[j]
        rest /= S[i, i]
        x[i] = rest
        q += rest * rest
    c = (1.0 / lam - 1.0) / q
    t = 1.0
    for j in range(p):
        before = t
        t += c * x[j] * x[j]
        inverse = 1.0 / np.sqrt(t * before)
        opens[j] = t * inverse
        opens_below[j] = c * x[j] * inverse
    w = 0.0
    for j in range(p - 1, -1, -1):  # f of the opened factor: S̄ᵀφ = Tᵀf
        old = f[j]
        f[j] = opens[j] * old + opens_below[j] * w
        w += x[j] * old
    gain = innovation / measurement(f, 1.0, diagonal, below)
    for i in range(p):
        w = 0.0
        v = 0.0
        for j in range(i, -1, -1):
            old = S[i, j]
            opened = old * opens[j] + opens_below[j] * w
            w += old * x[j]
            S[i, j] = opened * diagonal[j] + below[j] * v
            v += opened * f[j]
        theta[i] += gain * v
