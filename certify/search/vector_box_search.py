"""The search behind `certify.search.vector_box`: bounds of the rate and of the range on many boxes at once, in floats.

`certify.search.box_search.Search` halves the boxes whose bound is too high. The bounds are those of
`certify.proofs.vector_box_proof`, which proves the result. A hyperplane that touches a box up to rounding counts as
beside it (lean = 1) or as crossing it (lean = −1); the replay decides which of the two is true.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from certify.networks.vector import RELU, Activation, VectorWeights
from certify.proofs.box_planes import Box
from certify.proofs.vector_exact import Matrix, changed
from certify.proofs.vector_slopes import Layer
from certify.proofs.vector_statements import gains
from certify.search.box_search import EPS, TINY

TRIES = 16  # points on a line at which ‖J‖ is tried


class Lines(NamedTuple):
    """What is known of φ on intervals of z, arrays of one shape."""

    flat: np.ndarray  # least slope
    steep: np.ndarray  # greatest
    low: np.ndarray  # s, t: s z + t ≤ φ(z)
    low_constant: np.ndarray
    high: np.ndarray
    high_constant: np.ndarray
    least: np.ndarray  # φ at the ends
    most: np.ndarray


def value(phi: Activation, z: np.ndarray) -> np.ndarray:
    """φ(z)."""
    return np.tanh(z) if phi.name == "tanh" else np.maximum(z, float(phi.least) * z)


def slope(phi: Activation, z: np.ndarray) -> np.ndarray:
    """φ′(z)."""
    if phi.name == "tanh":
        E = np.exp(-2 * np.abs(z))
        return 4 * E / (1 + E) ** 2
    return np.where(z > 0, 1.0, float(phi.least))


def slope_ends(phi: Activation, least: np.ndarray, most: np.ndarray, slack: np.ndarray | float) -> tuple:
    """The least and the greatest slope on intervals; a slack above 0 ignores a crossing by less."""
    if phi.name == "tanh":
        near = np.maximum(np.maximum(least, -most), 0.0)
        return slope(phi, np.maximum(-least, most)), slope(phi, near)
    alpha = float(phi.least)
    on, off = least >= -slack, most <= slack
    return np.where(on, 1.0, alpha), np.where(off & ~on, alpha, 1.0)


def lines(phi: Activation, least: np.ndarray, most: np.ndarray, slack: np.ndarray | float) -> Lines:
    """As `certify.proofs.vector_slopes.lines`."""
    flat, steep = slope_ends(phi, least, most, slack)
    low, high = value(phi, least), value(phi, most)
    if phi.name == "tanh":
        s, middle = (flat + steep) / 2, (least + most) / 2
        band = (steep - flat) / 2 * (most - least) / 2
        straight = 2 * band < high - low
        s, at = np.where(straight, s, 0.0), value(phi, middle) - s * middle
        under, over = np.where(straight, at - band, low), np.where(straight, at + band, high)
        chord = (high - low) / np.maximum(most - least, TINY)
        tangent, one_sided = slope(phi, middle), (least >= 0) | (most <= 0)
        below = (chord, low - chord * least), (tangent, value(phi, middle) - tangent * middle)
        concave = least >= 0
        (s1, t1), (s2, t2) = (
            tuple(np.where(one_sided, np.where(concave, x, y), z) for x, y, z in zip(*three, strict=True))
            for three in ((below[0], below[1], (s, under)), (below[1], below[0], (s, over)))
        )
        return Lines(flat, steep, s1, t1, s2, t2, low, high)
    chord = np.where(steep == flat, flat, (high - low) / np.maximum(most - least, TINY))
    tangent = np.where((flat == steep) | (most <= -least), flat, 1.0)
    zero = np.zeros_like(least)
    return Lines(flat, steep, tangent, zero, chord, np.where(steep == flat, 0.0, high - chord * most), low, high)


class Floats:
    """A network, and the bounds of its rate on boxes, as functions for `Search.boxes`."""

    def __init__(
        self,
        weights: VectorWeights,
        phi: Activation,
        box: Box,
        norm: str,
        scaling: Matrix | None,
        lean: float = 1.0,
    ):
        self.weights, self.phi, self.q, self.lean = weights, phi, len(weights.R), lean
        self.H, self.c = np.concatenate([weights.W, weights.W2], 1), weights.b
        self.deep = weights.V is not None
        if self.deep:
            R, A, W = (np.array(X, dtype=float) for X in changed(weights, scaling))
            V = weights.V
            if norm == "one":
                R, W, V, A = R.T, A.T, V.T, W.T
            self.turned = norm == "one"
            signs = np.array([(1, *each) for each in itertools.product((-1, 1), repeat=self.q - 1)], dtype=float)
            self.parts = R @ signs.T, W @ signs.T, V, A  # (q, E), (n, E), (l, n), (q, l)
        else:
            self.phi = phi if phi.name == "tanh" else RELU  # the gain is from one side of a hyperplane to the other
            found = gains(weights, phi, box, norm, scaling)
            self.H, self.c = planes(found.planes, len(box.lo))
            self.start = np.array([k / found.unit for k in found.start])
            self.gain = np.array([[k / found.unit for k in row] for row in found.gain]).reshape(-1, len(self.start))
        self.sizes = np.abs(self.H)
        greatest = self.sizes @ np.maximum(np.abs(box.lo), np.abs(box.hi)) + np.abs(self.c)
        self.error = 4 * (len(box.lo) + 4) * EPS * greatest

    def first(self, lo: np.ndarray, hi: np.ndarray) -> tuple[np.ndarray, ...]:
        """The centre, the radius, z and its reach."""
        centre, radius = (lo + hi) / 2, (hi - lo) / 2
        return centre, radius, centre @ self.H.T + self.c, radius @ self.sizes.T

    def bound(self, lo: np.ndarray, hi: np.ndarray, signs: np.ndarray) -> tuple[np.ndarray, ...]:
        """Bounds of ‖J‖ on boxes, points and ‖J‖ there."""
        centre, _, z, reach = self.first(lo, hi)
        if self.deep:
            bounds = self._deep(*self._slopes(lo, hi)[:2])
        else:
            bounds = self._sums(z, reach).max(1)
        return signs, bounds, centre, self.at(centre)

    def halve(self, lo: np.ndarray, hi: np.ndarray, signs: np.ndarray) -> np.ndarray:
        """The coordinate on which the open slopes depend most."""
        _, radius, z, reach = self.first(lo, hi)
        if self.deep:
            (flat, steep), (flat2, steep2), reach2 = self._slopes(lo, hi)
            W, V, A = (np.abs(X) for X in (self.weights.W, self.weights.V, self.weights.A))
            last, first = A.sum(0), W.sum(1)
            share = (steep - flat) * ((steep2 * last) @ V) * first / (reach + TINY)
            share2 = (steep2 - flat2) * last * (steep @ (V * first).T) / (reach2 + TINY)
            return ((share @ self.sizes + share2 @ (V @ self.sizes)) * radius).argmax(1)
        flat, steep = slope_ends(self.phi, z - reach, z + reach, self.lean * self.error)
        worst = np.abs(self.gain[:, self._sums(z, reach).argmax(1)]).T
        return (((steep - flat) * worst / (reach + TINY)) @ self.sizes * radius).argmax(1)

    def at(self, y: np.ndarray) -> np.ndarray:
        """‖J‖ at points, `(k,)`; −∞ where rounding makes a slope uncertain."""
        z = y @ self.H.T + self.c
        d = slope(self.phi, z)
        if not self.deep:
            found = (self.start + d @ self.gain).max(1)
        else:
            z2 = value(self.phi, z) @ self.weights.V.T + self.weights.c
            d2 = slope(self.phi, z2)
            if self.turned:
                d, d2 = d2, d
            direct, moved, V, A = self.parts
            found = np.full(len(y), 0.0)
            for k in range(direct.shape[1]):
                sums = ((d * moved[:, k]) @ V.T * d2) @ A.T + direct[:, k]
                found = np.maximum(found, np.abs(sums).max(1))
        if self.phi.name == "tanh":
            return found
        return np.where((np.abs(z) > self.error).all(1), found, -np.inf)

    def climb(self, y: np.ndarray, box: Box, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """‖J‖ and points after searches from y along each coordinate in turn: exact where J changes at hyperplanes."""
        sides = np.flatnonzero(box.lo < box.hi)
        if not self.deep and self.phi.name != "tanh":
            for j in 3 * sides.tolist():
                y = self._best_on_line(y, j, box)
            return self.at(y), y
        best, rows = self.at(y), np.arange(len(y))
        for j in 2 * [*sides]:
            others = np.repeat(y[:, None], TRIES, 1)
            others[..., j] = rng.uniform(box.lo[j], box.hi[j], others.shape[:2])
            found = self.at(others.reshape(-1, y.shape[1])).reshape(-1, TRIES)
            k = found.argmax(1)
            better = found[rows, k] > best
            y, best = np.where(better[:, None], others[rows, k], y), np.where(better, found[rows, k], best)
        return best, y

    def _best_on_line(self, y: np.ndarray, j: int, box: Box) -> np.ndarray:
        """The middle of the interval of coordinate j, between hyperplanes, on which ‖J‖ is greatest."""
        h, rows = self.H[:, j], np.arange(len(y))
        z = y @ self.H.T + self.c
        crossed = np.where(h == 0, np.inf, y[:, j, None] - z / np.where(h == 0, 1.0, h))
        crossed = crossed.clip(box.lo[j], box.hi[j])
        order = crossed.argsort(1)
        first = self.start + (h < 0) @ self.gain + ((z > 0) & (h == 0)) @ self.gain  # (k, pairs)
        steps = (np.sign(h)[:, None] * self.gain)[order].cumsum(1)
        norms = np.concatenate([first[:, None], first[:, None] + steps], 1).max(2)
        least, most = np.full((len(y), 1), box.lo[j]), np.full((len(y), 1), box.hi[j])
        ends = np.concatenate([least, np.take_along_axis(crossed, order, 1), most], 1)
        k = np.where(np.diff(ends) > 1e-9 * (box.hi[j] - box.lo[j]), norms, -np.inf).argmax(1)
        y = y.copy()
        y[:, j] = (ends[rows, k] + ends[rows, k + 1]) / 2
        return y

    def _sums(self, z: np.ndarray, reach: np.ndarray) -> np.ndarray:
        flat, steep = slope_ends(self.phi, z - reach, z + reach, self.lean * self.error)
        return self.start + steep @ np.maximum(self.gain, 0) + flat @ np.minimum(self.gain, 0)

    def _slopes(self, lo: np.ndarray, hi: np.ndarray) -> tuple:
        """The slopes of both layers, and the reach of the second's z."""
        _, _, z, reach = self.first(lo, hi)
        known = lines(self.phi, z - reach, z + reach, self.lean * self.error)
        rows = Linears(self, lo, hi, known)
        low, high = rows.through(self.weights.V, self.weights.c)[:2]
        ends = slope_ends(self.phi, low, high, 0.0)
        return (known.flat, known.steep), ends, (high - low) / 2

    def _deep(self, first: tuple, second: tuple) -> np.ndarray:
        if self.turned:
            first, second = second, first
        direct, moved, V, A = self.parts
        positive, negative = np.maximum(V, 0), np.minimum(V, 0)
        up, down = np.maximum(A, 0), np.minimum(A, 0)
        found = np.full(len(first[0]), -np.inf)
        for k in range(direct.shape[1]):
            w, plus = moved[:, k], moved[:, k] > 0
            least, most = w * np.where(plus, *first), w * np.where(plus, *first[::-1])
            low, high = least @ positive.T + most @ negative.T, most @ positive.T + least @ negative.T
            low, high = (
                low * np.where(low > 0, *second),
                high * np.where(high > 0, *second[::-1]),
            )
            most, least = high @ up.T + low @ down.T + direct[:, k], low @ up.T + high @ down.T + direct[:, k]
            found = np.maximum(found, np.maximum(most.max(1), -least.min(1)))
        return found


class Linears:
    """Linear bounds of a layer's neurons on boxes."""

    def __init__(self, net: Floats, lo: np.ndarray, hi: np.ndarray, known: Lines):
        self.phi, self.centre, self.radius, self.known = net.phi, (lo + hi) / 2, (hi - lo) / 2, known
        H, c = np.concatenate([net.weights.W, net.weights.W2], 1), net.weights.b
        self.low, self.high = known.low[:, :, None] * H, known.high[:, :, None] * H  # (k, n, q + m)
        self.low_c = known.low * c + known.low_constant
        self.high_c = known.high * c + known.high_constant

    def through(self, matrix: np.ndarray, constants: np.ndarray) -> tuple[np.ndarray, ...]:
        """The ends of matrix φ(z) + constants, and its linear bounds: rows and constants, lower and upper."""
        plus, minus = np.maximum(matrix, 0), np.minimum(matrix, 0)
        low, high = plus @ self.low + minus @ self.high, plus @ self.high + minus @ self.low
        low_c = self.low_c @ plus.T + self.high_c @ minus.T + constants
        high_c = self.high_c @ plus.T + self.low_c @ minus.T + constants
        at, reach = self.centre[:, :, None], self.radius[:, :, None]
        least = (low @ at - np.abs(low) @ reach)[..., 0] + low_c
        most = (high @ at + np.abs(high) @ reach)[..., 0] + high_c
        inner, outer = self.known.least, self.known.most
        least = np.maximum(least, inner @ plus.T + outer @ minus.T + constants)
        most = np.minimum(most, outer @ plus.T + inner @ minus.T + constants)
        return least, most, low, low_c, high, high_c

    def follow(self, found: tuple[np.ndarray, ...], slack: float) -> None:
        """Go on to the next layer, whose bounds `through` has given."""
        least, most, low, low_c, high, high_c = found
        self.known = known = lines(self.phi, least, most, slack)
        self.low, self.high = known.low[:, :, None] * low, known.high[:, :, None] * high
        self.low_c = known.low * low_c + known.low_constant
        self.high_c = known.high * high_c + known.high_constant


def range_bounds(weights: VectorWeights, phi: Activation, box: Box, slack: float = 0.0) -> tuple[Callable, Callable]:
    """bound() and halve() of `Search.boxes` for how far f leaves the box's intervals of x.

    Bounds by chords, whose slopes a proof rounds, are raised by `slack`.
    """
    q, net = len(weights.R), Floats(weights, phi, box, "inf", None)
    net.phi, net.H, net.c = phi, np.concatenate([weights.W, weights.W2], 1), weights.b  # not merged
    net.sizes = np.abs(net.H)
    direct = np.concatenate([weights.R, np.zeros((q, weights.W2.shape[1]))], 1)
    deep = weights.V is not None

    def f(y):
        h = value(phi, y @ net.H.T + net.c)
        if deep:
            h = value(phi, h @ weights.V.T + weights.c)
        return y @ direct.T + h @ weights.A.T

    def bound(lo, hi, signs):
        centre, radius, z, reach = net.first(lo, hi)
        rows = Linears(net, lo, hi, lines(phi, z - reach, z + reach, 0.0))
        if deep:
            rows.follow(rows.through(weights.V, weights.c), 0.0)
        least, most, low, low_c, high, high_c = rows.through(weights.A, np.zeros(q))
        low, high = low + direct, high + direct
        straight, moved = centre @ direct.T, radius @ np.abs(direct).T
        at, size = centre[:, :, None], radius[:, :, None]
        least = np.maximum(least + straight - moved, (low @ at - np.abs(low) @ size)[..., 0] + low_c)
        most = np.minimum(most + straight + moved, (high @ at + np.abs(high) @ size)[..., 0] + high_c)
        rounded = (z > -reach) & (z < reach) | deep | (phi.name == "tanh")
        above, below = (
            ((rounded[:, None, :] & (side * weights.A > 0)).any(2) for side in (1, -1)) if not deep else (1, 1)
        )
        beyond = np.concatenate([most - box.hi[:q] + slack * above, box.lo[:q] - least + slack * below], 1)
        worst, k = beyond.argmax(1), np.arange(len(lo))
        row = np.concatenate([high, -low], 1)[k, worst]
        points = np.concatenate([centre, np.where(row > 0, hi, lo)])
        there = f(points)
        return signs, beyond.max(1), points, np.maximum(there - box.hi[:q], box.lo[:q] - there).max(1)

    def halve(lo, hi, signs):
        _, radius, z, reach = net.first(lo, hi)
        known = lines(phi, z - reach, z + reach, 0.0)
        gap = (known.high - known.low) * z + known.high_constant - known.low_constant
        weight = np.abs(weights.A).sum(0)
        if deep:
            weight = weight @ np.abs(weights.V)
        size = (np.maximum(gap, 0) * weight / (reach + TINY)) @ net.sizes
        return np.where(hi > lo, size * radius, -1.0).argmax(1)

    return bound, halve


def planes(found: Layer, width: int) -> tuple[np.ndarray, np.ndarray]:
    """z = H y + c in floats."""
    unit = 1 << found.bits
    H = np.array([[k / unit for k in row] for row in found.rows]).reshape(-1, width)
    return H, np.array([k / unit for k in found.constants])
