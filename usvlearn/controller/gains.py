"""PI gains by pole placement on the linearised boat, and the margins that they leave in the worst case.

At a command ξ₀ the boat settles at v₀. Near it, with T = −1/a, and a delay L from the measured speed to the thrust,

    d(v − v₀)/dt = a (v − v₀) + b (ξ(t − L) − ξ₀),   a = 2 q v₀ + l + Γ ξ₀,   b = Σ T'(ξ₀) + Γ v₀           (1)
    ξ = base + k_p e + k_i ∫ e dt,   e = wanted − v                                                      (2)
    s² + (b k_p − a) s + b k_i = s² + 2 ζ ω s + ω²   gives   k_p = (2 ζ ω + a)/b,   k_i = ω²/b              (3)

(3) takes the geometric means of a and b over all corners: the ends of their 90 % intervals, at each operating speed.
The loop (k_p + k_i/s) b e^(−sL)/(s − a) is then judged at every corner.

The derivation is in `docs/theory.md`, section 26.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from usvlearn.controller.feedforward import SAIL
from usvlearn.errors import ConfigError
from usvlearn.estimators.joint.curves import Curve, banded
from usvlearn.estimators.joint.quantities import SIDES, Ahead
from usvlearn.estimators.joint.reading import Identified

DAMPING = 1.0  # ζ
FASTEST, DELAYED = 4.0, 0.5  # crossover 2 ζ ω: at most 4/T, and .5/L
PHASE, GAIN = 45.0, 6.0  # deg, dB: least margins of the default bandwidth
SLOWER = 0.95  # from one trial of the bandwidth to the next
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


def linearised(name: str, found: Identified, commands: np.ndarray) -> Linearised:
    """(1) at some commands, `(points,)`.

    Args:
        name: of the boat, for errors.
        found: of it.
        commands: ξ₀, ascending.

    Raises:
        ConfigError: an interval of a holds 0, or one of b.
    """
    beside = found.beside
    assert beside is not None

    def time_constant(theta: np.ndarray) -> np.ndarray:
        boat = Ahead(theta[..., None, :])
        return -1 / (2 * boat.quadratic * boat.steady_speed(commands) + boat.linear + boat.lift * commands)

    def gain(theta: np.ndarray) -> np.ndarray:
        boat = Ahead(theta[..., None, :])
        return sum(boat.thrust_slope(commands, side) for side in SIDES) + boat.lift * boat.steady_speed(commands)

    T, b = (banded(found, beside, each, commands, f) for each, f in (("time_constant", time_constant), ("gain", gain)))
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
    """(3); without a proportional part where the wanted poles are slower than the boat.

    >>> placed(a=-0.5, b=2.0, bandwidth=1.0, damping=1.0)
    Gains(proportional=0.75, integral=0.5, bandwidth=1.0, damping=1.0)
    """
    return Gains(max(0.0, (2 * damping * bandwidth + a) / b), bandwidth**2 / b, bandwidth, damping)


def margins(gains: Gains, a: np.ndarray, b: np.ndarray, delay: float) -> Margins:
    """The worst margins over the corners a < 0, 1/s, and b > 0, m/s², `(corners,)`, at a delay in s.

    The open loop falls with frequency, so that it crosses 0 dB once, at
    ω⁴ + (a² − b² k_p²) ω² − b² k_i² = 0.
    """
    k_p, k_i = gains.proportional, gains.integral
    half = (a * a - (b * k_p) ** 2) / 2
    crossover = np.sqrt(-half + np.sqrt(half * half + (b * k_i) ** 2))

    def phase(w):
        return -np.arctan2(k_i, k_p * w) - np.arctan2(w, -a) - w * delay

    def loop(w):
        return (k_p + k_i / (1j * w)) * b / (1j * w - a) * np.exp(-1j * w * delay)

    left = np.pi + phase(crossover)
    w = GRID[:, None]
    over = phase(w) + np.pi
    crossed = (over[:-1] > 0) & (over[1:] <= 0)
    at = crossed.argmax(0)
    share = np.take_along_axis(over, at[None], 0)[0]
    share = share / (share - np.take_along_axis(over, at[None] + 1, 0)[0])
    turning = GRID[at] + share * (GRID[at + 1] - GRID[at])
    gain = np.where(crossed.any(0), -20 * np.log10(np.abs(loop(turning))), np.inf)
    closed = np.abs(loop(w) / (1 + loop(w)))
    dropped = (closed < np.sqrt(0.5)).argmax(0)
    bandwidth = GRID[dropped]
    return Margins(
        float(gain.min()),
        float(np.degrees(left).min()),
        float((left / crossover).min()),
        (float(bandwidth.min()), float(bandwidth.max())),
        (float(crossover.min()), float(crossover.max())),
    )


def design(
    name: str, linear: Linearised, delay: float, bandwidth: float | None = None, damping: float = DAMPING
) -> tuple[Gains, Margins]:
    """Gains, and their worst margins.

    The default bandwidth puts the crossover 2 ζ ω at min(`FASTEST`/T, `DELAYED`/L), and is lowered until all corners
    have `PHASE` and `GAIN`.

    Args:
        name: of the boat, for errors.
        linear: the boat.
        delay: L, s.
        bandwidth: ω, rad/s.
        damping: ζ.

    Raises:
        ConfigError: with the bandwidth that was given, a corner is unstable.
    """
    a, b = linear.corners
    middle_a, middle_b = -float(np.exp(np.log(-a).mean())), float(np.exp(np.log(b).mean()))
    if bandwidth is not None:
        gains = placed(middle_a, middle_b, bandwidth, damping)
        left = margins(gains, a, b, delay)
        if not (left.gain > 0 and left.phase > 0):
            safe, _ = design(name, linear, delay, None, damping)
            raise ConfigError(
                f"--bandwidth: found {bandwidth:g} rad/s, with which {name} is unstable at a corner of the intervals "
                f"with {delay:.2g} s of delay: give at most {safe.bandwidth:.2g} rad/s, or leave it out"
            )
        return gains, left
    bandwidth = min(FASTEST * -middle_a, DELAYED / max(delay, 1e-6)) / (2 * damping)
    while True:
        gains = placed(middle_a, middle_b, bandwidth, damping)
        left = margins(gains, a, b, delay)
        if left.gain >= GAIN and left.phase >= PHASE:
            return gains, left
        bandwidth *= SLOWER
