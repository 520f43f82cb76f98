"""Small networks for the tests of certify."""

import numpy as np

from certify.networks.shallow import ShallowWeights
from certify.networks.vector import VectorWeights, check
from certify.search.box import Box, operating_box


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
