"""The smallest rate of a network with a vector state in a norm √(xᵀ P x), by semidefinite programming, and its proof.

M of (3) in `certify.proofs.vector_exact` is linear in P and the multipliers Λ at a fixed rate κ:

    t(κ) = max t   over P, Λ, t   with   M(P, Λ, κ) ⪰ t diag(ε P₀, P₀, ε Λ₀),   trace P₀⁻¹P = q                (1)

κ can be certified iff t(κ) > 0. (1) has an inner point and a bounded t for every κ, so that no program is infeasible.
Dinkelbach's iteration for generalised eigenvalues finds the smallest κ from above: the next κ is the smallest one that
P and Λ of (1) allow, and (P₀, Λ₀) are the last P and Λ, without which it needs twice as many programs. P and Λ of a
slightly larger κ are rounded to short fractions and proved in rational arithmetic: the solver only proposes them. (1)
is solved for the equal network of `certify.search.vector_balance`.
"""

from __future__ import annotations

import itertools
import math
import time
import warnings
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from certify.errors import CertifyError
from certify.networks.vector import Activation, VectorWeights, check, refuse_large
from certify.proofs.vector_exact import Proof, proves
from certify.search.vector_balance import Balanced, balance

USABLE = ("optimal", "optimal_inaccurate")  # answers of cvxpy
QUIET = np.errstate(all="ignore")  # weights near the ends of a float's range; what is claimed is proved in fractions
SMALLEST = 2.0**-12  # rate of the balanced network: one whose slopes are all zero has the rate 0, which is no κ
FLOOR = 0.01  # of P₀ and Λ₀: beside a singular P₀ the solver fails
EPSILON = 0.1  # of (1): 1 needs half as many programs again, 0.01 makes the solver fail now and then
WIDENED = (5e-6, 1e-4, 1e-3, 1e-2, 0.1)  # relative distances above the smallest rate at which a proof is tried
BITS = (12, 17, 22, 28, 36, 52)  # of the fractions of P and Λ
NEGLIGIBLE = 1e-20  # of the balanced network's R and A: the solver fails on such entries
PROGRAMS = 40  # at most, for one smallest rate
CLOSE = 1e-6  # relative decrease of κ at which the iteration ends
LARGEST_DENSE = 60  # rows of M with which a failed program is solved again without its sparsity
MOST = Fraction(64)  # κ of a program, far above the rate of a balanced network
SAMPLES = 50  # patterns, for a first κ


class Solved(NamedTuple):
    """The answer of a solver, and the result of checking it exactly."""

    rate: float  # the smallest rate by the solver; NaN where it fails
    kappa: Fraction | None  # the rate that P and Λ prove
    proof: Proof | None
    status: str  # as the solver reports it
    seconds: float  # wall time, with the exact proof


@QUIET
def smallest_rate(weights: VectorWeights, phi: Activation, most: int = 1, solver: str = "CLARABEL") -> Solved:
    """The smallest κ at which (1) has t > 0 according to the solver, and a proof at a κ slightly above it.

    Args:
        weights: of one network, one or two hidden layers.
        phi: gives the least slope α.
        most: β, no unit. 1: the slopes of relu. 2: the paper's Λ in place of 2Λ, slopes up to 2.
        solver: CLARABEL, or any installed solver of cvxpy that takes semidefinite programs.

    Returns:
        The solver's rate, and the κ that is proved exactly, with its P and Λ.

    Raises:
        CertifyError: weights that are no network or too large, a `most` other than 1 and 2, no such solver.

    >>> from certify.networks.vector import RELU
    >>> net = VectorWeights(None, [[0.5, -1.0]], [[1.0], [0.75]], np.zeros((2, 0)), [0.0, 0.0])
    >>> answer = smallest_rate(net, RELU)
    >>> round(answer.rate, 5), 0.75 < answer.kappa < 0.7501
    (0.75, True)
    """
    start, weights = time.perf_counter(), _one(weights, most)
    program = Program(balance(weights), phi, most, solver)
    size = Fraction(program.network.size)
    kappa, high = 1.5 * max(SMALLEST, _largest_sampled_slope(program.network, phi, most)), math.inf
    status = ""
    while program.solved < PROGRAMS:
        margin, x, status = program.solve(kappa)
        if x is None or not margin > 0:
            if math.isfinite(high) or x is None:
                break
            kappa *= 2
            continue
        high = max(min(program.proved(x, kappa), kappa), SMALLEST)
        program.scale_by(x)
        if high > kappa * (1 - CLOSE):
            break
        kappa = high

    rate, exact, proof = high * float(size) if math.isfinite(high) else math.nan, None, None
    for widened in WIDENED if math.isfinite(high) else ():
        short = _short(high * (1 + widened))
        _, x, status = program.solve(float(short))
        if x is not None and (proof := program.proof(weights, x, short * size)):
            exact = short * size
            break
    return Solved(rate, exact, proof, status, time.perf_counter() - start)


def _one(weights: VectorWeights, most: int) -> VectorWeights:
    weights = check(weights)
    if weights.b.ndim != 1:
        raise CertifyError(f"weights: found a batch of shape {weights.b.shape[:-1]}, expected one network")
    refuse_large(weights)
    if most not in (1, 2):
        raise CertifyError(f"most: found {most}, expected 1 (slopes up to 1) or 2 (the paper's Λ, slopes up to 2)")
    return weights


def _largest_sampled_slope(network: Balanced, phi: Activation, most: int) -> float:
    """The largest spectral radius of R + A D W over some D: no rate is smaller. D is 0, β I, or drawn from one seed."""
    generator, largest = np.random.default_rng(0), 0.0
    for k in range(SAMPLES):
        J = np.eye(len(network.R))
        for layer, X in enumerate(network.layers):
            J = X @ J
            if layer < len(network.layers) - 1:
                on = generator.random(len(X)) < (0.0, 1.0, 0.5)[min(k, 2)]
                J *= np.where(on, float(most), float(phi.least))[:, None]
        largest = max(largest, float(np.abs(np.linalg.eigvals(network.R + J)).max()))
    return largest


def _short(kappa: float) -> Fraction:
    """A fraction of 26 bits that is κ or just above it."""
    mantissa, exponent = math.frexp(kappa)
    return Fraction(math.ceil(mantissa * 2**26)) * Fraction(2) ** (exponent - 26)


class Program:
    """(1) for one balanced network; the unknowns are the upper triangle of P, then Λ, then t.

    M is the sum of the unknowns times matrices, of which only those of P depend on κ.
    """

    def __init__(self, network: Balanced, phi: Activation, most: int, solver: str) -> None:
        self.network, self.phi, self.most, self.solver, self.solved = network, phi, most, solver.upper(), 0
        alpha, beta = float(phi.least), float(most)
        R, hidden, A = network.R, network.layers[:-1], network.layers[-1]
        self.q, self.widths = len(R), [len(X) for X in hidden]
        parts = [slice(i, j) for i, j in itertools.pairwise(itertools.accumulate([0, self.q, self.q, *self.widths]))]
        first, self.state, last = parts[0], parts[1], parts[-1]
        self.size = 2 * self.q + sum(self.widths)
        self.corners = list(zip(*(x.tolist() for x in np.triu_indices(self.q)), strict=True))  # of P's upper triangle
        count = len(self.corners) + sum(self.widths) + 1
        self.fixed, self.square = np.zeros((2, count, self.size, self.size))  # M = Σ x_k (fixed_k + κ² square_k)
        for k, (i, j) in enumerate(self.corners):
            P = np.zeros((self.q, self.q))
            P[[i, j], [j, i]] = 1.0
            for part, block in ((first, P), (self.state, P @ R), (last, P @ A)):
                self.fixed[k][first, part], self.fixed[k][part, first] = block, block.T
            self.square[k][self.state, self.state] = P
        self.fixed[np.abs(self.fixed) < NEGLIGIBLE] = 0.0
        k = len(self.corners)
        for X, into, place in zip(hidden, parts[1:], parts[2:], strict=False):
            for i, row in enumerate(X, place.start):
                self.fixed[k][i, i] = 2.0
                self.fixed[k][into, i] = self.fixed[k][i, into] = -(alpha + beta) * row
                self.fixed[k][into, into] += 2 * alpha * beta * np.outer(row, row)
                k += 1
        self._import()
        self._scale(np.eye(self.q), np.ones(sum(self.widths)))

    def _import(self) -> None:
        """The solver, and for Clarabel the upper triangles of the matrices, column by column."""
        if self.solver != "CLARABEL":
            import_cvxpy(self.solver)
            return
        _clarabel()
        from scipy.sparse import csc_matrix

        self._fixed, self._square = (csc_matrix(-self._triangle(X).T) for X in (self.fixed, self.square))

    def _triangle(self, X: np.ndarray) -> np.ndarray:
        j, i = np.tril_indices(self.size)
        return X[..., i, j] * np.where(i == j, 1.0, math.sqrt(2))

    def matrix(self, x: np.ndarray, kappa: float) -> np.ndarray:
        """M(P, Λ, κ)."""
        return np.tensordot(x[:-1], self.fixed[:-1], 1) + kappa**2 * np.tensordot(x[:-1], self.square[:-1], 1)

    def scale_by(self, x: np.ndarray) -> None:
        """The P₀ and Λ₀ of the next programs are the P and Λ among these unknowns, in bounds."""
        P, lam = np.tensordot(x, self.square, 1)[self.state, self.state], x[len(self.corners) : -1]
        unit = max(np.trace(P), 1e-300) / self.q
        self._scale(P / unit + FLOOR * np.eye(self.q), (lam / unit).clip(FLOOR, 1 / FLOOR))

    def _scale(self, P: np.ndarray, lam: np.ndarray) -> None:
        E, q = np.zeros((self.size, self.size)), self.q
        E[:q, :q], E[q : 2 * q, q : 2 * q], E[2 * q :, 2 * q :] = EPSILON * P, P, EPSILON * np.diag(lam)
        inverse = np.linalg.inv(P)
        self.scaling, self.fixed[-1] = E, -E
        self.trace = np.zeros(len(self.fixed))
        self.trace[: len(self.corners)] = [inverse[i, j] * (1 if i == j else 2) for i, j in self.corners]

    def solve(self, kappa: float) -> tuple[float, np.ndarray | None, str]:
        """t, the unknowns and the solver's status; t is NaN and the unknowns None where the solver fails."""
        self.solved += 1
        x, status = self._by_clarabel(kappa) if self.solver == "CLARABEL" else self._by_cvxpy(kappa)
        if x is None or not np.isfinite(x).all():
            return math.nan, None, status
        back = np.linalg.inv(np.linalg.cholesky(self.scaling))
        return float(np.linalg.eigvalsh(back @ self.matrix(x, kappa) @ back.T)[0]), x, status  # t as it is reached

    def _by_clarabel(self, kappa: float) -> tuple[np.ndarray | None, str]:
        from scipy.sparse import csc_matrix, hstack, vstack

        clarabel, count = _clarabel(), len(self.fixed)
        unknowns = (self._fixed + kappa**2 * self._square)[:, :-1]
        A = vstack([csc_matrix(self.trace), hstack([unknowns, csc_matrix(self._triangle(self.scaling)[:, None])])])
        b = np.zeros(1 + self.size * (self.size + 1) // 2)
        b[0] = self.q
        cones = [clarabel.ZeroConeT(1), clarabel.PSDTriangleConeT(self.size)]
        none, objective, settings = csc_matrix((count, count)), -np.eye(count)[-1], clarabel.DefaultSettings()
        settings.verbose = settings.chordal_decomposition_compact = False  # compact fails near the smallest κ
        for settings.chordal_decomposition_enable in (True, False):
            solution = clarabel.DefaultSolver(none, objective, A.tocsc(), b, cones, settings).solve()
            if str(solution.status) in ("Solved", "AlmostSolved") or self.size > LARGEST_DENSE:
                break
        return np.array(solution.x), str(solution.status)

    def _by_cvxpy(self, kappa: float) -> tuple[np.ndarray | None, str]:
        cp = import_cvxpy()
        x, flat = cp.Variable(len(self.fixed)), (self.fixed + kappa**2 * self.square).reshape(len(self.fixed), -1)
        M = cp.reshape(flat.T @ x, (self.size, self.size), order="C")
        problem = cp.Problem(cp.Maximize(x[-1]), [(M + M.T) / 2 >> 0, self.trace @ x == self.q])
        status = quietly(problem, self.solver)
        return x.value, status

    def proved(self, x: np.ndarray, kappa: float) -> float:
        """The smallest κ at which M is positive semidefinite with the P and Λ of a larger one, where t > 0."""
        M, state = self.matrix(x, 0.0), self.state
        others = np.delete(np.arange(len(M)), state)
        cross = M[state, others]
        try:
            root = np.linalg.inv(np.linalg.cholesky(np.tensordot(x, self.square, 1)[state, state]))
            least = root @ (cross @ np.linalg.solve(M[np.ix_(others, others)], cross.T) - M[state, state]) @ root.T
            square = float(np.linalg.eigvalsh((least + least.T) / 2)[-1])
        except np.linalg.LinAlgError:
            return kappa
        return math.sqrt(max(square, 0.0)) if math.isfinite(square) else kappa

    def proof(self, weights: VectorWeights, x: np.ndarray, kappa: Fraction) -> Proof | None:
        """The shortest fractions near the unknowns that prove κ for the weights as given; None if there are none."""
        count, scaled = len(self.corners), float(min(kappa / Fraction(self.network.size), MOST))
        for bits in BITS:
            P = [[Fraction(0)] * self.q for _ in range(self.q)]
            for (i, j), value in zip(self.corners, x.tolist(), strict=False):
                P[i][j] = P[j][i] = Fraction(round(value * 2**bits), 2**bits)
            lam = [_rounded(value, bits) for value in x[count:-1].tolist()]
            near = np.array([*(float(P[i][j]) for i, j in self.corners), *map(float, lam), 0.0])
            if min(lam, default=1) <= 0 or np.linalg.eigvalsh(self.matrix(near, scaled))[0] <= 0:
                continue
            values = iter(lam)
            proof = self.network.proof(P, [[next(values) for _ in range(width)] for width in self.widths])
            if proves(weights, self.phi, proof, kappa, Fraction(self.most)):
                return proof
        return None


def _rounded(value: float, bits: int) -> Fraction:
    """A fraction with so many significant bits."""
    mantissa, exponent = math.frexp(value)
    return Fraction(round(mantissa * 2**bits)) * Fraction(2) ** (exponent - bits)


def _clarabel() -> Any:
    """The solver; it has no types."""
    try:
        import clarabel
        from scipy.sparse import csc_matrix  # noqa: F401
    except ImportError as error:
        raise CertifyError(
            "clarabel is not installed, expected it for an LMI: run pip install 'usvlearn[lmi]'"
        ) from error
    return clarabel


def quietly(problem: Any, solver: str, **options: Any) -> str:
    """Solve a problem of cvxpy; the solver's status. Its output and its warnings are discarded."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            problem.solve(solver=solver, **options)
        status = problem.status
        values = [x.value for x in problem.variables()]
        if status in USABLE and not all(x is not None and np.isfinite(x).all() for x in values):
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
