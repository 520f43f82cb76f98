"""The time of each condition, proof, projection and solution, by the number of neurons.

python benchmarks/verdicts.py        writes docs/benchmarks/verdicts.md
"""

import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from families import initial_networks, random_networks
from pages import publish
from torch import Tensor

from certify.networks.shallow import ShallowWeights
from certify.proofs import exact
from certify.proofs.equilibria import equilibria
from certify.search import box
from certify.search.lmi import LMI
from certify.training import conditions
from certify.training.projections import project

ROOT = Path(__file__).parents[1]


def seconds(work: Callable[[], object], times: int = 30) -> float:
    """Median time of a call."""
    found = []
    for _ in range(times):
        began = time.perf_counter()
        work()
        found.append(time.perf_counter() - began)
    return statistics.median(found)


def retract(weights: ShallowWeights, rate: float) -> ShallowWeights:
    """The weights with `a` of each sign class scaled down until K ≤ rate."""
    up, down = (rate / extreme.clamp(min=rate)[..., None] for extreme in conditions.extreme_slopes(*weights[:2]))
    return weights._replace(a=weights.a * torch.where(weights.a * weights.w1 > 0, up, down))


def project_jointly(weights: ShallowWeights, rate: float) -> ShallowWeights:
    """The weights with the nearest (a, w₁) for which K ≤ rate, up to rounding."""
    a, w1 = weights.a, weights.w1
    positive, radius = a * w1 > 0, torch.as_tensor(rate, dtype=a.dtype).expand(a.shape[:-1])
    one = _nearest_product(*(torch.where(positive, x.abs(), 0.0) for x in (a, w1)), radius)
    other = _nearest_product(*(torch.where(positive, 0.0, x.abs()) for x in (a, w1)), radius)
    new_a, new_w = (torch.where(positive, x, y) for x, y in zip(one, other, strict=True))
    return retract(weights._replace(a=a.sign() * new_a, w1=w1.sign() * new_w), rate)


def _nearest_product(x: Tensor, y: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest sizes x, y ≥ 0, `(*batch, n)`, with Σ x y ≤ radius, `(*batch,)`.

    With h ≥ l the larger and the smaller of each pair,

        h + l ← (h + l)/(1 + θ),  h − l ← (h − l)/(1 − θ);  l ← 0 where it would be < 0;  Σ h l = r,  θ ∈ [0, 1]

    is the global minimum although the set is not convex, since the Lagrangian is convex for these θ. τ = 1 − θ is found
    by bisection.
    """
    total, gap, radius = x + y, (x - y).abs(), radius[..., None]

    def moved(tau: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        sums, gaps = total / (2 - tau), gap / tau
        return sums, gaps, gaps < sums

    def product(tau: Tensor) -> tuple[Tensor, Tensor]:  # Σ h l and its derivative by τ
        sums, gaps, kept = moved(tau)
        each = torch.where(kept, (sums - gaps) * (sums + gaps) / 4, 0.0)
        slope = torch.where(kept, (sums * sums / (2 - tau) + gaps * gaps / tau) / 2, 0.0)
        return each.sum(-1, keepdim=True), slope.sum(-1, keepdim=True)

    with torch.no_grad():
        low = torch.full_like(radius, torch.finfo(x.dtype).tiny ** 0.5).log()
        high = torch.zeros_like(low)
        for _ in range(80):
            middle = (low + high) / 2
            over = product(middle.exp())[0] > radius
            low, high = torch.where(over, low, middle), torch.where(over, middle, high)
        inside = (x * y).sum(-1, keepdim=True) <= radius
        tau = torch.where(inside, 1.0, low.exp())
        split = product(low.exp())[0] > radius  # only where x_i = y_i are left: θ = 1, and x_i + y_i is what counts
    found, slope = product(tau)
    tau = torch.where(inside | split, tau, tau - (found - radius) / slope.clamp(min=torch.finfo(x.dtype).tiny).detach())
    sums, gaps, kept = moved(tau)
    parted, tiny = split & (gap == 0), torch.finfo(x.dtype).tiny
    share = 4 * radius / torch.where(gap == 0, total * total / 4, 0.0).sum(-1, keepdim=True).clamp(min=radius * 4)
    gaps = torch.where(parted, total / 2 * (1 - share).clamp(min=tiny).sqrt(), gaps)
    moves = (kept | parted) & ~inside
    larger = torch.where(moves, (sums + gaps) / 2, x.maximum(y))
    smaller = torch.where(moves, (sums - gaps) / 2, torch.where(inside, x.minimum(y), 0.0))
    return torch.where(x >= y, larger, smaller), torch.where(x >= y, smaller, larger)


def tensors(weights: ShallowWeights) -> ShallowWeights:
    return ShallowWeights(*map(torch.tensor, weights))


def closed_forms() -> list[str]:
    generator = torch.Generator().manual_seed(0)
    many = torch.randn(2, 10_000, 20, generator=generator, dtype=torch.float64) / 5
    large = torch.randn(2, 500, generator=generator, dtype=torch.float64) / 25
    dispatch = seconds(lambda: large[0] * large[1], 500)
    lines = ["| condition | 10,000 networks, n = 20, ms | one, n = 500, µs | operations' worth of dispatch |",
             "|---|---:|---:|---:|"]  # fmt: skip
    every = {**conditions.CONDITIONS, **{f"{name}, best gauge": each for name, each in conditions.BEST_GAUGE.items()}}
    for name, each in every.items():
        batch, one = seconds(partial(each, *many)), seconds(partial(each, *large), 300)
        lines.append(f"| {name} | {1e3 * batch:.2f} | {1e6 * one:.1f} | {one / dispatch:.1f} |")
    return lines


def per_network(rng: np.random.Generator) -> list[str]:
    columns: dict[int, dict[str, float]] = {}
    for n in (20, 100, 500):
        weights = random_networks(1, n, rng)[0]
        K = float(exact.conditions(weights.a, weights.w1)["tight"].rate)
        weights = weights._replace(a=weights.a * (0.9 / K))
        a, w1 = weights.a, weights.w1
        proof, elements = exact.multipliers("tight", a, w1), tensors(weights)
        row = {
            "closed form, torch": seconds(partial(conditions.rate, elements.a, elements.w1), 200),
            "exact K": seconds(partial(exact.extreme_slopes, a, w1)),
            "all four conditions, exactly": seconds(partial(exact.conditions, a, w1)),
            "p, Λ proved: LDLᵀ over fractions": seconds(partial(exact.proves, "tight", a, w1, proof), 5),
            "equilibria at one input": seconds(partial(equilibria, weights, np.zeros(4))),
            "project a onto tight": seconds(partial(project, elements, "tight", 0.5)),
            "project (a, w₁) onto tight": seconds(partial(project_jointly, elements, 0.5)),
            "retract": seconds(partial(retract, elements, 0.5)),
        }
        if n <= 100:
            problem = LMI(n, "tight")
            row["LMI, first solve"] = seconds(partial(problem.solve, a, w1), 1)
            row["LMI, solved again"] = seconds(partial(problem.solve, 0.99 * a, w1), 5)
            row["LMI, solved again / closed form"] = row["LMI, solved again"] / row["closed form, torch"]
        columns[n] = row
    lines = ["| one network | n = 20 | n = 100 | n = 500 |", "|---|---:|---:|---:|"]
    for name in columns[20]:
        cells = [row.get(name) for row in columns.values()]
        told = ["–" if x is None else f"{x:.2g} ×" if "/" in name else f"{1e3 * x:.3g} ms" for x in cells]
        lines.append(f"| {name} | {' | '.join(told)} |")
    return lines


def boxes(rng: np.random.Generator) -> list[str]:
    lines = [
        "| exact rate on the box, gap 1e-6 | median, ms | largest, ms | closed |",
        "|---|---:|---:|---:|",
    ]
    for n, count in ((20, 30), (50, 30), (100, 30)):
        found = [box.rate(weights, box.operating_box(4)) for weights in initial_networks(count, n, rng)]
        took = [1e3 * each.seconds for each in found]
        closed = sum(each.closed for each in found)
        lines.append(f"| n = {n}, m = 4 | {statistics.median(took):.1f} | {max(took):.0f} | {closed} of {count} |")
    return lines


def command(rng: np.random.Generator) -> list[str]:
    with tempfile.TemporaryDirectory() as folder:
        for k, weights in enumerate(random_networks(100, 20, rng)):
            np.savez(f"{folder}/{k:03d}.npz", **weights._asdict())
        call = [sys.executable, "-m", "certify", folder]
        whole = seconds(partial(subprocess.run, call, cwd=ROOT, stdout=subprocess.DEVNULL), 3)
        torch_alone = seconds(partial(subprocess.run, [sys.executable, "-c", "import torch"]), 3)
    told = f"`python -m certify` on 100 checkpoints, n = 20: {whole:.2f} s"
    return [f"{told}; `import torch`, which it does not need, alone: {torch_alone:.2f} s."]


def main() -> None:
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    parts = [closed_forms(), per_network(rng), boxes(rng), command(rng)]
    opening = ["# Time of contraction verdicts", "Median times, one thread."]
    publish(__file__, "\n\n".join([*opening, *("\n".join(part) for part in parts)]))


if __name__ == "__main__":
    main()
