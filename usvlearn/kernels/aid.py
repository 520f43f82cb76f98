"""Adaptive identification: the step of `estimators.aid`, equations (1) to (6) there."""

import numpy as np

from usvlearn.compiled import kernel
from usvlearn.kernels.arrays import clamp, dot

AID_NUMBERS = ("scale", "surge_max", "gain", "leak", "dead_zone", "floor", "sigma", "bound")
SCALE, SURGE_MAX, GAIN, LEAK, DEAD_ZONE, FLOOR, SIGMA, BOUND = range(8)
AID_VECTORS = ("spread", "inverse_spread", "theta0", "lower", "upper")  # of p numbers, in this order behind the others
VECTORS = 8


def aid_fields(p):
    """The leaves of `AIDState`."""
    return {"theta": (p,), "surge": ()}


@kernel
def learn_aid(block, q, phi, estimate, target, dt, feedback, gamma_phi):
    """`AID.learn` on the leaves in `block`."""
    p = len(phi)
    theta = block[:p]
    error = estimate - target
    outside = error - clamp(error, q[DEAD_ZONE]) if q[DEAD_ZONE] > 0 else error
    N = 0.0
    for i in range(p):
        spread = q[VECTORS + i]
        gamma_phi[i] = q[GAIN] * (spread * spread) * phi[i]  # (2)
        N += phi[i] * gamma_phi[i]
    step = outside / (1 + N) if dot(phi, phi) * q[SCALE] ** 2 >= q[FLOOR] else 0.0
    n = 0.0
    for i in range(p):
        moved = theta[i] - step * gamma_phi[i]  # (3)
        lower, upper = q[VECTORS + 3 * p + i], q[VECTORS + 4 * p + i]
        moved = lower if moved < lower else (upper if moved > upper else moved)
        theta[i] = moved
        distance = (moved - q[VECTORS + 2 * p + i]) * q[VECTORS + p + i]
        n += distance * distance
    bound = q[BOUND]
    if q[SIGMA] > 0 and n > bound * bound:
        n = np.sqrt(n)
        rate = q[SIGMA] * min(n / bound - 1, 1.0)  # (4)
        leak = min(-np.expm1(-rate * dt), 1 - bound / n)
        for i in range(p):
            theta[i] -= leak * (theta[i] - q[VECTORS + 2 * p + i])  # (5)
    if feedback:
        target = clamp(target + (error - N * step) * np.exp(-q[LEAK] * dt), q[SURGE_MAX])  # (6)
    block[p] = target
