"""What each condition certifies, side by side: python -m certify compare.

The networks are the checkpoints of each PATH; without a PATH they are random ones, as torch initialises two layers.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

import numpy as np

from certify.analysis.assess import solved_both
from certify.display.figures import comparison_figure, save
from certify.display.tables import progress, show_comparison
from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights, find, load, matched
from certify.proofs import exact
from certify.proofs.rounding import float_above
from certify.search import box

CONDITIONS = (*exact.CORNER, "box")
RANDOM = "random"  # the name of networks that are no checkpoints


def random_networks(count: int, n: int, rng: np.random.Generator, inputs: int = 4) -> list[ShallowWeights]:
    """As torch.nn.Linear draws them: uniform within ±1/√(fan-in), the fan-in being 1 + m and n."""
    width = 1 / math.sqrt(1 + inputs)
    return [
        ShallowWeights(
            rng.uniform(-1, 1, n) / math.sqrt(n), *(rng.uniform(-width, width, size) for size in (n, (n, inputs), n))
        )
        for _ in range(count)
    ]


def examine(weights: ShallowWeights, seconds: float, solver: str | None = None) -> dict[str, Any]:
    """The smallest rate at which each condition holds, None where there is none, and whether it certifies the network.

    `seconds` are those of each search on the operating box. The solver is a name that cvxpy knows, or None.
    """
    conditions, inside = exact.conditions(weights.a, weights.w1), box.operating_box(weights.W2.shape[-1])
    bracket = box.rate(weights, inside, seconds=seconds)
    rates = {name: None if each.rate is None else float_above(each.rate) for name, each in conditions.items()}
    certified = {name: each.margin > 0 for name, each in conditions.items()}
    row: dict[str, Any] = {
        "n": len(weights.a),
        "rates": {**rates, "box": bracket.upper},
        "certified": {**certified, "box": box.certify(weights, inside, seconds=seconds).verdict == "certified"},
        "closed": bracket.closed,
    }
    if solver is not None:
        row["solved"] = {name: each["verdict"] for name, each in solved_both(weights, solver).items()}
    return row


def table(families: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """A row for each family and condition.

    Returns:
        networks, condition; certified, of; interval: of that share, 95 % (Wilson), of random networks; over_K: the
        median of the smallest rate over K, None where it is infinite; largest: the largest rate that is certified;
        disagreements: verdicts of the solver that are not those of the closed form, None without a solver.
    """
    from scipy.stats import binomtest

    lines = []
    for name, rows in families.items():
        for condition in CONDITIONS:
            held = [row for row in rows if row["certified"][condition]]
            ends = binomtest(len(held), len(rows)).proportion_ci(method="wilson") if name == RANDOM else None
            rates = [row["rates"] for row in rows if row["rates"]["exact"]]
            over = [math.inf if each[condition] is None else each[condition] / each["exact"] for each in rates]
            middle = statistics.median_low(over) if over else math.inf
            solved = [row for row in rows if condition in row.get("solved", {})]
            lines.append({
                "networks": name, "condition": condition, "certified": len(held), "of": len(rows),
                "interval": None if ends is None else [ends.low, ends.high],
                "over_K": middle if math.isfinite(middle) else None,
                "largest": max((row["rates"]["box" if condition == "box" else "exact"] for row in held), default=None),
                "disagreements": sum(
                    (row["solved"][condition] == "certified") != row["certified"][condition] for row in solved
                ) if solved else None,
            })  # fmt: skip
    return lines


def main(arguments: Sequence[str], say: Callable) -> int:
    """The command; returns its exit code. `say` calls what writes to standard output."""
    options = parse(arguments)
    import scipy.stats  # noqa: F401  # what is missing is told before the work

    drawn = random_networks(options.networks, options.neurons, np.random.default_rng(options.seed))
    networks = {str(path): [each.weights for file in find([path]) for each in load(file)]
                for path in matched(options.paths)} or {RANDOM: drawn}  # fmt: skip
    work = [(name, weights) for name, some in networks.items() for weights in some]
    families: dict[str, list[dict[str, Any]]] = {name: [] for name in networks}
    for name, weights in progress(work, "comparing"):
        families[name].append(examine(weights, options.seconds, options.solver if options.lmi else None))
    rows = table(families)
    if options.json:
        say(print, json.dumps(rows, indent=1, allow_nan=False))
    else:
        say(show_comparison, rows)
    if options.plot is not None:
        save(comparison_figure(families, CONDITIONS), options.plot)
    return 0


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """The options of the command; see `python -m certify compare --help`."""
    parser = argparse.ArgumentParser("python -m certify compare", description=__doc__)
    parser.add_argument("paths", nargs="*", metavar="PATH", help="folders of runs, or checkpoints: a part each")
    parser.add_argument("--networks", type=int, default=60, help="random ones, without PATH (default: 60)")
    parser.add_argument("--neurons", type=int, default=20, help="of each of them (default: 20)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each search on the box (default: 2)")
    parser.add_argument("--lmi", action="store_true", help="solve both matrix inequalities too (extra lmi)")
    parser.add_argument("--solver", default="CLARABEL", help="of --lmi, a name that cvxpy knows (default: CLARABEL)")
    parser.add_argument("--json", action="store_true", help="the table, on standard output")
    parser.add_argument("--plot", metavar="FILE", help="draw the smallest rates")

    def refuse(message: str) -> NoReturn:
        raise CertifyError(f"{message}: see python -m certify compare --help")

    parser.error = refuse  # type: ignore[method-assign]  # argparse calls this method, and would end the program
    options = parser.parse_args(arguments)
    for name in ("networks", "neurons", "seconds"):
        if not 0 < getattr(options, name) < math.inf:
            raise CertifyError(f"--{name}: found {getattr(options, name)}, expected a number above 0")
    if options.seed < 0:
        raise CertifyError(f"--seed: found {options.seed}, expected a whole number of 0 or more")
    return options
