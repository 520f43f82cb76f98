"""The covariance P = U D Uᵀ: operations in place, by the equations of the package.

A is the leaf `factor`: U_ij at A[j, i] for i < j, D_j at A[j, j].
"""

from usvlearn.core.arrays import fill
from usvlearn.core.jit import jit


@jit
def variance(A, i):
    """P_ii."""
    total = A[i, i]
    for j in range(i + 1, len(A)):
        total += A[j, j] * A[j, i] * A[j, i]
    return total


@jit
def walked(A, i, prior, growth):
    """By how much P_ii grows when it walks: no further than its prior."""
    room = prior - variance(A, i)
    return min(growth, room) if room > 0 else 0.0


@jit(reorder=True)
def rotated(A, H, f, G):
    """f and G of (2); returns HᵀPH."""
    total = 0.0
    for j in range(len(H)):
        own = H[j]
        for i in range(j):
            own += A[j, i] * H[i]
        f[j], G[j] = own, A[j, j] * own
        total += own * G[j]
    return total


@jit
def add(A, k, c, a):
    """P + c e_k e_kᵀ, (1)."""
    fill(a[:k], 0.0)
    a[k] = 1.0
    along(A, k, c, a)


@jit
def along(A, k, c, a):
    """P + c a aᵀ, (1), where a is 0 behind its place k; a is changed."""
    for j in range(k, 0, -1):
        d, own = A[j, j], a[j]
        larger = d + c * own * own
        keep, beta = d / larger, c * own / larger
        c *= keep
        for i in range(j):
            u = A[j, i]
            A[j, i] = u * keep + beta * a[i]
            a[i] -= own * u
        A[j, j] = larger
    A[0, 0] += c * a[0] * a[0]


@jit
def measure(A, f, G, alpha, gain):
    """(2) from α_0; writes P H into `gain`, and returns S. Four columns of U at a time take fewer loads and stores."""
    n, j = len(f), 0
    while j + 3 < n:
        G0, G1, G2, G3 = G[j], G[j + 1], G[j + 2], G[j + 3]
        alpha1 = alpha + f[j] * G0
        alpha2 = alpha1 + f[j + 1] * G1
        alpha3 = alpha2 + f[j + 2] * G2
        alpha4 = alpha3 + f[j + 3] * G3
        s0, s1, s2, s3 = -f[j] / alpha, -f[j + 1] / alpha1, -f[j + 2] / alpha2, -f[j + 3] / alpha3
        A[j, j] *= alpha / alpha1
        A[j + 1, j + 1] *= alpha1 / alpha2
        A[j + 2, j + 2] *= alpha2 / alpha3
        A[j + 3, j + 3] *= alpha3 / alpha4
        alpha = alpha4
        for i in range(j):
            total, u0, u1, u2, u3 = gain[i], A[j, i], A[j + 1, i], A[j + 2, i], A[j + 3, i]
            A[j, i] = u0 + total * s0
            total += u0 * G0
            A[j + 1, i] = u1 + total * s1
            total += u1 * G1
            A[j + 2, i] = u2 + total * s2
            total += u2 * G2
            A[j + 3, i] = u3 + total * s3
            gain[i] = total + u3 * G3
        total, u1, u2, u3 = G0, A[j + 1, j], A[j + 2, j], A[j + 3, j]
        A[j + 1, j] = u1 + total * s1
        total += u1 * G1
        A[j + 2, j] = u2 + total * s2
        total += u2 * G2
        A[j + 3, j] = u3 + total * s3
        gain[j] = total + u3 * G3
        total, u2, u3 = G1, A[j + 2, j + 1], A[j + 3, j + 1]
        A[j + 2, j + 1] = u2 + total * s2
        total += u2 * G2
        A[j + 3, j + 1] = u3 + total * s3
        gain[j + 1] = total + u3 * G3
        u3 = A[j + 3, j + 2]
        A[j + 3, j + 2] = u3 + G2 * s3
        gain[j + 2], gain[j + 3] = G2 + u3 * G3, G3
        j += 4
    while j < n:
        after, slope = alpha + f[j] * G[j], -f[j] / alpha
        for i in range(j):
            u = A[j, i]
            A[j, i] = u + gain[i] * slope
            gain[i] += u * G[j]
        gain[j] = G[j]
        A[j, j] *= alpha / after
        alpha = after
        j += 1
    return alpha


@jit(inline=True)
def project(x, A, i, k, share, t):
    """(3) with d = e_i + share e_k, i <= k."""
    value = x[i] + share * x[k]
    if value > 0:
        shift(x, A, i, k, share, value, t)


@jit
def shift(x, A, i, k, share, value, t):
    """x less P d times `value`/(dᵀP d)."""
    n, total = len(x), 0.0
    for j in range(i, n):
        t[j] = A[j, i] + share * A[j, k] if j > k else A[j, i]
    t[i] = 1.0
    t[k] += share
    for j in range(i, n):
        weight = A[j, j] * t[j]
        total += weight * t[j]
        t[j] = weight
    value /= total
    for j in range(i, n):
        move = value * t[j]
        for other in range(j):
            x[other] -= move * A[j, other]
        x[j] -= move


@jit
def loosen(A, growth, limit):
    """P times `growth`, up to `limit`; a limit below 1 counts as 1."""
    limit = 1.0 if limit < 1.0 else limit
    for j in range(len(A)):
        A[j, j] *= limit if growth > limit else growth
