"""The motion of all boats on all missions, with the autopilot in the loop or under given commands, compiled by numba.

The equations of the motion are those of `vessel`, those of the steering those of `autopilot`. Constants of the steps
are computed once, by torch, because its exponential differs from that of the C library.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from usvlearn.core.jit import jit
from usvlearn.simulate.autopilot import Autopilot
from usvlearn.simulate.gusts import Gusts
from usvlearn.simulate.vessel import Vessel


class Known(NamedTuple):
    """Constants for steering and stepping, besides the vessel's parameters. Leaves are `(elements,)`."""

    decay: np.ndarray  # of a thruster's lag over a step
    lag: np.ndarray  # of a thruster, in steps
    yaw_decay: np.ndarray  # of the yaw lag over a step
    top: np.ndarray  # m/s, top speed
    current: np.ndarray  # m/s
    direction: np.ndarray  # rad, where the current flows to
    push: np.ndarray  # N, of a full gust along the heading
    swing: np.ndarray  # rad/s, settled, of a full gust across the heading


def known(
    vessel: Vessel, batch: tuple[int, ...], dt: float, top: Tensor, current: Tensor, direction: Tensor, gusts: Gusts
) -> tuple[Vessel, Known]:
    """The vessel as arrays `(elements, …)`, and the constants that follow from it."""

    def elements(leaf: Tensor, *last: int) -> np.ndarray:
        return leaf.broadcast_to((*batch, *last)).reshape(-1, *last).contiguous().numpy()

    last: dict[str, tuple[int, ...]] = dict.fromkeys(("thrust_linear", "thrust_quadratic", "thrust_speed"), (2,))
    last["thrust_table"] = tuple(vessel.thrust_table.shape[-2:])
    leaves = torch.exp(-dt / vessel.lag), vessel.lag / dt, torch.exp(-dt / vessel.yaw_lag), top, current, direction
    arrays: Any = {name: elements(leaf, *last.get(name, ())) for name, leaf in vessel._asdict().items()}
    return Vessel(**arrays), Known(*map(elements, (*leaves, *gusts.strength(vessel))))


def gains(autopilot: Autopilot) -> tuple[float, ...]:
    """The autopilot's numbers as `steer` takes them."""
    a = autopilot
    numbers = a.proportional, a.integral / a.hz, a.heading, a.turn_max, a.lowest, a.resolution
    return tuple(map(float, numbers))


@jit(memory=True)
def clip(x: float, low: float, high: float) -> float:
    """x within low … high."""
    return min(max(x, low), high)


@jit(memory=True)
def steer(gains, integral, surge_reference, throttle, heading_reference, power, open_turn, surge, heading):
    """The next integral and the commands left and right, see `usvlearn.simulate.autopilot`."""
    k_p, k_i, k_h, turn_max, lowest, resolution = gains
    error = 0.0
    if math.isnan(surge_reference):
        integral = throttle
    else:
        error = surge_reference - surge  # 1.
        integral = clip(integral + k_i * error, lowest, 1.0)  # 2.
    throttle = clip(integral + k_p * error, lowest, 1.0)
    if math.isnan(heading_reference):
        turn = open_turn
    else:
        away = (heading_reference - heading + math.pi) % (2 * math.pi) - math.pi
        turn = clip(k_h * away, -turn_max, turn_max)  # 3.
    left = np.rint(clip(throttle + turn, lowest, 1.0) * power / resolution) * resolution  # 4.
    right = np.rint(clip(throttle - turn, lowest, 1.0) * power / resolution) * resolution
    return integral, left, right


@jit(memory=True)
def surge_dot(vessel, n, surge, cross, static, lift):
    """Equation (1) of `vessel` for batch element n, m/s²: the thrust is static + lift |v|, N."""
    speed = abs(surge)
    if speed > vessel.knee[n]:
        quadratic, linear = vessel.drag_quadratic_fast[n], vessel.drag_linear_fast[n]
    else:
        quadratic, linear = vessel.drag_quadratic[n], vessel.drag_linear[n]
    return ((quadratic * speed + (linear + cross)) * surge + (static + lift * speed)) / vessel.mass[n]


@jit(memory=True, inline=True)
def advance(vessel, known, n, left, right, push, swing, dt, state, static, lift):
    """The state of batch element n, in place, `dt` later: (1) by Runge-Kutta 4, (3) and (4) exactly.

    The thrust over the step is that of the mean thruster speed, which is exact once the thrusters have spun up.

    Args:
        vessel, known: see `known`.
        left, right: commands, share of full scale; saturate at -1 and 1.
        push, swing: of a gust, N and rad/s.
        dt: s; stable at 0.1 s and below for every vessel of `plants`.
        state: leaves `(elements, …)`.
        static, lift: workspace, `(2,)`.
    """
    nodes = vessel.thrust_table.shape[-1]
    v = state.surge[n]
    for i in range(2):
        command = clip(left if i == 0 else right, -1.0, 1.0)
        gap = state.shaft[n, i] - command
        rest = gap * known.decay[n]
        state.shaft[n, i] = command + rest  # (3)
        mean = command + (gap - rest) * known.lag[n]
        shaft = clip(mean, -1.0, 1.0)
        place = (shaft + 1) * ((nodes - 1) / 2)
        below = min(int(place), nodes - 2)
        low, high = vessel.thrust_table[n, i, below], vessel.thrust_table[n, i, below + 1]
        slope = vessel.thrust_linear[n, i] + vessel.thrust_quadratic[n, i] * abs(shaft)
        static[i] = low + (high - low) * (place - below) + slope * shaft
        lift[i] = vessel.thrust_speed[n, i] * mean

    settled = vessel.yaw_gain[n] * ((static[0] + lift[0] * abs(v)) - (static[1] + lift[1] * abs(v)))  # (2)
    settled += swing
    gap = state.yaw_rate[n] - settled
    rest = gap * known.yaw_decay[n]
    state.yaw_rate[n] = settled + rest  # (4)
    turned = settled * dt + (gap - rest) * vessel.yaw_lag[n]
    state.heading[n] += turned

    both, rise, cross = static[0] + static[1] + push, lift[0] + lift[1], vessel.drag_cross[n] * abs(turned / dt)
    k1 = surge_dot(vessel, n, v, cross, both, rise)  # (1)
    k2 = surge_dot(vessel, n, v + dt / 2 * k1, cross, both, rise)
    k3 = surge_dot(vessel, n, v + dt / 2 * k2, cross, both, rise)
    k4 = surge_dot(vessel, n, v + dt * k3, cross, both, rise)
    state.surge[n] = v + dt / 6 * (k1 + 2 * (k2 + k3) + k4)


@jit(entry=True, memory=True)
def sail_on(gains, reference, vessel, known, wind, dt, substeps, integral, state, surge, heading, commands):
    """Steer and step all batch elements over all ticks of the reference.

    Args:
        gains: see `gains`.
        reference: leaves `(ticks, elements)`.
        vessel, known: see `known`.
        wind: north and east part of a gust, of its full strength, `(ticks, elements, 2)`; `usvlearn.simulate.gusts`.
        dt: step, s.
        substeps: steps of a tick.
        integral, state: of the autopilot, `(elements,)`, and of the vessel, leaves `(elements, …)`; updated in place.
        surge, heading: output, through the water, m/s, and rad, `(ticks · substeps, elements)`.
        commands: output, `(ticks, elements, 2)`.
    """
    static, lift = np.empty(2), np.empty(2)
    for k in range(len(commands)):
        for n in range(len(integral)):
            flow = known.current[n] * math.cos(known.direction[n] - state.heading[n])
            integral[n], commands[k, n, 0], commands[k, n, 1] = steer(
                gains, integral[n], reference.surge[k, n], reference.throttle[k, n], reference.heading[k, n],
                reference.power[k, n], reference.turn[k, n], (state.surge[n] + flow) / known.top[n], state.heading[n],
            )  # fmt: skip
        for at in range(k * substeps, (k + 1) * substeps):
            for n in range(len(integral)):
                push = swing = 0.0
                if wind[k, n, 0] != 0 or wind[k, n, 1] != 0:
                    north, east = math.cos(state.heading[n]), math.sin(state.heading[n])
                    push = known.push[n] * (wind[k, n, 0] * north + wind[k, n, 1] * east)
                    swing = known.swing[n] * (wind[k, n, 1] * north - wind[k, n, 0] * east)
                surge[at, n], heading[at, n] = state.surge[n], state.heading[n]
                left, right = commands[k, n, 0], commands[k, n, 1]
                advance(vessel, known, n, left, right, push, swing, dt, state, static, lift)


@jit(entry=True, memory=True)
def drift(vessel, known, dt, commands, state, states):
    """Step all batch elements under commands `(time, elements, 2)`.

    `state` has leaves `(elements, …)` and is updated in place; `states` after each step are the output, leaves
    `(time, elements, …)`.
    """
    static, lift = np.empty(2), np.empty(2)
    for k in range(len(commands)):
        for n in range(len(state.surge)):
            advance(vessel, known, n, commands[k, n, 0], commands[k, n, 1], 0.0, 0.0, dt, state, static, lift)
            states.surge[k, n], states.heading[k, n] = state.surge[n], state.heading[n]
            states.yaw_rate[k, n], states.shaft[k, n] = state.yaw_rate[n], state.shaft[n]
