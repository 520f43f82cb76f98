"""The ellipses of tracks, and how they are learned: equations (3) and (4) of `estimators.planar.state`.

`head` is the table of places of `estimators.planar.state`, and `slot` a track.
"""

import numpy as np

from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import DT, LEARN, MODE
from usvlearn.core.prepared_samples import SURGE as TARGET
from usvlearn.estimators.ensemble.conformal.state import FEW
from usvlearn.estimators.ensemble.forecasts.state import LEAST, MOST, SHARE
from usvlearn.estimators.ensemble.manoeuvre_intervals.kernel import (
    group_of,
    halfwidth_held,
    hold,
    learn_error,
    moves_of,
)
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import FAR, HELD, NARROWEST, PATH
from usvlearn.estimators.planar.state import (
    AT_EAST,
    AT_NORTH,
    AWAY,
    CLIP,
    COMMANDS,
    CONSTANT,
    COS_0,
    COVARIANCE,
    DELAY,
    DEVIATION,
    DISTANCE,
    DUE,
    DUES,
    EAST,
    EAST_0,
    ELAPSED,
    ERROR,
    ERRORS,
    FLOOR,
    GROUP,
    HEADING,
    HEADING_ERROR,
    HELD_EAST,
    HELD_NORTH,
    HELD_RATE,
    HORIZON,
    HORIZON_COUNT,
    LARGEST,
    LEARNED,
    LIMIT,
    MEAN_ERROR,
    MOST_SURPRISE,
    NORTH,
    NORTH_0,
    OF_HORIZON,
    PREDICTED,
    PSI,
    PSI_0,
    QUANTILE,
    QUICK_TIME,
    R_0,
    RADIUS,
    RHO,
    ROUND,
    RUN,
    SIN_0,
    SLOW,
    SLOW_TIME,
    STATE,
    SURGE,
    SURPRISE,
    TRACK,
    TURN,
    U_0,
    USUAL,
    WIDER,
    YAW,
    Q,
)

BEYOND = 1 + 1e-4  # times the longest horizon, with room for rounding


@jit
def follow_surprise(head, s, row, pose):
    """ν and ν̄ of (4) after a step."""
    found, quick, slow = s[head[TRACK, SURPRISE] :], min(row[DT] / QUICK_TIME, 1.0), min(row[DT] / SLOW_TIME, 1.0)
    for i in range(2):
        axis = SURGE if i == 0 else YAW
        target, own = row[TARGET] if i == 0 else pose[TURN], s[head[axis, STATE] :]
        z = (target - own[head[axis, PREDICTED]]) / max(own[head[axis, DEVIATION]], NARROWEST)
        square = min(z * z, LARGEST)
        if square == square and (i == 1 or row[MODE] == LEARN):
            found[2 * i] += quick * (square - found[2 * i])
            found[2 * i + 1] += slow * (square - found[2 * i + 1])


@jit
def surprise(head, s):
    """The factor of (4)."""
    found, most = s[head[TRACK, SURPRISE] :], 1.0
    for i in range(2):
        most = max(most, found[2 * i] / (USUAL * max(found[2 * i + 1], NARROWEST)))
    return min(np.sqrt(most), MOST_SURPRISE)


@jit
def width_of(head, s, k):
    """The radius that does not know the manoeuvre, m; infinite where too few errors are known."""
    if s[head[TRACK, ERRORS] + k] < FEW:
        return np.inf
    return max(s[head[TRACK, QUANTILE] + k] * s[head[TRACK, MEAN_ERROR] + k], NARROWEST)


@jit
def radius_held(slot, k, horizon):
    """The radius of a track at a horizon, m, of which it knows the distance run and the commands until now.

    Args:
        slot: the track.
        k: index of the horizon.
        horizon: s, where the radius is asked for.
    """
    kept, path = slot[HORIZON + k * OF_HORIZON :], slot[COMMANDS : COMMANDS + PATH]
    return slot[WIDER] * halfwidth_held(kept[:HELD], kept[HELD], slot[RUN], path[FAR], group_of(path))


@jit
def shape(head, s, k, found):
    """Write S of (3)."""
    count, C = s[head[TRACK, ERRORS] + k], s[head[TRACK, COVARIANCE] + 3 * k :]
    round_ = FLOOR + ROUND / (count + ROUND) * (C[0] + C[2]) / 2
    a, b, c = C[0] + round_, C[1], C[2] + round_
    root = np.sqrt(max(a * c - b * b, 1e-6 * a * c))
    found[0], found[1], found[2] = a / root, b / root, c / root


@jit
def rho(S, forward, aside):
    """√(eᵀ S⁻¹ e), where det S is 1."""
    return np.sqrt(max(S[2] * forward * forward - 2 * S[1] * forward * aside + S[0] * aside * aside, 0.0))


@jit
def publish_due(head, s, q, slot, k, pose):
    """A track has become due at its horizon: what it said, what is measured, and what is learned of it."""
    due = s[head[TRACK, DUES] + k * DUE :]
    north, east = pose[NORTH] - slot[NORTH_0], pose[EAST] - slot[EAST_0]
    dn, de = slot[AT_NORTH] - north, slot[AT_EAST] - east
    if not np.hypot(north, east) < LIMIT * slot[ELAPSED] + AWAY:  # no boat moves so: it is no position
        return
    forward, aside = slot[COS_0] * dn + slot[SIN_0] * de, slot[COS_0] * de - slot[SIN_0] * dn
    turned = slot[PSI] - pose[HEADING]
    turned -= 2 * np.pi * np.floor((turned + np.pi) / (2 * np.pi))
    path = slot[COMMANDS : COMMANDS + PATH]
    group, kept = group_of(path), slot[HORIZON + k * OF_HORIZON :]
    u, r, h = slot[U_0], slot[R_0], slot[ELAPSED]
    psi, half = slot[PSI_0], r * h / 2
    chord = u * h * (np.sin(half) / half if abs(half) > 1e-9 else 1.0)
    due[ERROR], due[HEADING_ERROR] = np.hypot(dn, de), abs(turned)
    due[CONSTANT] = np.hypot(chord * np.cos(psi + half) - north, chord * np.sin(psi + half) - east)
    due[HELD_RATE] = np.hypot(slot[HELD_NORTH] - north, slot[HELD_EAST] - east)
    due[RHO] = rho(kept[HELD + 1 :], forward, aside)
    due[RADIUS], due[GROUP], due[DISTANCE] = radius_held(slot, k, h), group, slot[RUN]
    wider = slot[WIDER]
    learn_track(head, s, q, k, forward / wider, aside / wider, slot[RUN], path[FAR], group, kept[HELD + 1 :])


@jit
def learn_track(head, s, q, k, forward, aside, run, far, group, S):
    """(3), and the radius, from an error in the frame of the origin's heading, m; S is written."""
    C = s[head[TRACK, COVARIANCE] + 3 * k : head[TRACK, COVARIANCE] + 3 * k + 3]
    numbers, errors, mean = q[head[TRACK, Q] :], head[TRACK, ERRORS] + k, head[TRACK, MEAN_ERROR] + k
    overlap, alpha, quantile = numbers[1], 1 - numbers[0], head[TRACK, QUANTILE] + k
    shape(head, s, k, S)
    e, width = rho(S, forward, aside), max(s[quantile] * s[mean], NARROWEST)
    count = s[errors] + 1
    s[errors] = count
    if count > FEW and e > CLIP * width:
        forward, aside, e = forward * (CLIP * width / e), aside * (CLIP * width / e), CLIP * width
    s[mean] += max(1 / count, SHARE) * (e - s[mean])
    at, moves = head[TRACK, LEARNED : LEARNED + 6], moves_of(overlap, alpha)
    learn_error(s, at, k, count, e, width, run, far, group, moves, alpha)
    miss = 1.0 if e > width else 0.0
    s[quantile] = min(max(s[quantile] * np.exp((miss - alpha) / (DELAY + overlap)), LEAST), MOST)
    share = max(1 / (count + 1), SLOW)
    C[0] += share * (forward * forward - C[0])
    C[1] += share * (forward * aside - C[1])
    C[2] += share * (aside * aside - C[2])


@jit
def keep_ellipses(head, s, slot):
    """Keep in a track, as it begins, what its ellipses at all horizons need."""
    slot[WIDER] = surprise(head, s)
    for k in range(head[TRACK, HORIZON_COUNT]):
        kept = slot[HORIZON + k * OF_HORIZON :]
        hold(s, head[TRACK, LEARNED : LEARNED + 6], k, s[head[TRACK, ERRORS] + k], kept[:HELD])
        kept[HELD] = width_of(head, s, k)
        shape(head, s, k, kept[HELD + 1 :])


@jit
def ellipse(head, q, slot, found):
    """Write the covariance of a track's position, NN, NE, EE, m², of which the learned ellipse has the coverage."""
    H, horizons, t = head[TRACK, HORIZON_COUNT], q[head[TRACK, Q] + 2 :], slot[ELAPSED]
    k = 0
    while k + 1 < H and horizons[k + 1] <= t:
        k += 1
    rise = (t - horizons[k]) / (horizons[k + 1] - horizons[k]) if k + 1 < H and t > horizons[k] else 0.0
    above = min(k + 1, H - 1)
    width = radius_held(slot, k, t)
    if rise > 0:
        width = (1 - rise) * width + rise * radius_held(slot, above, t)
    elif t < horizons[0]:
        width *= t / horizons[0]
    if not (t <= horizons[H - 1] * BEYOND and width < np.inf):
        found[0], found[1], found[2] = np.inf, 0.0, np.inf
        return
    a, b = slot[HORIZON + k * OF_HORIZON + HELD + 1 :], slot[HORIZON + above * OF_HORIZON + HELD + 1 :]
    for i in range(3):
        found[i] = (1 - rise) * a[i] + rise * b[i]
    size, forward, both, aside = width * width / (-2 * np.log(1 - q[head[TRACK, Q]])), found[0], found[1], found[2]
    c, d = slot[COS_0], slot[SIN_0]
    found[0] = size * (c * c * forward - 2 * c * d * both + d * d * aside)
    found[1] = size * (c * d * (forward - aside) + (c * c - d * d) * both)
    found[2] = size * (d * d * forward + 2 * c * d * both + c * c * aside)
