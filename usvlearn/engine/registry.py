"""The kinds of a description: estimators that have a kernel."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from usvlearn.core.family import Family
from usvlearn.estimators import COMPILED

ESTIMATORS: list[Family[Any]] = [import_module(f"usvlearn.estimators.{name}.state").FAMILY for name in COMPILED]
KINDS = {kind: family for family in ESTIMATORS for kind in family.kinds}


def compilable(description: Mapping[str, Any] | None) -> bool:
    """Whether the kernels can make the steps of an estimator with this description (`Estimator.description`)."""
    if description is None:
        return False
    if description["kind"] == "ensemble":
        return all(compilable(member) and member["kind"] != "ensemble" for member in description["members"].values())
    inner: Mapping[str, Any] = description["inner"] if description["kind"] == "robust" else description
    return inner["kind"] in KINDS
