"""Recursive least squares with exponential forgetting in torch: equations (1) to (3) of `state`."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from usvlearn.core.family import FEEDBACK
from usvlearn.core.hyperparameters import Hyper, Positive, UnitInterval, as_tensor, check_broadcast
from usvlearn.core.protocol import Estimator, describe, spec_of
from usvlearn.core.samples import Inputs
from usvlearn.errors import check_choice, check_positive
from usvlearn.estimators.ensemble.monitors.layer import excitation_report
from usvlearn.estimators.least_squares.state import FAMILY, NOISE, NOISE_LEAST, NOISE_SHARE, RLSState
from usvlearn.estimators.regressors.layer import LinearModel, QuasiStatic, linearised


def triangle(
    x: Tensor,  # (*batch, p)
    y: Tensor,  # (*batch, p)
    before: Tensor,  # (*batch, p)
    after: Tensor,  # (*batch, p)
) -> Tensor:
    """T of (2), `(*batch, p, p)`: √(after/before) on the diagonal, x_i y_j/√(before_j after_j) below it."""
    below = x[..., :, None] * (y / (before * after).sqrt())[..., None, :]
    return below.tril(-1) + torch.diag_embed((after / before).sqrt())


def measured(
    theta: Tensor,  # (*batch, p)
    factor: Tensor,  # (*batch, p, p)
    phi: Tensor,  # (*batch, p)
    innovation: Tensor,  # (*batch,) y − φᵀθ
    lam: Tensor | float = 1.0,  # (*batch,) or ()
) -> tuple[Tensor, Tensor]:
    """One measurement update of (θ, S): equations (1) and (2), without the division by √λ."""
    f = (factor * phi[..., None]).sum(-2)  # Sᵀφ
    lam = (lam.to(phi.dtype) if isinstance(lam, Tensor) else phi.new_full((), lam))[..., None]
    before = lam + (f * f).flip(-1).cumsum(-1).flip(-1)  # α_{j−1}
    after = torch.cat([before[..., 1:], lam.expand_as(before[..., :1])], -1)  # α_j
    theta = theta + (factor * f[..., None, :]).sum(-1) * (innovation[..., None] / before[..., :1])
    return theta, factor @ triangle(f, -f, before, after)


def rls_step(
    theta: Tensor,  # (*batch, p)
    factor: Tensor,  # (*batch, p, p)
    phi: Tensor,  # (*batch, p)
    innovation: Tensor,  # (*batch,) y − φᵀθ
    forgetting: Tensor,  # (*batch,) or ()
    trace_max: float | Tensor = torch.inf,
) -> tuple[Tensor, Tensor]:
    """One measurement update of (θ, S) with forgetting, which pauses at `trace_max`."""
    theta, factor = measured(theta, factor, phi, innovation, forgetting)
    trace = (factor * factor).sum((-2, -1))
    growth = torch.where(trace < trace_max * forgetting, forgetting, 1.0).rsqrt()
    return theta, factor * growth[..., None, None]


class LeastSquares(Estimator):
    """The common part of all recursive least squares; a subclass defines in `_step` how it forgets.

    The estimate of the noise, and its part in a prediction, are derived in `docs/theory/estimators.md`, RLS.

    Args:
        model: `QuasiStatic()` predicts the speed itself (the paper's RLS); `SurgeDynamics(mass)` its increment.
        covariance: P₀ = covariance·scale²·I, where scale is the model's (1, or the mass); in units of σ², no unit;
            broadcasts against the batch.
        feedback: "measured" predicts from the last measured speed, "estimate" from the estimator's own.
        surge_max: physical limit of the prediction, m/s.

    Raises:
        ConfigError: a number outside its range, or another feedback.

    >>> from usvlearn import RLS, SIFtRLS
    >>> issubclass(RLS, LeastSquares), issubclass(SIFtRLS, LeastSquares)
    (True, True)
    """

    model: LinearModel

    frozen = FAMILY.frozen

    def __init__(self, model: LinearModel | None, covariance: Hyper, feedback: str, surge_max: float):
        super().__init__()
        self.feedback = check_choice("feedback", feedback, FEEDBACK)
        self.surge_max = check_positive("surge_max", surge_max, "of m/s")
        self.model = QuasiStatic() if model is None else model
        self.covariance = Positive(covariance, "covariance")

    @abc.abstractmethod
    def _step(
        self, theta: Tensor, factor: Tensor, phi: Tensor, innovation: Tensor, dt: Tensor
    ) -> tuple[Tensor, Tensor]:
        """One measurement update of (θ, S)."""

    def init(self, batch: Sequence[int] = ()) -> RLSState:
        check_broadcast(self, tuple(batch))
        p, like = len(self.model.names), self.covariance.log
        eye = torch.eye(p, dtype=like.dtype, device=like.device)
        root = self.covariance().sqrt() * self.model.scale
        factor = (root[..., None, None] * eye).expand(*batch, p, p)
        zero, noise = like.new_zeros(tuple(batch)), like.new_full(tuple(batch), NOISE**2)
        return RLSState(like.new_zeros((*batch, p)), factor, zero, noise, zero)

    def predict(self, state: RLSState, inputs: Inputs) -> tuple[RLSState, Tensor]:
        base, phi = linearised(self.model, state.surge, inputs, state.theta)
        surge = self._limit(base + (phi * state.theta).sum(-1))
        return state._replace(surge=surge, deviation=(state.noise * spread(state.factor, phi)).sqrt()), surge

    def update(self, state: RLSState, inputs: Inputs, surge: Tensor) -> RLSState:
        return self.learn(state, inputs, surge)[0]

    def learn(self, state: RLSState, inputs: Inputs, surge: Tensor) -> tuple[RLSState, Tensor]:
        base, phi = linearised(self.model, state.surge, inputs, state.theta)
        estimate = base + (phi * state.theta).sum(-1)
        innovation, s = surge - estimate, spread(state.factor, phi)
        theta, factor = self._step(state.theta, state.factor, phi, innovation, inputs.dt)
        # An outlier counts as four deviations at most, so that σ stays bounded.
        seen = torch.minimum(innovation * innovation / s, 16 * state.noise)
        noise = torch.lerp(state.noise, seen, NOISE_SHARE).clamp(min=NOISE_LEAST**2)
        predicted, deviation = self._limit(estimate), (state.noise * s).sqrt()
        departs = predicted if self.feedback == "estimate" else surge
        return RLSState(theta, factor, departs, noise, deviation), predicted

    def start(self, state: RLSState, surge: Tensor) -> RLSState:
        return state._replace(surge=surge)

    def _spec(self, kind: str, **own: Any) -> dict[str, Any] | None:
        """`description` of a kind; numbers that are not attributes are `own`."""
        if (terms := spec_of(self.model)) is None:
            return None
        p, scale = len(self.model.names), self.model.scale
        prior = p * self.covariance() * scale**2
        return describe(FAMILY, self, kind=kind, size=p, terms=terms, prior=prior, scale=scale, **own)

    def monitor(self, state: RLSState) -> dict[str, Tensor]:
        parameters = dict(zip(self.model.names, state.theta.unbind(-1), strict=True))
        trace = (state.factor**2).sum((-2, -1))
        prior = (self.covariance() * self.model.scale**2)[..., None]
        informed = excitation_report(self.model.names, state.factor, prior)
        return {**parameters, **informed, "covariance_trace": trace, "deviation": state.deviation}

    def _limit(self, surge: Tensor) -> Tensor:
        return surge.clamp(-self.surge_max, self.surge_max)


def spread(factor: Tensor, phi: Tensor) -> Tensor:
    """1 + φᵀPφ, `(*batch,)`."""
    f = (factor * phi[..., None]).sum(-2)
    return 1 + (f * f).sum(-1)


class RLS(LeastSquares):
    """Recursive least squares with exponential forgetting: the quasi-static thruster map, or the surge dynamics.

    Plackett 1950; paper, section IV-D. The square-root form is that of Carlson 1973.

    Args:
        model: `QuasiStatic()`, the default, predicts the speed itself (the paper's RLS); `SurgeDynamics(mass)` its
            increment.
        forgetting: λ, between 0 and 1, no unit; broadcasts against the batch.
        covariance: P₀ = covariance·scale²·I, where scale is the model's (1, or the mass); no unit, because P is in
            units of σ²; broadcasts against the batch.
        trace_growth: forgetting pauses where it would lift the trace of P above this multiple of its first value, no
            unit.
        feedback: "measured" predicts from the last measured speed, "estimate" from the estimator's own.
        surge_max: physical limit of the prediction, m/s.

    Raises:
        ConfigError: a number outside its range, or another feedback.

    >>> from usvlearn.estimators.regressors.layer import SurgeDynamics
    >>> dynamic = RLS(SurgeDynamics(mass=28.0), forgetting=0.995, covariance=10.0)
    >>> dynamic.init((3,)).covariance.shape
    torch.Size([3, 9, 9])
    """

    trace_max: Tensor  # as the covariance

    def __init__(
        self,
        model: LinearModel | None = None,
        forgetting: Hyper = 0.995,
        covariance: Hyper = 10.0,
        trace_growth: float = 100.0,
        feedback: str = "measured",
        surge_max: float = 10.0,
    ):
        super().__init__(model, covariance, feedback, surge_max)
        self.forgetting = UnitInterval(forgetting, "forgetting")
        growth = check_positive("trace_growth", trace_growth) * len(self.model.names)
        self.register_buffer("trace_max", growth * as_tensor(covariance) * self.model.scale**2)

    def description(self) -> dict[str, Any] | None:
        return self._spec("rls")

    def _step(
        self, theta: Tensor, factor: Tensor, phi: Tensor, innovation: Tensor, dt: Tensor
    ) -> tuple[Tensor, Tensor]:
        return rls_step(theta, factor, phi, innovation, self.forgetting(), self.trace_max)
