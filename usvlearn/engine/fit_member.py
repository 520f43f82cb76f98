"""Adds a batch fit to the forecasts of a running ensemble: the new state and description.

Its copies are those of the first joint EKF that is weighed. Its weights begin at `FIT_WEIGHT`, with the regret of the
others' mixture; under way it has none, so that what was forecast before stays. The next fit replaces its table alone.
A table of zeros makes it inactive (its forecasts are NaN); after that its weights begin anew.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from usvlearn.engine.parts import Description, leaves_of
from usvlearn.estimators.ensemble.forecasts import state as at
from usvlearn.estimators.ensemble.forecasts.state import EMPTY, FIT, FIT_WEIGHT

Leaves = dict[str, np.ndarray]


def with_fit(leaves: Mapping[str, np.ndarray], description: Description, table: Any) -> tuple[Leaves, Any]:
    """The leaves and the description with the table of a fit; as they are where no joint EKF is weighed.

    They are of an ensemble or of a boat in the plane; the table is of `usvlearn.model.fit.hand_over.table_of`.
    """
    if description["kind"] == "planar":
        surge_leaves = {name[6:]: leaf for name, leaf in leaves.items() if name.startswith("surge.")}
        surge_leaves, surge = with_fit(surge_leaves, description["surge"], table)
        description = {**description, "surge": surge}
        length, slots = leaves_of(description)["track.slots"].shape[-1], leaves["track.slots"]
        changed = {**leaves, **{f"surge.{name}": leaf for name, leaf in surge_leaves.items()}}
        if slots.shape[-1] != length:  # tracks under way end
            changed["track.slots"] = np.full((*slots.shape[:-1], length), EMPTY)
        return changed, description
    forecasts: Mapping[str, Any] = description.get("forecasts") or {"members": []}
    members, changed = description.get("members", {}), dict(leaves)
    weighed = {description["columns"][column]: column for column in forecasts["members"]}
    name = next((name for name in weighed if members[name]["kind"] == "joint"), None)
    if name is None or FIT in members:
        return changed, description
    new = {**forecasts, FIT: {"column": weighed[name], "table": np.asarray(table).tolist()}}
    first, place = FIT not in forecasts, len(weighed)
    anew = np.array(True) if first else ~np.any(forecasts[FIT]["table"], -1)
    if anew.any():
        rule = {key: leaves[f"forecasts.rule.{key}"][..., :place] for key in ("weights", "losses", "squares", "ranges")}
        weights = rule["weights"] / rule["weights"].sum(-1, keepdims=True)
        more = {key: (weights * rule[key]).sum(-1) for key in ("losses", "squares")}
        more |= {"weights": FIT_WEIGHT, "ranges": rule["ranges"].max(-1)}
        rule["weights"] = (1 - FIT_WEIGHT) * weights
        begun = {f"forecasts.rule.{key}": np.insert(each, place, more[key], -1) for key, each in rule.items()}
        begin = f"forecasts.frozen.{name}."
        under_way = {leaf: x for leaf, x in leaves.items() if leaf.startswith(begin)}
        begun |= {leaf.replace(begin, f"forecasts.frozen.{FIT}."): x for leaf, x in under_way.items()}
        for leaf, x in begun.items():
            where = anew.reshape(anew.shape + (1,) * (x.ndim - anew.ndim))
            changed[leaf] = x if first else np.where(where, x, leaves[leaf])
    if first:
        new["vectors"] = forecasts["vectors"] | at.with_fit(forecasts["vectors"]["prior"])
        for leaf, value in (("forecasts.weights", 0.0), ("forecasts.predictions", math.nan)):
            changed[leaf] = np.insert(leaves[leaf], place, value, -1)
    return changed, {**description, "forecasts": new}
