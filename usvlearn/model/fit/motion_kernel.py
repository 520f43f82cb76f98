"""Missions simulated with the parameters of `terms`, with their sensitivities, compiled.

The state of a mission is x = (w, c_N, c_E): the speed through the water and a constant current. w follows the step of
`usvlearn.model.surge`, (2), without noise; the commands are

    ξ = u + μ (u_before − u),   or with a thruster of time constant τ, from its state a,                (1)
    ξ = u + (a − u) (τ/h)(1 − e^(−h/τ)),   a⁺ = u + (a − u) e^(−h/τ)

v = w + c_N cos ψ + c_E sin ψ is measured. w at the start of a segment and the current are not parameters: a Kalman
filter without process noise has them, and is told each speed. Once it knows them its gain is 0, and the simulation is
an open loop. With the innovation e, its variance S and the sensitivity J = ∂v/∂θ (the gain is taken as known), a
mission has

    loss = ½ Σ (ρ(e²/S) + log S),   g = −Σ ω e J/S,   H = Σ ω J Jᵀ/S                                   (2)

with Huber's ρ, quadratic up to `robust` deviations and linear beyond, and its weight ω (Huber 1964).

The derivation is in `docs/theory/identification.md#batch-fit-simulation`.
"""

import numpy as np

from usvlearn.core.arrays import fill
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import COS, DT, HOLD, LEARN, LEFT, MODE, RIGHT, SIN, START, SURGE, YAW_RATE
from usvlearn.estimators.regressors.kernel import phi1
from usvlearn.model.fit.terms import (
    AT,
    DRAG_NODES,
    NAMES,
    PLACE_DRAG,
    PLACE_LAG,
    PLACE_THRUST,
    PLACE_TIME,
    THRUST_NODES,
)

SPEED_VARIANCE = 4.0  # (m/s)², of the speed through the water before a measurement
REST = 1e-3  # of u_L² + u_R² + w²: below, friction holds the boat, and nothing is learned
FASTEST = 20.0  # m/s
STEEPEST = -500.0  # of hJ: a fit may try parameters that are far off
DRAG, SIDE, KAPPA, EVEN, PARAMETERS = 3, 3, AT["thrust_cubic_left"], AT["drag_even"], len(NAMES)
THRUSTS, DRAGS = len(THRUST_NODES), len(DRAG_NODES)
APART, DRAG_APART = float(THRUST_NODES[0]), float(DRAG_NODES[0])


@jit
def commanded(theta, now, before, state, h):
    """ξ of (1), its derivatives to μ and τ, and the thruster's state a⁺ with its derivative to τ.

    Args:
        theta: parameters.
        now, before: u of the step and of that before it.
        state: a and its derivative to τ.
        h: s.
    """
    tau, mu = theta[PLACE_TIME], theta[PLACE_LAG]
    if tau > 0:
        a, slope = state
        share = np.exp(-h / tau)
        mean, by_tau = tau / h * (1 - share), (1 - share) / h - share / tau
        xi, d_tau = now + (a - now) * mean, slope * mean + (a - now) * by_tau
        return xi, 0.0, d_tau, (now + (a - now) * share, slope * share + (a - now) * share * h / (tau * tau))
    return now + mu * (before - now), before - now, 0.0, state


@jit
def hat(size, apart, count):
    """The index of the node above `size`, and its share; beyond the last node the line goes on."""
    k = int(size / apart) if size < apart * count else count - 1  # NaN too
    return k, size / apart - k


@jit
def sides(theta, w, xi, W, V):
    """Write what both sides add to W = ∂f/∂θ and V = ∂J/∂θ; returns ∂f/∂ξ and ∂J/∂ξ of each."""
    speed, sign = abs(w), 1.0 if w >= 0 else -1.0
    slopes = (0.0, 0.0)
    bends = (0.0, 0.0)
    for side in range(2):
        x = xi[side]
        size, way, k, e = abs(x), 1.0 if x >= 0 else -1.0, DRAG + SIDE * side, EVEN + 1 + SIDE * side
        W[k], W[k + 1], W[k + 2], V[k + 2] = x, x * size, x * speed, x * sign
        W[KAPPA + side] = x * x * x
        W[e], W[e + 1], W[e + 2], V[e + 2] = size, x * x, x * w, x
        slope = theta[k] + 2 * theta[k + 1] * size + theta[k + 2] * speed + 3 * theta[KAPPA + side] * x * x
        slope += theta[e] * way + 2 * theta[e + 1] * x + theta[e + 2] * w
        above, part = hat(size, APART, THRUSTS)
        node = PLACE_THRUST + THRUSTS * (2 * side + (0 if x >= 0 else 1)) + above
        W[node] = part * way
        slope += theta[node] / APART
        if above > 0:
            W[node - 1] = (1 - part) * way
            slope -= theta[node - 1] / APART
        bend = theta[k + 2] * sign + theta[e + 2]
        slopes = (slope, slopes[1]) if side == 0 else (slopes[0], slope)
        bends = (bend, bends[1]) if side == 0 else (bends[0], bend)
    return slopes, bends


@jit
def moved(theta, top, w, xi, late, slow, h, turn, W, V, gradient):
    """w⁺, and ∂w⁺/∂w; writes ∂w⁺/∂θ into `gradient`.

    Args:
        theta: parameters of `terms.NAMES`, per unit mass.
        top: top speed, m/s.
        w: speed through the water, m/s.
        xi: of both sides.
        late, slow: derivatives of both ξ to μ and τ.
        h: s.
        turn: |r|, rad/s.
        W, V: memory, `(parameters,)`.
    """
    speed, sign = abs(w), 1.0 if w >= 0 else -1.0
    fill(W, 0.0)
    fill(V, 0.0)
    W[0], W[1], W[2], W[EVEN] = speed * w, w, turn * w, w * w
    V[0], V[1], V[2], V[EVEN] = 2 * speed, 1.0, turn, 2 * w
    slopes, bends = sides(theta, w, xi, W, V)
    above, part = hat(speed / top, DRAG_APART, DRAGS)
    node, steep = PLACE_DRAG + above, 1 / (DRAG_APART * top)
    W[node], V[node] = part * sign, steep
    if above > 0:
        W[node - 1], V[node - 1] = (1 - part) * sign, -steep
    f = 0.0
    J = 0.0
    for i in range(PLACE_LAG):
        f += W[i] * theta[i]
        J += V[i] * theta[i]
    z = h * J
    inside = STEEPEST < z < 1
    value, slope = phi1(min(max(z, STEEPEST), 1.0))
    by_f, by_J = h * value, h * h * slope * f if inside else 0.0
    for i in range(PLACE_LAG):
        gradient[i] = by_f * W[i] + by_J * V[i]
    gradient[PLACE_LAG] = by_f * (slopes[0] * late[0] + slopes[1] * late[1]) + by_J * (
        bends[0] * late[0] + bends[1] * late[1]
    )
    gradient[PLACE_TIME] = by_f * (slopes[0] * slow[0] + slopes[1] * slow[1]) + by_J * (
        bends[0] * slow[0] + bends[1] * slow[1]
    )
    return w + by_f * f, 1 + by_f * J + by_J * 2 * (theta[0] * sign + theta[EVEN])


@jit
def gained(x, P, S, c, s, error, variance):
    """The measurement update of x, P and S = ∂x/∂θ, with the variance of the innovation; row 3 of P is memory."""
    for i in range(3):
        P[3, i] = (P[i, 0] + c * P[i, 1] + s * P[i, 2]) / variance
        x[i] += P[3, i] * error
    for j in range(S.shape[1]):
        seen = S[0, j] + c * S[1, j] + s * S[2, j]
        for i in range(3):
            S[i, j] -= P[3, i] * seen
    first = P[0, 0] + c * P[1, 0] + s * P[2, 0]
    second, third = P[0, 1] + c * P[1, 1] + s * P[2, 1], P[0, 2] + c * P[1, 2] + s * P[2, 2]
    for i in range(3):
        P[i, 0] -= P[3, i] * first
        P[i, 1] -= P[3, i] * second
        P[i, 2] -= P[3, i] * third


@jit(entry=True)
def mission(rows, theta, active, top, noise, current, robust, predictions, score, information, work, P, S):
    """One mission: its loss and its number of measured steps, with (2); writes each step's speed, m/s.

    Args:
        rows: prepared samples, `(time, ROW)`.
        theta: parameters, `(PARAMETERS,)`.
        active: places of the fitted ones, `(m,)`.
        top: top speed, m/s.
        noise: variance of a speed, (m/s)².
        current: prior deviation of a component of the current, m/s.
        robust: deviations from which on an innovation counts less.
        predictions: `(time,)`, is written: NaN where no step is made.
        score: g of (2), `(m,)`, is added to.
        information: H of (2), `(m, m)`, its lower half is added to; of shape (0, 0) where it is not wanted.
        work: memory, `(3 PARAMETERS + m + 3,)`; its last three are x at the end.
        P, S: memory, `(4, 3)` and `(3, m)`.
    """
    m, wanted = len(active), len(information) > 0
    W, V, gradient = work[:PARAMETERS], work[PARAMETERS : 2 * PARAMETERS], work[2 * PARAMETERS : 3 * PARAMETERS]
    J, x = work[3 * PARAMETERS : 3 * PARAMETERS + m], work[3 * PARAMETERS + m :]
    fill(x, 0.0)
    for i in range(3):
        fill(P[i], 0.0)
        fill(S[i], 0.0)
        P[i, i] = SPEED_VARIANCE if i == 0 else current * current
    loss, count, opened, begins = 0.0, 0.0, 0.0, False
    left, right = (0.0, 0.0), (0.0, 0.0)  # the state of each thruster, and its derivative to τ
    left_before, right_before = 0.0, 0.0
    for k in range(len(rows)):
        row = rows[k]
        mode, h, c, s = row[MODE], row[DT], row[COS], row[SIN]
        predictions[k] = np.nan
        if mode == START:
            opened, begins = row[SURGE], True
            continue
        if mode == HOLD:  # nothing is known of the motion meanwhile
            for i in range(3):
                P[0, i] = P[i, 0] = 0.0
            fill(S[0], 0.0)
            P[0, 0], begins = SPEED_VARIANCE, False
            left_before, right_before = np.nan, np.nan
            continue
        if begins:
            begins = False
            for i in range(3):
                P[0, i] = P[i, 0] = 0.0
            P[0, 0] = SPEED_VARIANCE
            x[0] = opened - c * x[1] - s * x[2]
            fill(S[0], 0.0)
            total = P[0, 0] + c * c * P[1, 1] + s * s * P[2, 2] + 2 * c * s * P[1, 2] + noise
            gained(x, P, S, c, s, 0.0, total)
            left_before = np.nan
        if not left_before == left_before:  # a new segment: the commands were those of its first step
            left_before, right_before = row[LEFT], row[RIGHT]
            left, right = (row[LEFT], 0.0), (row[RIGHT], 0.0)
        rests = row[LEFT] * row[LEFT] + row[RIGHT] * row[RIGHT] + x[0] * x[0] <= REST
        xi_left, late_left, slow_left, left = commanded(theta, row[LEFT], left_before, left, h)
        xi_right, late_right, slow_right, right = commanded(theta, row[RIGHT], right_before, right, h)
        left_before, right_before = row[LEFT], row[RIGHT]
        speed, through = moved(
            theta, top, x[0], (xi_left, xi_right), (late_left, late_right), (slow_left, slow_right), h,
            abs(row[YAW_RATE]), W, V, gradient,
        )  # fmt: skip
        x[0] = min(max(speed, -FASTEST), FASTEST)
        for j in range(m):
            S[0, j] = through * S[0, j] + (0.0 if rests else gradient[active[j]])
        P[0, 1], P[0, 2] = through * P[0, 1], through * P[0, 2]
        P[1, 0], P[2, 0], P[0, 0] = P[0, 1], P[0, 2], through * through * P[0, 0]
        predictions[k] = x[0] + c * x[1] + s * x[2]
        if mode != LEARN:
            continue
        error = row[SURGE] - predictions[k]
        total = noise + P[0, 0] + 2 * c * P[0, 1] + 2 * s * P[0, 2]
        total += c * c * P[1, 1] + s * s * P[2, 2] + 2 * c * s * P[1, 2]
        if not total > 0:  # parameters of an unstable motion
            return np.inf, count
        size = np.sqrt(error * error / total)
        weight = 1.0 if size <= robust else robust / size
        if not rests:
            loss += 0.5 * (np.log(total) + (size * size if size <= robust else (2 * size - robust) * robust))
            count += 1
            if wanted:
                share = weight / total
                for i in range(m):
                    J[i] = S[0, i] + c * S[1, i] + s * S[2, i]
                    score[i] -= share * error * J[i]
                for i in range(m):
                    by = share * J[i]
                    for j in range(i + 1):
                        information[i, j] += by * J[j]
        gained(x, P, S, c, s, error, total / (weight * weight))
    return loss, count
