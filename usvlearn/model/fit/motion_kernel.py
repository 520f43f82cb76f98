"""Missions simulated with the parameters of `terms`, with their sensitivities, compiled.

Equations (1) and (2): `docs/theory/identification.md#batch-fit-simulation`; g, H and J are ∇L, Φ and X there. What
multiplies γ |w| and e₃ w, Σ γ ξ and Σ e₃ ξ, follows as the thrust does. Relative to σ², a step that the simulation
takes as one at rest hardly changes the loss.
"""

import numpy as np

from usvlearn.core.arrays import copy, fill
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
def followed(now, late, state, tau, h):
    """T̄ of (1) with its derivatives to μ and τ, and a⁺ with its own; `late` is ∂T/∂μ, `state` is a with both."""
    share = np.exp(-h / tau)
    mean, apart, apart_late = tau / h * (1 - share), state[0] - now, state[1] - late
    by_tau = state[2] * mean + apart * ((1 - share) / h - share / tau)
    after = now + apart * share, late + apart_late * share, (state[2] + apart * h / (tau * tau)) * share
    return now + apart * mean, late + apart_late * mean, by_tau, after


@jit
def hat(size, apart, count):
    """The index of the node above `size`, and its share; beyond the last node the line goes on."""
    k = int(size / apart) if size < apart * count else count - 1  # NaN too
    return k, size / apart - k


@jit
def pushed(theta, xi, late, W):
    """What both commands add: T, and the factors of |w| and w, with their derivatives along `late`; writes ∂T/∂θ."""
    T, by_speed, by_w, T_late, speed_late, w_late = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for side in range(2):
        x, k, e = xi[side], DRAG + SIDE * side, EVEN + 1 + SIDE * side
        size, way, cubic, kappa = abs(x), 1.0 if x >= 0 else -1.0, x * x * x, KAPPA + side
        above, part = hat(size, APART, THRUSTS)
        node = PLACE_THRUST + THRUSTS * (2 * side + (0 if x >= 0 else 1)) + above
        below = theta[node - 1] if above > 0 else 0.0
        W[k], W[k + 1], W[kappa], W[e], W[e + 1], W[node] = x, x * size, cubic, size, x * x, part * way
        if above > 0:
            W[node - 1] = (1 - part) * way
        T += theta[k] * x + theta[k + 1] * x * size + theta[kappa] * cubic + theta[e] * size + theta[e + 1] * x * x
        T += way * (part * theta[node] + (1 - part) * below)
        slope = theta[k] + 2 * theta[k + 1] * size + 3 * theta[kappa] * x * x + theta[e] * way + 2 * theta[e + 1] * x
        T_late += (slope + (theta[node] - below) / APART) * late[side]
        by_speed, speed_late = by_speed + theta[k + 2] * x, speed_late + theta[k + 2] * late[side]
        by_w, w_late = by_w + theta[e + 2] * x, w_late + theta[e + 2] * late[side]
    return (T, by_speed, by_w), (T_late, speed_late, w_late)


@jit
def moved(theta, top, w, push, late, slow, h, turn, W, V, gradient):
    """w⁺, m/s, and ∂w⁺/∂w; writes ∂w⁺/∂θ into `gradient` where that has a place.

    `push` is of `pushed`, as it acts, `late` and `slow` are its derivatives to μ and τ, `turn` is |r|. W is ∂T/∂θ as it
    acts, 0 elsewhere, and is written; V is memory.
    """
    speed, sign = abs(w), 1.0 if w >= 0 else -1.0
    above, part = hat(speed / top, DRAG_APART, DRAGS)
    node, steep = PLACE_DRAG + above, 1 / (DRAG_APART * top)
    below = theta[node - 1] if above > 0 else 0.0
    f = push[0] + push[1] * speed + (push[2] + theta[0] * speed + theta[1] + theta[2] * turn + theta[EVEN] * w) * w
    f += sign * (part * theta[node] + (1 - part) * below)
    J = push[1] * sign + push[2] + 2 * theta[0] * speed + theta[1] + theta[2] * turn + 2 * theta[EVEN] * w
    J += steep * (theta[node] - below)
    z = h * J
    inside = STEEPEST < z < 1
    value, slope = phi1(min(max(z, STEEPEST), 1.0))
    by_f, by_J = h * value, h * h * slope * f if inside else 0.0
    if len(gradient) > 0:
        fill(V, 0.0)
        W[0], W[1], W[2], W[EVEN] = speed * w, w, turn * w, w * w
        V[0], V[1], V[2], V[EVEN] = 2 * speed, 1.0, turn, 2 * w
        for side in range(2):
            k, e = DRAG + SIDE * side, EVEN + 1 + SIDE * side
            W[k + 2], V[k + 2], W[e + 2], V[e + 2] = W[k] * speed, W[k] * sign, W[k] * w, W[k]
        fill(W[PLACE_DRAG:], 0.0)
        W[node], V[node] = part * sign, steep
        if above > 0:
            W[node - 1], V[node - 1] = (1 - part) * sign, -steep
        for i in range(PLACE_LAG):
            gradient[i] = by_f * W[i] + by_J * V[i]
        for place, by in ((PLACE_LAG, late), (PLACE_TIME, slow)):
            gradient[place] = by_f * (by[0] + by[1] * speed + by[2] * w) + by_J * (by[1] * sign + by[2])
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
        active: places of the fitted parameters, `(m,)`.
        noise, current: variance of a speed, and prior deviation of a component of the current, m/s.
        robust: deviations from which on an innovation counts less.
        predictions: `(time,)`, is written: NaN where no step is made.
        score: g of (2), `(m,)`, is added to.
        information: H of (2), `(m, m)`, its lower half is added to; of shape (0, 0) where it is not wanted.
        work, P, S: memory, `(4 PARAMETERS + m + 3,)`, the last three of which are x at the end, `(4, 3)`, `(3, m)`.
    """
    m, wanted = len(active), len(information) > 0
    W, V, A = work[:PARAMETERS], work[PARAMETERS : 2 * PARAMETERS], work[2 * PARAMETERS : 3 * PARAMETERS]
    gradient, J, x = work[3 * PARAMETERS : (4 if m > 0 else 3) * PARAMETERS], work[4 * PARAMETERS : -3], work[-3:]
    fill(x, 0.0)
    for i in range(3):
        fill(P[i], 0.0)
        fill(S[i], 0.0)
        P[i, i] = SPEED_VARIANCE if i == 0 else current * current
    loss, count, opened, begins = 0.0, 0.0, 0.0, False
    left_before, right_before, mu, tau, none = 0.0, 0.0, theta[PLACE_LAG], theta[PLACE_TIME], (0.0, 0.0, 0.0)
    thrust, by_speed, by_w = none, none, none  # a of (1), and its derivatives to μ and τ
    fill(A, 0.0)
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
        opens = not left_before == left_before  # a new segment: the commands were those of its first step
        if opens:
            left_before, right_before = row[LEFT], row[RIGHT]
        rests = row[LEFT] * row[LEFT] + row[RIGHT] * row[RIGHT] + x[0] * x[0] <= REST
        away = left_before - row[LEFT], right_before - row[RIGHT]
        left_before, right_before = row[LEFT], row[RIGHT]
        if m > 0:
            fill(W, 0.0)
        push, late = pushed(theta, (row[LEFT] + mu * away[0], row[RIGHT] + mu * away[1]), away, W)
        slow = none
        if tau > 0:
            if opens:
                thrust = push[0], late[0], 0.0
                by_speed, by_w = (push[1], late[1], 0.0), (push[2], late[2], 0.0)
                copy(A, W)
            first, first_late, first_slow, thrust = followed(push[0], late[0], thrust, tau, h)
            second, second_late, second_slow, by_speed = followed(push[1], late[1], by_speed, tau, h)
            third, third_late, third_slow, by_w = followed(push[2], late[2], by_w, tau, h)
            push, late = (first, second, third), (first_late, second_late, third_late)
            slow = first_slow, second_slow, third_slow
            if m > 0:
                share = np.exp(-h / tau)
                mean = tau / h * (1 - share)
                for i in range(PLACE_DRAG):
                    apart = A[i] - W[i]
                    W[i], A[i] = W[i] + apart * mean, W[i] + apart * share
        speed, through = moved(theta, top, x[0], push, late, slow, h, abs(row[YAW_RATE]), W, V, gradient)
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
            loss += 0.5 * (np.log(total / noise) + (size * size if size <= robust else (2 * size - robust) * robust))
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
