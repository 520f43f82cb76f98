"""Validates a description and a state from a file. The kernels check no index, so a file must be right.

`engine.parts` compares a description with what the families declare. Its sizes are bounded, and compared with the
leaves, before any array is made. This is done once, where a file is opened; for an estimator of this process, the
constructor has checked its arguments.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from usvlearn.core.checkpoint import QUOTED, as_array, load, newest, restore
from usvlearn.core.family import WIDTH, Field
from usvlearn.core.samples import named_leaves
from usvlearn.engine.parts import Entry, Part, batch_of, elsewhere, parts, wrong
from usvlearn.errors import CheckpointError, ShapeError

LARGEST = 2**20  # numbers of a batch element: its state, its parameters, its table
DTYPES = (np.dtype(np.float64), np.dtype(np.float32))
MEMBER = re.compile(r"(\w+\.)?members\.\w+\.")  # prefix of the leaves of one


def check(description: Any, leaves: Mapping[str, np.ndarray]) -> None:
    """Raise a CheckpointError, which names the entry, unless the kernels can continue from a file's content."""
    all_parts = list(parts(description))
    fields = _fields(all_parts)
    numbers = [entry for part in all_parts for entry in part.numbers]
    copied = sum(len(part.leaves()) for part in all_parts if part.role == "copy")
    table = (len(all_parts) + 1) * (WIDTH + 2 + max(len(part.columns) for part in all_parts) + 7 * copied)
    total = table + sum(each.length for each in numbers) + sum(prod(field.shape) for field in fields.values())
    if total > LARGEST:
        raise CheckpointError(f"kernel: found {total} numbers in all, expected {LARGEST} at most")
    batch, dtype = _check_state(all_parts, leaves)
    for each in numbers:
        _check_numbers(each, batch, dtype)


def read_checkpoint(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The leaves and the metadata of a checkpoint from which compiled code can continue; else a CheckpointError."""
    leaves, facts = load(path)
    torch = "Online(ESTIMATOR).restore(path), with torch"
    if facts.get("kernel") is None:
        raise CheckpointError(
            f"{path}: does not say how its estimator is built, or it has no compiled code: use {torch}"
        )
    try:
        if not isinstance(name := facts.get("estimator"), str):
            raise wrong("estimator", name, "the name of an estimator")
        check(facts["kernel"], leaves)
    except CheckpointError as error:
        raise CheckpointError(
            f"{path}: {str(error)[:QUOTED]}: use the checkpoint saved before it, or {torch}"
        ) from error
    return leaves, facts


def restored(path: Path, template: Any, estimator: str, description: Any) -> tuple[Any, dict[str, Any]]:
    """`checkpoint.restore` of a legal state of the described estimator (None: no kernel); the newest of a folder."""
    if path.is_dir():
        return newest(path, lambda each: restored(each, template, estimator, description))
    state, facts = restore(path, template, estimator)
    try:
        if description is not None:
            _check_state(list(parts(description)), {name: as_array(leaf) for name, leaf in named_leaves(state)})
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {str(error)[:QUOTED]}: use the checkpoint saved before it") from error
    return state, facts


def _fields(all_parts: Sequence[Part]) -> dict[str, Field]:
    return {name: field for part in all_parts for name, field in part.leaves().items()}


def _check_state(all_parts: Sequence[Part], leaves: Mapping[str, np.ndarray]) -> tuple[tuple[int, ...], np.dtype]:
    """The batch and the dtype of a state; a CheckpointError, which names the leaf, where it is not legal.

    What other code than kernels reads is not looked at.
    """
    fields, others = _fields(all_parts), elsewhere(all_parts)
    if other := sorted(name for name in fields.keys() ^ leaves.keys() if not name.startswith(others)):
        what = "found no such leaf" if other[0] in fields else "found a leaf that the estimator does not have"
        raise CheckpointError(f"state.{other[0]}: {what}, expected the leaves of the described estimator")
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


def _check_numbers(numbers: Entry, batch: tuple[int, ...], dtype: np.dtype) -> None:
    """Raise a CheckpointError unless values are numbers, broadcast against the batch, and are legal in this dtype."""
    entry, value, legal, vector, length = numbers
    try:
        array = np.asarray(value)
    except ValueError:  # lists of different lengths, or nested too deep
        array = np.asarray(None)
    if array.dtype.kind not in "iuf":
        raise wrong(entry, value, "a number, or lists of numbers")
    shape = batch if vector is None else (*batch, length)
    behind = shape[len(shape) - array.ndim :]
    fits = array.ndim <= len(shape) and all(x in (1, y) for x, y in zip(array.shape, behind, strict=True))
    if not fits or (vector is not None and array.shape[-1:] != shape[-1:]):
        raise CheckpointError(f"{entry}: found the shape {array.shape}, expected one that broadcasts against {shape}")
    with np.errstate(over="ignore"):
        array = array.astype(dtype)
    if len(illegal := legal.wrong(array)):
        raise CheckpointError(f"{entry}: found {illegal[0]}, expected {legal}")


def afresh(
    leaves: dict[str, np.ndarray], first: Callable[[], Mapping[str, np.ndarray]], ended: Collection[str] = ()
) -> tuple[dict[str, np.ndarray], str]:
    """The leaves, where a member whose state is not finite begins again in its vehicle; and a sentence about it, or "".

    `leaves` are of an ensemble or of a boat in the plane, `(*batch, …)`; `first` makes those of the beginning. The
    members `ended`, such as "members.mine.", stay as they are.
    """
    wrong = [name for name, leaf in leaves.items() if leaf.dtype != bool and not np.isfinite(leaf).all()]
    members = sorted({match[0] for name in wrong if (match := MEMBER.match(name))} - {*ended})
    leaves, begin, texts = dict(leaves), first() if members else {}, list[str]()
    for member in members:
        batch = leaves[f"{member.partition('members.')[0]}predictions"].shape[:-1]
        of_member = {name: leaf for name, leaf in leaves.items() if name.startswith(member)}
        bad = ~np.all([np.isfinite(leaf).reshape(*batch, -1).all(-1) for leaf in of_member.values()], 0)
        for name, leaf in of_member.items():
            leaves[name] = np.where(np.reshape(bad, (*batch, *[1] * (leaf.ndim - len(batch)))), begin[name], leaf)
        name = member.replace("members.", "").rstrip(".")
        texts.append(f"the state of {name} is not finite in {bad.sum()} of {bad.size} vehicles: it begins again there")
    return leaves, "; ".join(texts)
