"""Every equilibrium of a shallow ReLU network at constant input, its place and its class, exactly.

    f(x) = aᵀ relu(w₁ x + c),   c = W₂ u + b                                      (paper, section IV-B)            (1)
    x* = f(x*)                                                                    (paper, definition of x_eq)      (2)

f is continuous and piecewise linear. Its slope changes at the critical points t_i = −c_i/w_{1i} of all n neurons with
w_{1i} ≠ 0, by a_i |w_{1i}| from left to right, so that one sweep over the sorted t_i gives every segment:
f(x) = q x + r. Between two points at which f(x) − x has different signs there is exactly one equilibrium,

    x* = r/(1 − q)                                                                                                 (3)

Where f(x) = x at two neighbouring points, all between them are equilibria. There are at most n + 1 isolated
ones, and f need be neither one-to-one nor onto.

The class depends on the slopes q_L and q_R on both sides (elementary; Galor 2007 for q_L = q_R): a deviation d < 0
becomes q_L d, a deviation d > 0 becomes q_R d. A side with a negative slope hands its points to the other side:

    both ≥ 0    each side by itself: it comes nearer where q < 1, and leaves where q > 1
    both < 0    two steps multiply a deviation by q_L q_R
    mixed       after one step all points are on the side with q ≥ 0, which decides: q_L = −3, q_R = 0.2 is stable

All classes are local. Cycles of period two and longer are not searched for.

The sweep uses integers: floats are integers over a power of two, and so are all slopes and intercepts. The number and
the class of the equilibria are therefore exact for the given float weights and float input. Places and slopes are
rounded once, at the end.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from operator import mul
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from certify.errors import CertifyError
from certify.networks.shallow import ShallowWeights, check

CLASSES = {
    "deadbeat": "nearby states reach it exactly, in at most two steps",
    "stable": "nearby states come to it, crossing it at most once",
    "stable oscillatory": "nearby states come to it, on alternating sides",
    "neutral two-cycles": "nearby states alternate between two values for ever",
    "half-stable": "states on one side come to it, states on the other leave it",
    "unstable": "nearby states leave it, crossing it at most once",
    "unstable oscillatory": "nearby states leave it, on alternating sides",
    "continuum": "an interval of equilibria, or the end of one that lies outside [lo, hi]",
}
ATTRACTING = ("deadbeat", "stable", "stable oscillatory")


class Equilibrium(NamedTuple):
    """An isolated equilibrium, or an interval of them.

    >>> (point,) = equilibria(ShallowWeights([0.5], [1.0], [[0.0]], [0.25]), [0.0])
    >>> point.x, point.slope_left, point.attracts
    (0.25, 0.5, True)
    """

    lo: float  # first x with f(x) = x; no unit
    hi: float  # last one, no unit; equal to `lo` but for an interval
    kind: str  # its class, of CLASSES
    slope_left: float  # of f, just below `lo`; no unit
    slope_right: float  # of f, just above `hi`; no unit
    attracts: bool  # all states near it come to it; for an interval, to some point of it

    @property
    def x(self) -> float:
        """The position of the equilibrium, no unit; the middle of an interval."""
        return self.lo if self.lo == self.hi else self.lo + (self.hi - self.lo) / 2


class PiecewiseLinear(NamedTuple):
    """f on [lo, hi], through its critical points."""

    x: np.ndarray  # (k,) lo, the critical points between, hi, each once
    y: np.ndarray  # (k,) f(x)
    slopes: np.ndarray  # (k - 1,) of f between them


class _Network(NamedTuple):
    """A network's weights as integers over 2^e."""

    A: list[int]  # (n,)
    W: list[int]  # (n,)
    V: list[list[int]]  # (n, m)
    B: list[int]  # (n,)
    e: int


class _Sweep(NamedTuple):
    """f on [lo, hi] in integers: in segment k, f(x) = (q_k x + r_k)/one; segment k ends at point k."""

    points: list[tuple[int, int]]  # (k,) numerator and denominator > 0, ascending; the first is lo, the last hi
    lines: list[tuple[int, int]]  # (k + 1,) q and r; the first holds just below lo, the last just above hi
    one: int


def equilibria(weights: ShallowWeights, u: ArrayLike, lo: float = 0.0, hi: float = 1.0) -> list[Equilibrium]:
    """Every equilibrium (2) on [lo, hi] at the constant input u, in ascending order.

    An equilibrium at lo or hi is classified by the slopes of f on the real line, like any other.

    Args:
        weights: of one network.
        u: `(m,)`; all zeros in the paper's definition, although no heading gives that (see `surge_inputs`).
        lo: least x, no unit.
        hi: greatest x, no unit.

    Returns:
        The equilibria, each with its position, its class and the slopes beside it.

    Raises:
        CertifyError: shapes that do not fit, values that are not finite, lo > hi.

    >>> tooth = ShallowWeights([2.0], [1.0], [[0.0]], [-0.25])
    >>> [(point.x, point.kind) for point in equilibria(tooth, [0.0])]
    [(0.0, 'deadbeat'), (0.5, 'unstable')]
    """
    return sweep(weights, [u], lo, hi)[0]


def sweep(weights: ShallowWeights, inputs, lo: float = 0.0, hi: float = 1.0) -> list[list[Equilibrium]]:
    """The equilibria at each of several constant inputs, `(k, m)`; otherwise as `equilibria`."""
    network = _integer_network(weights)
    _check_domain(lo, hi)
    return [_solve(_sweep(network, u, lo, hi)) for u in _check_inputs(network, inputs)]


def piecewise(weights: ShallowWeights, u, lo: float = 0.0, hi: float = 1.0) -> PiecewiseLinear:
    """f on [lo, hi] at the constant input u, `(m,)`: the critical points, f there, and the slopes between them."""
    network = _integer_network(weights)
    _check_domain(lo, hi)
    points, lines, one = _sweep(network, _check_inputs(network, [u])[0], lo, hi)
    x = [_float(num, den) for num, den in points]
    y = [_float(q * num + r * den, one * den) for (num, den), (q, r) in zip(points, lines[1:], strict=True)]
    return PiecewiseLinear(np.array(x), np.array(y), np.array([_float(q, one) for q, _ in lines[1:-1]]))


def surge_inputs(headings, command_left=0.0, command_right=0.0) -> np.ndarray:
    """u = [½ + ½ sin θ, ½ + ½ cos θ, ξ_L, ξ_R] of the paper's surge network, `(*k, 4)`.

    The commands are 0 in the paper's equilibria ("no input"). No heading gives u = 0.

    Args:
        headings: θ, rad, `(*k,)`.
        command_left: ξ_L; broadcasts against the headings.
        command_right: ξ_R.
    """
    heading, left, right = np.broadcast_arrays(*(np.asarray(x, float) for x in (headings, command_left, command_right)))
    return np.stack([0.5 + 0.5 * np.sin(heading), 0.5 + 0.5 * np.cos(heading), left, right], -1)


def classify(slope_left, slope_right) -> str:
    """The class of an equilibrium from the slopes of f on its two sides; the numbers are compared exactly."""
    if slope_left == 1 or slope_right == 1:
        return "continuum"
    if slope_left < 0 and slope_right < 0:
        twice = slope_left * slope_right
        return "stable oscillatory" if twice < 1 else "neutral two-cycles" if twice == 1 else "unstable oscillatory"
    deciding = [q for q in (slope_left, slope_right) if q >= 0]
    if max(deciding) < 1:
        return "deadbeat" if max(deciding) == 0 else "stable"
    return "unstable" if min(deciding) > 1 else "half-stable"


def _solve(sweep: _Sweep) -> list[Equilibrium]:
    points, lines, one = sweep
    roots: list[tuple[float, float, int, int, bool]] = []  # lo, hi, slopes left and right times `one`, an interval
    before = None
    for k, ((num, den), height) in enumerate(zip(points, _heights(sweep), strict=True)):
        if height == 0:
            x, left, right = _float(num, den), lines[k][0], lines[k + 1][0]
            if before == 0:  # the segment between lies on the identity
                lo, _, left, *_ = roots.pop()
                roots.append((lo, x, left, right, True))
            else:
                roots.append((x, x, left, right, False))
        elif before and (before > 0) != (height > 0):
            q, r = lines[k]
            x = _float(r, one - q)  # (3)
            roots.append((x, x, q, q, False))
        before = height
    return [_equilibrium(*root, one) for root in roots]


def _equilibrium(lo: float, hi: float, left: int, right: int, interval: bool, one: int) -> Equilibrium:
    kind = "continuum" if interval else classify(Fraction(left, one), Fraction(right, one))
    # a slope of 1 beside an interval: the interval continues outside [lo, hi]
    attracts = max(left, right) <= one if kind == "continuum" else kind in ATTRACTING
    return Equilibrium(lo, hi, kind, _float(left, one), _float(right, one), attracts)


def _heights(sweep: _Sweep) -> list[int]:
    """f(x) − x at each point, times a positive number."""
    points, lines, one = sweep
    return [(q - one) * num + r * den for (num, den), (q, r) in zip(points, lines[1:], strict=True)]


def _sweep(network: _Network, u: np.ndarray, lo: float, hi: float) -> _Sweep:
    """f's segments on [lo, hi], ends included."""
    (first, den_lo), (last, den_hi) = float(lo).as_integer_ratio(), float(hi).as_integer_ratio()
    den = max(den_lo, den_hi)  # both are powers of two
    first, last = first * (den // den_lo), last * (den // den_hi)
    U, eu = _integers(u)
    q = r = 0
    events = [(first, den, 0, 0), (last, den, 0, 0)]  # point, and the changes of q and r there
    for A, w, V, B in zip(network.A, network.W, network.V, network.B, strict=True):
        W, C = w << eu, (B << eu) + sum(map(mul, V, U))
        at_lo, at_hi = W * first + C * den, W * last + C * den
        if at_lo > 0 or (at_lo == 0 and W < 0):  # active just below lo
            q, r = q + A * W, r + A * C
        if W and (at_lo <= 0 <= at_hi or at_hi <= 0 <= at_lo):
            events.append((-C, W, A * W, A * C) if W > 0 else (C, -W, -A * W, -A * C))
    # different fractions with denominators below 2^b differ by more than 2^−2b: sorted by their floors over 2^−2b−1
    bits = 2 * max(event[1] for event in events).bit_length() + 1
    points, lines, before = [], [], None
    for place, num, den, jump, lift in sorted(((num << bits) // den, num, den, *rest) for num, den, *rest in events):
        if place != before:
            points.append((num, den))
            lines.append((q, r))
            before = place
        q, r = q + jump, r + lift
    lines.append((q, r))
    return _Sweep(points, lines, 1 << (2 * network.e + eu))


def _integer_network(weights: ShallowWeights) -> _Network:
    a, w1, W2, b = check(weights)
    if a.ndim != 1:
        raise CertifyError(f"weights: found a batch {a.shape[:-1]}, expected one network: take one of them, a[0] …")
    n, m = W2.shape
    whole, e = _integers(np.concatenate([a, w1, b, W2.ravel()]))
    rows = [whole[k : k + m] for k in range(3 * n, (3 + m) * n, m)] if m else [[]] * n
    return _Network(whole[:n], whole[n : 2 * n], rows, whole[2 * n : 3 * n], e)


def _integers(x: np.ndarray) -> tuple[list[int], int]:
    """Integers and e ≥ 0 with x = integers/2^e exactly; x is `(k,)`."""
    mantissas, exponents = np.frexp(x)
    exponents = exponents - 53
    e = max(0, -int(exponents.min(initial=0)))
    whole = (mantissas * 2.0**53).astype(np.int64).tolist()
    return [value << shift for value, shift in zip(whole, (exponents + e).tolist(), strict=True)], e


def _float(num: int, den: int) -> float:
    """num/den, rounded once; ±inf beyond the range of floats."""
    try:
        return num / den + 0.0  # no −0
    except OverflowError:
        return math.inf if (num > 0) == (den > 0) else -math.inf


def _check_domain(lo: float, hi: float) -> None:
    if not (math.isfinite(lo) and math.isfinite(hi) and lo <= hi):
        raise CertifyError(f"lo, hi: found {lo}, {hi}, expected finite numbers with lo <= hi: give another interval")


def _check_inputs(network: _Network, inputs: Sequence | np.ndarray) -> np.ndarray:
    m = len(network.V[0])
    try:
        array = np.asarray(inputs, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CertifyError(f"u: found no array of numbers ({error}), expected inputs of {m} numbers each") from error
    if array.ndim != 2 or array.shape[1] != m:
        raise CertifyError(f"u: found inputs of shape {array.shape[1:]}, expected ({m},): one number a column of W2")
    if not np.isfinite(array).all():
        raise CertifyError("u: found NaN or infinite values, expected finite inputs: remove the missing values")
    return array
