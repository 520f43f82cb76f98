"""The regressors of `usvlearn.estimators.regressors.layer`, written into an array."""

from usvlearn.estimators.regressors.terms import TERMS
from usvlearn.jit import jit
from usvlearn.rows import COS, DT, LEFT, LEFT_BEFORE, RIGHT, RIGHT_BEFORE, SIN, SURGE_DOT, YAW_RATE

QUASI_STATIC = TERMS.index([])
# Sets of places in TERMS, as bits.
MEMORY = sum(1 << place for place, terms in enumerate(TERMS) if "memory" in terms)
AMBIENT = sum(1 << place for place, terms in enumerate(TERMS) if "ambient" in terms)


@jit
def regressor(terms, surge, x, scale, phi):
    """Write φ of the model with these TERMS; returns the base of the prediction, m/s."""
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
    place = 9
    if MEMORY >> terms & 1:
        phi[9], phi[10], phi[11] = step * x[SURGE_DOT], step * x[LEFT_BEFORE], step * x[RIGHT_BEFORE]
        place = 12
    if AMBIENT >> terms & 1:
        phi[place], phi[place + 1], phi[place + 2] = step, step * x[SIN], step * x[COS]
    return surge
