"""A thruster-driven vessel in surge and yaw; `missions_kernel` steps it.

Equations (1) to (4): `docs/theory/model.md#simulation`. In the code v is the surge speed through the water, tau_i the
thrust of a side, and xi the speed of a thruster as a share of full scale. Parameters are leaves of `Vessel`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor


class Vessel(NamedTuple):
    """Parameters; leaves broadcast against `(*batch,)`, those of the thrusters end in (left, right).

    >>> from usvlearn.simulate.plants import heron
    >>> heron().mass.item(), heron().thrust_linear.shape
    (28.0, torch.Size([2]))
    """

    mass: Tensor  # (*batch,) kg, added mass included
    drag_quadratic: Tensor  # (*batch,) c_q, N s^2/m^2
    drag_linear: Tensor  # (*batch,) c_l, N s/m
    drag_cross: Tensor  # (*batch,) c_x, N s^2/(m rad)
    knee: Tensor  # (*batch,) m/s: above this |v| the next two replace c_q and c_l; may be infinite
    drag_quadratic_fast: Tensor  # (*batch,) N s^2/m^2
    drag_linear_fast: Tensor  # (*batch,) N s/m
    thrust_table: Tensor  # (*batch, 2, nodes) N at evenly spaced xi from -1 to 1: dead band, saturation
    thrust_linear: Tensor  # (*batch, 2) alpha, N
    thrust_quadratic: Tensor  # (*batch, 2) beta, N
    thrust_speed: Tensor  # (*batch, 2) gamma, N s/m
    lag: Tensor  # (*batch,) s, of a thruster
    yaw_gain: Tensor  # (*batch,) rad/s of settled yaw rate per N of difference between the sides
    yaw_lag: Tensor  # (*batch,) s


class VesselState(NamedTuple):
    """The state of motion. Leaves are `(*batch,)` except `shaft`."""

    surge: Tensor  # (*batch,) m/s through the water
    heading: Tensor  # (*batch,) rad, 0 north, clockwise, not wrapped
    yaw_rate: Tensor  # (*batch,) rad/s
    shaft: Tensor  # (*batch, 2) thruster speed, left and right, share of full scale


def at_rest(batch: tuple[int, ...] = (), heading: Tensor | float = 0.0, dtype=torch.float64) -> VesselState:
    """The state of a vessel that lies still."""
    zero = torch.zeros(batch, dtype=dtype)
    return VesselState(zero, zero + heading, zero, torch.zeros(*batch, 2, dtype=dtype))


def scale_thrust(vessel: Vessel, sides: Tensor) -> Vessel:
    """The vessel with the thrust of each side multiplied by `sides`, `(*batch, 2)`."""
    return vessel._replace(
        thrust_table=vessel.thrust_table * sides[..., None],
        thrust_linear=vessel.thrust_linear * sides,
        thrust_quadratic=vessel.thrust_quadratic * sides,
        thrust_speed=vessel.thrust_speed * sides,
    )


def drag(vessel: Vessel, surge: Tensor, yaw_rate: Tensor | float = 0.0) -> Tensor:
    """Force of the water on the hull, N, `(*batch,)`: the first three terms of (1)."""
    turning: Any = abs(yaw_rate)
    speed = abs(surge)
    fast = speed > vessel.knee
    quadratic = torch.where(fast, vessel.drag_quadratic_fast, vessel.drag_quadratic)
    linear = torch.where(fast, vessel.drag_linear_fast, vessel.drag_linear)
    return (quadratic * speed + (linear + vessel.drag_cross * turning)) * surge


def static_thrust(vessel: Vessel, shaft: Tensor) -> Tensor:
    """Force of each thruster without the term in the speed, N, `(*batch, 2)`: (2) with gamma = 0.

    The table is interpolated linearly; beyond its ends (|xi| > 1) the thruster is saturated.
    """
    shaft = shaft.clamp(-1.0, 1.0)
    nodes = vessel.thrust_table.shape[-1]
    shape = np.broadcast_shapes(shaft.shape, vessel.thrust_table.shape[:-1])
    place = ((shaft + 1) * ((nodes - 1) / 2)).expand(shape)
    below = place.detach().floor().clamp(max=nodes - 2)
    index = below.long().unsqueeze(-1)
    table = vessel.thrust_table.expand(*shape, nodes)
    low = table.gather(-1, index).reshape(shape)
    high = table.gather(-1, index + 1).reshape(shape)
    curve = low + (high - low) * (place - below)
    return curve + (vessel.thrust_linear + vessel.thrust_quadratic * abs(shaft)) * shaft


def thrust(vessel: Vessel, shaft: Tensor, surge: Tensor) -> Tensor:
    """Force of each thruster, N, `(*batch, 2)`: (2)."""
    lift = vessel.thrust_speed * shaft.clamp(-1.0, 1.0)
    return static_thrust(vessel, shaft) + lift * abs(surge).unsqueeze(-1)


def over_ground(surge: Tensor, heading: Tensor, current: Tensor, direction: Tensor) -> Tensor:
    """Surge speed over ground, m/s: through the water, plus the current's part along the heading.

    All arguments broadcast.
    """
    return surge + current * torch.cos(direction - heading)


def steady_surge(vessel: Vessel, command: Tensor, highest: float = 50.0) -> Tensor:
    """The speed at which drag and thrust balance while going straight, by bisection.

    Args:
        vessel: its parameters.
        command: `(*batch, 2)` share of full scale.
        highest: bound of the search, m/s.

    Returns:
        The speed, m/s, `(*batch,)`.

    >>> from usvlearn.simulate.plants import heron
    >>> round(float(steady_surge(heron(), torch.ones(2, dtype=torch.float64))), 3)
    2.741
    """
    with torch.no_grad():
        balance = drag(vessel, torch.zeros_like(command[..., 0])) * 0
        low, high = balance - highest, balance + highest
        for _ in range(60):  # 100 m/s / 2^60 is below float64's resolution
            middle = (low + high) / 2
            ahead = drag(vessel, middle) + thrust(vessel, command, middle).sum(-1) > 0
            low, high = torch.where(ahead, middle, low), torch.where(ahead, high, middle)
        return (low + high) / 2
