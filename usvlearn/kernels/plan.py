"""From what an estimator says of itself to what the kernels interpret: a table, numbers, the places of the leaves.

An estimator describes itself (`Estimator.kernel`) in plain values, which also fit into JSON: its `kind`, `numbers` and
`vectors` by name (hyperparameters broadcast against the batch), what kind of choices were made, and what it wraps.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from usvlearn.errors import ShapeError
from usvlearn.kernels import aid, combiners, monitors, regressors, rls, rnn, samples, stable, step

Description = Mapping[str, Any]
Setting = tuple[int, int] | None  # of a bank, and how many it has
ORDER = {  # of the numbers of an estimator
    "rls": rls.RLS_NUMBERS, "sift": rls.RLS_NUMBERS, "aid": aid.AID_NUMBERS, "rnn": rnn.RNN_NUMBERS,
    "persistence": (), "acceleration": step.ACCELERATION_PARAMETERS,
}  # fmt: skip
VECTORS = {"aid": aid.AID_VECTORS, "rnn": ("bounds", "rate_ratio")}
TERMS = {"dynamics": regressors.DYNAMICS, "memory": regressors.MEMORY, "ambient": regressors.AMBIENT}
FLAGS = ("known", "unbroken")  # leaves that are bool


class Leaf(NamedTuple):
    """Where a leaf lies in the row of a lane."""

    place: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]  # in numbers


def fields(kind: str, size: int) -> dict[str, tuple[int, ...]]:
    """Shapes of the leaves of an estimator's state, in the order in which the kernels have them."""
    if kind in ("rls", "sift"):
        return rls.rls_fields(size)
    if kind == "aid":
        return aid.aid_fields(size)
    if kind == "rnn":
        return rnn.rnn_fields(size)
    return dict.fromkeys(step.PERSISTENCE_FIELDS if kind == "persistence" else step.ACCELERATION_FIELDS, ())


def plan_for(description: Description, batch: Sequence[int], dtype: np.dtype) -> Plan:
    """`Plan`, made once: a replay asks for the same one chunk after chunk."""
    return _plan(json.dumps(description), tuple(batch), np.dtype(dtype))


@lru_cache(maxsize=8)
def _plan(description: str, batch: tuple[int, ...], dtype: np.dtype) -> Plan:
    return Plan(json.loads(description), batch, dtype)


class Plan:
    """A table, its numbers and the places of the leaves, for one estimator and batch.

    Args:
        description: of an estimator, as `Estimator.kernel` gives it.
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
        states = np.empty((self.lanes, self.size), self.dtype)
        for name, view in self._views(states).items():
            if leaves[name].shape != view.shape:
                raise ShapeError(f"{name}: found the shape {leaves[name].shape}, expected {view.shape}")
            view[...] = leaves[name]
        return states

    def unpack(self, states: np.ndarray) -> dict[str, np.ndarray]:
        """Leaves `(*batch, …)` by dotted name: views of the states, but for those that are bool."""
        return {name: self.typed(name, view) for name, view in self._views(states).items()}

    def typed(self, name: str, array: np.ndarray) -> np.ndarray:
        """What the kernels have of a leaf, as bool where the leaf is."""
        return array.astype(bool) if name.rpartition(".")[2] in FLAGS else array

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

    def _place(self, fields: Mapping[str, tuple[int, ...]], prefix: str) -> int:
        """Add leaves; returns where the first lies."""
        first = self.size
        for name, shape in fields.items():
            strides = tuple(int(np.prod(shape[k + 1 :], dtype=int)) for k in range(len(shape)))
            self.leaves[prefix + name] = Leaf(self.size, shape, strides)
            self.size += int(np.prod(shape, dtype=int))
        return first

    def _numbers(self, values: Mapping[str, Any], order: Sequence[str], name: str, setting: Setting = None) -> int:
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
        count, begin = description["count"], self.size
        for k in range(count):
            self._estimator(description["inner"], prefix, (k, count))
        block = (self.size - begin) // count
        for name, leaf in self.leaves.items():
            if name.startswith(prefix):
                own = Leaf(leaf.place - (count - 1) * block, (count, *leaf.shape), (block, *leaf.strides))
                self.leaves[name] = own

    def _estimator(self, description: Description, prefix: str, setting: Setting) -> None:
        row = [-1] * 16
        wrappers: dict[str, tuple[Description, str]] = {}
        order = []
        while description["kind"] in ("robust", "memory"):
            order.append(description["kind"])
            wrappers[description["kind"]] = description, prefix
            description, prefix = description["inner"], f"{prefix}inner."
        kind, size, iterations = description["kind"], description["size"], description.get("iterations", 0)
        name = prefix.rstrip(".") or kind
        row[step.KIND], row[step.SIZE] = step.KINDS.index(kind), size
        row[step.TERMS] = sum(TERMS[term] for term in description.get("terms", ()))
        terms = row[step.TERMS]
        if kind == "rnn" or (size and (terms == regressors.QUASI_STATIC or terms & regressors.AMBIENT)):
            self._heads = 1  # it asks for the heading
        row[step.ESTIMATE] = int(description.get("feedback") == "estimate")
        row[step.STATE] = self._place(fields(kind, size), prefix)
        row[step.NUMBERS] = self._numbers(description["numbers"], ORDER[kind], name, setting)
        for key in VECTORS.get(kind, ()):
            vector = description["vectors"][key]
            self._vector(vector, np.shape(vector)[-1], f"{name}: {key}", setting)
        if kind == "rnn":
            row[step.CONDITION] = stable.CONDITIONS.index(description["condition"])
            row[step.BEST], row[step.UNROLL] = int(description["best"]), int(description["unroll"] == 2)
        row[step.ITERATIONS] = iterations
        if iterations:
            row[step.SIGNS] = self._vector(description["signs"], size, f"{name}: signs", setting)
        if "memory" in wrappers:
            wrapper, own = wrappers["memory"]
            row[step.MEMORY_STATE] = self._place(dict.fromkeys(step.MEMORY_FIELDS, ()), own)
            row[step.MEMORY_NUMBERS] = self._numbers(wrapper["numbers"], step.MEMORY_PARAMETERS, own, setting)
        if "robust" in wrappers:
            wrapper, own = wrappers["robust"]
            row[step.ROBUST_STATE] = self._place(dict.fromkeys(step.ROBUST_FIELDS, ()), own)
            row[step.ROBUST_NUMBERS] = self._numbers(wrapper["numbers"], step.ROBUST_PARAMETERS, own, setting)
            row[step.OUTER] = int(order[0] == "robust")
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
            kind, columns = rule["kind"], rule["columns"]
            row = [combiners.RULES.index(kind), len(columns), self._place(combiners.rule_fields(kind, len(columns)),
                   f"combiners.{name}."), len(self._columns), int(rule.get("loss") == "square"), *columns]  # fmt: skip
            order = combiners.RULE_NUMBERS[kind]
            self._numbers(rule["numbers"], order, name)
            self._vector(0.0, combiners.VECTOR - len(order), name)
            if "vector" in rule:
                self._vector(rule["vector"], len(rule["vector"]), name)
            self._rows.append(row)
        whole = {step.ESTIMATORS: estimators, step.RULES: len(rules), step.NAMES: names, step.MONITORS: -1}
        whole[step.OUTPUT] = estimators + list(rules).index(description["output"])
        whole[step.CONFORMAL] = self._place({"conformal.halfwidth": (names,), "conformal.count": (names,)}, "")
        whole[step.PREDICTIONS] = self._place({"predictions": (names,)}, "")
        whole[step.HALFWIDTHS] = self._place({"halfwidths": (names,)}, "")
        whole[step.LIMIT] = self._numbers(description["numbers"], ("surge_max",), "ensemble")
        numbers = description["conformal"]
        whole[step.CONFORMAL_NUMBERS] = self._numbers(numbers, combiners.CONFORMAL_NUMBERS, "conformal")
        if (numbers := description["monitors"]) is not None:
            whole[step.MONITORS] = self._place(monitors.monitor_fields(names), "monitors.")
            whole[step.MONITOR_NUMBERS] = self._numbers(numbers, monitors.MONITOR_NUMBERS, "monitors")
        widest = max(len(rule["columns"]) for rule in rules.values())
        self._largest = max(self._largest, 2 * estimators + 4 * widest, names + 4 * monitors.Z + monitors.Z**2)
        return whole
