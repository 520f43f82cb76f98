"""The covariance P = U D Uᵀ of the joint EKF: what its F, its noise and its H make faster than `factored`, in place.

A is the leaf `factor`: U_ij at A[j, i] for i < j, D_j at A[j, j].
"""

from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import COS, SIN
from usvlearn.estimators.augmented_ekf.kernel import add_slow, first_row
from usvlearn.estimators.joint.state import EAST, NORTH, B, W


@jit(reorder=True)
def transition(A, g, slow, current):
    """F P Fᵀ."""
    first_row(A, g)
    A[B, W] /= slow
    A[NORTH, W], A[EAST, W] = A[NORTH, W] / current, A[EAST, W] / current
    A[NORTH, B], A[EAST, B] = A[NORTH, B] * (slow / current), A[EAST, B] * (slow / current)
    for j in range(EAST + 1, len(g)):
        A[j, B], A[j, NORTH], A[j, EAST] = A[j, B] * slow, A[j, NORTH] * current, A[j, EAST] * current
    A[W, W] *= g[W] * g[W]
    A[B, B] *= slow * slow
    A[NORTH, NORTH], A[EAST, EAST] = A[NORTH, NORTH] * (current * current), A[EAST, EAST] * (current * current)


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
def seen(A, x, f, G):
    """`rotated` for H: f and G; returns HᵀPH."""
    n, cosine, sine, total = len(f), x[COS], x[SIN], 0.0
    f[W], f[B] = 1.0, A[B, W]
    f[NORTH], f[EAST] = A[NORTH, W] + cosine, A[EAST, W] + cosine * A[EAST, NORTH] + sine
    for j in range(EAST + 1, n):
        f[j] = A[j, W] + cosine * A[j, NORTH] + sine * A[j, EAST]
    for j in range(n):
        G[j] = A[j, j] * f[j]
        total += f[j] * G[j]
    return total
