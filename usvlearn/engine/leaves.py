"""The leaves of the state of a described estimator, in the order of the kernels, with their legal ranges."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.family import Field
from usvlearn.engine.registry import KINDS
from usvlearn.errors import ShapeError
from usvlearn.estimators.ensemble import state as ensemble
from usvlearn.estimators.ensemble.accommodation import state as accommodation
from usvlearn.estimators.ensemble.combiners.state import RULES
from usvlearn.estimators.ensemble.conformal import state as conformal
from usvlearn.estimators.ensemble.forecasts import state as forecasts
from usvlearn.estimators.ensemble.manoeuvre_intervals import state as conditional
from usvlearn.estimators.ensemble.monitors import state as monitors
from usvlearn.estimators.planar import state as track
from usvlearn.estimators.planar.state import AXES
from usvlearn.estimators.wrappers.robust.state import FAMILY as ROBUST

Description = Mapping[str, Any]
MEMBER = re.compile(r"(\w+\.)?members\.\w+\.")  # prefix of the leaves of one
KNOWN = "forecasts.conditional."  # prefix of what the intervals of forecasts know of the manoeuvre


class Part(NamedTuple):
    """One estimator of a description, and what is around it."""

    own: Description
    prefix: str  # of its leaves
    robust: Description | None  # of the `Robust` around it


def unwrapped(description: Description, prefix: str = "") -> Part:
    """An estimator apart from the `Robust` around it; `prefix` is that of the leaves of the whole."""
    if description["kind"] == "robust":
        return Part(description["inner"], f"{prefix}inner.", description)
    return Part(description, prefix, None)


def leaves_of(description: Description) -> dict[str, Field]:
    """The leaves of the state of an estimator with this description."""
    if description["kind"] == "planar":
        axes = {f"{axis}.{name}": each for axis in AXES for name, each in leaves_of(description[axis]).items()}
        return axes | track.FAMILY.leaves(track_size(description), "track.")
    if description["kind"] != "ensemble":
        return _member(description, "")
    found: dict[str, Field] = {}
    for name, member in description["members"].items():
        own = _member(member, f"members.{name}.")
        found |= {name: replace(each, legal=each.legal.inactive()) for name, each in own.items()}
    for name, rule in description["rules"].items():
        found |= RULES[rule["kind"]].leaves(len(rule["columns"]), f"combiners.{name}.")
    names = len(description["columns"]) + len(description["rules"])
    own = {"conditional": description.get("conditional", 0)}
    found |= conformal.FAMILY.leaves(names, "conformal.", own) | ensemble.FAMILY.leaves(names)
    found |= {} if description["monitors"] is None else monitors.FAMILY.leaves(names, "monitors.")
    found |= _forecasts(description) if description.get("forecasts") else {}
    return found | (accommodation.FAMILY.leaves(0, "accommodation.") if "accommodation" in description else {})


def frozen(description: Description) -> dict[str, Field]:
    """The leaves of an estimator that its open-loop simulation needs, by name."""
    part = unwrapped(description)
    family, every = KINDS[part.own["kind"]], _member(description, "")
    names = family.frozen or family.leaves(part.own["size"], own=part.own)
    return {part.prefix + name: every[part.prefix + name] for name in names}


def forecast_size(made: Description) -> tuple[int, int, int]:
    """Slots, horizons and members of forecasts."""
    return made["slots"], len(made["vectors"]["horizons"]), len(made["members"]) + (forecasts.FIT in made)


def copied(description: Description) -> list[tuple[str, int]]:
    """The forecasts' members by the names of their copies, with their columns; a fit has copies of a joint EKF."""
    made, columns = description["forecasts"], description["columns"]
    found = [(columns[column], column) for column in made["members"]]
    return [*found, (forecasts.FIT, made[forecasts.FIT]["column"])] if forecasts.FIT in made else found


def block_size(description: Description) -> int:
    """Numbers of an ensemble's frozen members."""
    names = (description["columns"][column] for _, column in copied(description))
    return sum(int(np.prod(each.shape, dtype=int)) for name in names for each in frozen(
        description["members"][name]).values())  # fmt: skip


def track_size(description: Description) -> tuple[int, int, int]:
    """Slots, horizons, and length of a slot of tracks."""
    horizons, blocks = description["vectors"]["horizons"], []
    for axis in AXES:
        _, own, members = forecast_size(description[axis]["forecasts"])
        blocks.append(own * members + block_size(description[axis]))
    slots = track.slots_of(tuple(horizons), description["numbers"]["overlap"])
    return slots, len(horizons), track.slot_length(len(horizons), blocks)


def _forecasts(description: Description) -> dict[str, Field]:
    """The leaves of an ensemble's forecasts."""
    made, found = description["forecasts"], {}
    for name, column in copied(description):
        for leaf, field in frozen(description["members"][description["columns"][column]]).items():
            legal = field.legal.inactive()
            found[f"forecasts.frozen.{name}.{leaf}"] = replace(field, shape=(made["slots"], *field.shape), legal=legal)
    found |= forecasts.FAMILY.leaves(size := forecast_size(made), "forecasts.")
    return found | (conditional.FAMILY.leaves(size[:2], KNOWN) if description.get("conditional") else {})


def afresh(
    leaves: dict[str, np.ndarray], first: Callable[[], Mapping[str, np.ndarray]]
) -> tuple[dict[str, np.ndarray], str]:
    """The leaves, where a member whose state is not finite begins again in its vehicle; and a sentence about it, or "".

    `leaves` are of an ensemble or of a boat in the plane, `(*batch, …)`; `first` makes those of the beginning.
    """
    wrong = [name for name, leaf in leaves.items() if leaf.dtype != bool and not np.isfinite(leaf).all()]
    members = sorted({found[0] for name in wrong if (found := MEMBER.match(name))})
    leaves, begin, told = dict(leaves), first() if members else {}, list[str]()
    for member in members:
        batch = leaves[f"{member.partition('members.')[0]}predictions"].shape[:-1]
        own = {name: leaf for name, leaf in leaves.items() if name.startswith(member)}
        bad = ~np.all([np.isfinite(leaf).reshape(*batch, -1).all(-1) for leaf in own.values()], 0)
        for name, leaf in own.items():
            leaves[name] = np.where(np.reshape(bad, (*batch, *[1] * (leaf.ndim - len(batch)))), begin[name], leaf)
        name = member.replace("members.", "").rstrip(".")
        told.append(f"the state of {name} is not finite in {bad.sum()} of {bad.size} vehicles: it begins again there")
    return leaves, "; ".join(told)


def batch_of(fields: Mapping[str, Field], leaves: Mapping[str, np.ndarray]) -> tuple[int, ...]:
    """The batch of a state, from the shape of its first leaf; a ShapeError where that leaf is missing."""
    name, field = next(iter(fields.items()))
    if name not in leaves or leaves[name].ndim < len(field.shape):
        found = f"found the shape {leaves[name].shape}" if name in leaves else "found no such leaf"
        raise ShapeError(f"{name}: {found}, expected (*batch, {', '.join(map(str, field.shape))})")
    return leaves[name].shape[: leaves[name].ndim - len(field.shape)]


def _member(description: Description, prefix: str) -> dict[str, Field]:
    """The leaves of one estimator, and of the `Robust` around it."""
    part = unwrapped(description, prefix)
    found = KINDS[part.own["kind"]].leaves(part.own["size"], part.prefix, part.own)
    return found if part.robust is None else found | ROBUST.leaves(0, prefix)
