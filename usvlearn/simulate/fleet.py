"""A season of a simulated fleet: boats of one plant, their missions, and their logs.

All missions of all boats are elements of one batch `(missions, boats)`, stepped together. Boat k and mission j draw
from generators seeded by (seed, purpose, j, k), so that a boat does not depend on the number of boats.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from usvlearn.core.samples import tree_map
from usvlearn.errors import ConfigError, check_choice, check_not_negative, check_positive
from usvlearn.logs.channels.channel import Recording
from usvlearn.simulate.autopilot import Autopilot
from usvlearn.simulate.fault import Fault, faulty_vessels
from usvlearn.simulate.gusts import Gusts
from usvlearn.simulate.plants import plant as plant_named
from usvlearn.simulate.scenario import MISSIONS, USUAL, Mission, aborted, paused
from usvlearn.simulate.sensors import Sensors, Truth, measure
from usvlearn.simulate.vessel import Vessel, VesselState, at_rest, over_ground, scale_thrust, steady_surge

LEAK, WEAR, DRAG = 0.25, 0.3, 0.2  # spread 1: mass up to +25 %, thrust of a side +-30 %, drag +-20 %
SUBSTEPS_HZ = 10.0  # least number of steps of the motion per second
MOST_HOURS = 1e5  # of all boats together; more fills the memory
HULL, BED, RIVER, COURSE, EVENT, SENSOR, WIND = range(7)  # purposes of a generator


def _rng(seed: int, purpose: int, mission: int = 0, boat: int = 0) -> np.random.Generator:
    return np.random.default_rng([seed, purpose, mission, boat])


def fleet_names(n: int, plant: str) -> list[str]:
    """The boats' names, in order."""
    return [plant] if n == 1 else [f"{plant}{k + 1}" for k in range(n)]


def fleet_vessels(
    n: int = 8,
    spread: float = 1.0,
    plant: str = "heron",
    seed: int = 0,
    missions: int = 1,
    drift: float = 0.2,
) -> Vessel:
    """The true parameters of every boat on every mission: leaves `(missions, n, ...)` where they vary.

    With draws z, z' uniform in the bounds and p = drift * j/(missions - 1) at mission j:

        mass = nominal (1 + spread * 0.25 ((1-p) z + p z')),     z in 0 ... 1
        thrust of a side, drag: likewise with 0.3 and 0.2,       z in -1 ... 1

    Args:
        n: number of boats.
        spread: no unit: 0 makes all boats equal to the plant; 1 varies them like a fleet in use.
        plant: heron, kingfisher, vtec, otter or wamv.
        seed: seed of the draws.
        missions: number of missions.
        drift: how far a boat's parameters move over the season towards a second draw, a share of 0 ... 1.

    Returns:
        The boats.

    >>> fleet_vessels(3, missions=2).mass.shape
    torch.Size([2, 3])
    """
    nominal = plant_named(plant)
    low = np.array([0.0, -1.0, -1.0, -1.0])  # mass, left, right, drag
    draws = [_rng(seed, HULL, 0, k).uniform(low, 1.0, (2, 4)) for k in range(n)]
    first, other = np.stack(draws, axis=1)  # (n, 4)
    gone = drift * np.linspace(0.0, 1.0, missions)[:, None, None]
    share = (1 - gone) * first + gone * other  # (missions, n, 4)
    factor = torch.from_numpy(1 + spread * np.array([LEAK, WEAR, WEAR, DRAG]) * share)
    mass, sides, hull = factor[..., 0], factor[..., 1:3], factor[..., 3]
    drag = {name: getattr(nominal, name) * hull for name in Vessel._fields if name.startswith("drag")}
    return scale_thrust(nominal._replace(mass=nominal.mass * mass, **drag), sides)


def fleet_missions(
    n: int,
    ticks: Sequence[int],
    hz: float,
    seed: int,
    kinds: Sequence[str] = USUAL,
    aborted_share: float = 0.1,
    paused_share: float = 0.1,
) -> tuple[list[str], list[list[Mission]]]:
    """The name of each mission, and its course per boat.

    The kinds are drawn without replacement until all have been used, so each occurs equally often. A convoy has one
    course for all boats. `ticks` are the lengths of the missions.
    """
    names, courses = [], []
    for j, length in enumerate(ticks):
        deck, card = divmod(j, len(kinds))
        kind = kinds[int(_rng(seed, COURSE, deck, 0).permutation(len(kinds))[card])]
        row = []
        for k in range(n):
            course = MISSIONS[kind](_rng(seed, COURSE, j, 1 if kind == "convoy" else k + 1), length, hz)
            event = _rng(seed, EVENT, j, k)
            dice = event.random()
            if dice < aborted_share:
                course = aborted(event, course, hz)
            elif dice < aborted_share + paused_share:
                course = paused(event, course)
            row.append(course)
        names.append(f"{j + 1:03d}_{kind}")
        courses.append(row)
    return names, courses


def sail(
    vessel: Vessel,
    courses: list[list[Mission]],
    current: Tensor,
    direction: Tensor,
    autopilot: Autopilot,
    later: Mapping[int, Vessel] | None = None,
    gusts: Gusts | None = None,
    wind: np.ndarray | None = None,
) -> tuple[float, Tensor, Tensor, Tensor]:
    """All missions of all boats, `(missions, boats)`, with the autopilot in the loop, to the length of the longest one.

    The current is in m/s, its direction in rad. `later` are the vessel's new parameters by the tick from which they
    hold; the autopilot does not know them. The wind is that of `Gusts.course`. Returns the step in s, surge over ground
    and heading at its multiples, `(steps + 1, missions, boats)`, and the commands, `(ticks, missions, boats, 2)`.
    """
    from usvlearn.core.jit import announce  # numba takes a moment to import
    from usvlearn.simulate import missions_kernel as kernel

    substeps = math.ceil(SUBSTEPS_HZ / autopilot.hz)
    dt = 1 / (autopilot.hz * substeps)
    batch, reference = (len(courses), len(courses[0])), _stacked(courses)
    ticks, count = len(reference.power), batch[0] * batch[1]
    top = steady_surge(vessel, torch.ones(2, dtype=torch.float64))
    first = torch.from_numpy(np.nan_to_num(reference.heading[0]).flatten())
    state = tree_map(lambda x: x.numpy().copy(), at_rest((count,), first))
    surge, heading = np.empty((2, ticks * substeps + 1, count))
    integral, commands = np.zeros(count), np.empty((ticks, count, 2))
    blows = np.zeros(commands.shape) if wind is None else wind.reshape(commands.shape)
    vessels = {0: vessel} | {tick: changed for tick, changed in (later or {}).items() if tick < ticks}
    for begin, end in pairwise([*sorted(vessels), ticks]):
        part = tree_map(lambda x, a=begin, b=end: x[a:b].reshape(b - a, count), reference)
        steps = slice(begin * substeps, end * substeps)
        known = kernel.known(vessels[begin], batch, dt, top, current, direction, gusts or Gusts())
        with announce(kernel.__file__, "simulator"):
            kernel.sail_on(
                kernel.gains(autopilot), part, *known, blows[begin:end], dt, substeps,
                integral, state, surge[steps], heading[steps], commands[begin:end],
            )  # fmt: skip
    surge[-1], heading[-1] = state.surge, state.heading
    through_water, headings, given = (
        torch.from_numpy(x.reshape(len(x), *batch, *x.shape[2:])) for x in (surge, heading, commands)
    )
    return dt, over_ground(through_water, headings, current, direction), headings, given


def _stacked(courses: list[list[Mission]]) -> Mission:
    """All courses as `(ticks, missions, boats)`; after its end a course has no power."""
    ticks = max(course.power.size for row in courses for course in row)
    stacked = np.zeros((len(Mission._fields), ticks, len(courses), len(courses[0])))
    for j, row in enumerate(courses):
        for k, course in enumerate(row):
            stacked[:, : course.power.size, j, k] = np.stack(course)
    return Mission(*stacked)


def fleet(
    n: int = 8,
    spread: float = 1.0,
    hours: float = 1.0,
    plant: str = "heron",
    mission_minutes: float = 15.0,
    seed: int = 0,
    drift: float = 0.2,
    current: float = 0.3,
    missions: Sequence[str] = USUAL,
    aborted_share: float = 0.1,
    paused_share: float = 0.1,
    autopilot: Autopilot | None = None,
    sensors: Sensors | None = None,
    fault: Fault | None = None,
    gusts: Gusts | None = None,
    fleet_seed: int | None = None,
) -> list[Recording]:
    """The logs of a fleet's season, boat by boat in the order of the missions.

    Args:
        n: number of boats, named after the plant.
        spread: no unit: 0 makes all boats equal, 1 spreads them (see `fleet_vessels`).
        hours: time of each boat on the water, all missions together, in hours (3600 s).
        plant: heron, kingfisher, vtec, otter or wamv.
        mission_minutes: length of a mission, min; the last one takes the rest of `hours`.
        seed: the same seed gives the same logs, bit for bit.
        drift: how far a boat's parameters move over the season, a share of 0 ... 1.
        current: fastest river current, m/s; each mission has its own speed; the direction varies little.
        missions: kinds to draw from: convoy, patrol, lawn_mower, station_keeping, random (open commands).
        aborted_share: share of the missions that end early, at 30 ... 80 % of their length.
        paused_share: share of the missions with a pause of the thrusters.
        autopilot: gains of the controller; by default it never goes astern.
        sensors: rates, errors and losses.
        fault: what changes about every boat, a thruster that fails for example; by default nothing does.
        gusts: of wind; by default there is none.
        fleet_seed: seed of the boats themselves, by default `seed`; set it to let the same boats sail another season.

    Returns:
        Recordings; `dropped` counts the messages that were lost.

    Raises:
        ConfigError: a number outside its range, an unknown plant or mission, or options that are no options.

    >>> log = fleet(n=1, hours=0.05, seed=3)[0]
    >>> log.boat, sorted(log.channels)
    ('heron', ['command_left', 'command_right', 'heading', 'surge'])
    """
    for name, value in (("n", n), ("hours", hours), ("mission_minutes", mission_minutes)):
        check_positive(name, value)
    others = {"spread": spread, "drift": drift, "current": current, "seed": seed, "fleet_seed": fleet_seed or 0}
    for name, value in others.items():
        check_not_negative(name, value)
    if not isinstance(n, int):
        raise ConfigError(f"n: found {n!r}, expected a whole number of boats")
    if n * hours > MOST_HOURS:
        raise ConfigError(f"hours: found {hours!r} for {n} boats, expected at most {MOST_HOURS:g} for all together")
    if drift > 1:
        raise ConfigError(f"drift: found {drift!r}, expected a share of 0 to 1")
    if not missions:
        raise ConfigError(f"missions: found none, expected some of {', '.join(MISSIONS)}")
    for kind in missions:
        check_choice("missions", kind, tuple(MISSIONS))
    autopilot, sensors = autopilot or Autopilot(), sensors or Sensors()
    for key, options, expected in (("autopilot", autopilot, Autopilot), ("sensors", sensors, Sensors)):
        if not isinstance(options, expected):
            raise ConfigError(f"{key}: found {options!r}, expected options under it: leave out {key}=…")
    whole, mission_ticks = round(3600 * hours * autopilot.hz), round(60 * mission_minutes * autopilot.hz)
    ticks = [min(mission_ticks, whole - start) for start in range(0, whole, mission_ticks)]

    vessel = fleet_vessels(n, spread, plant, seed if fleet_seed is None else fleet_seed, len(ticks), drift)
    names, courses = fleet_missions(n, ticks, autopilot.hz, seed, missions, aborted_share, paused_share)
    flow, direction = _river(seed, len(ticks), current)
    later = faulty_vessels(fault, vessel, ticks, autopilot.hz)
    wind = _wind(seed, gusts, ticks, n, autopilot.hz) if gusts else None
    dt, *motions = sail(vessel, courses, flow, direction, autopilot, later, gusts, wind)

    substeps = round(1 / (dt * autopilot.hz))
    surge, heading, commands = (x.numpy() for x in motions)
    recordings = []
    for k, boat in enumerate(fleet_names(n, plant)):
        for j, name in enumerate(names):
            ticks_here = courses[j][k].power.size
            steps = slice(ticks_here * substeps + 1)
            motion = surge[steps, j, k], heading[steps, j, k]
            truth = Truth(dt, *motion, 1 / autopilot.hz, commands[:ticks_here, j, k])
            recordings.append(Recording(boat, name, *measure(_rng(seed, SENSOR, j, k), truth, sensors)))
    return recordings


def _river(seed: int, missions: int, current: float) -> tuple[Tensor, Tensor]:
    """Speed and direction of the water on each mission, `(missions, 1)`."""
    bed = _rng(seed, BED).uniform(0, 2 * math.pi)
    rngs = [_rng(seed, RIVER, j) for j in range(missions)]
    flow = [(current * rng.random(), bed + rng.normal(0, 0.2)) for rng in rngs]
    speed, direction = torch.tensor(flow, dtype=torch.float64).unsqueeze(-1).unbind(1)
    return speed, direction


def _wind(seed: int, gusts: Gusts, ticks: Sequence[int], n: int, hz: float) -> np.ndarray:
    """The gusts of every mission of every boat, `(ticks, missions, n, 2)`; after its end a mission has none."""
    wind = np.zeros((max(ticks), len(ticks), n, 2))
    for j, length in enumerate(ticks):
        for k in range(n):
            wind[:length, j, k] = gusts.course(_rng(seed, WIND, j, k), length, hz)
    return wind


def simulate(vessel: Vessel, state: VesselState, commands: Tensor, dt: float) -> VesselState:
    """The trajectory under a course of commands.

    Args:
        vessel: its parameters, leaves that broadcast against `(*batch,)`.
        state: before the first step, leaves `(*batch, ...)`.
        commands: left and right, share of full scale, `(time, *batch, 2)`, each held for `dt`.
        dt: length of a step, s.

    Returns:
        States after each step: leaves `(time, *batch, ...)`.

    >>> from usvlearn.simulate.plants import heron
    >>> simulate(heron(), at_rest((3,)), torch.ones(5, 3, 2, dtype=torch.float64), 0.1).surge.shape
    torch.Size([5, 3])
    """
    from usvlearn.core.jit import announce  # numba takes a moment to import
    from usvlearn.simulate import missions_kernel as kernel

    ticks, batch, none = len(commands), commands.shape[1:-1], torch.zeros((), dtype=torch.float64)
    given = np.ascontiguousarray(commands.numpy()).reshape(ticks, -1, 2)
    sizes: tuple[tuple[int, ...], ...] = ((), (), (), (2,))  # of the leaves, behind the batch
    leaves = [leaf.broadcast_to((*batch, *size)).reshape(-1, *size) for leaf, size in zip(state, sizes, strict=True)]
    now: Any = [leaf.clone().numpy() for leaf in leaves]
    states: Any = [np.empty((ticks, *leaf.shape)) for leaf in now]
    known = kernel.known(vessel, batch, dt, none, none, none, Gusts())
    with announce(kernel.__file__, "simulator"):
        kernel.drift(*known, dt, given, VesselState(*now), VesselState(*states))
    shaped = (x.reshape(ticks, *batch, *size) for x, size in zip(states, sizes, strict=True))
    return VesselState(*map(torch.from_numpy, shaped))
