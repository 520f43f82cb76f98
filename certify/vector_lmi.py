"""The smallest rate of a network with a vector state in a norm √(xᵀ P x), by semidefinite programming, and its proof.

M of (3) in `certify.vector_exact` is linear in P and the multipliers Λ at a fixed rate κ:

    t(κ) = max t   over P, Λ, t   with   M(P, Λ, κ) ⪰ t I,   trace P = q                                   (1)

κ can be certified iff t(κ) > 0, and t does not decrease in κ. (1) has an inner point and a bounded t for every κ, so
that no program is infeasible. The smallest κ is the root of t, found by secants and bisection. P and Λ of a slightly
larger κ are rounded to short fractions and proved in rational arithmetic: the solver only proposes them. (1) is solved
for the equal network of `certify.vector_balance`.
"""

from __future__ import annotations

import itertools
import math
import time
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from certify.errors import CertifyError
from certify.lmi import TOLERANCE, import_cvxpy, quietly
from certify.vector_balance import Balanced, balance
from certify.vector_exact import Proof, proves
from certify.vector_weights import Activation, VectorWeights, check

SMALLEST = 2.0**-12  # rate of the balanced network: one whose slopes are all zero has the rate 0, which is no κ
WIDENED = (5e-6, 1e-4, 1e-3, 1e-2, 0.1)  # relative distances above the smallest rate at which a proof is tried
BITS = (12, 17, 22, 28, 36, 52)  # of the fractions of P and Λ
PROGRAMS = 40  # at most, for one smallest rate
CLOSE = 1e-6  # relative width of the bracket of the smallest rate


class Solved(NamedTuple):
    """The answer of a solver, and the result of checking it exactly."""

    verdict: str  # certified; not certified: the solver's answer, no proof; unknown: its answer proves nothing
    rate: float  # the smallest rate by the solver, or the rate that was asked for; NaN where the solver fails
    kappa: Fraction | None  # the rate that P and Λ prove; None unless certified
    proof: Proof | None
    margin: float  # t of (1) for the balanced network, at the last κ
    status: str  # as the solver reports it
    solver: str
    seconds: float  # wall time, with the exact proof
    programs: int  # how many were solved


def smallest_rate(weights: VectorWeights, phi: Activation, most: int = 1, solver: str = "CLARABEL") -> Solved:
    """The smallest κ at which (1) has t > 0 according to the solver, and a proof at a κ slightly above it.

    Args:
        weights: of one network, one or two hidden layers.
        phi: gives the least slope α.
        most: β. 1: the slopes of relu. 2: the paper's Λ in place of 2Λ, slopes up to 2.
        solver: CLARABEL, or any installed solver of cvxpy that takes semidefinite programs.

    Raises:
        CertifyError: weights that are no network, a `most` other than 1 and 2, a solver that is not installed.

    >>> from certify.vector_weights import RELU
    >>> net = VectorWeights(None, [[0.5, -1.0]], [[1.0], [0.75]], np.zeros((2, 0)), [0.0, 0.0])
    >>> found = smallest_rate(net, RELU)
    >>> found.verdict, round(found.rate, 5), 0.75 < found.kappa < 0.7501
    ('certified', 0.75, True)
    """
    start, weights = time.perf_counter(), _one(weights, most)
    program = Program(balance(weights), phi, most, solver)
    size = program.network.size
    low, high = SMALLEST, math.inf
    kappa, status, margin = 1.0, "", math.nan
    ends: list[tuple[float, float]] = []  # the last two κ with their t
    while len(program.seconds) < PROGRAMS and high > low * (1 + CLOSE):
        margin, _, status = program.solve(kappa)
        if math.isnan(margin):
            break
        low, high = (low, min(kappa, high)) if margin > 0 else (max(kappa, low), high)
        ends = [*ends[-1:], (kappa, margin)]
        kappa = _next(low, high, ends)

    def answer(verdict: str, kappa: Fraction | None = None, proof: Proof | None = None) -> Solved:
        rate = high * size if math.isfinite(high) else math.nan
        seconds = time.perf_counter() - start
        return Solved(verdict, rate, kappa, proof, margin, status, solver, seconds, len(program.seconds))

    if math.isfinite(high):
        for widened in WIDENED:
            short = _short(high * (1 + widened))
            margin, x, status = program.solve(float(short))
            if x is not None and (proof := program.proof(weights, x, short * Fraction(size))):
                return answer("certified", short * Fraction(size), proof)
    return answer("unknown")


def certify(
    weights: VectorWeights, phi: Activation, rate: float | Fraction = 1, most: int = 1, solver: str = "CLARABEL"
) -> Solved:
    """Whether (1) proves a rate; arguments and errors as in `smallest_rate`.

    >>> from certify.vector_weights import RELU
    >>> net = VectorWeights(None, [[0.5, -1.0]], [[1.0], [0.75]], np.zeros((2, 0)), [0.0, 0.0])
    >>> certify(net, RELU, 0.76).verdict, certify(net, RELU, 0.74).verdict
    ('certified', 'not certified')
    """
    start, weights = time.perf_counter(), _one(weights, most)
    if not (math.isfinite(rate) and rate > 0):
        raise CertifyError(f"rate: found {rate}, expected a finite number above 0")
    program = Program(balance(weights), phi, most, solver)
    kappa = min(max(Fraction(rate) / Fraction(program.network.size), Fraction(1, 2**60)), Fraction(2**20))
    margin, x, status = program.solve(float(kappa))
    proof = None if x is None else program.proof(weights, x, Fraction(rate))
    verdict = "certified" if proof else "not certified" if margin < -TOLERANCE else "unknown"
    seconds = time.perf_counter() - start
    exact = Fraction(rate) if proof else None
    return Solved(verdict, float(rate), exact, proof, margin, status, solver, seconds, len(program.seconds))


def _one(weights: VectorWeights, most: int) -> VectorWeights:
    weights = check(weights)
    if weights.b.ndim != 1:
        raise CertifyError(f"weights: found a batch of shape {weights.b.shape[:-1]}, expected one network")
    if most not in (1, 2):
        raise CertifyError(f"most: found {most}, expected 1 (slopes up to 1) or 2 (the paper's Λ, slopes up to 2)")
    return weights


def _next(low: float, high: float, ends: list[tuple[float, float]]) -> float:
    """The next κ: near the root of the secant through the last two, on its farther side; else between the bounds."""
    if not math.isfinite(high):
        return 2 * low
    if len(ends) == 2 and ends[0][1] != ends[1][1]:
        (k0, t0), (k1, t1) = ends
        root = k1 - t1 * (k1 - k0) / (t1 - t0)
        if low < root < high:
            beyond = max(0.05 * abs(root - k1), CLOSE / 3 * high)
            aim = root + beyond if high - root > root - low else root - beyond
            if low < aim < high:
                return aim
    return math.sqrt(low * high) if high > 2 * low else (low + high) / 2


def _short(kappa: float) -> Fraction:
    """A fraction of 26 bits that is κ or just above it."""
    mantissa, exponent = math.frexp(kappa)
    return Fraction(math.ceil(mantissa * 2**26)) * Fraction(2) ** (exponent - 26)


class Program:
    """(1) for one balanced network; the unknowns are the upper triangle of P, then Λ, then t.

    M is the sum of the unknowns times matrices, of which only those of P depend on κ.
    """

    def __init__(self, network: Balanced, phi: Activation, most: int, solver: str) -> None:
        self.network, self.phi, self.most, self.solver = network, phi, most, solver.upper()
        self.seconds: list[float] = []  # of each program solved
        alpha, beta = float(phi.least), float(most)
        R, hidden, A = network.R, network.layers[:-1], network.layers[-1]
        self.q, self.widths = len(R), [len(X) for X in hidden]
        starts = [0, *itertools.accumulate([self.q, self.q, *self.widths])]
        self.parts = [slice(i, j) for i, j in itertools.pairwise(starts)]
        N = starts[-1]
        self.corners = list(zip(*np.triu_indices(self.q), strict=True))  # of P's upper triangle
        count = len(self.corners) + sum(self.widths) + 1
        self.fixed, self.square = np.zeros((count, N, N)), np.zeros((count, N, N))  # M = Σ x_k (fixed_k + κ² square_k)
        first, second = self.parts[:2]
        for k, (i, j) in enumerate(self.corners):
            P = np.zeros((self.q, self.q))
            P[i, j] = P[j, i] = 1.0
            self._put(self.fixed[k], first, first, P)
            self._put(self.fixed[k], first, second, P @ R)
            self._put(self.fixed[k], first, self.parts[-1], P @ A)
            self._put(self.square[k], second, second, P)
        k = len(self.corners)
        for layer, X in enumerate(hidden):
            into, own = self.parts[1 + layer], self.parts[2 + layer]
            for i, row in enumerate(X):
                self.fixed[k][own.start + i, own.start + i] = 2.0
                self.fixed[k][into, own.start + i] = self.fixed[k][own.start + i, into] = -(alpha + beta) * row
                self.fixed[k][into, into] += 2 * alpha * beta * np.outer(row, row)
                k += 1
        self.fixed[k] = -np.eye(N)
        self._solve = self._clarabel if self.solver == "CLARABEL" else self._by_cvxpy
        self._prepare()

    def _put(self, M: np.ndarray, rows: slice, columns: slice, block: np.ndarray) -> None:
        M[rows, columns] = block
        M[columns, rows] = block.T

    def _prepare(self) -> None:
        N, count = self.fixed.shape[1], len(self.fixed)
        rows, columns = np.triu_indices(N)
        order = np.lexsort((rows, columns))  # the upper triangle, column by column, as Clarabel has it
        self._triangle = rows[order], columns[order]
        self._weight = np.where(rows[order] == columns[order], 1.0, math.sqrt(2))
        self._trace = np.zeros(count)
        self._trace[[k for k, (i, j) in enumerate(self.corners) if i == j]] = 1.0
        if self.solver != "CLARABEL":
            import_cvxpy(self.solver)

    def matrix(self, x: np.ndarray, kappa: float) -> np.ndarray:
        """M(P, Λ, κ) − t I."""
        return np.tensordot(x, self.fixed, 1) + kappa**2 * np.tensordot(x, self.square, 1)

    def solve(self, kappa: float) -> tuple[float, np.ndarray | None, str]:
        """t, the unknowns and the solver's status; t is NaN and the unknowns None where the solver fails."""
        start = time.perf_counter()
        x, status = self._solve(kappa)
        self.seconds.append(time.perf_counter() - start)
        if x is None or not np.isfinite(x).all():
            return math.nan, None, status
        x = np.append(x[:-1], 0.0)
        margin = float(np.linalg.eigvalsh(self.matrix(x, kappa))[0])  # which the solver may not reach
        return margin, x, status

    def _clarabel(self, kappa: float) -> tuple[np.ndarray | None, str]:
        try:
            import clarabel
            from scipy.sparse import csc_matrix
        except ImportError as error:
            raise CertifyError(
                "clarabel is not installed, expected it for an LMI: run pip install 'usvlearn[lmi]'"
            ) from error
        count = len(self.fixed)
        triangle = (self.fixed + kappa**2 * self.square)[:, *self._triangle] * self._weight
        A = csc_matrix(np.vstack([self._trace, -triangle.T]))
        b = np.zeros(A.shape[0])
        b[0] = self.q
        cones = [clarabel.ZeroConeT(1), clarabel.PSDTriangleConeT(self.fixed.shape[1])]
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        found = clarabel.DefaultSolver(csc_matrix((count, count)), -np.eye(count)[-1], A, b, cones, settings).solve()
        return np.array(found.x), str(found.status)

    def _by_cvxpy(self, kappa: float) -> tuple[np.ndarray | None, str]:
        cp = import_cvxpy()
        N, x = self.fixed.shape[1], cp.Variable(len(self.fixed))
        flat = (self.fixed + kappa**2 * self.square).reshape(len(self.fixed), -1)
        M = cp.reshape(flat.T @ x, (N, N), order="C")
        problem = cp.Problem(cp.Maximize(x[-1]), [(M + M.T) / 2 >> 0, self._trace @ x == self.q])
        status = quietly(problem, self.solver)
        return x.value, status

    def proof(self, weights: VectorWeights, x: np.ndarray, kappa: Fraction) -> Proof | None:
        """The shortest fractions near the unknowns that prove κ for the weights as given; None if there are none."""
        count, scaled = len(self.corners), float(kappa / Fraction(self.network.size))
        for bits in BITS:
            P = [[Fraction(0)] * self.q for _ in range(self.q)]
            for (i, j), value in zip(self.corners, x.tolist(), strict=False):
                P[i][j] = P[j][i] = Fraction(round(value * 2**bits), 2**bits)
            lam = [_rounded(value, bits) for value in x[count:-1].tolist()]
            near = np.array([*(float(P[i][j]) for i, j in self.corners), *map(float, lam), 0.0])
            if min(lam, default=1) <= 0 or np.linalg.eigvalsh(self.matrix(near, scaled))[0] <= 0:
                continue
            own = iter(lam)
            proof = self.network.proof(P, [[next(own) for _ in range(width)] for width in self.widths])
            if proves(weights, self.phi, proof, kappa, Fraction(self.most)):
                return proof
        return None


def _rounded(value: float, bits: int) -> Fraction:
    """A fraction with so many significant bits."""
    mantissa, exponent = math.frexp(value)
    return Fraction(round(mantissa * 2**bits)) * Fraction(2) ** (exponent - bits)
