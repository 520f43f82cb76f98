"""`identified`: the physical quantities of a boat, from the averaged joint EKF of an ensemble. Imports no torch.

That is the first member that is a joint EKF with periodic estimates (`usvlearn.estimators.joint.reading`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from usvlearn.engine import of_element
from usvlearn.errors import ConfigError
from usvlearn.estimators.joint.reading import Identified, identify, reader_of

Members = Mapping[str, Mapping[str, Any] | None]  # descriptions by name; None of an estimator without one


def members_of(description: Mapping[str, Any]) -> Members:
    """The members of a described ensemble; a single estimator has the name ""."""
    return description["members"] if description["kind"] == "ensemble" else {"": description}


def reader_leaves(
    members: Members, leaves: Mapping[str, np.ndarray]
) -> tuple[Mapping[str, Any], dict[str, np.ndarray]]:
    """The description of the averaged joint EKF, and its own leaves of the state.

    Raises:
        ConfigError: none of the members is an averaged joint EKF.
    """
    name = reader_of(members)
    if name is None:
        raise ConfigError(
            "identified: found no joint EKF with read_every among the estimators, expected one that is itself a "
            "member, not inside a Bank or Robust: add JointEKF(..., read_every=600.0), or "
            "+estimator@estimators.joint_averaged=joint_averaged on the command line, and learn anew"
        )
    prefix, description = f"members.{name}." if name else "", members[name]
    assert description is not None
    own = {key.removeprefix(prefix): np.asarray(leaf) for key, leaf in leaves.items() if key.startswith(prefix)}
    return description, own


def identified(members: Members, leaves: Mapping[str, np.ndarray]) -> list[Identified]:
    """What the averaged joint EKF has identified of each boat.

    Args:
        members: descriptions by name; see `members_of`.
        leaves: of the state by dotted name, `(boats, …)`.

    Raises:
        ConfigError: none of the members is an averaged joint EKF.
    """
    description, own = reader_leaves(members, leaves)
    boats = len(own["mean"])
    return [
        identify(of_element(description, boats, element), {key: leaf[element] for key, leaf in own.items()})
        for element in range(boats)
    ]


def sentences(found: Mapping[str, Identified]) -> list[str]:
    """What is said of each boat: once where it is true of all of them, else with the names of the boats.

    >>> sentences({})
    []
    """
    said: dict[str, list[str]] = {}
    for boat, each in found.items():
        for sentence in filter(None, (each.basis, each.scale, *each.lacks)):
            said.setdefault(sentence, []).append(boat)
    every = "all boats" if len(found) > 1 and len(said) > 2 else ""
    named = {sentence: every if len(of) == len(found) else ", ".join(of) for sentence, of in said.items()}
    return [f"{boats}: {sentence}" if boats else sentence for sentence, boats in named.items()]
