"""The paper's matrix inequality and the slope-restricted one as semidefinite programs: a check of the closed forms.

With the corner c (1: the paper's theorem IV.1, slopes in [0, 2]; 2: Revay & Manchester 2020, slopes in [0, 1]),

    M(p, Λ) = [2 − p, 0, −aᵀ/κ; 0, p, −w₁ᵀΛ; −a/κ, −Λw₁, cΛ]    solve: maximise t, M(p, Λ) ⪰ t I                   (1)
    T(k, Λ) = [1,     0, −aᵀ;   0, k, −w₁ᵀΛ; −a,   −Λw₁, cΛ]    smallest_rate: minimise k = κ², T(k, Λ) ⪰ 0        (2)

(2) is M(1, Λ/κ²) with scaled rows and columns. p = 1 is always a best metric, since p(2 − p) ≤ 1. Dividing a_i by some
c_i > 0 and multiplying w_{1i}, W₂ᵢ and b_i by it does not change the map; up to a congruence, M is then M of Λ_i/c_i².
So both problems are solved for the equal network with |a_i| = |w_{1i}|, whose best Λ is near I. For the weights as
given Λ can have any size, and the solver's smallest rate has an error of 1e-5 instead of 1e-7.
"""

from __future__ import annotations

import math
import time
import warnings
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from certify.errors import CertifyError
from certify.proofs.exact import CORNER, Multipliers, fractions, proves

TOLERANCE = 1e-7  # a margin below −TOLERANCE is clearly negative; the solver's own tolerance is about 1e-8
WIDENED = 5e-6  # relative distance above the smallest rate at which the solver's multipliers can be proved
FAINT = 1e-5  # the one weight of a balanced neuron whose other is zero: it takes about FAINT² from the margin
FARTHEST = 1e150  # a neuron's c_i, whose square must be a float
USABLE = ("optimal", "optimal_inaccurate")


class Solution(NamedTuple):
    """The answer of a solver, and the result of checking it exactly.

    >>> found = LMI(1, "exact").solve([0.5], [1.0])
    >>> found.verdict, found.rate, found.multipliers.shape
    ('certified', 1.0, (1,))
    """

    condition: str  # lmi or exact
    verdict: str  # certified, not certified or unknown; of a plain problem: feasible, infeasible or unknown
    margin: float  # no unit: t of (1) of the balanced network; of a plain problem the least eigenvalue of M
    rate: float  # the κ that was asked for, no unit
    metric: float  # p, no unit; NaN where the solver returned none, as the margin and Λ
    multipliers: np.ndarray  # Λ's diagonal, (n,), for the weights as given
    status: str  # as the solver reports it
    solver: str  # its name in cvxpy
    seconds: float  # wall time of the solver's call, s, with cvxpy's own work


class LMI:
    """(1) and (2) for networks of n neurons: parametrised, so that other weights need no new compilation.

    *Certified*: the returned p and Λ, taken as exact rationals, make M positive definite in rational arithmetic. *Not
    certified*: the solver found no t above −1e-7; this is no proof (`certify.proofs.exact.conditions` decides exactly).
    *Unknown*: the solver failed, or its answer proves nothing.

    Args:
        n: number of neurons.
        condition: `lmi` (Λ in the corner) or `exact` (2Λ).
        solver: any installed solver of cvxpy that takes semidefinite programs.
        strict: False solves plain M ⪰ 0 for the weights as given, without margin and check, as one would type the
            theorem. *Feasible* is then the solver's answer. With `exact` it proves nothing: the identity, a = w₁ = 1,
            passes.
        options: the solver's own, such as `eps_abs=1e-9` of SCS.

    Raises:
        CertifyError: cvxpy or the solver is not installed, or the solver takes no semidefinite programs.

    >>> problem = LMI(2, "exact")
    >>> problem.solve([0.5, -0.5], [1.0, 1.0]).verdict, problem.solve([0.6, 0.5], [1.0, 1.0]).verdict
    ('certified', 'not certified')
    """

    def __init__(self, n: int, condition: str = "exact", solver: str = "CLARABEL", strict: bool = True, **options: Any):
        if condition not in ("lmi", "exact"):
            raise CertifyError(f"condition: found {condition!r}, expected lmi or exact: the others are no LMI to solve")
        if n < 1:
            raise CertifyError(f"n: found {n}, expected 1 or more neurons")
        self.n, self.condition, self.solver, self.strict, self.options = n, condition, solver.upper(), strict, options
        cp = import_cvxpy(self.solver)
        self._a, self._w1 = cp.Parameter(n), cp.Parameter(n)
        self._metric, self._square, self._multipliers, self._t = (cp.Variable(k) for k in ((1, 1), (1, 1), n, ()))

        def arrow(first, second):
            product = cp.multiply(self._w1, self._multipliers)  # a parameter times a variable: DPP
            a, w = (cp.reshape(-x, (n, 1), order="C") for x in (self._a, product))
            corner = CORNER[condition] * cp.diag(self._multipliers)
            return cp.bmat([[first, np.zeros((1, 1)), a.T], [np.zeros((1, 1)), second, w.T], [a, w, corner]])

        self._M = arrow(2 - self._metric, self._metric)
        if strict:
            self.problem = cp.Problem(cp.Maximize(self._t), [self._M - self._t * np.eye(n + 2) >> 0])  # (1)
        else:
            self.problem = cp.Problem(cp.Minimize(0), [self._M >> 0])
        T = arrow(np.ones((1, 1)), self._square)
        self.rate_problem = cp.Problem(cp.Minimize(cp.sum(self._square)), [T >> 0])  # (2)

    def solve(self, a: Any, w1: Any, rate: float | Fraction = 1.0) -> Solution:
        """Whether the condition holds at a rate.

        Args:
            a: `(n,)` floats.
            w1: `(n,)` floats.
            rate: κ, no unit.

        Returns:
            The solver's answer, and the result of checking it.

        Raises:
            CertifyError: a and w₁ that do not fit n, values that are not finite, or a rate that is not above 0.

        >>> found = LMI(1, "lmi").solve([0.25], [1.0])
        >>> found.verdict, found.margin > 0.2
        ('certified', True)
        """
        a, w1 = self._check(a, w1, rate)
        scale = _balance(a / float(rate), w1) if self.strict else np.ones(self.n)
        self._a.value, self._w1.value = a / float(rate) / scale, w1 * scale
        status, seconds = self._run(self.problem)
        if status not in USABLE:
            verdict = "infeasible" if not self.strict and status == "infeasible" else "unknown"
            return self._nothing(verdict, float(rate), status, seconds)
        metric, multipliers = self._metric.value.item(), scale**2 * self._multipliers.value
        if not self.strict:
            verdict, margin = "feasible", np.linalg.eigvalsh(self._M.value)[0].item()
        else:
            verdict, margin = "unknown", self._t.value.item()
            exact = Multipliers(Fraction(metric), fractions(multipliers))
            if proves(self.condition, a, w1, exact, Fraction(rate)):
                verdict = "certified"
            elif margin < -TOLERANCE:
                verdict = "not certified"
        return Solution(self.condition, verdict, margin, float(rate), metric, multipliers, status, self.solver, seconds)

    def smallest_rate(self, a: Any, w1: Any) -> tuple[float, Solution]:
        """The smallest κ at which the condition holds according to the solver.

        `exact` must agree with K = max(P, N), `lmi` with 2K.

        Args:
            a: `(n,)` floats.
            w1: `(n,)` floats.

        Returns:
            The rate, no unit, NaN where the solver fails; and the result of `solve` 5e-6 above it.

        Raises:
            CertifyError: a and w₁ that do not fit n, or values that are not finite.

        >>> rate, found = LMI(1, "exact").smallest_rate([0.5], [1.0])
        >>> round(rate, 6), found.verdict
        (0.5, 'certified')
        """
        a, w1 = self._check(a, w1)
        size = float(np.abs(a * w1).sum()) or 1.0  # κ is proportional to a: solve for one near 1
        self._check(a, w1, size)
        scale = _balance(a / size, w1)
        self._a.value, self._w1.value = a / size / scale, w1 * scale
        status, seconds = self._run(self.rate_problem)
        if status not in USABLE:
            return math.nan, self._nothing("unknown", math.nan, status, seconds)
        rate = size * math.sqrt(max(self._square.value.item(), TOLERANCE**2))
        found = self.solve(a, w1, rate * (1 + WIDENED))
        return rate, found._replace(seconds=seconds + found.seconds)

    def _check(self, a: Any, w1: Any, rate: float | Fraction = 1.0) -> tuple[np.ndarray, np.ndarray]:
        if not (math.isfinite(rate) and rate > 0):
            raise CertifyError(f"rate: found {rate}, expected a finite number above 0")
        a, w1 = np.asarray(a, dtype=np.float64), np.asarray(w1, dtype=np.float64)
        if a.shape != (self.n,) or w1.shape != (self.n,):
            raise CertifyError(
                f"a, w1: found the shapes {a.shape}, {w1.shape}, expected ({self.n},): make another LMI(n)"
            )
        with np.errstate(over="ignore", invalid="ignore"):
            scaled = a / float(rate)
            finite = np.isfinite([scaled, w1]).all() and np.isfinite(np.abs(scaled * w1).sum())
        if not finite:
            raise CertifyError("a, w1: found NaN or infinite values or products, expected weights of a usual size")
        return a, w1

    def _run(self, problem: Any) -> tuple[str, float]:
        """The solver's status and its time."""
        start = time.perf_counter()
        status = quietly(problem, self.solver, **self.options)
        return status, time.perf_counter() - start

    def _nothing(self, verdict: str, rate: float, status: str, seconds: float) -> Solution:
        nothing = np.full(self.n, math.nan)
        return Solution(self.condition, verdict, math.nan, rate, math.nan, nothing, status, self.solver, seconds)


def _balance(a: np.ndarray, w1: np.ndarray) -> np.ndarray:
    """The c_i with |a_i/c_i| = |c_i w_{1i}|, `(n,)`; a neuron with one weight, which has no slope, becomes faint."""
    size, weight = np.abs(a), np.abs(w1)
    safe = np.where(weight > 0, weight, 1.0)
    with np.errstate(over="ignore"):  # beyond the largest float is beyond FARTHEST
        one = np.where(size > 0, size / FAINT, np.where(weight > 0, FAINT / safe, 1.0))
    both = np.sqrt(size) / np.sqrt(safe)
    return np.where((size > 0) & (weight > 0), both, one).clip(1 / FARTHEST, FARTHEST)


def quietly(problem: Any, solver: str, **options: Any) -> str:
    """Solve a problem of cvxpy; the solver's status. Its output and its warnings are discarded."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            problem.solve(solver=solver, **options)
        status = problem.status
        found = [x.value for x in problem.variables()]
        if status in USABLE and not all(x is not None and np.isfinite(x).all() for x in found):
            status = "no finite values"
    except import_cvxpy().SolverError as error:
        status = f"SolverError: {str(error).strip().splitlines()[0]}"
    return status


def import_cvxpy(solver: str | None = None) -> Any:
    """cvxpy, imported when it is used because that takes a second. If a solver is given, check that it solves (1)."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import cvxpy as cp
    except ImportError as error:
        raise CertifyError("cvxpy is not installed, expected it for an LMI: run pip install 'usvlearn[lmi]'") from error
    if solver is not None:
        installed = cp.installed_solvers()
        expected = f"expected one of {', '.join(installed)}, of which CLARABEL is the default"
        if solver not in installed:
            raise CertifyError(
                f"solver: found {solver}, which is not installed: {expected} (pip install 'usvlearn[lmi]')"
            )
        try:
            cp.Problem(cp.Minimize(0), [cp.Variable((2, 2), PSD=True) >> 0]).get_problem_data(solver)
        except cp.SolverError as error:
            raise CertifyError(f"solver: {solver} takes no semidefinite programs: {expected}") from error
    return cp
