"""Adaptive identification (AID) of the surge dynamics in torch: equations (1) to (6) of `state`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from usvlearn.core.family import FEEDBACK
from usvlearn.core.hyperparameters import Hyper, Positive, as_tensor, check_broadcast
from usvlearn.core.protocol import Estimator, describe, spec_of
from usvlearn.core.samples import Inputs
from usvlearn.errors import ConfigError, check_choice, check_not_negative, check_positive
from usvlearn.estimators.aid.state import FAMILY, AIDState
from usvlearn.estimators.mass import known_rows, recover_mass
from usvlearn.estimators.regressors.layer import LinearModel, SurgeDynamics, linearised

# Spread per unit of the model's scale, 1 where not named. Chosen by the one-step error on logs and simulations:
# what these terms explain, the others mostly can too.
SPREAD = {"drag_linear": 0.25, "drag_cross": 0.25, "thrust_speed_left": 0.25, "thrust_speed_right": 0.25}


class AID(Estimator):
    """Normalised adaptive identifier with sign projection, leakage and dead zone.

    Smallwood & Whitcomb 2003, with leakage by Ioannou & Kokotovic 1984; derived in `docs/theory/estimators.md`.

    Args:
        mass: m, kg, added mass included; broadcasts against the batch. A wrong mass scales the parameters; with the
            default `spread` it changes no prediction.
        gain: adaptation gain, s²/m²; broadcasts against the batch.
        spread: how far each parameter may lie from its prior, in its own unit (kg/m, kg/s, kg/rad, N, N s/m, as
            `model.names` says); 0 keeps a parameter at its prior. None: the mass times 1, and times ¼ for the drag
            linear in speed, that of turning, and the loss of thrust with speed.
        theta0: θ₀, the prior parameters, `(p,)` in their units, from which learning starts; None: zeros.
        dead_zone: half-width of dz, m/s; half the speed's resolution (0.025) where the log is quantised.
        floor: least |φ|² in units of the model's scale, no unit; below it, in the noise of a boat at rest, nothing is
            learned.
        sigma: σ, 1/s; 0 switches leakage off.
        bound: M, the distance from θ₀ in spreads (Euclidean) up to which nothing leaks. The default only keeps
            parameters from drifting away, whatever the boat; 1 to 1.5 steadies small boats under noise, and is wrong
            where full thrust gives many m/s².
        feedback: "measured" predicts from the last measured speed (series-parallel), "estimate" from AID's own
            estimate (parallel), drawn to the measurement at the rate `leak`.
        leak: −a_m, 1/s; used with feedback "estimate" alone.
        surge_max: physical limit of the estimate, m/s.
        project: clip the parameters onto the signs that physics gives them.
        known: quantities in physical units (N, N s/m, kg/m, kg/s, kg/rad) that pin the scale, by name or sum of names,
            as `{"thrust_linear_left + thrust_quadratic_left": 33.6}`. `mass` is then a first guess: `monitor` shows the
            mass identified, and the parameters that follow from it. Least squares identifies them sooner than AID.
        model: linear in its parameters; None is `SurgeDynamics(mass)`.

    Raises:
        ConfigError: a number outside its range, parameters that are not one for each name, or a prior with other signs.

    >>> aid = AID(mass=28.0, gain=1.0)
    >>> aid.init((8,)).theta.shape
    torch.Size([8, 9])
    >>> [round(x) for x in aid.spread.tolist()]  # kg/m, kg/s, kg/rad, then N, N, N s/m of each side
    [28, 7, 7, 28, 28, 7, 28, 28, 7]
    """

    model: LinearModel
    spread: Tensor  # (p,) or (*batch, p)
    inverse_spread: Tensor  # likewise; 0 where the spread is
    theta0: Tensor  # (p,)
    lower: Tensor  # (p,)
    upper: Tensor  # (p,)

    frozen = FAMILY.frozen

    def __init__(
        self,
        mass: Hyper = 36.0,
        gain: Hyper = 1.0,
        spread: Sequence[float] | None = None,
        theta0: Sequence[float] | None = None,
        dead_zone: float = 0.0,
        floor: float = 1e-3,
        sigma: float = 1.0,
        bound: float = 20.0,
        feedback: str = "measured",
        leak: Hyper = 1.0,
        surge_max: float = 10.0,
        project: bool = True,
        known: Mapping[str, float] | None = None,
        model: LinearModel | None = None,
    ):
        super().__init__()
        self.feedback = check_choice("feedback", feedback, FEEDBACK)
        self.surge_max = check_positive("surge_max", surge_max, "of m/s")
        self.dead_zone = check_not_negative("dead_zone", dead_zone, "of m/s")
        self.floor = check_not_negative("floor", floor)
        self.sigma = check_not_negative("sigma", sigma, "of 1/s")
        self.bound = check_positive("bound", bound, "of spreads")
        self.model = SurgeDynamics(mass) if model is None else model
        self.gain = Positive(gain, "gain")
        if feedback == "estimate":
            self.leak = Positive(leak, "leak")
        self.known = None if known is None else dict(known)
        if self.known is not None:
            known_rows(self.known, self.model.names)
            if not hasattr(self.model, "mass"):
                raise ConfigError(f"known: found a {type(self.model).__name__}, expected a model that has a mass")
        names, zeros = self.model.names, [0.0] * len(self.model.names)
        signs = as_tensor(self.model.signs if project else zeros)
        if spread is None:
            spreads = as_tensor(self.model.scale)[..., None] * as_tensor([SPREAD.get(name, 1.0) for name in names])
        else:
            spreads = _per_parameter("spread", spread, names)
        if bool((spreads < 0).any()):
            raise ConfigError(f"spread: found {spreads.tolist()}, expected numbers of 0 or more")
        prior = _per_parameter("theta0", zeros if theta0 is None else theta0, names)
        if bool((prior * signs < 0).any()):
            raise ConfigError(f"theta0: found {prior.tolist()}, expected the signs {signs.tolist()}, or project=False")
        infinity = torch.full_like(signs, torch.inf)
        self.register_buffer("spread", spreads)
        self.register_buffer("inverse_spread", torch.where(spreads > 0, 1 / spreads, 0.0))
        self.register_buffer("theta0", prior)
        self.register_buffer("lower", torch.where(signs > 0, 0.0, -infinity))
        self.register_buffer("upper", torch.where(signs < 0, 0.0, infinity))

    def init(self, batch: Sequence[int] = ()) -> AIDState:
        check_broadcast(self, tuple(batch))
        return AIDState(self.theta0.repeat(*batch, 1), self.theta0.new_zeros(tuple(batch)))

    def predict(self, state: AIDState, inputs: Inputs) -> tuple[AIDState, Tensor]:
        base, phi = linearised(self.model, state.surge, inputs, state.theta)
        surge = (base + (phi * state.theta).sum(-1)).clamp(-self.surge_max, self.surge_max)  # (1)
        return state._replace(surge=surge), surge

    def update(self, state: AIDState, inputs: Inputs, surge: Tensor) -> AIDState:
        return self.learn(state, inputs, surge)[0]

    def learn(self, state: AIDState, inputs: Inputs, surge: Tensor) -> tuple[AIDState, Tensor]:
        base, phi = linearised(self.model, state.surge, inputs, state.theta)
        estimate = base + (phi * state.theta).sum(-1)
        error = estimate - surge
        outside = error - error.clamp(-self.dead_zone, self.dead_zone) if self.dead_zone else error
        gamma_phi = self.gain()[..., None] * self.spread**2 * phi  # (2)
        N = (phi * gamma_phi).sum(-1)
        informs = (phi * phi).sum(-1) * self.model.scale**2 >= self.floor
        step = torch.where(informs, outside / (1 + N), 0.0)
        theta = (state.theta - step[..., None] * gamma_phi).clamp(self.lower, self.upper)  # (3)
        if self.sigma:
            theta = self._leaked(theta, inputs.dt)
        if self.feedback == "estimate":
            surge = surge + (error - N * step) * (-self.leak() * inputs.dt).exp()  # (6)
            surge = surge.clamp(-self.surge_max, self.surge_max)
        return AIDState(theta, surge), estimate.clamp(-self.surge_max, self.surge_max)

    def start(self, state: AIDState, surge: Tensor) -> AIDState:
        return state._replace(surge=surge)

    def description(self) -> dict[str, Any] | None:
        if (terms := spec_of(self.model)) is None:
            return None
        return describe(FAMILY, self, size=len(self.model.names), terms=terms, scale=self.model.scale)

    def monitor(self, state: AIDState) -> dict[str, Tensor]:
        numbers, theta = {"prior_distance": self._distance(state.theta)}, state.theta
        if self.known is not None:
            per_mass = theta / self.model.mass[..., None]  # type: ignore[attr-defined]  # __init__ has checked for it
            numbers["mass"], theta = recover_mass(per_mass, self.known, self.model.names)
        return {**dict(zip(self.model.names, theta.unbind(-1), strict=True)), **numbers}

    def _distance(self, theta: Tensor) -> Tensor:
        """n of (4), `(*batch,)`."""
        return torch.linalg.vector_norm((theta - self.theta0) * self.inverse_spread, dim=-1)

    def _leaked(self, theta: Tensor, dt: Tensor) -> Tensor:
        n = self._distance(theta).clamp(min=self.bound)
        rate = self.sigma * (n / self.bound - 1).clamp(max=1.0)  # (4)
        leak = torch.minimum(-torch.expm1(-rate * dt), 1 - self.bound / n)
        return theta - leak[..., None] * (theta - self.theta0)  # (5)


def _per_parameter(name: str, value: Sequence[float], names: Sequence[str]) -> Tensor:
    """Finite numbers, one for each of the names, `(p,)`."""
    numbers = as_tensor(list(value), name)
    if numbers.shape != (len(names),) or not bool(numbers.isfinite().all()):
        wanted = f"{len(names)} numbers, one for each of {', '.join(names)}"
        raise ConfigError(f"{name}: found {list(value)}, expected {wanted}")
    return numbers
