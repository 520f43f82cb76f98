"""Adaptive identification (AID) of the surge dynamics with known mass.

Continuous (Smallwood & Whitcomb 2003, scalar plant; paper, section IV-C), Δv = v̂ − v, Δθ = θ̂ − θ, a_m < 0:

    v̂_dot = Wᵀθ̂/m + a_m Δv,    θ̂_dot = −Γ W Δv,    V = ½Δv² + ½ Δθᵀ Γ⁻¹ Δθ / m,    V_dot = a_m Δv² ≤ 0

Discrete, with φ = dt·W/m and e = predicted − measured; safe for every gain because the step is normalised:

    v̂⁺ = v + φᵀθ̂                                                        (1)
    θ̂⁺ = clip( θ̂ − Γ φ dz(e) / (1 + φᵀΓφ) )  onto the signs of physics     (2)
    V = ½ Δθᵀ Γ⁻¹ Δθ,  V⁺ − V ≤ −½ e² / (1 + φᵀΓφ) without noise             (3)

dz is a dead zone. Γ is diagonal, so the clip is the exact projection in the metric Γ⁻¹ and can only lower V.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from usvlearn.errors import ConfigError, check_choice, check_not_negative, check_positive
from usvlearn.estimator import Estimator
from usvlearn.estimators.regressors import SurgeDynamics
from usvlearn.hyper import Positive, as_tensor, check_broadcast
from usvlearn.signals import Inputs


class AIDState(NamedTuple):
    """What AID identifies."""

    theta: Tensor  # (*batch, 9) parameters in the order and units of SurgeDynamics.names
    surge: Tensor  # (*batch,) speed from which the next step departs, m/s


class AID(Estimator):
    """Normalised adaptive identifier with sign projection and dead zone.

    Args:
        mass: m, kg, added mass included; broadcasts against the batch.
        gain: dimensionless adaptation gain; Γ = gain·m²·diag(gain_ratio). The factor m² makes the behaviour
            independent of the mass, which only scales the parameters. Broadcasts against the batch.
        gain_ratio: nine relative gains, one per parameter.
        dead_zone: half-width of dz, m/s; half the speed's resolution (0.025) where the log is quantised.
        feedback: "measured" predicts from the last measured speed (series-parallel), "estimate" from AID's own
            estimate (parallel), drawn to the measurement at the rate `leak`.
        leak: −a_m, 1/s; used with feedback "estimate" alone. The exact exp(a_m dt) is applied.
        surge_max: physical limit of the estimate, m/s.
        project: clip the parameters onto the signs that physics gives them.

    >>> aid = AID(mass=28.0, gain=1.0)
    >>> aid.init((8,)).theta.shape
    torch.Size([8, 9])
    """

    def __init__(
        self,
        mass=36.0,
        gain=1.0,
        gain_ratio: Sequence[float] = (1.0,) * 9,
        dead_zone: float = 0.0,
        feedback: str = "measured",
        leak=1.0,
        surge_max: float = 10.0,
        project: bool = True,
    ):
        super().__init__()
        self.feedback = check_choice("feedback", feedback, ("measured", "estimate"))
        self.surge_max = check_positive("surge_max", surge_max, "of m/s")
        self.dead_zone = check_not_negative("dead_zone", dead_zone, "of m/s")
        self.model = SurgeDynamics(mass)
        self.gain = Positive(gain, "gain")
        if feedback == "estimate":
            self.leak = Positive(leak, "leak")
        ratio, signs = as_tensor(list(gain_ratio), "gain_ratio"), as_tensor(self.model.signs)
        if ratio.shape != signs.shape or not bool((ratio >= 0).all()):
            raise ConfigError(f"gain_ratio: found {list(gain_ratio)}, expected nine numbers of 0 or more")
        infinity = torch.full_like(signs, torch.inf)
        self.register_buffer("gain_ratio", ratio)
        self.register_buffer("lower", torch.where(signs > 0, 0.0, -infinity) if project else -infinity)
        self.register_buffer("upper", torch.where(signs < 0, 0.0, infinity) if project else infinity)

    def init(self, batch: Sequence[int] = ()) -> AIDState:
        check_broadcast(self, tuple(batch))
        zeros = self.gain_ratio.new_zeros
        return AIDState(zeros((*batch, 9)), zeros(tuple(batch)))

    def predict(self, state: AIDState, inputs: Inputs) -> tuple[AIDState, Tensor]:
        base, phi = self.model(state.surge, inputs)
        surge = (base + (phi * state.theta).sum(-1)).clamp(-self.surge_max, self.surge_max)  # (1)
        return state._replace(surge=surge), surge

    def update(self, state: AIDState, inputs: Inputs, surge: Tensor) -> AIDState:
        base, phi = self.model(state.surge, inputs)
        error = base + (phi * state.theta).sum(-1) - surge
        outside = error - error.clamp(-self.dead_zone, self.dead_zone) if self.dead_zone else error
        gamma = (self.gain() * self.model.scale**2)[..., None] * self.gain_ratio  # diagonal of Γ
        gamma_phi = gamma * phi
        step = (outside / (1 + (phi * gamma_phi).sum(-1)))[..., None] * gamma_phi
        theta = (state.theta - step).clamp(self.lower, self.upper)  # (2)
        if self.feedback == "estimate":
            surge = surge + error * (-self.leak() * inputs.dt).exp()
            surge = surge.clamp(-self.surge_max, self.surge_max)
        return AIDState(theta, surge)

    def start(self, state: AIDState, surge: Tensor) -> AIDState:
        return state._replace(surge=surge)

    def monitor(self, state: AIDState) -> dict[str, Tensor]:
        return dict(zip(self.model.names, state.theta.unbind(-1), strict=True))
