"""What is printed of a speed controller."""

from __future__ import annotations

import math
from collections.abc import Iterator
from textwrap import wrap

import numpy as np
from rich.text import Text

from usvlearn.display.terminal import Blocks
from usvlearn.errors import printable
from usvlearn.model.controller.autopilots import ROVER_PERIOD
from usvlearn.model.controller.design import OVERSHOOT, Controller


def head(found: Controller) -> list[str]:
    """The lines above the parameters in a file, ASCII only."""
    gains, left, speeds = found.gains, found.margins, found.speeds
    name, file = found.boat.name, found.boat.path.name
    return [
        printable(f"{name}: speed controller by usvlearn controller, from {file}").encode("ascii", "replace").decode(),
        f"for {speeds[0]:.2f} to {speeds[-1]:.2f} m/s, a loop of {found.period:g} s or faster, and "
        f"{found.late:.2f} s of delay of the commands",
        f"poles at {gains.bandwidth:.2f} rad/s with damping {gains.damping:.2f}; worst margins over the 90 % "
        f"intervals: {_decibels(left.gain)}, {left.phase:.0f} deg",
        *(line for each in found.boat.guessed for line in wrap(each.encode("ascii", "replace").decode(), 90)),
        "throttle or thrust must be in proportion to the command that was learned (ArduRover: MOT_THST_EXPO 0)",
    ]


def parts(found: Controller) -> Iterator[str | Text | Blocks]:
    """All of it, for a terminal: sentences, tables, and lines of files, which are not broken."""
    yield printable(f"{found.boat.name}: speed controller from {found.boat.path.name}")
    yield found.boat.found.basis
    yield from found.boat.lacks
    yield ""
    yield from _feedforward(found)
    yield ""
    yield from _gains(found)
    yield ""
    yield from _closed_loop(found)
    yield ""
    yield "ArduRover, a parameter file"
    yield from map(Text, found.rover.text([]).rstrip().splitlines())
    yield ""
    yield "MOOS-IvP, a block of the mission file"
    yield from map(Text, found.moos.text([]).rstrip().splitlines())


def _feedforward(found: Controller) -> Iterator[str | Blocks]:
    forward, speeds = found.feedforward, found.speeds
    table = Blocks(
        "Feedforward: the command of both sides that holds a speed, straight ahead, in brackets 90 % intervals",
        ["speed, m/s"],
        ["command, %", "ArduRover, %", "time constant, s", "gain, m/s²"],
    )
    low, high = forward.band(speeds)
    T, b = found.linear
    for k in range(0, len(speeds), 2):
        table.add(
            f"{speeds[k]:.2f}", f"{100 * forward.at(speeds[k]):.0f} ({100 * low[k]:.0f} … {100 * high[k]:.0f})",
            f"{100 * found.rover.slope * speeds[k]:.0f}",
            *(f"{each.value[k]:.2f} ({each.low[k]:.2f} … {each.high[k]:.2f})" for each in (T, b)),
        )  # fmt: skip
    yield table
    least, top = forward.least, forward.top
    yield "ArduRover: the base throttle that CRUISE_SPEED and CRUISE_THROTTLE make."
    yield f"Lowest speed that can be held: {least[0]:.2f} m/s at {100 * least[1]:.0f} %; below is the dead band."
    yield f"Saturation: full command reaches {top[0]:.2f} m/s ({top[1]:.2f} … {top[2]:.2f})."
    if speeds[-1] > top[1]:
        yield f"The slowest boats of the interval do not reach {speeds[-1]:.2f} m/s, the upper end of the range."
    accelerates, slows = (
        ", and by ".join(
            f"{each.value[k]:.2f} m/s² ({each.low[k]:.2f} … {each.high[k]:.2f}) at {speeds[k]:.2f} m/s" for k in (0, -1)
        )
        for each in (found.acceleration, found.deceleration)
    )
    yield f"Full command accelerates by {accelerates}."
    yield f"Without thrust drag slows by {slows}."


def _gains(found: Controller) -> Iterator[str]:
    gains, left = found.gains, found.margins
    yield "Gains: command = base + P e + I ∫e dt, e = wanted − measured speed in m/s, command 1 = full"
    yield f"P = {gains.proportional:.3f} per m/s    I = {gains.integral:.3f} per m"
    yield f"base = {found.rover.slope:.3f} per m/s × wanted speed (ArduRover)"
    yield (
        f"Poles at {gains.bandwidth:.2f} rad/s with damping {gains.damping:.2f}. Delay of {found.delay:.2f} s: "
        f"{found.late:.2f} s of the commands (upper end of its interval), and half of the loop's period of "
        f"{found.period:g} s. A faster loop is safe."
    )
    if found.period > ROVER_PERIOD:
        yield f"ArduRover's own loop takes {ROVER_PERIOD:g} s: --period {ROVER_PERIOD:g} gives faster gains for it."
    yield (
        f"Worst over the corners of the 90 % intervals: gain margin {_decibels(left.gain)}, phase margin "
        f"{left.phase:.0f}°, {left.delay:.2f} s more delay."
    )
    yield f"Closed-loop bandwidth (−3 dB): {left.bandwidth[0]:.2f} … {left.bandwidth[1]:.2f} rad/s."


def _closed_loop(found: Controller) -> Iterator[str | Blocks]:
    count = found.loops[0].responses.speed.shape[1]
    table = Blocks(
        f"Closed loop on {count} boats drawn from the intervals: median, and in brackets the 95 % quantile",
        ["autopilot", "step, m/s"],
        ["overshoot", "settled to ±5 %", "boats settled", "unstable"],
    )
    for loop in found.loops:
        for step in loop.steps:
            over, settled = step.overshoot, step.settled
            times = (np.median(settled), np.quantile(settled, 0.95, method="higher"))
            middle, most = (f"{each:.1f} s" if math.isfinite(each) else "–" for each in times)
            table.add(
                loop.name, f"{step.before:.2f} → {step.after:.2f}",
                f"{100 * np.median(over):.0f} % ({100 * np.quantile(over, 0.95):.0f} %)", f"{middle} ({most})",
                f"{np.isfinite(settled).sum()} of {len(settled)}", f"{int(step.sways.sum())}",
            )  # fmt: skip
    yield table
    yield (
        "Overshoot is a share of the step. ArduRover's base acts at once, so that what the integral collects while "
        "the boat speeds up is undone by an overshoot; ATC_ACCEL_MAX and ATC_DECEL_MAX limit it."
    )
    worst = max(float(np.quantile(step.overshoot, 0.95)) for step in found.loops[0].steps)
    if worst > OVERSHOOT:
        yield (
            f"{100 * worst:.0f} % is more than the {100 * OVERSHOOT:.0f} % that was aimed at: the base is a straight "
            "line, and the boat's curve is not. A narrower --range helps, or a faster loop (--period)."
        )


def _decibels(gain: float) -> str:
    return f"{gain:.1f} dB" if math.isfinite(gain) else "infinite"
