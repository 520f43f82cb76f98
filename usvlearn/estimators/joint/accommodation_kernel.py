"""Fault accommodation in a joint EKF: (1) and (2) of `usvlearn.estimators.ensemble.accommodation`."""

import numpy as np

from usvlearn.core.arrays import copy, dot, fill
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.estimators.joint.change_detection_kernel import anew, end, side_of
from usvlearn.estimators.joint.kernel import start
from usvlearn.estimators.joint.state import AT, AT_TRIAL, KAPPA, THETA, Choice, E, W
from usvlearn.estimators.ud_factorization.kernel import along, rotated


@jit
def keep_past(node, s):
    """The filter that predicts is copied; the copy before becomes the older one."""
    n, mean, factor, noise = node[Row.SIZE], node[AT_TRIAL.past_mean], node[AT_TRIAL.past_factor], AT_TRIAL.past_noise
    copy(s[mean : mean + n], s[mean + n :])
    copy(s[mean + n : mean + 2 * n], s[node[AT.mean] :])
    copy(s[factor : factor + n * n], s[factor + n * n :])
    copy(s[factor + n * n : factor + 2 * n * n], s[node[AT.factor] :])
    s[node[noise]], s[node[noise] + 1] = s[node[noise] + 1], s[node[AT.noise]]


@jit
def hand_over(node, s, q, shares, loose, surge, a):
    """(1) of every side whose share is not 1."""
    n, past = node[Row.SIZE], s[node[AT_TRIAL.past_mean] :]
    copy(s[node[AT.mean] + THETA : node[AT.mean] + n], past[THETA:])
    copy(s[node[AT.factor] : node[AT.factor] + n * n], s[node[AT_TRIAL.past_factor] :])
    s[node[AT.noise]] = s[node[AT_TRIAL.past_noise]]
    for side in range(2):
        if shares[side] != 1.0:
            give(node, s, side, shares[side], loose, a)
    begin_anew(node, s, q, surge)


@jit
def give_back(node, s, q, side, loose, surge, a):
    """A thruster has recovered."""
    give(node, s, side, 1.0, loose, a)
    begin_anew(node, s, q, surge)


@jit
def give(node, s, side, share, loose, a):
    """A side's parameters are `share` times the older ones, and P grows along them."""
    n, mean = node[Row.SIZE], node[AT.mean]
    a = a[:n]
    side_of(node, s[node[AT_TRIAL.past_mean] :], side, a)
    k, e = THETA + 3 + 3 * side, E + 1 + 3 * side
    for i in range(3):
        s[mean + k + i] = share * a[k + i]
        if node[Choice.EVEN]:
            s[mean + e + i] = share * a[e + i]
    s[mean + KAPPA + side] = share * a[KAPPA + side]
    along(s[node[AT.factor] : node[AT.factor] + n * n].reshape(n, n), n - 1, loose * loose, a)


@jit
def begin_anew(node, s, q, surge):
    """A segment and the periodic estimates begin, without a trial."""
    end(node, s)
    anew(node, s)
    start(node, s, q, surge)


@jit
def thrust_left(node, s, side, scale, floor, work):
    """(2): η_j and s_j, which is infinite where the older parameters push backwards."""
    n, own, old = node[Row.SIZE], node[AT.mean], node[AT_TRIAL.past_mean]
    mean, past, a = s[own : own + n], s[old : old + n], work[:n]
    fill(a, 0.0)
    w, k, e = mean[W], THETA + 3 + 3 * side, E + 1 + 3 * side
    a[k], a[k + 1], a[k + 2], a[KAPPA + side] = 1.0, 1.0, abs(w), 1.0
    if node[Choice.EVEN]:
        a[e], a[e + 1], a[e + 2] = 1.0, 1.0, w
    before, now, f, G = dot(a, past), dot(a, mean), work[n : 2 * n], work[2 * n : 3 * n]
    if not before > 0:
        return 1.0, np.inf
    own, old = node[AT.factor], node[AT_TRIAL.past_factor]
    spread = rotated(s[own : own + n * n].reshape(n, n), a, f, G)
    doubt = rotated(s[old : old + n * n].reshape(n, n), a, f, G)
    share = now / before
    square = (scale * scale * spread + (1 - share) * (1 - share) * doubt) / (before * before)
    return share, np.sqrt(square + floor * floor)
