"""The mass and the physical parameters from what surge data alone identify (Harris, Mao, Paine & Whitcomb).

Surge data identify η = θ/m, and never m: a boat (2m, 2θ) moves exactly as the boat (m, θ). A quantity in newtons or
kilograms fixes the scale: the pull at the bollard at full command, or the drag of a towed hull. Equations (1) to (4):
`docs/theory/identification.md#mass`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from usvlearn.errors import ConfigError
from usvlearn.estimators.regressors.layer import SurgeDynamics

NAMES = SurgeDynamics().names
MASS_MAX = 1e6  # kg; a greater result means that the mass is not determined


class Mass(NamedTuple):
    """A mass and the parameters that follow from it; NaN where the data do not excite the known quantities yet."""

    mass: Tensor  # (*batch,) kg
    parameters: Tensor  # (*batch, p) in the physical units of the names
    mass_deviation: Tensor  # (*batch,) kg, standard deviation; NaN without a covariance
    deviations: Tensor  # (*batch, p) of the parameters, likewise


def known_rows(known: Mapping[str, float], names: Sequence[str]) -> tuple[list[list[float]], list[float]]:
    """The coefficients A and values d of known parameters, or sums of them; a ConfigError if one is not legal."""
    if not isinstance(known, Mapping):
        raise ConfigError(f"known: found {known!r}, expected {{name: value}}")
    if not known:
        raise ConfigError("known: found nothing, expected at least one {name: value}")
    rows, values = [], []
    for key, value in known.items():
        terms = [term.strip() for term in str(key).split("+")]
        for term in terms:
            if term not in names:
                raise ConfigError(f"known: found {term!r}, expected {', '.join(names)}, or a sum of them with +")
        if not (isinstance(value, int | float) and math.isfinite(value) and value != 0):
            raise ConfigError(f"known.{key}: found {value!r}, expected a number other than 0, in physical units")
        rows.append([float(terms.count(name)) for name in names])
        values.append(float(value))
    return rows, values


def recover_mass(
    per_mass: Tensor,  # (*batch, p) η
    known: Mapping[str, float],
    covariance: Tensor | None = None,  # (*batch, p, p) P
    names: Sequence[str] = NAMES,
) -> Mass:
    """The mass from parameters per unit mass and known physical values, equations (2) to (4).

    Args:
        per_mass: η = θ/m, in units of each parameter per kg.
        known: value by name of a parameter, or by a sum of names, as `{"thrust_linear_left +
            thrust_quadratic_left": 33.6}` for the pull of the left thruster at full command, N.
        covariance: of η. Of RLS: its covariance over the square of its model's mass, times the variance of the noise
            in the measured increments.
        names: of the p parameters.

    Returns:
        NaN where the known quantities do not determine a result: no thrust seen yet, or thrust of the wrong sign.
    """
    rows, values = known_rows(known, names)
    d = per_mass.new_tensor(values)
    A = per_mass.new_tensor(rows) / d[:, None]  # (known, p): r = A η
    one = torch.ones_like(d)
    if covariance is None:
        weight = (one / len(values)).expand(*per_mass.shape[:-1], -1)
    else:
        weight = torch.linalg.solve_ex(A @ covariance @ A.mT, one.expand(*covariance.shape[:-2], -1)[..., None])[0]
        weight = weight[..., 0] / weight.sum((-2, -1))[..., None]
    g = weight @ A  # (3)
    inverse = (g * per_mass).sum(-1)
    mass = torch.where(inverse > 1 / MASS_MAX, 1 / inverse, torch.nan)
    parameters = mass[..., None] * per_mass
    if covariance is None:
        return Mass(mass, parameters, torch.full_like(mass, torch.nan), torch.full_like(parameters, torch.nan))
    eye = torch.eye(len(names), dtype=per_mass.dtype, device=per_mass.device)
    J = mass[..., None, None] * (eye - parameters[..., None] * g[..., None, :])  # (4)
    mass_deviation = mass**2 * (g * (covariance @ g[..., None])[..., 0]).sum(-1).sqrt()
    return Mass(mass, parameters, mass_deviation, ((J @ covariance) * J).sum(-1).sqrt())
