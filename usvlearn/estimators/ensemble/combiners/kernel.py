"""The combiners of an ensemble: equations (1) to (4) of `state`.

`node` is the row of a combiner; the columns of its members stand behind it. x holds their predictions.
"""

import numpy as np

from usvlearn.core.arrays import clamp, dot, fill
from usvlearn.core.family import WIDTH, Row
from usvlearn.core.jit import jit
from usvlearn.estimators.ensemble.combiners import state
from usvlearn.estimators.ensemble.combiners.state import Bernstein, Exponential, Given, Loss, Plain, Prior, Priors
from usvlearn.estimators.ensemble.combiners.state import Recursive as Weighted
from usvlearn.estimators.least_squares.kernel import forget, rotated

AVERAGE, FIXED, RECURSIVE, EXPONENTIAL, BOA = (
    list(state.RULES).index(kind) for kind in ("average", "fixed", "recursive", "exponential", "boa")
)
AT_RECURSIVE, AT_EXPONENTIAL, AT_BOA = state.RECURSIVE.at, state.EXPONENTIAL.at, state.BOA.at
SQUARE = state.LOSSES.index("square")


@jit
def share(node, s, q, k):
    """The weight of member k among those that are active."""
    rule, numbers = node[Row.FAMILY], q[node[Row.NUMBERS] :]
    if rule == AVERAGE:
        return numbers[Plain.TINY] + 1.0
    if rule == FIXED:
        return numbers[Plain.TINY] + abs(q[node[Given.WEIGHTS] + k])
    if rule == RECURSIVE:
        return numbers[Weighted.TINY] + 1.0
    if rule == EXPONENTIAL:
        return numbers[Exponential.TINY] + s[node[AT_EXPONENTIAL.weights] + k]
    return numbers[Bernstein.TINY] + s[node[AT_BOA.weights] + k]


@jit
def fill_inactive(node, s, q, predictions, x):
    """Write x, where a member that is inactive (NaN) has the weighted mean of the others; returns whether all are."""
    m, inactive = node[Row.SIZE], 0
    for k in range(m):
        x[k] = predictions[node[WIDTH + k]]
        inactive += np.isnan(x[k])
    if inactive == 0:
        return False
    total, together = 0.0, 0.0
    for k in range(m):
        if not np.isnan(x[k]):
            weight = share(node, s, q, k)
            total += weight
            together += weight * x[k]
    together = together / total if total > 0 else np.nan
    for k in range(m):
        if np.isnan(x[k]):
            x[k] = together
    return inactive == m


@jit
def combine(node, s, q, x):
    """`Combiner.combine` of x."""
    rule, m = node[Row.FAMILY], node[Row.SIZE]
    if rule == AVERAGE:
        total = 0.0
        for k in range(m):
            total += x[k]
        return total / m
    if rule == FIXED:
        return dot(q[node[Given.WEIGHTS] : node[Given.WEIGHTS] + m], x[:m])
    if rule == RECURSIVE:
        total = dot(s[node[AT_RECURSIVE.weights] : node[AT_RECURSIVE.weights] + m], x[:m])
        return clamp(total, q[node[Row.NUMBERS] :][Weighted.SURGE_MAX])
    at = node[AT_EXPONENTIAL.weights] if rule == EXPONENTIAL else node[AT_BOA.weights]
    return dot(s[at : at + m], x[:m])


@jit
def learn_rule(node, s, q, x, inactive, surge, dt, work):
    """`Combiner.learn` of x; `inactive`: all its members are."""
    m, rule = node[Row.SIZE], node[Row.FAMILY]
    if rule == RECURSIVE and not inactive:
        learn_recursive(node, s, q, x[:m], surge, work)
    if rule == EXPONENTIAL or rule == BOA:
        if inactive:
            fill(x[:m], surge)
        if rule == EXPONENTIAL:
            learn_exponential(node, s, q, x, surge, dt, work)
        else:
            learn_boa(node, s, q, x, surge, dt, work)


@jit
def learn_recursive(node, s, q, x, surge, work):
    """`RecursiveWeights.learn`."""
    m, numbers, f = node[Row.SIZE], q[node[Row.NUMBERS] :], work[: len(x)]
    weights = s[node[AT_RECURSIVE.weights] : node[AT_RECURSIVE.weights] + m]
    factor = s[node[AT_RECURSIVE.factor] : node[AT_RECURSIVE.factor] + m * m].reshape(m, m)
    rotated(factor, x, f)
    innovation = surge - dot(weights, x)
    lam, trace_max = numbers[Weighted.FORGETTING], numbers[Weighted.TRACE_MAX]
    forget(weights, factor, f, innovation, lam, trace_max, work[m : 2 * m], work[2 * m : 3 * m])


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
def learn_exponential(node, s, q, x, surge, dt, work):
    """`ExponentialWeights.learn`."""
    m, numbers, square = node[Row.SIZE], q[node[Row.NUMBERS] :], node[Loss.LOSS] == SQUARE
    weights = s[node[AT_EXPONENTIAL.weights] : node[AT_EXPONENTIAL.weights] + m]
    losses = s[node[AT_EXPONENTIAL.losses] : node[AT_EXPONENTIAL.losses] + m]
    exponents, kappa = work[:m], np.exp(-dt / numbers[Exponential.MEMORY])
    for k in range(m):
        error = x[k] - surge
        losses[k] = kappa * losses[k] + (error * error if square else abs(error))
        exponents[k] = -numbers[Exponential.RATE] * losses[k]
    shares(weights, q[node[Prior.PRIOR] : node[Prior.PRIOR] + m], exponents)


@jit
def learn_boa(node, s, q, x, surge, dt, work):
    """`BOA.learn`."""
    m, numbers = node[Row.SIZE], q[node[Row.NUMBERS] :]
    weights = s[node[AT_BOA.weights] : node[AT_BOA.weights] + m]
    losses, squares = s[node[AT_BOA.losses] :], s[node[AT_BOA.squares] :]
    prior, costs, kappa = q[node[Priors.PRIOR] :], q[node[Priors.COSTS] :], np.exp(-dt / numbers[Bernstein.MEMORY])
    scale, part, square = numbers[Bernstein.SCALE], numbers[Bernstein.SHARE], node[Loss.LOSS] == SQUARE
    ranges = s[node[AT_BOA.ranges] :]
    bernstein(weights, losses, squares, ranges, prior, costs, kappa, scale, part, square, x, surge, work)


@jit
def bernstein(weights, losses, squares, ranges, prior, costs, kappa, scale, share, square, x, surge, work):
    """Equations (1) to (4) of members' predictions x, with κ = `kappa`."""
    m = len(weights)
    factors, exponents, combined = work[:m], work[m : 2 * m], dot(weights, x[:m])
    error = combined - surge
    slope = 2 * error if square else np.sign(error)
    for k in range(m):
        loss = slope * (x[k] - combined)
        ranges[k] = max(max(kappa * ranges[k], scale), abs(loss))  # (1)
        c = costs[k]
        least = c * ranges[k] * ranges[k]
        surprising = np.sqrt(c / max(squares[k], least)) * loss
        surcharge = ranges[k] if surprising > 0.5 else 0.0
        losses[k] = kappa * losses[k] + 0.5 * (loss * (1 + surprising) + surcharge)  # (2)
        squares[k] = kappa * squares[k] + loss * loss
        rate = np.sqrt(c / max(squares[k], least))  # (3)
        factors[k] = prior[k] * rate
        exponents[k] = -rate * losses[k]
    shares(weights, factors, exponents)  # (4)
    for k in range(m):
        weights[k] += share * (prior[k] - weights[k])
