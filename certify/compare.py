"""The conditions against the full LMI, and both against the exact rate on a box: python -m certify compare.

How often each certifies random, initialised and trained networks; how much slower than the exact rate it makes them
look; the time constants that it allows; whether the solver agrees with the closed form; and how long each takes.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch

from certify import box as box_search
from certify import conditions, exact
from certify.assess import solver
from certify.box_proof import proves
from certify.certificate import CONDITIONS
from certify.equilibria import equilibria
from certify.errors import CertifyError
from certify.families import initial_networks, random_networks, trained_networks
from certify.printed import progress
from certify.weights import ShallowWeights, find, load

CORNERS = {"lambda": ("lmi",), "2lambda": ("tight",), "both": ("lmi", "tight")}
ORDERS = {"nonstrict": (False,), "strict": (True,), "both": (False, True)}
KNOTS = {"paper": ("paper",), "all": ("all",), "both": ("paper", "all")}


def examine(weights: ShallowWeights, solve: Callable | None, seconds: float) -> dict[str, Any]:
    """Which conditions certify one network, the rate at which each holds, and the answer of the solver."""
    found = exact.conditions(weights.a, weights.w1)
    box = box_search.operating_box(weights.W2.shape[-1])
    bracket = box_search.rate(weights, box, seconds=seconds)
    verdict = box_search.certify(weights, box, seconds=seconds).verdict
    interval = conditions.interval(*_tensors(weights, box))
    rates = {name: None if each.rate is None else float(each.rate) for name, each in found.items()}
    row: dict[str, Any] = {
        "K": rates["tight"],
        "K_box": [bracket.lower, bracket.upper],
        "closed": bracket.closed,
        "certified": {name: each.margin > 0 for name, each in found.items()},
        "rates": {**rates, "interval": float(interval.rate), "box": bracket.upper},
    }
    row["certified"] |= {"interval": proves(weights, box, ".", 1), "box": verdict == "certified"}
    if solve is not None:
        row["solved"] = {name: solved for name, solved in solve(weights).items() if name != "solver"}
    return row


def _tensors(weights: ShallowWeights, box) -> tuple[ShallowWeights, torch.Tensor, torch.Tensor]:
    return ShallowWeights(*map(torch.tensor, weights)), torch.tensor(box.lo), torch.tensor(box.hi)


def summarise(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, float | None]]:
    """Per tier: share certified, median of rate/K_box, largest K certified, agreement with the solver."""
    summary: dict[str, dict[str, float | None]] = {}
    for tier in CONDITIONS:
        ratios = [
            math.inf if row["rates"][tier] is None else row["rates"][tier] / row["K_box"][1]
            for row in rows
            if row["K_box"][1] > 0
        ]
        middle = float(np.median(ratios)) if ratios else math.inf
        held = [row["K"] for row in rows if row["certified"][tier]]
        summary[tier] = {
            "share": len(held) / len(rows),
            "conservatism": middle if math.isfinite(middle) else None,
            "largest_K": max(held, default=None),
            "disagreements": None,
        }
        solved = [(row["solved"][tier]["verdict"] == "certified", row) for row in rows if tier in row.get("solved", {})]
        if solved:
            summary[tier]["disagreements"] = sum(said != row["certified"][tier] for said, row in solved)
    return summary


def timing(n: int, solver_name: str, largest: int, rng: np.random.Generator) -> dict[str, Any]:
    """The time for a network of n neurons, s, the least of several calls: closed forms, exact arithmetic, LMI, box."""
    weights, calls = works(n, rng)
    row: dict[str, Any] = {"n": n, "lmi_first": None, "lmi_again": None}
    row |= {name: _least(work, times) for name, (work, times) in calls.items()}
    if n <= largest:
        from certify.lmi import LMI

        began = time.perf_counter()
        problem = LMI(n, "tight", solver=solver_name)
        problem.solve(weights.a, weights.w1)
        row["lmi_first"] = time.perf_counter() - began
        row["lmi_again"] = _least(partial(problem.solve, 0.99 * weights.a, weights.w1), 3)
    return row


def works(n: int, rng: np.random.Generator) -> tuple[ShallowWeights, dict[str, tuple[Callable[[], object], int]]]:
    """A network of n neurons, and what is timed but for the LMI, with how often; `box` takes an initial network."""
    weights, initial = _at_rate(random_networks(1, n, rng)[0], "tight", 0.9), initial_networks(1, n, rng)[0]
    a, w1 = torch.tensor(weights.a), torch.tensor(weights.w1)
    return weights, {
        **{f"closed_{name}": (partial(each, a, w1), 50) for name, each in conditions.CONDITIONS.items()},
        "exact_rate": (partial(exact.extreme_slopes, weights.a, weights.w1), 5),
        "proof": (partial(_prove, weights), 2),
        "box": (partial(box_search.rate, initial, box_search.operating_box(4)), 2),
    }


def _prove(weights: ShallowWeights) -> bool:
    found = exact.multipliers("tight", weights.a, weights.w1)
    return found is not None and exact.proves("tight", weights.a, weights.w1, found)


def _least(call: Callable, times: int) -> float:
    found = []
    for _ in range(times):
        began = time.perf_counter()
        call()
        found.append(time.perf_counter() - began)
    return min(found)


def paper_tests(networks: Sequence[ShallowWeights], choices: argparse.Namespace) -> list[dict[str, Any]]:
    """The paper's tests literally, and corrected: M ⪰ 0 or M ≻ 0, Λ or 2Λ in the corner, knots i < n or all.

    The matrix is tested with networks just beyond each condition's edge, where a solver errs, and with a = w₁ = 1,
    b = 0, which is the identity: K = 1, and every state is an equilibrium.
    """
    rows = []
    one, zero = np.ones(1), np.zeros(1)
    identity = ShallowWeights(one, one, np.zeros((1, 4)), zero)
    for condition in CORNERS[choices.corner]:
        scaled = [weights for weights in networks if np.any(weights.a * weights.w1)][:20]
        edge = [_at_rate(weights, condition, 1 + beyond) for weights in scaled for beyond in (1e-8, 1e-7, 1e-6)]
        inside = [_at_rate(weights, condition, 0.999) for weights in scaled]
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


def _at_rate(weights: ShallowWeights, condition: str, rate: float) -> ShallowWeights:
    found = exact.conditions(weights.a, weights.w1)[condition].rate
    assert found is not None  # lmi and tight hold at some rate
    return weights._replace(a=weights.a * (rate / float(found)))


def _says(condition: str, strict: bool, solver_name: str) -> Callable[[ShallowWeights], bool]:
    """Whether the test passes: solved with a margin and proved (≻), or the solver's answer for plain M ⪰ 0."""
    from certify.lmi import LMI

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


def study(options: argparse.Namespace, given: Sequence[ShallowWeights] = ()) -> dict[str, Any]:
    """The whole comparison, as JSON."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(options.seed)
    families = {
        "random": random_networks(options.networks, options.neurons, rng),
        "initialised": initial_networks(options.networks, options.neurons, rng),
        f"trained, dt {options.dt:g} s": trained_networks(options.networks, options.neurons, rng, options.dt),
        **({"given": list(given)} if given else {}),
    }
    solve = None if options.no_lmi else solver(options.solver)
    work = [(name, weights) for name, networks in families.items() for weights in networks]
    rows = [(name, examine(weights, solve, options.seconds)) for name, weights in progress(work, "comparing")]
    examined = {name: [row for other, row in rows if other == name] for name in families}
    largest = 0 if options.no_lmi else options.largest
    return {
        "neurons": options.neurons,
        "dt": options.dt,
        "seed": options.seed,
        "families": {name: {"networks": some, "tiers": summarise(some)} for name, some in examined.items()},
        "timings": [timing(n, options.solver, largest, rng) for n in options.sizes],
        "paper": [] if options.no_lmi else paper_tests([w for _, w in work], options),
    }


def main(arguments: Sequence[str], say: Callable) -> int:
    """The command; returns its exit code. `say` calls what writes to standard output."""
    options = _parse(arguments)
    given = [network.weights for path in find(options.paths) for network in load(path)]
    result = study(options, given)
    if options.json:
        say(print, json.dumps(result, indent=1, allow_nan=False))
    else:
        from certify.printed import show_comparison

        say(show_comparison, result)
    if options.plot:
        from certify.figures import comparison_figure, save

        save(comparison_figure(result), options.plot)
    return 0


def _parse(arguments: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser("python -m certify compare", description=__doc__)
    parser.add_argument(
        "paths", nargs="*", metavar="PATH", help="parameter sets of your own, a family beside the others"
    )
    parser.add_argument("--networks", type=int, default=60, help="of each family (default: 60)")
    parser.add_argument("--neurons", type=int, default=20, help="of each network (default: 20)")
    parser.add_argument("--dt", type=float, default=0.4, help="s, step of the trained networks (default: 0.4)")
    parser.add_argument("--sizes", default="10,20,50,100,200,500", help="n to time, parted by commas")
    parser.add_argument("--largest", type=int, default=100, help="n up to which the LMI is timed (default: 100)")
    parser.add_argument("--seconds", type=float, default=2.0, help="of each search on a box (default: 2)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--solver", default="CLARABEL", help="a name that cvxpy knows (default: CLARABEL)")
    parser.add_argument("--no-lmi", action="store_true", help="closed forms, exact arithmetic and boxes alone")
    parser.add_argument("--order", choices=ORDERS, default="both", help="of the paper's matrix: M ⪰ 0 or M ≻ 0")
    parser.add_argument("--corner", choices=CORNERS, default="both", help="of the paper's matrix: Λ or 2Λ")
    parser.add_argument("--knots", choices=KNOTS, default="both", help="of equilibria: the paper's i < n, or all")
    parser.add_argument("--json", action="store_true", help="everything, on standard output")
    parser.add_argument("--plot", metavar="FILE", help="draw the comparison")
    options = parser.parse_args(arguments)
    if options.seed < 0:
        raise CertifyError(f"--seed: found {options.seed}, expected a whole number of 0 or more")
    for name in ("networks", "neurons", "dt", "seconds"):
        if not 0 < getattr(options, name) < math.inf:
            raise CertifyError(f"--{name}: found {getattr(options, name)}, expected a number above 0")
    options.sizes = _sizes(options.sizes)
    return options


def _sizes(text: str) -> list[int]:
    try:
        found = [int(part) for part in text.split(",")]
    except ValueError:
        found = [0]
    if min(found) < 1:
        raise CertifyError(f"--sizes: found {text!r}, expected whole numbers above 0, parted by commas")
    return found
