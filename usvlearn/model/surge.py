"""The surge dynamics of one identified boat: a step, a simulation, and all coefficients in units of force.

Equations (1) and (2): `docs/theory/model.md#surge-model`, with z = min(h J, 1). It is the step of the joint EKF without
disturbance, current and lag of the commands. A batch fit (`usvlearn.model.fit`) adds tables of thrust and drag to (1),
linear between their points.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.jit import jit
from usvlearn.core.prepared_samples import DT, LEFT, RIGHT, ROW, SURGE, YAW_RATE
from usvlearn.errors import ConfigError
from usvlearn.estimators.joint.kernel import flow
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.estimators.joint.quantities import SIDES, Ahead, kilograms_of
from usvlearn.estimators.joint.state import THETA, names
from usvlearn.estimators.regressors.terms import LAG
from usvlearn.model.fit import terms
from usvlearn.model.fit.motion_kernel import moved, pushed
from usvlearn.model.fit.quantities import CurvedAhead

WITHOUT_EVEN, WITH_EVEN = (tuple(name for name in names(even) if name != LAG) for even in (False, True))


class Tables(NamedTuple):
    """What a batch fit adds to (1), linear between its points; beyond the last one the line goes on."""

    theta: np.ndarray  # (parameters,) all parameters by `terms.NAMES`, per unit mass
    top: float  # m/s
    mass: float  # kg

    @property
    def thrust(self) -> dict[str, np.ndarray]:
        """N, of "left" and "right", at `TABLE_COMMANDS`, 0 at ξ = 0."""
        nodes = self.mass * self.theta[terms.PLACE_THRUST : terms.PLACE_DRAG].reshape(2, 2, -1)  # side, sign, node
        return {side: np.concatenate([0.0 - back[::-1], [0.0], ahead])
                for side, (ahead, back) in zip(SIDES, nodes, strict=True)}  # fmt: skip

    @property
    def drag(self) -> np.ndarray:
        """N, the force, at `speeds`; 0 at v = 0, and odd in v."""
        return self.mass * self.theta[terms.PLACE_DRAG : terms.PLACE_LAG]

    @property
    def speeds(self) -> np.ndarray:
        """Of `drag`, m/s."""
        return self.top * terms.DRAG_NODES


TABLE_COMMANDS = np.concatenate([-terms.THRUST_NODES[::-1], [0.0], terms.THRUST_NODES])


@dataclass(frozen=True)
class SurgeModel:
    """The surge dynamics of one boat.

    Attributes:
        mass: m of (1), kg, added mass included.
        coefficients: of (1), by the names of `usvlearn.estimators.regressors.terms`: kg/m, kg/s, kg/rad, N, N s/m.
            Drag is negative and thrust ahead is positive. Without the fore-aft asymmetry terms, e is 0.
        tables: of a batch fit; else None.
        thruster: time constant of the thrust after a command, s; 0 where it is not known. `step` has no state: its
            thrust acts at once, without (1) of `usvlearn.model.fit.motion_kernel`.

    Raises:
        ConfigError: the mass is not positive, a coefficient is missing or unknown, or a number is not finite.

    >>> model = SurgeModel(28.0, {**dict.fromkeys(WITHOUT_EVEN, 0.0), "drag_linear": -14.0, "thrust_linear_left": 28.0})
    >>> round(float(model.step(0.0, left=1.0, right=0.0, yaw_rate=0.0, dt=0.1)), 4)  # (1 − e^(−0.05)) 2 m/s
    0.0975
    """

    mass: float
    coefficients: Mapping[str, float]
    tables: Tables | None = None
    thruster: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.mass) and self.mass > 0):
            raise ConfigError(f"mass: found {self.mass!r}, expected a positive number of kg")
        if tuple(self.coefficients) not in (WITHOUT_EVEN, WITH_EVEN):
            raise ConfigError(
                f"coefficients: found {', '.join(self.coefficients)}, expected {', '.join(WITHOUT_EVEN)}, in this "
                f"order, and perhaps {', '.join(WITH_EVEN[len(WITHOUT_EVEN) :])}"
            )
        for name, value in self.coefficients.items():
            if not np.isfinite(value):
                raise ConfigError(f"coefficients.{name}: found {value!r}, expected a finite number")

    @classmethod
    def of(cls, identified: Identified, theta: np.ndarray | None = None) -> SurgeModel:
        """The boat of what was identified.

        Args:
            identified: of a boat.
            theta: other parameters of it per unit mass, `(m,)`, such as a draw from their distribution.

        Returns:
            The model, with the coefficients of the mean and without a lag.

        Raises:
            ConfigError: nothing is identified.

        >>> from usvlearn import JointEKF, Online
        >>> identified = Online(JointEKF(surge_max=2.7, mass=28.0, estimate_every=600.0)).identified()
        >>> round(float(SurgeModel.of(identified).ahead.steady_speed(1.0)), 2)
        2.7
        """
        theta = identified.theta if theta is None else theta
        mass = float(kilograms_of(theta, identified.mass, identified.inverse_mass))
        keys = names(len(theta) == len(names(even=True)))
        return cls(mass, {name: mass * float(each) for name, each in zip(keys, theta, strict=True) if name != LAG})

    @classmethod
    def fitted(cls, theta: np.ndarray, top: float, mass: float) -> SurgeModel:
        """The boat of a batch fit.

        Args:
            theta: by `terms.NAMES`, per unit mass, `(parameters,)`.
            top: top speed of the nodes of drag, m/s.
            mass: kg.

        Returns:
            The model, with its tables and the time constant of its thrusters.

        >>> theta = np.zeros(len(terms.NAMES))
        >>> theta[terms.AT["drag_linear"]] = -0.5
        >>> SurgeModel.fitted(theta, top=2.7, mass=28.0).coefficients["drag_linear"]
        -14.0
        """
        even = any(theta[terms.AT[name]] for name in terms.EVEN)
        coefficients = {name: mass * float(theta[terms.AT[name]]) for name in (WITH_EVEN if even else WITHOUT_EVEN)}
        return cls(mass, coefficients, Tables(theta, top, mass), float(theta[terms.PLACE_TIME]))

    @property
    def even(self) -> bool:
        """Whether it has the fore-aft asymmetry terms."""
        return len(self.coefficients) == len(WITH_EVEN)

    @property
    def per_mass(self) -> np.ndarray:
        """The coefficients per unit mass, and a lag of 0, as a joint EKF has them, `(m,)`."""
        return np.array([*self.coefficients.values(), 0.0]) / self.mass

    @property
    def ahead(self) -> Ahead:
        """Forces per mass and steady speeds of motion straight ahead."""
        return Ahead(self.per_mass) if self.tables is None else CurvedAhead(self.tables.theta, self.tables.top)

    def step(self, surge: Any, left: Any, right: Any, yaw_rate: Any, dt: Any) -> np.ndarray:
        """v⁺ of (2); all arguments broadcast.

        Args:
            surge: v, m/s.
            left: ξ_L, −1 … 1.
            right: ξ_R, −1 … 1.
            yaw_rate: r, rad/s.
            dt: h, s.

        Returns:
            v⁺, m/s.
        """
        return self._stepped(False, surge, left, right, yaw_rate, dt)

    def simulate(self, surge: float, left: Any, right: Any, yaw_rate: Any, dt: Any) -> np.ndarray:
        """The speeds after each of some steps.

        Args:
            surge: the speed at the beginning, m/s.
            left: ξ_L, −1 … 1, a number or `(time,)`, as are the next three.
            right: ξ_R, −1 … 1.
            yaw_rate: r, rad/s.
            dt: h, s.

        Returns:
            The speeds, m/s, `(time,)`.

        >>> forces = dict.fromkeys(WITHOUT_EVEN, 0.0) | {"drag_linear": -14.0, "thrust_linear_left": 28.0}
        >>> model = SurgeModel(28.0, forces)
        >>> model.simulate(0.0, left=np.ones(3), right=0.0, yaw_rate=0.0, dt=0.1).round(3).tolist()
        [0.098, 0.19, 0.279]
        """
        return self._stepped(True, surge, left, right, yaw_rate, dt)

    def _stepped(self, chained: bool, *given: Any) -> np.ndarray:
        arrays = np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in given))
        rows = np.zeros((arrays[0].size, ROW))
        for place, array in zip((SURGE, LEFT, RIGHT, YAW_RATE, DT), arrays, strict=True):
            rows[:, place] = array.reshape(-1)
        out = np.empty(len(rows))
        if self.tables is not None:
            _fitted_steps(self.tables.theta, self.tables.top, rows, chained, np.empty((2, len(terms.NAMES))), out)
        else:
            mean = np.concatenate([np.zeros(THETA), self.per_mass])  # x of a joint EKF
            _steps(self.even, mean, rows, chained, np.empty_like(mean), out)
        return out.reshape(arrays[0].shape)


@jit(entry=True)
def _steps(even, mean, rows, chained, g, out):
    """Write v⁺ of each row, from its own speed or, if chained, from the v⁺ before it. `g` is used as memory."""
    speed = 0.0
    for k in range(len(out)):
        if k == 0 or not chained:
            speed = rows[k, SURGE]
        x = rows[k]
        speed = flow(even, mean, speed, 0.0, x[LEFT], x[RIGHT], x, g)
        out[k] = speed


@jit(entry=True)
def _fitted_steps(theta, top, rows, chained, work, out):
    """Likewise with tables. `work`, `(2, parameters)`, is used as memory."""
    speed, none, W, V = 0.0, (0.0, 0.0, 0.0), work[0], work[1]
    for k in range(len(out)):
        if k == 0 or not chained:
            speed = rows[k, SURGE]
        x = rows[k]
        push, _ = pushed(theta, (x[LEFT], x[RIGHT]), (0.0, 0.0), W)
        speed, _ = moved(theta, top, speed, push, none, none, x[DT], abs(x[YAW_RATE]), W, V, V[:0])
        out[k] = speed
