"""Least squares with the signs that physics gives the parameters: drag slows a boat, a thruster pushes it.

After each update the parameters go to the nearest that have their signs, in the metric of the information R = P⁻¹, in
which a move costs as much as it worsens the fit to the samples:

    min (θ − z)ᵀ P⁻¹ (θ − z)   such that   s_i θ_i ≥ 0                                      (1)

With t = Sθ of the constrained parameters, S = diag(s), Q = S P S and multipliers μ ≥ 0 the solution is θ = z + P S μ,
with μ_i t_i = 0. The primal-dual active set method (Hintermüller, Ito & Kunisch 2003) guesses which are held at 0,

    A = { i : μ_i > t_i/Q_ii },   Q_AA μ_A = −(S z)_A,   μ = 0 elsewhere,   t = S z + Q μ          (2)

and is exact once A repeats, as a rule after two or three rounds; where parameters are scaled very differently it may
not, and θ is clipped. Clipping alone is no projection: the errors of strongly correlated parameters cancel, and if one
parameter is clipped alone, the error of the other remains (on recorded logs this is far worse than no prediction).

Q holds the products of the rows of the factor √P, so the condition number of (2) is the square of that of √P. θ is
known to about cond(P) ε, relative to its largest entry, ε = 2.2e-16. On usual samples cond(P) is below 1e6. Commands
of 99.9, whose terms differ by a factor of 1e4, bring it to 1e13: torch and the kernel then differ by up to 1e-4,
neither being nearer to (1). A test holds both to this bound.

The derivation is in `docs/theory/estimators.md#signs`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from usvlearn.core.protocol import Estimator, spec_of
from usvlearn.core.samples import Inputs
from usvlearn.errors import ConfigError
from usvlearn.estimators.least_squares.rls import LeastSquares
from usvlearn.estimators.least_squares.state import ROUNDS, RLSState


def held_by(signs: Sequence[int]) -> tuple[Tensor, Tensor]:
    """The places of the parameters whose signs are held, and these signs, `(held,)` each.

    >>> held_by((-1, 0, 1))
    (tensor([0, 2]), tensor([-1.,  1.], dtype=torch.float64))
    """
    places = [i for i, sign in enumerate(signs) if sign]
    return torch.tensor(places, dtype=torch.long), torch.tensor([signs[i] for i in places], dtype=torch.float64)


def project_signs(theta: Tensor, factor: Tensor, places: Tensor, S: Tensor, iterations: int) -> Tensor:
    """The solution of (1) after so many rounds of (2); the clipped θ where they did not suffice.

    `places` and `S` are what `held_by` returns, on the device of the parameters.

    >>> theta, factor = torch.tensor([1.0, -1.0]).double(), torch.tensor([[1.0, 0.0], [0.5, 1.0]]).double()
    >>> project_signs(theta, factor, *held_by((1, 1)), 4)  # the first moves too: they are correlated
    tensor([1.4000, 0.0000], dtype=torch.float64)
    """
    if not len(places):
        return theta
    rows = S[:, None] * factor.index_select(-2, places)
    Q, z = rows @ rows.mT, S * theta.index_select(-1, places)
    diagonal = Q.diagonal(dim1=-2, dim2=-1)
    t, multipliers = z, torch.zeros_like(z)
    for _ in range(iterations):
        active = multipliers > t / diagonal  # (2)
        both = active[..., None] & active[..., None, :]
        system = torch.where(both, Q, torch.diag_embed(diagonal))
        multipliers = torch.linalg.solve_ex(system, torch.where(active, -z, 0.0)[..., None])[0].squeeze(-1)
        t = torch.where(active, 0.0, z + (Q @ multipliers[..., None]).squeeze(-1))
    moved = theta + (factor @ (rows.mT @ multipliers[..., None])).squeeze(-1)
    tolerance = 1e-6 * z.abs().amax(-1, keepdim=True)
    solved = (t >= -tolerance).all(-1) & (multipliers * diagonal >= -tolerance).all(-1)
    moved, t = torch.where(solved[..., None], moved, theta), torch.where(solved[..., None], t, z)
    return moved.index_copy(-1, places, S * t.clamp(min=0))


class Projected(Estimator):
    """RLS or SIFtRLS whose parameters keep their signs.

    The active set method is that of Hintermüller, Ito & Kunisch 2003.

    Args:
        estimator: RLS or SIFtRLS.
        signs: −1, 0 (free) or 1 for each parameter, `(p,)`; those of the estimator's model by default.
        iterations: number of rounds of (2) after each update, 1000 at most.

    Raises:
        ConfigError: another estimator, signs that are not one for each parameter, or an illegal number of rounds.

    >>> from usvlearn import SIFtRLS, SurgeDynamics
    >>> Projected(SIFtRLS(SurgeDynamics(28.0))).signs
    (-1, -1, -1, 1, 1, -1, 1, 1, -1)
    """

    places: Tensor  # (held,) of the parameters whose signs are held
    held: Tensor  # (held,) these signs

    frozen = LeastSquares.frozen

    def __init__(self, estimator: LeastSquares, signs: Sequence[int] | None = None, iterations: int = 4):
        super().__init__()
        if not isinstance(estimator, LeastSquares):
            raise ConfigError(f"estimator: found {type(estimator).__name__}, expected RLS or SIFtRLS itself")
        self.estimator = estimator
        self.signs: tuple[int, ...] = tuple(estimator.model.signs if signs is None else signs)
        if len(self.signs) != len(estimator.model.names) or not set(self.signs) <= {-1, 0, 1}:
            raise ConfigError(
                f"signs: found {list(self.signs)}, expected -1, 0 or 1 for each of the "
                f"{len(estimator.model.names)} parameters"
            )
        if not (isinstance(iterations, int) and 1 <= iterations <= ROUNDS):
            raise ConfigError(f"iterations: found {iterations!r}, expected a whole number, 1 … {ROUNDS}")
        self.iterations = iterations
        places, held = held_by(self.signs)
        self.register_buffer("places", places, persistent=False)
        self.register_buffer("held", held, persistent=False)

    def init(self, batch: Sequence[int] = ()) -> RLSState:
        return self.estimator.init(batch)

    def predict(self, state: RLSState, inputs: Inputs) -> tuple[RLSState, Tensor]:
        return self.estimator.predict(state, inputs)

    def update(self, state: RLSState, inputs: Inputs, surge: Tensor) -> RLSState:
        return self.learn(state, inputs, surge)[0]

    def learn(self, state: RLSState, inputs: Inputs, surge: Tensor) -> tuple[RLSState, Tensor]:
        state, predicted = self.estimator.learn(state, inputs, surge)
        return state._replace(
            theta=project_signs(state.theta, state.factor, self.places, self.held, self.iterations)
        ), predicted

    def start(self, state: RLSState, surge: Tensor) -> RLSState:
        return self.estimator.start(state, surge)

    def inflate_covariance(self, state: RLSState, factor: Tensor) -> RLSState:
        return self.estimator.inflate_covariance(state, factor)

    def description(self) -> dict[str, Any] | None:
        inner = spec_of(self.estimator)
        return inner and {
            **inner,
            "signs": list(map(int, self.signs)),
            "iterations": int(self.iterations) if any(self.signs) else 0,
        }

    def monitor(self, state: RLSState) -> dict[str, Tensor]:
        return self.estimator.monitor(state)
