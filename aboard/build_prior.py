"""`python aboard/build_prior.py`: make the file of `usvlearn.live.prior` from the configuration, with torch.

It must be made anew when a default of the ensemble changes; a test compares the two.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from usvlearn.composition.configuration import compose_train, ensemble_of, plain
from usvlearn.core import checkpoint
from usvlearn.core.samples import named_leaves
from usvlearn.errors import ConfigError, exit_on_user_error
from usvlearn.live.prior import FILE

TRIED = ((2.0, 1.0), (1.0, 2.0), (17.5, 3.5), (0.3, 0.2), (8000.0, 7.9))  # kg, m/s; the first two give the powers
ROUNDING = 1e-12  # relative; settings are stored as logarithms
Parts = dict[str, dict[str, Any]]  # "state" and "kernel": numbers, or else, by dotted path


def default_ensemble(mass: float, surge_max: float) -> tuple[str, dict[str, Any], dict[str, np.ndarray]]:
    """The ensemble of configs/train.yaml for a boat: its name, its description as JSON gives it, its first state."""
    vehicle = {"vehicle": {"mass": mass, "surge_max": surge_max}}
    ensemble = ensemble_of(plain(compose_train([], vehicle)))
    leaves = {name: checkpoint.as_array(leaf) for name, leaf in named_leaves(ensemble.init(()))}
    return type(ensemble).__name__, json.loads(json.dumps(ensemble.description())), leaves


def make(path: Path = FILE) -> Path:
    """Write the file; a ConfigError where a number is no product of whole powers of mass and top speed."""
    name, description, leaves = default_ensemble(1.0, 1.0)
    ones = _parts(description, leaves)
    boats = {boat: _parts(*default_ensemble(*boat)[1:]) for boat in TRIED}
    powers: dict[str, Any] = {"state": {}, "kernel": {}}
    for part, entries in ones.items():
        for entry, c in entries.items():
            changed = {boat: parts[part].get(entry) for boat, parts in boats.items()}
            if (ab := _powers(f"{part}.{entry}", c, changed)) is not None:
                powers[part][entry] = ab
    return checkpoint.save(path, leaves, estimator=name, kernel=description, powers=powers)


def _powers(name: str, c: Any, changed: dict[tuple[float, float], Any]) -> tuple[Any, Any] | None:
    """The powers a, b of an entry c, of its shape, or one number where all are equal; None where it does not vary."""
    if not isinstance(c, np.ndarray) or c.dtype == bool:
        if any(not np.array_equal(each, c) for each in changed.values()):
            raise ConfigError(f"{name}: found a choice that depends on the boat, expected one for all boats")
        return None
    varies = np.isfinite(c) & (c != 0)
    with np.errstate(all="ignore"):
        a, b = (np.where(varies, np.rint(np.log2(changed[boat] / c)), 0.0) for boat in TRIED[:2])
    for (mass, surge_max), numbers in changed.items():
        if not np.allclose(numbers, c * mass**a * surge_max**b, rtol=ROUNDING, atol=0, equal_nan=True):
            raise ConfigError(f"{name}: found a number that is no product of whole powers of mass and surge_max")
    if not a.any() and not b.any():
        return None
    return _shortest(a, varies), _shortest(b, varies)


def _shortest(powers: np.ndarray, varies: np.ndarray) -> Any:
    """Powers as whole numbers: one number if all that matter are equal."""
    ones = np.unique(powers[varies])
    return int(ones[0]) if ones.size == 1 else powers.astype(int).tolist()


def _parts(description: Any, leaves: dict[str, np.ndarray]) -> Parts:
    return {"state": dict(leaves), "kernel": dict(_entries(description))}


def _entries(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """The entries of a description by dotted path; numbers, and lists of them, as arrays."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from _entries(value, f"{path}.{key}" if path else key)
    elif isinstance(tree, float) or (isinstance(tree, list) and any(isinstance(x, float) for x in tree)):
        yield path, np.array(tree, float)
    else:
        yield path, tree


if __name__ == "__main__":
    with exit_on_user_error():
        print(make())
