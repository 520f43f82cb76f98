"""The true parameters and quantities of a simulated boat, as far as the models can represent them.

If the thrust of a plant is a table, or its drag has a knee, the true parameters are those of the least-squares fits
c_q |v| v + c_l v over speeds from 0 to the top speed, and α ξ + β ξ|ξ| over commands from 0 to 1. Surge data identify
the parameters only in proportion to the mass, so all are scaled by declared over true mass. Names and definitions of
quantities are those of `usvlearn.estimators.joint.quantities` and, of turning, `estimators.axis.turning_quantities`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from usvlearn.simulate.fleet import fleet_names, fleet_vessels
from usvlearn.simulate.planar import PlanarBoat, rates, simulate_planar
from usvlearn.simulate.planar_fleet import planar_boats
from usvlearn.simulate.vessel import Vessel, drag, static_thrust, steady_surge, thrust

GRID = 101  # points of a fit
COAST = 0.1  # share of the speed that is left at the end of the stopping distance
COMMANDS = {"full": 1.0, "half": 0.5, "quarter": 0.25}


def truth_of(sources: Sequence[Mapping[str, Any]], mass: float) -> dict[str, dict[str, np.ndarray]]:
    """`true_parameters` of a single configured simulation; {} for several sources, or for other data."""
    if len(sources) != 1 or not sources[0]["_target_"].endswith("simulate.fleet.fleet") or sources[0].get("fault"):
        return {}  # a fault changes the truth during the season
    return true_parameters(mass, **sources[0])


def quantities_of(sources: Sequence[Mapping[str, Any]], mass: float) -> dict[str, dict[str, float]]:
    """`true_quantities` of a single configured simulation; {} as of `truth_of`."""
    parameters = truth_of(sources, mass)
    return true_quantities(mass, parameters, **sources[0]) if parameters else {}


def true_quantities(
    mass: float,
    parameters: Mapping[str, Mapping[str, np.ndarray]],
    n: int,
    plant: str,
    mission: int = -1,
    **season: Any,
) -> dict[str, dict[str, float]]:
    """What `identified` is compared with: boat -> quantity -> value on one mission.

    Tables of thrust and a knee in the drag count as they are, except for the parameters, which are fits.
    The declared mass is in kg; `n`, `plant` and `season` are those of `usvlearn.simulate.fleet.fleet`. By default the
    last mission counts: what the boat is at the end.
    """
    missions, vessel = _season(n, plant, **season)
    both = torch.ones(2, dtype=torch.float64)
    quantities = {f"steady_speed_{name}": steady_surge(vessel, share * both) for name, share in COMMANDS.items()}
    top, scale = quantities["steady_speed_full"], mass / vessel.mass
    for k, side in enumerate(("left", "right")):
        quantities[f"thrust_full_{side}"] = static_thrust(vessel, both)[..., k] * scale
    quantities["thrust_ratio"] = quantities["thrust_full_left"] / quantities["thrust_full_right"]
    quantities["drag_half_speed"] = -drag(vessel, top / 2) * scale
    step = 1e-4 * top
    above, below = (
        drag(vessel, top / 2 + sign * step) + thrust(vessel, both / 2, top / 2 + sign * step).sum(-1)
        for sign in (1, -1)
    )
    quantities["time_constant"] = vessel.mass * 2 * step / (below - above)
    shares = torch.linspace(COAST, 1.0, 2001, dtype=torch.float64)
    quantities["stopping_distance"] = torch.trapezoid(
        torch.stack([vessel.mass * share * top * top / -drag(vessel, share * top) for share in shares], -1), shares
    )
    last = {name: value.expand(missions, n)[mission] for name, value in quantities.items()}
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
    spread: float = 1.0,
    drift: float = 0.2,
    fleet_seed: int | None = None,
    **_: Any,
) -> tuple[int, Vessel]:
    """The number of missions, and the true boats on each of them, as `usvlearn.simulate.fleet.fleet` draws them."""
    missions = math.ceil(round(hours * 60 / mission_minutes, 6))
    return missions, fleet_vessels(n, spread, plant, seed if fleet_seed is None else fleet_seed, missions, drift)


def true_parameters(mass: float, n: int, plant: str, **season: Any) -> dict[str, dict[str, np.ndarray]]:
    """The parameters of every boat by name, one value for each mission, in the units of `SurgeDynamics`.

    `mass` is the declared one, kg; the rest is as of `usvlearn.simulate.fleet.fleet`.
    """
    missions, vessel = _season(n, plant, **season)
    one = torch.ones(2, dtype=torch.float64)
    xi = torch.linspace(0.0, 1.0, GRID, dtype=torch.float64)[1:]
    v = steady_surge(vessel, one).expand(missions, n)[..., None] * xi
    scale = (mass / vessel.mass).expand(missions, n)
    cut = vessel._replace(**{name: leaf[..., None] for name, leaf in vessel._asdict().items() if leaf.ndim == 2})
    force = drag(cut, v).expand(missions, n, len(xi))
    linear, quadratic = _fit(v, force)
    values = {"drag_quadratic": quadratic, "drag_linear": linear, "drag_cross": vessel.drag_cross.expand(missions, n)}
    sides = torch.stack([static_thrust(vessel, x.expand(2)) for x in xi], -1)  # (missions, n, 2, commands)
    alpha, beta = _fit(xi, sides)
    gamma = vessel.thrust_speed.expand(missions, n, 2)
    for k, side in enumerate(("left", "right")):
        values |= {f"thrust_linear_{side}": alpha[..., k], f"thrust_quadratic_{side}": beta[..., k]}
        values[f"thrust_speed_{side}"] = gamma[..., k]
    return {
        boat: {name: (value * scale)[:, k].numpy() for name, value in values.items()}
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


INNER = 0.5  # command of the inner side of a turn, relative to that of the outer one
SETTLED, STEP = 120.0, 0.5  # s of constant commands; s of a step
FASTEST, HALVINGS = 20.0, 60  # rad/s; of the bisection
SMALL = 1e-4  # rad/s, of a finite difference


def true_turning(boat: PlanarBoat) -> dict[str, float]:
    """The quantities of `usvlearn.estimators.axis.turning_quantities`, from simulated turns and `rates`."""
    outer = np.array(list(COMMANDS.values()))
    commands = np.stack([np.stack([outer, inner * outer], -1) for inner in (INNER, 1.0)])  # turning, straight ahead
    held = np.broadcast_to(commands, (round(SETTLED / STEP), *commands.shape))
    (u, v, r), (speeds, _, _) = np.moveaxis(simulate_planar(boat, held, STEP)[-1], -1, -2)
    half = speeds[list(COMMANDS).index("half")]
    values = [_on_the_spot(boat), *r, *(np.hypot(u, v) / r), _time_constant(boat, half), _time_constant(boat, 0.0)]
    names = [
        "yaw_rate_full_difference", *(f"yaw_rate_{name}" for name in COMMANDS),
        *(f"turning_radius_{name}" for name in COMMANDS), "yaw_time_constant", "yaw_time_constant_rest",
    ]  # fmt: skip
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def _on_the_spot(boat: PlanarBoat) -> float:
    """The steady yaw rate at u = v = 0 under full difference, rad/s, by bisection."""
    low, high = 0.0, FASTEST
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        faster = rates(boat, np.array([0.0, 0.0, middle]), np.array([1.0, -1.0]))[2] > 0
        low, high = (middle, high) if faster else (low, middle)
    return low


def _time_constant(boat: PlanarBoat, surge: float) -> float:
    """−1/(∂ r_dot/∂r) straight ahead, s."""
    slowed, sped = rates(boat, np.array([[surge, 0.0, SMALL], [surge, 0.0, -SMALL]]), np.zeros(2))[:, 2]
    return 2 * SMALL / (sped - slowed)


def turning_of(sources: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """`true_turning` of each boat of a single configured `planar_fleet`, by name; {} for other data."""
    if len(sources) != 1 or not sources[0]["_target_"].endswith("planar_fleet.planar_fleet"):
        return {}
    given = {"n": 1, **sources[0]}
    boats = planar_boats(**{name: given[name] for name in ("n", "spread", "seed") if name in given})
    return dict(zip(fleet_names(len(boats), "planar"), map(true_turning, boats), strict=True))
