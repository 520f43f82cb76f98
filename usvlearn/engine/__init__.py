"""Runs of compiled code: the same steps on the same states as torch's, equal to rounding; no torch.

The engine knows the layout of no family. Each declares its own (`usvlearn.family`); its `kernel.py` makes its steps.
One program serves every estimator: a table says what it is made of, and the kernels interpret it. So nothing is
compiled anew for another ensemble. A state is one row of numbers per lane; its leaves are views of that row. The files,
in the order in which they build on each other:

    kinds         the families that have a kernel; whether an estimator is made of them alone
    chains        one function for each verb, which calls the kernel of the family at hand
    dispatch      one estimator with its wrappers, one ensemble, one step; runs over (time, lanes)
    leaves        which leaves the state of a specified estimator has
    program       from a specification (`Estimator.spec`) to the table, the numbers and the places of the leaves
    check         whether a specification and a state from a file are legal
    run, live, free_runs    what the rest of the library calls
"""

from collections.abc import Mapping
from typing import Any

import numpy as np


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
