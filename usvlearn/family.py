"""Which numbers are legal: each family of kernels declares it of its parameters and of the leaves of its state.

Nothing is checked here where an estimator describes itself: its constructor has done that. What a file says is checked
by `describe`, against these declarations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import inf
from typing import Any, NamedTuple

import numpy as np

LEAST, MOST = 1e-30, 1e30  # of a positive number: its inverse is finite in float32, and its eighth power in float64


@dataclass(frozen=True)
class Range:
    """The numbers from `least` to `most`, both included; NaN is none of them.

    Attributes:
        diagonal: the least number on the diagonal of a square matrix.
        sleeps: whether NaN, infinity and what is beyond all measure are legal, too.
    """

    least: float
    most: float
    diagonal: float = -inf
    sleeps: bool = False

    def wrong(self, array: np.ndarray) -> np.ndarray:
        """The numbers that are not legal, in one row.

        >>> POSITIVE.wrong(np.array([1.0, 0.0, np.nan]))
        array([ 0., nan])
        """
        legal = (array >= self.least) & (array <= self.most)
        if self.diagonal > -inf:
            legal &= (array >= self.diagonal) | ~np.eye(array.shape[-1], dtype=bool)
        if self.sleeps:
            legal |= ~(np.abs(array) <= MOST)
        return array[~legal]

    def __str__(self) -> str:
        ends = f"{self.least:.9g} … {self.most:.9g}"
        return ends if self.diagonal == -inf else f"{ends}, and {self.diagonal:.9g} or more on the diagonal"

    def asleep(self) -> Range:
        """These, and those of a member of an ensemble that diverges, or has: it sleeps."""
        return replace(self, sleeps=True)


FINITE = Range(-MOST, MOST)
NOT_NEGATIVE = Range(0.0, MOST)
POSITIVE = Range(LEAST, MOST)
MODEST = Range(1e-12, 1e12)  # the scale of parameters: a mass, kg, or the inverse of a speed
POSITIVE_OR_INFINITE = Range(LEAST, inf)
UNIT = Range(0.0, 1.0)
FACTOR = Range(LEAST, 1.0)
BELOW_ONE = Range(0.0, 1 - 2.0**-24)  # in float32, too
AT_MOST_TEN = Range(0.0, 10.0)  # the exponent of what is multiplied at every step
WEIGHT = Range(0.0, 1.001)  # a share, to rounding
TRIANGLE = Range(-MOST, MOST, diagonal=LEAST)  # the Cholesky factor of a covariance
ANY = Range(-inf, inf, sleeps=True)


class Field(NamedTuple):
    """A leaf of a state."""

    shape: tuple[int, ...]  # without the batch
    legal: Range = FINITE
    flag: bool = False  # whether it is bool


class Vector(NamedTuple):
    """Several numbers of one name."""

    length: Callable[[int], int]  # of the estimator's size, or the count of a rule's members
    legal: Range


@dataclass(frozen=True)
class Family:
    """What the kernels need to know of one kind of estimator, wrapper or rule, and what is legal of it.

    Attributes:
        fields: the leaves of its state, by name, in the order in which the kernels have them, from its size.
        numbers: its parameters by name, in the order in which the kernels have them.
        vectors: its parameters that are several numbers each, behind the others, likewise.
        choices: the values that each of its other entries may have.
        size: the sizes that it may have; None: that of its regressor, whose terms it names.
        projects: whether its parameters may have signs.
    """

    fields: Callable[[int], dict[str, Field]]
    numbers: Mapping[str, Range] = field(default_factory=dict)
    vectors: Mapping[str, Vector] = field(default_factory=dict)
    choices: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)
    size: Range | None = Range(0, 0)
    projects: bool = False
