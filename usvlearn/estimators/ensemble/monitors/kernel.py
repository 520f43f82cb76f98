"""The monitors of an ensemble: `layer.observe`, in place. Numbers in parentheses are equations of `state`."""

import numpy as np

from usvlearn.core.arrays import clamp, fill
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import COS, DT, LEFT, RIGHT, SIN, SURGE, YAW_RATE
from usvlearn.estimators.ensemble.monitors.state import (
    APART,
    AT,
    BEGUN,
    BLOCK,
    LAGGED,
    LAST,
    LEVEL,
    LEVELS,
    MARGIN,
    NINETY,
    RAISED,
    REMEMBERED,
    ROUNDING,
    SIGNIFICANT,
    SLOW,
    SLOWLY,
    SQUARE,
    SURGES,
    THRUST,
    VARIANCE,
    YAW,
    Number,
)


@jit
def observe_innovations(node, s, q, innovation):
    """Whiteness: (1) and (2)."""
    k, q, at = node[Row.SIZE], q[node[Row.NUMBERS] :], AT.innovations
    moments = s[node[at.moments] : node[at.moments] + 4 * k].reshape(k, 4)
    scales, last = s[node[at.scale] : node[at.scale] + k], s[node[at.last] : node[at.last] + k]
    share, huber = 1 / q[Number.INNOVATION_MEMORY], q[Number.HUBER] * q[Number.HUBER]
    for i in range(k):
        e = innovation[i]
        if not np.isfinite(e):
            continue
        scale = scales[i]
        clipped = clamp(e, 3 * np.sqrt(scale))
        squared = min(e * e, huber * scale)
        scales[i] = max(
            scale + q[Number.HUBER_RATE] * (squared / q[Number.HUBER_MEAN] - scale), q[Number.LEAST_SCALE]
        )  # (2)
        row = moments[i]
        row[0] += share * (1.0 - row[0])
        row[1] += share * (clipped - row[1])
        row[2] += share * (clipped * clipped - row[2])
        row[3] += share * (clipped * last[i] - row[3])
        last[i] = clipped


@jit
def factor(moments, ridge, L, theta):
    """ϑ of (4) into `theta`, and the Cholesky factor of Σ w x xᵀ + R into `L`; its diagonal holds the inverse."""
    n, share = len(theta), ROUNDING * np.finfo(moments.dtype).eps * moments[1, 1]
    for i in range(n):
        for j in range(i + 1):
            total = moments[i + 1, j + 1]
            if i == j:
                total += max(ridge, share * total)  # (7)
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j and not total > 0:
                fill(theta, 0.0)
                return
            L[i, j] = 1.0 / np.sqrt(total) if i == j else total * L[j, j]
    for i in range(n):
        one = moments[i + 1, 0]
        for k in range(i):
            one -= L[i, k] * theta[k]
        theta[i] = one * L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            theta[i] -= L[k, i] * theta[k]
        theta[i] *= L[i, i]


@jit
def judge(theta, L, errors, q, z, yaw, effects, solved):
    """Error of z[0] by (3) and (4), and what each side and both have made of it, into `effects`.

    Also: 1/σ of (5), the share of the errors' information that their colour leaves, and the slow error of (8).
    """
    n, x, e, leverage, misfit = len(z) - 1, z[1:], z[0], 0.0, 0.0
    for i in range(n):
        e -= x[i] * theta[i]
        one = x[i]
        for k in range(i):
            one -= L[i, k] * solved[k]
        solved[i] = one * L[i, i]
        leverage += solved[i] * solved[i]
    for side in range(2):
        k = THRUST + side
        effects[side] = x[k] * theta[k] + x[k + 2] * theta[k + 2] + x[k + 4] * theta[k + 4]
        full = abs(theta[k] + theta[k + 2] + theta[k + 4])
        misfit += full * (full if yaw else abs(effects[side]))
    effects[2] = effects[0] + effects[1]
    variance = (1 + q[Number.HORIZON] * leverage) * errors[VARIANCE] + 0.5 * q[Number.MISFIT] ** 2 * misfit
    colour = clamp(errors[LAGGED] / errors[SQUARE], 0.95) if errors[LAGGED] > 0 else 0.0
    return e, 1 / np.sqrt(variance), (1 - colour) / (1 + colour), q[Number.SLOWNESS] * np.sqrt(errors[LEVELS])


@jit
def learn_model(moments, errors, q, z, e, floor, calm, keep, seconds):
    """The sums of (4), lower half, and the statistics of its errors; z lasted some seconds."""
    variance, square = errors[VARIANCE], e * e
    light = variance / (variance + square / (q[Number.KNEE] * q[Number.KNEE]))
    weight, share = calm * np.sqrt(light), min(calm * seconds / SLOWLY, 1.0) if moments[1, 1] > BEGUN else 0.0
    for i in range(len(z)):
        for j in range(i + 1):
            moments[i, j] = keep * moments[i, j] + weight * z[i] * z[j]
    moved = variance + calm * q[Number.YAW_RATE] * (square * light * q[Number.YAW_SPREAD] - variance)
    errors[VARIANCE] = max(moved, floor)
    e = clamp(e, 3 * np.sqrt(errors[VARIANCE]))
    errors[SQUARE] += share * (e * e - errors[SQUARE])
    errors[LAGGED] += share * (e * errors[LAST] - errors[LAGGED])
    errors[LAST] = e
    errors[LEVEL] += min(calm * seconds / SLOW, 1.0) * (e - errors[LEVEL])
    errors[LEVELS] += share * (errors[LEVEL] * errors[LEVEL] - errors[LEVELS])
    return square * light


@jit
def gather(sums, q, k, effect, e, precision, colour, slow, g):
    """One sample of (5), (6) and (8) for a hypothesis: of the yaw rate (k = 0) or the surge (1). Returns g."""
    precision *= min(q[Number.CLIP] / max(abs(effect) * precision, 1e-9), 1.0)
    f, loss = effect * precision, q[Number.LOSS]
    moment, weight = colour * f * clamp(e * precision, q[Number.CLIP]), colour * f * f
    g = min(max(g - loss * moment - 0.5 * loss * loss * weight, 0.0), 2 * q[Number.THRESHOLD])
    old = min(REMEMBERED / (sums[1] + weight), 1.0) if weight > 0 else 1.0
    for i in range(4):
        sums[i] *= old
    sums[0] += moment
    sums[1] += weight
    sums[2 + k] += colour * f * precision * slow
    if not g > 0 or not 1 + sums[0] / (sums[1] + q[Number.DOUBT]) > q[Number.BACKWARDS]:
        fill(sums, 0.0)
        g = 0.0
    return g


@jit
def observe_thrusters(node, s, q, inputs, work):
    """The evidence against each thruster, and against both: (3) to (8)."""
    q, at, n = q[node[Row.NUMBERS] :], AT.thrusters, 1 + YAW
    yaws, root = s[node[at.moments] : node[at.moments] + n * n].reshape(n, n), s[node[at.root] :][: YAW * YAW]
    theta, errors, before = s[node[at.theta] :], s[node[at.errors] :], s[node[at.before] :]
    block, explained, raised = s[node[at.block] :], s[node[at.explained] :], s[node[at.raised] :]
    evidence, sums = s[node[at.evidence] :], s[node[at.sums] :][:12].reshape(3, 4)
    z, effects, rest = work[:n], work[n : n + 3], work[n + 3 :]
    dt, rate, left, right = inputs[DT], inputs[YAW_RATE], inputs[LEFT], inputs[RIGHT]
    doubt = max(max(evidence[0], evidence[1]), evidence[2])
    calm = 0.0 if raised[0] + raised[1] > 0 else np.exp(-doubt / q[Number.CALM])  # the models are of a whole boat
    keep = np.exp(-min(abs(left) + abs(right), 1.0) * dt / q[Number.YAW_MEMORY])  # only thrust makes it forget
    z[0], z[1], z[2], z[3], z[4], z[5] = rate, 1.0, before[0], before[1], left, right
    z[6], z[7], z[8], z[9] = left * abs(left), right * abs(right), left * left * left, right * right * right
    e, precision, colour, slow = judge(theta, root.reshape(YAW, YAW), errors, q, z, True, effects, rest)
    power = yaws[4, 4] + yaws[5, 5]
    tells = power - 2 * yaws[5, 4] > APART * power and explained[0] < (1 - q[Number.EXPLAINED]) * explained[1]
    tells = tells and errors[LAGGED] < q[Number.COLOURED] * errors[SQUARE]
    for side in range(2 if tells else 0):
        rest_of = e + gone(raised, s[node[at.share] :], effects, 1 - side)
        evidence[side] = gather(sums[side], q, 0, effects[side], rest_of, precision, colour, slow, evidence[side])
    made, share = e + effects[2], min(calm * dt / SLOWLY, 1.0)
    square = learn_model(yaws, errors, q, z, e, q[Number.YAW_FLOOR], calm, keep, dt)
    explained[0] += share * (square - explained[0])
    explained[1] += share * (made * made - explained[1])
    before[1], before[0] = before[0], rate
    block[0] += dt
    turned = inputs[SIN] * inputs[SIN] + inputs[COS] * inputs[COS] < 1.01  # else sine and cosine are not computed
    block[1], block[2] = block[1] + dt * left, block[2] + dt * right
    block[3], block[4] = block[3] + dt * left * abs(left), block[4] + dt * right * abs(right)
    block[5], block[6] = block[5] + dt * left * left, block[6] + dt * right * right
    block[7] += dt * abs(rate)
    if turned:
        block[8], block[9] = block[8] + dt * inputs[COS], block[9] + dt * inputs[SIN]
    if block[0] >= BLOCK - 1e-3:
        observe_surge(node, s, q, inputs[SURGE], calm, work)
        factor(yaws, q[Number.YAW_RIDGE], root.reshape(YAW, YAW), theta[:YAW])
    alarm = decide(node, s, q, evidence, sums, dt, tells)
    s[node[at.alarms]] += alarm
    s[node[at.since]] = (s[node[at.since]] + dt) * (1 - alarm)


@jit
def observe_surge(node, s, q, surge, calm, work):
    """The evidence of a speed at the end of a block, which then begins anew."""
    at, n = AT.thrusters, 1 + SURGES
    surges, errors = s[node[at.surges] : node[at.surges] + n * n].reshape(n, n), s[node[at.errors] + 6 :]
    before, block, raised = s[node[at.before] + 2 :], s[node[at.block] :][: SURGES - 2], s[node[at.raised] :]
    evidence, sums = s[node[at.evidence] :], s[node[at.sums] :][:12].reshape(3, 4)
    x, effects, theta, rest = work[:n], work[n : n + 3], work[n + 3 : 2 * n + 2], work[2 * n + 2 :]
    L = rest[SURGES : SURGES + SURGES * SURGES].reshape(SURGES, SURGES)
    x[0], x[1], x[2], x[3] = surge, 1.0, before[0], before[0] * abs(before[0])
    for i in range(1, SURGES - 2):
        x[3 + i] = block[i] / block[0]
    x[10] *= before[0]
    factor(surges, q[Number.YAW_RIDGE], L, theta)
    e, precision, colour, slow = judge(theta, L, errors, q, x, False, effects, rest)
    for k in range(3):
        if k == 2 and raised[0] + raised[1] > 0 and not s[node[at.together]] > 0:
            forget(evidence, sums, 2)
            continue
        rest_of = e + (gone(raised, s[node[at.share] :], effects, 1 - k) if k < 2 else 0.0)
        evidence[k] = gather(sums[k], q, 1, effects[k], rest_of, precision, colour, slow, evidence[k])
    keep = np.exp(-min(abs(x[4]) + abs(x[5]), 1.0) * block[0] / q[Number.YAW_MEMORY])
    learn_model(surges, errors, q, x, e, q[Number.SURGE_FLOOR], calm, keep, block[0])
    fill(block, 0.0)
    before[0] = surge


@jit
def gone(raised, share, effects, side):
    """What the loss of a side, as far as it is known, has taken from z of (3)."""
    return (1 - share[side]) * effects[side] if raised[side] > 0 else 0.0


@jit
def forget(evidence, sums, k):
    """No evidence for a hypothesis any more."""
    evidence[k] = 0.0
    fill(sums[k], 0.0)


@jit
def effectiveness(q, sums):
    """(6) and (8) of a hypothesis."""
    weight = sums[1] + q[Number.DOUBT]
    return 1 + sums[0] / weight, np.sqrt(1 / weight + (sums[2] * sums[2] + sums[3] * sums[3]) / (weight * weight))


@jit
def decide(node, s, q, evidence, sums, dt, tells):
    """Which alarms are on, and the effectiveness of the sides; returns 1 where the first begins, else 0."""
    at = AT.thrusters
    raised, share, deviation = s[node[at.raised] :], s[node[at.share] :], s[node[at.deviation] :]
    held, together, before = s[node[at.held] :], s[node[at.together] :], raised[0] + raised[1] > 0
    for k in range(3):
        value, spread = effectiveness(q, sums[k])
        on = together[0] > 0 if k == 2 else raised[k] > 0 and not together[0] > 0
        if on:
            stays = evidence[k] > q[Number.CLEARED] * q[Number.THRESHOLD] and value + NINETY * spread < 1
            held[k] = 0.0 if stays else held[k] + dt
            if held[k] >= q[Number.LEAVE] or not evidence[k] > 0:
                held[k] = 0.0
                for side in range(2):
                    if k == 2 or k == side:
                        raised[side] = 0.0
                        forget(evidence, sums, side)
                if k == 2:
                    together[0] = 0.0
                    forget(evidence, sums, 2)
            continue
        least, hold = q[Number.THRESHOLD], q[Number.HOLD]
        if k == 2:
            least, hold = q[Number.BOTH], q[Number.WAITS] if tells else hold
            lost = not raised[0] + raised[1] > 0
        else:
            alone = raised[1 - k] > 0 and not together[0] > 0
            hold = q[Number.WAITS] if alone else hold
            rival = evidence[1 - k] if tells else max(evidence[1 - k], evidence[2]) + 2 * MARGIN
            lost = alone or evidence[k] > rival + MARGIN
        lost = lost and evidence[k] > least and value + RAISED * spread < 1
        held[k] = held[k] + dt if lost else 0.0
        if held[k] >= hold:
            held[k] = 0.0
            if k == 2:
                together[0] = raised[0] = raised[1] = 1.0
            else:
                if together[0] > 0:
                    together[0] = raised[1 - k] = 0.0
                raised[k] = 1.0
    for side in range(2):
        k = 2 if together[0] > 0 else side
        value, deviation[side] = effectiveness(q, sums[k])
        share[side] = value if raised[side] > 0 or evidence[k] > SIGNIFICANT else 1.0
    return 1.0 if raised[0] + raised[1] > 0 and not before else 0.0
