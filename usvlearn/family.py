"""What a family of estimators declares, once: the leaves of its state, its numbers, its choices, and what is legal.

The layer reads the names here, the kernel the places, the engine both, and `engine.check` the ranges. A family is an
estimator with its twin, a wrapper, a rule, or another part of an ensemble. It declares in its `state.py`

    class Number(Numbers):          numbers, by name; each has its legal range
        GAIN = POSITIVE
    class Vector(Vectors):          several numbers of one name, as many as the size says
        SPREAD = NOT_NEGATIVE
    class Choice(Choices):          which of some values was chosen
        FEEDBACK = FEEDBACK
    FAMILY = Family(("aid",), lambda p: AIDState(theta=leaf(p), surge=leaf()), Number, Choice, Vector)
    AT = FAMILY.at                  an AIDState of places

The program writes a row of whole numbers for each part: where its leaves, numbers and vectors lie, and what was chosen.
A kernel is handed this row as `node`, the state `s` and the numbers `q` of a lane:

    numbers = q[node[Node.NUMBERS] :]
    numbers[Number.GAIN], s[node[AT.surge]], q[node[Vector.SPREAD] + i], node[Choice.FEEDBACK]
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import count
from math import inf
from typing import Any, Generic, TypeVar

import numpy as np

from usvlearn.signals import named_leaves

S = TypeVar("S")

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


class Node(IntEnum):
    """Places in a part's row of the table, before those that the part itself declares."""

    FAMILY = 0  # which of the list of families
    KIND = 1  # which of its family's kinds
    SIZE = 2
    NUMBERS = 3  # of the first number
    BEGIN = 4  # of the estimator's state,
    END = 5  # and behind it: what `Robust` restores where it refuses a sample
    MEMORY = 6  # the row of the wrapper; −1 without
    ROBUST = 7
    OUTER = 8  # whether `Robust` is around `WithMemory`


CHOICES, VECTORS, LEAVES, WIDTH = 9, 16, 24, 40  # where the places of these begin in a row, and its length
FEEDBACK = ("measured", "estimate")  # the speed from which the next step departs
ESTIMATE = FEEDBACK.index("estimate")


@dataclass(frozen=True)
class Field:
    """A leaf of a state."""

    shape: tuple[int, ...]  # without the batch
    legal: Range = FINITE
    flag: bool = False  # whether it is bool


def leaf(*shape: int, legal: Range = FINITE, flag: bool = False) -> Any:
    """A `Field` in the place of a tensor.

    >>> leaf(3, legal=UNIT).shape
    (3,)
    """
    return Field(shape, legal, flag)


class Named(IntEnum):
    """Members are counted in the order of their declaration. Their names in a specification are in lower case."""

    @property
    def key(self) -> str:
        return self.name.lower()

    @classmethod
    def _member(cls, first: int, end: float) -> Any:
        place = first + len(cls.__members__)
        if place >= end:
            raise TypeError(f"{cls.__module__}.{cls.__name__}: found more than {end - first} members: widen the table")
        member = int.__new__(cls, place)
        member._value_ = place
        return member


class Numbers(Named):
    """Numbers by name, with their legal range; the value is the place behind a part's first number.

    >>> class Number(Numbers):
    ...     GAIN = POSITIVE
    ...     SHARE = UNIT
    >>> [(each.key, int(each), str(each.legal)) for each in Number]
    [('gain', 0, '1e-30 … 1e+30'), ('share', 1, '0 … 1')]
    """

    legal: Range

    def __new__(cls, legal: Range) -> Any:
        member = cls._member(0, inf)
        member.legal = legal
        return member


class Vectors(Named):
    """Several numbers of one name, with their legal range and their count, which is the size unless stated.

    The value is the place in a row at which the place of the first of them stands.
    """

    legal: Range
    length: Callable[[int], int]

    def __new__(cls, legal: Range, length: Callable[[int], int] = lambda size: size) -> Any:
        member = cls._member(VECTORS, LEAVES)
        member.legal, member.length = legal, length
        return member


@dataclass(frozen=True)
class Each:
    """A list of choices, as many as the size says; they are kept among the numbers."""

    allowed: tuple[Any, ...]


class Choices(Named):
    """What was chosen, with what is allowed: some values, whole numbers of a `Range`, or `Each`.

    The value is the place in a row at which the choice stands: which of the values, or the whole number itself, or
    the place of the first of many.
    """

    allowed: tuple[Any, ...]

    def __new__(cls, *allowed: Any) -> Any:
        member = cls._member(CHOICES, VECTORS)
        member.allowed = allowed
        return member

    @property
    def whole(self) -> Range | None:
        """The whole numbers that are allowed, if it is one."""
        return self.allowed[0] if isinstance(self.allowed[0], Range) else None

    @property
    def each(self) -> tuple[Any, ...] | None:
        """The values of which each of a list is one, if it is a list."""
        return self.allowed[0].allowed if isinstance(self.allowed[0], Each) else None


@dataclass(frozen=True)
class Family(Generic[S]):
    """What a family declares.

    Attributes:
        kinds: the names by which specifications call it.
        state: a state of `Field`s, from the size.
        numbers, choices, vectors: what else it has.
        size: the sizes that it may have, or its size from its entries in a specification.
        optional: choices that are all there, or none.
        work: how many numbers its kernel needs to work with, from the size.
        heading: whether it asks for the heading, from its entries.
        remembers: whether it needs the inputs that `WithMemory` adds, from its entries.

    >>> from usvlearn.estimators.aid.state import FAMILY
    >>> FAMILY.at.surge - FAMILY.at.theta, list(FAMILY.leaves(9))
    (1, ['theta', 'surge'])
    """

    kinds: tuple[str, ...]
    state: Callable[[int], S]
    numbers: type[Numbers] = Numbers
    choices: type[Choices] = Choices
    vectors: type[Vectors] = Vectors
    size: Range | Callable[[Mapping[str, Any]], int] = Range(0, 0)
    optional: tuple[Choices, ...] = ()
    work: Callable[[int], int] = lambda size: 0
    heading: Callable[[Mapping[str, Any]], bool] = lambda own: False
    remembers: Callable[[Mapping[str, Any]], bool] = lambda own: False

    @property
    def at(self) -> S:
        """The state, with the place in a row at which the place of each leaf stands."""
        return _counted(self.state(1), count(LEAVES))

    def leaves(self, size: int, prefix: str = "") -> dict[str, Field]:
        """The leaves of its state by dotted name, in the order of the state."""
        return {prefix + name: each for name, each in named_leaves(self.state(size))}

    def chosen(self, own: Mapping[str, Any]) -> list[Choices]:
        """The choices that a specification must state."""
        stated = any(choice.key in own for choice in self.optional)
        return [choice for choice in self.choices if stated or choice not in self.optional]


def _counted(tree: Any, places: Iterator[int]) -> Any:
    """A tree of fields as one of numbers; what has no leaves is an empty tuple."""
    if isinstance(tree, Field):
        if (place := next(places)) >= WIDTH:
            raise TypeError(f"found more than {WIDTH - LEAVES} leaves: widen the table")
        return place
    return type(tree)(*(_counted(each, places) for each in tree)) if isinstance(tree, tuple) else ()
