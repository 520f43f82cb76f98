"""The joint EKF: its arguments, its first state, and its diagnostics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from usvlearn.core.hyperparameters import Hyper, Positive, as_tensor, check_broadcast
from usvlearn.core.protocol import KernelEstimator, describe
from usvlearn.errors import ConfigError, check_positive
from usvlearn.estimators.augmented_ekf.layer import initial
from usvlearn.estimators.augmented_ekf.state import FIRST_DISTURBANCE
from usvlearn.estimators.joint import state as at
from usvlearn.estimators.joint.change_detection import Trial, of
from usvlearn.estimators.joint.quantities import KNOWN_SIGNS, sums
from usvlearn.estimators.joint.state import EAST, FAMILY, NORTH, THETA, B, JointState, names
from usvlearn.estimators.mass import known_rows
from usvlearn.estimators.regressors.terms import CURRENT, DISTURBANCE, LAG

TIME = 2.5  # s, time constant of the prior's boat


class JointEKF(KernelEstimator):
    """Speed, slow disturbance, current and parameters in one extended Kalman filter, which measures its own noise.

    The prior is a boat that reaches `surge_max` with both sides at full, with a time constant of 2.5 s.

    The step is that of Hochbruck & Ostermann 2010; the filter is derived in `docs/theory/estimators.md`.

    Args:
        surge_max: top speed, m/s; 0.5 to 1.4 times the true one does; broadcasts against the batch.
        mass: kg, added mass included. It only gives the parameters their units; broadcasts against the batch.
        theta0: the prior's nine parameters, kg/m, kg/s, kg/rad, then N, N, N s/m of each side; None: the boat above.
        disturbance: q_b, variance of the disturbance's noise in a step of 0.4 s, in units of σ², 1/s²; broadcasts
            against the batch, as do the next seven.
        disturbance_time: τ_b, s. With q_b of 5 or more, 30 s or more would take the drag for a disturbance.
        current: σ_c, standard deviation of each component, m/s; 0.15 where currents are strong.
        current_time: τ_c, s.
        drift_time: T_θ, s, after which the parameters' variance has grown by its prior; 3000 to follow a boat that
            changes, 1e5 for one that does not.
        lag: prior standard deviation of μ, share of a step.
        cubic: that of κ, in units of the force per mass of one side at full, no unit.
        even: ρ, that of the fore-aft asymmetry terms, in units of the drag's and that force, no unit; None: no terms.
        outlier: k, number of standard deviations beyond which a measurement is one; None: none is. Broadcasts, too.
        estimate_every: s of update steps under way between two periodic estimates of the parameters; None: none.
        known: forces by name, or by a sum of names, in N, as `{"thrust_full_left": 33.6}`: the mass is identified too
            (`usvlearn.estimators.mass`); the names are those of `quantities.sums`.
        trial: how a change of the boat is answered within seconds; None: as fast as the parameters drift.

    Raises:
        ConfigError: a number outside its range, or nine prior parameters of which the first three are not 0 or less.

    >>> joint = JointEKF(surge_max=2.7, mass=28.0)
    >>> joint.init((8,)).mean.shape
    torch.Size([8, 23])
    >>> round(float(joint.monitor(joint.init())["thrust_linear_left"]), 1)  # N
    5.7
    """

    mass: Tensor  # kg, () or as given
    prior: Tensor  # (m,) or (*batch, m): prior mean of the parameters, per unit mass
    scale: Tensor  # (m,) or (*batch, m): their standard deviations where `lag`, `cubic` and `even` are 1
    outlier: Tensor  # () or as given
    chosen: Tensor  # (4, m): 1 where the parameter's deviation is its scale, and times `cubic`, `even`, `lag`
    inverse_mass: Tensor  # (m,) g of 1/m = gᵀθ, with equal weight for every known force; zeros where none is known

    frozen = FAMILY.frozen

    def __init__(
        self,
        surge_max: Hyper,
        mass: Hyper = 1.0,
        theta0: Sequence[float] | None = None,
        disturbance: Hyper = 0.5,
        disturbance_time: Hyper = 1.0,
        current: Hyper = 0.05,
        current_time: Hyper = 600.0,
        drift_time: Hyper = 1e5,
        lag: Hyper = 0.03,
        cubic: Hyper = 1.0,
        even: Hyper | None = 0.2,
        outlier: Hyper | None = 4.0,
        estimate_every: float | None = None,
        known: Mapping[str, float] | None = None,
        trial: Trial | None = None,
    ):
        super().__init__()
        self.trial = trial
        self.disturbance = Positive(disturbance, "disturbance", learnable=False)
        self.disturbance_time = Positive(disturbance_time, "disturbance_time", learnable=False)
        self.current = Positive(current, "current", learnable=False)
        self.current_time = Positive(current_time, "current_time", learnable=False)
        self.drift_time = Positive(drift_time, "drift_time", learnable=False)
        self.lag, self.cubic = Positive(lag, "lag", learnable=False), Positive(cubic, "cubic", learnable=False)
        self.even = None if even is None else Positive(even, "even", learnable=False)
        self.estimate_every = (
            torch.inf if estimate_every is None else check_positive("estimate_every", estimate_every, "of s")
        )
        self.register_buffer("outlier", as_tensor(torch.inf if outlier is None else outlier, "outlier"))
        self.register_buffer("mass", as_tensor(mass, "mass"))
        v = as_tensor(surge_max, "surge_max")
        positive = ("outlier", self.outlier, "deviations"), ("mass", self.mass, "kg"), ("surge_max", v, "m/s")
        for name, value, unit_ in positive:
            if not bool((value > 0).all()):
                raise ConfigError(f"{name}: found {value.tolist()}, expected a positive number of {unit_}")
        self.names = names(even is not None)
        one = torch.ones_like(v)
        linear, quadratic = -0.5 / TIME * one, -0.25 / (TIME * v)
        force = -(linear * v + quadratic * v * v) / 2
        zero, side = 0 * one, [force / 2, force / 2, 0 * one]
        mean = torch.stack([quadratic, linear, zero, *side, *side], -1)
        if theta0 is not None:
            given = as_tensor(list(theta0), "theta0")
            if given.shape != mean.shape[-1:] or not bool(given.isfinite().all()) or bool((given[:3] > 0).any()):
                raise ConfigError(f"theta0: found {list(theta0)}, expected nine numbers, the first three 0 or less")
            mean = given / self.mass[..., None]
        push = [force, force, 0.15 * one]
        drag = [0.5 / v, 0.4 * one, 0.3 * one]
        odd = [0.5 / v, *[force, force, force / v] * 2] if even is not None else []
        self.register_buffer("scale", torch.stack([*drag, *push, *push, force, force, *odd, one], -1))
        kinds = torch.tensor([0] * 9 + [1] * 2 + [2] * len(odd) + [3])
        self.register_buffer("chosen", (kinds == torch.arange(4)[:, None]).to(v.dtype))
        self.register_buffer("prior", torch.cat([mean, mean.new_zeros((*mean.shape[:-1], len(odd) + 3))], -1))
        rows = sums(even is not None)
        inverse = torch.zeros(len(self.names), dtype=v.dtype)
        if known is not None:
            chosen, values = known_rows(known, tuple(rows))
            for name, known_force in known.items():
                if name in KNOWN_SIGNS and not known_force * KNOWN_SIGNS[name] > 0:
                    sense = (
                        "positive: thrust ahead is" if KNOWN_SIGNS[name] > 0 else "negative: a drag's parameters are"
                    )
                    raise ConfigError(f"known.{name}: found {known_force!r}, expected a number that is {sense}")
            coefficients = torch.tensor(chosen, dtype=v.dtype) @ torch.tensor(
                np.stack(list(rows.values())), dtype=v.dtype
            )
            inverse = (coefficients / torch.tensor(values, dtype=v.dtype)[:, None]).mean(0)
        self.register_buffer("inverse_mass", inverse)

    @property
    def variance(self) -> Tensor:
        """Prior variance of the parameters, `(m,)` or `(*batch, m)`."""
        deviation, kinds = self.scale * self.chosen[0], (self.cubic, self.even, self.lag)
        for kind, mask in zip(kinds, self.chosen[1:], strict=True):
            if kind is not None:
                deviation = deviation + self.scale * mask * kind()[..., None]
        return deviation * deviation

    def init(self, batch: Sequence[int] = ()) -> JointState:
        batch = tuple(batch)
        check_broadcast(self, batch)
        m, zero = len(self.names), self.lag.log.new_zeros(batch)
        first = [zero + at.SPEED_VARIANCE, zero + FIRST_DISTURBANCE, *[zero + self.current() ** 2] * 2]
        wide = zero[..., None].expand(*batch, m)
        state = JointState(
            *initial(torch.stack(first, -1), self.prior, self.variance),
            learned=zero,
            readings=zero,
            weight=zero,
            reading=wide.clone(),
            spread=wide[..., None].expand(*batch, m, m).clone(),
        )
        return state if self.trial is None else state._replace(trial=self.trial.init(state))

    def description(self) -> dict[str, Any]:
        own = {} if self.trial is None else self.trial.description()
        return describe(FAMILY, self, size=THETA + len(self.names), even=self.even is not None, **own)

    def monitor(self, state: JointState) -> dict[str, Tensor]:
        numbers = dict(zip(self.names, (state.mean[..., THETA:] * self.mass[..., None]).unbind(-1), strict=True))
        numbers |= {LAG: state.mean[..., -1], DISTURBANCE: state.mean[..., B] * self.mass}
        numbers |= dict(zip(CURRENT, state.mean[..., NORTH : EAST + 1].unbind(-1), strict=True))
        numbers |= {"noise": state.noise.sqrt(), "deviation": state.deviation, "readings": state.readings}
        if self.trial is not None:
            trial = of(state)
            numbers |= {"evidence": trial.evidence, "changes": trial.changes, "since_change": trial.since}
        return numbers
