"""What an ensemble makes of its members' predictions: the rules of `estimators.combiners`, and `estimators.conformal`.

A rule sees x: the predictions of its members, NaN where one sleeps.
"""

import numpy as np

from usvlearn.arrays import clamp, dot, fill
from usvlearn.estimators.least_squares.kernel import forget, rotated
from usvlearn.family import (
    AT_MOST_TEN,
    FACTOR,
    FINITE,
    NOT_NEGATIVE,
    POSITIVE,
    POSITIVE_OR_INFINITE,
    TRIANGLE,
    UNIT,
    WEIGHT,
    Family,
    Field,
    Vector,
)
from usvlearn.jit import jit

AVERAGE, FIXED, RECURSIVE, EXPONENTIAL, BOA = range(5)
# Places in a rule's row of the table; its members' columns follow.
RULE, COUNT, STATE, NUMBERS, SQUARE, COLUMNS = range(6)
TINY, FORGETTING, TRACE_MAX, SURGE_MAX = range(4)
MEMORY, RATE, SCALE, SHARE = 1, 2, 2, 3
VECTOR = 4  # weights of `fixed`, priors of the last two; behind those of `boa`, c of (3)
_LOSS = {"loss": ("absolute", "square")}
_WHOLE = {"tiny": POSITIVE}
RULES = {  # in the order of the constants above; the size is the count of members
    "average": Family(lambda m: {}, _WHOLE),
    "fixed": Family(lambda m: {}, _WHOLE, {"weights": Vector(lambda m: m, FINITE)}),
    "recursive": Family(
        lambda m: {"weights": Field((m,)), "factor": Field((m, m), TRIANGLE)},
        {**_WHOLE, "forgetting": FACTOR, "trace_max": POSITIVE, "surge_max": POSITIVE},
    ),
    "exponential": Family(
        lambda m: {"weights": Field((m,), WEIGHT), "losses": Field((m,), NOT_NEGATIVE)},
        {**_WHOLE, "memory": POSITIVE_OR_INFINITE, "rate": POSITIVE}, {"prior": Vector(lambda m: m, FACTOR)}, _LOSS,
    ),
    "boa": Family(
        lambda m: {"weights": Field((m,), WEIGHT), "losses": Field((m,)), "squares": Field((m,), NOT_NEGATIVE),
                   "ranges": Field((m,), POSITIVE)},
        {**_WHOLE, "memory": POSITIVE_OR_INFINITE, "scale": POSITIVE, "share": UNIT},
        {"prior": Vector(lambda m: m, FACTOR), "costs": Vector(lambda m: m, POSITIVE)}, _LOSS,
    ),
}  # fmt: skip


@jit
def fill_sleeping(row, s, q, predictions, x):
    """Write what the rule hears: who sleeps says what the awake say together, NaN where all sleep; returns if so."""
    m, asleep = row[COUNT], 0
    for k in range(m):
        x[k] = predictions[row[COLUMNS + k]]
        asleep += np.isnan(x[k])
    if asleep == 0:
        return False
    total, together = 0.0, 0.0
    for k in range(m):
        if not np.isnan(x[k]):
            share = q[TINY]
            if row[RULE] == FIXED:
                share += abs(q[VECTOR + k])
            elif row[RULE] == AVERAGE or row[RULE] == RECURSIVE:
                share += 1.0
            else:
                share += s[k]
            total += share
            together += share * x[k]
    together = together / total if total > 0 else np.nan
    for k in range(m):
        if np.isnan(x[k]):
            x[k] = together
    return asleep == m


@jit
def combine(row, s, q, x):
    """`Combiner.combine` of what the rule hears."""
    m = row[COUNT]
    if row[RULE] == AVERAGE:
        total = 0.0
        for k in range(m):
            total += x[k]
        return total / m
    weights = q[VECTOR : VECTOR + m] if row[RULE] == FIXED else s[:m]
    total = dot(weights, x[:m])
    return clamp(total, q[SURGE_MAX]) if row[RULE] == RECURSIVE else total


@jit
def learn_rule(row, s, q, x, asleep, surge, dt, work):
    """`Combiner.learn` of what the rule hears; `asleep`: all its members are."""
    m, kind = row[COUNT], row[RULE]
    if kind == RECURSIVE and not asleep:
        weights, f = s[:m], work[:m]
        factor = s[m : m + m * m].reshape(m, m)
        rotated(factor, x[:m], f)
        innovation = surge - dot(weights, x[:m])
        forget(weights, factor, f, innovation, q[FORGETTING], q[TRACE_MAX], work[m : 2 * m], work[2 * m : 3 * m])
    if kind == EXPONENTIAL or kind == BOA:
        if asleep:
            fill(x[:m], surge)
        kept = np.exp(-dt / q[MEMORY])
        if kind == EXPONENTIAL:
            learn_exponential(s, q, x, m, row[SQUARE], surge, kept, work)
        else:
            learn_boa(s, q, x, m, row[SQUARE], surge, kept, work)


@jit
def shares(weights, factors, exponents):
    """weights ∝ factors · exp(exponents)."""
    most, total = exponents[0], 0.0
    for k in range(1, len(weights)):
        most = max(most, exponents[k])
    for k in range(len(weights)):
        weights[k] = factors[k] * np.exp(exponents[k] - most)
        total += weights[k]
    for k in range(len(weights)):
        weights[k] /= total


@jit
def learn_exponential(s, q, x, m, square, surge, kept, work):
    """`ExponentialWeights.learn`."""
    weights, losses, exponents = s[:m], s[m : 2 * m], work[:m]
    for k in range(m):
        error = x[k] - surge
        losses[k] = kept * losses[k] + (error * error if square else abs(error))
        exponents[k] = -q[RATE] * losses[k]
    shares(weights, q[VECTOR : VECTOR + m], exponents)


@jit
def learn_boa(s, q, x, m, square, surge, kept, work):
    """`BOA.learn`, equations (1) to (4)."""
    weights, losses, squares, ranges = s[:m], s[m : 2 * m], s[2 * m : 3 * m], s[3 * m : 4 * m]
    prior, costs = q[VECTOR : VECTOR + m], q[VECTOR + m : VECTOR + 2 * m]
    factors, exponents = work[:m], work[m : 2 * m]
    combined = dot(weights, x[:m])
    error = combined - surge
    slope = 2 * error if square else np.sign(error)
    for k in range(m):
        loss = slope * (x[k] - combined)
        ranges[k] = max(kept * ranges[k], q[SCALE], abs(loss))  # (1)
        c = costs[k]
        least = c * ranges[k] * ranges[k]
        surprising = np.sqrt(c / max(squares[k], least)) * loss
        surcharge = ranges[k] if surprising > 0.5 else 0.0
        losses[k] = kept * losses[k] + 0.5 * (loss * (1 + surprising) + surcharge)  # (2)
        squares[k] = kept * squares[k] + loss * loss
        rate = np.sqrt(c / max(squares[k], least))  # (3)
        factors[k] = prior[k] * rate
        exponents[k] = -rate * losses[k]
    shares(weights, factors, exponents)  # (4)
    for k in range(m):
        weights[k] += q[SHARE] * (prior[k] - weights[k])


CONFORMAL_NUMBERS = {"coverage": UNIT, "rate": AT_MOST_TEN, "boost": AT_MOST_TEN, "least": POSITIVE}
COVERAGE, STEP, BOOST, LEAST = range(4)


@jit
def conformal(halfwidth, count, innovation, q):
    """`conformal.conformal_step`, in place."""
    seen, narrower, wider = -1.0, 1.0, 1.0
    for k in range(len(halfwidth)):
        if np.isfinite(innovation[k]):
            count[k] += 1
            if count[k] != seen:  # as a rule it is the same for all
                seen = count[k]
                rate = q[STEP] + q[BOOST] / seen
                narrower, wider = np.exp(-rate * (1 - q[COVERAGE])), np.exp(rate * q[COVERAGE])
            moved = halfwidth[k] * (wider if abs(innovation[k]) > halfwidth[k] else narrower)
            halfwidth[k] = max(moved, q[LEAST])
