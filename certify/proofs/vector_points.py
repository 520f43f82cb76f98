"""The Jacobian and the value of a network with a vector state at a point (x, u), in rational arithmetic.

With relu and leaky both are exact. With tanh they lie between bounds that are some 10⁻²⁸ apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from certify.networks.vector import Activation, VectorWeights
from certify.proofs.box_planes import Box, Region, region
from certify.proofs.vector_exact import Matrix, changed, product, transposed
from certify.proofs.vector_slopes import (
    Ends,
    Linear,
    exact_slopes,
    first_layer,
    layer,
    linear,
    through,
)

Intervals = list[list[tuple[Fraction, Fraction]]]


def norm_at(
    weights: VectorWeights, phi: Activation, point: Any, norm: str = "inf", scaling: Matrix | None = None
) -> Fraction | None:
    """‖T J T⁻¹‖ at a point `(q + m,)`, or for tanh a bound below it; None where J does not exist.

    The point refutes every rate up to this number.

    >>> from certify.networks.vector import RELU, check
    >>> net = check(VectorWeights(None, [[0.5]], [[1.0]], np.zeros((1, 0)), [-0.5]))
    >>> norm_at(net, RELU, [0.75]), norm_at(net, RELU, [0.5])
    (Fraction(1, 2), None)
    """
    R, A, W = changed(weights, scaling)
    layers = [W] if weights.V is None else [W, _fractions(weights.V)]
    J: Intervals = [[(x, x) for x in row] for row in layers[0]]
    slopes = _slopes_at(weights, phi, point)
    for found, after in zip(slopes, [*layers[1:], A], strict=True):
        for i, (row, slope) in enumerate(zip(J, found, strict=True)):
            matters = any(map(any, row)) and any(each[i] for each in after)
            if slope is None and matters:
                return None
            J[i] = [_times(slope or (Fraction(0), Fraction(0)), x) for x in row]
        J = _product(after, J)

    J = [[(low + x, high + x) for (low, high), x in zip(row, own, strict=True)] for row, own in zip(J, R, strict=True)]
    sizes = [[max(low, -high, Fraction(0)) for low, high in row] for row in J]
    return max(sum(row, Fraction(0)) for row in (transposed(sizes) if norm == "one" else sizes))


def value_at(weights: VectorWeights, phi: Activation, point: Any) -> list[tuple[Fraction, Fraction]]:
    """Bounds of each component of f at a point `(q + m,)`; equal for relu, up to 2⁻⁹⁶ for leaky.

    >>> from certify.networks.vector import RELU, check
    >>> value_at(check(VectorWeights(None, [[0.5]], [[1.0]], np.zeros((1, 0)), [1.0])), RELU, [0.5])
    [(Fraction(3, 4), Fraction(3, 4))]
    """
    here, found, ends = _reached(weights, phi, point)[-1]
    last = layer(weights.A, np.zeros(len(weights.R)))
    found, ends = through(phi, found, ends, last, here)
    x = [Fraction(float(value)) for value in np.asarray(point)[: len(weights.R)]]
    moved = [row[0] for row in product(_fractions(weights.R), [[value] for value in x])]
    unit = 1 << (found.bits + here.bits)
    return [(Fraction(low, unit) + k, Fraction(high, unit) + k) for (low, high), k in zip(ends, moved, strict=True)]


def _reached(weights: VectorWeights, phi: Activation, point: Any) -> list[tuple[Region, Linear, Ends]]:
    """z of each hidden layer at a point."""
    at = np.asarray(point, dtype=np.float64)
    here = region(Box(at, at))
    found, ends = linear(first_layer(weights, Box(at, at)), here)
    layers = [(here, found, ends)]
    if weights.V is not None:
        layers.append((here, *through(phi, found, ends, layer(weights.V, weights.c), here)))
    return layers


def _slopes_at(weights: VectorWeights, phi: Activation, point: Any) -> list[list[tuple[Fraction, Fraction] | None]]:
    """φ′ of each neuron; None where z = 0 is not excluded and φ has a corner there."""
    layers = []
    for here, found, ends in _reached(weights, phi, point):
        slopes: list[tuple[Fraction, Fraction] | None] = list(exact_slopes(phi, ends, found.bits + here.bits))
        if phi.name != "tanh":
            slopes = [None if least <= 0 <= most else own for own, (least, most) in zip(slopes, ends, strict=True)]
        layers.append(slopes)
    return layers


def _fractions(values: Any) -> Matrix:
    return [[Fraction(x) for x in row] for row in np.asarray(values, dtype=np.float64).tolist()]


def _times(x: tuple[Fraction, Fraction], y: tuple[Fraction, Fraction]) -> tuple[Fraction, Fraction]:
    """The product of two intervals, the first of which is not negative."""
    low, high = x
    return (low if y[0] > 0 else high) * y[0], (high if y[1] > 0 else low) * y[1]


def _product(X: Matrix, Y: Intervals) -> Intervals:
    columns = list(zip(*Y, strict=True))
    return [[_sum(row, column) for column in columns] for row in X]


def _sum(row: Sequence[Fraction], column: Sequence[tuple[Fraction, Fraction]]) -> tuple[Fraction, Fraction]:
    low = high = Fraction(0)
    for k, (x, y) in zip(row, column, strict=True):
        if k:
            low, high = low + k * (x if k > 0 else y), high + k * (y if k > 0 else x)
    return low, high
