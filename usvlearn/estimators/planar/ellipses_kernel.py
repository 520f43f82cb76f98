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
from usvlearn.estimators.planar import state as at

BEYOND = 1 + 1e-4  # times the longest horizon, with room for rounding


@jit
def follow_surprise(head, s, row, pose):
    """ν and ν̄ of (4) after a step."""
    quick, slow = min(row[DT] / at.QUICK_TIME, 1.0), min(row[DT] / at.SLOW_TIME, 1.0)
    surprises = s[head[at.TRACK, at.SURPRISE] :]
    for i in range(2):
        axis = at.SURGE if i == 0 else at.YAW
        target, state = row[TARGET] if i == 0 else pose[at.TURN], s[head[axis, at.STATE] :]
        z = (target - state[head[axis, at.PREDICTED]]) / max(state[head[axis, at.DEVIATION]], NARROWEST)
        square = min(z * z, at.LARGEST)
        if square == square and (i == 1 or row[MODE] == LEARN):
            surprises[2 * i] += quick * (square - surprises[2 * i])
            surprises[2 * i + 1] += slow * (square - surprises[2 * i + 1])


@jit
def surprise(head, s):
    """The factor of (4)."""
    surprises, most = s[head[at.TRACK, at.SURPRISE] :], 1.0
    for i in range(2):
        most = max(most, surprises[2 * i] / (at.USUAL * max(surprises[2 * i + 1], NARROWEST)))
    return min(np.sqrt(most), at.MOST_SURPRISE)


@jit
def width_of(head, s, k):
    """The radius that does not know the manoeuvre, m; infinite where too few errors are known."""
    if s[head[at.TRACK, at.ERRORS] + k] < FEW:
        return np.inf
    return max(s[head[at.TRACK, at.QUANTILE] + k] * s[head[at.TRACK, at.MEAN_ERROR] + k], NARROWEST)


@jit
def radius_held(slot, k, horizon):
    """The radius of a track at a horizon, m, for which it knows the distance run and the commands until now."""
    stored, path = slot[at.HORIZON + k * at.OF_HORIZON :], slot[at.COMMANDS : at.COMMANDS + PATH]
    return slot[at.WIDER] * halfwidth_held(stored[:HELD], stored[HELD], slot[at.RUN], path[FAR], group_of(path))


@jit
def shape(head, s, k, out):
    """Write S of (3)."""
    count, C = s[head[at.TRACK, at.ERRORS] + k], s[head[at.TRACK, at.COVARIANCE] + 3 * k :]
    round_ = at.FLOOR + at.ROUND / (count + at.ROUND) * (C[0] + C[2]) / 2
    a, b, c = C[0] + round_, C[1], C[2] + round_
    root = np.sqrt(max(a * c - b * b, 1e-6 * a * c))
    out[0], out[1], out[2] = a / root, b / root, c / root


@jit
def rho(S, forward, aside):
    """√(eᵀ S⁻¹ e), where det S is 1."""
    return np.sqrt(max(S[2] * forward * forward - 2 * S[1] * forward * aside + S[0] * aside * aside, 0.0))


@jit
def publish_due(head, s, q, slot, k, pose):
    """A track has become due at its horizon: what it said, what is measured, and what is learned of it."""
    due = s[head[at.TRACK, at.DUES] + k * at.DUE :]
    north, east = pose[at.NORTH] - slot[at.NORTH_0], pose[at.EAST] - slot[at.EAST_0]
    dn, de = slot[at.AT_NORTH] - north, slot[at.AT_EAST] - east
    if not np.hypot(north, east) < at.LIMIT * slot[at.ELAPSED] + at.AWAY:  # no boat moves so: it is no position
        return
    forward, aside = slot[at.COS_0] * dn + slot[at.SIN_0] * de, slot[at.COS_0] * de - slot[at.SIN_0] * dn
    turned = slot[at.PSI] - pose[at.HEADING]
    turned -= 2 * np.pi * np.floor((turned + np.pi) / (2 * np.pi))
    path = slot[at.COMMANDS : at.COMMANDS + PATH]
    group, stored = group_of(path), slot[at.HORIZON + k * at.OF_HORIZON :]
    u, r, h = slot[at.U_0], slot[at.R_0], slot[at.ELAPSED]
    psi, half = slot[at.PSI_0], r * h / 2
    chord = u * h * (np.sin(half) / half if abs(half) > 1e-9 else 1.0)
    due[at.ERROR], due[at.HEADING_ERROR] = np.hypot(dn, de), abs(turned)
    due[at.CONSTANT] = np.hypot(chord * np.cos(psi + half) - north, chord * np.sin(psi + half) - east)
    due[at.HELD_RATE] = np.hypot(slot[at.HELD_NORTH] - north, slot[at.HELD_EAST] - east)
    due[at.RHO] = rho(stored[HELD + 1 :], forward, aside)
    due[at.RADIUS], due[at.GROUP], due[at.DISTANCE] = radius_held(slot, k, h), group, slot[at.RUN]
    wider = slot[at.WIDER]
    learn_track(head, s, q, k, forward / wider, aside / wider, slot[at.RUN], path[FAR], group, stored[HELD + 1 :])


@jit
def learn_track(head, s, q, k, forward, aside, run, far, group, S):
    """(3), and the radius, from an error in the frame of the origin's heading, m; S is written."""
    track = head[at.TRACK]
    C = s[track[at.COVARIANCE] + 3 * k : track[at.COVARIANCE] + 3 * k + 3]
    numbers, errors, mean = q[track[at.Q] :], track[at.ERRORS] + k, track[at.MEAN_ERROR] + k
    overlap, alpha, quantile = numbers[1], 1 - numbers[0], track[at.QUANTILE] + k
    shape(head, s, k, S)
    e, width = rho(S, forward, aside), max(s[quantile] * s[mean], NARROWEST)
    count = s[errors] + 1
    s[errors] = count
    if count > FEW and e > at.CLIP * width:
        forward, aside, e = forward * (at.CLIP * width / e), aside * (at.CLIP * width / e), at.CLIP * width
    s[mean] += max(1 / count, SHARE) * (e - s[mean])
    learned, moves = track[at.LEARNED : at.LEARNED + 6], moves_of(overlap, alpha)
    learn_error(s, learned, k, count, e, width, run, far, group, moves, alpha)
    miss = 1.0 if e > width else 0.0
    s[quantile] = min(max(s[quantile] * np.exp((miss - alpha) / (at.DELAY + overlap)), LEAST), MOST)
    share = max(1 / (count + 1), at.SLOW)
    C[0] += share * (forward * forward - C[0])
    C[1] += share * (forward * aside - C[1])
    C[2] += share * (aside * aside - C[2])


@jit
def keep_ellipses(head, s, slot):
    """Keep in a track, as it begins, what its ellipses at all horizons need."""
    slot[at.WIDER] = surprise(head, s)
    for k in range(head[at.TRACK, at.HORIZON_COUNT]):
        stored = slot[at.HORIZON + k * at.OF_HORIZON :]
        hold(s, head[at.TRACK, at.LEARNED : at.LEARNED + 6], k, s[head[at.TRACK, at.ERRORS] + k], stored[:HELD])
        stored[HELD] = width_of(head, s, k)
        shape(head, s, k, stored[HELD + 1 :])


@jit
def ellipse(head, q, slot, out):
    """Write the covariance of a track's position, NN, NE, EE, m², of which the learned ellipse has the coverage."""
    H, horizons, t = head[at.TRACK, at.HORIZON_COUNT], q[head[at.TRACK, at.Q] + 2 :], slot[at.ELAPSED]
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
        out[0], out[1], out[2] = np.inf, 0.0, np.inf
        return
    a, b = slot[at.HORIZON + k * at.OF_HORIZON + HELD + 1 :], slot[at.HORIZON + above * at.OF_HORIZON + HELD + 1 :]
    for i in range(3):
        out[i] = (1 - rise) * a[i] + rise * b[i]
    size = width * width / (-2 * np.log(1 - q[head[at.TRACK, at.Q]]))
    forward, both, aside = out[0], out[1], out[2]
    c, d = slot[at.COS_0], slot[at.SIN_0]
    out[0] = size * (c * c * forward - 2 * c * d * both + d * d * aside)
    out[1] = size * (c * d * (forward - aside) + (c * c - d * d) * both)
    out[2] = size * (d * d * forward + 2 * c * d * both + c * c * aside)
