"""Operations on small arrays, for kernels. `a[:] = b` is avoided: it may allocate memory, which kernels cannot."""

import numpy as np

from usvlearn.core.jit import jit


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


@jit(inline=True)
def whole(value, end):
    """A number of a state as an index from 0 … end − 1; 0 where it is none: a state may hold any number."""
    return int(value) if 0 <= value < end else 0


@jit
def clamp(x, limit):
    """x between −limit and limit; NaN stays."""
    return limit if x > limit else (-limit if x < -limit else x)


@jit(reorder=True)
def finite(block):
    """Whether all numbers of a block are finite, as their sum tells (it overflows only beyond 1e308)."""
    total = 0.0 * block[0]
    for i in range(len(block)):
        total += block[i]
    return np.isfinite(total)
