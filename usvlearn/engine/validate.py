"""Validates a description and a state from a file. The kernels check no index, so a file must be right.

A description (`Estimator.description`) is compared entry by entry with what the families declare in their `state.py`.
Its sizes are bounded, and compared with the leaves, before any array is made. This is done once, where a file is
opened; for an estimator of this process, the constructor has checked its arguments.
"""

from __future__ import annotations

import reprlib
from collections.abc import Collection, Iterable, Mapping
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.checkpoint import QUOTED, as_array, newest, restore
from usvlearn.core.family import FINITE, WIDTH, Field, Options, Parameters, Range
from usvlearn.core.samples import named_leaves
from usvlearn.engine.leaves import batch_of, leaves_of
from usvlearn.engine.registry import KINDS
from usvlearn.errors import CheckpointError, ShapeError
from usvlearn.estimators.ensemble import state as ensemble
from usvlearn.estimators.ensemble.accommodation import state as accommodation
from usvlearn.estimators.ensemble.combiners.state import RULES
from usvlearn.estimators.ensemble.conformal import state as conformal
from usvlearn.estimators.ensemble.forecasts import state as forecasts
from usvlearn.estimators.ensemble.monitors import state as monitors
from usvlearn.estimators.planar import state as track
from usvlearn.estimators.planar.state import AXES, MOST_OVERLAP, filter_of
from usvlearn.estimators.wrappers.robust.state import FAMILY as ROBUST

LARGEST = 2**20  # numbers of a batch element: its state, its parameters, its table
CELLS = 3 * WIDTH  # of the table, for each estimator or combiner with its wrappers, without a combiner's members
HORIZONS = Range(1, forecasts.MOST_HORIZONS)  # of forecasts, and of tracks
DTYPES = (np.dtype(np.float64), np.dtype(np.float32))


class Entries(NamedTuple):
    """Numbers of a description; they are checked when the batch is known."""

    entry: str
    value: Any
    legal: Range
    own: tuple[int, ...] = ()  # their shape without the batch: the length of a vector
    vector: bool = False  # whether the last axis is a vector's, which must have its full length


def check(description: Any, leaves: Mapping[str, np.ndarray]) -> None:
    """Raise a CheckpointError, which names the entry, unless the kernels can continue from a file's content.

    Args:
        description: of an estimator, as `Estimator.description` gives it, from JSON.
        leaves: of its state, `(*batch, …)`, by dotted name.
    """
    reading = _Reading()
    if _kind("kernel", description) == "planar":
        reading.planar(description)
    else:
        reading.whole(description)
    fields = leaves_of(description)
    total = reading.cells + sum(
        prod(shape) for shape in (*(x.own for x in reading.numbers), *(x.shape for x in fields.values()))
    )
    if total > LARGEST:
        raise CheckpointError(f"kernel: found {total} numbers in all, expected {LARGEST} at most")
    batch, dtype = _check_state(fields, leaves)
    for each in reading.numbers:
        _check_numbers(each, batch, dtype)


def restored(path: Path, template: Any, estimator: str, description: Any) -> tuple[Any, dict[str, Any]]:
    """`checkpoint.restore` of a legal state of the described estimator (None: no kernel); the newest of a folder."""
    if path.is_dir():
        return newest(path, lambda each: restored(each, template, estimator, description))
    state, facts = restore(path, template, estimator)
    try:
        if description is not None:
            _check_state(leaves_of(description), {name: as_array(leaf) for name, leaf in named_leaves(state)})
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {str(error)[:QUOTED]}: use the checkpoint saved before it") from error
    return state, facts


def _check_state(fields: Mapping[str, Field], leaves: Mapping[str, np.ndarray]) -> tuple[tuple[int, ...], np.dtype]:
    """The batch and the dtype of a state; a CheckpointError, which names the leaf, where it is not legal."""
    if other := sorted(fields.keys() ^ leaves.keys()):
        found = "found no such leaf" if other[0] in fields else "found a leaf that the estimator does not have"
        raise CheckpointError(f"state.{other[0]}: {found}, expected the leaves of the described estimator")
    try:
        batch = batch_of(fields, leaves)
    except ShapeError as error:
        raise CheckpointError(f"state.{error}") from error
    dtype = next(leaves[name].dtype for name, field in fields.items() if not field.flag)
    for name, field in fields.items():
        flag, legal = field.flag, field.legal
        leaf, shape, wanted = leaves[name], (*batch, *field.shape), np.dtype(bool) if flag else dtype
        if leaf.shape != shape or leaf.size == 0:
            raise CheckpointError(f"state.{name}: found the shape {leaf.shape}, expected {shape}, none of them 0")
        if leaf.dtype != wanted or not (flag or dtype in DTYPES):
            raise CheckpointError(
                f"state.{name}: found numbers of {leaf.dtype}, expected {wanted if flag else 'float64 or float32'}, "
                "the same in all leaves"
            )
        if len(illegal := legal.wrong(leaf)):
            raise CheckpointError(f"state.{name}: found {illegal[0]}, expected {legal}")
    return batch, dtype


def _check_numbers(numbers: Entries, batch: tuple[int, ...], dtype: np.dtype) -> None:
    """Raise a CheckpointError unless values are numbers, broadcast against the batch, and are legal in this dtype."""
    entry, value, legal, own, vector = numbers
    try:
        array = np.asarray(value)
    except ValueError:  # lists of different lengths, or nested too deep
        array = np.asarray(None)
    if array.dtype.kind not in "iuf":
        raise wrong(entry, value, "a number, or lists of numbers")
    shape = (*batch, *own)
    behind = shape[len(shape) - array.ndim :]
    fits = array.ndim <= len(shape) and all(x in (1, y) for x, y in zip(array.shape, behind, strict=True))
    if not fits or (vector and array.shape[-1:] != own[-1:]):
        raise CheckpointError(f"{entry}: found the shape {array.shape}, expected one that broadcasts against {shape}")
    with np.errstate(over="ignore"):
        array = array.astype(dtype)
    if len(illegal := legal.wrong(array)):
        raise CheckpointError(f"{entry}: found {illegal[0]}, expected {legal}")


class _Reading:
    """Reads a description entry by entry; raises a CheckpointError where one is not legal.

    Attributes:
        numbers: the numbers that were found.
        cells: size of the table.
    """

    def __init__(self) -> None:
        self.numbers: list[Entries] = []
        self.cells = CELLS

    def planar(self, description: Any) -> None:
        """Check the three ensembles of a boat in the plane, and its tracks."""
        _keys("kernel", description, ("kind", *AXES, "numbers", "vectors"))
        for axis in AXES:
            own = _Reading()
            if _kind(f"kernel.{axis}", description[axis]) != "ensemble":
                raise wrong(f"kernel.{axis}.kind", description[axis]["kind"], "an ensemble")
            try:
                own.whole(description[axis])
            except CheckpointError as error:
                raise CheckpointError(f"kernel.{axis}: {error}") from error
            if not description[axis].get("forecasts") or filter_of(axis, description[axis]) is None:
                raise CheckpointError(f"kernel.{axis}: found no forecasts, or no filter of its kind, expected both")
            self.cells += own.cells
            self.numbers += [each._replace(entry=f"kernel.{axis}: {each.entry}") for each in own.numbers]
        self._parameters("kernel.numbers", description["numbers"], track.Number)
        _keys("kernel.vectors", description["vectors"], ("horizons",))
        horizons = _list("kernel.vectors.horizons", description["vectors"]["horizons"], HORIZONS)
        if any(type(h) not in (int, float) or not h > 0 for h in horizons) or sorted(set(horizons)) != horizons:
            raise wrong("kernel.vectors.horizons", horizons, "increasing positive numbers")
        overlap = description["numbers"]["overlap"]
        if type(overlap) not in (int, float) or not 0 < overlap <= MOST_OVERLAP:
            raise wrong("kernel.numbers.overlap", overlap, f"a number of 0 … {MOST_OVERLAP:g}")

    def whole(self, description: Any) -> None:
        """Check an estimator or an ensemble."""
        if _kind("kernel", description) != "ensemble":
            self._estimator("kernel", description)
            return
        keys = ("kind", "members", "output", "columns", "rules", "numbers", "conformal", "monitors")
        made = ("forecasts",) if "forecasts" in description else ()
        others = [key for key in ("conditional", "accommodation") if key in description]
        _keys("kernel", description, (*keys, *made, *others))
        if "conditional" in others:
            _number("kernel.conditional", description["conditional"], Range(0, 1))
        rules, members = _some("kernel.rules", description["rules"]), _some("kernel.members", description["members"])
        for name, member in members.items():
            if not name.isidentifier():  # it becomes a part of the names of leaves
                raise wrong("kernel.members", name, "names of letters, digits and _")
            self._estimator(f"kernel.members.{name}", member)
        count, columns = len(members), description["columns"]
        if columns != list(members):
            raise wrong("kernel.columns", columns, "the names of the members, in their order")
        widest = max(self._rule(f"kernel.rules.{name}", name, rule, count) for name, rule in rules.items())
        self.cells = (count + len(rules)) * (CELLS + widest)
        _choose("kernel.output", description["output"], list(rules))
        self._parameters("kernel.numbers", description["numbers"], ensemble.Number)
        self._parameters("kernel.conformal", description["conformal"], conformal.Number)
        if description["monitors"] is not None:
            self._parameters("kernel.monitors", description["monitors"], monitors.Number)
        if made:
            self._forecasts("kernel.forecasts", description["forecasts"], description, columns)
        if "accommodation" in others:
            self._accommodation("kernel.accommodation", description["accommodation"], description)

    def _accommodation(self, entry: str, given: Any, description: Any) -> None:
        """Check which members get what the monitor of the thrusters finds."""
        _keys(entry, given, ("members", "numbers"))
        if description["monitors"] is None:
            raise CheckpointError(f"{entry}: found no monitors, expected them where filters are accommodated")
        columns, known = description["columns"], description["members"]
        members = _list(f"{entry}.members", given["members"], Range(1, len(columns)))
        for k, column in enumerate(members):
            _number(f"{entry}.members[{k}]", column, Range(0, len(columns) - 1))
            own = known[columns[column]]
            if own["kind"] != "joint" or "trial_steps" not in own:
                raise wrong(f"{entry}.members[{k}]", column, "the column of a joint EKF with trials")
        if len(set(members)) < len(members):
            raise wrong(f"{entry}.members", members, "each once")
        self._parameters(f"{entry}.numbers", given["numbers"], accommodation.Number)

    def _forecasts(self, entry: str, made: Any, description: Any, columns: list[Any]) -> None:
        """Check forecasts of an ensemble."""
        fitted = isinstance(made, dict) and forecasts.FIT in made
        _keys(entry, made, ("members", "slots", "numbers", "vectors", *[forecasts.FIT] * fitted))
        members = _list(f"{entry}.members", made["members"], Range(1, len(columns)))
        for k, column in enumerate(members):
            _number(f"{entry}.members[{k}]", column, Range(0, len(columns) - 1))
        if len(set(members)) < len(members):
            raise wrong(f"{entry}.members", members, "each once")
        slots = _number(f"{entry}.slots", made["slots"], Range(1, forecasts.MOST_SLOTS))
        _keys(f"{entry}.vectors", made["vectors"], [vector.key for vector in forecasts.Vector])
        horizons = _list(f"{entry}.vectors.horizons", made["vectors"]["horizons"], HORIZONS)
        if any(not isinstance(h, int | float) for h in horizons) or sorted(set(horizons)) != horizons:
            raise wrong(f"{entry}.vectors.horizons", horizons, "increasing numbers")
        if fitted:
            _keys(f"{entry}.fit", made["fit"], ("column", "table"))
            column = made["fit"]["column"]
            joint = column in members and description["members"][columns[column]]["kind"] == "joint"
            if not joint or forecasts.FIT in description["members"]:
                raise wrong(f"{entry}.fit.column", column, "that of a weighed joint EKF, and no member named fit")
            table = Entries(f"{entry}.fit.table", made["fit"]["table"], FINITE, (forecasts.TABLE,), True)
            self.numbers.append(table)
        size = slots, len(horizons), len(members) + fitted
        for vector in forecasts.Vector:
            own, value = (vector.length(size),), made["vectors"][vector.key]
            self.numbers.append(Entries(f"{entry}.vectors.{vector.key}", value, vector.legal, own, True))
        self._parameters(f"{entry}.numbers", made["numbers"], forecasts.Number)
        self.cells += (2 * size[2] + 1) * 2 * CELLS + 3 * 16 * size[2]

    def _estimator(self, entry: str, member: Any) -> None:
        """Check an estimator, and the `Robust` around it."""
        kinds = [*KINDS, "robust"]
        if _kind(entry, member) == "robust":
            _keys(entry, member, ("kind", "inner", "numbers"))
            self._parameters(f"{entry}.numbers", member["numbers"], ROBUST.numbers)
            entry, member, kinds = f"{entry}.inner", member["inner"], [*KINDS]
        family = KINDS[_choose(f"{entry}.kind", _kind(entry, member), kinds)]
        chosen = family.chosen(member)
        vectors = ("vectors",) if len(family.vectors) else ()
        for key, fact in family.facts.items():
            _choose(f"{entry}.{key}", member.get(key, fact), [fact])
        facts = member.keys() & family.facts.keys()
        _keys(entry, member, ("kind", "size", "numbers", *facts, *(choice.key for choice in chosen), *vectors))
        for choice in chosen:
            self._choice(entry, choice, member[choice.key])
        if isinstance(family.size, Range):
            size = _number(f"{entry}.size", member["size"], family.size)
        else:
            size = family.size(member)
            _number(f"{entry}.size", member["size"], Range(size, size))
        self._parameters(f"{entry}.numbers", member["numbers"], family.numbered(member))
        if vectors:
            _keys(f"{entry}.vectors", member["vectors"], [vector.key for vector in family.vectors])
        for vector in family.vectors:
            own, value = (vector.length(size),), member["vectors"][vector.key]
            self.numbers.append(Entries(f"{entry}.vectors.{vector.key}", value, vector.legal, own, True))

    def _choice(self, entry: str, choice: Options, found: Any) -> None:
        """Check a choice: a whole number, or one of several values."""
        if choice.whole is not None:
            _number(f"{entry}.{choice.key}", found, choice.whole)
        else:
            _choose(f"{entry}.{choice.key}", found, choice.allowed)

    def _rule(self, entry: str, name: str, rule: Any, count: int) -> int:
        """Check a combiner of an ensemble of `count` columns; returns how many it combines."""
        if not name or "." in name:
            raise wrong("kernel.rules", name, "names without a dot")
        family = RULES[_choose(f"{entry}.kind", _kind(entry, rule), list(RULES))]
        vectors = ("vector",) if len(family.vectors) else ()
        _keys(entry, rule, ("kind", "columns", "numbers", *(choice.key for choice in family.choices), *vectors))
        columns = _list(f"{entry}.columns", rule["columns"], Range(1, count))
        for k, column in enumerate(columns):
            _number(f"{entry}.columns[{k}]", column, Range(0, count - 1))
        if len(set(columns)) < len(columns):
            raise wrong(f"{entry}.columns", columns, "each once")
        for choice in family.choices:
            self._choice(entry, choice, rule[choice.key])
        self._parameters(f"{entry}.numbers", rule["numbers"], family.numbers)
        lengths = [vector.length(len(columns)) for vector in family.vectors]
        if lengths:
            flat = _list(f"{entry}.vector", rule["vector"], Range(sum(lengths), sum(lengths)))
        begin = 0
        for length, vector in zip(lengths, family.vectors, strict=True):
            part = flat[begin : begin + length]
            self.numbers.append(Entries(f"{entry}.vector[{begin}:]", part, vector.legal, (length,), True))
            begin += length
        return len(columns)

    def _parameters(self, entry: str, values: Any, legal: Iterable[Parameters]) -> None:
        """Check numbers by name."""
        legal = list(legal)
        _keys(entry, values, [each.key for each in legal])
        self.numbers += [Entries(f"{entry}.{each.key}", values[each.key], each.legal) for each in legal]


def wrong(entry: str, found: Any, expected: str) -> CheckpointError:
    """The error of an entry."""
    return CheckpointError(f"{entry}: found {reprlib.repr(found)}, expected {expected}")


def _some(entry: str, found: Any) -> dict[str, Any]:
    """Check a dictionary that is not empty."""
    if not isinstance(found, dict):
        raise wrong(entry, found, "a dictionary")
    if not found:
        raise wrong(entry, found, "at least one")
    return found


def _keys(entry: str, found: Any, expected: Collection[str]) -> None:
    """Check a dictionary of exactly these keys."""
    if not isinstance(found, dict):
        raise wrong(entry, found, "a dictionary")
    names = ", ".join(expected) or "nothing"
    if other := sorted(found.keys() ^ set(expected)):
        what = "found no" if other[0] in expected else "found"
        raise CheckpointError(f"{entry}: {what} {reprlib.repr(other[0])}, expected {names}")


def _kind(entry: str, found: Any) -> str:
    """The `kind` of an entry."""
    if not isinstance(found, dict):
        raise wrong(entry, found, "a dictionary")
    if "kind" not in found:
        raise CheckpointError(f"{entry}: found no 'kind', expected the kind of an estimator or a combiner")
    if not isinstance(found["kind"], str):
        raise wrong(f"{entry}.kind", found["kind"], "the kind of an estimator or a combiner")
    return found["kind"]


def _number(entry: str, found: Any, legal: Range) -> int:
    """Check a whole number."""
    expected = f"{legal.least:g}" if legal.least == legal.most else str(legal)
    if not isinstance(found, int) or isinstance(found, bool):
        raise wrong(entry, found, f"a whole number, {expected}")
    if not legal.least <= found <= legal.most:
        raise wrong(entry, found, expected)
    return found


def _list(entry: str, found: Any, count: Range) -> list[Any]:
    """Check a list of this length."""
    if not isinstance(found, list):
        raise wrong(entry, found, "a list")
    if not count.least <= len(found) <= count.most:
        expected = f"{count.least:g}" if count.least == count.most else str(count)
        raise CheckpointError(f"{entry}: found {reprlib.repr(found)}, expected {expected} of them")
    return found


def _choose(entry: str, found: Any, choices: Collection[Any]) -> Any:
    """Check that a value is one of these, and of the same type."""
    if not any(type(found) is type(each) and found == each for each in choices):
        raise wrong(entry, found, f"one of {', '.join(map(repr, choices))}")
    return found
