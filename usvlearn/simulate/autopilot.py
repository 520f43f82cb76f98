"""The controller of a simulated boat: a PI controller of the speed (or an open throttle) and a P controller of heading.

    e = (surge_reference - surge) / surge_max                                                         (1)
    I+ = clip(I + dt k_i e),   throttle = I+ + k_p e          where the speed is controlled           (2)
    turn = clip(k_h wrap(heading_reference - heading), turn_max)      where the heading is controlled (3)
    command = round(power * clip(throttle +- turn))           left +, right -                         (4)

Where the throttle is given directly, the integral follows it, so that switching to speed control makes no jump.
`missions_kernel.steer` computes it.
"""

from __future__ import annotations

from dataclasses import dataclass

from usvlearn.errors import check_positive


@dataclass(frozen=True)
class Autopilot:
    """Gains of the controller.

    Args:
        hz: rate of the commands, 1/s.
        proportional: k_p, share of full scale per share of top speed.
        integral: k_i, 1/s.
        heading: k_h, 1/rad.
        turn_max: largest share of full scale spent on turning, a side.
        lowest: least command, share of full scale: 0 goes ahead only, -1 backs up too.
        resolution: commands are multiples of it, share of full scale.

    Raises:
        ConfigError: a number outside its range.

    >>> Autopilot(lowest=-1.0).hz
    4.0
    """

    hz: float = 4.0
    proportional: float = 0.6
    integral: float = 0.3
    heading: float = 0.6
    turn_max: float = 0.35
    lowest: float = 0.0
    resolution: float = 0.01

    def __post_init__(self):
        check_positive("hz", self.hz, "Hz")
        check_positive("resolution", self.resolution)
