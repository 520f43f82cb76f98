"""The command that holds a speed, and PI gains by pole placement on the linearised boat, with their worst margins.

*Feedforward.* The steady-speed curve v(ξ), both sides equal, straight ahead, is inverted on its rising part, from the
dead band of the thrusters to its greatest speed. A cubic thrust curve may bend down before full command. Where it loses
no more than `FALL` of the greatest speed there, full command is taken as saturated, and otherwise the curve is refused.

*Gains.* Equations (1) to (4): `docs/theory/identification.md#controller`. In the code a is J_v, b is J_ξ, T is τ, and L
the delay τ_d. (3) takes the geometric means of a and b over all corners: the ends of their 90 % intervals, at each
operating speed. The loop (k_p + k_i/s) b e^(−sL)/(s − a) is then judged at every corner.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from usvlearn.errors import ConfigError
from usvlearn.estimators.joint.curves import Curve, banded
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.estimators.joint.quantities import SIDES, Ahead
from usvlearn.logs.setup import Setup

FASTEST, DELAYED, SLOWEST_INTEGRAL = 4.0, 0.5, 4.0  # of (4)
PHASE, GAIN = 45.0, 6.0  # deg, dB: least margins of the default bandwidth
SLOWER = 0.95  # from one trial of the bandwidth to the next
LONGEST_DELAY = 10.0  # s
GRID = np.geomspace(1e-3, 1e2, 2000)  # rad/s


class Linearised(NamedTuple):
    """(1) at some commands, with 90 % intervals."""

    time_constant: Curve  # T, s, over the command
    gain: Curve  # b, m/s², over the command

    @property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """a, 1/s, and b, m/s², at each end of both intervals, `(4 points,)` each."""
        T, b = self.time_constant, self.gain
        a = -1 / np.concatenate([T.low, T.low, T.high, T.high])
        return a, np.concatenate([b.low, b.high, b.low, b.high])


class Gains(NamedTuple):
    """(2), and what it was designed for."""

    proportional: float  # k_p, share of full command per m/s
    integral: float  # k_i, share of full command per m/s and s
    bandwidth: float  # ω, rad/s
    damping: float  # ζ


class Margins(NamedTuple):
    """The worst over all corners."""

    gain: float  # dB
    phase: float  # deg
    delay: float  # s, by which the loop may be later before it is unstable
    bandwidth: tuple[float, float]  # rad/s, least and greatest: where the closed loop has −3 dB
    crossover: tuple[float, float]  # rad/s, least and greatest: where the open loop has 0 dB


def late_of(name: str, known: Identified, setup: Setup | None, given: float | None) -> tuple[float, float, float]:
    """How late the commands act, s: `delay` of the logged commands, that and the identified lag, and its deviation."""
    if given is not None:
        if not 0 <= given <= LONGEST_DELAY:
            raise ConfigError(f"--delay: found {given!r}, expected 0 to {LONGEST_DELAY:g} s")
        return given, given, 0.0
    if setup is None:
        raise ConfigError(f"{name}: the checkpoint does not tell the step of its samples: give --delay")
    before = max(setup.aligned[f"command_{side}"].delay for side in SIDES)
    late, deviation = known.lag(float(setup.align["dt"]))
    return before, before + late, deviation


def curve_of(known: Identified, name: str, at: np.ndarray, of: Callable[[Ahead], Any]) -> Curve:
    """A quantity of the boat at some points, with its 90 % band."""
    assert known.beside is not None
    return banded(known, known.beside, name, at, lambda theta: of(known.ahead(theta[..., None, :])))


def force(known: Identified, speeds: np.ndarray, command: float) -> Curve:
    """Acceleration at full command, or deceleration with both thrusters off, m/s²."""

    def pull(boat: Ahead) -> np.ndarray:
        if command == 0:
            return boat.drag(speeds)
        return sum(boat.thrust(command, side) for side in SIDES) + boat.lift * command * speeds - boat.drag(speeds)

    return curve_of(known, "acceleration", speeds, pull)


def linearised(name: str, known: Identified, commands: np.ndarray) -> Linearised:
    """(1) at some commands, `(points,)`; a ConfigError where an interval of T or b holds 0."""

    def gain(boat: Ahead) -> np.ndarray:
        return sum(boat.thrust_slope(commands, side) for side in SIDES) + boat.lift * boat.steady_speed(commands)

    T = curve_of(known, "time_constant", commands, lambda boat: boat.settling(boat.steady_speed(commands), commands))
    b = curve_of(known, "gain", commands, gain)
    for curve, what, unit in ((T, "time constant", "s"), (b, "gain of the thrust", "m/s²")):
        wrong = np.flatnonzero(~(curve.low > 0))
        if len(wrong):
            k = int(wrong[0])
            raise ConfigError(
                f"{name}: the 90 % interval of the {what} at {100 * commands[k]:.0f} % command, {curve.low[k]:.2g} … "
                f"{curve.high[k]:.2g} {unit}, holds 0, so that no gains are safe: {SAIL}, or narrow --range to speeds "
                "that were sailed"
            )
    return Linearised(T, b)


def placed(a: float, b: float, bandwidth: float, damping: float) -> Gains:
    """(3); without a proportional part, and with the damping that is left, where the wanted poles are slower."""
    if 2 * damping * bandwidth + a < 0:
        return Gains(0.0, bandwidth**2 / b, bandwidth, -a / (2 * bandwidth))
    return Gains((2 * damping * bandwidth + a) / b, bandwidth**2 / b, bandwidth, damping)


def poles(crossover: float, time_constant: float) -> tuple[float, float]:
    """ω and ζ of (4), from ω_c in rad/s and T in s."""
    bandwidth = math.sqrt(crossover / min(time_constant, SLOWEST_INTEGRAL / crossover))
    return bandwidth, (crossover + 1 / time_constant) / (2 * bandwidth)


def margins(gains: Gains, a: np.ndarray, b: np.ndarray, delay: float) -> Margins:
    """The worst margins over the corners a < 0, 1/s, and b > 0, m/s², `(corners,)`, at a delay in s."""
    s = 1j * GRID[:, None]
    return worst((gains.proportional + gains.integral / s) * b / (s - a) * np.exp(-s * delay))


def worst(loop: np.ndarray) -> Margins:
    """The worst margins of open loops at `GRID`, `(points, corners)`, that fall and begin between 0 and −180°."""
    level, w = np.log(np.abs(loop)), np.broadcast_to(np.log(GRID)[:, None], loop.shape)
    over = np.unwrap(np.angle(loop), axis=0) + np.pi

    def where_falls(y: np.ndarray, of: np.ndarray, never: np.ndarray | float) -> np.ndarray:
        """Another array where y first falls through 0; `never` where it does not."""
        falls = (y[:-1] > 0) & (y[1:] <= 0)
        at = falls.argmax(0)[None]
        (first, second), (begin, end) = ([np.take_along_axis(x, at + k, 0)[0] for k in (0, 1)] for x in (y, of))
        return np.where(falls.any(0), begin + first / (first - second) * (end - begin), never)

    crossover, left = np.exp(where_falls(level, w, w[-1])), where_falls(level, over, over[-1])
    bandwidth = GRID[(np.abs(loop / (1 + loop)) < np.sqrt(0.5)).argmax(0)]
    return Margins(
        20 / math.log(10) * float(where_falls(over, -level, np.inf).min()),
        float(np.degrees(left).min()),
        float((left / crossover).min()),
        (float(bandwidth.min()), float(bandwidth.max())),
        (float(crossover.min()), float(crossover.max())),
    )


def design(
    name: str, linear: Any, delay: float, bandwidth: float | None = None, damping: float | None = None
) -> tuple[Gains, Margins]:
    """Gains, and their worst margins over the corners of a `Linearised`, or a `Yaw`, at a delay L, s.

    Without a bandwidth ω, rad/s, the crossover of (4) is lowered until all corners have `PHASE` and `GAIN`. With one,
    the damping ζ is 1 by default; a ConfigError where a corner is unstable then.
    """
    a, b = linear.corners
    middle_a, middle_b = -float(np.exp(np.log(-a).mean())), float(np.exp(np.log(b).mean()))
    if bandwidth is not None:
        gains = placed(middle_a, middle_b, bandwidth, 1.0 if damping is None else damping)
        left = margins(gains, a, b, delay)
        if not (left.gain > 0 and left.phase > 0):
            safe, _ = design(name, linear, delay, None, damping)
            raise ConfigError(
                f"--bandwidth: found {bandwidth:g} rad/s, with which {name} is unstable at a corner of the intervals "
                f"with {delay:.2g} s of delay: give at most {safe.bandwidth:.2g} rad/s, or leave it out"
            )
        return gains, left
    crossover = min(FASTEST * -middle_a, DELAYED / max(delay, 1e-6))
    while True:
        own_bandwidth, own_damping = poles(crossover, -1 / middle_a)
        gains = placed(middle_a, middle_b, own_bandwidth, own_damping if damping is None else damping)
        left = margins(gains, a, b, delay)
        if left.gain >= GAIN and left.phase >= PHASE:
            return gains, left
        crossover *= SLOWER


POINTS = 201
DEAD = 0.02  # share of the greatest speed, below which a command is in the dead band
FALL = 0.05  # share of the greatest speed that the curve may lose before full command
SAIL = (
    "sail straight ahead for 10 min with both commands equal, in steps between 20 and 100 % that are held for 10 s, "
    "and learn from that log, too"
)


class Feedforward(NamedTuple):
    """Steady speeds over commands, on the rising part of the curve; all arrays `(points,)`, rising."""

    command: np.ndarray  # share of full scale, both sides
    speed: np.ndarray  # m/s
    low: np.ndarray  # m/s, the 90 % band
    high: np.ndarray

    @classmethod
    def of(cls, name: str, known: Identified) -> Feedforward:
        """The curve of what was identified; a ConfigError if the log did not excite the boat, or it does not rise."""
        beside = known.beside
        if beside is None or beside.vague:
            because = known.lacks[0] if known.lacks else "Nothing is identified."
            raise ConfigError(
                f"{name}: the steady speeds are not identified, so there is no feedforward ({because}): {SAIL}"
            )
        commands = np.linspace(0.0, 1.0, POINTS)
        curve = curve_of(known, "steady_speed", commands, lambda boat: boat.steady_speed(commands))
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
        part = slice(first, last + 1)
        if not (np.isfinite(curve.low[part]).all() and np.isfinite(curve.high[part]).all()):
            raise ConfigError(f"{name}: the steady speeds have no interval: {SAIL}")
        return cls(curve.at[part], speeds[part], *(np.maximum.accumulate(x[part]) for x in (curve.low, curve.high)))

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
