"""The projections of `certify.training.projections.project` with w₁ fixed, for one network whose weights lie in one
array.

Where the threshold θ of (1) there is found by sorting, here it is by Michelot's rounds (1986): those that would become
zero leave the sums until none does, which takes a few passes and no memory.
"""

import numpy as np

from usvlearn.core.jit import jit
from usvlearn.estimators.rnn.state import BEGIN, INPUTS, Condition


@jit
def threshold(a, cost, radius):
    """θ of (1), and 1/Σ c² of those that do not become zero, by which it falls with the radius; 0, 0 in the ball."""
    theta, slope = 0.0, 0.0
    last = -1
    while True:
        total, squares, count = 0.0, 0.0, 0
        for i in range(len(a)):
            size = abs(a[i])
            if cost[i] > 0 and size > theta * cost[i]:
                total += cost[i] * size
                squares += cost[i] * cost[i]
                count += 1
        if (last == -1 and not total > radius) or count == 0 or 0 <= last <= count:  # they only become fewer
            return theta, slope
        last = count
        theta, slope = (total - radius) / squares, 1.0 / squares


@jit
def shrink(a, cost, radius):
    """Project a onto Σ c_i |a_i| ≤ radius; where the cost is 0 nothing moves."""
    theta = threshold(a, cost, radius)[0]
    if theta > 0:
        for i in range(len(a)):
            size = abs(a[i]) - theta * cost[i]
            a[i] = 0.0 if size < 0 else (size if a[i] > 0 else -size)


@jit
def extremes(a, w1):
    """P and N: over all activation patterns the slope lies in [−N, P]."""
    P, N = 0.0, 0.0
    for i in range(len(a)):
        s = a[i] * w1[i]
        P += max(s, 0.0)
        N += max(-s, 0.0)
    return P, N


@jit
def scale(a, w1, sign, rate, kappa):
    """Scale a by κ/found where that is below 1, of the neurons whose s has this sign; 0 means all."""
    if not rate > kappa:
        return
    for i in range(len(a)):
        if sign == 0 or (a[i] * w1[i] > 0) == (sign > 0):
            a[i] *= kappa / rate


@jit
def project(weights, n, condition, best, kappa, bounds, work):
    """a becomes the nearest that holds a condition at the rate κ; literal conditions may change the gauge first."""
    a, w1, cost = weights[n * BEGIN.a : n * BEGIN.a + n], weights[n * BEGIN.w1 : n * BEGIN.w1 + n], work[:n]
    kappa *= 1 - 8 * n * np.finfo(weights.dtype).eps
    if condition == Condition.EXACT or condition == Condition.LMI:
        times = 2.0 if condition == Condition.LMI else 1.0
        P, N = extremes(a, w1)
        if times * max(P, N) <= kappa:  # NaN goes on, and stays
            return
        for sign in (1.0, -1.0):
            for i in range(n):
                cost[i] = abs(w1[i]) if (a[i] * w1[i] > 0) == (sign > 0) else 0.0
            shrink(a, cost, kappa / times)
        P, N = extremes(a, w1)
        scale(a, w1, 1, times * P, kappa)
        scale(a, w1, -1, times * N, kappa)
    elif condition == Condition.INTERVAL:
        project_interval(weights, n, kappa, bounds, work)
    else:
        if not best:
            regauge(weights, n)
        project_diagonal(a, w1, condition, best, kappa, cost)


@jit
def regauge(weights, n):
    """Rescale each neuron with |w₁| ≥ 1 to ½, which changes no output."""
    for i in range(n):
        w = abs(weights[n * BEGIN.w1 + i])
        if w >= 1:
            c = 0.5 / w
            weights[n * BEGIN.a + i] /= c
            for j in range(INPUTS):
                weights[n * BEGIN.W2 + INPUTS * i + j] *= c
            weights[n * BEGIN.w1 + i] *= c
            weights[n * BEGIN.b + i] *= c


@jit
def project_diagonal(a, w1, condition, best, kappa, cost):
    """The conditions `simple` and `gershgorin`, in either gauge."""
    n = len(a)
    rate = 0.0
    tiny = np.finfo(a.dtype).tiny
    if condition == Condition.SIMPLE:
        for i in range(n):
            w = abs(w1[i])
            limit = kappa * (0.25 / ((n + 1) * max(w, tiny)) if best else (1 - w) / (n + 1))
            a[i] = min(abs(a[i]), limit) * np.sign(a[i])
            size = (n + 1) * abs(a[i])
            rate = max(rate, 4 * (n + 1) * abs(a[i] * w1[i]) if best else size / (1 - w))
    else:
        for i in range(n):
            cost[i] = abs(w1[i]) if best else 1 / (1 - abs(w1[i]))
        shrink(a, cost, kappa / 2 if best else 2 * kappa)
        for i in range(n):
            rate += 2 * abs(a[i] * w1[i]) if best else abs(a[i]) / (1 - abs(w1[i])) / 2
    scale(a, w1, 0, rate, kappa)


@jit
def box_rate(weights, n, bounds, side):
    """The rate of `conditions.interval`; `side` becomes 1 where a neuron is always on, −1 where it never is, else 0."""
    lo, hi = bounds[: 1 + INPUTS], bounds[1 + INPUTS :]
    rounding = 14 * np.finfo(weights.dtype).eps
    on, above, below = 0.0, 0.0, 0.0
    for i in range(n):
        z, reach, largest = weights[n * BEGIN.b + i], 0.0, abs(weights[n * BEGIN.b + i])
        for j in range(1 + INPUTS):
            w = weights[n * BEGIN.w1 + i] if j == 0 else weights[n * BEGIN.W2 + INPUTS * i + j - 1]
            z += w * ((lo[j] + hi[j]) / 2)
            reach += abs(w) * ((hi[j] - lo[j]) / 2)
            largest += abs(w) * max(abs(lo[j]), abs(hi[j]))
        reach += rounding * largest
        s = weights[n * BEGIN.a + i] * weights[n * BEGIN.w1 + i]
        side[i] = 1.0 if z > reach else (-1.0 if z < -reach else 0.0)
        on += s if z > reach else 0.0
        if side[i] == 0:
            above += max(s, 0.0)
            below += max(-s, 0.0)
    return max(on + above, -on + below)


@jit
def project_interval(weights, n, kappa, bounds, work):
    """`projections._nearest_on_box`, and the scaling after it; δ of (2) by Newton's steps on its pieces."""
    a, w1 = weights[n * BEGIN.a : n * BEGIN.a + n], weights[n * BEGIN.w1 : n * BEGIN.w1 + n]
    side, above, below = work[:n], work[n : 2 * n], work[2 * n : 3 * n]
    box_rate(weights, n, bounds, side)
    S, W = 0.0, 0.0
    for i in range(n):
        above[i] = below[i] = 0.0
        s = a[i] * w1[i]
        if side[i] > 0:
            S += s
            W += w1[i] * w1[i]
        elif side[i] == 0:
            above[i] = abs(w1[i]) if s > 0 else 0.0
            below[i] = abs(w1[i]) if s < 0 else 0.0
    delta = 0.0
    if W > 0:
        low, high = (S - kappa) / W, (S + kappa) / W
        delta = min(max(0.0, low), high)
        for _ in range(200):
            up, falls_up = threshold(a, above, max(kappa - S + delta * W, 0.0))
            down, falls_down = threshold(a, below, max(kappa + S - delta * W, 0.0))
            excess = up - down - delta
            if excess > 0:
                low = delta
            elif excess < 0:
                high = delta
            step = excess / (1 + W * (falls_up + falls_down))
            if abs(step) <= 1e-16 * max(abs(delta), 1e-300):
                break
            moved = delta + step
            moved = (low + high) / 2 if not low <= moved <= high else moved
            if moved == delta:
                break
            delta = moved
    up = threshold(a, above, max(kappa - S + delta * W, 0.0))[0]
    down = threshold(a, below, max(kappa + S - delta * W, 0.0))[0]
    for i in range(n):
        shift = min(abs(a[i]), up * above[i] + down * below[i])
        a[i] = a[i] - (delta * w1[i] if side[i] > 0 else 0.0) - (shift if a[i] > 0 else -shift)
    total = 0.0
    for i in range(n):
        total += abs(a[i] * w1[i])
    scale(a, w1, 0, box_rate(weights, n, bounds, side) + 4 * n * np.finfo(a.dtype).eps * total, kappa)
