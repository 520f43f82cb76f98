"""The trial of the joint EKF: equations (8) to (10) of `state`. The steps of its two filters are made in `kernel`."""

import numpy as np

from usvlearn.core.arrays import copy, fill
from usvlearn.core.family import Row
from usvlearn.core.jit import jit
from usvlearn.estimators.joint.state import (
    AT,
    AT_TRIAL,
    INNOVATION_MOST,
    KAPPA,
    KEPT,
    OFFSET,
    ROOM,
    SUSPECT,
    THETA,
    TRUSTED,
    USUAL_MOST,
    USUAL_SHARE,
    USUALLY,
    WARM,
    Choice,
    E,
    Number,
    Vector,
)
from usvlearn.estimators.ud_factorization.kernel import add, along, variance


@jit(inline=True)
def has_trial(node):
    """Whether this filter makes trials."""
    return node[Choice.TRIAL_STEPS] > 0


@jit
def keep(node, s):
    """The second filter is the state before this step."""
    n, present, second = node[Row.SIZE], node[AT.mean], node[AT_TRIAL.mean]
    copy(s[second : second + n], s[present : present + n])
    present, second = node[AT.factor], node[AT_TRIAL.factor]
    copy(s[second : second + n * n], s[present : present + n * n])
    s[node[AT_TRIAL.noise]], s[node[AT_TRIAL.updates]] = s[node[AT.noise]], s[node[AT.updates]]


@jit
def exchange(node, s):
    """The two filters change places."""
    n = node[Row.SIZE]
    swap(s, node[AT.mean], node[AT_TRIAL.mean], n)
    swap(s, node[AT.factor], node[AT_TRIAL.factor], n * n)
    swap(s, node[AT.noise], node[AT_TRIAL.noise], 1)
    swap(s, node[AT.updates], node[AT_TRIAL.updates], 1)


@jit
def swap(s, one, other, count):
    """Exchange `count` numbers."""
    for i in range(count):
        s[one + i], s[other + i] = s[other + i], s[one + i]


@jit
def loosen_sides(node, s, q, a):
    """(9), of the second filter, whose parameters are kept."""
    n, numbers, prior = node[Row.SIZE], q[node[Row.NUMBERS] :], q[node[Vector.VARIANCE] :]
    mean = s[node[AT_TRIAL.mean] : node[AT_TRIAL.mean] + n]
    A = s[node[AT_TRIAL.factor] : node[AT_TRIAL.factor] + n * n].reshape(n, n)
    copy(s[node[AT_TRIAL.kept] : node[AT_TRIAL.kept] + n - THETA], mean[THETA:])
    for side in range(2):
        side_of(node, mean, side, a)
        along(A, n - 1, numbers[Number.SIDE] * numbers[Number.SIDE], a)
    for i in range(THETA, n - 1):
        room = ROOM * prior[i - THETA] - variance(A, i)
        grown = numbers[Number.EACH] * mean[i]
        add(A, i, min(grown * grown, room) if room > 0 else 0.0, a)


@jit
def side_of(node, mean, side, a):
    """d of (9): the parameters of a side where they lie in x, else 0."""
    fill(a, 0.0)
    copy(a[THETA + 3 + 3 * side : THETA + 6 + 3 * side], mean[THETA + 3 + 3 * side :])
    a[KAPPA + side] = mean[KAPPA + side]
    if node[Choice.EVEN]:
        copy(a[E + 1 + 3 * side : E + 4 + 3 * side], mean[E + 1 + 3 * side :])


@jit
def detect(node, s, z):
    """g of (8) after the innovation z, in standard deviations; returns whether the second filter begins to run."""
    usual, last = s[node[AT_TRIAL.usual]], s[node[AT_TRIAL.last]]
    size, same = min(abs(z), abs(last)), z * last > 0
    m = min(size * size, INNOVATION_MOST)
    g = max(0.0, s[node[AT_TRIAL.statistic]] + (m if same else -m) - OFFSET - USUALLY * usual)
    s[node[AT_TRIAL.usual]] += USUAL_SHARE * ((min(m, USUAL_MOST) if same else 0.0) - usual)
    s[node[AT_TRIAL.last]], s[node[AT_TRIAL.statistic]] = z, g
    if g <= SUSPECT:
        s[node[AT_TRIAL.run]] = 0.0
    return g > SUSPECT and not s[node[AT_TRIAL.run]] > 0


@jit
def likelihood(z, S):
    """ℓ of (10) of the innovation z √S."""
    return -0.5 * min(z * z, INNOVATION_MOST) - 0.5 * np.log(S)


@jit
def end(node, s):
    """There is no trial, and nothing speaks for a change."""
    s[node[AT_TRIAL.run]] = s[node[AT_TRIAL.tried]] = s[node[AT_TRIAL.leads]] = s[node[AT_TRIAL.early]] = 0.0
    s[node[AT_TRIAL.statistic]] = s[node[AT_TRIAL.last]] = 0.0
    s[node[AT_TRIAL.evidence]] = s[node[AT_TRIAL.best]] = 0.0


@jit
def judge(node, s, q):
    """Begin a trial, confirm or drop it, and choose the filter that predicts the next speed."""
    numbers, tried, D = q[node[Row.NUMBERS] :], s[node[AT_TRIAL.tried]], s[node[AT_TRIAL.evidence]]
    leads = s[node[AT_TRIAL.leads]] > 0
    if tried > 0:
        best = max(s[node[AT_TRIAL.best]], D)
        s[node[AT_TRIAL.best]] = best
        if D > numbers[Number.CONFIRMED]:
            if not leads:
                exchange(node, s)
            confirm(node, s)
            return
        if D < numbers[Number.DROPPED] or D < best - numbers[Number.FALLEN] or tried > node[Choice.TRIAL_STEPS]:
            if leads:
                exchange(node, s)
            end(node, s)
            return
        s[node[AT_TRIAL.tried]] = tried + 1
    elif s[node[AT_TRIAL.run]] > 0:
        if not (s[node[AT_TRIAL.statistic]] > numbers[Number.THRESHOLD] and s[node[AT.updates]] > WARM):
            return
        if s[node[AT_TRIAL.run]] > KEPT:
            end(node, s)
            return
        s[node[AT_TRIAL.tried]], s[node[AT_TRIAL.best]] = 1.0, 0.0
    else:
        return
    if (D > numbers[Number.LEADS]) != leads:
        exchange(node, s)
        s[node[AT_TRIAL.leads]] = 0.0 if leads else 1.0
    s[node[AT_TRIAL.early]] = 1.0 if numbers[Number.LEADS] < D <= TRUSTED else 0.0


@jit
def confirm(node, s):
    """The second filter, which lies first, replaces the other one."""
    m = node[Row.SIZE] - THETA
    copy(s[node[AT_TRIAL.before] : node[AT_TRIAL.before] + m], s[node[AT_TRIAL.kept] :])
    end(node, s)
    s[node[AT_TRIAL.changes]] += 1
    s[node[AT_TRIAL.since]] = 0.0
    anew(node, s)


@jit
def anew(node, s):
    """The periodic estimates begin."""
    m = node[Row.SIZE] - THETA
    s[node[AT.learned]] = s[node[AT.readings]] = s[node[AT.weight]] = 0.0
    fill(s[node[AT.reading] : node[AT.reading] + m], 0.0)
    fill(s[node[AT.spread] : node[AT.spread] + m * m], 0.0)
