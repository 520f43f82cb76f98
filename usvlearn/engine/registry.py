"""The kinds of a description: estimators that have a kernel, and their wrappers."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from usvlearn.core.family import Family
from usvlearn.estimators import COMPILED
from usvlearn.estimators.wrappers.memory.state import FAMILY as MEMORY
from usvlearn.estimators.wrappers.robust.state import FAMILY as ROBUST

ESTIMATORS: list[Family[Any]] = [import_module(f"usvlearn.estimators.{name}.state").FAMILY for name in COMPILED]
KINDS = {kind: family for family in ESTIMATORS for kind in family.kinds}
WRAPPERS: dict[str, Family[Any]] = {"memory": MEMORY, "robust": ROBUST}


def compilable(description: Mapping[str, Any] | None) -> bool:
    """Whether the kernels can make the steps of an estimator with this description (`Estimator.description`).

    >>> compilable({"kind": "robust", "inner": {"kind": "persistence"}}), compilable(None)
    (True, False)
    """
    if description is None:
        return False
    own: Mapping[str, Any] = description
    if own["kind"] == "ensemble":
        members = own["members"].values()
        return all(compilable(x["inner"] if x["kind"] == "bank" else x) and x["kind"] != "ensemble" for x in members)
    wrappers = []
    while own["kind"] in WRAPPERS:
        wrappers.append(own["kind"])
        own = own["inner"]
    if len(set(wrappers)) < len(wrappers) or own["kind"] not in KINDS:
        return False
    return "memory" in wrappers or not KINDS[own["kind"]].remembers(own)
