"""The true parameters of a simulated boat, as far as the motion model can represent them.

If the thrust of a plant is a table, or its drag has a knee, the true parameters are those of the least-squares fits
c_q |v| v + c_l v over speeds from 0 to the top speed, and α ξ + β ξ|ξ| over commands from 0 to 1. Surge data identify
the parameters only in proportion to the mass, so all are scaled by declared over true mass.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from usvlearn.simulate.fleet import fleet_names, fleet_vessels
from usvlearn.simulate.vessel import Vessel, drag, static_thrust, steady_surge, thrust

GRID = 101  # points of a fit
COAST = 0.1  # share of the speed that is left at the end of the stopping distance
COMMANDS = {"full": 1.0, "half": 0.5, "quarter": 0.25}


def truth_of(sources: Sequence[Mapping[str, Any]], mass: float) -> dict[str, dict[str, np.ndarray]]:
    """`true_parameters` of a single configured simulation; {} for several sources, or for other data.

    >>> truth_of([{"_target_": "usvlearn.logs.read.read", "path": "logs"}], 28.0)
    {}
    """
    if len(sources) != 1 or not sources[0]["_target_"].endswith("simulate.fleet.fleet") or sources[0].get("fault"):
        return {}  # a fault changes the truth during the season
    return true_parameters(mass, **sources[0])


def quantities_of(sources: Sequence[Mapping[str, Any]], mass: float) -> dict[str, dict[str, float]]:
    """`true_quantities` of a single configured simulation; {} as of `truth_of`.

    >>> quantities_of([{"_target_": "usvlearn.logs.read.read", "path": "logs"}], 28.0)
    {}
    """
    parameters = truth_of(sources, mass)
    return true_quantities(mass, parameters, **sources[0]) if parameters else {}


def true_quantities(
    mass: float,
    parameters: Mapping[str, Mapping[str, np.ndarray]],
    n: int,
    plant: str,
    hours: float,
    mission_minutes: float,
    seed: int,
    spread: float = 1.0,
    drift: float = 0.2,
    fleet_seed: int | None = None,
    mission: int = -1,
    **_,
) -> dict[str, dict[str, float]]:
    """What `identified` is compared with: boat -> quantity -> value on one mission.

    The names and definitions are those of `usvlearn.estimators.joint.quantities`. Tables of thrust and a knee in the
    drag count as they are, except for the parameters, which are fits.

    Args:
        mass: declared, kg.
        parameters: of `true_parameters`.
        n, plant, hours, mission_minutes, seed, spread, drift, fleet_seed: as of `usvlearn.simulate.fleet.fleet`.
        mission: its index; by default the last one: what the boat is at the end.

    >>> known = {"n": 1, "plant": "heron", "hours": 1.0, "mission_minutes": 30.0, "seed": 0, "spread": 0.0}
    >>> found = true_quantities(28.0, true_parameters(28.0, **known), **known)["heron"]
    >>> round(found["steady_speed_full"], 3), round(found["thrust_full_left"], 1)
    (2.741, 33.6)
    """
    missions, vessel = _season(n, plant, hours, mission_minutes, seed, spread, drift, fleet_seed)
    both = torch.ones(2, dtype=torch.float64)
    found = {f"steady_speed_{name}": steady_surge(vessel, share * both) for name, share in COMMANDS.items()}
    top, scale = found["steady_speed_full"], mass / vessel.mass
    for k, side in enumerate(("left", "right")):
        found[f"thrust_full_{side}"] = static_thrust(vessel, both)[..., k] * scale
    found["thrust_ratio"] = found["thrust_full_left"] / found["thrust_full_right"]
    found["drag_half_speed"] = -drag(vessel, top / 2) * scale
    step = 1e-4 * top
    above, below = (
        drag(vessel, top / 2 + sign * step) + thrust(vessel, both / 2, top / 2 + sign * step).sum(-1)
        for sign in (1, -1)
    )
    found["time_constant"] = vessel.mass * 2 * step / (below - above)
    shares = torch.linspace(COAST, 1.0, 2001, dtype=torch.float64)
    found["stopping_distance"] = torch.trapezoid(
        torch.stack([vessel.mass * share * top * top / -drag(vessel, share * top) for share in shares], -1), shares
    )
    last = {name: value.expand(missions, n)[mission] for name, value in found.items()}
    return {
        boat: {name: float(value[mission]) for name, value in parameters[boat].items()}
        | {name: float(value[k]) for name, value in last.items()}
        for k, boat in enumerate(fleet_names(n, plant))
    }


def _season(
    n: int,
    plant: str,
    hours: float,
    mission_minutes: float,
    seed: int,
    spread: float,
    drift: float,
    fleet_seed: int | None,
) -> tuple[int, Vessel]:
    """The number of missions, and the true boats on each of them, as `usvlearn.simulate.fleet.fleet` draws them."""
    missions = math.ceil(round(hours * 60 / mission_minutes, 6))
    return missions, fleet_vessels(n, spread, plant, seed if fleet_seed is None else fleet_seed, missions, drift)


def true_parameters(
    mass: float,
    n: int,
    plant: str,
    hours: float,
    mission_minutes: float,
    seed: int,
    spread: float = 1.0,
    drift: float = 0.2,
    fleet_seed: int | None = None,
    **_,
) -> dict[str, dict[str, np.ndarray]]:
    """The parameters of every boat by name, one value for each mission, in the units of `SurgeDynamics`.

    Args:
        mass: declared, kg.
        n, plant, hours, mission_minutes, seed, spread, drift, fleet_seed: as of `usvlearn.simulate.fleet.fleet`.

    >>> found = true_parameters(28.0, 1, "heron", hours=1.0, mission_minutes=30.0, seed=0, spread=0.0)
    >>> found["heron"]["drag_linear"].round(3).tolist(), len(found["heron"])
    ([-16.45, -16.45], 9)
    """
    missions, vessel = _season(n, plant, hours, mission_minutes, seed, spread, drift, fleet_seed)
    one = torch.ones(2, dtype=torch.float64)
    xi = torch.linspace(0.0, 1.0, GRID, dtype=torch.float64)[1:]
    v = steady_surge(vessel, one).expand(missions, n)[..., None] * xi
    scale = (mass / vessel.mass).expand(missions, n)
    cut = vessel._replace(**{name: leaf[..., None] for name, leaf in vessel._asdict().items() if leaf.ndim == 2})
    force = drag(cut, v).expand(missions, n, len(xi))
    linear, quadratic = _fit(v, force)
    found = {"drag_quadratic": quadratic, "drag_linear": linear, "drag_cross": vessel.drag_cross.expand(missions, n)}
    sides = torch.stack([static_thrust(vessel, x.expand(2)) for x in xi], -1)  # (missions, n, 2, commands)
    alpha, beta = _fit(xi, sides)
    gamma = vessel.thrust_speed.expand(missions, n, 2)
    for k, side in enumerate(("left", "right")):
        found |= {f"thrust_linear_{side}": alpha[..., k], f"thrust_quadratic_{side}": beta[..., k]}
        found[f"thrust_speed_{side}"] = gamma[..., k]
    return {
        boat: {name: (value * scale)[:, k].numpy() for name, value in found.items()}
        for k, boat in enumerate(fleet_names(n, plant))
    }


def _fit(x: torch.Tensor, y: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """a and b of y ≈ a x + b x², x > 0, `(grid,)` or like y, y `(..., grid)`.

    x² is made orthogonal to x first. `torch.linalg.lstsq` is not used: its pivots begin from memory that nobody has
    set (`jpvt` of LAPACK's gelsy), so its last digits differ between calls with equal numbers.
    """
    square = x * x
    rest = square - (square * x).sum(-1, keepdim=True) / square.sum(-1, keepdim=True) * x
    b = (y * rest).sum(-1) / (rest * rest).sum(-1)
    a = ((y - b[..., None] * square) * x).sum(-1) / square.sum(-1)
    return a, b
