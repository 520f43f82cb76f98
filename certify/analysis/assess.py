"""Assesses one checkpoint: all conditions, rates and certificates, as a JSON object."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from certify.networks.shallow import Network, ShallowWeights
from certify.networks.vector import MOST_STATES, VectorNetwork, is_recurrent, of_shallow
from certify.proofs import exact, vector_certificate, vector_exact
from certify.proofs.box_planes import Box, value_at
from certify.proofs.box_proof import proves
from certify.proofs.equilibria import equilibria, surge_inputs, sweep
from certify.proofs.rational import Matrix
from certify.proofs.rounding import float_above, float_below
from certify.search.recurrent import by_full_metric, by_spectral_norm, diagonal_scaling
from certify.search.vector_scaling import best_scaling

if TYPE_CHECKING:
    from certify.search.vector_lmi import Solved

HEADINGS = np.linspace(0.0, 2 * math.pi, 12, endpoint=False)  # rad, of the equilibria at rest
AT_REST = (-1.0, 1.0)  # interval of x that is searched for equilibria: twice the largest speed, ahead or astern
STEPS = "steps"  # the certificate of all steps, beside those of the conditions
NEARLY = Fraction(99, 100)  # of the largest step: at the largest itself the rate is 1
SHARE = 0.1  # of the seconds of a search on a box, which the search of a scaling takes
FULL = 6.0  # times these seconds: the search of a full metric
MOST_FULL, MOST_QUADRATIC = 64, 200  # states of a recurrent network with a full metric, and with any


def assess(
    network: Network | VectorNetwork,
    u: np.ndarray | None = None,
    box: Box | None = None,
    seconds: float = 10.0,
    solver: str | None = None,
    steps: bool = False,
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """What is found about one checkpoint; and of a vector state a verified certificate of each condition that holds.

    Margins are rounded down and rates up, so that the printed bounds are true. Places and slopes: rounded to nearest.

    Args:
        network: with one state or with a vector state.
        u: of one state: constant input of the equilibria, `(m,)`; zeros, as in the paper, by default.
        box: of one state: on which the exact rate is searched for, if any.
        seconds: for that search; the search of a scaling of a vector state takes a tenth.
        solver: of the LMIs, if they are to be solved; a name that cvxpy knows.
        steps: of a vector state: whether to prove, in the norm of `exact`, that all steps up to the largest contract.
            This certificate has the key `STEPS`.
    """
    if isinstance(network, VectorNetwork):
        return _vector_state(network, seconds, solver, steps)
    return _one_state(network, np.zeros(network.inputs) if u is None else u, box, seconds, solver), {}


def _one_state(network: Network, u: np.ndarray, box: Box | None, seconds: float, solver: str | None) -> dict[str, Any]:
    weights = network.weights
    n, m = weights.W2.shape
    verdict = exact.verdict(weights)
    assert verdict is not None  # `load` refuses other weights
    K = verdict.rate
    row = {
        "path": network.path,
        "n": n,
        "m": m,
        "margins": {name: float_below(margin) for name, margin in verdict.margins.items()},
        "rate": float_above(K),
        "time_constant": time_constant(K),  # in steps
        "certified": {name: margin > 0 for name, margin in verdict.margins.items()},
        "best_gauge": {name: rate < 1 for name, rate in exact.best_gauge(weights.a, weights.w1).items()},
        "input": list(map(float, u)),
        "equilibria": [_findings(each) for each in equilibria(weights, u)],  # in [0, 1], as in the paper
    }
    if not row["equilibria"] and K < 1:  # a contraction has one on ℝ: |x| ≤ |f(0)|/(1 − K)
        reach = min(float_above(abs(value_at(weights, [0.0, *u])) / (1 - K)), sys.float_info.max)
        row["equilibria_outside"] = [_findings(each) for each in equilibria(weights, u, -reach, reach)]
    if m == 4:
        at_rest = sweep(weights, surge_inputs(HEADINGS), *AT_REST)
        every = [each for places in at_rest for each in places]
        row["at_rest"] = {
            "headings": len(at_rest),
            "equilibria": [min(map(len, at_rest)), max(map(len, at_rest))],
            "x": [float(f(each.x for each in every)) for f in (min, max)] if every else [],
            "classes": sorted({each.kind for each in every}),
        }
    if solver is not None:
        row["lmi"] = {"solver": solver} | solved_both(weights, solver)
    if box is not None:
        row["box"] = search_box(weights, box, seconds)
    return row


def time_constant(K: Fraction) -> float | None:
    """−1/ln K; None where K ≥ 1, or so near to 1 that no float holds it."""
    room = float(1 - K) if K < 1 else 0.0
    if not room:
        return None
    if float(K) == 0:
        return 0.0
    return _number(-1 / (math.log(float(K)) if K < 0.5 else math.log1p(-room)))


def _findings(equilibrium) -> dict[str, Any]:
    """A point, or an interval: {"x": 0.3, …} or {"x": 0.3, "interval": [0.2, 0.4], …}."""
    point = {"x": float(equilibrium.x), "class": equilibrium.kind}
    if equilibrium.lo != equilibrium.hi:
        point["interval"] = [float(equilibrium.lo), float(equilibrium.hi)]
    return {**point, "slopes": [float(equilibrium.slope_left), float(equilibrium.slope_right)]}


def search_box(weights: ShallowWeights, box: Box, seconds: float = 10.0) -> dict[str, Any]:
    """The bracket of the exact rate on a box, and the verdict on rate < 1, with the trees that prove it."""
    from certify.proofs.certificate import provable_rate
    from certify.search import box as search

    bracket = search.rate(weights, box, seconds=seconds / 2)
    asked = [Fraction(1)]
    if (short := provable_rate(1.001 * bracket.upper)) is not None and short < 1:
        asked.insert(0, short)
    for kappa in asked:
        result = search.certify(weights, box, float(kappa), seconds / 2)
        if result.verdict == "certified" or kappa == 1:
            break
    return {
        "verdict": result.verdict,
        "bracket": [bracket.lower, min(bracket.upper, result.upper)],
        "closed": bracket.closed,
        "interval": "certified" if proves(weights, box, ".", 1) else "not certified",
        "proved_rate": result.rate if result.verdict == "certified" else None,
        "forward_invariant": result.invariant,
        "witness": _point(result.witness or bracket.witness),
        "escape": None if result.escape is None else list(map(float, result.escape)),
        "intervals": [[float(lo), float(hi)] for lo, hi in zip(box.lo, box.hi, strict=True)],
        "tree": result.tree,
        "invariance_tree": result.invariance_tree,
    }


def _point(witness) -> dict[str, Any] | None:
    if witness is None:
        return None
    return {"x": float(witness.x), "u": list(map(float, witness.u)), "slope": float(witness.slope)}


def solved(network: VectorNetwork, condition: str, solver: str) -> tuple[dict[str, Any], Solved]:
    """What a solver says of an LMI: `lmi` is the paper's, with slopes up to 2, any other that of the slopes of φ."""
    from certify.search.vector_lmi import smallest_rate

    lmi = smallest_rate(network.weights, network.activation, 2 if condition == "lmi" else 1, solver)
    proved = lmi.kappa is not None and lmi.kappa <= 1
    verdict = "certified" if proved else "not certified" if lmi.rate > 1 else "unknown"
    return {"verdict": verdict, "rate": _number(lmi.rate), "status": lmi.status, "seconds": lmi.seconds}, lmi


def solved_both(weights: ShallowWeights, solver: str) -> dict[str, dict[str, Any]]:
    """What a solver says of the LMIs of one state; the closed forms must agree with it."""
    alike = VectorNetwork("", of_shallow(weights))
    return {name: solved(alike, name, solver)[0] for name in ("lmi", "exact")}


def _number(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None


def _vector_state(
    network: VectorNetwork, seconds: float, solver: str | None, steps: bool
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    weights, phi = network.weights, network.activation
    recurrent = is_recurrent(weights)
    rates: dict[str, Fraction | None] = {} if recurrent else {"gershgorin": None}
    tried: dict[str, dict[str, Any] | None] = {}
    statuses, metric = {}, None
    if recurrent:
        rates["quadratic"], tried["quadratic"] = _quadratic(network, FULL * seconds, solver is not None)
    elif weights.V is None and phi.name == "relu":
        rates["gershgorin"] = vector_exact.gershgorin(weights)[1]
        tried["gershgorin"] = vector_certificate.make(network, "gershgorin")
    if solver is not None and not recurrent:
        for name in ("lmi", "quadratic"):
            rates[name] = None
            if name == "quadratic" or phi.name == "relu":
                statuses[name], answer = solved(network, name, solver)
                tried[name] = None
                if answer.proof is not None and statuses[name]["verdict"] == "certified":
                    tried[name] = vector_certificate.make(network, name, answer.kappa, answer.proof)
                if (proved := tried[name]) is not None:
                    rates[name] = Fraction(proved["rate"])
                    metric = [[Fraction(x) for x in each] for each in proved["proof"]["metric"]]
    if network.states > MOST_STATES:
        norm, scaling = "one", diagonal_scaling(weights.W)
        exact = vector_exact.rate(weights, vector_exact.everywhere(weights, phi), norm, scaling)
    else:
        norm, scaling, exact, _ = best_scaling(weights, phi, SHARE * seconds, metric)
    rates["exact"] = exact
    tried["exact"] = vector_certificate.make(network, "exact", norm=norm, scaling=scaling)
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
    if recurrent:
        row["recurrent"] = True
    if statuses:
        row["solver"] = {"name": solver, **statuses}
    certificates = {name: each for name, each in tried.items() if each is not None}
    row["certified"] = {name: name in certificates for name in vector_certificate.CONDITIONS if name in tried}
    smallest = [Fraction(each["contraction_rate"]) for each in certificates.values()]
    row["rate"] = float_above(min(smallest)) if smallest else None
    row["time_constant"] = time_constant(min(smallest)) if smallest else None  # in steps
    if steps:  # about other steps: no verdict about the network's own
        row["steps"], all_steps = _all_steps(network, norm, scaling)
        if all_steps is not None:
            certificates[STEPS] = all_steps
    return row, certificates


def _quadratic(network: VectorNetwork, seconds: float, full: bool) -> tuple[Fraction | None, dict[str, Any] | None]:
    """The rate of a recurrent network in a norm √(hᵀ P h), and its certificate if it is below 1.

    A full P is searched where a diagonal one does not certify, or where it is asked for.
    """
    W, best = network.weights.W, None
    if network.states <= MOST_QUADRATIC:
        best = by_spectral_norm(W)
    if network.states <= MOST_FULL and (full or best is None or best.kappa > 1):
        full_metric = by_full_metric(W, seconds)
        best = min((each for each in (best, full_metric) if each), key=lambda each: each.kappa, default=None)
    if best is None:
        return None, None
    kappa = max(best.kappa, vector_certificate.SMALLEST_RATE)
    return best.kappa, vector_certificate.make(network, "quadratic", kappa, best.proof) if kappa <= 1 else None


def _all_steps(
    network: VectorNetwork, norm: str, scaling: Matrix
) -> tuple[dict[str, str] | None, dict[str, Any] | None]:
    """The steps that contract, in steps of the network, and the certificate for all of them but the last percent."""
    from certify.proofs.steps import short, steps

    limits = steps(network.weights, vector_exact.everywhere(network.weights, network.activation), norm, scaling)
    proved = short(NEARLY * limits.largest)
    certified = None
    if proved is not None:
        certified = vector_certificate.make(network, "exact", norm=norm, scaling=scaling, step=proved)
    if certified is None:
        return None, None
    row = {"largest": str(limits.largest), "fastest": str(limits.fastest), "proved": str(proved)}
    return row, certified


def judged(row: dict[str, Any], certificates: dict[str, dict[str, Any]], condition: str | None) -> str | None:
    """The condition that certifies a network: the one asked for, if it holds; None where none does.

    Without one asked it is `exact`, and of a vector state that of `exact` and `quadratic` with the smaller rate.
    """
    if "states" not in row:
        name = "exact" if condition in (None, "quadratic") else str(condition)
        if name in row["certified"]:
            return name if row["certified"][name] else None
        return name if row["box"]["verdict" if name == "box" else "interval"] == "certified" else None
    names: Sequence[str] = ("exact", "quadratic") if condition is None else (condition,)
    held = [name for name in names if name in certificates]
    return min(held, key=lambda name: Fraction(certificates[name]["contraction_rate"]), default=None)
