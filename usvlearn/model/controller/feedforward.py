"""The command that holds a speed: the inverse of the identified steady-speed curve, both sides equal, straight ahead.

The curve v(ξ) is inverted on its rising part, from the dead band of the thrusters to its greatest speed. A cubic thrust
curve may bend down before full command. Where it loses no more than `FALL` of the greatest speed there, full command is
taken as saturated, and otherwise the curve is refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from usvlearn.errors import ConfigError
from usvlearn.estimators.joint.curves import Curve, banded
from usvlearn.estimators.joint.periodic_estimates import Identified

POINTS = 201
DEAD = 0.02  # share of the greatest speed, below which a command is in the dead band
FALL = 0.05  # share of the greatest speed that the curve may lose before full command
SAIL = (
    "sail straight ahead for 10 min with both commands equal, in steps between 20 and 100 % that are held for 10 s, "
    "and learn from that log, too"
)


@dataclass(frozen=True)
class Feedforward:
    """Steady speeds over commands, on the rising part of the curve; all arrays `(points,)`, rising.

    Attributes:
        command: share of full scale, both sides.
        speed: m/s.
        low, high: m/s, the 90 % band.

    >>> rising = np.array([0.2, 0.6, 1.0])
    >>> curve = Feedforward(rising, 2 * rising, 1.8 * rising, 2.2 * rising)
    >>> round(float(curve.at(1.0)), 3), [round(float(each), 3) for each in curve.band(1.0)]
    (0.5, [0.455, 0.556])
    """

    command: np.ndarray
    speed: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, name: str, found: Identified) -> Feedforward:
        """The curve of what was identified.

        Args:
            name: of the boat, for errors.
            found: of it.

        Raises:
            ConfigError: the log did not excite the boat, or the curve does not rise.
        """
        beside = found.beside
        if beside is None or beside.vague:
            because = found.lacks[0] if found.lacks else "Nothing is identified."
            raise ConfigError(
                f"{name}: the steady speeds are not identified, so there is no feedforward ({because}): {SAIL}"
            )
        commands = np.linspace(0.0, 1.0, POINTS)
        return cls._rising(
            name,
            banded(
                found, beside, "steady_speed", commands,
                lambda theta: found.ahead(theta[..., None, :]).steady_speed(commands),
            ),
        )  # fmt: skip

    @classmethod
    def _rising(cls, name: str, curve: Curve) -> Feedforward:
        """The rising part of a curve over all commands."""
        speeds = curve.value
        if not (np.isfinite(speeds).all() and speeds[-1] > 0):
            raise ConfigError(
                f"{name}: found no steady speed ahead at every command, expected one, for which drag has to grow with "
                f"speed and thrust to point ahead: check the signs of the speed and the commands, and {SAIL}"
            )
        last = int(speeds.argmax())
        top = speeds[last]
        first = int(np.flatnonzero(speeds[: last + 1] <= DEAD * top)[-1]) if speeds[0] <= DEAD * top else 0
        falls = np.flatnonzero(np.diff(speeds[first : last + 1]) <= 0)
        at, lost = (first + int(falls[0]), True) if len(falls) else (last, top - speeds[-1] > FALL * top)
        if lost:
            raise ConfigError(
                f"{name}: the steady speed does not rise with the command but falls from {speeds[at]:.2f} m/s at "
                f"{100 * curve.at[at]:.0f} %, so that no command belongs to a speed: {SAIL}"
            )
        kept = slice(first, last + 1)
        if not (np.isfinite(curve.low[kept]).all() and np.isfinite(curve.high[kept]).all()):
            raise ConfigError(f"{name}: the steady speeds have no interval: {SAIL}")
        return cls(curve.at[kept], speeds[kept], *(np.maximum.accumulate(x[kept]) for x in (curve.low, curve.high)))

    def at(self, speed):
        """The command that holds a speed in m/s; the ends of the curve beyond it."""
        return np.interp(speed, self.speed, self.command)

    def band(self, speed) -> tuple[np.ndarray, np.ndarray]:
        """The commands that hold a speed in m/s on the fastest and on the slowest boat of the 90 % band."""
        return self._inverse(speed, self.high), np.where(speed > self.low[-1], 1.0, self._inverse(speed, self.low))

    def _inverse(self, speed, of: np.ndarray) -> np.ndarray:
        rises = np.append(True, np.diff(of) > 0)
        return np.interp(speed, of[rises], self.command[rises])

    @property
    def least(self) -> tuple[float, float]:
        """The lowest speed that can be held, m/s, and its command: where the slowest boat of the band moves."""
        moves = int(np.argmax(self.low > DEAD * self.speed[-1]))
        return float(self.speed[moves]), float(self.command[moves])

    @property
    def top(self) -> tuple[float, float, float]:
        """The greatest steady speed, m/s, with its band."""
        return float(self.speed[-1]), float(self.low[-1]), float(self.high[-1])

    def check(self, name: str, option: str, speed: float) -> None:
        """Raise a ConfigError if a speed cannot be held."""
        top, least = self.top, self.least
        if not speed <= top[0]:
            raise ConfigError(
                f"{option}: found {speed:g} m/s, and {name} reaches {top[0]:.2f} m/s ({top[1]:.2f} … {top[2]:.2f}) at "
                "full command: give a lower speed, or where the boat is faster, sail at full command for 2 min and "
                "learn anew"
            )
        if not speed >= least[0]:
            raise ConfigError(
                f"{option}: found {speed:g} m/s, and the lowest speed that {name} can hold is {least[0]:.2f} m/s, at "
                f"{100 * least[1]:.0f} % command (dead band below): give a higher speed"
            )
