"""Everything that `certify` finds about one checkpoint, as a JSON object."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np

from certify.errors import CertifyError
from certify.networks.shallow import Network, ShallowWeights
from certify.proofs import exact
from certify.proofs.box_planes import Box, value_at
from certify.proofs.box_proof import proves
from certify.proofs.equilibria import equilibria, surge_inputs, sweep
from certify.proofs.rounding import float_above, float_below

HEADINGS = np.linspace(0.0, 2 * math.pi, 12, endpoint=False)  # rad, of the equilibria at rest
AT_REST = (-1.0, 1.0)  # interval of x that is searched for equilibria: twice the largest speed, ahead or astern


def assess(
    network: Network,
    u: np.ndarray | None = None,
    box: Box | None = None,
    seconds: float = 10.0,
    solve: Callable[[ShallowWeights], dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """Every condition, decided exactly; the equilibria; the results of the solver and of the search on the box.

    Margins are rounded down and rates up, so that the printed bounds are true. Places and slopes: rounded to nearest.

    Args:
        network: one checkpoint.
        u: constant input of the equilibria, `(m,)`; zeros, as in the paper, by default.
        box: on which the exact rate is searched for, if any.
        seconds: for that search.
        solve: solves the LMI, if given; see `solver`.

    >>> found = assess(Network("a.npz", ShallowWeights(*map(np.array, ([0.5], [1.0], [[0.0]], [0.25])))))
    >>> found["rate"], found["certified"]["tight"], found["equilibria"][0]["x"]
    (0.5, True, 0.25)
    """
    weights = network.weights
    n, m = weights.W2.shape
    verdict = exact.verdict(weights)
    assert verdict is not None  # `load` refuses other weights
    K = verdict.rate
    u = np.zeros(m) if u is None else u
    found = {
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
    if not found["equilibria"] and K < 1:  # a contraction has one on ℝ: |x| ≤ |f(0)|/(1 − K)
        reach = min(float_above(abs(value_at(weights, [0.0, *u])) / (1 - K)), sys.float_info.max)
        found["equilibria_outside"] = [_findings(each) for each in equilibria(weights, u, -reach, reach)]
    if m == 4:
        at_rest = sweep(weights, surge_inputs(HEADINGS), *AT_REST)
        every = [each for places in at_rest for each in places]
        found["at_rest"] = {
            "headings": len(at_rest),
            "equilibria": [min(map(len, at_rest)), max(map(len, at_rest))],
            "x": [float(f(each.x for each in every)) for f in (min, max)] if every else [],
            "classes": sorted({each.kind for each in every}),
        }
    if solve is not None:
        found["lmi"] = solve(weights)
    if box is not None:
        found["box"] = search_box(weights, box, seconds)
    return found


def time_constant(K: Fraction) -> float | None:
    """−1/ln K; None where K ≥ 1, or so near to 1 that no float holds it.

    >>> time_constant(Fraction(1, 2)) == 1 / math.log(2), time_constant(1 - Fraction(1, 2**1113))
    (True, None)
    """
    room = float(1 - K) if K < 1 else 0.0
    if not room:
        return None
    if float(K) == 0:
        return 0.0
    return _number(-1 / (math.log(float(K)) if K < 0.5 else math.log1p(-room)))


def _findings(equilibrium) -> dict[str, Any]:
    """A point, or an interval: {"x": 0.3, …} or {"x": 0.3, "interval": [0.2, 0.4], …}."""
    found = {"x": float(equilibrium.x), "class": equilibrium.kind}
    if equilibrium.lo != equilibrium.hi:
        found["interval"] = [float(equilibrium.lo), float(equilibrium.hi)]
    return {**found, "slopes": [float(equilibrium.slope_left), float(equilibrium.slope_right)]}


def search_box(weights: ShallowWeights, box: Box, seconds: float = 10.0) -> dict[str, Any]:
    """The bracket of the exact rate on a box, and the verdict on rate < 1, with the trees that prove it."""
    from certify.proofs.certificate import provable_rate
    from certify.search import box as search

    bracket = search.rate(weights, box, seconds=seconds / 2)
    asked = [Fraction(1)]
    if (short := provable_rate(1.001 * bracket.upper)) is not None and short < 1:
        asked.insert(0, short)
    for kappa in asked:
        found = search.certify(weights, box, float(kappa), seconds / 2)
        if found.verdict == "certified" or kappa == 1:
            break
    return {
        "verdict": found.verdict,
        "bracket": [bracket.lower, min(bracket.upper, found.upper)],
        "closed": bracket.closed,
        "interval": "certified" if proves(weights, box, ".", 1) else "not certified",
        "proved_rate": found.rate if found.verdict == "certified" else None,
        "forward_invariant": found.invariant,
        "witness": _point(found.witness or bracket.witness),
        "escape": None if found.escape is None else list(map(float, found.escape)),
        "intervals": [[float(lo), float(hi)] for lo, hi in zip(box.lo, box.hi, strict=True)],
        "tree": found.tree,
        "invariance_tree": found.invariance_tree,
    }


def _point(witness) -> dict[str, Any] | None:
    if witness is None:
        return None
    return {"x": float(witness.x), "u": list(map(float, witness.u)), "slope": float(witness.slope)}


def solver(name: str = "CLARABEL") -> Callable[[ShallowWeights], dict[str, Any]]:
    """A function that solves both matrices' LMI for a network; problems are compiled once per size."""
    from certify.search.lmi import LMI

    problems: dict[tuple[int, str], LMI] = {}

    def solve(weights: ShallowWeights) -> dict[str, Any]:
        found = {}
        for condition in ("lmi", "tight"):
            key = len(weights.a), condition
            if key not in problems:
                problems[key] = LMI(*key, solver=name)
            try:
                solution = problems[key].solve(weights.a, weights.w1)
                rate, _ = problems[key].smallest_rate(weights.a, weights.w1)
            except CertifyError as error:  # weights that no float solver can take
                nothing = {"margin": None, "rate": None, "metric": None, "status": str(error), "seconds": 0.0}
                found[condition] = {"verdict": "unknown", **nothing}
                continue
            found[condition] = {
                "verdict": solution.verdict,
                "margin": _number(solution.margin),
                "rate": _number(rate),
                "metric": _number(solution.metric),
                "status": solution.status,
                "seconds": solution.seconds,
            }
        return {"solver": name, **found}

    return solve


def _number(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None
