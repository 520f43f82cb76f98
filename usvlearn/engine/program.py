"""Lowers a description to what the kernels interpret: a table, numbers, and the places of the leaves.

The table has a row for the whole, for each estimator, for each combiner, and for each other part, in this order. A boat
in the plane has those of its three ensembles one behind the other, and the places of its tracks.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from math import prod
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from usvlearn.core.family import LEAVES, WIDTH, Field, Row
from usvlearn.core.prepared_samples import ROW
from usvlearn.engine.parts import ESTIMATORS, Description, Entry, Part, elsewhere, parts
from usvlearn.errors import ShapeError
from usvlearn.estimators.ensemble.combiners.state import RULES
from usvlearn.estimators.ensemble.forecasts.state import Choice as ForecastChoice
from usvlearn.estimators.ensemble.manoeuvre_intervals.state import PATH
from usvlearn.estimators.planar import state as at
from usvlearn.estimators.planar.state import AXES, PLACES, filter_of

if TYPE_CHECKING:
    from numpy.typing import DTypeLike

OTHERS = "conformal", "monitors", "forecasts", "conditional", "accommodation"  # whose rows the first row names


def program_for(description: Description, batch: Sequence[int], dtype: DTypeLike) -> Program:
    """The `Program`, cached, because a replay needs the same one for every chunk."""
    return _program(json.dumps(description), tuple(batch), np.dtype(dtype))


@lru_cache(maxsize=8)
def _program(description: str, batch: tuple[int, ...], dtype: np.dtype) -> Program:
    return Program(json.loads(description), batch, dtype)


class Leaf(NamedTuple):
    """Where a leaf lies in the row of a batch element."""

    place: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]  # in numbers
    flag: bool  # whether it is bool


class Program:
    """A table, its numbers and the places of the leaves, for one estimator and batch, from its description.

    Attributes:
        program: the table, int64.
        head: of the surge alone zeros; else the places of the axes and of the tracks (`estimators.planar.state`).
        numbers: `(1, …)`, or `(elements, …)` where some differ by batch element.
        leaves: where each leaf lies, by dotted name.
        size: of a batch element's row.
        slot: length of a slot of forecasts, of the surge.
        length: of a slot of tracks.
        work: length of the array that the kernels work in.
        external: how many members of the surge other code steps; their predictions come last in the work array.
        elsewhere: prefixes of the leaves of those members, which are not in a row.

    Raises:
        ShapeError: a hyperparameter does not broadcast against the batch.
    """

    def __init__(self, description: Description, batch: Sequence[int] = (), dtype: DTypeLike = np.float64):
        self.batch, self.dtype = tuple(batch), np.dtype(dtype)
        self.elements, self.elsewhere = prod(self.batch), tuple[str, ...]()
        self.leaves: dict[str, Leaf] = {}
        self.size = self.slot = self.length = self.external = 0
        self._columns: list[np.ndarray] = []  # (1,) or (elements,) each
        self._copies: list[int] = []  # of each leaf that is copied: see `engine.forecasting`
        self._copied: dict[str, Field] = {}
        if description["kind"] == "planar":
            self._side_by_side(description)
        else:
            self._alone(list(parts(description)))
        elements = max((len(column) for column in self._columns), default=1)
        self.numbers = np.empty((elements, len(self._columns)), self.dtype)
        for place, column in enumerate(self._columns):
            self.numbers[:, place] = column
        item = self.dtype.itemsize
        rows = [item * self.size * stride for stride in _strides(self.batch)]
        self._layout = {
            name: ((*self.batch, *leaf.shape), item * leaf.place, (*rows, *(item * x for x in leaf.strides)))
            for name, leaf in self.leaves.items()
        }

    def pack(self, leaves: Mapping[str, np.ndarray]) -> np.ndarray:
        """States, `(elements, size)`, from leaves `(*batch, …)` by dotted name; a ShapeError where they do not fit."""
        if other := sorted(n for n in self.leaves.keys() ^ leaves.keys() if not n.startswith(self.elsewhere)):
            raise ShapeError(
                f"leaves: found {', '.join(other[:4])} in only one of the state and the description, "
                "expected the same leaves in both"
            )
        for name, (shape, _, _) in self._layout.items():
            if leaves[name].shape != shape:
                raise ShapeError(f"{name}: found the shape {leaves[name].shape}, expected {shape}")
        states = np.empty((self.elements, self.size), self.dtype)
        for name, view in self._views(states).items():
            view[...] = leaves[name]
        return states

    def unpack(self, states: np.ndarray) -> dict[str, np.ndarray]:
        """Leaves `(*batch, …)` by dotted name: views of the states, but for those that are bool."""
        return {name: self.typed(name, view) for name, view in self._views(states).items()}

    def view(self, states: np.ndarray, name: str) -> np.ndarray:
        """One leaf `(*batch, …)`, a view of the states."""
        shape, offset, strides = self._layout[name]
        return np.ndarray(shape, self.dtype, states, offset, strides)

    def typed(self, name: str, array: np.ndarray) -> np.ndarray:
        """The numbers of a leaf, converted to bool where the leaf is bool."""
        return array.astype(bool) if self.leaves[name].flag else array

    def places(self, name: str) -> np.ndarray:
        """The places of a leaf's numbers in a batch element's row, in the leaf's shape."""
        leaf = self.leaves[name]
        places = np.full(leaf.shape, leaf.place)
        for axis, (length, stride) in enumerate(zip(leaf.shape, leaf.strides, strict=True)):
            places += (np.arange(length) * stride).reshape([-1 if k == axis else 1 for k in range(len(leaf.shape))])
        return places

    def _views(self, states: np.ndarray) -> dict[str, np.ndarray]:
        return {name: self.view(states, name) for name in self._layout}

    def _alone(self, all_parts: Sequence[Part]) -> None:
        """Lay out an estimator, or an ensemble."""
        estimators: list[list[int]] = []
        rules: list[list[int]] = []
        others: list[list[int]] = []
        copies: list[tuple[int, int]] = []  # the number of the row of each, and the column
        forecasts: list[int] = []
        members = [part for part in all_parts if part.role == "estimator"]
        first = 1 + len(members) + sum(part.role == "rule" for part in all_parts)
        whole, links, largest = [-1] * WIDTH, dict[Row, int](), 0
        for part in all_parts:
            role, columns, work = part.role, part.columns, part.family.work(part.size)
            column = columns[0] if role == "copy" else 0
            row = self._copy(part, members[column], estimators[column]) if role == "copy" else self._row(part)
            if role == "estimator":
                row[Row.FAMILY] = ESTIMATORS.index(part.family)
                row[Row.KIND] = part.family.kinds.index(part.own["kind"])
                estimators.append(row)
            elif role == "rule":
                row[Row.FAMILY], work = list(RULES).index(part.own["kind"]), 2 * len(members) + work
                rules.append([*row, *columns])
            elif role == "ensemble":
                whole = row
                whole[Row.OUTPUT] = len(members) + list(part.own["rules"]).index(part.own["output"])
            else:
                number = first + len(others)
                others.append(row)
                if role in OTHERS:
                    links[Row[role.upper()]] = number
            if role == "robust":
                estimators[-1][Row.ROBUST] = number
            elif role == "copy":
                copies.append((number, columns[0]))
            elif role == "forecasts":
                forecasts, work = row, largest + 2 * part.size[2] + PATH
            elif role == "accommodation":
                row += [len(columns), *(1 + column for column in columns)]
            elif role in ("conformal", "monitors"):
                work += part.size
            largest = max(largest, work)
        if copies:
            forecasts += [self._place_copies(), *(row for row, _ in copies), *(column for _, column in copies)]
            forecasts += [len(self._copies) // 5, *self._copies]
            forecasts[Row.SIZE] = self.slot
        for place, number in links.items():
            whole[place] = number
        whole[Row.ESTIMATORS], whole[Row.RULES] = len(estimators), len(rules)
        whole[Row.NAMES] = len(estimators) + len(rules) if rules else 0
        whole[Row.HEADS] = any(part.family.heading(part.own) for part in members)
        self.elsewhere = elsewhere(members)
        whole[Row.EXTERNAL] = self.external = len(self.elsewhere)
        backup = max(row[Row.END] - row[Row.BEGIN] for row in estimators)
        whole[Row.KEPT], self.work = largest, largest + backup + ROW + self.external
        self.program, self.head = _stacked([whole, *estimators, *rules, *others]), np.zeros((1, PLACES), np.int64)

    def _side_by_side(self, description: Description) -> None:
        """Lay out the ensembles of a boat in the plane one behind the other, and the tracks."""
        (part,) = (part for part in parts(description) if part.role == "track")
        slots, count, self.length = part.size
        self.head, self.work = np.zeros((len(AXES) + 1, PLACES), np.int64), 0
        block, tables = at.slot_length(count, ()), list[np.ndarray]()
        for row, axis in zip(self.head, AXES, strict=False):
            ensemble, program = description[axis], program_for(description[axis], self.batch, self.dtype)
            name, leaves, table = filter_of(axis, ensemble), program.leaves, program.program
            member, forecasts = f"members.{name}.", table[table[0, Row.FORECASTS]]
            weights = block + program.slot
            row[: at.DEVIATION + 1] = (
                sum(map(len, tables)), self.size, len(self._columns), leaves[f"{member}mean"].place,
                0 if axis == "surge" else leaves[f"{member}updates"].place, block, weights,
                leaves["predictions"].place + ensemble["columns"].index(name), leaves[f"{member}deviation"].place,
            )  # fmt: skip
            block = weights + forecasts[ForecastChoice.HORIZONS] * forecasts[ForecastChoice.MEMBERS]
            for leaf, each in leaves.items():
                self.leaves[f"{axis}.{leaf}"] = each._replace(place=each.place + self.size)
            tables.append(table)
            self._columns += list(program.numbers.T)
            self.size, self.work = self.size + program.size, max(self.work, program.work + 4 * ROW)
            self.slot, self.external = self.slot or program.slot, self.external + program.external
            self.elsewhere += tuple(f"{axis}.{each}" for each in program.elsewhere)
        tracks = self._row(part)
        places, sizes = tracks[LEAVES : LEAVES + at.LEARNED + 6], (slots, count, self.length, tracks[Row.NUMBERS])
        self.head[-1] = *places[: at.DUES], places[-1], *places[at.DUES : -1], *sizes
        self.program = _stacked([row for table in tables for row in table])

    def _row(self, part: Part) -> list[int]:
        """Add the leaves, numbers and choices of a part; returns its row."""
        row = [-1] * WIDTH
        row[Row.SIZE] = part.size if isinstance(part.size, int) else 0
        row[Row.BEGIN], row[Row.NUMBERS] = self.size, len(self._columns)
        for place, (name, field) in enumerate(part.leaves().items(), LEAVES):
            self.leaves[name] = Leaf(self.size, field.shape, _strides(field.shape), field.flag)
            row[place] = self.size
            self.size += prod(field.shape)
        row[Row.END] = self.size
        for choice in part.family.choices:
            value = part.own[choice.key]
            row[choice] = value if choice.whole else choice.allowed.index(value)
        for each in part.numbers:
            if each.vector is not None:
                row[each.vector] = len(self._columns)
            self._add(each)
        return row

    def _add(self, entry: Entry) -> None:
        """Add numbers, `(*batch,)`, or `(*batch, length)` of a vector."""
        value = np.asarray(entry.value, float)
        try:
            array = np.broadcast_to(
                value if entry.vector is not None else value[..., None], (*self.batch, entry.length)
            )
        except ValueError as error:
            raise ShapeError(f"{entry.name}: found the shape {value.shape}, expected one for {self.batch}") from error
        array = array.reshape(self.elements, entry.length)
        self._columns += list((array[:1] if (array == array[:1]).all() else array).T)

    def _copy(self, part: Part, member: Part, row: Sequence[int]) -> list[int]:
        """The row of a copy of a member: its leaves lie in a slot of forecasts; `row` is the member's."""
        names = [name.removeprefix(member.prefix) for name in member.leaves()]
        places = dict.fromkeys(names, -1)
        for name, field in part.leaves().items():
            leaf, length = name.removeprefix(part.prefix), prod(field.shape[1:])
            pair = [f"{member.prefix}{each}" for each in part.family.instead.get(leaf, ())]
            instead = [self.leaves[each].place for each in pair if each in self.leaves] or [-1, -1]
            self._copies += [self.leaves[member.prefix + leaf].place, self.slot, length, *instead]
            places[leaf] = self.slot
            self._copied[name], self.leaves[name] = field, Leaf(self.slot, (), (), field.flag)  # its place in a slot
            self.slot += length
        copy = [*row[:LEAVES], *places.values(), *row[LEAVES + len(names) :]]
        copy[Row.ROBUST] = -1
        return copy

    def _place_copies(self) -> int:
        """Place the leaves of the copies in their slots; returns the place of the first slot."""
        first, slots = self.size, 0
        for name, field in self._copied.items():
            slots, place = field.shape[0], first + self.leaves[name].place
            self.leaves[name] = Leaf(place, field.shape, (self.slot, *_strides(field.shape[1:])), field.flag)
        self.size += slots * self.slot
        return first


def _strides(shape: Sequence[int]) -> tuple[int, ...]:
    """How many numbers lie from one to the next along each axis."""
    return tuple(prod(shape[k + 1 :]) for k in range(len(shape)))


def _stacked(rows: Sequence[Sequence[int] | np.ndarray]) -> np.ndarray:
    """Rows as a table, filled up with −1."""
    table = np.full((len(rows), max(map(len, rows))), -1, np.int64)
    for place, row in zip(table, rows, strict=True):
        place[: len(row)] = row
    return table
