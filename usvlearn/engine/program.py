"""From what an estimator says of itself to what the kernels interpret: a table, numbers, the places of the leaves.

An estimator describes itself (`Estimator.spec`) in plain values, which also fit into JSON: its `kind`, `numbers` and
`vectors` by name (hyperparameters broadcast against the batch), what kind of choices were made, and what it wraps.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from usvlearn import rows as samples
from usvlearn.engine import dispatch as step
from usvlearn.engine.leaves import Description, ensemble_fields, unwrapped
from usvlearn.errors import ShapeError
from usvlearn.estimators.ensemble import combiners_kernel as combiners
from usvlearn.estimators.ensemble import monitors_kernel as monitors
from usvlearn.estimators.regressors import kernel as regressors
from usvlearn.estimators.rnn import projection_kernel as stable
from usvlearn.family import Field

Setting = tuple[int, int] | None  # of a bank, and how many it has


class Leaf(NamedTuple):
    """Where a leaf lies in the row of a lane."""

    place: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]  # in numbers
    flag: bool  # whether it is bool


def plan_for(description: Description, batch: Sequence[int], dtype: np.dtype) -> Plan:
    """`Plan`, made once: a replay asks for the same one chunk after chunk."""
    return _plan(json.dumps(description), tuple(batch), np.dtype(dtype))


@lru_cache(maxsize=8)
def _plan(description: str, batch: tuple[int, ...], dtype: np.dtype) -> Plan:
    return Plan(json.loads(description), batch, dtype)


class Plan:
    """A table, its numbers and the places of the leaves, for one estimator and batch.

    Args:
        description: of an estimator, as `Estimator.spec` gives it.
        batch: of its state.
        dtype: of the state, float64 or float32.

    Attributes:
        program: the table, int64.
        numbers: `(1, …)`, or `(lanes, …)` where some differ by lane.
        leaves: where each leaf lies, by dotted name.
        size: of a lane's row.
        work: how many numbers the kernels need to work with.

    Raises:
        ShapeError: a hyperparameter does not broadcast against the batch.

    >>> one = Plan({"kind": "persistence", "size": 0, "numbers": {}})
    >>> one.unpack(np.ones((1, one.size)))["surge"]
    array(1.)
    """

    def __init__(self, description: Description, batch: Sequence[int] = (), dtype=np.float64):
        self.batch, self.dtype = tuple(batch), np.dtype(dtype)
        self.lanes = int(np.prod(self.batch, dtype=int))
        self.leaves: dict[str, Leaf] = {}
        self.size = 0
        self._columns: list[np.ndarray] = []  # (1,) or (lanes,) each
        self._largest, self._kept, self._heads = 0, 1, 0
        self._rows: list[list[int]] = []
        if description["kind"] == "ensemble":
            whole = self._ensemble(description)
        else:
            self._member(description, "")
            whole = {step.ESTIMATORS: len(self._rows)}
        width = max(16, *(len(row) for row in self._rows))
        self.program = np.full((len(self._rows) + 1, width), -1, np.int64)
        self.program[0] = 0
        for place, value in whole.items():
            self.program[0, place] = value
        for row, values in zip(self.program[1:], self._rows, strict=True):
            row[: len(values)] = values
        self.program[0, step.KEPT], self.program[0, step.HEADS] = self._largest, self._heads
        self.work = self._largest + self._kept + samples.ROW
        lanes = max((len(column) for column in self._columns), default=1)
        self.numbers = np.empty((lanes, len(self._columns)), self.dtype)
        for place, column in enumerate(self._columns):
            self.numbers[:, place] = column
        item = self.dtype.itemsize
        rows = [item * self.size * int(np.prod(self.batch[k + 1 :], dtype=int)) for k in range(len(self.batch))]
        self._layout = {
            name: ((*self.batch, *leaf.shape), item * leaf.place, (*rows, *(item * x for x in leaf.strides)))
            for name, leaf in self.leaves.items()
        }

    def pack(self, leaves: Mapping[str, np.ndarray]) -> np.ndarray:
        """States, `(lanes, size)`, from leaves `(*batch, …)` by dotted name; a ShapeError where they do not fit."""
        if other := sorted(self.leaves.keys() ^ leaves.keys()):
            raise ShapeError(f"leaves: {', '.join(other[:4])} are not in both the state and what its estimator says")
        for name, (shape, _, _) in self._layout.items():
            if leaves[name].shape != shape:
                raise ShapeError(f"{name}: found the shape {leaves[name].shape}, expected {shape}")
        states = np.empty((self.lanes, self.size), self.dtype)
        for name, view in self._views(states).items():
            view[...] = leaves[name]
        return states

    def unpack(self, states: np.ndarray) -> dict[str, np.ndarray]:
        """Leaves `(*batch, …)` by dotted name: views of the states, but for those that are bool."""
        return {name: self.typed(name, view) for name, view in self._views(states).items()}

    def typed(self, name: str, array: np.ndarray) -> np.ndarray:
        """What the kernels have of a leaf, as bool where the leaf is."""
        return array.astype(bool) if self.leaves[name].flag else array

    def places(self, name: str) -> np.ndarray:
        """Where the numbers of a leaf stand in a lane's row, in its shape."""
        leaf = self.leaves[name]
        found = np.full(leaf.shape, leaf.place)
        for axis, (length, stride) in enumerate(zip(leaf.shape, leaf.strides, strict=True)):
            found += (np.arange(length) * stride).reshape([-1 if k == axis else 1 for k in range(len(leaf.shape))])
        return found

    def _views(self, states: np.ndarray) -> dict[str, np.ndarray]:
        return {
            name: np.ndarray(shape, self.dtype, states, offset, strides)
            for name, (shape, offset, strides) in self._layout.items()
        }

    def _place(self, fields: Mapping[str, Field], prefix: str) -> int:
        """Add leaves; returns where the first lies."""
        first = self.size
        for name, (shape, _, flag) in fields.items():
            strides = tuple(int(np.prod(shape[k + 1 :], dtype=int)) for k in range(len(shape)))
            self.leaves[prefix + name] = Leaf(self.size, shape, strides, flag)
            self.size += int(np.prod(shape, dtype=int))
        return first

    def _numbers(self, values: Mapping[str, Any], order: Iterable[str], name: str, setting: Setting = None) -> int:
        """Add numbers; returns where the first stands."""
        first = len(self._columns)
        for key in order:
            self._vector(np.asarray(values[key], float)[..., None], 1, f"{name}: {key}", setting)
        return first

    def _vector(self, value: Any, length: int, name: str, setting: Setting = None) -> int:
        """Add so many numbers, `(*batch, length)`; returns where the first stands."""
        first, bank = len(self._columns), () if setting is None else (setting[1],)
        try:
            array = np.broadcast_to(np.asarray(value, float), (*self.batch, *bank, length))
        except ValueError as error:
            raise ShapeError(f"{name}: found the shape {np.shape(value)}, expected one for {self.batch}") from error
        array = (array if setting is None else array[..., setting[0], :]).reshape(self.lanes, length)
        self._columns += list((array[:1] if (array == array[:1]).all() else array).T)
        return first

    def _member(self, description: Description, prefix: str) -> None:
        """Add one estimator, or a bank's settings."""
        if description["kind"] != "bank":
            self._estimator(description, prefix, None)
            return
        count, begin, others, self.leaves = description["count"], self.size, self.leaves, {}
        for k in range(count):
            self._estimator(description["inner"], prefix, (k, count))
        block = (self.size - begin) // count
        for name, (place, shape, strides, flag) in self.leaves.items():  # of the last setting
            others[name] = Leaf(place - (count - 1) * block, (count, *shape), (block, *strides), flag)
        self.leaves = others

    def _estimator(self, description: Description, prefix: str, setting: Setting) -> None:
        row = [-1] * 16
        description, prefix, wrappers = unwrapped(description, prefix)
        kind, size, iterations = description["kind"], description["size"], description.get("iterations", 0)
        name, family = prefix.rstrip(".") or kind, step.FAMILIES[kind]
        row[step.KIND], row[step.SIZE] = list(step.FAMILIES).index(kind), size
        row[step.TERMS] = sum(regressors.TERMS[term] for term in description.get("terms", ()))
        terms = row[step.TERMS]
        if kind == "rnn" or (size and (terms == regressors.QUASI_STATIC or terms & regressors.AMBIENT)):
            self._heads = 1  # it asks for the heading
        row[step.ESTIMATE] = int(description.get("feedback") == "estimate")
        row[step.STATE] = self._place(family.fields(size), prefix)
        row[step.NUMBERS] = self._numbers(description["numbers"], family.numbers, name, setting)
        for key, vector in family.vectors.items():
            self._vector(description["vectors"][key], vector.length(size), f"{name}: {key}", setting)
        if kind == "rnn":
            row[step.CONDITION] = stable.CONDITIONS.index(description["condition"])
            row[step.BEST], row[step.UNROLL] = int(description["best"]), int(description["unroll"] == 2)
        row[step.ITERATIONS] = iterations
        if iterations:
            row[step.SIGNS] = self._vector(description["signs"], size, f"{name}: signs", setting)
        for kind, state, numbers in (
            ("memory", step.MEMORY_STATE, step.MEMORY_NUMBERS), ("robust", step.ROBUST_STATE, step.ROBUST_NUMBERS),
        ):  # fmt: skip
            if kind in wrappers:
                (wrapper, own), family = wrappers[kind], step.WRAPPERS[kind]
                row[state] = self._place(family.fields(0), own)
                row[numbers] = self._numbers(wrapper["numbers"], family.numbers, own, setting)
        if "robust" in wrappers:
            row[step.OUTER] = int(next(iter(wrappers)) == "robust")
        self._rows.append(row)
        needed = 4 + 16 * size if kind == "rnn" else 12 * size + 2 * size * size
        self._largest = max(self._largest, regressors.INPUTS + needed)
        self._kept = max(self._kept, self.size - row[step.STATE])

    def _ensemble(self, description: Description) -> dict[int, int]:
        for name, member in description["members"].items():
            self._member(member, f"members.{name}.")
        estimators, rules = len(self._rows), description["rules"]
        names = estimators + len(rules)
        for name, rule in rules.items():
            columns, family = rule["columns"], combiners.RULES[rule["kind"]]
            row = [list(combiners.RULES).index(rule["kind"]), len(columns)]
            row += [self._place(family.fields(len(columns)), f"combiners.{name}."), len(self._columns)]
            self._rows.append([*row, int(rule.get("loss") == "square"), *columns])
            self._numbers(rule["numbers"], family.numbers, name)
            self._vector(0.0, combiners.VECTOR - len(family.numbers), name)
            if family.vectors:
                self._vector(rule["vector"], sum(each.length(len(columns)) for each in family.vectors.values()), name)
        watched = description["monitors"] is not None
        self._place(ensemble_fields(names, watched), "")
        whole = {step.ESTIMATORS: estimators, step.RULES: len(rules), step.NAMES: names, step.MONITORS: -1}
        whole[step.OUTPUT] = estimators + list(rules).index(description["output"])
        whole[step.CONFORMAL] = self.leaves["conformal.halfwidth"].place
        whole[step.PREDICTIONS] = self.leaves["predictions"].place
        whole[step.HALFWIDTHS] = self.leaves["halfwidths"].place
        whole[step.LIMIT] = self._numbers(description["numbers"], step.ENSEMBLE_PARAMETERS, "ensemble")
        numbers = description["conformal"]
        whole[step.CONFORMAL_NUMBERS] = self._numbers(numbers, combiners.CONFORMAL_NUMBERS, "conformal")
        if watched:
            whole[step.MONITORS] = self.leaves["monitors.innovations.moments"].place
            numbers = description["monitors"]
            whole[step.MONITOR_NUMBERS] = self._numbers(numbers, monitors.MONITOR_NUMBERS, "monitors")
        widest = max(len(rule["columns"]) for rule in rules.values())
        self._largest = max(self._largest, 2 * estimators + 4 * widest, names + 4 * monitors.Z + monitors.Z**2)
        return whole
