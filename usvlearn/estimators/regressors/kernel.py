"""The regressors of `usvlearn.estimators.regressors.layer`, written into an array."""

import numpy as np

from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import COS, DT, LEFT, RIGHT, SIN, YAW_RATE
from usvlearn.estimators.regressors.terms import LEAST, MOST, NEAR, SERIES, TERMS

QUASI_STATIC, PLAIN = TERMS.index([]), TERMS.index(["dynamics"])
# Sets of places in TERMS, as bits.
CUBIC, EXPONENTIAL = (
    sum(1 << place for place, terms in enumerate(TERMS) if name in terms) for name in ("cubic", "exponential")
)


@jit
def phi1(z):
    """φ1(z) = (e^z − 1)/z and its derivative, as `layer.phi1`."""
    less = np.expm1(z)
    value = less / z if z != 0 else z + 1.0
    slope = 0.0
    if abs(z) < NEAR:
        for c in SERIES:
            slope = slope * z + c
    else:
        slope = (1.0 + less - value) * (1.0 / z)
    return value, slope


@jit
def mean_decay(step, surge, x, theta):
    """φ1(dt Ĵ) of the exponential step, `layer` (1); `step` is dt/m."""
    sign = np.sign(surge)
    slope = 2 * abs(surge) * theta[0] + theta[1] + abs(x[YAW_RATE]) * theta[2]
    slope += sign * (x[LEFT] * theta[5] + x[RIGHT] * theta[8])
    z = step * slope
    return phi1(LEAST if z < LEAST else (MOST if z > MOST else z))[0]


@jit
def regressor(terms, surge, x, scale, theta, phi):
    """Write φ of the model with these TERMS and parameters; returns the base of the prediction, m/s."""
    left, right = x[LEFT], x[RIGHT]
    if terms == QUASI_STATIC:
        phi[0], phi[1], phi[2] = right, right * abs(right), right * right * right
        phi[3], phi[4], phi[5] = left, left * abs(left), left * left * left
        phi[6], phi[7], phi[8] = x[SIN], x[COS], abs(x[YAW_RATE])
        return surge * 0.0
    speed, step = abs(surge), x[DT] / scale
    phi[0], phi[1], phi[2] = step * (speed * surge), step * surge, step * (abs(x[YAW_RATE]) * surge)
    phi[3], phi[4], phi[5] = step * left, step * (left * abs(left)), step * (left * speed)
    phi[6], phi[7], phi[8] = step * right, step * (right * abs(right)), step * (right * speed)
    if terms == PLAIN:
        return surge
    place = 9
    if CUBIC >> terms & 1:
        phi[9], phi[10] = step * (left * left * left), step * (right * right * right)
        place = 11
    if EXPONENTIAL >> terms & 1:
        share = mean_decay(step, surge, x, theta)
        for i in range(place):
            phi[i] *= share
    return surge
