"""One walk of a description: its parts, in the order of the state. Checks, leaves and the program are read from it.

A description (`Estimator.description`) has JSON values only: `kind`, `size`, `numbers` and `vectors` by name
(hyperparameters broadcast against the batch), the choices, and the description of the estimator that it wraps. The walk
compares its entries with what the families declare in their `state.py`, and raises a CheckpointError, which names the
entry, where one is not legal: a description may come from a file. The numbers are left to `engine.validate`, which
knows the batch.
"""

from __future__ import annotations

import reprlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from importlib import import_module
from math import prod
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.family import FINITE, MOST, Family, Field, Options, Parameters, Range, defaults
from usvlearn.errors import CheckpointError, ShapeError
from usvlearn.estimators import COMPILED
from usvlearn.estimators.ensemble import state as ensemble
from usvlearn.estimators.ensemble.accommodation import state as accommodation
from usvlearn.estimators.ensemble.combiners.state import RULES
from usvlearn.estimators.ensemble.conformal import state as conformal
from usvlearn.estimators.ensemble.forecasts import state as forecasts
from usvlearn.estimators.ensemble.manoeuvre_intervals import state as conditional
from usvlearn.estimators.ensemble.monitors import state as monitors
from usvlearn.estimators.planar import state as track
from usvlearn.estimators.planar.state import AXES, MOST_OVERLAP, filter_of
from usvlearn.estimators.wrappers.robust.state import FAMILY as ROBUST

Description = Mapping[str, Any]
ESTIMATORS: list[Family[Any]] = [import_module(f"usvlearn.estimators.{name}.state").FAMILY for name in COMPILED]
KINDS = {kind: family for family in ESTIMATORS for kind in family.kinds}
EXTERNAL = "external"  # the kind of a member that other code steps
ALONE = [*(kind for kind in KINDS if kind != EXTERNAL), "robust"]
HORIZONS = Range(1, forecasts.MOST_HORIZONS)  # of forecasts, and of tracks


class Entry(NamedTuple):
    """Numbers of a description."""

    name: str  # where they stand
    value: Any
    legal: Range
    vector: int | None = None  # of a vector, the place in a row that holds the place of its first number,
    length: int = 1  # and its length


class Part(NamedTuple):
    """A part of a description."""

    role: str
    family: Family[Any]
    own: Description  # its entries
    size: Any
    prefix: str  # of its leaves
    numbers: tuple[Entry, ...] = ()
    columns: tuple[int, ...] = ()  # those that a combiner combines; of a copy, that of the member
    slots: int = 0  # of a copy
    inactive: bool = False  # whether it is a member, which is inactive once it has diverged

    def leaves(self) -> dict[str, Field]:
        """The leaves of its state by dotted name; of a copy those that an open-loop simulation needs."""
        fields = self.family.leaves(self.size, self.prefix, self.own)
        if self.slots:
            names = [self.prefix + name for name in self.family.frozen] if self.family.frozen else list(fields)
            fields = {name: replace(fields[name], shape=(self.slots, *fields[name].shape)) for name in names}
        if self.inactive:
            fields = {name: replace(each, legal=each.legal.inactive()) for name, each in fields.items()}
        return fields


def compilable(description: Description | None) -> bool:
    """Whether the kernels can make the steps of an estimator with this description (`Estimator.description`)."""
    if description is None:
        return False
    if description["kind"] == "ensemble":
        return all(compilable(member) and member["kind"] != "ensemble" for member in description["members"].values())
    return (description["inner"] if description["kind"] == "robust" else description)["kind"] in KINDS


def leaves_of(description: Description) -> dict[str, Field]:
    """The leaves of the state of an estimator with this description."""
    return {name: field for part in parts(description) for name, field in part.leaves().items()}


def elsewhere(all_parts: Iterable[Part]) -> tuple[str, ...]:
    """The prefixes of the leaves of members that other code steps."""
    return tuple(part.prefix for part in all_parts if part.role == "estimator" and part.own["kind"] == EXTERNAL)


def external_in(description: Description) -> list[str]:
    """The names of those members."""
    members = description.get("surge", description).get("members", {})
    return [name for name, member in members.items() if member["kind"] == EXTERNAL]


def batch_of(fields: Mapping[str, Field], leaves: Mapping[str, np.ndarray]) -> tuple[int, ...]:
    """The batch of a state, from the shape of its first leaf; a ShapeError where that leaf is missing."""
    name, field = next(iter(fields.items()))
    if name not in leaves or leaves[name].ndim < len(field.shape):
        seen = f"found the shape {leaves[name].shape}" if name in leaves else "found no such leaf"
        raise ShapeError(f"{name}: {seen}, expected (*batch, {', '.join(map(str, field.shape))})")
    return leaves[name].shape[: leaves[name].ndim - len(field.shape)]


def parts(description: Any, entry: str = "kernel") -> Iterator[Part]:
    """The parts of an estimator, of an ensemble, or of a boat in the plane, whose description stands at this entry.

    Their roles are "estimator" and "robust" (the wrapper of the one before it), "rule" (a combiner), "ensemble",
    "conformal", "monitors", "forecasts", "copy" (of a member, in the slots of forecasts), "conditional" (what the
    intervals of forecasts know of the manoeuvre), "accommodation", and "track".
    """
    kind = kind_of(entry, description)
    if kind == "planar":
        yield from _planar(entry, description)
    elif kind == "ensemble":
        yield from _ensemble(entry, description, "")
    else:
        yield from _estimator(entry, description, "", ALONE)


def _planar(entry: str, own: Description) -> Iterator[Part]:
    """The three ensembles of a boat in the plane, and its tracks."""
    check_keys(entry, own, ("kind", *AXES, "numbers", "vectors"))
    blocks = []
    for axis in AXES:
        place = f"{entry}.{axis}"
        if kind_of(place, own[axis]) != "ensemble":
            raise wrong(f"{place}.kind", own[axis]["kind"], "an ensemble")
        block = 0
        for part in _ensemble(place, own[axis], f"{axis}."):
            yield part
            block += sum(prod(field.shape[1:]) for field in part.leaves().values()) if part.role == "copy" else 0
            block += part.size[1] * part.size[2] if part.role == "forecasts" else 0
        if not own[axis].get("forecasts") or filter_of(axis, own[axis]) is None:
            raise CheckpointError(f"{place}: found no forecasts, or no filter of its kind, expected both")
        blocks.append(block)
    numbers = _numbers(f"{entry}.numbers", own["numbers"], track.Number)
    overlap = own["numbers"]["overlap"]
    if type(overlap) not in (int, float) or not 0 < overlap <= MOST_OVERLAP:
        raise wrong(f"{entry}.numbers.overlap", overlap, f"a number of 0 … {MOST_OVERLAP:g}")
    check_keys(f"{entry}.vectors", own["vectors"], ("horizons",))
    horizons = _horizons(f"{entry}.vectors.horizons", own["vectors"]["horizons"])
    size = track.slots_of(tuple(horizons), overlap), len(horizons), track.slot_length(len(horizons), blocks)
    numbers += _vectors(f"{entry}.vectors", own["vectors"], track.FAMILY, size)
    yield Part("track", track.FAMILY, own, size, "track.", numbers)


def _ensemble(entry: str, own: Description, prefix: str) -> Iterator[Part]:
    keys = ("kind", "members", "output", "columns", "rules", "numbers", "conformal", "monitors")
    optional = [key for key in ("forecasts", "conditional", "accommodation") if key in own]
    check_keys(entry, own, (*keys, *optional))
    knows = _whole(f"{entry}.conditional", own.get("conditional", 0), Range(0, 1))
    rules, members = _some(f"{entry}.rules", own["rules"]), _some(f"{entry}.members", own["members"])
    columns: dict[str, Part] = {}
    allowed = [*KINDS, "robust"] if prefix in ("", "surge.") else ALONE
    for name, member in members.items():
        if not name.isidentifier():  # it becomes a part of the names of leaves
            raise wrong(f"{entry}.members", name, "names of letters, digits and _")
        for part in _estimator(f"{entry}.members.{name}", member, f"{prefix}members.{name}.", allowed):
            columns.setdefault(name, part)
            yield part._replace(inactive=True)
    given = [member["column"] for member in members.values() if member["kind"] == EXTERNAL]
    if given != list(range(len(given))):
        raise wrong(f"{entry}.members", given, f"the kind {EXTERNAL} with the columns 0, 1, … in their order")
    if own["columns"] != list(members):
        raise wrong(f"{entry}.columns", own["columns"], "the names of the members, in their order")
    for name, rule in rules.items():
        yield _rule(f"{entry}.rules.{name}", name, rule, len(members), f"{prefix}combiners.{name}.")
    _choose(f"{entry}.output", own["output"], list(rules))
    names = len(members) + len(rules)
    numbers = _numbers(f"{entry}.numbers", own["numbers"], ensemble.Number)
    yield Part("ensemble", ensemble.FAMILY, own, names, prefix, numbers)
    numbers = _numbers(f"{entry}.conformal", own["conformal"], conformal.Number)
    yield Part("conformal", conformal.FAMILY, {"conditional": knows}, names, f"{prefix}conformal.", numbers)
    if own["monitors"] is not None:
        numbers = _numbers(f"{entry}.monitors", own["monitors"], monitors.Number)
        yield Part("monitors", monitors.FAMILY, own, names, f"{prefix}monitors.", numbers)
    if "forecasts" in own:
        yield from _forecasts(f"{entry}.forecasts", own, columns, prefix)
    if "accommodation" in own:
        yield _accommodation(f"{entry}.accommodation", own, f"{prefix}accommodation.")


def _accommodation(entry: str, own: Description, prefix: str) -> Part:
    """What the monitor of the thrusters finds is given to some members."""
    given, members = own["accommodation"], list(own["members"].values())
    check_keys(entry, given, ("members", "numbers"))
    if own["monitors"] is None:
        raise CheckpointError(f"{entry}: found no monitors, expected them where filters are accommodated")
    columns = _columns(f"{entry}.members", given["members"], len(members))
    for k, column in enumerate(columns):
        if members[column]["kind"] != "joint" or not members[column].get("trial_steps"):
            raise wrong(f"{entry}.members[{k}]", column, "the column of a joint EKF with trials")
    numbers = _numbers(f"{entry}.numbers", given["numbers"], accommodation.Number)
    return Part("accommodation", accommodation.FAMILY, given, 0, prefix, numbers, columns)


def _forecasts(entry: str, whole: Description, members: Mapping[str, Part], prefix: str) -> Iterator[Part]:
    """Forecasts, and the copies of members that make them; a fit has copies of a joint EKF."""
    made: Any = whole["forecasts"]
    fitted = isinstance(made, dict) and forecasts.FIT in made
    check_keys(entry, made, ("members", "slots", "numbers", "vectors", *[forecasts.FIT] * fitted))
    chosen, names = _columns(f"{entry}.members", made["members"], len(members)), list(members)
    copies, more = {names[column]: column for column in chosen}, list[Entry]()
    if other := [name for name in copies if whole["members"][name]["kind"] == EXTERNAL]:
        raise wrong(f"{entry}.members", other[0], "members with a kernel")
    slots = _whole(f"{entry}.slots", made["slots"], Range(1, forecasts.MOST_SLOTS))
    check_keys(f"{entry}.vectors", made["vectors"], [vector.key for vector in forecasts.Vector])
    horizons = _horizons(f"{entry}.vectors.horizons", made["vectors"]["horizons"])
    if fitted:
        check_keys(f"{entry}.fit", made["fit"], ("column", "table"))
        column = made["fit"]["column"]
        joint = type(column) is int and column in chosen and whole["members"][names[column]]["kind"] == "joint"
        if not joint or forecasts.FIT in members:
            raise wrong(f"{entry}.fit.column", column, "that of a weighed joint EKF, and no member named fit")
        copies[forecasts.FIT] = column
        more = [Entry(f"{entry}.fit.table", made["fit"]["table"], FINITE, forecasts.Choice.FIT, forecasts.TABLE)]
    size = slots, len(horizons), len(copies)
    own = {"slots": slots, "horizons": len(horizons), "members": len(copies), forecasts.FIT: -1}
    numbers = _numbers(f"{entry}.numbers", made["numbers"], forecasts.Number)
    numbers += _vectors(f"{entry}.vectors", made["vectors"], forecasts.FAMILY, size)
    yield Part("forecasts", forecasts.FAMILY, own, size, f"{prefix}forecasts.", (*numbers, *more))
    for name, column in copies.items():
        member = members[names[column]]
        inner = member.prefix.removeprefix(f"{prefix}members.{names[column]}.")
        place = f"{prefix}forecasts.frozen.{name}.{inner}"
        yield member._replace(role="copy", prefix=place, numbers=(), columns=(column,), slots=slots, inactive=True)
    if whole.get("conditional"):
        yield Part("conditional", conditional.FAMILY, {}, size[:2], f"{prefix}forecasts.conditional.")


def _estimator(entry: str, own: Any, prefix: str, kinds: Collection[str]) -> Iterator[Part]:
    """An estimator, and the `Robust` around it."""
    family = KINDS.get(_choose(f"{entry}.kind", kind_of(entry, own), kinds))
    if family is None:
        check_keys(entry, own, ("kind", "inner", "numbers"))
        yield from _estimator(f"{entry}.inner", own["inner"], f"{prefix}inner.", ALONE[:-1])
        yield Part("robust", ROBUST, own, 0, prefix, _numbers(f"{entry}.numbers", own["numbers"], ROBUST.numbers))
        return
    own = defaults(family.choices) | own
    vectors = ("vectors",) if len(family.vectors) else ()
    check_keys(entry, own, ("kind", "size", "numbers", *(choice.key for choice in family.choices), *vectors))
    _choices(entry, own, family.choices)
    legal = family.size
    if not isinstance(legal, Range):
        legal = Range(count := legal(own), count)
    size = _whole(f"{entry}.size", own["size"], legal)
    numbers = _numbers(f"{entry}.numbers", own["numbers"], family.numbers)
    numbers += _vectors(f"{entry}.vectors", own["vectors"], family, size) if vectors else ()
    yield Part("estimator", family, own, size, prefix, numbers)


def _rule(entry: str, name: str, own: Any, count: int, prefix: str) -> Part:
    """A combiner of an ensemble of `count` columns."""
    if not name or "." in name:
        raise wrong(entry.removesuffix(f".{name}"), name, "names without a dot")
    family = RULES[_choose(f"{entry}.kind", kind_of(entry, own), list(RULES))]
    vectors = ("vector",) if len(family.vectors) else ()
    check_keys(entry, own, ("kind", "columns", "numbers", *(choice.key for choice in family.choices), *vectors))
    columns = _columns(f"{entry}.columns", own["columns"], count)
    _choices(entry, own, family.choices)
    numbers = [*_numbers(f"{entry}.numbers", own["numbers"], family.numbers)]
    lengths, begin = [vector.length(len(columns)) for vector in family.vectors], 0
    flat = _list(f"{entry}.vector", own["vector"], Range(sum(lengths), sum(lengths))) if lengths else []
    for length, vector in zip(lengths, family.vectors, strict=True):
        part = flat[begin : begin + length]
        numbers.append(Entry(f"{entry}.vector[{begin}:]", part, vector.legal, vector, length))
        begin += length
    return Part("rule", family, own, len(columns), prefix, tuple(numbers), columns)


def _numbers(entry: str, given: Any, declared: Iterable[Parameters]) -> tuple[Entry, ...]:
    """Numbers by name; one that is absent has its default."""
    declared = list(declared)
    if isinstance(given, dict):
        given = defaults(declared) | given
    check_keys(entry, given, [each.key for each in declared])
    return tuple(Entry(f"{entry}.{each.key}", given[each.key], each.legal) for each in declared)


def _vectors(entry: str, given: Any, family: Family[Any], size: Any) -> tuple[Entry, ...]:
    """Vectors by name."""
    check_keys(entry, given, [each.key for each in family.vectors])
    return tuple(
        Entry(f"{entry}.{each.key}", given[each.key], each.legal, each, each.length(size)) for each in family.vectors
    )


def _choices(entry: str, own: Description, choices: Iterable[Options]) -> None:
    """Check choices: a whole number, or one of several values."""
    for choice in choices:
        if choice.whole is not None:
            _whole(f"{entry}.{choice.key}", own[choice.key], choice.whole)
        else:
            _choose(f"{entry}.{choice.key}", own[choice.key], choice.allowed)


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


def check_keys(entry: str, found: Any, expected: Collection[str]) -> None:
    """Check a dictionary of exactly these keys."""
    if not isinstance(found, dict):
        raise wrong(entry, found, "a dictionary")
    names = ", ".join(expected) or "nothing"
    if other := sorted(found.keys() ^ set(expected)):
        what = "found no" if other[0] in expected else "found"
        raise CheckpointError(f"{entry}: {what} {reprlib.repr(other[0])}, expected {names}")


def kind_of(entry: str, found: Any) -> str:
    """The `kind` of an entry."""
    if not isinstance(found, dict):
        raise wrong(entry, found, "a dictionary")
    if "kind" not in found:
        raise CheckpointError(f"{entry}: found no 'kind', expected the kind of an estimator or a combiner")
    if not isinstance(found["kind"], str):
        raise wrong(f"{entry}.kind", found["kind"], "the kind of an estimator or a combiner")
    return found["kind"]


def _whole(entry: str, found: Any, legal: Range) -> int:
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


def _columns(entry: str, found: Any, count: int) -> tuple[int, ...]:
    """Check columns of an ensemble, each once."""
    columns = _list(entry, found, Range(1, count))
    for k, column in enumerate(columns):
        _whole(f"{entry}[{k}]", column, Range(0, count - 1))
    if len(set(columns)) < len(columns):
        raise wrong(entry, columns, "each once")
    return tuple(columns)


def _horizons(entry: str, found: Any) -> list[Any]:
    """Check times, s, that increase."""
    horizons = _list(entry, found, HORIZONS)
    if any(type(h) not in (int, float) or not 0 < h <= MOST for h in horizons) or sorted(set(horizons)) != horizons:
        raise wrong(entry, horizons, "increasing positive numbers")
    return horizons


def _choose(entry: str, found: Any, choices: Collection[Any]) -> Any:
    """Check that a value is one of these, and of the same type."""
    if not any(type(found) is type(each) and found == each for each in choices):
        raise wrong(entry, found, f"one of {', '.join(map(repr, choices))}")
    return found
