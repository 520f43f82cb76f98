"""The covariance P = U D Uᵀ of the joint filter: the operations of `factored`, in place.

A is the leaf `factor`: U_ij at A[j, i] for i < j, D_j at A[j, j]. Equations are those of `state`.
"""

from usvlearn.arrays import fill
from usvlearn.estimators.joint.state import EAST, NORTH, B, W
from usvlearn.jit import jit
from usvlearn.rows import COS, SIN


@jit
def variance(A, i):
    """P_ii."""
    total = A[i, i]
    for j in range(i + 1, len(A)):
        total += A[j, j] * A[j, i] * A[j, i]
    return total


@jit(reorder=True)
def transition(A, g, slow, current):
    """F P Fᵀ."""
    n = len(g)
    for j in range(1, n):
        total = g[j]
        for i in range(j):
            total += g[i] * A[j, i]
        A[j, W] = total
    A[B, W] /= slow
    A[NORTH, W], A[EAST, W] = A[NORTH, W] / current, A[EAST, W] / current
    A[NORTH, B], A[EAST, B] = A[NORTH, B] * (slow / current), A[EAST, B] * (slow / current)
    for j in range(EAST + 1, n):
        A[j, B], A[j, NORTH], A[j, EAST] = A[j, B] * slow, A[j, NORTH] * current, A[j, EAST] * current
    A[W, W] *= g[W] * g[W]
    A[B, B] *= slow * slow
    A[NORTH, NORTH], A[EAST, EAST] = A[NORTH, NORTH] * (current * current), A[EAST, EAST] * (current * current)


@jit
def add(A, k, c, a):
    """P + c e_k e_kᵀ, (8)."""
    fill(a[:k], 0.0)
    a[k] = 1.0
    for j in range(k, 0, -1):
        d = A[j, j]
        larger = d + c * a[j] * a[j]
        inverse = 1 / larger
        keep, beta = d * inverse, c * a[j] * inverse
        c *= keep
        for i in range(j):
            u = A[j, i]
            A[j, i] = u * keep + beta * a[i]
            a[i] -= a[j] * u
        A[j, j] = larger
    A[W, W] += c * a[W] * a[W]


@jit
def add_current(A, c):
    """`add` for both components of the current, where all numbers stay in registers."""
    d, north, slow, fast = A[EAST, EAST], -A[EAST, NORTH], -A[EAST, B], -A[EAST, W]
    larger = d + c
    keep = d / larger
    A[EAST, EAST], A[EAST, NORTH], A[EAST, B], A[EAST, W] = larger, -north * keep, -slow * keep, -fast * keep
    add_north(A, c * keep, north, slow, fast)
    add_north(A, c, 1.0, 0.0, 0.0)


@jit
def add_north(A, c, north, slow, fast):
    """P + c a aᵀ with a = [fast, slow, north, 0, …]."""
    d, v, u = A[NORTH, NORTH], A[NORTH, B], A[NORTH, W]
    larger = d + c * north * north
    inverse = 1 / larger
    keep, beta = d * inverse, c * north * inverse
    A[NORTH, NORTH], A[NORTH, B], A[NORTH, W] = larger, v * keep + beta * slow, u * keep + beta * fast
    add_slow(A, c * keep, slow - north * v, fast - north * u)


@jit
def add_slow(A, c, slow, fast):
    """P + c a aᵀ with a = [fast, slow, 0, …]."""
    d, u = A[B, B], A[B, W]
    larger = d + c * slow * slow
    inverse = 1 / larger
    keep, beta = d * inverse, c * slow * inverse
    A[B, B], A[B, W] = larger, u * keep + beta * fast
    fast -= slow * u
    A[W, W] += c * keep * fast * fast


@jit
def seen(A, x, f, G):
    """f and G of (9); returns HᵀPH."""
    n, cosine, sine, total = len(f), x[COS], x[SIN], 0.0
    f[W], f[B] = 1.0, A[B, W]
    f[NORTH], f[EAST] = A[NORTH, W] + cosine, A[EAST, W] + cosine * A[EAST, NORTH] + sine
    for j in range(EAST + 1, n):
        f[j] = A[j, W] + cosine * A[j, NORTH] + sine * A[j, EAST]
    for j in range(n):
        G[j] = A[j, j] * f[j]
        total += f[j] * G[j]
    return total


@jit
def measure(A, f, G, alpha, gain):
    """(9) from α_0; writes P H into `gain`, and returns S.

    Four columns of U at a time: then a sum is loaded and stored once for four products.
    """
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


@jit
def project(mean, A, i, k, sign, t):
    """x_i + sign x_k becomes 0, and the others follow their covariances with it."""
    n, value, total = len(mean), mean[i] + sign * mean[k], 0.0
    for j in range(i, n):
        t[j] = A[j, i] + sign * A[j, k] if j > k else A[j, i]
    t[i] = 1.0
    t[k] += sign
    for j in range(i, n):
        weight = A[j, j] * t[j]
        total += weight * t[j]
        t[j] = weight
    value /= total
    for j in range(i, n):
        move = value * t[j]
        for other in range(j):
            mean[other] -= move * A[j, other]
        mean[j] -= move
