"""Physical quantities of a fitted boat that moves straight ahead, named as in `usvlearn.estimators.joint.quantities`.

The thrust of a side at standstill T(ξ) and the drag D(v) are curves here. The parameters of the paper are their
least-squares fits, α ξ + β ξ² over commands from 0 to 1 and −q v² − l v over speeds from 0 to the steady speed at full
command, as those of simulated boats are (`usvlearn.simulate.truth`). The steady speed is the first at which drag and
thrust are equal; the time constant is that of a departure of a tenth of the top speed; the stopping distance is an
integral.
"""

from __future__ import annotations

import numpy as np

from usvlearn.estimators.joint.quantities import COAST, COMMANDS, SIDES, Ahead
from usvlearn.estimators.joint.state import names
from usvlearn.model.fit.terms import AT, DRAG_NODES, PLACE_DRAG, PLACE_LAG, THRUST_NODES

GRID = 101  # points of a least-squares fit, and of the integral
FARTHEST = 3.0  # top speeds within which a steady speed is looked for
NEAR = 0.1  # top speeds: the departure of the time constant
JOINT = [AT[name] for name in names(even=True)]  # the parameters of a joint EKF


class CurvedAhead(Ahead):
    """A boat with curves of thrust and drag that moves straight ahead, of θ by `terms.NAMES`, `(..., parameters)`."""

    def __init__(self, theta: np.ndarray, top: float):
        super().__init__(theta[..., JOINT])
        self.theta, self.top = theta, top
        self.drag_nodes = theta[..., PLACE_DRAG:PLACE_LAG]

    def thrust(self, command, side: str):
        """T(ξ), m/s², of commands −1 … 1."""
        x = np.asarray(command, float)
        a, b, k, e1, e2 = self._thrust_terms(side)
        size = np.abs(x)
        curve = (hats(size, THRUST_NODES) * self._thrust_nodes(x, side)).sum(-1)
        return a * x + b * x * size + k * x**3 + e1 * size + e2 * x * x + np.sign(x) * curve

    def thrust_slope(self, command, side: str):
        """Derivative of `thrust` by the command, m/s²; at a node that towards larger commands."""
        x = np.asarray(command, float)
        a, b, k, e1, e2 = self._thrust_terms(side)
        size, way = np.abs(x), np.where(x >= 0, 1.0, -1.0)
        curve = (hat_slopes(size, THRUST_NODES) * self._thrust_nodes(x, side)).sum(-1)
        return a + 2 * b * size + 3 * k * x * x + e1 * way + 2 * e2 * x + curve

    def _thrust_terms(self, side: str) -> list[np.ndarray]:
        kinds = ("linear", "quadratic", "cubic", "even_linear", "even_quadratic")
        return [self.theta[..., AT[f"thrust_{kind}_{side}"]] for kind in kinds]

    def _thrust_nodes(self, x: np.ndarray, side: str) -> np.ndarray:
        """Those of the command's own sign, `(..., nodes)`."""
        ahead, astern = (AT[f"thrust_node_{side}_{sign}_{THRUST_NODES[0]:g}"] for sign in ("ahead", "astern"))
        count = len(THRUST_NODES)
        return np.where(
            x[..., None] >= 0, self.theta[..., ahead : ahead + count], self.theta[..., astern : astern + count]
        )

    def drag(self, speed):
        """D(v), m/s², of v ≥ 0."""
        return super().drag(speed) - self._drag_curve(speed)

    def _drag_curve(self, speed) -> np.ndarray:
        """What the nodes of drag add to the force at v ≥ 0, m/s²."""
        added: np.ndarray = (hats(np.abs(speed) / self.top, DRAG_NODES) * self.drag_nodes).sum(-1)
        return added

    def motion(self, speed, command):
        """dv/dt, m/s², and its derivative by the speed, 1/s, as in `Ahead`."""
        f, J = super().motion(speed, command)
        slopes = (hat_slopes(np.abs(speed) / self.top, DRAG_NODES) * self.drag_nodes).sum(-1)
        return f + np.sign(speed) * self._drag_curve(speed), J + slopes / self.top

    def settling(self, speed, command):
        """The time constant of a departure of `NEAR` top speeds, s, as in `Ahead`."""
        away = NEAR * self.top
        slope = (self.drag(speed + away) - self.drag(np.maximum(speed - away, 0.0))) / (
            away + np.minimum(away, speed)
        ) - self.lift * command
        with np.errstate(divide="ignore", invalid="ignore"):
            return 1 / slope

    @property
    def brakes(self):
        """Whether drag grows with speed at every node, `(...)`, bool."""
        speeds = self.top * np.append(0.0, DRAG_NODES)
        along = CurvedAhead(self.theta[..., None, :], self.top)
        return (np.diff(along.drag(speeds), axis=-1) > 0).all(-1)

    def steady_speed(self, command):
        """The first speed at which drag and thrust are equal, m/s, signed as the thrust; NaN beyond `FARTHEST`."""
        push = sum(self.thrust(command, side) for side in SIDES)
        brake = self.linear + self.lift * command
        c2, c1, c0 = (np.asarray(x)[..., None] for x in np.broadcast_arrays(self.quadratic, brake, np.abs(push)))
        # between two nodes the balance is a parabola: c₂ v² + (c₁ + slope) v + (c₀ + the line's height at v = 0)
        starts, ends = self.top * np.append(0.0, DRAG_NODES[:-1]), self.top * np.append(DRAG_NODES[:-1], FARTHEST)
        nodes = np.concatenate([np.zeros_like(self.drag_nodes[..., :1]), self.drag_nodes], -1)
        slope = np.diff(nodes, axis=-1) / (DRAG_NODES[0] * self.top)
        c1, c0 = c1 + slope, c0 + nodes[..., :-1] - slope * starts
        with np.errstate(all="ignore"):
            root = np.sqrt(c1 * c1 - 4 * c2 * c0)
            falling = np.where(c1 > 0, (-c1 - root) / (2 * c2), 2 * c0 / (root - c1))  # where the balance falls
            crossing = np.where((falling >= starts) & (falling <= ends), falling, np.inf).min(-1)
        return np.where(np.isfinite(crossing), np.sign(push) * crossing, np.nan)


def quantities(theta: np.ndarray, top: float, mass: float) -> dict[str, np.ndarray]:
    """All quantities, `(...)` each, of θ by `terms.NAMES`, `(..., parameters)`; NaN where it determines none."""
    boat, along = CurvedAhead(theta, top), CurvedAhead(theta[..., None, :], top)
    values: dict[str, np.ndarray] = {}
    share = np.linspace(0.0, 1.0, GRID)
    paper = np.linalg.pinv(np.stack([share * share, share], -1))  # of the two terms of the paper
    with np.errstate(all="ignore"):
        fastest = np.abs(boat.steady_speed(1.0))
        over = np.where(np.isfinite(fastest), fastest, top)
        quadratic, linear = np.moveaxis(-along.drag(over[..., None] * share) @ paper.T, -1, 0)
        values |= {"drag_quadratic": quadratic / over**2, "drag_linear": linear / over}
        values["drag_cross"] = theta[..., AT["drag_cross"]]
        for side in SIDES:
            quadratic, linear = np.moveaxis(along.thrust(share, side) @ paper.T, -1, 0)
            values |= {f"thrust_linear_{side}": linear, f"thrust_quadratic_{side}": quadratic}
            values[f"thrust_speed_{side}"] = boat.sums[f"thrust_speed_{side}"]
            values[f"thrust_full_{side}"] = boat.thrust(1.0, side)
        values["drag_half_speed"] = boat.drag(fastest / 2)
        values = {name: mass * value for name, value in values.items()}
        values |= {f"steady_speed_{name}": boat.steady_speed(command) for name, command in COMMANDS.items()}
        step = NEAR * fastest
        slope = (boat.drag(fastest / 2 + step) - boat.drag(fastest / 2 - step)) / (2 * step) - boat.lift / 2
        values["time_constant"] = np.where(slope > 0, 1 / slope, np.nan)
        coasts = (COAST + (1 - COAST) * share) * fastest[..., None]
        values["stopping_distance"] = np.trapezoid(coasts / along.drag(coasts), coasts)
        values["thrust_ratio"] = values["thrust_full_left"] / values["thrust_full_right"]
    return values


def hats(x: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """The weights of equally spaced nodes at x ≥ 0, `(..., nodes)`: 0 at x = 0; beyond the last the line goes on."""
    x = np.asarray(x, float)[..., None] / nodes[0]
    places = np.arange(1, len(nodes) + 1)
    beyond = np.maximum(x - len(nodes), 0.0)
    weights = np.clip(1 - np.abs(np.minimum(x, len(nodes)) - places), 0.0, 1.0)
    return weights + beyond * (places == len(nodes)) - beyond * (places == len(nodes) - 1)


def hat_slopes(x: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """The derivatives of `hats` by x, towards larger x, `(..., nodes)`."""
    above = np.minimum(np.floor(np.asarray(x, float)[..., None] / nodes[0]), len(nodes) - 1) + 1
    places = np.arange(1, len(nodes) + 1)
    return ((places == above) - 1.0 * (places == above - 1)) / nodes[0]
