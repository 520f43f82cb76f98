"""Models that are linear in their parameters: v⁺ = base + φᵀθ (paper, sections IV-A, IV-C, IV-D).

Commands and speeds are signed, so that boats may back up: ξ|ξ| stands for ξ² and ξ|v| for ξv. Where ξ ≥ 0 and
v ≥ 0 these are the paper's own terms.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from usvlearn.errors import ConfigError
from usvlearn.hyper import as_tensor
from usvlearn.signals import Inputs


def surge_regressor(surge: Tensor, inputs: Inputs) -> Tensor:
    """W of m·surge_dot = Wᵀθ: [|v|v, v, |r|v, ξ_L, ξ_L|ξ_L|, ξ_L|v|, ξ_R, ξ_R|ξ_R|, ξ_R|v|], shape `(*batch, 9)`.

    The paper's |r v| is written |r|v, so that a turn slows a boat that backs up too.
    """
    speed = surge.abs()
    drag = torch.stack([speed * surge, surge, inputs.yaw_rate.abs() * surge], -1)  # (*batch, 3)
    xi = torch.stack([inputs.command_left, inputs.command_right], -1)  # (*batch, 2)
    thrust = torch.stack([xi, xi * xi.abs(), xi * speed[..., None]], -1)  # (*batch, 2, 3)
    return torch.cat([drag, thrust.flatten(-2)], -1)


def quasi_static_regressor(inputs: Inputs) -> Tensor:
    """Φ of v ≈ Φᵀζ: [ξ_R, ξ_R|ξ_R|, ξ_R³, ξ_L, ξ_L|ξ_L|, ξ_L³, sin θ, cos θ, |r|], shape `(*batch, 9)`."""
    xi = torch.stack([inputs.command_right, inputs.command_left], -1)  # (*batch, 2)
    thrust = torch.stack([xi, xi * xi.abs(), xi * xi * xi], -1)  # (*batch, 2, 3)
    heading = inputs.heading
    rest = torch.stack([heading.sin(), heading.cos(), inputs.yaw_rate.abs()], -1)
    return torch.cat([thrust.flatten(-2), rest], -1)


class SurgeDynamics(nn.Module):
    """One step of the surge dynamics, m·surge_dot = Wᵀθ: v⁺ = v + φᵀθ with φ = dt·W/m.

    Args:
        mass: m, kg, added mass included; broadcasts against the batch.

    >>> model = SurgeDynamics(28.0)
    >>> [name for name in model.names if "drag" in name]
    ['drag_quadratic', 'drag_linear', 'drag_cross']
    """

    names = (
        "drag_quadratic",  # c_q, kg/m
        "drag_linear",  # c_l, kg/s
        "drag_cross",  # c_θ̇, kg/rad
        "thrust_linear_left",  # α_L, N
        "thrust_quadratic_left",  # β_L, N
        "thrust_speed_left",  # γ_L, N s/m
        "thrust_linear_right",
        "thrust_quadratic_right",
        "thrust_speed_right",
    )
    signs = (-1, -1, -1, 1, 1, -1, 1, 1, -1)  # of the parameters, by physics

    def __init__(self, mass=36.0):
        super().__init__()
        mass = as_tensor(mass, "mass")
        if not bool(((mass > 0) & mass.isfinite()).all()):
            raise ConfigError(f"mass: found {mass.tolist()}, expected a positive number of kg")
        self.register_buffer("mass", mass)

    @property
    def scale(self) -> Tensor:
        """The size of the parameters, which are proportional to the mass."""
        return self.mass

    def forward(self, surge: Tensor, inputs: Inputs) -> tuple[Tensor, Tensor]:
        """The base of the prediction, m/s, `(*batch,)`, and φ, `(*batch, 9)`."""
        return surge, (inputs.dt / self.mass)[..., None] * surge_regressor(surge, inputs)


class QuasiStatic(nn.Module):
    """The thruster map v = Φᵀζ, which has no memory of speed; parameters in m/s.

    >>> QuasiStatic().names[0]
    'zeta_right_linear'
    """

    names = (
        "zeta_right_linear",
        "zeta_right_quadratic",
        "zeta_right_cubic",
        "zeta_left_linear",
        "zeta_left_quadratic",
        "zeta_left_cubic",
        "zeta_heading_sin",
        "zeta_heading_cos",
        "zeta_yaw_rate",  # m/rad
    )
    scale = 1.0

    def forward(self, surge: Tensor, inputs: Inputs) -> tuple[Tensor, Tensor]:
        """The base of the prediction, 0 m/s, `(*batch,)`, and Φ, `(*batch, 9)`."""
        return torch.zeros_like(surge), quasi_static_regressor(inputs)
