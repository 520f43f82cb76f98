"""The scaling T of the state in which the ∞-norm or the 1-norm of a network's slopes is smallest.

For each row r and each ε ∈ {±1}^q, (2) of `certify.proofs.vector_exact` has one number v_rε(T), and K is the largest of
them.

**Diagonal T.** With s_r = 1/t_r, let F_r(s) be the largest [J x]_r over |x| ≤ s and all slopes. F is monotone and
homogeneous, and K = max_r F_r(s)/s_r. So the smallest K is the spectral radius of F on the positive cone, by Perron and
Frobenius, and s ← F(s) + s, normalised, leads to it.

**Full T.** T ← (I + G) T changes v_rε by a linear function of G, as long as the signs remain. A linear program
minimises the largest v_rε + ∇v_rε·G over |G_ij| ≤ δ; δ is quartered where K does not decrease. The starts are the best
diagonal T, bases of eigenvectors, and square roots of a metric P such as that of `certify.search.vector_lmi`. The
result is a local minimum. T is rounded to short fractions, for which the exact rate is computed: the floats only
search.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from certify.networks.vector import Activation, VectorWeights
from certify.proofs.rational import Matrix, identity, inverse
from certify.proofs.vector_exact import NORMS, everywhere, rate

QUIET = np.errstate(all="ignore")  # weights near the ends of a float's range; what is claimed is computed in fractions
STEPS = 60  # linear programs from one start
ITERATIONS = 400  # of F
FIRST, LAST = 0.3, 1e-4  # δ, and where the search ends
GAIN = 1e-5  # of K, relative: a program that expects less ends the search, too
GRIDS = (2**6, 2**10, 2**16, 2**24)  # denominators of T
WORTH = 1e-3  # relative gain for which T gets longer fractions
WORST = 1e7  # condition of T
TURNS = 2  # random rotations of √P, from one seed


class Scaling(NamedTuple):
    """A norm ‖T x‖ and the exact rate in it; with two hidden layers its bound."""

    norm: str  # inf or one
    T: Matrix  # (q, q)
    rate: Fraction
    kind: str  # none, diagonal or full


class Values:
    """v_rε in floats."""

    def __init__(self, weights: VectorWeights, phi: Activation, norm: str) -> None:
        layers = [x for x in (weights.W, weights.V, weights.A) if x is not None]
        self.R = weights.R
        if norm == "one":
            self.R, layers = self.R.T, [x.T for x in reversed(layers)]
        self.layers, self.transposed = layers, norm == "one"
        self.low, self.high = float(phi.least), float(phi.most)
        self.signs = np.array(list(itertools.product((-1.0, 1.0), repeat=len(self.R)))).T  # (q, 2^q)

    def __call__(self, T: np.ndarray) -> np.ndarray:
        """`(q, 2^q)`."""
        back = np.linalg.inv(T)
        if self.transposed:  # (T J T⁻¹)ᵀ
            T, back = back.T, T.T
        return self.on(back @ self.signs, T)

    def largest(self, T: np.ndarray) -> float:
        """K; infinite for a T that is singular in floats."""
        if not np.isfinite(T).all() or np.linalg.cond(T) > WORST:
            return math.inf
        return float(self(T).max())

    def on(self, x: np.ndarray, T: np.ndarray) -> np.ndarray:
        """The largest T J x for each x, `(q, points)`; of two hidden layers a bound."""
        first, *rest = self.layers
        least = greatest = first @ x
        for X in [*rest[:-1], T @ rest[-1]]:
            least = np.minimum(self.low * least, self.high * least)
            greatest = np.maximum(self.low * greatest, self.high * greatest)
            above, below = np.maximum(X, 0.0), np.minimum(X, 0.0)
            least, greatest = above @ least + below @ greatest, above @ greatest + below @ least
        return T @ self.R @ x + greatest


def best_diagonal(values: Values) -> np.ndarray:
    """The diagonal of T for which K is smallest, `(q,)`, with the geometric mean 1."""
    q = len(values.R)
    s, unit = np.ones(q), np.eye(q)
    for _ in range(ITERATIONS):
        F = values.on(s[:, None] * values.signs, unit).max(1)
        largest = max(F.max(), 1e-300)
        new = F / largest + s / s.max() * 0.5 + 1e-9  # a little is added where F is reducible
        new /= np.exp(np.log(new).mean())
        done = np.abs(np.log(new / s)).max() < 1e-9
        s = new
        if done:
            break
    return s if values.transposed else 1 / s


def improve(values: Values, T: np.ndarray, until: float) -> np.ndarray:
    """The T of a local minimum of K near T, or what is found until then."""
    from scipy.optimize import linprog

    q, delta, step = len(T), FIRST, 1e-7
    K = values.largest(T)
    for _ in range(STEPS if math.isfinite(K) else 0):
        if delta < LAST or time.perf_counter() > until:
            break
        now = values(T)
        slopes = np.empty((q * q, now.size))
        for k in range(q * q):
            G = np.zeros(q * q)
            G[k] = step
            slopes[k] = (values(T + G.reshape(q, q) @ T) - now).ravel() / step
        columns = np.column_stack([slopes.T, -np.ones(now.size)])
        bounds = [(-delta, delta)] * (q * q) + [(None, None)]
        solution = linprog(np.eye(q * q + 1)[-1], columns, -now.ravel(), bounds=bounds, method="highs")
        if not solution.success or K - solution.x[-1] <= GAIN * K:
            break
        moved = T + solution.x[:-1].reshape(q, q) @ T
        then = values.largest(moved)
        if K - then <= GAIN / 10 * K:
            delta /= 4
            continue
        if K - then > 0.75 * (K - solution.x[-1]):
            delta *= 2
        T, K = moved / np.abs(moved).max(), then
    return T


def starts(weights: VectorWeights, phi: Activation, values: Values, metric: np.ndarray | None) -> Iterator[np.ndarray]:
    """The T from which the search starts."""
    yield np.diag(best_diagonal(values))
    if metric is not None and np.linalg.eigvalsh(metric)[0] > 0:
        root = np.linalg.cholesky(metric).T
        generator = np.random.default_rng(0)
        eigenvalues, vectors = np.linalg.eigh(metric)
        yield np.sqrt(eigenvalues)[:, None] * vectors.T
        for k in range(TURNS + 1):
            yield (np.eye(len(root)) if k == 0 else np.linalg.qr(generator.standard_normal(root.shape))[0]) @ root
    middle = float(phi.least + phi.most) / 2
    slope = weights.A @ ((middle * weights.V @ (middle * weights.W)) if weights.V is not None else middle * weights.W)
    for J in (weights.R + slope, weights.R):
        eigenvalues, vectors = np.linalg.eig(J)
        basis = np.where(np.imag(eigenvalues) >= 0, np.real(vectors), np.imag(vectors))  # of a pair
        if np.linalg.cond(basis) < 1e4:
            yield np.linalg.inv(basis)


@QUIET
def best_scaling(
    weights: VectorWeights,
    phi: Activation,
    seconds: float = 10.0,
    metric: Sequence[Sequence[Fraction | float]] | None = None,
    full: bool = True,
) -> Scaling:
    """The smallest rate over both norms and T = I, diagonal or full; never above the smaller rate with T = I.

    Args:
        weights: of one network, checked.
        phi: gives the slopes.
        seconds: s after which no further program is started. A search that ends before gives equal results every time.
        metric: P of a quadratic norm to start from, `(q, q)`.
        full: False tries no full T, and needs no scipy.

    Returns:
        The norm, T, the exact rate in that norm, and the kind of T.

    >>> from certify.networks.vector import RELU, check
    >>> net = check(VectorWeights([[0.5, 8.0], [0.0, 0.5]], np.zeros((2, 1)), np.zeros((1, 2)), [[0.0]], [0.0]))
    >>> scaling = best_scaling(net, RELU, full=False)
    >>> scaling.kind, scaling.rate < Fraction(51, 100)
    ('diagonal', True)
    """
    start, q = time.perf_counter(), len(weights.R)
    slopes = everywhere(weights, phi)
    scalings = [Scaling(norm, identity(q), rate(weights, slopes, norm), "none") for norm in NORMS]
    if q == 1:
        return scalings[0]  # K does not depend on T
    P = None if metric is None else np.array([[float(x) for x in row] for row in metric])
    for k, norm in enumerate(NORMS, 1):
        until = start + seconds * k / len(NORMS)
        values = Values(weights, phi, norm)
        tried = [("diagonal", np.diag(best_diagonal(values)))]
        for T in starts(weights, phi, values, P) if full else ():
            if time.perf_counter() < until:
                tried.append(("full", improve(values, T / np.abs(T).max(), until)))
        for kind in ("diagonal", "full"):
            if those := [T for each, T in tried if each == kind]:
                short = _rounded(values, min(those, key=values.largest))
                if inverse(short) is not None:
                    scalings.append(Scaling(norm, short, rate(weights, slopes, norm, short), kind))
    return min(scalings, key=lambda each: each.rate)


def _rounded(values: Values, T: np.ndarray) -> Matrix:
    """Fractions near T, the coarsest whose rate in floats is at most WORTH above."""
    T = T / np.abs(T).max()
    for grid in GRIDS:
        near = np.round(T * grid) / grid
        if values.largest(near) <= values.largest(T) * (1 + WORTH):
            break
    return [[Fraction(round(x * grid), grid) for x in row] for row in T.tolist()]
