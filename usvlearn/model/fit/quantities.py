"""Physical quantities of a fitted boat that moves straight ahead, named as in `usvlearn.estimators.joint.quantities`.

The thrust of a side at standstill T(ξ) and the drag D(v) are curves here. The parameters of the paper are their
least-squares fits, α ξ + β ξ² over commands from 0 to 1 and −q v² − l v over speeds from 0 to the steady speed at full
command, as those of simulated boats are (`usvlearn.simulate.truth`). The steady speed is the first at which drag and
thrust are equal; the time constant is that of a departure of a tenth of the top speed; the stopping distance is an
integral.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import brentq

from usvlearn.estimators.joint.quantities import COAST, COMMANDS, SIDES
from usvlearn.model.fit.terms import AT, DRAG_NODES, PLACE_DRAG, PLACE_LAG, THRUST_NODES

GRID = 101  # points of a least-squares fit, and of the integral
FARTHEST = 3.0  # top speeds within which a steady speed is looked for
NEAR = 0.1  # top speeds: the departure of the time constant


class Ahead:
    """The forces of some parameters of motion straight ahead, per unit mass.

    Args:
        theta: by `terms.NAMES`, `(parameters,)`.
        top: top speed of the nodes of drag, m/s.
    """

    def __init__(self, theta: np.ndarray, top: float):
        self.theta, self.top = theta, top

    def _at(self, name: str) -> float:
        return float(self.theta[AT[name]])

    def thrust(self, command: np.ndarray | float, side: str) -> np.ndarray:
        """T(ξ), m/s², of commands −1 … 1."""
        x: Any = np.asarray(command, float)
        a, b, k, e1, e2 = (
            self._at(f"thrust_{name}_{side}")
            for name in ("linear", "quadratic", "cubic", "even_linear", "even_quadratic")
        )
        size, found = np.abs(x), np.zeros(np.shape(x))
        for sign, way in (("ahead", x >= 0), ("astern", x < 0)):
            first = AT[f"thrust_node_{side}_{sign}_{THRUST_NODES[0]:g}"]
            found = found + np.where(way, _line(size, THRUST_NODES, self.theta[first : first + len(THRUST_NODES)]), 0.0)
        return a * x + b * x * size + k * x**3 + e1 * size + e2 * x * x + np.sign(x) * found

    def drag(self, speed: np.ndarray | float) -> np.ndarray:
        """D(v), positive for v > 0, m/s²."""
        v = np.asarray(speed, float)
        size, nodes = np.abs(v), self.theta[PLACE_DRAG:PLACE_LAG]
        curve = np.sign(v) * _line(size, DRAG_NODES * self.top, nodes)
        return -(
            self._at("drag_quadratic") * size * v + self._at("drag_linear") * v + self._at("drag_even") * v * v + curve
        )

    @property
    def lift(self) -> dict[str, float]:
        """γ + e₃ of each side, 1/s: what its thrust loses with speed."""
        return {side: self._at(f"thrust_speed_{side}") + self._at(f"thrust_even_speed_{side}") for side in SIDES}

    def balance(self, speed: float, command: float) -> float:
        """Acceleration with one command for both sides, m/s²."""
        pull = sum(float(self.thrust(command, side)) for side in SIDES)
        return pull + sum(self.lift.values()) * command * speed - float(self.drag(speed))

    def steady_speed(self, command: float) -> float:
        """m/s; NaN where drag and thrust are never equal."""
        speeds = np.linspace(0.0, FARTHEST * self.top, 3 * GRID)
        sign = np.array([self.balance(v, command) > 0 for v in speeds])
        if not sign[0] or sign.all():
            return np.nan
        k = int(np.argmin(sign))
        root: Any = brentq(self.balance, speeds[k - 1], speeds[k], args=(command,))
        return float(root)


def quantities(theta: np.ndarray, top: float, mass: float) -> dict[str, float]:
    """All quantities; NaN where the parameters determine none.

    Args:
        theta: by `terms.NAMES`, per unit mass.
        top: top speed of the nodes of drag, m/s.
        mass: kg.

    >>> from usvlearn.model.fit.terms import prior
    >>> found = quantities(prior("nine", top=2.0).mean, 2.0, 28.0)
    >>> round(found["steady_speed_full"], 3), round(found["thrust_full_left"], 2)
    (2.0, 8.4)
    """
    boat = Ahead(theta, top)
    found: dict[str, float] = {}
    commands = np.linspace(0.0, 1.0, GRID)
    fastest = boat.steady_speed(1.0)
    speeds = np.linspace(0.0, fastest if np.isfinite(fastest) else top, GRID)
    quadratic, linear = _fitted(speeds, -boat.drag(speeds))
    found |= {"drag_quadratic": quadratic, "drag_linear": linear, "drag_cross": float(theta[AT["drag_cross"]])}
    for side in SIDES:
        quadratic, linear = _fitted(commands, boat.thrust(commands, side))
        found |= {f"thrust_linear_{side}": linear, f"thrust_quadratic_{side}": quadratic}
        found[f"thrust_speed_{side}"] = boat.lift[side]
        found[f"thrust_full_{side}"] = float(boat.thrust(1.0, side))
    found["drag_half_speed"] = float(boat.drag(fastest / 2))
    found = {name: mass * value for name, value in found.items()}
    found |= {f"steady_speed_{name}": boat.steady_speed(command) for name, command in COMMANDS.items()}
    step = NEAR * fastest
    slope = (boat.balance(fastest / 2 - step, 0.5) - boat.balance(fastest / 2 + step, 0.5)) / (2 * step)
    found["time_constant"] = 1 / slope if slope > 0 else np.nan
    coasts = np.linspace(COAST, 1.0, GRID) * fastest
    with np.errstate(all="ignore"):
        found["stopping_distance"] = float(np.trapezoid(coasts / boat.drag(coasts), coasts))
        found["thrust_ratio"] = found["thrust_full_left"] / found["thrust_full_right"]
    return found


def _line(x: np.ndarray, nodes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """A piecewise linear curve from 0, which goes on beyond its last node."""
    inside = np.interp(x, np.append(0.0, nodes), np.append(0.0, values))
    slope = (values[-1] - values[-2]) / (nodes[-1] - nodes[-2])
    return np.where(x > nodes[-1], values[-1] + slope * (x - nodes[-1]), inside)


def _fitted(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """The least-squares fit a x² + b x, (a, b)."""
    a, b = np.linalg.lstsq(np.stack([x * x, x], -1), y, rcond=None)[0]
    return float(a), float(b)
