"""The search of `certify.search.box` for the greatest slope by linear programs, for boxes of many coordinates.

In a cell some z_i ("parted") have known signs and the others ("free") any. On each side of the slope planes are turned
so that z_i > 0 adds a gain g_i ≥ 0. With L_i = min z_i < 0 over the box, free planes and parted ones (on, off) satisfy

    g_i [z_i > 0] ≤ g_i + μ_i z_i,  0 ≤ μ_i ≤ g_i/|L_i|;        0 ≤ μ_i z_i,  μ_i ≥ 0 (on) or μ_i ≤ 0 (off)       (1)
    slope ≤ start + Σ_{free, on} g_i + min_μ max_box Σ μ_i z_i                                                   (2)

since g_i + μ_i z_i ≥ g_i where z_i > 0, and ≥ g_i − μ_i |L_i| ≥ 0 elsewhere. μ = 0 is interval arithmetic. The minimum
is the dual of max Σ_free g_i min(1, 1 + z_i/|L_i|) over the cell: a linear program with a row for each coordinate,

    min Σ_i μ_i z_i(centre) + Σ_j |Σ_i μ_i h_ij| r_j,    r: half the box's widths                                    (3)

A split at a plane changes the limits of one μ_i, so the solver starts at its parent's basis. Any μ within its limits is
a bound, so that the solver's tolerances are harmless; `certify.proofs.box_proof` proves it with μ rounded to few
digits. The solver is HiGHS; without the package `highspy` the search is that of `certify.search.box_cells`.
"""

from __future__ import annotations

import heapq
import itertools
import math
from typing import Any, NamedTuple

import numpy as np

from certify.proofs.box_planes import Box
from certify.search.box_cells import inner_point
from certify.search.box_search import EPS, Forms, Search, climb, slopes_at

CAP = 100.0  # the largest μ tried, in the solver's units
STARTS = 256  # points from which the search for a high slope begins
ROUNDED = 5  # a high slope is sought from the point of every fifth program
CLIMBED = 16  # and by climbing after so many such points
WHOLE = 1e-7  # a plane's share below which it counts as on, and above one minus which as off
FINEST = 60  # bits to which multipliers are rounded at most


def installed() -> bool:
    """Whether the solver can be imported."""
    try:
        import highspy  # noqa: F401
    except ImportError:
        return False
    return True


class Solution(NamedTuple):
    """The solution of (3) in a cell."""

    excess: float  # (3), an upper bound also for a μ that is not optimal, with rounding
    mu: np.ndarray  # (G,) of the forms turned to the side
    v: np.ndarray  # (d,) the point of the cell, in −1 … 1 over the box
    basis: Any  # to start from


class Side:
    """One side of the slope on a box, and its linear program: the greatest slope, or minus the least.

    The solver's unknowns are q_i = μ_i ρ_i / g, with ρ_i half the range of z_i on the box and g the largest gain.
    """

    def __init__(self, forms: Forms, box: Box, sign: int):
        from highspy import Highs, HighsLp, MatrixFormat, kHighsInf

        self.sign = sign
        self.gain, self.unit = forms.gain, float(forms.gain.max())
        self.start = forms.start if sign > 0 else -forms.start - float(forms.gain.sum())
        centre, radius = (box.lo + box.hi) / 2, (box.hi - box.lo) / 2
        rows, heights = sign * forms.H * radius, sign * (forms.H @ centre + forms.c)
        self.reach = np.abs(rows).sum(1)
        self.rows, self.heights = rows / self.reach[:, None], heights / self.reach
        self.floor = np.minimum(self.heights - 1, 0.0) - forms.error / self.reach  # L_i below rounding
        self.most = np.minimum(self.gain / self.unit / -self.floor, CAP)  # g_i/|L_i|
        G, d = self.rows.shape
        self.rounding = (G + d + 8) * (forms.error / self.reach + 4 * EPS) * self.unit  # of (3), for each q_i
        self.solver, self.columns = Highs(), np.arange(G, dtype=np.int32)
        program = HighsLp()
        program.num_col_, program.num_row_ = G + 2 * d, d
        program.col_cost_ = np.r_[self.heights, np.ones(2 * d)]
        program.col_lower_, program.col_upper_ = np.zeros(G + 2 * d), np.r_[self.most, np.full(2 * d, kHighsInf)]
        program.row_lower_ = program.row_upper_ = np.zeros(d)
        program.a_matrix_.format_ = MatrixFormat.kColwise
        program.a_matrix_.start_ = np.r_[np.arange(0, d * G + 1, d), d * G + 1 + np.arange(2 * d)]
        program.a_matrix_.index_ = np.r_[np.tile(np.arange(d), G), np.arange(d), np.arange(d)]
        program.a_matrix_.value_ = np.r_[self.rows.ravel(), -np.ones(d), np.ones(d)]
        for option, value in (("output_flag", False), ("presolve", "off"), ("solver", "simplex"), ("parallel", "off")):
            self.solver.setOptionValue(option, value)
        self.solver.passModel(program)

    def solve(self, signs: np.ndarray, basis: Any) -> Solution | None:
        """(3) with the signs of the parted planes on this side, `(G,)`, 0 where free; None where the solver fails."""
        from highspy import HighsModelStatus

        lower = np.where(signs < 0, -CAP, 0.0)
        upper = np.where(signs > 0, CAP, np.where(signs < 0, 0.0, self.most))
        if basis is not None:
            self.solver.setBasis(basis)
        self.solver.changeColsBounds(len(self.columns), self.columns, lower, upper)
        self.solver.run()
        if self.solver.getModelStatus() != HighsModelStatus.kOptimal:
            return None
        found = self.solver.getSolution()
        q = np.clip(found.col_value[: len(self.columns)], lower, upper)
        v = np.clip(-np.array(found.row_dual), -1, 1)
        return Solution(self.excess(q), q * self.unit / self.reach, v, self.solver.getBasis())

    def excess(self, q: np.ndarray) -> float:
        """(3), rounded upwards."""
        value = q @ self.heights + np.abs(q @ self.rows).sum()
        return float(value * self.unit + np.abs(q) @ self.rounding)


class Node(NamedTuple):
    """A cell that is open on one side."""

    name: int  # in the tree
    side: Side
    signs: np.ndarray  # (G,) of the parted planes, turned to the side; 0 where free
    v: np.ndarray
    basis: Any


def search_duals(search: Search, forms: Forms, box: Box, rng: np.random.Generator) -> bool:
    """Search max |slope| over the cells of the whole box, the highest bound first, each side in its own subtree.

    False, with nothing done, if the planes' numbers are too small or too large for the programs.
    """
    sides = [Side(forms, box, sign) for sign in (1, -1)]
    if not all(np.isfinite(x).all() for side in sides for x in (side.rows, side.heights, side.most, side.rounding)):
        return False
    search.reached(*climb(forms, box, rng.uniform(box.lo, box.hi, (STARTS, len(box.lo)))))
    search.splits[0] = "s", 1
    search.count += 2
    _Cells(search, forms, box, rng).run(sides)
    return True


class _Cells:
    def __init__(self, search: Search, forms: Forms, box: Box, rng: np.random.Generator):
        self.search, self.forms, self.box, self.rng = search, forms, box, rng
        self.heap: list[tuple[float, int, Node]] = []
        self.tie, self.stuck, self.popped = itertools.count(), -math.inf, 0
        self.seen: list[np.ndarray] = []  # points of programs, from which to climb

    def run(self, sides: list[Side]) -> None:
        search, signs, v = self.search, np.zeros(len(self.forms.c), np.int8), np.zeros(len(self.box.lo))
        for k, side in enumerate(sides):
            self.enter(Node(1 + k, side, signs, v, None), math.inf)
        while self.heap and not search.over():
            bound, _, node = heapq.heappop(self.heap)
            if -bound <= search.threshold(search.best):
                search.closed = max(search.closed, -bound)
                self.heap.clear()  # the others' bounds are no higher
                break
            side = node.side
            z = side.heights + side.rows @ node.v
            share = np.where(node.signs == 0, np.clip(z / side.floor, 0, 1), 0.0)  # by which a free plane is off
            score = side.gain * share * (1 - share)
            if self.popped % ROUNDED == 0:
                self.climb_from(node, z)
            self.popped += 1
            if score.max() > WHOLE * side.unit:
                self.split(node, int(score.argmax()), -bound)
            else:
                self.settle(node, (node.signs > 0) | ((node.signs == 0) & (share < 0.5)), -bound)
        search.open = max(self.stuck, -self.heap[0][0] if self.heap else -math.inf)

    def split(self, node: Node, g: int, bound: float) -> None:
        """Both cells of a split at a plane."""
        for child in self.parted(node, g):
            self.enter(child, bound)

    def parted(self, node: Node, g: int) -> list[Node]:
        """The cells z_g < 0 and z_g > 0, z of the neuron, in the order of the tree."""
        search, forms = self.search, self.forms
        name, turned = search.count, int(node.side.sign * forms.side[g])
        search.splits[node.name] = f"z{forms.planes.neuron[g]}", name
        search.count += 2
        children = []
        for k, sign in enumerate((-turned, turned)):
            signs = node.signs.copy()
            signs[g] = sign
            children.append(node._replace(name=name + k, signs=signs))
        return children

    def enter(self, node: Node, parent: float) -> None:
        """Bound a cell; keep it if it stays open."""
        search, side = self.search, node.side
        top = side.start + float(side.gain[node.signs >= 0].sum()) + self.forms.slack
        limit = search.threshold(search.best)
        if top <= limit:
            search.closed = max(search.closed, top)
            return
        found = side.solve(node.signs, node.basis)
        bound = min(parent, top)
        if found is not None:
            if top + found.excess <= limit:
                if not search.proof or self.written(node, found.mu, top, limit):
                    search.closed = max(search.closed, top + found.excess)
                    return
            else:
                bound = min(bound, top + found.excess)
            node = node._replace(v=found.v, basis=found.basis)
        heapq.heappush(self.heap, (-bound, next(self.tie), node))

    def written(self, node: Node, mu: np.ndarray, top: float, limit: float) -> bool:
        """Keep the multipliers as integers over a power of two, as few bits as bound the slope by the limit."""
        side, found = node.side, self.forms.planes
        largest = float(np.abs(mu).max())
        if not (0 < largest < math.inf):
            return False
        for bits in range(6, FINEST, 6):
            scale = bits - math.frexp(largest)[1]
            if not -1000 < scale < 1000:
                return False
            whole = np.trunc(np.ldexp(mu, scale))
            if top + side.excess(np.ldexp(whole, -scale) * side.reach / side.unit) <= limit:
                turned = side.sign * self.forms.side
                pairs = [
                    f"{found.neuron[g]}:{int(turned[g] * whole[g]) << max(-scale, 0)}" for g in np.flatnonzero(whole)
                ]
                self.search.leaves[node.name] = ",".join([f"d{1 << max(scale, 0)}", *pairs])
                return True
        return False

    def settle(self, node: Node, on: np.ndarray, bound: float) -> None:
        """A cell in whose program every plane is on or off: find a point where the same are on, or that there is none.

        A point that reaches the bound closes the cell. If there is none, planes that exclude each other are split
        one by one, until the last cell is excluded and the others are bounded by the planes that are off there.
        """
        search, forms, side = self.search, self.forms, node.side
        turned = side.sign * forms.side
        cell = [
            (int(g), int(side.sign if node.signs[g] >= 0 else -side.sign))
            for g in np.flatnonzero(on | (node.signs < 0))
        ]
        point, excluding = inner_point(forms, self.box.lo, self.box.hi, tuple(cell), self.rng)
        if excluding:
            for g in sorted(excluding, key=lambda g: -side.gain[g]):
                if node.signs[g] == 0:
                    first, second = self.parted(node, g)
                    node, other = (second, first) if turned[g] > 0 else (first, second)
                    self.enter(other, bound)
            found = forms.planes.neuron
            search.leaves[node.name] = "e" + ",".join(f"{found[g]}:{mu}" for g, mu in excluding.items())
            return
        if point is not None:
            z = forms.H @ point + forms.c
            search.reached(slopes_at(forms, z[None]), point[None])
            if bound <= search.threshold(search.best):
                heapq.heappush(self.heap, (-bound, next(self.tie), node))
                return
            off = np.where((node.signs == 0) & (side.sign * z <= forms.error), side.gain, 0.0)
            if off.any():
                return self.split(node, int(off.argmax()), bound)
        self.stuck = max(self.stuck, bound)

    def climb_from(self, node: Node, z: np.ndarray) -> None:
        """Step off the planes through a program's point to the sides where they are on; climb from many such points."""
        side, v = node.side, node.v
        at, ends = np.abs(z) < WHOLE, np.abs(v) > 1 - WHOLE
        inward = np.concatenate([np.where(node.signs[at] < 0, -1.0, 1.0)[:, None] * side.rows[at], -np.diag(v)[ends]])
        step = np.linalg.lstsq(inward, np.ones(len(inward)), rcond=None)[0] if len(inward) else np.zeros_like(v)
        with np.errstate(divide="ignore", invalid="ignore"):
            crossed = np.r_[-z / (side.rows @ step), (np.sign(step) - v) / step][~np.r_[at, ends]]
        length = crossed[crossed > 0].min(initial=1.0) / 2
        point = np.clip(
            (self.box.lo + self.box.hi) / 2 + (self.box.hi - self.box.lo) / 2 * (v + length * step), *self.box
        )
        self.search.reached(slopes_at(self.forms, (self.forms.H @ point + self.forms.c)[None]), point[None])
        self.seen.append(point)
        if len(self.seen) == CLIMBED:
            self.search.reached(*climb(self.forms, self.box, np.array(self.seen)))
            self.seen.clear()
