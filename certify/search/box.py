"""The exact contraction rate of a shallow ReLU network on an operating box, and whether it keeps x inside.

    x⁺ = f(x, u) = aᵀ relu(z),  z = w₁ x + W₂ u + b,  s_i = a_i w_{1i},  (x, u) in a box
    K_box = max |Σ_{z_i > 0} s_i|  over the open cells, z_i ≠ 0 where s_i ≠ 0, that meet the box       (1)

At fixed u each z_i with s_i ≠ 0 changes sign at one x. So every slope of x ↦ f(x, u) belongs to an open cell, K_box is
the least rate with |f(x₁, u) − f(x₂, u)| ≤ K_box |x₁ − x₂| on the box. A cell whose closure only touches the box does
not count. An input of zero width is fixed: cells are then open in x and the other inputs. x itself has a width.

`certify.search.box_search` searches; `certify.proofs.box_proof` proves the result, in integers. With many inputs, and
where hyperplanes meet in a point, the bracket of `rate` may stay open, and `certify` may answer "unknown".
"""

from __future__ import annotations

import math
import time
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights, check
from certify.proofs.box_planes import Box, planes, slope_at, value_at
from certify.proofs.box_proof import proves, proves_range
from certify.proofs.rounding import float_below
from certify.search.box_search import BOXES, REPLAYED, Search, constant, forms_of, search_range, search_slopes

LARGEST = 1e60  # a weight or an end of the box; products of a few are floats

QUIET = np.errstate(all="ignore")  # numbers near the ends of a float's range; every claim is checked in integers


class Witness(NamedTuple):
    """A point of the box, and the slope there, computed exactly."""

    x: float
    u: np.ndarray  # (m,)
    active: np.ndarray  # (n,) bool, z_i > 0
    slope: float  # dx⁺/dx, rounded towards 0, so that its size is reached


class BoxRate(NamedTuple):
    """A bracket of K_box.

    >>> fold = ShallowWeights(np.array([0.5, 0.5]), np.array([1.0, -1.0]), np.zeros((2, 0)), np.array([-0.5, 0.5]))
    >>> bracket = rate(fold, operating_box(0))
    >>> bracket.closed, bracket.lower <= 0.5 <= bracket.upper
    (True, True)
    """

    lower: float  # the slope at the witness, no unit
    upper: float  # proved with outward rounding, no unit
    witness: Witness | None  # None only where lower is 0
    closed: bool  # whether the gap is as small as asked
    nodes: int  # number of boxes that were looked at
    seconds: float  # wall time, s


class BoxVerdict(NamedTuple):
    """Whether |slope| < rate on the box, and whether f maps the box into its interval of x.

    >>> half = ShallowWeights(np.array([0.5]), np.array([1.0]), np.zeros((1, 0)), np.zeros(1))
    >>> result = certify(half, operating_box(0), rate=0.75)
    >>> result.verdict, result.invariant, result.lower
    ('certified', 'yes', 0.5)
    """

    verdict: str  # "certified" (the tree proves it), "refuted" (the witness has |slope| ≥ rate) or "unknown"
    rate: float  # the rate asked for, no unit
    lower: float  # of K_box, no unit
    upper: float  # of K_box, no unit
    witness: Witness | None  # of lower
    tree: str | None  # for box_proof.proves
    invariant: str  # "yes" (its tree proves it), "no" (f leaves at escape) or "unknown"
    invariance_tree: str | None  # for box_proof.proves_range
    escape: np.ndarray | None  # (1 + m,)
    seconds: float  # wall time, s


def box(given: Any, m: int) -> Box:
    """A box for a network of m inputs, from `lo:hi` of x, u₁ … u_m separated by commas, or from pairs."""
    parts = [part.split(":") for part in given.split(",")] if isinstance(given, str) else list(given)
    names = ["x", *(f"u{j}" for j in range(1, m + 1))]
    if len(parts) != len(names):
        raise CertifyError(
            f"box: found {len(parts)} intervals, expected {len(names)}: give lo:hi of {', '.join(names)}, with commas"
        )
    ends = []
    for name, part in zip(names, parts, strict=True):
        try:
            lo, hi = map(float, part)
        except (TypeError, ValueError):
            text = ":".join(map(str, part)) if isinstance(part, list | tuple) else part
            raise CertifyError(f"box: found {text!r} for {name}, expected two numbers, as in 0:1") from None
        if not (math.isfinite(lo) and math.isfinite(hi)):
            raise CertifyError(f"box: found {lo}:{hi} for {name}, expected finite numbers")
        if lo > hi:
            raise CertifyError(f"box: found {lo}:{hi} for {name}, expected lo ≤ hi: exchange them")
        if name == "x" and lo == hi:
            raise CertifyError(f"box: found {lo}:{hi} for {name}, expected lo < hi: a rate compares two states")
        ends.append((lo + 0.0, hi + 0.0))
    lo, hi = np.array(ends).T
    return Box(lo.copy(), hi.copy())


def operating_box(m: int) -> Box:
    """x in [0, 1], and the inputs' box: heading as (½ + ½ sin, ½ + ½ cos) and two commands if m = 4, else [−1, 1]ᵐ."""
    lo = np.full(1 + m, -1.0)
    lo[: 3 if m == 4 else 1] = 0.0
    return Box(lo, np.ones(1 + m))


@QUIET
def rate(weights: ShallowWeights, box: Box, gap: float = 1e-6, seconds: float = 10.0) -> BoxRate:
    """K_box of one network, (1), as a bracket.

    Args:
        weights: arrays without a batch.
        box: of the network's x and inputs.
        gap: relative width of the bracket at which to stop, no unit.
        seconds: s after which to stop with the bracket reached so far.

    Returns:
        The bracket, a point where the lower end is reached, and how long it took.

    Raises:
        CertifyError: weights that are no network, or a box that does not fit them.

    >>> fold = ShallowWeights(np.array([0.5, 0.5]), np.array([1.0, -1.0]), np.zeros((2, 0)), np.array([-0.5, 0.5]))
    >>> rate(fold, operating_box(0)).lower
    0.5
    """
    started = time.perf_counter()
    weights = _checked(weights, box)
    forms = forms_of(planes(weights, box), box)
    search = Search(lambda best: best + max(gap * best, forms.slack), math.inf, started + seconds)
    search_slopes(search, forms, box, 10 * BOXES)
    seen = _witness(weights, search.point)
    lower = abs(seen.slope) if seen else 0.0
    upper = max(search.upper(), lower)
    closed = upper - lower <= gap * upper + 2 * forms.slack
    return BoxRate(lower, upper, seen if lower else None, closed, search.count, time.perf_counter() - started)


@QUIET
def certify(weights: ShallowWeights, box: Box, rate: float = 1.0, seconds: float = 10.0) -> BoxVerdict:
    """Whether |slope| < rate everywhere on the box, decided exactly, and whether the box is forward invariant.

    A rate on a box says something about trajectories only if they stay in it.

    Args:
        weights: arrays without a batch.
        box: of the network's x and inputs.
        rate: the rate asked for, no unit.
        seconds: about how long to search and to prove, s.

    Returns:
        The verdict on the rate, with its proof or its witness; and whether the box is forward invariant.

    Raises:
        CertifyError: weights that are no network, a box that does not fit them, or a rate that is not above 0.

    >>> half = ShallowWeights(np.array([0.5]), np.array([1.0]), np.zeros((1, 0)), np.zeros(1))
    >>> certify(half, operating_box(0)).verdict, certify(half, operating_box(0), rate=0.5).verdict
    ('certified', 'refuted')
    """
    started = time.perf_counter()
    weights = _checked(weights, box)
    if not (rate > 0 and math.isfinite(rate)):
        raise CertifyError(f"rate: found {rate}, expected a number above 0")
    forms = forms_of(planes(weights, box), box)
    search = Search(constant(np.nextafter(float(rate), 0.0)), float(rate), started + 0.7 * seconds)
    search_slopes(search, forms, box, int(REPLAYED * seconds))
    seen = _witness(weights, search.point)
    lower, upper = abs(seen.slope) if seen else 0.0, search.upper()
    verdict, tree = "unknown", None
    slope = None if search.point is None else slope_at(weights, search.point)
    if slope is not None and abs(slope) >= Fraction(rate):
        verdict = "refuted"
    elif search.open == -math.inf:
        text = search.text()
        if proves(weights, box, text, rate):
            verdict, tree = "certified", text
    invariant, invariance_tree, escape = invariance(weights, box, started + seconds - time.perf_counter())
    took = time.perf_counter() - started
    bounds = lower, max(lower, upper)
    return BoxVerdict(verdict, float(rate), *bounds, seen, tree, invariant, invariance_tree, escape, took)


@QUIET
def invariance(weights: ShallowWeights, box: Box, seconds: float = 3.0) -> tuple[str, str | None, np.ndarray | None]:
    """Whether f maps the box into its interval of x.

    Args:
        weights: arrays without a batch.
        box: of the network's x and inputs.
        seconds: about how long to search and to prove, s.

    Returns:
        "yes", its proof and None; "no", None and a point `(1 + m,)` that leaves the interval; or "unknown", None, None.

    Raises:
        CertifyError: weights that are no network, or a box that does not fit them.

    >>> identity = ShallowWeights(np.ones(1), np.ones(1), np.zeros((1, 0)), np.zeros(1))
    >>> invariance(identity, operating_box(0))
    ('yes', '.', None)
    """
    weights = _checked(weights, box)
    end = time.perf_counter() + max(seconds, 0.0)
    lo, hi = float(box.lo[0]), float(box.hi[0])
    small = 1e-12 * (1 + max(abs(lo), abs(hi)))
    for margin, slack in ((0.0, 0.0), (0.0, small), (small, 0.0)):  # rounding may hide that a leaf is just open
        search = Search(constant(-margin), small, end)
        search_range(search, weights, box, ((1.0, hi), (-1.0, -lo)), slack)
        if search.point is not None and not Fraction(lo) <= value_at(weights, search.point) <= Fraction(hi):
            return "no", None, search.point
        if search.open == -math.inf and proves_range(weights, box, text := search.text()):
            return "yes", text, None
    return "unknown", None, None


def _witness(weights: ShallowWeights, point: np.ndarray | None) -> Witness | None:
    if point is None or (slope := slope_at(weights, point)) is None:
        return None
    active = weights.w1 * point[0] + weights.W2 @ point[1:] + weights.b > 0
    return Witness(float(point[0]), point[1:], active, math.copysign(float_below(abs(slope)), slope))


def _checked(weights: ShallowWeights, box: Box) -> ShallowWeights:
    weights = check(weights)
    greatest = max(float(np.abs(x).max(initial=0.0)) for x in (*weights, *box))
    if greatest > LARGEST:
        raise CertifyError(
            f"weights or box: found a value of size {greatest:.3g}, expected at most {LARGEST}: rescale the network"
        )
    if weights.a.ndim != 1:
        raise CertifyError(f"weights: found a batch {weights.a.shape[:-1]}, expected one network")
    if len(box.lo) != 1 + weights.W2.shape[1]:
        raise CertifyError(
            f"box: found {len(box.lo)} intervals, expected 1 + m = {1 + weights.W2.shape[1]}: x and inputs"
        )
    return weights
