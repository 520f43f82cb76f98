"""Recursive least squares, SIFt-RLS and the projection onto signs: the steps of `estimators.rls`, `sift`, `projected`.

S is lower triangular. S T, T as in equation (2) of `rls`, is made in place along each row from its end: with the sums
w = Σ_{k>j} S_ik x_k that the row has passed, S_ij ← S_ij T_jj + y_j w. What stands at its beginning is (S x)_i.
"""

import numpy as np

from usvlearn.compiled import kernel
from usvlearn.kernels.arrays import clamp, copy, dot, fill

RLS_NUMBERS = (
    "scale", "surge_max", "prior", "loosest", "noise_share", "noise_least", "forgetting", "trace_max", "memory",
    "longest", "floor",
)  # fmt: skip
SCALE, SURGE_MAX, PRIOR, LOOSEST, NOISE_SHARE, NOISE_LEAST, FORGETTING, TRACE_MAX, TAU, LONGEST, FLOOR = range(11)


def rls_fields(p):
    """The leaves of `RLSState`."""
    return {"theta": (p,), "factor": (p, p), "surge": (), "noise": (), "deviation": ()}


@kernel
def rotated(S, phi, f):
    """f = Sᵀφ; returns fᵀf."""
    fill(f, 0.0)
    for i in range(len(phi)):
        for j in range(i + 1):
            f[j] += S[i, j] * phi[i]
    return dot(f, f)


@kernel
def measurement(f, lam, diagonal, below):
    """T of a measurement update, equation (2) of `rls`: its diagonal, and what stands below it over f_i; returns s."""
    alpha = lam
    for j in range(len(f) - 1, -1, -1):
        after = alpha
        alpha += f[j] * f[j]
        inverse = 1.0 / np.sqrt(alpha * after)
        diagonal[j] = after * inverse
        below[j] = -f[j] * inverse
    return alpha


@kernel
def forget(theta, S, f, innovation, lam, trace_max, diagonal, below):
    """One step of exponential forgetting, (1) and (2) of `rls`, with f = Sᵀφ."""
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


@kernel
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


@kernel
def learn_least_squares(block, q, forgets, phi, estimate, target, dt, feedback, work):
    """`LeastSquares.learn` on the leaves in `block`; `forgets` exponentially, or by what it learns anew."""
    p = len(phi)
    theta, S = block[:p], block[p : p + p * p].reshape(p, p)
    f, x = work[:p], work[p : 2 * p]
    innovation = target - estimate
    s = 1.0 + rotated(S, phi, f)
    noise = block[p + p * p + 1]
    if forgets:
        forget(theta, S, f, innovation, q[FORGETTING], q[TRACE_MAX], work[2 * p : 3 * p], work[3 * p : 4 * p])
    else:
        squared = dot(phi, phi) * q[SCALE] ** 2
        if squared >= q[FLOOR] and squared > 0:
            lam = np.exp(-min(dt / q[TAU], q[LONGEST]))
            sift(theta, S, phi, f, innovation, lam, x, work[2 * p : 3 * p], work[3 * p : 4 * p], work[4 * p : 5 * p],
                 work[5 * p : 6 * p])  # fmt: skip
    seen = innovation * innovation / s
    if not seen <= 16 * noise:  # NaN is passed on, as torch.minimum does
        seen = 16 * noise if seen > 16 * noise else seen
    learned = noise + q[NOISE_SHARE] * (seen - noise)
    block[p + p * p] = clamp(estimate, q[SURGE_MAX]) if feedback else target
    block[p + p * p + 1] = q[NOISE_LEAST] if learned < q[NOISE_LEAST] else learned
    block[p + p * p + 2] = np.sqrt(noise * s)


@kernel
def coast_least_squares(block, phi, surge, work):
    """`LeastSquares.predict`: the speed, and the deviation of its prediction."""
    p = len(phi)
    s = 1.0 + rotated(block[p : p + p * p].reshape(p, p), phi, work[:p])
    block[p + p * p] = surge
    block[p + p * p + 2] = np.sqrt(block[p + p * p + 1] * s)


@kernel
def loosen_least_squares(block, p, q, factor):
    """`LeastSquares.loosen`: P times `factor`, up to its limit."""
    S = block[p : p + p * p]
    limit = q[LOOSEST] * q[PRIOR] / dot(S, S)
    limit = 1.0 if limit < 1.0 else limit
    growth = np.sqrt(limit if factor > limit else factor)
    for i in range(len(S)):
        S[i] *= growth


@kernel
def solve(A, b, n):
    """b ← A⁻¹ b of the leading n × n block, by elimination with pivots; A is destroyed."""
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(A[i, k]) > abs(A[pivot, k]):
                pivot = i
        for j in range(k, n):
            A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
        b[k], b[pivot] = b[pivot], b[k]
        for i in range(k + 1, n):
            share = A[i, k] / A[k, k]
            for j in range(k + 1, n):
                A[i, j] -= share * A[k, j]
            b[i] -= share * b[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            b[k] -= A[k, j] * b[j]
        b[k] /= A[k, k]


@kernel
def project_signs(theta, S, signs, iterations, work):
    """`projected.project_signs`: θ becomes the nearest with these signs in the metric of P."""
    p = len(theta)
    held = 0
    inside = True
    for i in range(p):
        if signs[i] != 0:
            held += 1
            inside = inside and signs[i] * theta[i] >= 0
    if inside:
        return
    k = held
    place, Q, A = work[:k], work[k : k + k * k].reshape(k, k), work[k + k * k : k + 2 * k * k].reshape(k, k)
    rest = work[k + 2 * k * k :]
    z, t, mu, b, active = rest[:k], rest[k : 2 * k], rest[2 * k : 3 * k], rest[3 * k : 4 * k], rest[4 * k : 5 * k]
    moved = rest[5 * k : 5 * k + p]
    count = 0
    for i in range(p):
        if signs[i] != 0:
            place[count] = i
            z[count] = signs[i] * theta[i]
            count += 1
    for a in range(k):
        for c in range(a + 1):
            i, j = int(place[a]), int(place[c])
            Q[a, c] = Q[c, a] = signs[i] * signs[j] * dot(S[i], S[j])
    largest = 0.0
    for a in range(k):
        t[a], mu[a] = z[a], 0.0
        largest = max(largest, abs(z[a]))
    for _ in range(iterations):
        n = 0
        for a in range(k):
            if mu[a] > t[a] / Q[a, a]:
                active[n] = a
                n += 1
        for a in range(n):
            b[a] = -z[int(active[a])]
            for c in range(n):
                A[a, c] = Q[int(active[a]), int(active[c])]
        solve(A, b, n)
        fill(mu, 0.0)
        for a in range(n):
            mu[int(active[a])] = b[a]
        for a in range(k):
            t[a] = z[a] + dot(Q[a], mu)
        for a in range(n):
            t[int(active[a])] = 0.0
    tolerance = 1e-6 * largest
    solved = True
    for a in range(k):
        solved = solved and t[a] >= -tolerance and mu[a] * Q[a, a] >= -tolerance
    if solved:
        work_column = rest[5 * k + p : 5 * k + 2 * p]
        fill(work_column, 0.0)
        for a in range(k):
            i = int(place[a])
            for j in range(i + 1):
                work_column[j] += S[i, j] * (signs[i] * mu[a])
        for i in range(p):
            moved[i] = theta[i]
            for j in range(i + 1):
                moved[i] += S[i, j] * work_column[j]
        copy(theta, moved)
    else:
        copy(t, z)
    for a in range(k):
        i = int(place[a])
        theta[i] = signs[i] * (0.0 if t[a] < 0 else t[a])
