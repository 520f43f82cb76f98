"""How far apart two trajectories can be whose weights differ: a network that learns while it runs.

Two runs x_{k+1} = f(x_k, u_k; θ_k) and x'_{k+1} = f(x'_k, u_k; θ'_k) have equal inputs. θ_k contracts at the rate
κ_k. With Δ_k = x_k − x'_k and δ_k = ‖θ_k − θ'_k‖₂,

    ‖Δ_{k+1}‖ ≤ ‖f(x_k; θ_k) − f(x'_k; θ_k)‖ + ‖f(x'_k; θ_k) − f(x'_k; θ'_k)‖ ≤ κ_k ‖Δ_k‖ + e_k,           (1)

and e_k ≤ L_k δ_k, so that with κ ≥ κ_k, L ≥ L_k, by the geometric series

    ‖Δ_k‖ ≤ κᵏ ‖Δ_0‖ + L sup_{j<k} δ_j/(1 − κ).                                                              (2)

x'_k may be any state of a box. The distance of a learning run to a free run with frozen weights θ is the same with
θ_k = θ, and the learned weights as θ'_k. A speed that is limited to an interval after each step keeps (1).

(1) is far smaller than (2), because e_k is the smallest of three bounds: L_k δ_k; the same by components, with the
gradient and the change of each weight multiplied one by one,

    e_r = Σ_s |(T ΔR)_rs| |x_s| + Σ_i |(T ΔA)_ri| |φ(z_i)| + |(T A')_ri| |Δz_i|,   Δz = ΔW x + ΔW₂ u + Δb;

and where the box is a point, because x'_k and u_k were recorded, the difference of the two values itself.

**L_k bounds the gradient of f in its weights** on the segment between θ_k and θ'_k (mean value theorem). For one hidden
layer, z = W x + W₂ u + b, slopes d_i ∈ [0, 1] and the output (T f)_r, the derivatives by R, A, W, W₂ and b are
T_rs x_k, T_rs φ(z_i), and (T A)_ri d_i times x_k, u_j and 1. So

    L² = max_r ‖T_r‖² (‖x‖² + Σ_i φ(z_i)²) + (1 + ‖x‖² + ‖u‖²) Σ_i (T A)_ri²                                     (3)

without ‖x‖² in the first bracket if R is the same in both. At fixed (x, u) z and A are affine along the segment, so
that |z_i| and Σ (T A)_ri² are convex and greatest at its ends. |φ(z_i)| is bounded by max |φ| at the ends of the
interval of z_i on the box, for both weights. This bounds ‖T f‖_∞. In the 1-norm L is the sum over r in place of the
maximum. All of it is computed in fractions, and every root and every bound is rounded up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from certify.errors import CertifyError
from certify.networks.vector import RELU, Activation, VectorWeights, check
from certify.proofs.box_planes import Box, region
from certify.proofs.rounding import float_above
from certify.proofs.vector_exact import Matrix, everywhere, identity, matrix, product, rate
from certify.proofs.vector_points import value_at
from certify.proofs.vector_slopes import first_layer

ZERO = Fraction(0)


class LearningBound(NamedTuple):
    """Bounds of ‖Δ_k‖, rounded up."""

    rate: float  # κ of (2), the greatest of the first run's weights
    gradient: float  # L of (2)
    distance: float  # sup δ_j
    limit: float  # L sup δ_j/(1 − κ); infinite where κ ≥ 1
    steps: np.ndarray  # (k + 1,) of Δ_0 … Δ_k, by (1)

    def after(self, k: int) -> float:
        """(2), from ‖Δ_0‖; infinite where κ ≥ 1 and the weights differ."""
        if math.inf in (self.rate, self.limit):
            return math.inf
        return float_above(Fraction(self.rate) ** k * Fraction(float(self.steps[0])) + Fraction(self.limit))


def bound(
    first: Sequence[VectorWeights],
    second: Sequence[VectorWeights],
    box: Box | Sequence[Box],
    start: float,
    phi: Activation = RELU,
    norm: str = "inf",
    scaling: Matrix | None = None,
    kappa: Fraction | None = None,
) -> LearningBound:
    """How far apart two runs are after each step, if they start `start` apart.

    Args:
        first: θ_0, θ_1, …, of one network each, with one hidden layer.
        second: θ'_0, θ'_1, …, as many.
        box: `(q + m,)`, in which the states of the second run and the inputs lie; ends may be equal. Or one box for
            each step, such as a recorded (x'_k, u_k) as both ends.
        start: ‖T Δ_0‖.
        phi: the activation.
        norm: "inf" or "one".
        scaling: T, `(q, q)`; the identity by default.
        kappa: a rate that is proved for all of `first`, such as on a box that holds both runs; by default each κ_k is
            computed, exactly, over all slopes of φ.

    Raises:
        CertifyError: weights of different shapes, two hidden layers, a box, a start or a κ that does not fit.

    >>> one = VectorWeights(None, [[0.5]], [[1.0]], [[0.0]], [0.0])
    >>> found = bound([one, one], [one, one._replace(A=[[0.25]])], Box(np.zeros(2), np.ones(2)), 1.0)
    >>> found.rate, found.distance, found.steps.tolist()[:2]
    (0.5, 0.25, [1.0, 0.5])
    """
    pairs, boxes = _checked(first, second, box, start)
    if kappa is not None and not 0 <= kappa < math.inf:
        raise CertifyError(f"kappa: found {kappa}, expected a finite rate of 0 or more")
    T = identity(len(pairs[0][0].R)) if scaling is None else scaling
    most = gradient = distance = ZERO
    steps, known = [float_above(Fraction(start))], dict[int, Fraction]()
    for (own, other), here in zip(pairs, boxes, strict=True):
        key = id(own)  # frozen weights are one object
        if key not in known:
            known[key] = rate(own, everywhere(own, phi), norm, scaling) if kappa is None else Fraction(kappa)
        apart = weight_distance(own, other)
        steepest = gradient_bound(own, other, here, phi, norm, T) if apart else ZERO
        change = min(steepest * apart, change_bound(own, other, here, phi, norm, T)) if apart else ZERO
        most, gradient, distance = max(most, known[key]), max(gradient, steepest), max(distance, apart)
        before = steps[-1]
        steps.append(float_above(known[key] * Fraction(before) + change) if before < math.inf else math.inf)
    limit = math.inf if most >= 1 else float_above(gradient * distance / (1 - most))
    sizes = float_above(most), float_above(gradient), float_above(distance)
    return LearningBound(*sizes, limit if distance else 0.0, np.array(steps))


def weight_distance(first: VectorWeights, second: VectorWeights) -> Fraction:
    """‖θ − θ'‖₂, rounded up.

    >>> one = VectorWeights([[0.0]], [[0.5]], [[1.0]], [[0.0]], [0.0])
    >>> weight_distance(one, one._replace(A=[[3.5]], b=[4.0]))
    Fraction(5, 1)
    """
    total = ZERO
    for x, y in zip(first, second, strict=True):
        if x is not None:
            own, other = (np.ravel(each).tolist() for each in (x, y))
            total += sum(((Fraction(a) - Fraction(b)) ** 2 for a, b in zip(own, other, strict=True) if a != b), ZERO)
    return root_above(total)


def gradient_bound(
    first: VectorWeights,
    second: VectorWeights,
    box: Box,
    phi: Activation = RELU,
    norm: str = "inf",
    scaling: Matrix | None = None,
) -> Fraction:
    """L of (3) for the segment between two networks' weights, checked, on a box; rounded up.

    >>> net = check(VectorWeights(None, [[1.0]], [[1.0]], [[0.0]], [0.0]))
    >>> gradient_bound(net, net, Box(np.zeros(2), np.ones(2)))  # √(1 + 1 + 1 + 1)
    Fraction(2, 1)
    """
    T = identity(len(first.R)) if scaling is None else scaling
    sides = zip(np.asarray(box.lo).tolist(), np.asarray(box.hi).tolist(), strict=True)
    y = [max(abs(Fraction(lo)), abs(Fraction(hi))) ** 2 for lo, hi in sides]
    states = sum(y[: len(T)], ZERO)
    sizes = [max(pair) for pair in zip(_values(first, box, phi), _values(second, box, phi), strict=True)]
    direct = sum((size * size for size in sizes), ZERO)
    if not np.array_equal(first.R, second.R):
        direct += states
    roots = []
    outer = [[sum((x * x for x in row), ZERO) for row in product(T, matrix(each.A))] for each in (first, second)]
    for row, *ends in zip(T, *outer, strict=True):
        scale = sum((x * x for x in row), ZERO)
        roots.append(root_above(scale * direct + (1 + sum(y, ZERO)) * max(ends)))
    return max(roots) if norm == "inf" else sum(roots, ZERO)


def change_bound(
    first: VectorWeights,
    second: VectorWeights,
    box: Box,
    phi: Activation = RELU,
    norm: str = "inf",
    scaling: Matrix | None = None,
) -> Fraction:
    """A bound of ‖T f(x, u; θ) − T f(x, u; θ')‖ on a box by components; at a point the difference itself.

    >>> net = check(VectorWeights(None, [[1.0]], [[1.0]], [[0.0]], [0.0]))
    >>> change_bound(net, net._replace(A=np.array([[0.5]])), Box(np.zeros(2), np.ones(2)))
    Fraction(1, 2)
    """
    T = identity(len(first.R)) if scaling is None else scaling
    lo, hi = np.asarray(box.lo), np.asarray(box.hi)
    if (lo == hi).all():
        values = [value_at(each, phi, lo) for each in (first, second)]
        ends = [(low - top, high - bottom) for (low, high), (bottom, top) in zip(*values, strict=True)]
        sums = [_magnitude(row, ends) for row in T]
    else:
        rows = [[matrix(x) for x in (w.R, w.A, np.concatenate([w.W, w.W2, w.b[:, None]], 1))] for w in (first, second)]
        dR, dA, dz = (
            [[x - y for x, y in zip(*pair, strict=True)] for pair in zip(*X, strict=True)]
            for X in zip(*rows, strict=True)
        )
        sides = [*zip(matrix([lo])[0], matrix([hi])[0], strict=True), (Fraction(1), Fraction(1))]
        moved = [_magnitude(row, sides) for row in dz]
        values_at_most = _values(first, box, phi)
        sums = []
        for direct, own, other in zip(product(T, dR), product(T, dA), product(T, rows[1][1]), strict=True):
            total = _magnitude(direct, sides[: len(T)])
            total += sum((abs(k) * v for k, v in zip(own, values_at_most, strict=True)), ZERO)
            sums.append(total + sum((abs(k) * v for k, v in zip(other, moved, strict=True)), ZERO))
    return max(sums) if norm == "inf" else sum(sums, ZERO)


def _magnitude(row: Sequence[Fraction], ends: Sequence[tuple[Fraction, Fraction]]) -> Fraction:
    """The greatest |Σ k y| over intervals of y."""
    low = sum((min(k * x, k * y) for k, (x, y) in zip(row, ends, strict=True)), ZERO)
    high = sum((max(k * x, k * y) for k, (x, y) in zip(row, ends, strict=True)), ZERO)
    return max(high, -low)


def root_above(x: Fraction, bits: int = 64) -> Fraction:
    """√x, rounded up to so many significant bits or more; exact squares of short numbers stay exact.

    >>> root_above(Fraction(9, 4)), float(root_above(Fraction(2)))
    (Fraction(3, 2), 1.4142135623730951)
    """
    if not x:
        return ZERO
    shift = max(bits + (x.denominator.bit_length() - x.numerator.bit_length()) // 2 + 1, 0)
    whole = -(-(x.numerator << (2 * shift)) // x.denominator)
    low = math.isqrt(whole)
    return Fraction(low if low * low == whole else low + 1, 1 << shift)


def _values(weights: VectorWeights, box: Box, phi: Activation) -> list[Fraction]:
    """The greatest |φ(z_i)| on a box; of tanh, min(|z|, 1)."""
    here, first = region(box), first_layer(weights, box)
    unit, found = 1 << (first.bits + here.bits), []
    for row, constant in zip(first.rows, first.constants, strict=True):
        least, most = (Fraction(k, unit) for k in here.extremes(row, constant))
        if phi.name == "tanh":
            found.append(min(max(-least, most), Fraction(1)))
        else:
            found.append(max(most, -phi.least * least, ZERO))
    return found


def _checked(
    first: Sequence[VectorWeights], second: Sequence[VectorWeights], box: Box | Sequence[Box], start: float
) -> tuple[list[tuple[VectorWeights, VectorWeights]], list[Box]]:
    if not first or len(first) != len(second):
        raise CertifyError(f"weights: found {len(first)} and {len(second)} sets, expected one or more, as many in both")
    kept: dict[int, VectorWeights] = {}
    sets = [[kept.setdefault(id(each), check(each)) for each in run] for run in (first, second)]
    shapes = {tuple(None if x is None else x.shape for x in each) for run in sets for each in run}
    one = sets[0][0]
    if len(shapes) > 1 or one.V is not None or one.b.ndim != 1:
        raise CertifyError(
            "weights: found sets of different shapes, a batch or two hidden layers, expected networks of one shape "
            "with one hidden layer"
        )
    boxes = [box] * len(first) if isinstance(box, Box) else list(box)
    if len(boxes) != len(first):
        raise CertifyError(f"box: found {len(boxes)} boxes for {len(first)} steps, expected one, or one for each step")
    width = one.W.shape[1] + one.W2.shape[1]
    for each in {id(x): x for x in boxes}.values():
        ends = [np.asarray(x, dtype=np.float64) for x in each]
        if any(x.shape != (width,) or not np.isfinite(x).all() for x in ends) or (ends[0] > ends[1]).any():
            raise CertifyError(f"box: expected {width} intervals of x and u with finite ends lo ≤ hi")
    if not (math.isfinite(start) and start >= 0):
        raise CertifyError(f"start: found {start}, expected a distance of 0 or more")
    return list(zip(*sets, strict=True)), boxes
