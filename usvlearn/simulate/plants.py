"""Five vessels with published mass, drag and thrust; their yaw motion is assumed.

Mass, drag and thrust are the published figures that each docstring gives. None of the sources has the yaw motion or the
turning drag in this form, so both are set to plausible values: with one side at full ahead and the other at rest the
boat turns at 0.6 rad/s.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch

from usvlearn.errors import check_choice
from usvlearn.simulate.vessel import Vessel

TURN_RATE = 0.6  # rad/s, one side full ahead, the other at rest

KINGFISHER = (-4, -4, -4, -4, -2, -1, 0, 0, 0, 0, 0, 0, 0, 0.5, 1.5, 4.75, 8.25, 16, 19.5, 19.5, 19.5)


def build(
    mass: float,  # kg, added mass included
    drag: tuple[float, float],  # N s/m and N s^2/m^2: force = drag[0] v + drag[1] v^2
    table: Sequence[float],  # N of one thruster at evenly spaced commands from -1 to 1
    cross: float,  # N s^2/(m rad), drag of turning
    yaw_lag: float,  # s
    lag: float = 0.05,  # s, of a thruster
    knee: float = math.inf,  # m/s above which `drag_fast` replaces `drag`
    drag_fast: tuple[float, float] = (0.0, 0.0),
    sides: tuple[float, float] = (1.0, 1.0),  # factor on the thrust of the left and of the right side
    dtype: torch.dtype = torch.float64,
) -> Vessel:
    """A vessel without batch axes, from positive drag figures."""

    def leaf(value):
        return torch.as_tensor(value, dtype=dtype)

    none = torch.zeros(2, dtype=dtype)
    return Vessel(
        mass=leaf(mass),
        drag_quadratic=leaf(-drag[1]),
        drag_linear=leaf(-drag[0]),
        drag_cross=leaf(-cross),
        knee=leaf(knee),
        drag_quadratic_fast=leaf(-drag_fast[1]),
        drag_linear_fast=leaf(-drag_fast[0]),
        thrust_table=leaf(sides)[:, None] * leaf(table),
        thrust_linear=none,
        thrust_quadratic=none,
        thrust_speed=none,
        lag=leaf(lag),
        yaw_gain=leaf(TURN_RATE / table[-1]),
        yaw_lag=leaf(yaw_lag),
    )


def heron() -> Vessel:
    """Clearpath Heron, maker's model: 28 kg, drag 16.45 v + 2.942 v^2 N, 33.6 N a side; tops 2.74 m/s."""
    table = (-19.88, -16.52, -12.6, -5.6, -1.4, 0.0, 2.24, 9.52, 21.28, 28.0, 33.6)
    return build(28.0, (16.45, 2.942), table, cross=8.0, yaw_lag=0.5)


def kingfisher() -> Vessel:
    """Clearpath Kingfisher, identified on the boat: 35 kg, drag 17.26 v^2 N; tops 1.5 m/s.

    Thrust is nothing from -0.4 to 0.2 of full scale and saturates at 19.5 N ahead, 4 N astern.
    """
    return build(35.0, (0.0, 17.26), KINGFISHER, cross=8.0, yaw_lag=0.5)


def vtec() -> Vessel:
    """VTec: 30 + 2.25 kg, -30 ... 36.5 N a side, the right one times 0.78; tops 1.5 m/s.

    Drag is not smooth: 25 v N up to 1.2 m/s, -64.55 v + 70.92 v^2 N above.
    """
    fast = (-64.55, 70.92)
    thrust, drag = (-30.0, 0.0, 36.5), (25.0, 0.0)
    return build(32.25, drag, thrust, cross=10.0, yaw_lag=0.6, knee=1.2, drag_fast=fast, sides=(1.0, 0.78))


def otter() -> Vessel:
    """Otter: 80 + 5.5 kg, drag 77.56 v N, thruster lag 0.1 s; tops 3.1 m/s.

    Thrust is k n |n|, n the propeller speed: k = 0.01108 N s^2/rad^2 up to 103.9 rad/s ahead, 0.006445 down
    to -101.7 rad/s astern; command 1 is full ahead, -1 full astern. Tabulated at steps of 0.05, within 0.1 N.
    """
    even = [2 * i / 40 - 1 for i in range(41)]
    table = [0.01108 * (103.9 * x) ** 2 if x > 0 else -0.006445 * (101.7 * x) ** 2 for x in even]
    return build(85.5, (77.56, 0.0), table, cross=25.0, yaw_lag=1.0, lag=0.1)


def wamv() -> Vessel:
    """WAM-V: 180 kg, drag 51.3 v + 72.4 v^2 N, -2354 ... 2354 N a side, linear in the command; tops 7.7 m/s."""
    return build(180.0, (51.3, 72.4), (-2354.0, 0.0, 2354.0), cross=80.0, yaw_lag=1.5)


PLANTS: dict[str, Callable[[], Vessel]] = {
    "heron": heron,
    "kingfisher": kingfisher,
    "vtec": vtec,
    "otter": otter,
    "wamv": wamv,
}


def plant(name: str) -> Vessel:
    """The vessel of a name.

    Args:
        name: heron, kingfisher, vtec, otter or wamv.

    Returns:
        The vessel, leaves without batch axes.

    Raises:
        ConfigError: no such plant; the message lists them.

    >>> plant("otter").lag.item()
    0.1
    """
    return PLANTS[check_choice("plant", name, tuple(PLANTS))]()
