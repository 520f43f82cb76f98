"""Random networks with a vector state, and the norm of their slopes."""

from fractions import Fraction

import numpy as np

from certify.networks.vector import RELU, VectorNetwork, VectorWeights, check
from certify.proofs.rational import Matrix, inverse


def draw(rng: np.random.Generator, q: int, n: int, second: int = 0, inputs: int = 2) -> VectorWeights:
    """Gaussian weights, some zero, with a skip connection in two of three; a second hidden layer of that width."""
    last = second or n
    A, W, W2 = (rng.standard_normal(shape) for shape in ((q, last), (n, q), (n, inputs)))
    V = rng.standard_normal((second, n)) if second else None
    R = rng.standard_normal((q, q)) * rng.choice([0.0, 0.3, 1.0])
    for X in (A, W, R):
        X[rng.random(X.shape) < 0.1] = 0.0
    return check(VectorWeights(R, A, W, W2, rng.standard_normal(n), V, rng.standard_normal(second) if second else None))


def draw_scaling(rng: np.random.Generator, q: int) -> Matrix:
    """A regular T of small fractions."""
    while True:
        T = [[Fraction(int(x), 4) for x in row] for row in rng.integers(-8, 9, (q, q))]
        if inverse(T) is not None:
            return T


def spectral(slopes: np.ndarray, metric: Matrix) -> float:
    """The largest norm of the slopes, `(…, q, q)`, in √(xᵀ P x)."""
    root = np.linalg.cholesky(np.array(metric, dtype=float)).T
    return float(np.linalg.norm(root @ slopes @ np.linalg.inv(root), 2, axis=(-2, -1)).max())


def network(rng: np.random.Generator, q: int = 2, n: int = 4, two: bool = False, phi=RELU) -> VectorNetwork:
    """As if read from net.npz: Gaussian weights, of which those behind the neurons are small."""
    layer = {"V": rng.normal(size=(3, n)) / n, "c": rng.normal(size=3)} if two else {}
    A = 0.3 * rng.normal(size=(q, 3 if two else n)) / n
    weights = VectorWeights(0.3 * np.eye(q), A, rng.normal(size=(n, q)), rng.normal(size=(n, 2)), rng.normal(size=n))
    return VectorNetwork("net.npz", check(weights._replace(**layer)), phi)


def forward(network: VectorNetwork, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """x⁺ in floats."""
    R, A, W, W2, b, V, c = network.weights

    def phi(z: np.ndarray) -> np.ndarray:
        return np.tanh(z) if network.activation.name == "tanh" else np.maximum(z, float(network.activation.least) * z)

    hidden = phi(x @ W.T + u @ W2.T + b)
    return x @ R.T + (hidden if V is None else phi(hidden @ V.T + c)) @ A.T
