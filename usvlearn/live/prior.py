"""The state from which a node without a checkpoint starts: the default ensemble before its first measurement.

The ensemble is made of the boat's mass m and top speed U. Each number of its state and of its description is

    c mᵃ Uᵇ

with whole a and b, because it is a physical quantity that is formed of m, U and constants. The file beside this module
contains the numbers c, which are those of m = 1 kg and U = 1 m/s, and the powers a, b of the numbers that vary.
`python aboard/build_prior.py` makes it anew from the configuration, with torch.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from usvlearn.core import checkpoint
from usvlearn.core.samples import LIMIT, speed_limit
from usvlearn.errors import check_positive

FILE = Path(__file__).with_name("prior.safetensors")


def prior(mass: float, surge_max: float) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The state by dotted name and the facts from which `Online.of` starts, of a mass in kg and a top speed in m/s."""
    check_positive("mass", mass, "of kg")
    check_positive("surge_max", surge_max, "of m/s")
    leaves, facts = checkpoint.load(FILE)
    facts["kernel"] = with_limit(facts["kernel"], speed_limit(surge_max))
    for name, (a, b) in facts["powers"]["state"].items():
        leaves[name] = _scaled(leaves[name], a, b, mass, surge_max)
    for path, (a, b) in facts["powers"]["kernel"].items():
        *parents, last = path.split(".")
        entry = facts["kernel"]
        for parent in parents:
            entry = entry[parent]
        entry[last] = _scaled(entry[last], a, b, mass, surge_max).tolist()
    return leaves, {"estimator": facts["estimator"], "kernel": facts["kernel"]}


def with_limit(node: Any, limit: float) -> Any:
    """A configuration or description in which the limits of speeds that stand at their default are this one, m/s."""
    if not isinstance(node, dict):
        return node
    return {k: limit if k == "surge_max" and x == LIMIT else with_limit(x, limit) for k, x in node.items()}


def _scaled(c: Any, a: Any, b: Any, mass: float, surge_max: float) -> np.ndarray:
    """c mᵃ Uᵇ of arrays, or lists, of one shape; a and b may also be one number each."""
    return np.asarray(c) * float(mass) ** np.array(a) * float(surge_max) ** np.array(b)
