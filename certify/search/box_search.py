"""The searches behind `certify.search.box`: branch and bound over boxes, in floats.

Boxes: bound the slope by interval arithmetic (neurons surely on, surely off, free) and halve the boxes whose bound is
too high (Moore, Kearfott and Cloud, Introduction to Interval Analysis, 2009). The slope at any point bounds the
maximum from below. Where more hyperplanes meet in a point than there are coordinates, no halving decides: such a box
stays open. `certify.proofs.box_proof` proves the result.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from certify.networks.shallow import ShallowWeights
from certify.proofs.box_planes import Box, Planes, region

BATCH = 256  # boxes halved at once
BOXES = 200_000  # boxes tried
LEFT = 64  # the search ends when more boxes than this cannot be halved
SMALL = 2.0**-16  # share of the whole box's width down to which boxes are halved
REPLAYED = 30_000  # boxes whose proof is replayed in about a second
CLIMBERS = 32  # points from which the search for a high slope begins
EPS, TINY = float(np.finfo(np.float64).eps), float(np.finfo(np.float64).tiny)


class Forms(NamedTuple):
    """The planes that cross the box's interior, in floating point: slope = start + Σ gain [z > 0], gain ≥ 0."""

    H: np.ndarray  # (G, 1 + m) z = H·(x, u) + c
    c: np.ndarray  # (G,)
    side: np.ndarray  # (G,) 1, or −1 where z is minus the neuron's, so that its gain is not negative
    gain: np.ndarray  # (G,)
    start: float
    error: np.ndarray  # (G,) of z, anywhere in the box
    slack: float  # of a slope
    planes: Planes  # these alone


def forms_of(planes: Planes, box: Box) -> Forms:
    """The planes that cross a box of any number of coordinates, in floats; the others are counted in the start."""
    here = region(box)
    crossing, start = [], 0
    for g, (row, constant, above, below) in enumerate(zip(*planes[:4], strict=True)):
        least, most = here.extremes(row, constant)
        if least < 0 < most:
            crossing.append(g)
            start += min(above, below)
        else:
            start += above if least >= 0 else below
    planes = planes._replace(
        rows=[planes.rows[g] for g in crossing],
        constants=[planes.constants[g] for g in crossing],
        above=[planes.above[g] for g in crossing],
        below=[planes.below[g] for g in crossing],
    )
    unit, slope_unit = 1 << planes.z_bits, 1 << planes.slope_bits
    H = np.array([[k / unit for k in row] for row in planes.rows]).reshape(len(crossing), len(box.lo))
    c = np.array([k / unit for k in planes.constants])
    gain = np.array([(above - below) / slope_unit for above, below in zip(planes.above, planes.below, strict=True)])
    side = np.where(gain < 0, -1, 1)
    size = np.abs(H) @ np.maximum(np.abs(box.lo), np.abs(box.hi)) + np.abs(c)
    slack = (len(c) + 8) * EPS * (abs(start / slope_unit) + float(np.abs(gain).sum())) + TINY
    error = 2 * (len(box.lo) + 4) * EPS * size + TINY
    return Forms(H * side[:, None], c * side, side, np.abs(gain), start / slope_unit, error, slack, planes)


def constant(threshold: float) -> Callable[[float], float]:
    """A search's threshold that does not depend on the best value so far."""
    return lambda best: threshold


class Search:
    """Branch and bound: the tree so far, the best value so far, and the open leaves."""

    def __init__(self, threshold: Callable[[float], float], target: float, end: float):
        self.threshold = threshold  # a bound up to threshold(best) needs no further split
        self.target = target  # a best of this or more ends the search
        self.end = end  # of time
        self.best = -math.inf
        self.point: np.ndarray | None = None  # where best was reached
        self.closed = -math.inf  # the greatest bound among the leaves that were closed
        self.open = -math.inf  # and among those that were left open
        self.count = 1  # nodes
        self.halvings: list[tuple[np.ndarray, ...]] = []  # of many boxes each: nodes, tokens, first children

    def over(self) -> bool:
        return self.best >= self.target or time.perf_counter() > self.end

    def upper(self) -> float:
        return float(max(self.best, self.closed, self.open))

    def reached(self, values: np.ndarray, points: np.ndarray) -> None:
        k = int(values.argmax())
        if values[k] > self.best:
            self.best, self.point = float(values[k]), points[k].copy()

    def text(self) -> str:
        """The tree in preorder."""
        splits: dict[int, tuple[str, int]] = {}  # node: token, first child
        for nodes, names, children in self.halvings:
            splits.update(zip(nodes.tolist(), zip(names, children.tolist(), strict=True), strict=True))
        tokens, pending = [], [0]
        while pending:
            token, child = splits.get(pending.pop(), (".", 0))
            tokens.append(token)
            if child:
                pending += [child + 1, child]
        return " ".join(tokens)

    def boxes(
        self, bound: Callable, halve: Callable, climb: Callable | None, box: Box, width: int, most: int, small: float
    ) -> list[np.ndarray]:
        """Halve boxes until all are closed or the tree has `most` nodes; return bounds, lo, hi, signs, ids of the open.

        A box is not halved along a side that is at most `small` times that side of the whole box. bound(lo, hi, signs)
        gives signs, bounds, points and values there; halve(lo, hi, signs) coordinates; climb(points) values and points.
        """
        names = np.array(["x", *(f"u{j}" for j in range(1, len(box.lo)))], dtype=object)

        climbed, least = 1, small * (box.hi - box.lo)
        aside: list[list[np.ndarray]] = []

        def see(lo, hi, signs, ids):
            nonlocal climbed
            signs, bounds, points, values = bound(lo, hi, signs)
            self.reached(values, points)
            if climb and self.count >= 4 * climbed:
                climbed = self.count
                self.reached(*climb(points[np.argsort(-values)[:CLIMBERS]]))
            return [bounds, lo, hi, signs, ids]

        queue = see(box.lo[None], box.hi[None], np.zeros((1, width), np.int8), np.zeros(1, np.int64))
        while True:
            keep = queue[0] > self.threshold(self.best)
            self.closed = max(self.closed, queue[0][~keep].max(initial=-math.inf))
            queue = [x[keep] for x in queue]
            size, room = len(queue[0]), (most - self.count) // 2  # a halved box has two children
            if not size or room < 1 or sum(len(x[0]) for x in aside) > LEFT or self.over():
                return [np.concatenate(column) for column in zip(queue, *aside, strict=True)]
            now, rest, take = queue, None, min(max(BATCH, size // 4), room)
            if size > take:
                order = np.argpartition(-queue[0], take)
                now, rest = ([x[part] for x in queue] for part in (order[:take], order[take:]))
            _, lo, hi, signs, ids = now
            k, j = np.arange(len(lo)), halve(lo, hi, signs)
            below, above = lo[k, j], hi[k, j]
            middle = (below + above) / 2
            halved = (above - below > least[j]) & (below < middle) & (middle < above)
            if not halved.all():
                aside.append([x[~halved] for x in now])
                now = [x[halved] for x in now]
                if not len(now[0]):
                    queue = now if rest is None else rest
                    continue
                _, lo, hi, signs, ids = now
                k, j, middle = k[: len(lo)], j[halved], middle[halved]
            children = self.count + 2 * k
            self.halvings.append((ids, names[j], children))
            self.count += 2 * len(k)
            lower_hi, upper_lo = hi.copy(), lo.copy()
            lower_hi[k, j] = upper_lo[k, j] = middle
            ends = np.concatenate([lo, upper_lo]), np.concatenate([lower_hi, hi])
            queue = see(*ends, np.concatenate([signs, signs]), np.concatenate([children, children + 1]))
            if rest is not None:
                queue = [np.concatenate(pair) for pair in zip(queue, rest, strict=True)]


def slope_bounds(forms: Forms) -> tuple[Callable, Callable]:
    """bound() and halve() of `Search.boxes` for |slope|."""
    H, c, side, gain, start, error, slack, planes = forms
    sizes, top = np.abs(H), start + gain.sum()

    def bound(lo, hi, signs):
        centre, radius = (lo + hi) / 2, (hi - lo) / 2
        z, reach = centre @ H.T + c, radius @ sizes.T
        least, most = z - reach, z + reach
        on, off = (signs > 0) | (least >= error), (signs < 0) | (most <= -error)
        doubt = ~on & ~off & ((least >= -error) | (most <= error))
        if doubt.any():  # a hyperplane that touches the box, or nearly
            for k, g in np.argwhere(doubt):
                low, high = region(Box(lo[k], hi[k])).extremes(planes.rows[g], planes.constants[g])
                positive, negative = (low >= 0, high <= 0) if side[g] > 0 else (high <= 0, low >= 0)
                on[k, g], off[k, g] = positive, negative
        bounds = np.maximum(top - off @ gain, -start - on @ gain) + slack
        return on.astype(np.int8) - off, bounds, centre, slopes_at(forms, z)

    def halve(lo, hi, signs):
        radius = (hi - lo) / 2
        return (((signs == 0) * gain / (radius @ sizes.T + TINY) @ sizes) * radius).argmax(1)

    return bound, halve


def search_slopes(search: Search, forms: Forms, box: Box, most: int) -> None:
    """Search max |slope| in at most `most` boxes; `search` receives the tree, the best point and the bounds."""
    bound, halve = slope_bounds(forms)
    start = np.random.default_rng(0).uniform(box.lo, box.hi, (CLIMBERS, len(box.lo)))
    search.reached(*climb(forms, box, start))
    queue = search.boxes(bound, halve, lambda y: climb(forms, box, y), box, len(forms.c), most, SMALL)
    search.open = queue[0].max(initial=-math.inf)


def climb(forms: Forms, box: Box, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """|slope| and points, after three exact searches from y, `(P, 1 + m)`, along each coordinate in turn."""
    H, c, _, gain, start, *_ = forms
    P, elements = len(y), np.arange(len(y))
    for j in 3 * [*np.flatnonzero(box.lo < box.hi)]:
        h = H[:, j]
        z = y @ H.T + c
        crossed = np.where(h == 0, math.inf, y[:, j, None] - z / np.where(h == 0, 1.0, h))
        crossed = crossed.clip(box.lo[j], box.hi[j])
        order = crossed.argsort(1)
        first = start + (h < 0) @ gain + ((z > 0) & (h == 0)) @ gain
        slopes = np.concatenate([first[:, None], first[:, None] + (np.sign(h) * gain)[order].cumsum(1)], 1)
        least, most = np.full((P, 1), box.lo[j]), np.full((P, 1), box.hi[j])
        ends = np.concatenate([least, np.take_along_axis(crossed, order, 1), most], 1)
        wide = np.diff(ends) > 1e-9 * (box.hi[j] - box.lo[j])
        k = np.where(wide, np.abs(slopes), -1.0).argmax(1)
        y[elements, j] = (ends[elements, k] + ends[elements, k + 1]) / 2
    return slopes_at(forms, y @ H.T + c), y


def slopes_at(forms: Forms, z: np.ndarray) -> np.ndarray:
    """|slope| at points with these z, `(k, G)`; −∞ where rounding makes a sign uncertain."""
    return np.where((np.abs(z) > forms.error).all(1), np.abs(forms.start + (z > 0) @ forms.gain), -math.inf)


def search_range(
    search: Search, weights: ShallowWeights, box: Box, sides: tuple[tuple[float, float], ...], slack: float = 0.0
) -> None:
    """Search for the greatest σ f − o over the box and the sides (σ, o); bounds by a chord are raised by `slack`."""
    a, w1, W2, c = weights
    H = np.concatenate([w1[:, None], W2], 1)
    sizes = np.abs(H)
    size = np.abs(a) @ (sizes @ np.maximum(np.abs(box.lo), np.abs(box.hi)) + np.abs(c))
    error = 8 * (len(a) + len(box.lo) + 4) * EPS * size if len(sides) == 1 else 0.0  # two: a proof follows

    def bound(lo, hi, signs):
        centre, radius = (lo + hi) / 2, (hi - lo) / 2
        z, reach = centre @ H.T + c, radius @ sizes.T
        least, most = z - reach, z + reach
        chord = np.where(least >= 0, 1.0, np.where(most <= 0, 0.0, most / np.where(reach > 0, 2 * reach, 1.0)))
        chord = np.clip(chord, 0.0, 1.0)
        support = np.where((least >= 0) | ((most > 0) & (most > -least)), 1.0, 0.0)
        shift = np.where(least < 0, -chord * least, 0.0)
        bounds, points = [], [centre]
        for side, offset in sides:
            weight = side * a
            slope = weight * np.where(weight > 0, chord, support)
            row = slope @ H
            value = slope @ c + shift @ np.maximum(weight, 0.0) + (row * centre).sum(1) + (np.abs(row) * radius).sum(1)
            inner = (weight > 0) & (chord > 0) & (chord < 1)  # a proof rounds the slopes of these chords up
            bounds.append(value + error - offset + slack * inner.any(1))
            points.append(np.where(row > 0, hi, lo))
        places = np.concatenate(points)
        f = np.maximum(places @ H.T + c, 0.0) @ a
        values = np.max([side * f - offset for side, offset in sides], 0)
        return signs, np.max(bounds, 0), places, values

    def halve(lo, hi, signs):
        z, reach = ((lo + hi) / 2) @ H.T + c, ((hi - lo) / 2) @ sizes.T
        gap = np.abs(a) * np.maximum(reach * reach - z * z, 0.0) / (reach * reach + TINY)
        return np.where(hi > lo, (gap @ sizes) * (hi - lo), -1.0).argmax(1)

    search.open = search.boxes(bound, halve, None, box, 0, BOXES, 0.0)[0].max(initial=-math.inf)
