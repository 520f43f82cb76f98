"""Lowers a description to what the kernels interpret: a table, numbers, and the places of the leaves.

A description (`Estimator.description`) has JSON values only: `kind`, `size`, `numbers` and `vectors` by name
(hyperparameters broadcast against the batch), the choices, and the description of the estimator that it wraps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from usvlearn.core.family import LEAVES, WIDTH, Family, Field, Row
from usvlearn.core.prepared_samples import ROW
from usvlearn.engine.dispatch import Whole
from usvlearn.engine.leaves import KNOWN, Description, Part, copied, forecast_size, frozen, unwrapped
from usvlearn.engine.registry import ESTIMATORS, KINDS
from usvlearn.errors import ShapeError
from usvlearn.estimators.ensemble import state as ensemble
from usvlearn.estimators.ensemble.accommodation import state as accommodation
from usvlearn.estimators.ensemble.combiners.state import RULES
from usvlearn.estimators.ensemble.conformal import state as conformal
from usvlearn.estimators.ensemble.forecasts import state as forecasts
from usvlearn.estimators.ensemble.manoeuvre_intervals import state as conditional
from usvlearn.estimators.ensemble.monitors import state as monitors
from usvlearn.estimators.planar.state import PLACES
from usvlearn.estimators.wrappers.robust.state import FAMILY as ROBUST

if TYPE_CHECKING:
    from numpy.typing import DTypeLike


class Leaf(NamedTuple):
    """Where a leaf lies in the row of a batch element."""

    place: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]  # in numbers
    flag: bool  # whether it is bool


class Program:
    """A table, its numbers and the places of the leaves, for one estimator and batch.

    Args:
        description: of an estimator, as `Estimator.description` gives it.
        batch: of its state.
        dtype: of the state, float64 or float32.

    Attributes:
        program: the table, int64.
        head: of the surge alone zeros; else the places of the axes (`estimators.planar.state`).
        numbers: `(1, …)`, or `(elements, …)` where some differ by batch element.
        leaves: where each leaf lies, by dotted name.
        size: of a batch element's row.
        slot: length of a slot of forecasts.
        work: length of the array that the kernels work in.

    Raises:
        ShapeError: a hyperparameter does not broadcast against the batch.
    """

    def __init__(self, description: Description, batch: Sequence[int] = (), dtype: DTypeLike = np.float64):
        self.batch, self.dtype = tuple(batch), np.dtype(dtype)
        self.elements = int(np.prod(self.batch, dtype=int))
        self.leaves: dict[str, Leaf] = {}
        self.size = self.slot = 0
        self._columns: list[np.ndarray] = []  # (1,) or (elements,) each
        self._largest, self._kept = 0, 1
        self._estimators: list[list[int]] = []
        self._rules: list[list[int]] = []
        self._others: list[list[int]] = []
        whole = self._ensemble(description) if description["kind"] == "ensemble" else self._alone(description)
        whole[Whole.KEPT] = self._largest
        self.program, self.head = self._table(whole), np.zeros((1, PLACES), np.int64)
        self.work = self._largest + self._kept + ROW
        elements = max((len(column) for column in self._columns), default=1)
        self.numbers = np.empty((elements, len(self._columns)), self.dtype)
        for place, column in enumerate(self._columns):
            self.numbers[:, place] = column
        self._lay_out()

    def _lay_out(self) -> None:
        """Find the places of all leaves in the states of a batch."""
        item = self.dtype.itemsize
        rows = [item * self.size * int(np.prod(self.batch[k + 1 :], dtype=int)) for k in range(len(self.batch))]
        self._layout = {
            name: ((*self.batch, *leaf.shape), item * leaf.place, (*rows, *(item * x for x in leaf.strides)))
            for name, leaf in self.leaves.items()
        }

    def pack(self, leaves: Mapping[str, np.ndarray]) -> np.ndarray:
        """States, `(elements, size)`, from leaves `(*batch, …)` by dotted name; a ShapeError where they do not fit."""
        if other := sorted(self.leaves.keys() ^ leaves.keys()):
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
        found = np.full(leaf.shape, leaf.place)
        for axis, (length, stride) in enumerate(zip(leaf.shape, leaf.strides, strict=True)):
            found += (np.arange(length) * stride).reshape([-1 if k == axis else 1 for k in range(len(leaf.shape))])
        return found

    def _views(self, states: np.ndarray) -> dict[str, np.ndarray]:
        return {name: self.view(states, name) for name in self._layout}

    def _table(self, whole: list[int]) -> np.ndarray:
        """The table of all rows; indices of wrappers and other parts become row numbers."""
        rows = [whole, *self._estimators, *self._rules, *self._others]
        first = len(rows) - len(self._others)
        estimators = list(self._estimators)
        if whole[Whole.FORECASTS] >= 0:
            made = self._others[whole[Whole.FORECASTS]]
            for k in range(WIDTH + 1, WIDTH + 1 + made[forecasts.Choice.MEMBERS]):
                estimators.append(self._others[made[k]])
                made[k] += first
        for row in estimators:
            row[Row.ROBUST] += first if row[Row.ROBUST] >= 0 else 0
        for part in (Whole.CONFORMAL, Whole.MONITORS, Whole.FORECASTS, Whole.KNOWN, Whole.ACCOMMODATION):
            whole[part] += first if whole[part] >= 0 else 0
        table = np.full((len(rows), max(map(len, rows))), -1, np.int64)
        for place, row in zip(table, rows, strict=True):
            place[: len(row)] = row
        return table

    def _part(self, family: Family[Any], own: Description, size: Any, prefix: str, name: str) -> list[int]:
        """Add the leaves, numbers and choices of one part with the entries `own`; returns its row."""
        row = [-1] * WIDTH
        row[Row.SIZE], row[Row.BEGIN], row[Row.NUMBERS] = size, self.size, len(self._columns)
        for place, (leaf, field) in enumerate(family.leaves(size, prefix, own).items(), LEAVES):
            row[place] = self._place(leaf, field)
        row[Row.END] = self.size
        for number in family.numbered(own):
            value = np.asarray(own["numbers"][number.key], float)[..., None]
            self._vector(value, 1, f"{name}: {number.key}")
        for vector in family.vectors:
            value = own["vectors"][vector.key]
            row[vector] = self._vector(value, vector.length(size), f"{name}: {vector.key}")
        for choice in family.chosen(own):
            value = own[choice.key]
            row[choice] = value if choice.whole else choice.allowed.index(value)
        self._largest = max(self._largest, family.work(size))
        return row

    def _place(self, name: str, field: Field) -> int:
        """Add a leaf; returns its place."""
        first, shape = self.size, field.shape
        strides = tuple(int(np.prod(shape[k + 1 :], dtype=int)) for k in range(len(shape)))
        self.leaves[name] = Leaf(first, shape, strides, field.flag)
        self.size += int(np.prod(shape, dtype=int))
        return first

    def _vector(self, value: Any, length: int, name: str) -> int:
        """Add a vector, `(*batch, length)`; returns the place of its first number."""
        first = len(self._columns)
        try:
            array = np.broadcast_to(np.asarray(value, float), (*self.batch, length))
        except ValueError as error:
            raise ShapeError(f"{name}: found the shape {np.shape(value)}, expected one for {self.batch}") from error
        array = array.reshape(self.elements, length)
        self._columns += list((array[:1] if (array == array[:1]).all() else array).T)
        return first

    def _alone(self, description: Description) -> list[int]:
        """Add one estimator; returns the row of the whole."""
        heads = self._estimator(description, "")
        return self._whole([-1] * WIDTH, names=0, heads=heads)

    def _whole(self, row: list[int], names: int, heads: bool) -> list[int]:
        row[Whole.ESTIMATORS], row[Whole.RULES] = len(self._estimators), len(self._rules)
        row[Whole.NAMES], row[Whole.HEADS] = names, int(heads)
        return row

    def _estimator(self, description: Description, outer: str) -> bool:
        """Add one estimator, and the `Robust` around it; returns whether it needs the heading."""
        own, prefix, robust = unwrapped(description, outer)
        kind, family = own["kind"], KINDS[own["kind"]]
        row = self._part(family, own, own["size"], prefix, prefix.rstrip(".") or kind)
        row[Row.FAMILY], row[Row.KIND] = ESTIMATORS.index(family), family.kinds.index(kind)
        if robust is not None:
            row[Row.ROBUST] = len(self._others)
            self._others.append(self._part(ROBUST, robust, 0, outer, outer))
        self._estimators.append(row)
        self._kept = max(self._kept, row[Row.END] - row[Row.BEGIN])
        return family.heading(own)

    def _ensemble(self, description: Description) -> list[int]:
        """Add members, combiners, intervals and monitors; returns the row of the whole."""
        heads = [self._estimator(member, f"members.{name}.") for name, member in description["members"].items()]
        count, rules = len(self._estimators), description["rules"]
        names = count + len(rules)
        for name, rule in rules.items():
            self._rules.append(self._rule(rule, name, count))
        row = self._part(ensemble.FAMILY, description, names, "", "ensemble")
        self._whole(row, names, any(heads))
        row[Whole.OUTPUT] = count + list(rules).index(description["output"])
        own = {"conditional": description.get("conditional", 0)}
        for place, part, name in (
            (Whole.CONFORMAL, conformal.FAMILY, "conformal"), (Whole.MONITORS, monitors.FAMILY, "monitors"),
        ):  # fmt: skip
            if (numbers := description[name]) is not None:
                row[place] = len(self._others)
                self._others.append(self._part(part, own | {"numbers": numbers}, names, f"{name}.", name))
                self._largest = max(self._largest, names + part.work(names))
        if made := description.get("forecasts"):
            forecast = self._forecasts(description, made)
            row[Whole.FORECASTS] = len(self._others)
            self._others.append(forecast)
            if description.get("conditional"):
                row[Whole.KNOWN] = len(self._others)
                known = self._part(conditional.FAMILY, {}, forecast_size(made)[:2], KNOWN, "forecasts")
                known[Row.SIZE] = 0  # the table has whole numbers only
                self._others.append(known)
        if given := description.get("accommodation"):
            row[Whole.ACCOMMODATION] = len(self._others)
            own_row = self._part(accommodation.FAMILY, given, 0, "accommodation.", "accommodation")
            self._others.append([*own_row, len(given["members"]), *(1 + column for column in given["members"])])
        return row

    def _forecasts(self, description: Description, made: Description) -> list[int]:
        """Add the forecasts; returns their row, and what follows it (`engine.forecasting`)."""
        slots, horizons, members = size = forecast_size(made)
        place = self._vector(made[forecasts.FIT]["table"], forecasts.TABLE, "fit") if forecasts.FIT in made else -1
        own = {**made, "horizons": horizons, "members": members, forecasts.FIT: place}
        row = self._part(forecasts.FAMILY, own, size, "forecasts.", "forecasts")
        begin, columns, block = self.size, [column for _, column in copied(description)], 0
        rows: list[int] = []
        copies: list[int] = []
        for name, column in copied(description):
            member = description["columns"][column]
            node, block = self._frozen(self._estimators[column], description, member, name, block, copies)
            rows.append(node)
        for name, (place, shape, strides, flag) in list(self.leaves.items()):
            if name.startswith("forecasts.frozen."):
                self.leaves[name] = Leaf(begin + place, (slots, *shape), (block, *strides), flag)
        self.size += slots * block
        row[Row.SIZE] = self.slot = block
        self._largest += 2 * members + conditional.PATH
        return [*row, begin, *rows, *columns, len(copies) // 5, *copies]

    def _instead(self, part: Part, prefix: str, leaf: str) -> tuple[int, int]:
        """The place of the leaf that is copied instead of this one, and of the flag that tells when; −1 without."""
        own = leaf.removeprefix(part.prefix)
        pair = KINDS[part.own["kind"]].instead.get(own, ("", "")) if leaf.startswith(part.prefix) else ("", "")
        found = [self.leaves.get(f"{prefix}{part.prefix}{name}") for name in pair]
        other, flag = (each.place if name and each else -1 for name, each in zip(pair, found, strict=True))
        return other, flag

    def _frozen(
        self, row: list[int], whole: Description, member: str, name: str, block: int, copies: list[int]
    ) -> tuple[int, int]:
        """Add the row of a member in a slot, whose leaves are at places in the slot; returns its index, and the end."""
        description = whole["members"][member]
        part, places = unwrapped(description), {}
        for leaf, field in frozen(description).items():
            source, length = self.leaves[f"members.{member}.{leaf}"], int(np.prod(field.shape, dtype=int))
            places[leaf] = block
            self.leaves[f"forecasts.frozen.{name}.{leaf}"] = source._replace(place=block)
            copies += [source.place, block, length, *self._instead(part, f"members.{member}.", leaf)]
            block += length

        family = KINDS[part.own["kind"]]
        leaves = [places.get(leaf, -1) for leaf in family.leaves(part.own["size"], part.prefix, part.own)]
        frozen_row = [*row[:LEAVES], *leaves, *row[LEAVES + len(leaves) :]]
        frozen_row[Row.ROBUST] = -1
        self._others.append(frozen_row)
        return len(self._others) - 1, block

    def _rule(self, rule: Description, name: str, count: int) -> list[int]:
        """Add a combiner of an ensemble of `count` columns; returns its row, followed by the columns of its members."""
        family, columns = RULES[rule["kind"]], rule["columns"]
        vectors, begin = {}, 0
        for vector in family.vectors:
            end = begin + vector.length(len(columns))
            vectors[vector.key], begin = rule["vector"][begin:end], end
        row = self._part(family, {**rule, "vectors": vectors}, len(columns), f"combiners.{name}.", name)
        row[Row.FAMILY] = list(RULES).index(rule["kind"])
        self._largest = max(self._largest, 2 * count + family.work(len(columns)))
        return [*row, *columns]
