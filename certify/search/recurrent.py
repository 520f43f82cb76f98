"""Norms in which h⁺ = φ(W h + W₂ u + b) contracts, searched in floats without a solver; see `certify.proofs.recurrent`.

A diagonal T for the rate (1): the smallest rate is the spectral radius of |W|, and T the left vector of Perron.

A diagonal P for (2): the least spectral norm ‖D W D⁻¹‖ over D. D is balanced until the rows and the columns of the
largest singular vectors weigh equally, those of Schatten norms of growing order at first.

A full P for (2): the method of centres for generalised eigenvalues (Boyd and El Ghaoui 1993). P and Λ are the analytic
centre of M ≻ 0 at θ = κ², then θ comes nearer to the least one that these P and Λ allow. A centre is found by Newton's
method whose linear system is solved by conjugate gradients, in coordinates in which the present P and Λ are I: a
product with the Hessian takes some products of matrices, and 64 states take some ten seconds.
"""

from __future__ import annotations

import math
import time
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from certify.proofs import recurrent
from certify.proofs.rational import Matrix
from certify.proofs.vector_exact import Proof

ORDERS = (1, 2, 4, 8, 16, 32, 64)  # of the Schatten norms
BALANCINGS = 40  # of D for each order
PERRON = 1000  # iterations for a vector of Perron
FAINT = 1e-9  # of the largest entry: added to |W|, so that it has one vector of Perron
SHARE, CLOSE = (
    0.2,
    1e-5,
)  # of the distance of θ to the least one that is kept; the relative decrease that ends the search
NEWTON, GRADIENTS = 8, 100  # steps at most, for a centre and for a step
CENTRED = 0.3  # Newton decrement of a centre
WIDENED = (1e-5, 1e-4, 1e-3, 1e-2)  # relative distances above the smallest rate at which a proof is tried
BITS = (12, 16, 20, 26, 34, 44)  # of the numbers of a proof
WORTH = 1e-4  # relative gain for which they get longer


class Found(NamedTuple):
    """A rate, and its proof."""

    kappa: Fraction
    proof: Proof


def perron(W: np.ndarray) -> np.ndarray:
    """The left vector of Perron of |W|, positive, `(n,)`, its largest entry 1."""
    size = np.abs(W)
    size = size / max(size.max(), 1e-300) + FAINT
    u = np.ones(len(W))
    for _ in range(PERRON):
        before, u = u, u @ size + u  # + u: one of period two ends, too
        u /= u.max()
        if np.abs(u - before).max() < 1e-13:
            break
    return u


def diagonal_scaling(W: np.ndarray) -> Matrix:
    """T for the norm "one", of short fractions."""
    return _diagonal([_short(x, 26) for x in perron(W).tolist()])


def balanced(W: np.ndarray) -> np.ndarray:
    """The diagonal of D for which ‖D W D⁻¹‖ is smallest, nearly, `(n,)`."""
    d = np.sqrt(perron(W) / perron(W.T))
    best, least = d, math.inf
    for order in ORDERS:
        for _ in range(BALANCINGS):
            left, sizes, right = np.linalg.svd(d[:, None] * W / d)
            if sizes[0] < least:
                best, least = d, sizes[0]
            if not sizes[0] > 0:
                return best
            share = (sizes / sizes[0]) ** (2 * order)
            d = d * ((share @ right**2 + FAINT) / (left**2 @ share + FAINT)) ** (0.25 / math.sqrt(order))
            d = np.exp(np.clip(np.log(d) - np.log(d).mean(), -20, 20))  # a nilpotent W has no best d
    return best


def by_spectral_norm(W: np.ndarray) -> Found | None:
    """The smallest rate that a diagonal P proves."""
    d = balanced(W)
    rate = float(np.linalg.norm(d[:, None] * W / d, 2))
    for bits in BITS:
        p = [_short(x, bits) for x in (d * d).tolist()]
        scale = np.sqrt(np.array(p, dtype=float))
        if (now := float(np.linalg.norm(scale[:, None] * W / scale, 2))) <= rate * (1 + WORTH):
            break
    return _proved(W, now, _diagonal(p), p)


def by_full_metric(W: np.ndarray, seconds: float) -> Found | None:
    """The smallest rate that a full P proves, or one near it that is found in about so many s."""
    d = np.exp2(np.round(np.log2(balanced(W))))  # powers of two: nothing is rounded
    V = d[:, None] * W / d
    size = float(np.linalg.norm(V, 2))
    if not size > 0:
        return by_spectral_norm(W)
    V = V / size
    P, lam = _smallest(V, time.perf_counter() + seconds)
    rate, unit = math.sqrt(_least(V, P, lam)), [Fraction(x) for x in d.tolist()]
    for bits in BITS:
        near = [[Fraction(round(x * 2**bits), 2**bits) for x in row] for row in P.tolist()]
        short = [_short(x, bits) for x in lam.tolist()]
        try:
            now = math.sqrt(_least(V, np.array(near, dtype=float), np.array(short, dtype=float)))
        except np.linalg.LinAlgError:
            continue
        if now <= rate * (1 + WORTH):
            metric = [[x * s * t for x, t in zip(row, unit, strict=True)] for row, s in zip(near, unit, strict=True)]
            return _proved(W, size * now, metric, [x * t * t for x, t in zip(short, unit, strict=True)])
    return None


def _proved(W: np.ndarray, rate: float, metric: Matrix, multipliers: list[Fraction]) -> Found | None:
    for widened in WIDENED:
        kappa = Fraction(math.ceil(rate * (1 + widened) * 10**7 + 1), 10**7)
        if recurrent.proves(W, metric, multipliers, kappa):
            return Found(kappa, Proof(metric, [multipliers]))
    return None


def _inequality(V: np.ndarray, theta: float, P: np.ndarray, lam: np.ndarray) -> np.ndarray:
    """M of (2) at θ = κ²: it is linear in P and Λ."""
    cross = -lam[:, None] * V
    return np.block([[theta * P, cross.T], [cross, 2 * np.diag(lam) - P]])


def _least(V: np.ndarray, P: np.ndarray, lam: np.ndarray) -> float:
    """The least θ with these P and Λ; a LinAlgError if P or 2Λ − P is not positive definite."""
    cross = lam[:, None] * V
    root = np.linalg.inv(np.linalg.cholesky(P))
    half = np.linalg.solve(np.linalg.cholesky(2 * np.diag(lam) - P), cross @ root.T)
    return float(np.linalg.norm(half, 2)) ** 2


def _smallest(V: np.ndarray, until: float) -> tuple[np.ndarray, np.ndarray]:
    """P and the diagonal of Λ with nearly the least θ, for a V with the spectral norm 1."""
    P, lam, theta = np.eye(len(V)), np.ones(len(V)), 1.1
    while True:
        least = _least(V, P, lam)
        new = least + SHARE * (theta - least)
        if theta - new < CLOSE * theta or time.perf_counter() > until:
            return P, lam
        theta = new
        for _ in range(NEWTON):
            P, lam, decrement = _newton(V, theta, P, lam)
            if decrement < CENTRED or time.perf_counter() > until:
                break


def _newton(V: np.ndarray, theta: float, P: np.ndarray, lam: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """A step of Newton towards the least −log det M + trace P + trace Λ, and its decrement."""
    n, root = len(V), np.linalg.cholesky(P)
    G = np.linalg.inv(_inequality(V, theta, P, lam))

    def original(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return root @ x[:-1] @ root.T, lam * x[-1]

    def adjoint(Z: np.ndarray, identity: float = 0.0) -> np.ndarray:
        """The gradient with respect to the scaled P and Λ of trace Z M − identity (trace P + trace Λ)."""
        X = theta * Z[:n, :n] - Z[n:, n:] - identity * np.eye(n)
        diagonal = 2 * np.diag(Z[n:, n:]) - 2 * np.einsum("ij,ji->i", V, Z[:n, n:]) - identity
        return np.vstack([root.T @ (X + X.T) @ root / 2, lam * diagonal])

    right = residual = direction = adjoint(G, 1.0)
    x, square = np.zeros((n + 1, n)), float((residual**2).sum())
    first = square
    for _ in range(GRADIENTS):
        image = adjoint(G @ _inequality(V, theta, *original(direction)) @ G)
        length = square / float((direction * image).sum())
        x, residual = x + length * direction, residual - length * image
        before, square = square, float((residual**2).sum())
        if square < 1e-2 * first:
            break
        direction = residual + square / before * direction
    decrement = math.sqrt(max(float((x * right).sum()), 0.0))
    move, step = original(x), 1.0 if decrement < 0.25 else 1 / (1 + decrement)
    while step > 1e-6:
        new = P + step * move[0], lam + step * move[1]
        try:
            np.linalg.cholesky(_inequality(V, theta, *new))
            return *new, decrement
        except np.linalg.LinAlgError:
            step /= 2
    return P, lam, 0.0


def _short(x: float, bits: int) -> Fraction:
    """A fraction with so many significant bits."""
    mantissa, exponent = math.frexp(x)
    return Fraction(max(round(mantissa * 2**bits), 1)) * Fraction(2) ** (exponent - bits)


def _diagonal(values: list[Fraction]) -> Matrix:
    return [[x if i == j else Fraction(0) for j in range(len(values))] for i, x in enumerate(values)]
