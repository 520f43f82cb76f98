"""What is done with small arrays. `a[:] = b` would ask for memory, where a and b might overlap; kernels have none."""

import numpy as np

from usvlearn.jit import jit


@jit
def copy(to, source):
    """to_i ← source_i."""
    for i in range(len(to)):
        to[i] = source[i]


@jit
def fill(to, value):
    """to_i ← value."""
    for i in range(len(to)):
        to[i] = value


@jit
def dot(x, y):
    """Σ x_i y_i."""
    total = x[0] * y[0]
    for i in range(1, len(x)):
        total += x[i] * y[i]
    return total


@jit
def clamp(x, limit):
    """x between −limit and limit; NaN stays."""
    return limit if x > limit else (-limit if x < -limit else x)


@jit
def finite(block):
    """Whether a sum is finite, as it is where all its terms are, short of 1e308."""
    total = 0.0 * block[0]
    for i in range(len(block)):
        total += block[i]
    return np.isfinite(total)
