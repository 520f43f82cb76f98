"""Draw the pictures of `docs/certification.md` from the functions of `certify`; needs the extra plot.

python docs/certification_figures.py
"""

from __future__ import annotations

import itertools
from fractions import Fraction
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from certify.display.figures import INK, PALE, TIER_COLOURS
from certify.networks.shallow import ShallowWeights
from certify.networks.vector import RELU, VectorWeights, check
from certify.proofs import vector_exact
from certify.proofs.box_planes import Box, slope_at
from certify.proofs.rational import matrix
from certify.training import conditions

FOLDER = Path(__file__).parent / "images"
RELU_COLOUR, OTHER, WARM = TIER_COLOURS["exact"], TIER_COLOURS["box"], TIER_COLOURS["gershgorin"]


def panes(count: int, height: float = 3.4, **options):
    figure = Figure(figsize=(4.1 * count, height), dpi=130, layout="constrained")
    axes = np.ravel(figure.subplots(1, count, **options))
    for each in axes:
        each.spines[["top", "right"]].set_visible(False)
        each.grid(color="#EEEEEE", linewidth=0.8)
        each.set_axisbelow(True)
    return figure, axes


def legend(figure, columns: int = 4) -> None:
    """One legend for all panes, below them."""
    known = {
        label: handle for each in figure.axes for handle, label in zip(*each.get_legend_handles_labels(), strict=True)
    }
    figure.legend(known.values(), known.keys(), ncols=columns, fontsize=8, frameon=False, loc="outside lower center")


def sectors():
    """The slopes that each matrix allows."""
    figure, axes = panes(3, sharey=True)
    z = np.linspace(-1, 1, 201)
    cases = (
        ("2Λ: slopes in [0, 1]", 0.0, 1.0, np.maximum(z, 0), "relu", RELU_COLOUR),
        ("Λ: slopes in [0, 2]", 0.0, 2.0, np.maximum(z, 0), "relu", RELU_COLOUR),
        ("leaky, α = 0.3: slopes in [0.3, 1]", 0.3, 1.0, np.maximum(z, 0.3 * z), "leaky relu", WARM),
    )
    for each, (title, least, most, y, name, colour) in zip(axes, cases, strict=True):
        low, high = np.minimum(least * z, most * z), np.maximum(least * z, most * z)
        each.fill_between(z, low, high, color=PALE, alpha=0.25, linewidth=0, label="increments that the matrix allows")
        each.plot(z, y, color=colour, linewidth=2, label=f"increments of {name} from 0")
        each.set(title=title, xlabel="Δz", ylim=(-1.1, 2.05), xticks=[-1, 0, 1])
        each.title.set_fontsize(10)
    axes[0].set_ylabel("Δy")
    legend(figure)
    return figure


def tiers():
    """Where each condition holds: in the plane of s₁, s₂, and for one neuron in the plane of a, w."""
    figure, (left, right) = panes(2, 4.4)
    s = torch.linspace(-1.25, 1.25, 801, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(s, s, indexing="xy"), -1)  # a w₁ of two neurons, as w₁ = 1
    one = torch.ones_like(grid)
    holds = {
        "exact": conditions.exact(grid, one), "lmi": conditions.lmi(grid, one),
        "gershgorin": conditions.gershgorin_best_gauge(grid, one), "simple": conditions.simple_best_gauge(grid, one),
    }  # fmt: skip
    a = torch.linspace(0.005, 3, 600, dtype=torch.float64)
    w = torch.linspace(0.005, 3, 600, dtype=torch.float64)
    aa, ww = (x[..., None] for x in torch.meshgrid(a, w, indexing="xy"))
    single = {name: conditions.CONDITIONS[name](aa, ww) for name in holds}
    for axes, regions, x, y in ((left, holds, s, s), (right, single, a, w)):
        for name, condition in regions.items():
            inside = (condition.margin > 0).numpy()
            axes.contourf(x, y, inside, levels=[0.5, 1.5], colors=[TIER_COLOURS[name]], alpha=0.75)
            axes.plot([], [], color=TIER_COLOURS[name], linewidth=6, alpha=0.75, label=name)
    left.set(
        xlabel="$s_1 = a_1 w_{11}$", ylabel="$s_2 = a_2 w_{12}$", aspect="equal", title="Two neurons, best rescaling"
    )
    right.set(xlabel="a", ylabel="$w_1$", aspect="equal", title="One neuron, weights as given")
    for axes in (left, right):
        axes.title.set_fontsize(10)
    legend(figure)
    return figure


def cells():
    """The planes of a network on a box of x and one input: its cells, coloured by the slope."""
    figure, (axes,) = panes(1, 4.2)
    figure.set_figwidth(6)
    net = ShallowWeights(
        np.array([0.7, -0.5, 0.6, -0.3]), np.array([1.0, 1.0, 0.75, -1.0]), np.array([[0.5], [-1.0], [1.0], [0.5]]),
        np.array([-0.25, 0.125, -0.5, 0.5]),
    )  # fmt: skip
    box = Box(np.array([0.0, -1.0]), np.ones(2))
    x, u = np.meshgrid(np.linspace(0, 1, 700), np.linspace(-1, 1, 700))
    z = net.w1 * x[..., None] + net.W2[:, 0] * u[..., None] + net.b
    slope = (z > 0) @ (net.a * net.w1)
    shown = axes.contourf(x, u, slope, levels=np.linspace(-1.6, 1.6, 17), cmap="PuOr_r")
    bar = figure.colorbar(shown, ax=axes, label="slope of x ↦ f(x, u)", ticks=[-1.5, -1, -0.5, 0, 0.5, 1, 1.5])
    bar.outline.set_visible(False)
    for i in range(len(net.a)):
        axes.contour(x, u, z[..., i], levels=[0], colors=INK, linewidths=1.2)
    k = np.unravel_index(np.abs(slope).argmax(), slope.shape)
    place = np.argwhere(np.abs(slope) == np.abs(slope[k])).mean(0).round().astype(int)
    point = [float(x[tuple(place)]), float(u[tuple(place)])]
    exact = slope_at(net, point)
    assert exact is not None  # no plane passes through the point
    axes.plot(*point, "*", color=WARM, markersize=15, markeredgecolor=INK)
    axes.annotate(
        f"witness: slope {float(exact):.4g}", point, (8, 8), textcoords="offset points", fontsize=9, color="white"
    )
    axes.set(xlabel="x", ylabel="u", xlim=(box.lo[0], box.hi[0]), ylim=(box.lo[1], box.hi[1]))
    return figure


def turning() -> VectorWeights:
    """Two states, three neurons: its rate in ‖x‖_∞ is 1, in a scaled norm below."""
    A = [[0.25, -0.5, 0.0], [0.0, 0.125, 0.25]]
    W = [[0.5, 1.0], [1.0, -0.5], [0.25, 0.5]]
    return check(VectorWeights([[0.5, 0.125], [0.0, 0.5]], A, W, np.zeros((3, 1)), np.zeros(3)))


def balls():
    """Unit balls of three norms, and their images by all activation patterns."""
    net = turning()
    slopes = vector_exact.everywhere(net, RELU)
    T = [[Fraction(1), Fraction(0)], [Fraction(0), Fraction(2)]]
    P = metric(net)
    P *= np.linalg.inv(P)[0, 0] / 1.6**2  # the same norm up to a factor, so that its ball is 1.6 wide
    root = np.linalg.cholesky(P).T
    plain, scaled = (float(vector_exact.rate(net, slopes, "inf", each)) for each in (None, T))
    cases = (
        (rf"$\|x\|_\infty$: K = {plain:.4g}", np.eye(2), np.inf),
        (rf"$\|T\,x\|_\infty$, T = diag(1, 2): K = {scaled:.4g}", np.diag([1.0, 2.0]), np.inf),
        (rf"$\sqrt{{x^T P\,x}}$: K = {largest(net, root):.4g}", root, 2),
    )
    figure, axes = panes(3, 3.6)
    turn = np.linspace(0, 2 * np.pi, 2881)
    plane = np.stack([np.cos(turn), np.sin(turn)], -1)
    for each, (title, scaling, order) in zip(axes, cases, strict=True):
        ball = plane / np.linalg.norm(plane @ scaling.T, order, axis=-1)[:, None]
        images = list(jacobians(net))
        for J in images:
            each.fill(*(ball @ J.T).T, facecolor=PALE, alpha=0.12)
            each.plot(*(ball @ J.T).T, color=PALE, linewidth=0.8)
        each.plot([], [], color=PALE, label=f"its images by the {len(images)} activation patterns")
        each.plot(ball[:, 0], ball[:, 1], color=RELU_COLOUR, linewidth=2, label="unit ball")
        each.set(title=title, xlabel="$x_1$", aspect="equal", xlim=(-1.65, 1.65), ylim=(-1.15, 1.15))
        each.title.set_fontsize(10)
    axes[0].set_ylabel("$x_2$")
    legend(figure)
    return figure


def jacobians(net: VectorWeights):
    for pattern in itertools.product((0.0, 1.0), repeat=len(net.b)):
        yield net.R + net.A @ (np.array(pattern)[:, None] * net.W)


def largest(net: VectorWeights, root: np.ndarray) -> float:
    return max(float(np.linalg.norm(root @ J @ np.linalg.inv(root), 2)) for J in jacobians(net))


def metric(net: VectorWeights) -> np.ndarray:
    from certify.search.vector_lmi import smallest_rate

    solution = smallest_rate(net, RELU)
    assert solution.proof is not None
    return np.array([[float(x) for x in row] for row in solution.proof.metric])


def pairs():
    """The distance of pairs of starts, and what is proved."""
    net = turning()
    rng = np.random.default_rng(1)
    T = np.diag([1.0, 2.0])
    x = rng.uniform(-1, 1, (2, 40, 2))
    distances = []
    for _ in range(25):
        distances.append(np.abs((x[0] - x[1]) @ T).max(-1))
        z = x @ net.W.T + rng.uniform(-1, 1, (40, 1)) @ net.W2.T + net.b
        x = x @ net.R.T + np.maximum(z, 0.0) @ net.A.T
    figure, (axes,) = panes(1, 3.6)
    figure.set_figwidth(6)
    K = float(vector_exact.rate(net, vector_exact.everywhere(net, RELU), "inf", matrix(T)))
    axes.plot(np.array(distances) / distances[0], color=PALE, linewidth=0.8, alpha=0.7)
    axes.plot([], [], color=PALE, label="40 pairs of starts, equal inputs")
    axes.plot(K ** np.arange(25), color=RELU_COLOUR, linewidth=2, label=rf"$\kappa^k$, κ = {K:.4g}")
    axes.set(yscale="log", xlabel="step k", ylabel=r"$\|T\,(x - x')\|_\infty$, relative to the start")
    legend(figure)
    return figure


FIGURES = {"sectors": sectors, "tiers": tiers, "cells": cells, "balls": balls, "pairs": pairs}

if __name__ == "__main__":
    for name, draw in FIGURES.items():
        draw().savefig(FOLDER / f"certification_{name}.png")
