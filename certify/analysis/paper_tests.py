"""The paper's tests, literally and corrected: its matrix, and its set of critical values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from certify.networks.shallow import ShallowWeights
from certify.proofs import exact
from certify.proofs.equilibria import equilibria

CORNERS = {"lambda": ("lmi",), "2lambda": ("tight",), "both": ("lmi", "tight")}
ORDERS = {"nonstrict": (False,), "strict": (True,), "both": (False, True)}
KNOTS = {"paper": ("paper",), "all": ("all",), "both": ("paper", "all")}


class Choices(Protocol):
    """Which of the tests are made."""

    corner: str  # a key of CORNERS
    order: str  # of ORDERS
    knots: str  # of KNOTS
    solver: str  # a name that cvxpy knows


def paper_tests(networks: Sequence[ShallowWeights], choices: Choices) -> list[dict[str, Any]]:
    """The paper's tests literally, and corrected: M ⪰ 0 or M ≻ 0, Λ or 2Λ in the corner, knots i < n or all.

    The matrix is tested with networks just beyond each condition's edge, where a solver errs, and with a = w₁ = 1,
    b = 0, which is the identity: K = 1, and every state is an equilibrium.
    """
    rows = []
    one, zero = np.ones(1), np.zeros(1)
    identity = ShallowWeights(one, one, np.zeros((1, 4)), zero)
    for condition in CORNERS[choices.corner]:
        scaled = [weights for weights in networks if np.any(weights.a * weights.w1)][:20]
        edge = [at_rate(weights, condition, 1 + beyond) for weights in scaled for beyond in (1e-8, 1e-7, 1e-6)]
        inside = [at_rate(weights, condition, 0.999) for weights in scaled]
        for strict in ORDERS[choices.order]:
            says = _says(condition, strict, choices.solver)
            rows.append({
                "test": f"M {'≻' if strict else '⪰'} 0, {'Λ' if condition == 'lmi' else '2Λ'}",
                "inside": [sum(map(says, inside)), len(inside)],
                "beyond": [sum(map(says, edge)), len(edge)],
                "identity": says(identity),
                "contracting": sum(exact.conditions(w.a, w.w1)["tight"].margin > 0 for w in edge),
            })  # fmt: skip
    every = [[each.x for each in equilibria(w, np.zeros(w.W2.shape[-1]))] for w in networks]
    for knots in KNOTS[choices.knots]:
        found = every if knots == "all" else [truncated_equilibria(w) for w in networks]
        wrong = sum(len(x) != len(y) or not np.allclose(x, y, atol=1e-9) for x, y in zip(found, every, strict=True))
        name = "all knots" if knots == "all" else "knots i < n"
        rows.append({"test": f"equilibria at u = 0, {name}", "wrong": [wrong, len(networks)]})
    return rows


def at_rate(weights: ShallowWeights, condition: str, rate: float) -> ShallowWeights:
    """The network with `a` scaled until a condition's smallest rate is the given one, up to rounding."""
    found = exact.conditions(weights.a, weights.w1)[condition].rate
    assert found is not None  # lmi and tight hold at some rate
    return weights._replace(a=weights.a * (rate / float(found)))


def _says(condition: str, strict: bool, solver_name: str) -> Callable[[ShallowWeights], bool]:
    """Whether the test passes: solved with a margin and proved (≻), or the solver's answer for plain M ⪰ 0."""
    from certify.search.lmi import LMI

    problems: dict[int, LMI] = {}

    def says(weights: ShallowWeights) -> bool:
        n = len(weights.a)
        if n not in problems:
            problems[n] = LMI(n, condition, solver=solver_name, strict=strict)
        return problems[n].solve(weights.a, weights.w1).verdict in ("certified", "feasible")

    return says


def truncated_equilibria(weights: ShallowWeights) -> list[float]:
    """Equilibria as the paper's set S finds them, from the knots of the first n − 1 neurons alone, at u = 0.

    Between two of these critical values the map is assumed to be linear. It is not linear at the last neuron's knot.

    >>> tooth = ShallowWeights(np.array([2.0]), np.array([1.0]), np.zeros((1, 0)), np.array([-0.25]))
    >>> truncated_equilibria(tooth), [found.x for found in equilibria(tooth, [])]
    ([0.0], [0.0, 0.5])
    """
    a, w1, _, b = weights
    with np.errstate(divide="ignore", invalid="ignore"):
        knots = (-b / w1)[:-1]
    x = np.unique(np.concatenate([[0.0, 1.0], knots[(knots >= 0) & (knots <= 1)]]))
    gap = (np.maximum(w1 * x[:, None] + b, 0.0) @ a) - x
    found = [float(x[k]) for k in range(len(x)) if gap[k] == 0]
    crossed = [k for k in range(len(x) - 1) if gap[k] * gap[k + 1] < 0]
    return sorted(found + [float(x[k] + (x[k + 1] - x[k]) * gap[k] / (gap[k] - gap[k + 1])) for k in crossed])
