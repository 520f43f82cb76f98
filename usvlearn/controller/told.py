"""What is printed of a speed controller."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from usvlearn.controller.design import Controller, Loop
from usvlearn.errors import printable

ASCII = str.maketrans({"–": "-", "…": "to", "ζ": "zeta", "ω": "w"})


def head(found: Controller) -> list[str]:
    """The lines above the parameters in a file, ASCII only."""
    gains, left = found.gains, found.margins
    return [
        printable(f"{found.boat.name}: speed controller by usvlearn controller, from {found.boat.path.name}").translate(
            ASCII
        ),
        f"for {found.speeds[0]:.2f} to {found.speeds[-1]:.2f} m/s, a loop of {found.period:g} s or faster, and {found.delay:.2f} s of delay",
        f"poles at {gains.bandwidth:.2f} rad/s with damping {gains.damping:g}; worst margins over the 90 % intervals: "
        f"{left.gain:.1f} dB, {left.phase:.0f} deg",
        "full throttle or thrust must be full command of both sides, in proportion (ArduRover: MOT_THST_EXPO 0)",
    ]


def lines(found: Controller) -> Iterator[str]:
    """All of it, for a terminal."""
    forward, speeds, gains, left = found.feedforward, found.speeds, found.gains, found.margins
    identified = found.boat.found
    yield printable(f"{found.boat.name}: speed controller from {found.boat.path.name}")
    yield identified.basis
    yield from identified.lacks
    yield ""
    yield "Feedforward: the command of both sides that holds a speed, straight ahead, with 90 % intervals"
    yield f"  {'speed':>8} {'command':>9} {'90 %':>13} {'ArduRover':>10} {'time constant':>15} {'90 %':>13} {'gain':>10} {'90 %':>13}"
    yield f"  {'m/s':>8} {'%':>9} {'%':>13} {'base, %':>10} {'s':>15} {'s':>13} {'m/s² ':>10} {'m/s² ':>13}"
    low, high = forward.band(speeds)
    T, b = found.linear
    for k in range(0, len(speeds), 2):
        yield (
            f"  {speeds[k]:8.2f} {100 * forward.at(speeds[k]):9.0f} {100 * low[k]:6.0f} …{100 * high[k]:5.0f} "
            f"{100 * found.rover.slope * speeds[k]:10.0f} {T.value[k]:15.2f} {T.low[k]:6.2f} …{T.high[k]:5.2f} "
            f"{b.value[k]:10.2f} {b.low[k]:6.2f} …{b.high[k]:5.2f}"
        )
    least, top = forward.least, forward.top
    yield f"  Lowest speed that can be held: {least[0]:.2f} m/s at {100 * least[1]:.0f} %; below is the dead band."
    yield f"  Saturation: full command reaches {top[0]:.2f} m/s ({top[1]:.2f} … {top[2]:.2f})."
    up, down, ends = found.acceleration, found.deceleration, (0, len(speeds) - 1)
    told = [
        ", and ".join(
            f"{each.value[k]:.2f} m/s² ({each.low[k]:.2f} … {each.high[k]:.2f}) at {speeds[k]:.2f} m/s" for k in ends
        )
        for each in (up, down)
    ]
    yield f"  Full command accelerates by {told[0]}."
    yield f"  Without thrust drag slows by {told[1]}."
    yield ""
    yield "Gains: command = base + P e + I ∫e dt, e = wanted − measured speed in m/s, command 1 = full"
    yield f"  P = {gains.proportional:.3f} per m/s    I = {gains.integral:.3f} per m    base = {found.rover.slope:.3f} per m/s × wanted speed"
    yield f"  Poles at {gains.bandwidth:.2f} rad/s with damping {gains.damping:g}, for a delay of {found.delay:.2f} s: {found.late:.2f} s of the commands,"
    yield f"  at the upper end of its interval, and half of the loop's period of {found.period:g} s. A faster loop is safe."
    gain = f"{left.gain:.1f} dB" if math.isfinite(left.gain) else "infinite"
    yield f"  Worst over the corners of the 90 % intervals: gain margin {gain}, phase margin {left.phase:.0f}°, {left.delay:.2f} s more delay."
    yield f"  Closed-loop bandwidth (−3 dB) {left.bandwidth[0]:.2f} … {left.bandwidth[1]:.2f} rad/s."
    yield ""
    count = found.loops[0].responses.speed.shape[1]
    yield f"Closed loop on {count} boats drawn from the intervals: median, and in brackets the worst of 95 %"
    yield f"  {'autopilot':<10} {'step, m/s':>14} {'overshoot':>16} {'settled within ±5 %':>22} {'settled':>10} {'unstable':>9}"
    for loop in found.loops:
        yield from _steps(loop)
    yield "  Overshoot is a share of the step."
    yield ""
    yield "ArduRover, a parameter file"
    yield from found.rover.text([]).rstrip().splitlines()
    yield ""
    yield "MOOS-IvP"
    yield from found.moos.text([]).rstrip().splitlines()


def _steps(loop: Loop) -> Iterator[str]:
    for step in loop.steps:
        over, settled = step.overshoot, step.settled
        times = [np.median(settled), np.quantile(settled, 0.95, method="higher")]
        shown = [f"{each:.1f}" if math.isfinite(each) else "–" for each in times]
        step_text = f"{step.before:.2f} → {step.after:.2f}"
        over_text = f"{100 * np.median(over):.0f} % ({100 * np.quantile(over, 0.95):.0f} %)"
        settled_text = f"{shown[0]} s ({shown[1]} s)"
        yield (
            f"  {loop.name:<10} {step_text:>14} {over_text:>16} {settled_text:>22} "
            f"{int(np.isfinite(settled).sum()):>6} of {len(settled)} {int(step.sways.sum()):>6}"
        )
