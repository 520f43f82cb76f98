"""Models that are linear in their parameters: v⁺ = base + φᵀθ (paper, sections IV-A, IV-C, IV-D).

Commands and speeds are signed, so that boats may back up: ξ|ξ| stands for ξ² and ξ|v| for ξv. Where ξ ≥ 0 and v ≥ 0
these are the paper's own terms. The terms beyond the paper's and the exponential step, equation (2):
`docs/theory/model.md#surge-model`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor, nn

from usvlearn.core.hyperparameters import Hyper, as_tensor
from usvlearn.core.samples import Inputs
from usvlearn.errors import ConfigError, ShapeError
from usvlearn.estimators.regressors.terms import LEAST, MOST, NEAR, QUASI_STATIC, SERIES, signs_of


class LinearModel(Protocol):
    """A torch module that is linear in its parameters, as `SurgeDynamics` and `QuasiStatic` are."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters."""
        ...

    @property
    def signs(self) -> Sequence[int]:
        """Of the parameters by physics; 0 where physics gives none."""
        ...

    @property
    def scale(self) -> Tensor | float:
        """The size of the parameters, in their units."""
        ...

    def __call__(self, surge: Tensor, inputs: Inputs) -> tuple[Tensor, Tensor]:
        """The base of the prediction, m/s, `(*batch,)`, and φ, `(*batch, p)`."""
        ...


def linearised(model: LinearModel, surge: Tensor, inputs: Inputs, theta: Tensor) -> tuple[Tensor, Tensor]:
    """The base and φ of any model; one that makes the exponential step is told the parameters θ, `(*batch, p)`."""
    if isinstance(model, SurgeDynamics) and model.exponential:
        return model(surge, inputs, theta)
    return model(surge, inputs)


def surge_regressor(surge: Tensor, inputs: Inputs) -> Tensor:
    """W of m·surge_dot = Wᵀθ: [|v|v, v, |r|v, ξ_L, ξ_L|ξ_L|, ξ_L|v|, ξ_R, ξ_R|ξ_R|, ξ_R|v|], shape `(*batch, 9)`.

    The paper's |r v| is written |r|v, so that a turn also slows a boat that backs up.
    """
    speed = surge.abs()
    drag = torch.stack([speed * surge, surge, inputs.yaw_rate.abs() * surge], -1)  # (*batch, 3)
    xi = torch.stack([inputs.command_left, inputs.command_right], -1)  # (*batch, 2)
    thrust = torch.stack([xi, xi * xi.abs(), xi * speed[..., None]], -1)  # (*batch, 2, 3)
    return torch.cat([drag, thrust.flatten(-2)], -1)


def force_slope(surge: Tensor, inputs: Inputs, theta: Tensor) -> Tensor:
    """∂(Wᵀθ)/∂v, kg/s, `(*batch,)`, with sgn 0 = 0; the cubic term does not depend on v."""
    q, linear, cross, _, _, left, _, _, right = theta[..., :9].unbind(-1)
    pull = inputs.command_left * left + inputs.command_right * right
    return 2 * surge.abs() * q + linear + inputs.yaw_rate.abs() * cross + surge.sign() * pull


def quasi_static_regressor(inputs: Inputs) -> Tensor:
    """Φ of v ≈ Φᵀζ: [ξ_R, ξ_R|ξ_R|, ξ_R³, ξ_L, ξ_L|ξ_L|, ξ_L³, sin θ, cos θ, |r|], shape `(*batch, 9)`."""
    xi = torch.stack([inputs.command_right, inputs.command_left], -1)  # (*batch, 2)
    thrust = torch.stack([xi, xi * xi.abs(), xi * xi * xi], -1)  # (*batch, 2, 3)
    heading = inputs.heading
    rest = torch.stack([heading.sin(), heading.cos(), inputs.yaw_rate.abs()], -1)
    return torch.cat([thrust.flatten(-2), rest], -1)


def phi1(z: Tensor) -> Tensor:
    """φ1(z) = (e^z − 1)/z, 1 at z = 0; autograd may differentiate it."""
    near = z.abs() < NEAR
    small, large = torch.where(near, z, 0.0), torch.where(near, -1.0, z)
    slope = torch.zeros_like(z)
    for c in SERIES:
        slope = slope * small + c
    return torch.where(near, (1 - small * slope) / (1 - small), torch.expm1(large) / large)  # as e^z = φ1 + z φ1'


class SurgeDynamics(nn.Module):
    """One step of the surge dynamics, m·surge_dot = Wᵀθ: v⁺ = v + φᵀθ with φ = dt·W/m, or (1).

    The terms are the paper's, section IV-C; the step (1) is that of Hochbruck & Ostermann 2010.

    Args:
        mass: m, kg, added mass included; broadcasts against the batch.
        cubic: adds thrust κ ξ³ of each side, N.
        exponential: makes the step (1) in place of Euler's; AID and least squares take its φ1 as known.

    Attributes:
        names: of the parameters.
        signs: of the parameters by physics; 0 where physics gives none.

    Raises:
        ConfigError: a mass that is not a positive number.

    >>> [name for name in SurgeDynamics(28.0, cubic=True).names if "cubic" in name]
    ['thrust_cubic_left', 'thrust_cubic_right']
    """

    mass: Tensor  # kg, () or as given

    def __init__(self, mass: Hyper = 36.0, cubic: bool = False, exponential: bool = False):
        super().__init__()
        self.cubic, self.exponential = cubic, exponential
        options = {"cubic": cubic, "exponential": exponential}
        self.terms = ["dynamics", *(name for name, chosen in options.items() if chosen)]
        parts = signs_of(self.terms)
        self.names, self.signs = tuple(parts), tuple(parts.values())
        given = as_tensor(mass, "mass")
        if not bool(((given > 0) & given.isfinite()).all()):
            raise ConfigError(f"mass: found {given.tolist()}, expected a positive number of kg")
        self.register_buffer("mass", given)

    def description(self) -> list[str]:
        """Its terms, for the description of an estimator.

        Returns:
            The names of the terms.

        >>> SurgeDynamics(28.0, cubic=True).description()
        ['dynamics', 'cubic']
        """
        return list(self.terms)

    @property
    def scale(self) -> Tensor:
        """The size of the parameters, kg: they are proportional to the mass."""
        return self.mass

    def forward(self, surge: Tensor, inputs: Inputs, theta: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The base of the prediction, m/s, `(*batch,)`, and φ, `(*batch, p)`; `exponential` needs θ, `(*batch, p)`."""
        W = surge_regressor(surge, inputs)
        if self.cubic:
            W = torch.cat([W, torch.stack([inputs.command_left**3, inputs.command_right**3], -1)], -1)
        step = inputs.dt / self.mass
        if self.exponential:
            if theta is None:
                raise ShapeError("SurgeDynamics(exponential=True): found no parameters, expected theta, (*batch, p)")
            step = step * phi1((step * force_slope(surge, inputs, theta)).clamp(LEAST, MOST))
        return surge, step[..., None] * W


class QuasiStatic(nn.Module):
    """The static thruster map v = Φᵀζ, which does not depend on the last speed; parameters in m/s.

    Paper, section IV-D.

    >>> QuasiStatic().names[0]
    'zeta_right_linear'
    """

    names, signs = tuple(QUASI_STATIC), tuple(QUASI_STATIC.values())
    scale = 1.0

    def description(self) -> list[str]:
        """It has none of the terms of the dynamics.

        Returns:
            An empty list.

        >>> QuasiStatic().description()
        []
        """
        return []

    def forward(self, surge: Tensor, inputs: Inputs) -> tuple[Tensor, Tensor]:
        """The base of the prediction, 0 m/s, `(*batch,)`, and Φ, `(*batch, 9)`."""
        return torch.zeros_like(surge), quasi_static_regressor(inputs)
