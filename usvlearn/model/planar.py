"""The motion of one identified boat in the plane: surge, sway, yaw rate, heading and position.

u is the speed ahead and v the speed to starboard, both through the water; r is the yaw rate, clockwise; ψ the heading,
clockwise from north; ξ the command of a side as a share of full scale, and c the current. r⁺ and v⁺ are (2) and (3) of
`docs/theory/identification.md#yaw-rate-and-sway` without disturbance and lag of the commands. A step of length h makes
r⁺ from (u, v), ψ⁺ = ψ + h (r + r⁺)/2, v⁺ from (u, r), u⁺ at the yaw rate (r + r⁺)/2, and with R(ψ), which turns ahead
and starboard to north and east,

    p⁺ = p + h c + h/2 [R(ψ)(u, v) + R(ψ⁺)(u⁺, v⁺)]
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import DT, LEFT, RIGHT, ROW, SURGE, YAW_RATE
from usvlearn.core.prepared_samples import SIN as OTHER_INPUT
from usvlearn.errors import ConfigError
from usvlearn.estimators.axis.kernel import flow
from usvlearn.estimators.axis.state import KINDS, THETA, names
from usvlearn.estimators.regressors.terms import LAG
from usvlearn.model.surge import SurgeModel

COEFFICIENTS = {kind: tuple(name for name in names(kind) if name != LAG) for kind in KINDS}
_TURN = ("rad/s^2", "rad/s^2", "rad/(m s)", "rad/s^2", "rad/s^2", "rad/s^2")  # of a side
_UNITS = {
    "yaw": ("rad/s^2", "1/s", "1/rad", "1/m", "rad/m^2", "rad/(m s)", "rad/(m s)", *_TURN, *_TURN),
    "sway": ("m/s^2", "1/s", "1/m", "1/m", "1/rad", "m/(s rad)", "1/s", "m/s^2", "m/s^2", "m/s^2", "m/s^2"),
}
UNITS = {kind: dict(zip(COEFFICIENTS[kind], _UNITS[kind], strict=True)) for kind in KINDS}


class Motion(NamedTuple):
    """Where a boat is and how it moves; numbers, or arrays of one shape."""

    surge: Any  # m/s, u, ahead through the water
    sway: Any  # m/s, v, to starboard through the water
    yaw_rate: Any  # rad/s, r, clockwise
    heading: Any  # rad, ψ, clockwise from north; not wrapped
    north: Any  # m
    east: Any  # m


@dataclass(frozen=True)
class PlanarModel:
    """The motion of one boat in the plane.

    Attributes:
        surge: the dynamics of the surge.
        yaw: coefficients θ of the yaw rate, by the names `COEFFICIENTS["yaw"]`, in SI units, those of `UNITS["yaw"]`.
        sway: likewise for the sway, in SI units; None where it was not learned: v is then 0.

    Raises:
        ConfigError: a coefficient is missing or unknown, or a number is not finite.

    >>> from usvlearn.model.surge import WITHOUT_EVEN
    >>> surge = SurgeModel(28.0, {**dict.fromkeys(WITHOUT_EVEN, 0.0), "drag_linear": -14.0, "thrust_linear_left": 28.0})
    >>> yaw = {**dict.fromkeys(COEFFICIENTS["yaw"], 0.0), "linear": -1.0, "linear_left": 0.5, "linear_right": -0.5}
    >>> turned = PlanarModel(surge, yaw).step(Motion(1.0, 0.0, 0.0, 0.0, 0.0, 0.0), left=0.5, right=-0.5, dt=0.1)
    >>> round(float(turned.yaw_rate), 4), round(float(turned.north), 4)  # (1 − e^(−0.1)) 0.5 rad/s
    (0.0476, 0.1)
    """

    surge: SurgeModel
    yaw: Mapping[str, float]
    sway: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        for kind, given in (("yaw", self.yaw), ("sway", self.sway)):
            if given is None:
                continue
            if tuple(given) != COEFFICIENTS[kind]:
                raise ConfigError(
                    f"{kind}: found the coefficients {', '.join(given)}, expected {', '.join(COEFFICIENTS[kind])}, "
                    "in this order"
                )
            for name, value in given.items():
                if not np.isfinite(value):
                    raise ConfigError(f"{kind}.{name}: found {value!r}, expected a finite number")

    @classmethod
    def of(cls, surge: SurgeModel, yaw: np.ndarray, sway: np.ndarray | None = None) -> PlanarModel:
        """The boat whose yaw rate and sway have these means of an axis EKF.

        Args:
            surge: of the boat.
            yaw: x of a `YawEKF`, `(22,)`, SI units.
            sway: x of a `SwayEKF`, `(14,)`, SI units; None: not learned.

        Returns:
            The model.

        Raises:
            ConfigError: a mean has another shape, or is not finite.

        >>> from usvlearn import YawEKF
        >>> from usvlearn.model.surge import WITHOUT_EVEN
        >>> surge = SurgeModel(28.0, dict.fromkeys(WITHOUT_EVEN, 0.0) | {"drag_linear": -14.0})
        >>> model = PlanarModel.of(surge, YawEKF(surge_max=2.7).init().mean.numpy())
        >>> model.yaw["linear"], model.sway
        (-0.5, None)
        """
        return cls(surge, _coefficients("yaw", yaw), None if sway is None else _coefficients("sway", sway))

    def step(self, motion: Motion, left: Any, right: Any, dt: Any, current: tuple[Any, Any] = (0.0, 0.0)) -> Motion:
        """The motion after a step; all arguments broadcast.

        Args:
            motion: before the step.
            left: ξ_L, −1 … 1.
            right: ξ_R, −1 … 1.
            dt: h, s.
            current: c, north and east, m/s.

        Returns:
            The motion after the step.
        """
        u, v, r, psi, north, east = (np.asarray(each, np.float64) for each in motion)
        v = v if self.sway is not None else 0.0 * v
        turned = self._axis("yaw", r, left, right, v, u, dt)
        aside = self._axis("sway", v, left, right, r, u, dt) if self.sway is not None else 0.0 * turned
        along = self.surge.step(u, left, right, (r + turned) / 2, dt)
        after = psi + dt * (r + turned) / 2
        first, last = (np.cos(psi), np.sin(psi)), (np.cos(after), np.sin(after))
        north = north + dt * current[0] + dt / 2 * (first[0] * u - first[1] * v + last[0] * along - last[1] * aside)
        east = east + dt * current[1] + dt / 2 * (first[1] * u + first[0] * v + last[1] * along + last[0] * aside)
        return Motion(*np.broadcast_arrays(along, aside, turned, after, north, east))

    def simulate(self, motion: Motion, left: Any, right: Any, dt: Any, current: tuple[Any, Any] = (0.0, 0.0)) -> Motion:
        """The motion after each of some steps.

        Args:
            motion: at the beginning.
            left: share of full scale, a number or `(time, …)`, as are the next three.
            right: likewise.
            dt: s.
            current: m/s, north and east.

        Returns:
            Leaves `(time, …)`.

        >>> from usvlearn.model.surge import WITHOUT_EVEN
        >>> surge = SurgeModel(28.0, dict.fromkeys(WITHOUT_EVEN, 0.0) | {"drag_linear": -14.0})
        >>> model = PlanarModel(surge, {**dict.fromkeys(COEFFICIENTS["yaw"], 0.0), "linear": -1.0})
        >>> motion = model.simulate(Motion(1.0, 0.0, 0.0, 0.0, 0.0, 0.0), left=np.zeros(3), right=0.0, dt=0.1)
        >>> motion.north.round(2).tolist()
        [0.1, 0.19, 0.28]
        """
        given = np.broadcast_arrays(*(np.atleast_1d(np.asarray(x, np.float64)) for x in (left, right, dt, *current)))
        motions = []
        for xi_left, xi_right, h, north, east in zip(*given, strict=True):
            motion = self.step(motion, xi_left, xi_right, h, (north, east))
            motions.append(motion)
        return Motion(*(np.array(each) for each in zip(*motions, strict=True)))

    def _axis(self, kind: str, *given: Any) -> np.ndarray:
        """r⁺ or v⁺, from itself, ξ_L, ξ_R, the other one, u and h."""
        mean = np.array([*[0.0] * THETA, *getattr(self, kind).values(), 0.0])  # x of an axis EKF
        arrays = np.broadcast_arrays(*(np.asarray(x, np.float64) for x in given))
        rows = np.zeros((arrays[0].size, ROW))
        for place, array in zip((SURGE, LEFT, RIGHT, OTHER_INPUT, YAW_RATE, DT), arrays, strict=True):
            rows[:, place] = array.reshape(-1)
        out = np.empty(len(rows))
        _axis_steps(kind == "yaw", mean, rows, np.empty_like(mean), out)
        return out.reshape(arrays[0].shape)


def _coefficients(kind: str, mean: np.ndarray) -> dict[str, float]:
    shape, size = np.shape(mean), THETA + len(names(kind))
    if shape != (size,):
        raise ConfigError(f"{kind}: found a mean of the shape {shape}, expected ({size},)")
    return dict(zip(COEFFICIENTS[kind], map(float, mean[THETA:-1]), strict=True))


@jit(entry=True)
def _axis_steps(yaw, mean, rows, g, out):
    """Write r⁺ or v⁺ of each row, whose `SURGE` holds what it was. `g` is used as memory."""
    for k in range(len(out)):
        x = rows[k]
        out[k] = flow(yaw, mean, x[SURGE], 0.0, x[LEFT], x[RIGHT], x, g)
