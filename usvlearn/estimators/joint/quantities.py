"""Physical quantities of a boat that moves ahead, from the parameters of a joint EKF. Imports no torch.

Equations (1) to (5): `docs/theory/identification.md#quantities`. All parameters are per unit mass, in the order of
`state.names`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping

import numpy as np

from usvlearn.estimators.joint.state import names
from usvlearn.estimators.regressors.terms import SURGE, UNITS

SIDES = ("left", "right")
COMMANDS = {"full": 1.0, "half": 0.5, "quarter": 0.25}
CUBIC_FIT = {"linear": -0.4, "quadratic": 4 / 3}  # of (1)
COAST = 0.1  # share of the speed that is left at the end of (5)
FORCES = {name: UNITS[name] for name in SURGE} | {  # what a mass scales, with its unit
    **{f"thrust_full_{side}": "N" for side in SIDES}, "drag_half_speed": "N",
}  # fmt: skip
QUANTITIES = FORCES | {
    **{f"steady_speed_{name}": "m/s" for name in COMMANDS},
    "time_constant": "s", "stopping_distance": "m", "thrust_ratio": "left/right", "mass": "kg",
}  # fmt: skip
MEANING = (
    "thrust_full: of a side at standstill. drag_half_speed and time_constant: at half of steady_speed_full, the latter "
    "at half command. stopping_distance: with thrusters off, from steady_speed_full until a tenth of it is left."
)
KNOWN_SIGNS = {f"drag_{kind}": -1 for kind in ("quadratic", "linear", "cross")} | {
    f"thrust_full_{side}": 1 for side in SIDES
}  # which a force that a user knows must have
EVEN_BESIDE = {"drag_quadratic": "drag_even"} | {
    f"thrust_{kind}_{side}": f"thrust_even_{kind}_{side}" for side in SIDES for kind in ("linear", "quadratic", "speed")
}


@functools.cache
def sums(even: bool) -> dict[str, np.ndarray]:
    """Coefficients, `(m,)`, of sums of parameters: the nine of motion ahead, and each side's pull, (1)."""
    of = dict(zip(names(even), np.eye(len(names(even))), strict=True))
    rows = {name: of[name] + (of[EVEN_BESIDE[name]] if even and name in EVEN_BESIDE else 0.0) for name in SURGE}
    pulls = {
        f"thrust_full_{side}": rows[f"thrust_linear_{side}"]
        + rows[f"thrust_quadratic_{side}"]
        + of[f"thrust_cubic_{side}"]
        for side in SIDES
    }
    for side in SIDES:
        for kind, share in CUBIC_FIT.items():
            rows[f"thrust_{kind}_{side}"] = rows[f"thrust_{kind}_{side}"] + share * of[f"thrust_cubic_{side}"]
    return rows | pulls


class Ahead:
    """The boat of some parameters, per unit mass, `(..., m)`, that moves straight ahead: forces per mass, speeds."""

    def __init__(self, theta: np.ndarray):
        even = theta.shape[-1] == len(names(even=True))
        self.sums = {name: theta @ row for name, row in sums(even).items()}
        parameters = dict(zip(names(even), np.moveaxis(theta, -1, 0), strict=True))
        self.cubic = {side: parameters[f"thrust_cubic_{side}"] for side in SIDES}
        self.quadratic, self.linear = self.sums["drag_quadratic"], self.sums["drag_linear"]
        self.lift = self.sums["thrust_speed_left"] + self.sums["thrust_speed_right"]

    def thrust(self, command, side: str):
        """Force of a side at standstill, m/s²."""
        alpha, beta = (
            self.sums[f"thrust_{kind}_{side}"] - share * self.cubic[side] for kind, share in CUBIC_FIT.items()
        )
        return (alpha + (beta + self.cubic[side] * command) * command) * command

    def thrust_slope(self, command, side: str):
        """Derivative of `thrust` by the command, m/s²."""
        alpha, beta = (
            self.sums[f"thrust_{kind}_{side}"] - share * self.cubic[side] for kind, share in CUBIC_FIT.items()
        )
        return alpha + (2 * beta + 3 * self.cubic[side] * command) * command

    def drag(self, speed):
        """Force of the water, positive, m/s²."""
        return -(self.quadratic * speed + self.linear) * speed

    def motion(self, speed, command):
        """dv/dt, m/s², and its derivative by the speed, 1/s, under one command 0 … 1 of both sides."""
        brake, size = self.linear + self.lift * command, np.abs(speed)
        f = self.quadratic * speed * size + brake * speed + sum(self.thrust(command, side) for side in SIDES)
        return f, 2 * self.quadratic * size + brake

    def settling(self, speed, command):
        """The time constant near a speed ahead, s."""
        return -1 / (2 * self.quadratic * speed + self.linear + self.lift * command)

    @property
    def brakes(self):
        """Whether drag brakes at every speed, bool."""
        return (self.quadratic <= 0) & (self.linear <= 0)

    def steady_speed(self, command):
        """(2), m/s; where the thrust points astern, minus the speed of as much thrust ahead; infinite without drag, NaN
        where drag that falls with speed, q > 0, never balances the thrust.
        """
        push = sum(self.thrust(command, side) for side in SIDES)
        slope = -(self.linear + self.lift * command)
        with np.errstate(divide="ignore", invalid="ignore"):
            whole = slope + np.sqrt(slope * slope - 4 * self.quadratic * np.abs(push))
            return np.where(whole >= 0, 2 * push / whole, np.nan)


def kilograms_of(theta: np.ndarray, mass: float, inverse_mass: np.ndarray) -> np.ndarray:
    """The mass, kg, `(...)`: of known forces where there are any, NaN where they have the wrong sign, else `mass`."""
    if not inverse_mass.any():
        return np.full(theta.shape[:-1], mass)
    inverse = theta @ inverse_mass
    return np.where(inverse > 0, 1 / np.where(inverse > 0, inverse, 1.0), np.nan)


def quantities(theta: np.ndarray, mass: float, inverse_mass: np.ndarray) -> dict[str, np.ndarray]:
    """All quantities of `QUANTITIES`, `(...)`; NaN or infinite where the parameters determine none.

    θ is per unit mass, `(..., m)`. `inverse_mass` is g of 1/m = gᵀθ where a known force fixes the mass, `(m,)`, which
    then is among the quantities; zeros where `mass`, kg, is an assumption.
    """
    boat = Ahead(theta)
    with np.errstate(all="ignore"):
        kilograms = kilograms_of(theta, mass, inverse_mass)
        speeds = {f"steady_speed_{name}": boat.steady_speed(command) for name, command in COMMANDS.items()}
        top = np.abs(speeds["steady_speed_full"])
        slope = -(boat.quadratic * top + boat.linear + boat.lift / 2)
        quadratic = np.where(np.abs(boat.quadratic) > 1e-9, -boat.quadratic, 1e-9)  # (5) goes to its limit, ln(10)/-l
        fast, slow = (quadratic * part - boat.linear for part in (top, COAST * top))
        forces = boat.sums | {"drag_half_speed": boat.drag(top / 2)}
        values = {name: kilograms * forces[name] for name in FORCES} | speeds
        values["time_constant"] = np.where(slope > 0, 1 / slope, np.nan)
        values["stopping_distance"] = np.log(fast / slow) / quadratic
        values["thrust_ratio"] = forces["thrust_full_left"] / forces["thrust_full_right"]
    return values | ({"mass": kilograms} if inverse_mass.any() else {})


def steps_of(variance: np.ndarray) -> np.ndarray:
    """Steps of the central differences of gradients, `(m,)`."""
    return 1e-4 * np.sqrt(variance)


def gradients(
    of: Callable[[np.ndarray], Mapping[str, np.ndarray]], theta: np.ndarray, steps: np.ndarray
) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Quantities `of` θ, `(m,)`, by name, and their gradients by central differences of `steps`, `(m,)`."""
    shifts, m = np.diag(steps), len(theta)
    every = of(np.concatenate([theta[None], theta + shifts, theta - shifts]))
    with np.errstate(invalid="ignore"):
        return (
            {name: float(values[0]) for name, values in every.items()},
            {name: (values[1 : m + 1] - values[m + 1 :]) / (2 * steps) for name, values in every.items()},
        )
