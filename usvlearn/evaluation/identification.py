"""What an ensemble's averaged joint EKF has identified of each boat."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from usvlearn.core.checkpoint import as_array
from usvlearn.core.protocol import spec_of
from usvlearn.core.samples import named_leaves
from usvlearn.engine.identified import identified, identified_planar
from usvlearn.estimators.ensemble.layer import Ensemble
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.estimators.planar.layer import Planar

Truth = Mapping[str, Mapping[str, float]]  # boat -> quantity -> value


def identified_boats(
    ensemble: Ensemble, state: Any, boats: Sequence[str], required: bool = False
) -> dict[str, Identified]:
    """The quantities of each boat by name; {} if the ensemble has no averaged joint EKF.

    Args:
        ensemble: with its members.
        state: leaves `(boats, …)`.
        boats: their names.
        required: whether a missing one raises a ConfigError.
    """
    name = ensemble.averaged
    if name is None and not required:
        return {}
    members = {} if name is None else {name: spec_of(ensemble.members[name])}
    leaves = {key: as_array(leaf) for key, leaf in named_leaves(state.members.get(name, {}), f"members.{name}")}
    return dict(zip(boats, identified(members, leaves), strict=True))


def identified_planar_boats(planar: Planar, state: Any, boats: Sequence[str]) -> dict[str, Identified]:
    """As `identified_boats`, with the quantities of turning.

    Args:
        planar: with its ensembles.
        state: leaves `(boats, …)`.
        boats: their names.
    """
    if planar.surge.averaged is None:
        return {}
    leaves = {key: as_array(leaf) for key, leaf in named_leaves(state) if ".members." in key}
    return dict(zip(boats, identified_planar(planar.description(), leaves), strict=True))


def as_results(found: Mapping[str, Identified], truth: Truth) -> dict[str, Any]:
    """The entries of `results.json`: `identified`, boat -> quantity -> value, low, high, unit, and truth if known; and
    `lacks`, boat -> what its log lacks. {} without an averaged joint EKF.
    """
    if not found:
        return {}
    values = {boat: each.json() for boat, each in found.items()}
    for boat, known in truth.items():
        for name in known.keys() & values.get(boat, {}).keys():
            values[boat][name]["truth"] = known[name]
    return {"identified": values, "lacks": {boat: list(each.lacks) for boat, each in found.items()}}
