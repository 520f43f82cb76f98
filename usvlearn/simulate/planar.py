"""A twin-hull boat with two fixed thrusters in surge, sway and yaw (Fossen 2011, chapters 6 and 7).

    m_u u_dot = m_v v r + d_u(u) + tau_L + tau_R
    m_v v_dot = -m_u u r + d_v(v)                                                                               (1)
    j r_dot = (m_u - m_v) u v + d_r(r) + b (tau_L - tau_R),       d_i(x) = -(l_i + q_i |x| + s_i |u|) x
    lag xi_dot = command - xi,   tau = k(xi) xi,   k ahead or astern                                            (2)

u and v are the speeds through the water ahead and to starboard, r the yaw rate, clockwise; m_u, m_v and j include the
added mass, b is half the distance of the thrusters, and s is the lift of the slender hulls. The model without sway is
`usvlearn.simulate.vessel`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from usvlearn.core.samples import Inputs, VectorSample
from usvlearn.errors import check_positive

FINEST = 0.1  # s, of a step of Runge-Kutta 4


class PlanarBoat(NamedTuple):
    """Parameters, of a Heron by default.

    Linear and quadratic drag and full thrust are those of the maker's model. Added mass, inertia, the distance of the
    thrusters and the lift are assumed; without the lift, the boat would not keep its course at 1 m/s and above.

    >>> PlanarBoat(mass=(60.0, 76.0, 14.0)).thrust
    (33.6, 19.88)
    """

    mass: tuple[float, float, float] = (30.0, 38.0, 7.0)  # m_u, m_v, kg; j, kg m²; with added mass
    linear: tuple[float, float, float] = (16.45, 15.80, 6.0)  # l: N s/m, N s/m, N m s/rad
    quadratic: tuple[float, float, float] = (2.942, 2.762, 5.0)  # q: N s²/m², N s²/m², N m s²/rad²
    lift: tuple[float, float, float] = (0.0, 60.0, 12.0)  # s: N s²/m², N s²/m², N m s²/(rad m)
    thrust: tuple[float, float] = (33.6, 19.88)  # N, of one thruster at full ahead and full astern
    arm: float = 0.37  # b, m
    lag: float = 0.1  # s, of a thruster


HERON = PlanarBoat()


def rates(boat: PlanarBoat, velocity: np.ndarray, shaft: np.ndarray) -> np.ndarray:
    """(1): accelerations, `(*batch, 3)`, from u, v, r, `(*batch, 3)`, and xi, left and right, `(*batch, 2)`."""
    u, v, r = np.moveaxis(velocity, -1, 0)
    m_u, m_v, _ = boat.mass
    tau = np.where(shaft > 0, boat.thrust[0], boat.thrust[1]) * shaft
    left, right = tau[..., 0], tau[..., 1]
    force = np.stack([m_v * v * r + left + right, -m_u * u * r, (m_u - m_v) * u * v + boat.arm * (left - right)], -1)
    linear, quadratic, lift, mass = (np.array(each) for each in (boat.linear, boat.quadratic, boat.lift, boat.mass))
    return (force - (linear + quadratic * abs(velocity) + lift * abs(u)[..., None]) * velocity) / mass


def simulate_planar(
    boat: PlanarBoat,
    commands: np.ndarray,
    dt: float,
    velocity: np.ndarray | None = None,
    forces: np.ndarray | None = None,
) -> np.ndarray:
    """The velocities after each step, from rest or from a velocity.

    Args:
        boat: its parameters.
        commands: `(time, *batch, 2)` left and right, share of full scale, each held for `dt`; saturate at −1 and 1.
        dt: s.
        velocity: `(*batch, 3)` at first, m/s, m/s, rad/s.
        forces: `(time, *batch, 3)` that act on the boat beside (1), per unit mass and inertia; none by default.

    Returns:
        Surge, sway and yaw rate, m/s, m/s, rad/s, `(time, *batch, 3)`.

    Raises:
        ConfigError: dt is not positive.

    >>> simulate_planar(HERON, np.ones((100, 2)), 0.2)[-1].round(2).tolist()
    [2.74, 0.0, 0.0]
    """
    count = max(1, round(check_positive("dt", dt, "of s") / FINEST))
    h = dt / count
    commands = np.clip(commands, -1.0, 1.0)
    x = np.zeros((*commands.shape[1:-1], 3)) if velocity is None else np.asarray(velocity, dtype=np.float64)
    shaft, velocities = np.zeros(commands.shape[1:]), []
    others = [0.0] * len(commands) if forces is None else forces
    for command, other in zip(commands, others, strict=True):
        for _ in range(count):
            after = command + (shaft - command) * np.exp(-h / boat.lag)  # (2)
            middle = command + (shaft - command) * np.exp(-h / (2 * boat.lag))
            k1 = rates(boat, x, shaft) + other
            k2 = rates(boat, x + h / 2 * k1, middle) + other
            k3 = rates(boat, x + h / 2 * k2, middle) + other
            k4 = rates(boat, x + h * k3, after) + other
            x, shaft = x + h / 6 * (k1 + 2 * (k2 + k3) + k4), after
        velocities.append(x)
    return np.stack(velocities)


def courses(rng: np.random.Generator, steps: int, dt: float, batch: tuple[int, ...] = ()) -> np.ndarray:
    """Commands that excite all three components, `(steps, *batch, 2)`.

    A throttle of −0.3 to 1 and a difference of up to ±0.3 between the sides are each held for 2 to 15 s; in one of four
    spells the boat goes straight, and in one of eight the thrusters are off.
    """
    width = int(np.prod(batch, dtype=int))
    commands = np.empty((steps, width, 2))
    for element in range(width):
        throttle = _held(rng, steps, dt, lambda n: rng.uniform(-0.3, 1.0, n) * (rng.random(n) > 1 / 8))
        turn = _held(rng, steps, dt, lambda n: rng.uniform(-0.3, 0.3, n) * (rng.random(n) > 1 / 4))
        commands[:, element] = np.stack([throttle + turn, throttle - turn], -1)
    return np.clip(commands, -1.0, 1.0).reshape(steps, *batch, 2)


def _held(rng: np.random.Generator, steps: int, dt: float, draw) -> np.ndarray:
    least = max(1, round(2 / dt))
    lengths = rng.integers(least, max(least + 1, round(15 / dt)), steps // least + 1)
    return np.repeat(draw(len(lengths)), lengths)[:steps]


def planar_runs(
    seed: int,
    minutes: float,
    runs: int,
    dt: float = 0.2,
    noise: tuple[float, float, float] = (0.03, 0.03, 0.01),
    boat: PlanarBoat = HERON,
) -> tuple[VectorSample, np.ndarray]:
    """Runs of one boat from rest, and its true velocities.

    The first sample of a run starts a segment.

    Args:
        seed: seed of commands and noise.
        minutes: length of a run, min.
        runs: number of runs.
        dt: s.
        noise: standard deviation of the measured components, m/s, m/s, rad/s.
        boat: its parameters.

    Returns:
        The samples, leaves `(time, runs)`, and the velocities without noise, m/s, m/s, rad/s, `(time, runs, 3)`.

    >>> samples, true = planar_runs(0, 1.0, 2)
    >>> samples.velocity.shape, samples.inputs.dt[:2, 0].tolist()
    ((301, 2, 3), [0.0, 0.2])
    """
    rng = np.random.default_rng(seed)
    commands = courses(rng, round(60 * minutes / dt), dt, (runs,))
    true = simulate_planar(boat, commands, dt)
    true = np.concatenate([np.zeros((1, runs, 3)), true])
    commands = np.concatenate([np.zeros((1, runs, 2)), commands])
    velocity = true + rng.normal(size=true.shape) * np.array(noise)
    steps = np.full(commands.shape[:-1], dt)
    steps[0] = 0.0
    heading = np.cumsum(true[..., 2] * dt, 0)
    inputs = Inputs(commands[..., 0], commands[..., 1], heading, velocity[..., 2], steps)
    every = np.ones(true.shape, dtype=bool)
    return VectorSample(inputs, velocity, every[..., 0], every), true
