"""Recursive least squares that forgets only what it learns anew: SIFt-RLS (Lai & Bernstein 2024, arXiv 2404.10844).

Equations (1) and (2): `docs/theory/estimators.md#sift`. p² operations in all, without a loop over parameters.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from usvlearn.core.hyperparameters import Hyper, Positive
from usvlearn.errors import check_not_negative
from usvlearn.estimators.least_squares.rls import LeastSquares, measured, triangle
from usvlearn.estimators.least_squares.state import LONGEST
from usvlearn.estimators.regressors.layer import LinearModel


def sift_step(
    theta: Tensor,  # (*batch, p)
    factor: Tensor,  # (*batch, p, p)
    phi: Tensor,  # (*batch, p)
    innovation: Tensor,  # (*batch,) y − φᵀθ
    forgetting: Tensor,  # (*batch,) λ
    informs: Tensor | bool = True,  # (*batch,) bool: nothing changes where it is False
) -> tuple[Tensor, Tensor]:
    """One measurement update of (θ, S), equations (1) and (2)."""
    informs = (informs if isinstance(informs, Tensor) else torch.full_like(innovation, informs, dtype=torch.bool))[
        ..., None
    ]
    safe = torch.where(informs, phi, 1.0)  # the values of an uninformative sample must not reach the gradients
    x = torch.linalg.solve_triangular(factor, safe[..., None], upper=False).squeeze(-1)
    sums = (x * x).cumsum(-1)
    c = (1 / forgetting[..., None] - 1) / sums[..., -1:]
    t = 1 + c * sums
    before = torch.cat([torch.ones_like(c), t[..., :-1]], -1)
    opened = factor @ triangle(c * x, x, before, t)  # (2)
    theta_new, factor_new = measured(theta, opened, safe, innovation)
    return torch.where(informs, theta_new, theta), torch.where(informs[..., None], factor_new, factor)


class SIFtRLS(LeastSquares):
    """Recursive least squares with subspace-of-information forgetting.

    Lai & Bernstein 2024, arXiv 2404.10844.

    Args:
        model: `QuasiStatic()`, the default, predicts the speed itself; `SurgeDynamics(mass)` its increment.
        memory: τ, s, per direction; broadcasts against the batch.
        covariance: P₀ = covariance·scale²·I, where scale is the model's (1, or the mass); in units of σ², as of `RLS`,
            no unit; broadcasts against the batch.
        floor: ε, the least |φ|² in units of the model's scale, no unit: below it a regressor informs nothing.
        feedback: "measured" predicts from the last measured speed, "estimate" from the estimator's own.
        surge_max: physical limit of the prediction, m/s.

    Raises:
        ConfigError: a number outside its range, or another feedback.

    >>> from usvlearn.estimators.regressors.layer import SurgeDynamics
    >>> SIFtRLS(SurgeDynamics(mass=28.0), memory=30.0).init((3,)).theta.shape
    torch.Size([3, 9])
    """

    def __init__(
        self,
        model: LinearModel | None = None,
        memory: Hyper = 30.0,
        covariance: Hyper = 10.0,
        floor: float = 1e-3,
        feedback: str = "measured",
        surge_max: float = 10.0,
    ):
        super().__init__(model, covariance, feedback, surge_max)
        self.memory = Positive(memory, "memory")
        self.floor = check_not_negative("floor", floor)

    def description(self) -> dict[str, Any] | None:
        return self._spec("sift", longest=LONGEST)

    def _step(
        self, theta: Tensor, factor: Tensor, phi: Tensor, innovation: Tensor, dt: Tensor
    ) -> tuple[Tensor, Tensor]:
        forgetting = (-(dt / self.memory()).clamp(max=LONGEST)).exp()
        squared = (phi * phi).sum(-1) * self.model.scale**2
        return sift_step(theta, factor, phi, innovation, forgetting, (squared >= self.floor) & (squared > 0))
