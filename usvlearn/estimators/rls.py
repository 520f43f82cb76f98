"""Recursive least squares with exponential forgetting, for any model that is linear in its parameters.

With y the part of the speed that φᵀθ explains, and λ the forgetting factor (Plackett 1950; paper, section IV-D):

    s = λ + φᵀPφ,   K = Pφ/s,   θ⁺ = θ + K (y − φᵀθ),   P⁺ = (P − Pφ φᵀP/s)/λ        (1)

which minimises Σ λ^(k−j) (y_j − φ_jᵀθ)² + λ^k θᵀP₀⁻¹θ. Computed in the square-root form of Potter, P = S Sᵀ,
f = Sᵀφ:

    S⁺ = (S − S f fᵀ / (s + √(λ s))) / √λ                                              (2)

The textbook's P − K (φᵀP) multiplies its rounding asymmetry by 1/λ at every step and diverges within minutes; S Sᵀ is
symmetric and positive by construction. Where data stop informing a direction, P grows there without bound: forgetting
pauses wherever it would lift the trace of P over a limit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from usvlearn.errors import check_choice, check_positive
from usvlearn.estimator import Estimator
from usvlearn.estimators.regressors import QuasiStatic
from usvlearn.hyper import Positive, UnitInterval, as_tensor, check_broadcast
from usvlearn.signals import Inputs


class RLSState(NamedTuple):
    """What RLS identifies."""

    theta: Tensor  # (*batch, p) parameters
    factor: Tensor  # (*batch, p, p) S, a square root of the covariance
    surge: Tensor  # (*batch,) speed from which the next step departs, m/s

    @property
    def covariance(self) -> Tensor:
        """P = S Sᵀ, `(*batch, p, p)`, in units of the measurement noise's variance."""
        return self.factor @ self.factor.mT


def rls_step(
    theta: Tensor,  # (*batch, p)
    factor: Tensor,  # (*batch, p, p)
    phi: Tensor,  # (*batch, p)
    innovation: Tensor,  # (*batch,) y − φᵀθ
    forgetting: Tensor,  # (*batch,) or ()
    trace_max: float | Tensor = torch.inf,
) -> tuple[Tensor, Tensor]:
    """One measurement update of (θ, S), equations (1) and (2).

    >>> theta, factor = torch.zeros(1), torch.eye(1) * 1e3
    >>> theta, factor = rls_step(theta, factor, torch.ones(1), torch.tensor(2.0), torch.tensor(1.0))
    >>> round(float(theta), 3)
    2.0
    """
    lam = forgetting[..., None]
    f = (factor * phi[..., None]).sum(-2)  # Sᵀφ
    P_phi = (factor * f[..., None, :]).sum(-1)
    s = lam + (f * f).sum(-1, keepdim=True)
    theta = theta + P_phi * (innovation[..., None] / s)
    factor = factor - P_phi[..., None] * (f / (s + (lam * s).sqrt()))[..., None, :]
    trace = (factor * factor).sum((-2, -1))
    growth = torch.where(trace < trace_max * forgetting, forgetting, 1.0).rsqrt()
    return theta, factor * growth[..., None, None]


class RLS(Estimator):
    """Recursive least squares: the quasi-static thruster map, or the surge dynamics.

    Args:
        model: `QuasiStatic()` predicts the speed itself (the paper's RLS); `SurgeDynamics(mass)` its increment.
        forgetting: λ, between 0 and 1; broadcasts against the batch.
        covariance: P₀ = covariance·scale²·I, where scale is the model's (1, or the mass); broadcasts against the batch.
        trace_growth: nothing is forgotten that would lift the trace of P above so many times its first value.
        feedback: "measured" predicts from the last measured speed, "estimate" from the estimator's own.
        surge_max: physical limit of the prediction, m/s.

    >>> from usvlearn.estimators.regressors import SurgeDynamics
    >>> dynamic = RLS(SurgeDynamics(mass=28.0), forgetting=0.995, covariance=10.0)
    >>> dynamic.init((3,)).covariance.shape
    torch.Size([3, 9, 9])
    """

    def __init__(
        self,
        model: nn.Module | None = None,
        forgetting=0.995,
        covariance=10.0,
        trace_growth: float = 100.0,
        feedback: str = "measured",
        surge_max: float = 10.0,
    ):
        super().__init__()
        self.feedback = check_choice("feedback", feedback, ("measured", "estimate"))
        self.surge_max = check_positive("surge_max", surge_max, "of m/s")
        self.model = QuasiStatic() if model is None else model
        self.forgetting = UnitInterval(forgetting, "forgetting")
        self.covariance = Positive(covariance, "covariance")
        growth = check_positive("trace_growth", trace_growth) * len(self.model.names)
        self.register_buffer("trace_max", growth * as_tensor(covariance) * self.model.scale**2)

    def init(self, batch: Sequence[int] = ()) -> RLSState:
        check_broadcast(self, tuple(batch))
        p, like = len(self.model.names), self.covariance.log
        eye = torch.eye(p, dtype=like.dtype, device=like.device)
        root = self.covariance().sqrt() * self.model.scale
        factor = (root[..., None, None] * eye).expand(*batch, p, p)
        return RLSState(like.new_zeros((*batch, p)), factor, like.new_zeros(tuple(batch)))

    def predict(self, state: RLSState, inputs: Inputs) -> tuple[RLSState, Tensor]:
        base, phi = self.model(state.surge, inputs)
        surge = (base + (phi * state.theta).sum(-1)).clamp(-self.surge_max, self.surge_max)
        return state._replace(surge=surge), surge

    def update(self, state: RLSState, inputs: Inputs, surge: Tensor) -> RLSState:
        base, phi = self.model(state.surge, inputs)
        estimate = base + (phi * state.theta).sum(-1)
        theta, factor = rls_step(state.theta, state.factor, phi, surge - estimate, self.forgetting(), self.trace_max)
        if self.feedback == "estimate":
            surge = estimate.clamp(-self.surge_max, self.surge_max)
        return RLSState(theta, factor, surge)

    def start(self, state: RLSState, surge: Tensor) -> RLSState:
        return state._replace(surge=surge)

    def monitor(self, state: RLSState) -> dict[str, Tensor]:
        parameters = dict(zip(self.model.names, state.theta.unbind(-1), strict=True))
        return {**parameters, "covariance_trace": (state.factor**2).sum((-2, -1))}
