"""Compiled twins of the estimators' steps: the same steps on the same states, equal to them to rounding; no torch.

One program serves every estimator: a table of numbers says what it is made of (`plan`), and the kernels interpret it,
so that nothing is compiled anew for another ensemble. A state is one row of numbers per lane, of which its leaves are
views. The files, in the order in which they build on each other:

    arrays samples ranges            sums and copies; samples as the kernels read them; which numbers are legal
    regressors rls aid rnn stable    one file per family of estimators; `stable` projects the network's weights
    combiners monitors               what an ensemble does with its members' predictions
    step          one estimator, one ensemble, one step; runs over (time, lanes)
    leaves        which leaves the state of a described estimator has
    plan          from an estimator's `kernel()` to the table, the parameters and the places of the leaves
    describe      whether what a file says of an estimator and its state is legal
    run           what the rest of the library calls
"""

from collections.abc import Mapping
from typing import Any

import numpy as np


def compilable(description: Mapping[str, Any] | None) -> bool:
    """Whether the kernels can make the steps of an estimator that describes itself so (`Estimator.spec`).

    >>> compilable({"kind": "robust", "inner": {"kind": "persistence"}}), compilable(None)
    (True, False)
    """
    if description is None:
        return False
    if description["kind"] == "ensemble":
        members = description["members"].values()
        return all(compilable(x["inner"] if x["kind"] == "bank" else x) and x["kind"] != "ensemble" for x in members)
    wrappers = []
    while description["kind"] in ("robust", "memory"):
        wrappers.append(description["kind"])
        description = description["inner"]
    alone = len(set(wrappers)) == len(wrappers) and description["kind"] not in ("bank", "ensemble")
    return alone and ("memory" in wrappers or "memory" not in description.get("terms", ()))


def of_lane(description: Any, lanes: int, lane: int, depth: int = 0) -> Any:
    """The description of one lane of many: of each number that differs by lane, its own.

    >>> many = {"kind": "aid", "numbers": {"gain": [1.0, 2.0], "scale": 28.0}, "vectors": {"spread": [[1.0], [3.0]]}}
    >>> of_lane(many, 2, 1)
    {'kind': 'aid', 'numbers': {'gain': 2.0, 'scale': 28.0}, 'vectors': {'spread': [3.0]}}
    """
    if not isinstance(description, Mapping):
        return description
    own = {}
    for key, value in description.items():
        if key in ("numbers", "vectors"):
            axes = depth + (key == "vectors")  # behind that of the lanes: a bank's settings, a vector's entries
            own[key] = {
                name: x if np.ndim(x) <= axes else (x[lane] if len(x) == lanes else x[0]) for name, x in value.items()
            }
        elif key == "inner":
            own[key] = of_lane(value, lanes, lane, depth + (description["kind"] == "bank"))
        elif key in ("members", "rules"):
            own[key] = {name: of_lane(x, lanes, lane) for name, x in value.items()}
        else:
            own[key] = value
    return own
