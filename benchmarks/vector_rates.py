"""The smallest rate of networks with a vector state in several norms, and the time to find it.

python benchmarks/vector_rates.py [--quick]        writes docs/benchmarks/vector_rates.md

Of each network, x⁺ = R x + A relu(W x + W₂ u + b): K_∞ is exact; so is the smaller of K_∞ and K_1 in the best diagonal
and the best full scaling found. The matrix inequality gives a rate in a quadratic norm, proved in fractions. Rates are
medians over networks, as ratios to K_∞; times are medians in seconds. *Random*: R = 0, Gaussian A and W. *Slow*: R near
0.9 I, small A, and a state whose components have different units, like the speeds of a boat at short steps.
"""

import argparse
import itertools
import math
import statistics
import time
from collections.abc import Iterator

import numpy as np
from pages import publish

from certify.networks.vector import RELU, VectorWeights, check
from certify.proofs.vector_exact import everywhere, rate
from certify.search.vector_lmi import smallest_rate
from certify.search.vector_scaling import best_scaling

STATES, NEURONS, SEEDS = (1, 2, 3, 6), (5, 20, 50, 100), 3
TIERS = ("K_∞", "diagonal", "full", "LMI")


def draw(family: str, q: int, n: int, seed: int) -> VectorWeights:
    """One network with one hidden layer."""
    generator = np.random.default_rng([seed, q, n])
    R, A = np.zeros((q, q)), generator.standard_normal((q, n)) / math.sqrt(n)
    W = generator.standard_normal((n, q)) / math.sqrt(q)
    if family == "slow":
        units = 10 ** generator.uniform(-0.5, 0.5, q)
        R, A = 0.9 * np.eye(q) + 0.05 * generator.standard_normal((q, q)) / math.sqrt(q), 0.1 * A
        R, A, W = units[:, None] * R / units, units[:, None] * A, W / units
    return check(VectorWeights(R, A, W, np.zeros((n, 0)), np.zeros(n)))


def judge(weights: VectorWeights) -> tuple[dict[str, float], dict[str, float], str]:
    """The rate and the time of each tier, and the verdict of the inequality."""
    slopes, rates, times = everywhere(weights, RELU), {}, {}

    def timed(name, work):
        start = time.perf_counter()
        found = work()
        times[name] = time.perf_counter() - start
        return found

    rates["K_∞"] = float(timed("K_∞", lambda: rate(weights, slopes)))
    rates["diagonal"] = float(timed("diagonal", lambda: best_scaling(weights, RELU, full=False)).rate)
    found = timed("LMI", lambda: smallest_rate(weights, RELU))
    rates["LMI"] = float(found.kappa) if found.kappa is not None else math.nan
    metric = found.proof.metric if found.proof else None
    rates["full"] = float(timed("full", lambda: best_scaling(weights, RELU, metric=metric)).rate)
    return rates, times, found.verdict


def ladder(states, neurons, seeds) -> Iterator[str]:
    yield (
        "| networks | q | n | diagonal T / K_∞ | full T / K_∞ | LMI / K_∞ | proved | "
        + " | ".join(f"{name}, s" for name in ("K_∞", "diagonal T", "full T", "LMI"))
        + " |"
    )
    yield "|---|" + "---:|" * 10
    for family, q, n in itertools.product(("random", "slow"), states, neurons):
        found = [judge(draw(family, q, n, seed)) for seed in range(seeds)]
        ratios = [statistics.median(rates[name] / rates["K_∞"] for rates, _, _ in found) for name in TIERS]
        times = [statistics.median(each[name] for _, each, _ in found) for name in TIERS]
        proved = sum(verdict == "certified" for *_, verdict in found)
        cells = [family, q, n, *(f"{x:.3f}" for x in (ratios[1], ratios[2], ratios[3])), f"{proved} of {seeds}"]
        line = "| " + " | ".join(map(str, [*cells, *(f"{x:.2g}" for x in times)])) + " |"
        print(line, flush=True)
        yield line


def patterns(weights: VectorWeights) -> Iterator[np.ndarray]:
    """R + A D₁ V D₀ W for every D₀ and D₁."""
    n, last = len(weights.b), len(weights.c)
    first = [np.array(d)[:, None] * weights.W for d in itertools.product((0.0, 1.0), repeat=n)]
    second = [weights.A * np.array(d) @ weights.V for d in itertools.product((0.0, 1.0), repeat=last)]
    for X, Y in itertools.product(second, first):
        yield weights.R + X @ Y


def two_layers(states, n: int, seeds: int) -> Iterator[str]:
    yield "| q | n + n | interval bound / enumeration, ∞-norm | LMI / enumeration, norm of P | LMI / interval bound |"
    yield "|---:|---:|---:|---:|---:|"
    for q in states:
        rows = []
        for seed in range(seeds):
            generator = np.random.default_rng([seed, q, n, 2])
            A, V, W = (generator.standard_normal(shape) for shape in ((q, n), (n, n), (n, q)))
            zero = np.zeros(n)
            weights = check(VectorWeights(None, A, W, np.zeros((n, 0)), zero, V, zero))
            bound = float(rate(weights, everywhere(weights, RELU)))
            found = smallest_rate(weights, RELU)
            slopes = np.array(list(patterns(weights)))
            most = np.abs(slopes).sum(-1).max()
            if found.proof is None:
                continue
            root = np.linalg.cholesky(np.array(found.proof.metric, dtype=float)).T
            inside = np.linalg.norm(root @ slopes @ np.linalg.inv(root), 2, axis=(-2, -1)).max()
            rows.append((bound / most, float(found.kappa) / inside, float(found.kappa) / bound))
        medians = [statistics.median(column) for column in zip(*rows, strict=True)]
        yield f"| {q} | {n} + {n} | " + " | ".join(f"{x:.3f}" for x in medians) + " |"
        print(q, medians, len(rows), flush=True)


def corner(states, n: int, seeds: int) -> tuple[float, float]:
    """The least and the greatest ratio of the smallest rates with the paper's Λ and with 2Λ, where R = 0."""
    found = []
    for q, seed in itertools.product(states, range(seeds)):
        weights = draw("random", q, n, seed)
        found.append(smallest_rate(weights, RELU, most=2).rate / smallest_rate(weights, RELU).rate)
    return min(found), max(found)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="few small networks, and no page")
    quick = parser.parse_args().quick
    states, neurons, seeds = ((1, 3), (5, 20), 2) if quick else (STATES, NEURONS, SEEDS)
    half = corner(states, 10, seeds)
    lines = [
        "# Rates of networks with a vector state in several norms",
        "",
        *__doc__.strip().splitlines()[4:],
        "",
        *ladder(states, neurons, seeds),
        "",
        "K_∞ is the exact evaluation in fractions. The time of full T is that of all starts in both norms, with the P "
        "of the inequality as one of them; it ends after 10 s. One thread, beside other work, so that "
        "times compare within a row only.",
        "",
        "## Two hidden layers",
        "",
        f"Medians over {4 if quick else 20} Gaussian networks each. Enumeration takes the largest norm over all "
        "patterns of both layers, in the norm of the bound beside it.",
        "",
        *two_layers(states, 4 if quick else 5, 4 if quick else 20),
        "",
        "## The paper's Λ",
        "",
        f"With Λ in place of 2Λ the smallest rate of {seeds * len(states)} random networks with R = 0 is "
        f"{half[0]:.6f} to {half[1]:.6f} times that with 2Λ: slopes in [0, 2] are twice those in [0, 1], so that every "
        "A D W doubles, and its norm with it.",
    ]
    if quick:
        print("\n".join(lines))
    else:
        publish(__file__, lines)


if __name__ == "__main__":
    main()
