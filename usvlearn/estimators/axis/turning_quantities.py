"""Physical quantities of turning, from the parameters of the filters of surge, sway and yaw rate. Imports no torch.

Equations (1) to (5): `docs/theory/identification.md#turning`. θ of the yaw rate is per unit inertia and θ of the sway
per unit mass, in the order of `state.names`; that of the surge is of a joint EKF, seen ahead
(`usvlearn.estimators.joint.quantities.Ahead`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from usvlearn.estimators.augmented_ekf.state import MOST
from usvlearn.estimators.axis.state import CROSS, LINEAR, QUADRATIC, SIZES, THETA
from usvlearn.estimators.joint.quantities import COMMANDS, SIDES, Ahead

INNER = 0.5  # command of the inner side of a turn, relative to that of the outer one
HALVINGS = 50  # of (4)
QUANTITIES = {
    "yaw_rate_full_difference": "rad/s",
    **{f"yaw_rate_{name}": "rad/s" for name in COMMANDS},
    **{f"turning_radius_{name}": "m" for name in COMMANDS},
    "yaw_time_constant": "s", "yaw_time_constant_rest": "s",
}  # fmt: skip
OF_FIT = {"thrust_lag": "s", "dead_zone": "of full", "compass_offset": "deg", "current": "m/s"}  # of a batch fit
MEANING_OF_FIT = (
    "thrust_lag: the time constant with which thrust follows a command, as turns show it. dead_zone: the share of a "
    "command that has no thrust. compass_offset: what the compass shows too much, clockwise; add it to "
    "data.channels.heading.zero. current: its mean size over the missions."
)
MEANING = (
    "yaw_rate_full_difference: on the spot, one side full ahead and the other one full astern. yaw_rate and "
    "turning_radius: of a steady turn with the outer side at full, half or quarter command, and the inner one at half "
    "of that; mean of both directions. yaw_time_constant: straight ahead at the steady speed of half command, and at "
    "rest."
)


class Theta(NamedTuple):
    """Parameters of a boat."""

    surge: np.ndarray  # (..., m) of a joint EKF
    yaw: np.ndarray  # (..., 20)
    sway: np.ndarray | None = None  # (..., 12); None: the sway is not measured


def quantities(theta: Theta) -> dict[str, np.ndarray]:
    """All quantities of `QUANTITIES`, `(...)` by name; NaN where the parameters determine none."""
    yaw = theta.yaw
    linear, quadratic, cross = (yaw[..., place - THETA] for place in (LINEAR, QUADRATIC, CROSS))
    spot = [balance(quadratic, linear, acceleration("yaw", yaw, 0.0, 0.0, 0.0, x, -x)) for x in (1.0, -1.0)]
    u, v, r = steady_turns(theta)
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = (np.hypot(u, v) / np.abs(r)).mean(0)
        slope = linear + cross * Ahead(theta.surge).steady_speed(COMMANDS["half"])
        constants = [np.where(each < 0, -1 / each, np.nan) for each in (slope, linear)]
    rate = (r[0] - r[1]) / 2
    return dict(zip(QUANTITIES, [(spot[0] - spot[1]) / 2, *rate, *radius, *constants], strict=True))


def steady_turns(theta: Theta) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u, v, r of (2) to (4), m/s, m/s, rad/s, `(2, 3, ...)`, to starboard, to port, by `COMMANDS`; NaN without."""
    behind = [1] * (theta.yaw.ndim - 1)
    outer = np.array(list(COMMANDS.values())).reshape(-1, *behind)
    left, right = np.stack([outer, INNER * outer]), np.stack([INNER * outer, outer])
    sign = np.array([1.0, -1.0]).reshape(2, 1, *behind)
    ahead, sway = Ahead(theta.surge), theta.sway
    sides = dict(zip(SIDES, (left, right), strict=True))
    thrust = sum(ahead.thrust(command, side) for side, command in sides.items())
    lift = sum(ahead.sums[f"thrust_speed_{side}"] * command for side, command in sides.items())

    def motion(r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u = balance(ahead.quadratic, ahead.linear + ahead.sums["drag_cross"] * np.abs(r) + lift, thrust)  # (2)
        if sway is None:
            return u, np.zeros_like(u)
        drag = sway[..., LINEAR - THETA] + sway[..., CROSS - THETA] * np.abs(u)
        push = acceleration("sway", sway, 0.0, r, u, left, right)
        return u, balance(sway[..., QUADRATIC - THETA], drag, push)  # (3)

    def faster(size: np.ndarray) -> np.ndarray:
        u, v = motion(sign * size)
        return sign * acceleration("yaw", theta.yaw, sign * size, v, u, left, right)

    low = np.zeros((2, len(COMMANDS), *theta.yaw.shape[:-1]))
    high = low + MOST
    exists = (faster(low) > 0) & (faster(high) < 0)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        up = faster(middle) > 0
        low, high = np.where(up, middle, low), np.where(up, high, middle)
    r = np.where(exists, sign * (low + high) / 2, np.nan)
    return *motion(r), r


def balance(quadratic, linear, push):
    """y of (1); infinite without drag, NaN where no y balances."""
    with np.errstate(divide="ignore", invalid="ignore"):
        whole = -linear + np.sqrt(linear * linear - 4 * quadratic * np.abs(push))
        return np.where(whole >= 0, 2 * push / whole, np.nan)


def acceleration(kind: str, theta: np.ndarray, y, other, surge, left, right) -> np.ndarray:
    """f of (2) of `state` without disturbance, rad/s² or m/s², of yaw rate or sway y (`kind`) and the other one."""
    along = np.abs(surge)
    terms = [1.0, y, y * np.abs(y), along * y, surge * other, other, surge]
    for x in (left, right):
        size = np.abs(x)
        terms += [x, x * size] + ([x * along, x**3, size, x * x] if kind == "yaw" else [])
    assert len(terms) == SIZES[kind] - THETA - 1  # all but the lag
    total = np.zeros(())
    for k, each in enumerate(terms):
        total = total + theta[..., k] * each
    return total
