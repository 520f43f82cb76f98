"""Figures of networks with a vector state; matplotlib is imported where it is used (extra `plot`)."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from certify.display.figures import INK, PALE, TIER_COLOURS, blank
from certify.networks.vector import VectorNetwork, forward

PAIRS = 24  # of starts
STEPS = 60
PATTERNS = 300  # activation patterns whose Jacobian is drawn, at most
FAINTEST = 1e-12  # relative distance, where rounding begins
FARTHEST = 1e30  # that is drawn

QUIET = np.errstate(all="ignore")  # weights near the ends of a float's range


@QUIET
def contraction_figure(network: VectorNetwork, row: Mapping[str, Any], scaling: np.ndarray):
    """How fast pairs of starts come together, beside what is proved; and the unit ball of the norm with its images.

    Args:
        network: one checkpoint.
        row: of `certify.analysis.vector_assess.assess`.
        scaling: T of the norm ‖T x‖ in `row`, `(q, q)`.

    Returns:
        A matplotlib figure.

    Raises:
        CertifyError: matplotlib is not installed.
    """
    q, order = network.states, np.inf if row["norm"] == "inf" else 1
    figure = blank(
        "the figure of contraction", figsize=(11, 4.6) if q > 1 else (6.2, 4.6), dpi=110, layout="constrained"
    )
    figure.suptitle(network.path, fontsize=10, color=INK)
    axes, *others = np.ravel(figure.subplots(1, 2 if q > 1 else 1))
    distances = _distances(network, scaling, order)  # an overflow is no finite distance, and is not drawn
    finite = distances[distances < FARTHEST]
    steps = np.arange(len(distances))
    axes.plot(steps, np.where(distances < FARTHEST, distances, np.nan), color=PALE, linewidth=0.8, alpha=0.7)
    axes.plot([], [], color=PALE, label=f"{PAIRS} pairs of starts, equal random inputs")
    rate = row["rates"]["exact"]
    axes.plot(steps, np.clip(rate**steps, FAINTEST, FARTHEST), color=TIER_COLOURS["tight"], linewidth=2,
              label=f"exact rate over all patterns, {rate:.4g}")  # fmt: skip
    axes.set(yscale="log", xlabel="step k", ylabel="distance in the norm / that of the starts", title="Pairs of starts")
    highest = 2 * max(1.0, min(rate, 1.2) ** STEPS, finite.max())
    axes.set_ylim(max(FAINTEST, finite.min() / 2), min(highest, FARTHEST))
    for pane in others:
        _draw_balls(pane, network, scaling, order)
    for pane in (axes, *others):
        pane.title.set_fontsize(11)
        pane.spines[["top", "right"]].set_visible(False)
        pane.grid(color="#EEEEEE", linewidth=0.8)
        pane.set_axisbelow(True)
        pane.legend(fontsize=8, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.14))
    return figure


def _distances(network: VectorNetwork, scaling: np.ndarray, order: float) -> np.ndarray:
    """‖T (x_k − x'_k)‖ / ‖T (x_0 − x'_0)‖, `(STEPS + 1, PAIRS)`."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (2, PAIRS, network.states))
    found = []
    for _ in range(STEPS + 1):
        found.append(np.linalg.norm((x[0] - x[1]) @ scaling.T, order, axis=-1))
        u = rng.uniform(-1, 1, (PAIRS, network.inputs))
        x = forward(network, x, u)
    return np.maximum(np.array(found) / found[0], FAINTEST)


def _draw_balls(axes, network: VectorNetwork, scaling: np.ndarray, order: float) -> None:
    """The unit ball of the norm in the plane of the first two states, and its images by Jacobians of patterns."""
    turn = np.linspace(0, 2 * np.pi, 721)
    plane = np.zeros((len(turn), network.states))
    plane[:, 0], plane[:, 1] = np.cos(turn), np.sin(turn)
    ball = plane / np.linalg.norm(plane @ scaling.T, order, axis=-1)[:, None]
    weights = network.weights
    for D in patterns(network):
        J = D[: len(weights.b), None] * weights.W
        if weights.V is not None:
            J = D[len(weights.b) :, None] * (weights.V @ J)
        image = ball @ (weights.R + weights.A @ J).T
        axes.plot(image[:, 0], image[:, 1], color=PALE, linewidth=0.6, alpha=0.35)
    count = 2**network.neurons
    drawn = f"all {count}" if count <= PATTERNS else f"{PATTERNS} random"
    axes.plot([], [], color=PALE, label=f"its images by {drawn} activation patterns")
    if weights.V is None:
        image = ball @ _worst(network, scaling, order).T
        axes.plot(
            image[:, 0], image[:, 1], color=TIER_COLOURS["gershgorin"], linewidth=1.5, label="by the worst pattern"
        )
    axes.plot(ball[:, 0], ball[:, 1], color=TIER_COLOURS["tight"], linewidth=2, label="unit ball of the norm")
    axes.set(xlabel="$x_1$", ylabel="$x_2$", title="Where the ball goes in one step", aspect="equal")


def patterns(network: VectorNetwork) -> Iterator[np.ndarray]:
    """The slopes of all hidden neurons, `(n + l,)`, each the least or 1: all patterns, or PATTERNS random ones.

    >>> from certify.networks.vector import VectorWeights, check
    >>> net = check(VectorWeights(None, [[0.5, 0.25]], [[1.0], [1.0]], np.zeros((2, 0)), np.zeros(2)))
    >>> [D.tolist() for D in patterns(VectorNetwork("", net))]
    [[1.0, 1.0], [1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]
    """
    n, least = network.neurons, float(network.activation.least)
    if 2**n <= PATTERNS:
        yield from map(np.array, itertools.product((1.0, least), repeat=n))
        return
    rng = np.random.default_rng(0)
    sizes = [len(each) for each in (network.weights.b, network.weights.c) if each is not None]
    for k in range(PATTERNS):
        layers = []
        for size in sizes:
            share = 1.0 if k == 0 else rng.uniform()  # of the layer's neurons that are on
            layers.append(np.where(rng.uniform(size=size) < share, 1.0, least))
        yield np.concatenate(layers)


def _worst(network: VectorNetwork, scaling: np.ndarray, order: float) -> np.ndarray:
    """The Jacobian of the pattern with the largest norm, `(q, q)`; one hidden layer."""
    weights, alpha = network.weights, float(network.activation.least)
    back = np.linalg.inv(scaling)
    A, W = scaling @ weights.A, weights.W @ back
    outer, inner = (A, W) if order == np.inf else (W.T, A.T)
    found = []
    for r, signs in itertools.product(range(len(A)), itertools.product((-1.0, 1.0), repeat=len(A))):
        slopes = np.where(outer[r] * (inner @ signs) > 0, 1.0, alpha)
        found.append(weights.R + weights.A @ (slopes[:, None] * weights.W))
    return max(found, key=lambda J: np.linalg.norm(scaling @ J @ back, order))
