"""Values of the gates as named leaves: their digest, and the first place where two sets of leaves differ.

A case is a dict of parts. The leaves of a part whose name ends with "by step" have the time as their first axis; a text
is the array of its lines. Values are equal if they have the same bits, except that every NaN equals every other.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

STEPPED = "by step"
PART = ": "  # between a part and a leaf of it
DIGITS = 10  # of a digest, hexadecimal
LONGEST = 90  # characters of a value that is printed

Leaves = Mapping[str, np.ndarray]


class Difference(NamedTuple):
    """Where two cases differ first."""

    leaf: str
    place: str  # such as "step 12", "place 12 (3)" or "as a whole"
    recorded: str
    present: str

    def __str__(self) -> str:
        return f"{self.leaf}, {self.place}: recorded {self.recorded}, now {self.present}"


def leaves(parts: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The leaves of a case by name, such as "end: theta", "end: names.0" or "steps"."""
    return {
        name + (f"{PART}{path}" if path else ""): leaf
        for name, part in parts.items()
        for path, leaf in _flattened("", part)
    }


def _flattened(path: str, tree: Any) -> Iterator[tuple[str, np.ndarray]]:
    """Of trees of dicts, sequences and NamedTuples: arrays, tensors, numbers and texts."""
    if isinstance(tree, tuple) and hasattr(tree, "_asdict"):
        tree = tree._asdict()
    if isinstance(tree, list | tuple):
        tree = {str(k): each for k, each in enumerate(tree)}
    if isinstance(tree, Mapping):
        for name, each in tree.items():
            yield from _flattened(f"{path}.{name}" if path else str(name), each)
    elif isinstance(tree, str | Fraction | Path | None):
        yield path, np.array(str(tree).splitlines() or [""])
    else:
        array = np.asarray(tree.detach().numpy() if hasattr(tree, "detach") else tree)
        if array.dtype.hasobject:
            raise TypeError(f"{path}: found {type(tree).__name__}, expected numbers, texts, or a tree of them")
        yield path, array


def bits(array: np.ndarray) -> np.ndarray:
    """An array as integers that are equal where its numbers have equal bits; all NaN are one."""
    if array.dtype.kind != "f":
        return array
    return np.where(np.isnan(array), array.dtype.type(np.nan), array).view(f"u{array.itemsize}")


def digest(case: Leaves) -> str:
    """Of all names, types, shapes and bits."""
    sha = hashlib.sha256()
    for name, leaf in case.items():
        sha.update(f"{name}\n{leaf.dtype} {leaf.shape}\n".encode())
        sha.update(np.ascontiguousarray(bits(leaf)).tobytes())
    return sha.hexdigest()[:DIGITS]


def first_difference(recorded: Leaves, present: Leaves) -> Difference | None:
    """The first difference of two cases, in the order of parts, then steps, then leaves; None if all is equal."""
    names = [*recorded, *(name for name in present if name not in recorded)]
    for part in dict.fromkeys(name.partition(PART)[0] for name in names):
        same = [name for name in names if name.partition(PART)[0] == part]
        pairs = [(place, name) for name in same if (place := _first(recorded.get(name), present.get(name))) is not None]
        if pairs:
            place, name = min(pairs, key=lambda each: each[0][:1] or (0,))  # of several at one step, the first leaf
            return _told(part, name, place, recorded.get(name), present.get(name))
    return None


def _first(recorded: np.ndarray | None, present: np.ndarray | None) -> tuple[int, ...] | None:
    """The index of the first difference; () where a leaf is missing, is a number, or has another type or shape."""
    if recorded is None or present is None or _kind(recorded) != _kind(present):
        return ()
    if recorded.shape != present.shape and not recorded.dtype.kind == "U":
        return ()
    if recorded.shape == present.shape:
        differ = np.asarray(bits(recorded) != bits(present))
        return tuple(map(int, np.argwhere(differ)[0])) if differ.any() else None
    lines = min(len(recorded), len(present))
    return next(((k,) for k in range(lines) if recorded[k] != present[k]), (lines,))


def _kind(leaf: np.ndarray) -> str:
    return leaf.dtype.kind if leaf.dtype.kind == "U" else str(leaf.dtype)


def _told(
    part: str, name: str, place: tuple[int, ...], recorded: np.ndarray | None, present: np.ndarray | None
) -> Difference:
    where = "as a whole"
    if place:
        said, element = "step" if part.endswith(STEPPED) else "place", ", ".join(map(str, place[1:]))
        where = f"{said} {place[0]}{element and f' ({element})'}"
    pair = [_shown(leaf, place) for leaf in (recorded, present)]
    if max(map(len, pair)) > LONGEST:  # from shortly before the first character that differs
        same = next((k for k, (a, b) in enumerate(zip(*pair, strict=False)) if a != b), min(map(len, pair)))
        begin = max(same - LONGEST // 3, 0)
        pair = ["… " * (begin > 0) + each[begin:][:LONGEST] for each in pair]
    return Difference(name, where, *pair)


def _shown(leaf: np.ndarray | None, place: tuple[int, ...]) -> str:
    if leaf is None:
        return "nothing"
    if place and place[0] >= len(leaf):
        return "no such place"
    return repr(leaf[place].item()) if place or not leaf.ndim else f"{leaf.dtype} {leaf.shape}"
