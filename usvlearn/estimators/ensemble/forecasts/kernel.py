"""Forecasts over several horizons: the parts that step no member, equations (1) to (3) of `state`.

`known` is the row of a `HorizonState`, and `knows` says whether intervals know the manoeuvre; else it is another row.
"""

import numpy as np

from usvlearn.core.arrays import whole
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.estimators.ensemble.combiners.kernel import bernstein
from usvlearn.estimators.ensemble.conformal.state import FEW
from usvlearn.estimators.ensemble.forecasts.state import (
    AT,
    BEYOND,
    DELAY,
    LEAST,
    MOST,
    NARROWEST,
    SHARE,
    STEP,
    Choice,
    Number,
    Vector,
)
from usvlearn.estimators.ensemble.manoeuvre_intervals.kernel import (
    begin_path,
    extend_path,
    group_of,
    halfwidth_held,
    halfwidth_now,
    hold,
    learn_error,
    moves_of,
)
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import AT as KNOWN
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import DUE, FAR, GROUPS, HELD, PATH


@jit
def weights_after(node, s, q, time, weights):
    """Write the weights of a forecast over `time`, s."""
    H, M = node[Choice.HORIZONS], node[Choice.MEMBERS]
    k, rise = between(node, q, time)
    below = s[node[AT.rule.weights] + judged(node, s, k) * M :]
    above = s[node[AT.rule.weights] + judged(node, s, min(k + 1, H - 1)) * M :]
    for m in range(M):
        weights[m] = (1 - rise) * below[m] + rise * above[m] if rise > 0 else below[m]


@jit
def between(node, q, time):
    """The horizon before a time, s, and the share of the next one in it."""
    H, horizons = node[Choice.HORIZONS], q[node[Vector.HORIZONS] :]
    k = 0
    while k + 1 < H and horizons[k + 1] <= time:
        k += 1
    if k + 1 < H and time > horizons[k]:
        return k, (time - horizons[k]) / (horizons[k + 1] - horizons[k])
    return k, 0.0


@jit
def halfwidth_after(node, known, knows, s, q, time, weights, x, surge, path):
    """The half-width, m/s, of members' predictions x and their forecast after a time, s, on a path of the commands."""
    if time > q[node[Vector.HORIZONS] + node[Choice.HORIZONS] - 1] * BEYOND:
        return np.inf
    k, rise = between(node, q, time)
    spread = spread_of(weights, x, surge, node[Choice.MEMBERS]) if knows else 0.0
    width = halfwidth_on(node, known, knows, s, k, spread, path)
    return (1 - rise) * width + rise * halfwidth_on(node, known, knows, s, k + 1, spread, path) if rise > 0 else width


@jit
def halfwidth_on(node, known, knows, s, k, spread, path):
    """The half-width over the horizon k, of the present state."""
    width = halfwidth(node, s, k)
    if not knows:
        return width
    at = known[KNOWN.learned.coefficients :]
    return halfwidth_now(s, at, k, s[node[AT.errors] + k], width, spread, path[FAR], group_of(path))


@jit
def spread_of(weights, x, surge, members):
    """The members' spread about a forecast; an inactive one counts as the forecast."""
    total = 0.0
    for m in range(members):
        if not np.isnan(x[m]):
            total += weights[m] * ((x[m] - surge) * (x[m] - surge))
    return np.sqrt(total) if not np.isnan(surge) else 0.0


@jit
def path_at(known, slot):
    """The place of the commands since the origin of a slot."""
    return known[KNOWN.paths] + slot * PATH


@jit
def combine(node, q, weights, x):
    """(1) of the members' predictions x, m/s, NaN where one is inactive."""
    tiny, total, together, combined = q[node[Row.NUMBERS] :][Number.TINY], 0.0, 0.0, 0.0
    inactive = 0.0
    for m in range(node[Choice.MEMBERS]):
        if np.isnan(x[m]):
            inactive += weights[m]
        else:
            total += weights[m] + tiny
            together += (weights[m] + tiny) * x[m]
            combined += weights[m] * x[m]
    return combined + inactive * (together / total) if total > 0 else np.nan


@jit
def publish(node, known, knows, s, q, slot, k, x):
    """What one slot says over the horizon k."""
    H, M = node[Choice.HORIZONS], node[Choice.MEMBERS]
    forecast = s[node[AT.predictions] + k * (M + 2) :]
    for m in range(M):
        forecast[m] = x[m]
    weights = s[node[AT.weights] + (slot * H + k) * M :]
    forecast[M], forecast[M + 1] = s[node[AT.origin] + slot], combine(node, q, weights, x)
    width = s[node[AT.widths] + slot * H + k]
    if knows:
        due, path = s[known[KNOWN.due] + k * DUE :], s[path_at(known, slot) :]
        group, held = group_of(path), s[known[KNOWN.held] + (slot * H + k) * HELD :]
        due[0], due[1], due[2] = spread_of(weights, x, forecast[M + 1], M), path[FAR], group
        width = halfwidth_held(held, width, due[0], path[FAR], group)
    s[node[AT.halfwidths] + k] = width


@jit
def learn_due(node, known, knows, s, q, surge, dt, work):
    """Compare what became due with the measured speed, m/s."""
    H, M, numbers = node[Choice.HORIZONS], node[Choice.MEMBERS], q[node[Row.NUMBERS] :]
    horizons, memory = q[node[Vector.HORIZONS] :], q[node[Vector.MEMORY] :]
    prior, costs = q[node[Vector.PRIOR] : node[Vector.PRIOR] + M], q[node[Vector.COSTS] : node[Vector.COSTS] + M]
    x, rest, overlap, tiny = work[:M], work[M:], numbers[Number.OVERLAP], numbers[Number.TINY]
    alpha = 1 - numbers[Number.COVERAGE]
    moves = moves_of(overlap, alpha)
    for k in range(H):
        forecast = s[node[AT.predictions] + k * (M + 2) :]
        if not np.isfinite(forecast[M + 1]):
            continue
        begin = k * M
        weights = s[node[AT.rule.weights] + begin : node[AT.rule.weights] + begin + M]
        unit, total, together = np.sqrt(horizons[k] / STEP), 0.0, 0.0
        kappa = np.exp(-max(horizons[k] / overlap, dt) / memory[k])
        for m in range(M):
            x[m] = forecast[m] / unit
            if not np.isnan(x[m]):
                total += weights[m] + tiny
                together += (weights[m] + tiny) * x[m]
        for m in range(M):
            x[m] = together / total if np.isnan(x[m]) else x[m]
        bernstein(
            weights,
            s[node[AT.rule.losses] + begin : node[AT.rule.losses] + begin + M],
            s[node[AT.rule.squares] + begin : node[AT.rule.squares] + begin + M],
            s[node[AT.rule.ranges] + begin : node[AT.rule.ranges] + begin + M],
            prior, costs, kappa, numbers[Number.SCALE], numbers[Number.SHARE], False, x, surge / unit, rest,
        )  # fmt: skip
        e, q_before, s_before = abs(forecast[M + 1] - surge), s[node[AT.quantile] + k], s[node[AT.error] + k]
        s[node[AT.errors] + k] += 1
        s[node[AT.error] + k] += max(1 / s[node[AT.errors] + k], SHARE) * (e - s_before)  # (2)
        if knows:
            due, at = s[known[KNOWN.due] + k * DUE :], known[KNOWN.learned.coefficients :]
            learn_error(
                s, at, k, s[node[AT.errors] + k], e, max(q_before * s_before, NARROWEST), due[0], due[1],
                whole(due[2], GROUPS), moves, alpha,
            )  # fmt: skip
        miss = 1.0 if e > max(q_before * s_before, NARROWEST) else 0.0
        moved = q_before * np.exp((miss - (1 - numbers[Number.COVERAGE])) / (DELAY + overlap))  # (3)
        s[node[AT.quantile] + k] = min(max(moved, LEAST), MOST)


@jit
def judged(node, s, k):
    """The longest horizon up to k of which enough errors are known, else the shortest."""
    while k > 0 and s[node[AT.errors] + k] < FEW:
        k -= 1
    return k


@jit
def halfwidth(node, s, k):
    """q s over the horizon k, infinite where too few errors are known."""
    if s[node[AT.errors] + k] < FEW:
        return np.inf
    return max(s[node[AT.quantile] + k] * s[node[AT.error] + k], NARROWEST)


@jit
def fill_slot(node, known, knows, s, q, slot, surge, half):
    """An origin at the measured speed, m/s, in a step of 2 `half` s; the members' leaves are copied elsewhere."""
    if knows:  # the path since the last measured speed has begun with this one
        path, now = s[path_at(known, slot) :], s[known[KNOWN.path] :]
        for i in range(PATH):
            path[i] = now[i]
    H, M, horizons = node[Choice.HORIZONS], node[Choice.MEMBERS], q[node[Vector.HORIZONS] :]
    reach, overlap = 0, q[node[Row.NUMBERS] :][Number.OVERLAP]
    for k in range(H):
        if s[node[AT.since] + k] + half >= horizons[k] / overlap:
            reach = k
    for k in range(reach + 1):
        s[node[AT.since] + k] = 0.0
    s[node[AT.elapsed] + slot], s[node[AT.origin] + slot], s[node[AT.reach] + slot] = 0.0, surge, reach
    weights = s[node[AT.weights] + slot * H * M :]
    for k in range(H):
        source = s[node[AT.rule.weights] + judged(node, s, k) * M :]
        for m in range(M):
            weights[k * M + m] = source[m]
        s[node[AT.widths] + slot * H + k] = halfwidth(node, s, k)
        if knows:
            held = s[known[KNOWN.held] + (slot * H + k) * HELD :]
            hold(s, known[KNOWN.learned.coefficients :], k, s[node[AT.errors] + k], held)


@jit
def extend_paths(node, known, s, left, right):
    """The commands of one more step, of all that is under way."""
    extend_path(s[known[KNOWN.path] : known[KNOWN.path] + PATH], left, right)
    for slot in range(node[Choice.SLOTS]):
        if s[node[AT.elapsed] + slot] >= 0:
            extend_path(s[path_at(known, slot) :], left, right)


@jit
def begin_again(known, s, left, right):
    """A measured speed: the commands since then are those of its step."""
    begin_path(s[known[KNOWN.path] : known[KNOWN.path] + PATH], left, right)
