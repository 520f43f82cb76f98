"""The schema of a family: state arrays, parameters, options, legal ranges.

The layer reads the names, the kernel the places, the engine both, and `engine.validate` the ranges. A family is an
estimator, a wrapper, a combiner, or another part of an ensemble. It declares in its `state.py`

    class Number(Parameters):       numbers, by name; each has its legal range, and perhaps a default
        GAIN = POSITIVE
    class Vector(ParameterVectors): several numbers of one name, as many as the size says
    class Choice(Options):          one of several allowed values
    FAMILY = Family(("aid",), lambda p: AIDState(theta=leaf(p), surge=leaf()), Number, Choice, Vector)
    AT = FAMILY.at                  an AIDState that holds places

A default, as in `LEAK = BELOW_ONE, 0.0`, is what a description states where an estimator has no such attribute, or
None: the value that leaves the steps as they are without. A description that lacks the entry means it, too, so
checkpoints and priors from before there was such a number open.

`engine.program` writes a row of integers for each part: the places of its leaves, numbers and vectors, and its choices.
A kernel receives this row as `node`, and the state `s` and the numbers `q` of one batch element:

    numbers = q[node[Row.NUMBERS] :]
    numbers[Number.GAIN], s[node[AT.surge]], q[node[Vector.SPREAD] + i], node[Choice.FEEDBACK]
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from itertools import count
from math import inf
from typing import Any, Generic, TypeVar

import numpy as np

from usvlearn.core.samples import named_leaves

S = TypeVar("S")

LEAST, MOST = 1e-30, 1e30  # of a positive number: its inverse is finite in float32, and its eighth power in float64


@dataclass(frozen=True)
class Range:
    """The numbers from `least` to `most`, both included; NaN is outside."""

    least: float
    most: float
    diagonal: float = -inf  # the least number on the diagonal of a square matrix
    diverged: bool = False  # whether NaN, infinity, and numbers beyond ±1e30 are legal too
    index: bool = False  # whether a kernel takes it for a place: a member that has diverged may hold no other number

    def wrong(self, array: np.ndarray) -> np.ndarray:
        """The numbers that are not legal, `(count,)`."""
        legal = (array >= self.least) & (array <= self.most)
        if self.diagonal > -inf:
            legal &= (array >= self.diagonal) | ~np.eye(array.shape[-1], dtype=bool)
        if self.diverged:
            legal |= ~(np.abs(array) <= MOST)
        return array[~legal]

    def __str__(self) -> str:
        ends = f"{self.least:.9g} … {self.most:.9g}"
        return ends if self.diagonal == -inf else f"{ends}, and {self.diagonal:.9g} or more on the diagonal"

    def inactive(self) -> Range:
        """This range, and the values of a member that has diverged (it is inactive)."""
        return replace(self, diverged=not self.index)


FINITE = Range(-MOST, MOST)
NOT_NEGATIVE = Range(0.0, MOST)
POSITIVE = Range(LEAST, MOST)
MODEST = Range(1e-12, 1e12)  # the scale of parameters: a mass, kg, or the inverse of a speed
POSITIVE_OR_INFINITE = Range(LEAST, inf)
UNIT = Range(0.0, 1.0)
FACTOR = Range(LEAST, 1.0)
BELOW_ONE = Range(0.0, 1 - 2.0**-24)  # in float32, too
AT_MOST_TEN = Range(0.0, 10.0)  # the exponent of a factor that is applied at every step
WEIGHT = Range(0.0, 1.001)  # a share, with room for rounding
TRIANGLE = Range(-MOST, MOST, diagonal=LEAST)  # the Cholesky factor of a covariance
ANY = Range(-inf, inf, diverged=True)


class Row(IntEnum):
    """The first places in the row of a part; those that the part declares follow.

    The first row of a table describes the whole. Where others have choices, it has what is below `ROBUST`.
    """

    FAMILY = 0  # index in the list of families
    KIND = 1  # index in its family's kinds
    SIZE = 2
    NUMBERS = 3  # place of the first number
    BEGIN = 4  # place of the estimator's state, which `Robust` restores where it refuses a sample,
    END = 5  # and the place behind it
    ROBUST = 6  # the row of the wrapper; −1 without
    ESTIMATORS = 7  # how many there are
    RULES = 8  # of combiners; 0: one estimator alone
    NAMES = 9  # estimators and combiners
    OUTPUT = 10  # the column whose prediction is the ensemble's
    KEPT = 11  # place in the work array of the copy of a state that `Robust` may restore
    HEADS = 12  # whether an estimator needs the heading
    CONFORMAL = 13  # rows of these parts, −1 without
    MONITORS = 14
    FORECASTS = 15
    CONDITIONAL = 16  # what intervals of forecasts know of the manoeuvre
    ACCOMMODATION = 17
    EXTERNAL = 18  # how many columns behind a prepared sample have predictions of other code


CHOICES, VECTORS, LEAVES, WIDTH = 7, 14, 22, 58  # where each begins in a row, and the row's length
FEEDBACK = ("measured", "estimate")  # the speed from which the next step departs
ESTIMATE = FEEDBACK.index("estimate")


@dataclass(frozen=True)
class Field:
    """A leaf of a state."""

    shape: tuple[int, ...]  # without the batch
    legal: Range = FINITE
    flag: bool = False  # whether it is bool


def leaf(*shape: int, legal: Range = FINITE, flag: bool = False) -> Any:
    """A `Field`, typed so that it can stand for a tensor in a state."""
    return Field(shape, legal, flag)


class Named(IntEnum):
    """Members are numbered in the order of their declaration. A description has their names in lower case."""

    default: Any  # the value of an entry that is absent; None: it must be stated

    @property
    def key(self) -> str:
        return self.name.lower()

    @classmethod
    def _member(cls, first: int, end: float) -> Any:
        place = first + len(cls.__members__)
        if place >= end:
            raise TypeError(f"{cls.__module__}.{cls.__name__}: found more than {end - first} members: widen the table")
        member = int.__new__(cls, place)
        member._value_, member.default = place, None
        return member


class Parameters(Named):
    """Named numbers with their legal range and perhaps a default; a value is an offset from the part's first number."""

    legal: Range

    def __new__(cls, legal: Range, default: float | None = None) -> Any:
        member = cls._member(0, inf)
        member.legal, member.default = legal, default
        return member


class ParameterVectors(Named):
    """Named vectors with their legal range and their length, which is the size unless stated.

    A value is the place in a row that holds the place of the vector's first number.
    """

    legal: Range
    length: Callable[[Any], int]

    def __new__(cls, legal: Range, length: Callable[[Any], int] = lambda size: size) -> Any:
        member = cls._member(VECTORS, LEAVES)
        member.legal, member.length = legal, length
        return member


class Options(Named):
    """Named choices with what is allowed: some values, or the whole numbers of a `Range`, and perhaps a default.

    Where one value alone is allowed, it is the default. A value is the place in a row that holds the choice: the index
    of the chosen value, or the whole number itself.
    """

    allowed: tuple[Any, ...]

    def __new__(cls, *allowed: Any) -> Any:
        member = cls._member(CHOICES, VECTORS)
        member.allowed = allowed
        member.default = allowed[-1] if len(allowed) == 1 + isinstance(allowed[0], Range) else None
        return member

    @property
    def whole(self) -> Range | None:
        """The range of the whole numbers that are allowed, or None."""
        return self.allowed[0] if isinstance(self.allowed[0], Range) else None


@dataclass(frozen=True)
class Family(Generic[S]):
    """What a family declares."""

    kinds: tuple[str, ...]  # its names in descriptions
    state: Callable[..., S]  # from the size (of forecasts a tuple), and the values of `lengths`, a state of `Field`s
    numbers: type[Parameters] = Parameters
    choices: type[Options] = Options
    vectors: type[ParameterVectors] = ParameterVectors
    size: Range | Callable[[Mapping[str, Any]], int] = Range(0, 0)  # the legal ones, or that of a description
    lengths: tuple[Options, ...] = ()  # choices that size the state, too: whole numbers
    work: Callable[[int], int] = lambda size: 0  # the length of the work array that its kernel needs
    heading: Callable[[Mapping[str, Any]], bool] = lambda own: False  # whether a description needs the heading
    frozen: tuple[str, ...] | None = None  # leaves that `free_step` reads or changes, by dotted name; None: all
    instead: Mapping[str, tuple[str, str]] = field(default_factory=dict)  # a leaf in place of it while a flag is 1

    @property
    def at(self) -> S:
        """A state that holds, for each leaf, the place in a row that holds the leaf's place."""
        return _counted(self.state(1, *(1 for _ in self.lengths)), count(LEAVES))

    def leaves(self, size: Any, prefix: str, own: Mapping[str, Any]) -> dict[str, Field]:
        """The leaves of its state by dotted name, in its order; `own` is its entries in a description."""
        lengths = (own[choice.key] for choice in self.lengths)
        return {prefix + name: each for name, each in named_leaves(self.state(size, *lengths))}


def defaults(declared: Iterable[Named]) -> dict[str, Any]:
    """What a description that lacks them has: the defaults by name."""
    return {each.key: each.default for each in declared if each.default is not None}


def _counted(tree: Any, places: Iterator[int]) -> Any:
    """A tree of fields as a tree of places; a part without leaves is an empty tuple."""
    if isinstance(tree, Field):
        if (place := next(places)) >= WIDTH:
            raise TypeError(f"found more than {WIDTH - LEAVES} leaves: widen the table")
        return place
    return type(tree)(*(_counted(each, places) for each in tree)) if isinstance(tree, tuple) else ()
