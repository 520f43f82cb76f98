"""What each condition certifies, and what Gershgorin's lemma loses to the LMI: python -m certify compare.

Random, initialised and trained networks, and those of your runs: the loss of each condition against the exact rate, by
n and by signs; how many networks it certifies; which time constants; whether a solver agrees; how long each takes.
"""

from __future__ import annotations

import argparse
import json
import math
import shlex
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, cast

import numpy as np
import torch

from certify.analysis.assess import solver
from certify.analysis.comparison_counts import (
    GAUGED,
    conservatism,
    contingency,
    of_losses,
    summarise,
)
from certify.analysis.families import initial_networks, random_networks, signed_networks, trained_networks
from certify.analysis.paper_tests import CORNERS, KNOTS, ORDERS, Choices, at_rate, paper_tests
from certify.analysis.run_steps import given
from certify.display.printed import busy, progress
from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights
from certify.proofs import exact
from certify.proofs.box_proof import proves
from certify.proofs.gauge import loss
from certify.proofs.rounding import float_above
from certify.search import box as box_search
from certify.training import conditions

SHARES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)  # of the neurons with the rarer sign
INPUTS = (1, 2, 3, 4, 5, 6, 8)  # m, of the box search
SEARCHED = 5  # networks for each m
ROUNDS = 5  # in which the LMI and the closed form are timed in turn
DT = 0.4  # s, of the trained networks
USUAL = {"networks": 60, "neurons": 20, "sizes": "5,10,20,50,100,200,500", "largest": 100, "seconds": 2.0,
         "training": 3000}  # fmt: skip
QUICK = {"networks": 8, "neurons": 6, "sizes": "4,8", "largest": 8, "seconds": 0.2, "training": 500}  # of --quick


class Family(NamedTuple):
    """Networks that are compared with each other."""

    networks: Sequence[ShallowWeights]
    steps: Sequence[float | None]  # dt of each, s; None where the family has none
    drawn: bool  # independently, so that shares and medians have intervals


def examine(weights: ShallowWeights, solve: Callable | None, seconds: float, dt: float | None = None) -> dict[str, Any]:
    """Which conditions certify one network, the smallest rate at which each holds, what Gershgorin loses, the solver.

    Args:
        weights: of one network.
        solve: see `certify.analysis.assess.solver`; None: no LMI is solved.
        seconds: of each search on the box.
        dt: s, the step of its samples, if it has one.
    """
    found, best = exact.conditions(weights.a, weights.w1), exact.best_gauge(weights.a, weights.w1)
    box = box_search.operating_box(weights.W2.shape[-1])
    bracket = box_search.rate(weights, box, seconds=seconds)
    verdict = box_search.certify(weights, box, seconds=seconds).verdict
    interval = conditions.interval(*_tensors(weights, box))
    rates = {name: None if each.rate is None else float_above(each.rate) for name, each in found.items()}
    rates |= {GAUGED[name]: float_above(rate) for name, rate in best.items()}
    certified = {name: each.margin > 0 for name, each in found.items()}
    certified |= {GAUGED[name]: rate < 1 for name, rate in best.items()}
    row: dict[str, Any] = {
        "n": len(weights.a),
        "dt": dt,
        "K": rates["tight"],
        "K_box": [bracket.lower, bracket.upper],
        "closed": bracket.closed,
        "certified": {**certified, "interval": proves(weights, box, ".", 1), "box": verdict == "certified"},
        "rates": {**rates, "interval": float(interval.rate), "box": bracket.upper},
        "loss": _loss(weights),
    }
    if solve is not None:
        row["solved"] = {name: solved for name, solved in solve(weights).items() if name != "solver"}
    return row


def _loss(weights: ShallowWeights) -> dict[str, Any] | None:
    """`certify.proofs.gauge.loss` as JSON."""
    found = loss(weights.a, weights.w1)
    if found is None:
        return None
    numbers = {name: float(getattr(found, name)) for name in ("ratio", "simple", "rarer")}
    return {**numbers, "one_sign": found.ratio == 1, "false": list(found.false)}


def _tensors(weights: ShallowWeights, box) -> tuple[ShallowWeights, torch.Tensor, torch.Tensor]:
    return ShallowWeights(*map(torch.tensor, weights)), torch.tensor(box.lo), torch.tensor(box.hi)


def by_neurons(sizes: Sequence[int], count: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """The smallest rate of each condition over K, for random and initialised networks of several sizes."""
    rows = []
    for name, draw in (("initialised", initial_networks), ("random", random_networks)):
        for n in sizes:
            found = []
            for weights in draw(count, n, rng):
                rates = {key: each.rate for key, each in exact.conditions(weights.a, weights.w1).items()}
                rates |= {GAUGED[key]: rate for key, rate in exact.best_gauge(weights.a, weights.w1).items()}
                K = max(exact.extreme_slopes(weights.a, weights.w1))
                over = {key: math.inf if rate is None else float(rate / K) for key, rate in rates.items()}
                found.append({"over_K": over, "loss": _loss(weights)})
            rows.append({"family": name, "n": n, "networks": count, "tiers": conservatism(found), **of_losses(found)})
    return rows


def by_signs(sizes: Sequence[int], count: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """σ/K by the share of neurons whose s_i has the rarer sign, for networks of several sizes."""
    rows = []
    for n in sizes:
        for rarer in dict.fromkeys(round(share * n) for share in SHARES):
            found = [{"loss": _loss(weights)} for weights in signed_networks(count, n, rarer, rng)]
            rows.append({"n": n, "rarer": rarer / n, "networks": count, **of_losses(found)})
    return rows


def timing(n: int, solver_name: str, largest: int, rng: np.random.Generator) -> dict[str, Any]:
    """The time for a network of n neurons, s, the least of several calls: closed forms, exact arithmetic, LMI, box.

    `lmi_first` includes the compilation of the problem, `lmi_again` cvxpy's own work; `solver` is the solver's time
    alone, as it reports it. `ratio` is the median over rounds of the processor time of the LMI solved
    again over that of the closed form, in turn.
    """
    weights, calls = works(n, rng)
    row: dict[str, Any] = {"n": n, "lmi_first": None, "lmi_again": None, "solver": None, "ratio": None}
    searches: list[Any] = [calls["box"][0]() for _ in range(calls["box"][1])]
    row |= {name: _least(work, times) for name, (work, times) in calls.items() if name != "box"}
    row |= {"box": min(each.seconds for each in searches), "box_closed": all(each.closed for each in searches)}
    if n <= largest:
        from certify.search.lmi import LMI

        began = time.perf_counter()
        problem = LMI(n, "tight", solver=solver_name)
        problem.solve(weights.a, weights.w1)
        row["lmi_first"] = time.perf_counter() - began
        ratios, again = [], []
        own: list[Any] = []
        for _ in range(ROUNDS):
            solve = partial(problem.solve, 0.99 * weights.a, weights.w1)
            ratios.append(_least(solve, 1, time.process_time) / _least(*calls["closed_tight"], clock=time.process_time))
            again.append(_least(solve, 1))
            stats = problem.problem.solver_stats
            own.append(getattr(stats, "solve_time", None))
        row["lmi_again"] = min(again)
        row["solver"] = None if None in own else min(own)
        row["ratio"] = statistics.median(ratios)
    return row


def works(n: int, rng: np.random.Generator) -> tuple[ShallowWeights, dict[str, tuple[Callable[[], object], int]]]:
    """A network of n neurons, and what is timed but for the LMI, with how often; `box` takes an initial network."""
    weights, initial = at_rate(random_networks(1, n, rng)[0], "tight", 0.9), initial_networks(1, n, rng)[0]
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


def _least(call: Callable, times: int, clock: Callable[[], float] = time.perf_counter) -> float:
    found = []
    for _ in range(times):
        began = clock()
        call()
        found.append(clock() - began)
    return min(found)


def box_timing(m: int, n: int, seconds: float, rng: np.random.Generator) -> dict[str, Any]:
    """The time of the exact rate on the box of x in [0, 1] and m inputs in [−1, 1], s, and how often it was found."""
    box = box_search.box([(0.0, 1.0), *[(-1.0, 1.0)] * m], m)
    found = [box_search.rate(w, box, seconds=seconds) for w in initial_networks(SEARCHED, n, rng, m)]
    gaps = [each.upper / each.lower - 1 for each in found if each.lower > 0]
    return {
        "m": m,
        "n": n,
        "seconds": [each.seconds for each in found],
        "closed": sum(each.closed for each in found),
        "widest": max(gaps, default=None),
    }


def study(options: argparse.Namespace) -> dict[str, Any]:
    """The whole comparison, as JSON."""
    torch.set_num_threads(1)
    rng, count, n = np.random.default_rng(options.seed), options.networks, options.neurons
    runs, dt = given(options.paths, options.dt, options.checkpoints), options.dt or DT
    with busy("training networks"):
        families = {
            "random": Family(random_networks(count, n, rng), [None] * count, True),
            "initialised": Family(initial_networks(count, n, rng), [None] * count, True),
            "trained": Family(trained_networks(count, n, rng, dt, options.training), [dt] * count, True),
        }
    for run in runs:
        families[f"run {run.name}"] = Family([each.weights for each in run.networks], run.steps, False)
    solve = None if options.no_lmi else solver(options.solver)
    largest = 0 if options.no_lmi else options.largest
    work = [
        (name, *each) for name, family in families.items() for each in zip(family.networks, family.steps, strict=True)
    ]
    examined: dict[str, list[dict[str, Any]]] = {name: [] for name in families}
    for name, weights, step in progress(work, "comparing"):
        solvable = solve if len(weights.a) <= max(largest, n) else None
        examined[name].append(examine(weights, solvable, options.seconds, step))
    found = {
        name: {
            "drawn": families[name].drawn,
            "networks": rows,
            "tiers": summarise(rows, families[name].drawn),
            "contingency": contingency(rows, families[name].drawn),
            **of_losses(rows, families[name].drawn),
        }
        for name, rows in examined.items()
    }
    with busy("comparing by neurons and by signs"):
        neurons, signs = by_neurons(options.sizes, count, rng), by_signs((n, 10 * n), count, rng)
    with busy("solving the tests of the paper"):
        paper = [] if options.no_lmi else paper_tests([weights for _, weights, _ in work], cast(Choices, options))
    return {
        "neurons": n,
        "dt": dt,
        "seed": options.seed,
        "seconds": options.seconds,
        "solver": None if options.no_lmi else options.solver,
        "notes": [note for run in runs for note in run.notes],
        "theorem": _theorem([*found.values(), *neurons, *signs]),
        "families": found,
        "by_neurons": neurons,
        "by_signs": signs,
        "timings": [timing(size, options.solver, largest, rng) for size in progress(options.sizes, "timing by n")],
        "box_times": [box_timing(m, n, options.seconds, rng) for m in progress(INPUTS, "timing by m")],
        "paper": paper,
    }


def _theorem(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """On how many networks the theorem was checked, and where its ratio lay."""
    known = [part["ratio"] for part in parts if part["ratio"] is not None]
    return {
        "networks": sum(part["with_slope"] for part in parts),
        "without_slope": sum(part["without_slope"] for part in parts),
        "false": sorted({name for part in parts for name in part["false"]}),
        "least": min((each["least"] for each in known), default=None),
        "greatest": max((each["greatest"] for each in known), default=None),
        "one_sign": sum(part["one_sign"] for part in parts),
    }


def main(arguments: Sequence[str], say: Callable) -> int:
    """The command; returns its exit code. `say` calls what writes to standard output."""
    options = parse(arguments)
    if options.plot is not None or options.page is not None:
        from certify.display.comparison_figures import check_drawing

        check_drawing(options.plot)
    if options.page is not None:
        from certify.display.comparison_page import check_folder

        check_folder(options.page)
    result = study(options)
    if options.json:
        say(print, json.dumps(result, indent=1, allow_nan=False))
    else:
        from certify.display.printed import show_comparison

        say(show_comparison, result)
    if options.plot is not None or options.page is not None:
        from certify.display.comparison_figures import pictures, save_all

        with busy("drawing"):
            drawn = pictures(result)
        if options.plot is not None:
            save_all(drawn, Path(options.plot))
        if options.page is not None:
            from certify.display.comparison_page import write

            command = f"python -m certify compare {shlex.join(arguments)}"
            page = write(Path(options.page), result, drawn, command)
            if not options.json:
                say(print, f"page: {page}")
    return 0


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """The options of the command; see `python -m certify compare --help`."""
    parser = argparse.ArgumentParser("python -m certify compare", description=__doc__)
    parser.add_argument("paths", nargs="*", metavar="PATH", help="folders of runs, or checkpoints: a family each")
    parser.add_argument("--page", metavar="FOLDER", help="write the result as a page: index.html, report.md, figures/")
    parser.add_argument("--networks", type=int, help="of each family, and of each size (default: 60)")
    parser.add_argument("--checkpoints", type=int, default=100, help="most checkpoints of a PATH (default: 100)")
    parser.add_argument("--neurons", type=int, help="of each network of a family (default: 20)")
    parser.add_argument(
        "--dt",
        type=float,
        help=f"s, step of the trained networks (default: {DT:g}) and of checkpoints whose run tells none",
    )
    parser.add_argument("--sizes", help="n that are compared and timed (default: 5,10,20,50,100,200,500)")
    parser.add_argument("--largest", type=int, help="n up to which the LMI is solved (default: 100)")
    parser.add_argument("--seconds", type=float, help="of each search on a box (default: 2)")
    parser.add_argument("--training", type=int, help="steps of Adam of the trained networks (default: 3000)")
    parser.add_argument("--quick", action="store_true", help="all, on few small networks: whether it runs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--solver", default="CLARABEL", help="a name that cvxpy knows (default: CLARABEL)")
    parser.add_argument("--no-lmi", action="store_true", help="closed forms, exact arithmetic and boxes alone")
    parser.add_argument("--order", choices=ORDERS, default="both", help="of the paper's matrix: M ⪰ 0 or M ≻ 0")
    parser.add_argument("--corner", choices=CORNERS, default="both", help="of the paper's matrix: Λ or 2Λ")
    parser.add_argument("--knots", choices=KNOTS, default="both", help="of equilibria: the paper's i < n, or all")
    parser.add_argument("--json", action="store_true", help="everything, on standard output")
    parser.add_argument("--plot", metavar="FILE", help="draw the pictures alone: FILE with the name of each in it")

    def refuse(message: str) -> NoReturn:
        raise CertifyError(f"{message}: see python -m certify compare --help")

    parser.error = refuse  # type: ignore[method-assign]  # argparse calls this method, and would end the program
    if any(each.partition("=")[0] == "--sets" for each in arguments):
        refuse("--sets: it is --checkpoints now")
    options = parser.parse_args(arguments)
    for name, value in (USUAL | (QUICK if options.quick else {})).items():
        if getattr(options, name) is None:
            setattr(options, name, value)
    if options.seed < 0:
        raise CertifyError(f"--seed: found {options.seed}, expected a whole number of 0 or more")
    for name in ("networks", "checkpoints", "neurons", "dt", "seconds", "training"):
        value = getattr(options, name)
        if value is not None and not 0 < value < math.inf:
            raise CertifyError(f"--{name}: found {value}, expected a number above 0")
    options.sizes = _sizes(options.sizes)
    return options


def _sizes(text: str) -> list[int]:
    try:
        found = [int(part) for part in text.split(",")]
    except ValueError:
        found = [0]
    if min(found) < 1:
        raise CertifyError(f"--sizes: found {text!r}, expected whole numbers above 0, parted by commas")
    return list(dict.fromkeys(found))
