"""The controller aboard a simulated boat: a speed PI or an open throttle, and a heading P, to two commands.

    e = (surge_reference - surge) / surge_max                                                         (1)
    I+ = clip(I + dt k_i e),   throttle = I+ + k_p e          where the speed is controlled           (2)
    turn = clip(k_h wrap(heading_reference - heading), turn_max)                                      (3)
    command = round(power * clip(throttle +- turn))           left +, right -                         (4)

Where the throttle is open the integral follows it, so that taking control over makes no bump.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from usvlearn.errors import check_positive


class Reference(NamedTuple):
    """What the boat is told at one tick, or `(ticks, ...)` for a mission. Leaves are `(*batch,)`."""

    surge: Tensor  # speed over ground, share of the top speed; NaN where the throttle is open
    throttle: Tensor  # mean of both commands where it is open, share of full scale
    heading: Tensor  # rad
    power: Tensor  # 1, or 0 where both thrusters are off


@dataclass(frozen=True)
class Autopilot:
    """Gains of the controller.

    Args:
        hz: rate of the commands, 1/s.
        proportional: k_p, share of full scale per share of top speed.
        integral: k_i, 1/s.
        heading: k_h, 1/rad.
        turn_max: largest share of full scale spent on turning, a side.
        lowest: least command: 0 goes ahead only, -1 backs up too.
        resolution: commands are multiples of it.
    """

    hz: float = 4.0
    proportional: float = 0.6
    integral: float = 0.3
    heading: float = 0.6
    turn_max: float = 0.35
    lowest: float = 0.0
    resolution: float = 0.01

    def __post_init__(self):
        check_positive("hz of the autopilot", self.hz, "Hz")
        check_positive("resolution of the autopilot", self.resolution)


def wrap(angle: Tensor) -> Tensor:
    """The angle within -pi ... pi, rad; shape unchanged.

    >>> round(wrap(torch.tensor(2 * math.pi + 0.5)).item(), 5)
    0.5
    """
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def steer(
    autopilot: Autopilot, integral: Tensor, reference: Reference, surge: Tensor, heading: Tensor
) -> tuple[Tensor, Tensor]:
    """The next integral `(*batch,)` and the command `(*batch, 2)`.

    Args:
        integral: I, `(*batch,)`.
        surge: speed over ground, share of the top speed, `(*batch,)`.
        heading: rad, `(*batch,)`.

    >>> one = torch.ones(())
    >>> ahead = Reference(surge=one * torch.nan, throttle=0.5 * one, heading=0 * one, power=one)
    >>> steer(Autopilot(), 0 * one, ahead, 0 * one, 0 * one)[1].tolist()
    [0.5, 0.5]
    """
    controlled = ~torch.isnan(reference.surge)
    error = torch.where(controlled, reference.surge, surge) - surge  # 1.
    charged = (integral + autopilot.integral / autopilot.hz * error).clamp(autopilot.lowest, 1.0)  # 2.
    integral = torch.where(controlled, charged, reference.throttle)
    throttle = (integral + autopilot.proportional * error).clamp(autopilot.lowest, 1.0)
    turn = autopilot.heading * wrap(reference.heading - heading)  # 3.
    turn = turn.clamp(-autopilot.turn_max, autopilot.turn_max)
    command = torch.stack((throttle + turn, throttle - turn), dim=-1).clamp(autopilot.lowest, 1.0)  # 4.
    steps = (command * reference.power.unsqueeze(-1) / autopilot.resolution).round()
    return integral, steps * autopilot.resolution
