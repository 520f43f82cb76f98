"""`identified`: the physical quantities of a boat, from the averaged joint EKF of an ensemble. Imports no torch.

That is the first member that is a joint EKF with `usvlearn.estimators.joint.periodic_estimates`. Of a boat in the
plane the quantities of turning follow (`usvlearn.estimators.axis.turning_intervals`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from usvlearn.engine import select_element
from usvlearn.errors import ConfigError
from usvlearn.estimators.axis.turning_intervals import Filter, with_turning
from usvlearn.estimators.joint.periodic_estimates import Identified, identify, reader_of
from usvlearn.estimators.planar.state import USED, filter_of

Members = Mapping[str, Mapping[str, Any] | None]  # descriptions by name; None of an estimator without one


def members_of(description: Mapping[str, Any]) -> Members:
    """The members of a described ensemble; a single estimator has the name ""."""
    return description["members"] if description["kind"] == "ensemble" else {"": description}


def reader_leaves(
    members: Members, leaves: Mapping[str, np.ndarray]
) -> tuple[Mapping[str, Any], dict[str, np.ndarray]]:
    """The description of the averaged joint EKF, and its own leaves of the state; a ConfigError without one."""
    name = reader_of(members)
    if name is None:
        raise ConfigError(
            "identified: found no joint EKF with estimate_every among the estimators, expected one that is itself a "
            "member, not inside Robust: add JointEKF(..., estimate_every=600.0), or "
            "+estimator@estimators.joint_averaged=joint_averaged on the command line, and learn anew"
        )
    prefix, description = f"members.{name}." if name else "", members[name]
    assert description is not None
    selected = {key.removeprefix(prefix): np.asarray(leaf) for key, leaf in leaves.items() if key.startswith(prefix)}
    return description, selected


def identified(description: Mapping[str, Any], leaves: Mapping[str, np.ndarray]) -> list[Identified]:
    """What the averaged joint EKF has identified of each boat, from leaves `(boats, …)`; a ConfigError without one."""
    if description["kind"] == "planar":
        return _with_turning(description, leaves)
    joint, selected = reader_leaves(members_of(description), leaves)
    boats = len(selected["mean"])
    return [
        identify(select_element(joint, boats, element), {key: leaf[element] for key, leaf in selected.items()})
        for element in range(boats)
    ]


def _with_turning(description: Mapping[str, Any], leaves: Mapping[str, np.ndarray]) -> list[Identified]:
    """As `identified`, of a `Planar`: the quantities of turning follow those of the surge."""
    surge = {name.removeprefix("surge."): leaf for name, leaf in leaves.items() if name.startswith("surge.")}
    joint, _ = reader_leaves(members_of(description["surge"]), surge)
    results, boats = [], identified(description["surge"], surge)
    for element, each in enumerate(boats):
        yaw, sway = (_filter(axis, description[axis], leaves, len(boats), element) for axis in ("yaw", "sway"))
        variance = np.asarray(select_element(joint, len(boats), element)["vectors"]["variance"], dtype=np.float64)
        results.append(with_turning(each, variance, yaw, sway if float(sway[1]["updates"]) >= USED else None))
    return results


def _filter(
    axis: str, ensemble: Mapping[str, Any], leaves: Mapping[str, np.ndarray], boats: int, element: int
) -> Filter:
    """The filter of an axis and its leaves, of one boat."""
    name = filter_of(axis, ensemble)
    assert name is not None  # see `Planar.description`
    prefix = f"{axis}.members.{name}."
    selected = {key.removeprefix(prefix): leaf[element] for key, leaf in leaves.items() if key.startswith(prefix)}
    return select_element(ensemble["members"][name], boats, element), selected


def sentences(boats: Mapping[str, Identified], whole: bool = True) -> list[str]:
    """What is said of each boat: once where it is true of all of them, else with the names of the boats. Not `whole`:
    only what the logs lack.
    """
    said: dict[str, list[str]] = {}
    for boat, each in boats.items():
        for sentence in filter(None, (*((each.basis, each.scale) if whole else ()), *each.lacks)):
            said.setdefault(sentence, []).append(boat)
    every = "all boats" if len(boats) > 1 and len(said) > 2 else ""
    named = {sentence: every if len(of) == len(boats) else ", ".join(of) for sentence, of in said.items()}
    return [f"{boats}: {sentence}" if boats else sentence for sentence, boats in named.items()]
