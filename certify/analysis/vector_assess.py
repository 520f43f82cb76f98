"""Everything that `certify` finds about one network with a vector state: a JSON object, and its certificates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from certify.analysis.assess import time_constant
from certify.networks.vector import VectorNetwork
from certify.proofs import vector_certificate, vector_exact
from certify.proofs.rounding import float_above
from certify.proofs.vector_exact import Matrix
from certify.search.vector_scaling import best_scaling

STEPS = "steps"  # the certificate of all steps, beside those of the conditions
NEARLY = Fraction(99, 100)  # of the largest step: at the largest itself the rate is 1
SHARE = 0.1  # of the seconds of a search on a box, which the search of a scaling takes


def assess(
    network: VectorNetwork,
    seconds: float = 10.0,
    solver: str | None = None,
    steps: bool = False,
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """The rates that each condition proves, rounded up, and a verified certificate of each condition that holds.

    Args:
        network: one checkpoint.
        seconds: as for the search on a box of a network with one state; that of a scaling takes a tenth.
        solver: of the LMIs, if they are to be solved; a name that cvxpy knows.
        steps: whether to prove, in the norm of `exact`, that all steps up to the largest contract. This certificate
            has the key `STEPS`.

    >>> import numpy as np
    >>> from certify.networks.vector import VectorWeights, check
    >>> turn = VectorWeights(None, [[0.0, 0.5], [-0.5, 0.0]], np.eye(2), np.zeros((2, 1)), np.zeros(2))
    >>> row, made = assess(VectorNetwork("turn.npz", check(turn)))
    >>> row["rates"]["exact"], sorted(made)
    (0.5, ['exact'])
    """
    weights, phi = network.weights, network.activation
    rates: dict[str, Fraction | None] = {"gershgorin": None}
    made: dict[str, dict[str, Any] | None] = {}
    if weights.V is None and phi.name == "relu":
        rates["gershgorin"] = vector_exact.gershgorin(weights)[1]
        made["gershgorin"] = vector_certificate.make(network, "gershgorin")
    statuses, metric = {}, None
    if solver is not None:
        for name in ("lmi", "tight"):
            rates[name] = None
            if name == "tight" or phi.name == "relu":
                made[name], statuses[name] = _solved(network, name, solver)
                if (proved := made[name]) is not None:
                    rates[name] = Fraction(proved["rate"])
                    metric = [[Fraction(x) for x in each] for each in proved["proof"]["metric"]]
    norm, scaling, exact, _ = best_scaling(weights, phi, SHARE * seconds, metric)
    rates["exact"] = exact
    made["exact"] = vector_certificate.make(network, "exact", norm=norm, scaling=scaling)
    row: dict[str, Any] = {
        "path": network.path,
        "states": network.states,
        "n": network.neurons,
        "m": network.inputs,
        "activation": str(phi),
        "hidden_layers": 1 if weights.V is None else 2,
        "rates": {name: None if rate is None else float_above(rate) for name, rate in rates.items()},
        "norm": norm,
        "scaling": [[str(x) for x in each] for each in scaling],
    }
    if statuses:
        row["solver"] = {"name": solver, **statuses}
    found = {name: each for name, each in made.items() if each is not None}
    row["certified"] = {name: name in found for name in vector_certificate.CONDITIONS if name in made}
    smallest = [Fraction(each["contraction_rate"]) for each in found.values()]
    row["rate"] = float_above(min(smallest)) if smallest else None
    row["time_constant"] = time_constant(min(smallest)) if smallest else None  # in steps
    if steps:  # about other steps: no verdict about the network's own
        row["steps"], all_steps = _all_steps(network, norm, scaling)
        if all_steps is not None:
            found[STEPS] = all_steps
    return row, found


def _solved(network: VectorNetwork, name: str, solver: str) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    from certify.search.vector_lmi import smallest_rate

    found = smallest_rate(network.weights, network.activation, 2 if name == "lmi" else 1, solver)
    made = None
    if found.proof is not None and found.kappa is not None and found.kappa <= 1:
        made = vector_certificate.make(network, name, found.kappa, found.proof)
    answer = {"rate": found.rate if math.isfinite(found.rate) else None, "status": found.status}
    return made, {**answer, "seconds": found.seconds}


def _all_steps(
    network: VectorNetwork, norm: str, scaling: Matrix
) -> tuple[dict[str, str] | None, dict[str, Any] | None]:
    """The steps that contract, in steps of the network, and the certificate for all of them but the last percent."""
    from certify.proofs.steps import short, steps

    found = steps(network.weights, vector_exact.everywhere(network.weights, network.activation), norm, scaling)
    proved = short(NEARLY * found.largest)
    made = None
    if proved is not None:
        made = vector_certificate.make(network, "exact", norm=norm, scaling=scaling, step=proved)
    if made is None:
        return None, None
    row = {"largest": str(found.largest), "fastest": str(found.fastest), "proved": str(proved)}
    return row, made


def best(certificates: dict[str, dict[str, Any]], condition: str | None) -> str | None:
    """The condition that is judged: the one asked for, or of `exact` and `tight` the one with the smaller rate.

    >>> best({"exact": {"contraction_rate": "1/2"}, "tight": {"contraction_rate": "1/3"}}, None)
    'tight'
    """
    names: Sequence[str] = ("exact", "tight") if condition is None else (condition,)
    held = [name for name in names if name in certificates]
    return min(held, key=lambda name: Fraction(certificates[name]["contraction_rate"]), default=None)
