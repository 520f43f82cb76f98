"""The true quantities of turning of a simulated boat.

Names and definitions are those of `usvlearn.estimators.axis.turning_quantities`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from usvlearn.simulate.planar import PlanarBoat, rates, simulate_planar
from usvlearn.simulate.planar_fleet import planar_boats
from usvlearn.simulate.truth import COMMANDS

INNER = 0.5  # command of the inner side of a turn, relative to that of the outer one
SETTLED, STEP = 120.0, 0.5  # s of constant commands; s of a step
FASTEST, HALVINGS = 20.0, 60  # rad/s; of the bisection
SMALL = 1e-4  # rad/s, of a finite difference


def true_turning(boat: PlanarBoat) -> dict[str, float]:
    """The quantities of `usvlearn.estimators.axis.turning_quantities`, from simulated turns and `rates`.

    >>> from usvlearn.simulate.planar import HERON
    >>> {name: round(value, 2) for name, value in true_turning(HERON).items() if "half" in name}
    {'yaw_rate_half': 0.18, 'turning_radius_half': 6.99}
    """
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
    """`true_turning` of each boat of a single configured `planar_fleet`, by name; {} for other data.

    >>> turning_of([{"_target_": "usvlearn.logs.read.read", "path": "logs"}])
    {}
    """
    if len(sources) != 1 or not sources[0]["_target_"].endswith("planar_fleet.planar_fleet"):
        return {}
    given = {"n": 1, **sources[0]}
    boats = planar_boats(**{name: given[name] for name in ("n", "spread", "seed") if name in given})
    return {boat_name(k, len(boats)): true_turning(boat) for k, boat in enumerate(boats)}


def boat_name(k: int, n: int) -> str:
    """The name of the k-th of n boats in `planar_fleet`.

    >>> boat_name(0, 1), boat_name(0, 2)
    ('planar', 'planar1')
    """
    return "planar" if n == 1 else f"planar{k + 1}"
