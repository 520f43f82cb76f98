"""The regressors of `usvlearn.estimators.regressors.layer`, written into an array."""

from usvlearn.jit import jit
from usvlearn.rows import COS, DT, LEFT, RIGHT, SIN, YAW_RATE

SURGE_DOT, LEFT_BEFORE, RIGHT_BEFORE = range(6, 9)  # places of what `WithMemory` adds to the inputs of a sample
INPUTS = 9

QUASI_STATIC, DYNAMICS, MEMORY, AMBIENT = 0, 1, 2, 4  # the terms of a model; the last three are added up
TERMS = {"dynamics": DYNAMICS, "memory": MEMORY, "ambient": AMBIENT}
LEGAL_TERMS = ([], ["dynamics"], ["dynamics", "memory"], ["dynamics", "ambient"], ["dynamics", "memory", "ambient"])
FEEDBACK = ("measured", "estimate")


def parameters(terms):
    """How many parameters a model with these terms has.

    >>> parameters(["dynamics", "memory", "ambient"])
    15
    """
    return 9 + 3 * ("memory" in terms) + 3 * ("ambient" in terms)


@jit
def regressor(terms, surge, x, scale, phi):
    """Write φ; returns the base of the prediction, m/s."""
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
    if terms & MEMORY:
        phi[9], phi[10], phi[11] = step * x[SURGE_DOT], step * x[LEFT_BEFORE], step * x[RIGHT_BEFORE]
        place = 12
    if terms & AMBIENT:
        phi[place], phi[place + 1], phi[place + 2] = step, step * x[SIN], step * x[COS]
    return surge
