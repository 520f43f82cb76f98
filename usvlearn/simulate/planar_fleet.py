"""Logs of simulated boats that turn and drift: compass, gyro and GPS in a current, with slow forces of wind and waves.

The boats are those of `usvlearn.simulate.planar`. The slow forces are Gauss–Markov processes of each axis, in the
boat's frame. The water moves with one velocity in a mission. A GPS gives position and velocity over ground, so that
surge and sway come from the velocity and the compass.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from usvlearn.errors import ConfigError, check_not_negative, check_positive
from usvlearn.logs.channels.channel import Channel, Recording
from usvlearn.simulate.planar import HERON, PlanarBoat, courses, simulate_planar
from usvlearn.simulate.sensors import ranks

HZ = 10.0  # of the motion, the commands and the compass
MOST_HOURS = 1e3  # of all boats together
CHANGES = (0.25, 0.2, 0.2, 0.3)  # spread 1: mass and inertia to +25 %, drag ±20 %, lift ±20 %, thrust ±30 %
SLOW, SLOW_TIME = (0.03, 0.03, 0.02), 20.0  # m/s², m/s², rad/s² of the slow forces; s
COMPASS, GYRO, GYRO_BIAS = 0.01, 0.005, 0.002  # rad, rad/s, rad/s
GPS_HZ, GPS_NOISE, GPS_DRIFT, GPS_TIME, GPS_SPEED = 5.0, 0.02, 0.3, 120.0, 0.03  # 1/s, m, m, s, m/s
START = (48.5, 9.05)  # deg north and east
EARTH = 6_371_000.0  # m


class Voyage(NamedTuple):
    """The true motion of one mission."""

    time: np.ndarray  # (time,) s
    velocity: np.ndarray  # (time, 3) u, v through the water, m/s, r, rad/s
    heading: np.ndarray  # (time,) rad, not wrapped
    position: np.ndarray  # (time, 2) m north and east
    current: np.ndarray  # (2,) m/s north and east
    commands: np.ndarray  # (time, 2) in force from each time on


def planar_boats(n: int, spread: float = 1.0, seed: int = 0) -> list[PlanarBoat]:
    """Boats that differ like a fleet in use."""
    boats = []
    for k in range(n):
        rng = np.random.default_rng([seed, 1, k])
        mass, drag, lift, thrust = (
            1 + spread * change * (rng.random() if i == 0 else rng.uniform(-1, 1)) for i, change in enumerate(CHANGES)
        )
        factors = {"mass": mass, "linear": drag, "quadratic": drag, "lift": lift, "thrust": thrust}
        varied: Any = {name: tuple(x * factor for x in getattr(HERON, name)) for name, factor in factors.items()}
        boats.append(HERON._replace(**varied))
    return boats


def voyage(rng: np.random.Generator, boat: PlanarBoat, minutes: float, current: float, slow: float = 1.0) -> Voyage:
    """One mission from rest."""
    h, steps = 1 / HZ, round(60 * minutes * HZ)
    commands = courses(rng, steps, h)
    decay, share = math.exp(-h / SLOW_TIME), math.sqrt(1 - math.exp(-2 * h / SLOW_TIME))
    force, forces = np.zeros(3), np.empty((steps, 3))
    for k, draw in enumerate(rng.normal(size=(steps, 3))):
        force = decay * force + share * slow * np.array(SLOW) * draw
        forces[k] = force
    velocity = np.concatenate([np.zeros((1, 3)), simulate_planar(boat, commands, h, forces=forces)])
    direction, speed = rng.uniform(0, 2 * math.pi), current * rng.random()
    water = speed * np.array([math.cos(direction), math.sin(direction)])
    r = velocity[:, 2]
    heading = rng.uniform(0, 2 * math.pi) + np.concatenate([[0.0], np.cumsum(h * (r[1:] + r[:-1]) / 2)])
    c, s, (u, v) = np.cos(heading), np.sin(heading), velocity[:, :2].T
    ground = np.column_stack([c * u - s * v, s * u + c * v]) + water
    position = np.concatenate([np.zeros((1, 2)), np.cumsum(h * (ground[1:] + ground[:-1]) / 2, 0)])
    given = np.concatenate([commands, commands[-1:]])
    return Voyage(np.arange(steps + 1) * h, velocity, heading, position, water, given)


def logged(rng: np.random.Generator, truth: Voyage) -> dict[str, Channel]:
    """The channels of a log of it: commands, compass, gyro, and a GPS with position and velocity."""
    n, every = len(truth.time), round(HZ / GPS_HZ)
    c, s, (u, v, r) = np.cos(truth.heading), np.sin(truth.heading), truth.velocity.T
    ground = np.column_stack([c * u - s * v, s * u + c * v]) + truth.current
    fixes = slice(0, n, every)
    at = truth.time[fixes]
    decay = math.exp(-1 / (GPS_HZ * GPS_TIME))
    drift = np.zeros((len(at), 2))
    for k in range(1, len(at)):
        drift[k] = decay * drift[k - 1] + math.sqrt(1 - decay * decay) * GPS_DRIFT * rng.normal(size=2)
    position = truth.position[fixes] + drift + GPS_NOISE * rng.normal(size=(len(at), 2))
    speed = ground[fixes] + GPS_SPEED * rng.normal(size=(len(at), 2))
    latitude = np.radians(START[0]) + position[:, 0] / EARTH
    longitude = np.radians(START[1]) + position[:, 1] / (EARTH * math.cos(math.radians(START[0])))
    readings = {
        "command_left": (truth.time, truth.commands[:, 0]),
        "command_right": (truth.time, truth.commands[:, 1]),
        "heading": (truth.time, np.remainder(truth.heading + COMPASS * rng.normal(size=n), 2 * math.pi)),
        "yaw_rate": (truth.time, r + GYRO_BIAS * rng.normal() + GYRO * rng.normal(size=n)),
        "latitude": (at, latitude),
        "longitude": (at, longitude),
        "velocity_north": (at, speed[:, 0]),
        "velocity_east": (at, speed[:, 1]),
    }
    psi = readings["heading"][1][fixes]
    readings["surge"] = at, speed[:, 0] * np.cos(psi) + speed[:, 1] * np.sin(psi)
    orders = ranks([time for time, _ in readings.values()])
    return {
        name: Channel(time, value, order, window=0.5)
        for (name, (time, value)), order in zip(readings.items(), orders, strict=True)
    }


def planar_fleet(
    n: int = 1,
    hours: float = 1.0,
    mission_minutes: float = 10.0,
    seed: int = 0,
    spread: float = 1.0,
    current: float = 0.3,
    slow: float = 1.0,
) -> list[Recording]:
    """The logs of boats that turn and drift, boat by boat in the order of their missions.

    Args:
        n: number of boats, named planar, or planar1, planar2, ….
        hours: time of each boat, all missions together, in hours (3600 s).
        mission_minutes: length of a mission, min.
        seed: the same seed gives the same logs, bit for bit.
        spread: no unit: 0 makes all boats equal, 1 spreads them.
        current: m/s, the fastest.
        slow: share of the slow forces of wind and waves.

    Returns:
        The logs; each has commands, heading, yaw rate, surge, velocities north and east, latitude and longitude.

    Raises:
        ConfigError: a number outside its range.

    >>> log = planar_fleet(hours=0.02, mission_minutes=1.0)[0]
    >>> log.boat, log.run, "latitude" in log.channels
    ('planar', '001', True)
    """
    for name, value in (("n", n), ("hours", hours), ("mission_minutes", mission_minutes)):
        check_positive(name, value)
    for name, value in (("seed", seed), ("spread", spread), ("current", current), ("slow", slow)):
        check_not_negative(name, value)
    if not isinstance(n, int):
        raise ConfigError(f"n: found {n!r}, expected a whole number of boats")
    if n * hours > MOST_HOURS:
        raise ConfigError(f"hours: found {hours!r} for {n} boats, expected at most {MOST_HOURS:g} for all together")
    logs, missions = [], max(1, round(60 * hours / mission_minutes))
    for k, boat in enumerate(planar_boats(n, spread, seed)):
        for j in range(missions):
            rng = np.random.default_rng([seed, 2, k, j])
            truth = voyage(rng, boat, min(mission_minutes, 60 * hours), current, slow)
            logs.append(Recording("planar" if n == 1 else f"planar{k + 1}", f"{j + 1:03d}", logged(rng, truth), {}))
    return logs
