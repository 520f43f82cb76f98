"""A simulated boat's voyage with all that a real boat may log of it: the truth behind logs in any form."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
import torch

from usvlearn.simulate.autopilot import Autopilot
from usvlearn.simulate.fleet import fleet_missions, fleet_vessels, sail
from usvlearn.simulate.sensors import Sensors, Truth, measure

EARTH = 6_371_000.0  # m
START = (48.5, 9.05)  # deg north and east


class Voyage(NamedTuple):
    """What was measured on a voyage, each a pair of stamps, s, and SI values; heading 0 is north, clockwise."""

    command_left: tuple[np.ndarray, np.ndarray]
    command_right: tuple[np.ndarray, np.ndarray]
    heading: tuple[np.ndarray, np.ndarray]
    yaw_rate: tuple[np.ndarray, np.ndarray]
    surge: tuple[np.ndarray, np.ndarray]
    course: tuple[np.ndarray, np.ndarray]
    north: tuple[np.ndarray, np.ndarray]
    east: tuple[np.ndarray, np.ndarray]

    def at(self, name: str, time: np.ndarray) -> np.ndarray:
        """A channel at other times: commands are held, angles are interpolated on the circle."""
        stamps, value = getattr(self, name)
        order = np.argsort(stamps, kind="stable")
        stamps, value = stamps[order], value[order]
        if name.startswith("command"):
            return value[np.clip(np.searchsorted(stamps, time, side="right") - 1, 0, None)]
        if name in ("heading", "course"):
            return np.interp(time, stamps, np.unwrap(value)) % (2 * math.pi)
        return np.interp(time, stamps, value)

    @property
    def latitude(self) -> tuple[np.ndarray, np.ndarray]:
        return self.north[0], START[0] + np.degrees(self.north[1] / EARTH)

    @property
    def longitude(self) -> tuple[np.ndarray, np.ndarray]:
        return self.east[0], START[1] + np.degrees(self.east[1] / EARTH / math.cos(math.radians(START[0])))


@functools.cache
def voyage(
    seed: int = 0,
    plant: str = "heron",
    minutes: float = 10.0,
    kind: str = "patrol",
    current: float = 0.0,
    lowest: float = -0.5,
    commands: str = "periodic",
    surge_quantum: float = 0.01,
) -> Voyage:
    """Sail one mission, and measure it; the current and the resolution of the speed are in m/s."""
    autopilot = Autopilot(lowest=lowest)
    sensors = Sensors(commands=commands, surge_quantum=surge_quantum)
    rng = np.random.default_rng([seed, 99])
    vessel = fleet_vessels(1, 1.0, plant, seed)
    ticks = [round(60 * minutes * autopilot.hz)]
    _, courses = fleet_missions(1, ticks, autopilot.hz, seed, [kind], 0.0, 0.3)
    flow = torch.tensor([[current]], dtype=torch.float64)
    set_ = torch.tensor([[rng.uniform(0, 2 * math.pi)]], dtype=torch.float64)
    dt, *motions = sail(vessel, courses, flow, set_, autopilot)
    surge, heading, given = (x.numpy()[:, 0, 0] for x in motions)
    channels, _ = measure(rng, Truth(dt, surge, heading, 1 / autopilot.hz, given), sensors)
    time = np.arange(len(surge)) * dt
    rate = np.gradient(heading, dt)
    places = [np.cumsum(surge * turned) * dt for turned in (np.cos(heading), np.sin(heading))]

    def sensed(value: np.ndarray, hz: float, noise: float) -> tuple[np.ndarray, np.ndarray]:
        stamps = np.arange(0.3 / hz, time[-1], 1 / hz)
        return stamps, np.interp(stamps, time, value) + rng.normal(0, noise, len(stamps))

    course_time, course = sensed(heading, 5.0, 0.0)
    slow = np.abs(np.interp(course_time, time, surge))
    course = (course + rng.normal(0, 1, len(course)) * 0.02 / np.maximum(slow, 0.01)) % (2 * math.pi)
    measured = {name: (channel.time, channel.value) for name, channel in channels.items()}
    return Voyage(
        **measured,
        yaw_rate=sensed(rate, 10.0, 0.01),
        course=(course_time, course),
        north=sensed(places[0], 5.0, 0.01),
        east=sensed(places[1], 5.0, 0.01),
    )
