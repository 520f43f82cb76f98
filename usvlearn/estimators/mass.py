"""The mass and the physical parameters from what surge data alone identify (Harris, Mao, Paine & Whitcomb).

Surge data identify η = θ/m, and never m: a boat (2m, 2θ) moves exactly as the boat (m, θ). A quantity in newtons or
kilograms fixes the scale: the pull at the bollard at full command, or the drag of a towed hull. Equations (1) to (3):
`docs/theory/identification.md#mass`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from usvlearn.errors import ConfigError

MASS_MAX = 1e6  # kg; a greater result means that the mass is not determined


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


def recover_mass(per_mass: Tensor, known: Mapping[str, float], names: Sequence[str]) -> tuple[Tensor, Tensor]:
    """The mass, kg, `(*batch,)`, and the parameters, `(*batch, p)`, by (3) from those per unit mass, η.

    NaN where the known quantities do not determine them: no thrust seen yet, or thrust of the wrong sign.
    """
    rows, values = known_rows(known, names)
    d = per_mass.new_tensor(values)
    A = per_mass.new_tensor(rows) / d[:, None]  # (known, p)
    inverse = ((torch.ones_like(d) / len(values)) @ A * per_mass).sum(-1)
    mass = torch.where(inverse > 1 / MASS_MAX, 1 / inverse, torch.nan)
    return mass, mass[..., None] * per_mass
