"""The rate of a network with a vector state on an operating box, and whether it keeps the state inside.

    x⁺ = f(x, u) of `certify.networks.vector`,  (x, u) in a box of q + m intervals
    K = sup ‖T J(x, u) T⁻¹‖_∞  over the box, or in the 1-norm,  J = ∂f/∂x

K is the least rate with ‖T(f(x, u) − f(x′, u))‖ ≤ K ‖T(x − x′)‖ for all x, x′ and u of the box, since a box is
convex. A search halves the box where its bound is too high (`certify.search.vector_box_search`, in floats).
`certify.proofs.vector_box_proof` computes the bound of every leaf again, in integers; `certify.proofs.vector_points`
the norm at a witness. Where more hyperplanes of relu meet in a point than there are coordinates, halving does not end,
and the verdict can be "unknown".
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from certify.errors import CertifyError
from certify.networks.vector import Activation, VectorWeights, check
from certify.proofs.box_planes import Box
from certify.proofs.rounding import float_above, float_below
from certify.proofs.vector_box_proof import bound, coordinates, proves_range, usual
from certify.proofs.vector_exact import NORMS, Matrix
from certify.proofs.vector_points import norm_at, value_at
from certify.proofs.vector_statements import Range, slopes_on
from certify.search.box_search import BOXES, CLIMBERS, REPLAYED, Search, constant
from certify.search.vector_box_search import Floats, range_bounds

LARGEST = 1e60  # a weight or an end of the box; products of a few are floats
SMALL = 2.0**-24  # share of the whole box's width down to which boxes are halved
SAMPLES = 2000  # points at which the norm is computed before the search
QUIET = np.errstate(all="ignore")  # numbers near the ends of a float's range; every claim is checked in integers


class VectorWitness(NamedTuple):
    """A point of the box, and the norm of the Jacobian there."""

    x: np.ndarray  # (q,)
    u: np.ndarray  # (m,)
    norm: float  # of T J T⁻¹, rounded down; computed exactly, with tanh from rigorous bounds


class VectorRate(NamedTuple):
    """A bracket of K."""

    lower: float  # the norm at the witness
    upper: float  # proved by the tree
    witness: VectorWitness | None  # None only where lower is 0
    tree: str  # for vector_box_proof.bound
    seconds: float


class VectorBoxVerdict(NamedTuple):
    """Whether K < rate on the box, and whether f maps the box into its intervals of x."""

    verdict: str  # "certified" (the tree proves it), "refuted" (the witness has a norm ≥ rate) or "unknown"
    rate: float  # the rate asked for
    lower: float  # of K
    upper: float
    witness: VectorWitness | None  # of lower
    tree: str | None  # for vector_box_proof.proves
    invariant: str  # "yes" (its tree proves it), "no" (f leaves at escape) or "unknown"
    invariance_tree: str | None  # for vector_box_proof.proves_range
    escape: np.ndarray | None  # (q + m,)
    seconds: float


@QUIET
def certify(
    weights: VectorWeights,
    phi: Activation,
    box: Box,
    rate: float = 1.0,
    norm: str = "inf",
    scaling: Matrix | None = None,
    seconds: float = 10.0,
) -> VectorBoxVerdict:
    """Whether K < rate on the box, and whether the box is forward invariant.

    A rate on a box says something about trajectories only if they stay in it.

    Args:
        weights: of one network, see `certify.networks.vector.check`.
        phi: its activation.
        box: `(q + m,)`, the intervals of x and u; every component of x has a width.
        rate: the rate asked for, no unit.
        norm: "inf" or "one".
        scaling: T, `(q, q)` fractions; the identity by default.
        seconds: about how long to search and to prove, s; the replay of a long tree takes some seconds more.

    Returns:
        The verdict on the rate, with its proof or its witness; and whether the box is forward invariant.

    Raises:
        CertifyError: a box, a rate, a norm or a scaling that does not fit.

    >>> from certify.networks.vector import RELU, VectorWeights
    >>> net = VectorWeights(None, [[0.5, 0.0], [0.25, 0.5]], [[1.0, 0.0], [0.0, 1.0]], [[0.0], [0.0]], [0.0, 0.0])
    >>> over = Box(np.array([0.0, 0.0, -1.0]), np.ones(3))
    >>> [certify(net, RELU, over, rate).verdict for rate in (1.0, 0.75)]
    ['certified', 'refuted']
    """
    started = time.perf_counter()
    weights = _checked(weights, box, norm)
    if not (rate > 0 and math.isfinite(rate)):
        raise CertifyError(f"rate: found {rate}, expected a number above 0")
    end = started + 0.6 * seconds
    verdict, tree, best, upper = "unknown", None, None, math.inf
    for lean in (1.0, -1.0):  # the replay tells whether hyperplanes that touch a leaf up to rounding cross it
        threshold = constant(rate * (1 - 1e-13))
        seen, search, text, proved = _search(weights, phi, box, norm, scaling, threshold, rate, end, lean)
        best = seen if best is None or (seen and seen[0] > best[0]) else best
        if best is not None and best[0] >= Fraction(rate):
            verdict = "refuted"
        upper = min(upper, _above(proved))
        if verdict == "unknown" and proved is not None and proved < Fraction(rate):
            verdict, tree = "certified", text
        if verdict != "unknown" or search.open > -math.inf:
            break
    invariant, invariance_tree, escape = invariance(weights, phi, box, started + seconds - time.perf_counter())
    lower, witness = _witness(best, len(weights.R))
    took = time.perf_counter() - started
    return VectorBoxVerdict(
        verdict, float(rate), lower, upper, witness, tree, invariant, invariance_tree, escape, took
    )  # fmt: skip


@QUIET
def rate(
    weights: VectorWeights,
    phi: Activation,
    box: Box,
    norm: str = "inf",
    scaling: Matrix | None = None,
    gap: float = 1e-3,
    seconds: float = 10.0,
) -> VectorRate:
    """K on a box as a bracket.

    Args:
        weights: of one network, see `certify.networks.vector.check`.
        phi: its activation.
        box: `(q + m,)`, the intervals of x and u; every component of x has a width.
        norm: "inf" or "one".
        scaling: T, `(q, q)` fractions; the identity by default.
        gap: relative width of the bracket at which to stop, no unit.
        seconds: about how long to search, s; the replay of a long tree takes some seconds more.

    Returns:
        The bracket, a point where the lower end is reached, the tree that proves the upper end, and how long it took.

    Raises:
        CertifyError: a box, a norm or a scaling that does not fit.

    >>> from certify.networks.vector import RELU, VectorWeights
    >>> net = VectorWeights(None, [[0.5, 0.0], [0.25, 0.5]], [[1.0, 0.0], [0.0, 1.0]], [[0.0], [0.0]], [0.0, 0.0])
    >>> found = rate(net, RELU, Box(np.array([0.0, 0.0, -1.0]), np.ones(3)))
    >>> found.lower, found.upper
    (0.75, 0.75)
    """
    started = time.perf_counter()
    weights = _checked(weights, box, norm)
    end = started + 0.6 * seconds

    def threshold(best: float) -> float:
        return best + gap * max(best, 0.0)

    seen, _, text, proved = _search(weights, phi, box, norm, scaling, threshold, math.inf, end, 1.0)
    upper, plain = _above(proved), _above(bound(weights, phi, box, ".", norm, scaling))
    if plain <= upper:
        upper, text = plain, "."
    lower, witness = _witness(seen, len(weights.R))
    return VectorRate(lower, upper, witness, text, time.perf_counter() - started)


@QUIET
def invariance(
    weights: VectorWeights, phi: Activation, box: Box, seconds: float = 3.0
) -> tuple[str, str | None, np.ndarray | None]:
    """Whether f maps the box into its intervals of x.

    Args:
        weights: of one network, see `certify.networks.vector.check`.
        phi: its activation.
        box: `(q + m,)`, the intervals of x and u.
        seconds: about how long to search and to prove, s; the replay of a long tree takes some seconds more.

    Returns:
        "yes", its proof and None; "no", None and a point `(q + m,)` that leaves the intervals; or "unknown", None,
        None.

    Raises:
        CertifyError: a box that does not fit.

    >>> from certify.networks.vector import RELU, VectorWeights
    >>> identity = VectorWeights(None, [[1.0]], [[1.0]], np.zeros((1, 0)), [0.0])
    >>> invariance(identity, RELU, Box(np.zeros(1), np.ones(1)))
    ('yes', '.', None)
    """
    weights = _checked(weights, box, "inf")
    q, end = len(weights.R), time.perf_counter() + max(seconds, 0.0)
    ends = [(Fraction(float(lo)), Fraction(float(hi))) for lo, hi in zip(box.lo[:q], box.hi[:q], strict=True)]
    small = 1e-12 * (1 + float(np.abs(box.lo[:q]).max() + np.abs(box.hi[:q]).max()))
    most = min(Range(weights, phi, box).nodes, BOXES)
    for margin, slack in ((0.0, 0.0), (0.0, small), (small, 0.0)):  # rounding may hide that a leaf is just open
        bounds, halve = range_bounds(weights, phi, box, slack)
        search = Search(constant(-margin), small, end)
        left = search.boxes(bounds, halve, None, box, 0, most, 0.0)[0]
        if search.point is not None:
            values = value_at(weights, phi, search.point)
            if any(low > hi or high < lo for (low, high), (lo, hi) in zip(values, ends, strict=True)):
                return "no", None, search.point
        if not len(left) and proves_range(weights, phi, box, text := _text(search, q, box)):
            return "yes", text, None
    return "unknown", None, None


def _search(
    weights: VectorWeights,
    phi: Activation,
    box: Box,
    norm: str,
    scaling: Matrix | None,
    threshold: Callable[[float], float],
    target: float,
    end: float,
    lean: float,
) -> tuple[tuple[Fraction, np.ndarray] | None, Search, str, Fraction | None]:
    """The best point with its exact norm, the search, its tree, and the bound that the tree proves."""
    net, rng = Floats(weights, phi, box, norm, scaling, lean), np.random.default_rng(0)
    search = Search(threshold, target, end)
    points = rng.uniform(box.lo, box.hi, (SAMPLES, len(box.lo))).clip(box.lo, box.hi)
    order = np.argsort(-net.at(points))[:CLIMBERS]

    def climb(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return net.climb(y, box, rng)

    search.reached(*climb(points[order]))
    nodes = slopes_on(weights, phi, box, norm, scaling).nodes
    most = min(nodes, max(int(REPLAYED * (end - time.perf_counter())), 1), BOXES)
    search.open = search.boxes(net.bound, net.halve, climb, box, 0, most, SMALL)[0].max(initial=-math.inf)
    seen = None
    if search.point is not None and (exact := norm_at(weights, phi, search.point, norm, scaling)) is not None:
        seen = exact, search.point
    kept = search.count
    while True:
        text = _text(search, len(weights.R), box, kept)
        proved = bound(weights, phi, box, text, norm, scaling)
        if proved is not None or kept == 1:
            return seen, search, text, proved
        kept //= 2  # the replay takes too long; what was halved first is a tree, too


def _text(search: Search, q: int, box: Box, count: float = math.inf) -> str:
    """The tree of the first `count` nodes, or one less, with the names of this network's coordinates."""
    width = len(box.lo)
    names = dict(zip(coordinates(1, width - 1), coordinates(q, width - q), strict=True))
    return " ".join(names.get(token, token) for token in search.text(count).split())


def _witness(seen: tuple[Fraction, np.ndarray] | None, q: int) -> tuple[float, VectorWitness | None]:
    lower = 0.0 if seen is None else max(float_below(seen[0]), 0.0)
    if seen is None or not lower:
        return lower, None
    return lower, VectorWitness(seen[1][:q], seen[1][q:], lower)


def _above(proved: Fraction | None) -> float:
    """A proved bound, rounded up; infinite where nothing is proved."""
    return math.inf if proved is None else float_above(proved)


def _checked(weights: VectorWeights, box: Box, norm: str) -> VectorWeights:
    weights = check(weights)
    if np.ndim(weights.b) != 1:
        raise CertifyError(f"weights: found a batch {weights.b.shape[:-1]}, expected one network")
    greatest = max(float(np.abs(x).max(initial=0.0)) for x in (*weights, *box) if x is not None)
    if greatest > LARGEST:
        raise CertifyError(
            f"weights or box: found a value of size {greatest:.3g}, expected at most {LARGEST}: rescale the network"
        )
    q, m = len(weights.R), weights.W2.shape[1]
    if not usual(weights, box):
        raise CertifyError(
            f"box: found {len(box.lo)} intervals, expected q + m = {q} + {m}, finite, with lo ≤ hi, and lo < hi for x"
        )
    if norm not in NORMS:
        raise CertifyError(f"norm: found {norm!r}, expected {' or '.join(NORMS)}")
    return weights
