"""Small networks for the tests of certify."""

from fractions import Fraction

import numpy as np

from certify.networks.shallow import ShallowWeights
from certify.networks.vector import VectorWeights, check
from certify.search.box import Box, operating_box

SCALING = [[Fraction(2), Fraction(1, 3)], [Fraction(0), Fraction(1)]]  # T, of two states


def network(n: int, m: int, seed: int) -> ShallowWeights:
    """As two torch layers begin: uniform ±1/√fan-in."""
    rng, k = np.random.default_rng(seed), 1 / np.sqrt(1 + m)
    a = rng.uniform(-1, 1, n) / np.sqrt(n)
    return ShallowWeights(a, rng.uniform(-k, k, n), rng.uniform(-k, k, (n, m)), rng.uniform(-k, k, n))


def star() -> tuple[ShallowWeights, Box]:
    """Three lines through (0.3, 0); their three neurons are never active together, so that K = 0.8, though σ = 1.2."""
    x, u = np.array([1.0, 1.0, -1.0]), np.array([[1.0], [-1.0], [0.0]])
    return ShallowWeights(np.array([0.4, 0.4, -0.4]), x, u, -0.3 * x), operating_box(1)


def vector_network(
    rng: np.random.Generator, q: int, m: int, n: int, last: int = 0, integer: bool = False
) -> VectorWeights:
    """With a skip connection in every second one; with two hidden layers if `last` is not 0."""

    def some(*shape):
        return rng.integers(-2, 3, shape) / 4 if integer else rng.normal(size=shape) / 2

    more = {"V": some(last, n), "c": some(last)} if last else {}
    direct = some(q, q) if rng.random() < 0.5 else None
    return check(VectorWeights(direct, some(q, last or n), some(n, q), some(n, m), some(n), **more))


def value(weights, phi, y):
    """f at points `(k, q + m)`, in floats."""

    def act(z):
        return np.tanh(z) if phi.name == "tanh" else np.maximum(z, float(phi.least) * z)

    h = act(y @ np.concatenate([weights.W, weights.W2], 1).T + weights.b)
    if weights.V is not None:
        h = act(h @ weights.V.T + weights.c)
    return y[:, : len(weights.R)] @ weights.R.T + h @ weights.A.T


def greatest_ratio(weights, phi, box, norm, scaling, rng) -> float:
    """The largest ‖T Δf‖/‖T Δx‖ of pairs of states near and far, at equal inputs."""
    q, T = len(weights.R), np.eye(len(weights.R)) if scaling is None else np.array(scaling, float)
    y = rng.uniform(box.lo, box.hi, (2000, len(box.lo)))
    other = y.copy()
    other[:1000, :q] = rng.uniform(box.lo[:q], box.hi[:q], (1000, q))
    other[1000:, :q] = np.clip(y[1000:, :q] + 1e-3 * rng.normal(size=(1000, q)), box.lo[:q], box.hi[:q])

    def size(v):
        v = np.abs(v @ T.T)
        return v.max(1) if norm == "inf" else v.sum(1)

    apart = size((y - other)[:, :q])
    return float(
        (size(value(weights, phi, y) - value(weights, phi, other)) / np.maximum(apart, 1e-300))[apart > 1e-5].max()
    )
