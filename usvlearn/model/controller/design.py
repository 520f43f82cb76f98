"""Designs the speed controller of one identified boat, and describes it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from textwrap import wrap
from typing import Any, NamedTuple

import numpy as np
from rich.text import Text

from usvlearn.core.events import NINETY
from usvlearn.display.json_values import finite
from usvlearn.display.terminal import Blocks
from usvlearn.errors import ConfigError, check_positive, printable
from usvlearn.estimators.joint.curves import Curve
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.model.controller.closed_loop import (
    ROVER_PERIOD,
    Moos,
    MoosLaw,
    Rover,
    RoverLaw,
    Step,
    draws,
    rover_text,
    simulate,
    steps_of,
)
from usvlearn.model.controller.gains import Feedforward, Gains, Linearised, Margins, design, force, late_of, linearised
from usvlearn.model.controller.steering import Steering, Trial, steering, trials
from usvlearn.model.controller.steering import parts as parts_of_steering
from usvlearn.model.read_boats import IdentifiedBoat

POINTS, MOST_BOATS = 9, 5000  # operating speeds; boats of the closed loop
LOWEST, HIGHEST = 0.25, 0.9  # of the greatest speed; of the lower end of its interval
SPARE = 1.3  # of the integral's limit, over what the feedforward errs
LEAST_INTEGRAL = 0.1
OVERSHOOT, TRIED = 0.2, 50  # of 95 % of so many boats: ArduRover's limits of acceleration are lowered until then
SHARES = (1.0, 0.7, 0.5, 0.35, 0.25)  # shares of the accelerations that can be held
PERIOD = 0.2  # s, of a loop, at most: ArduRover keeps it easily, and pMarinePID at 45 Hz
LEAST_ACCELERATION = 0.02  # m/s²: 0 would switch the limit off
HOLD = 15.0  # time constants between two steps
BOUNDS = {"speed": (0.01, 50.0), "bandwidth": (0.01, 50.0), "damping": (0.1, 10.0), "period": (0.01, 2.0)}  # m/s … s
LEAST_RANGE = 0.05  # m/s
TITLES = "ArduRover, a parameter file", "MOOS-IvP, a block of the mission file", "PX4, a parameter file"  # of `files`


class Wanted(NamedTuple):
    """Options; None: a default from what was identified."""

    speed: float | None = None  # cruise speed, m/s
    range: tuple[float, float] | None = None  # of operating speeds, m/s
    bandwidth: float | None = None  # rad/s
    damping: float | None = None
    period: float | None = None  # s, of the control loop
    delay: float | None = None  # s, from the measured speed to the thrust, without the loop's own
    boats: int = 200
    seed: int = 0


class Controller(NamedTuple):
    """The speed controller of a boat."""

    boat: IdentifiedBoat
    feedforward: Feedforward
    speeds: np.ndarray  # (points,) operating speeds, m/s
    linear: Linearised
    late: float  # s, of the commands
    period: float  # s, of the control loop
    gains: Gains
    margins: Margins
    acceleration: Curve  # m/s² at full command, over the speed
    deceleration: Curve  # m/s² with both thrusters off, over the speed
    rover: Rover
    moos: Moos
    loops: dict[str, list[Step]]  # over drawn boats, by autopilot
    steering: Steering | str  # or why there is none
    trials: list[Trial]  # of the steering

    @property
    def delay(self) -> float:
        """L, s: of the commands, and half of a period of the loop, for which a command is held."""
        return self.late + self.period / 2

    @property
    def ardurover(self) -> dict[str, tuple[float, str]]:
        """Value and comment of its parameters, by name."""
        return self.rover.parameters() | ({} if isinstance(self.steering, str) else self.steering.ardurover())


def controller(boat: IdentifiedBoat, wanted: Wanted | None = None, fit: Identified | None = None) -> Controller:
    """Design it, and sail it on boats drawn from the intervals; a fit, by default its own, tells the turning."""
    wanted = wanted or Wanted()
    for option in ("speed", "bandwidth", "damping", "period"):
        if (value := getattr(wanted, option)) is not None:
            check_positive(f"--{option}", value)
            least, most = BOUNDS[option]
            if not least <= value <= most:
                raise ConfigError(f"--{option}: found {value:g}, expected {least:g} to {most:g}")
    if wanted.seed < 0:
        raise ConfigError(f"--seed: found {wanted.seed}, expected 0 or more")
    if not 2 <= wanted.boats <= MOST_BOATS:
        raise ConfigError(f"--boats: found {wanted.boats}, expected 2 to {MOST_BOATS}")
    name, identified = boat.name, boat.identified
    forward = Feedforward.of(name, identified)
    low, high = _range(name, forward, wanted)
    speeds = np.linspace(low, high, POINTS)
    linear = linearised(name, identified, forward.at(speeds))
    before, late, spread = late_of(name, identified, boat.setup, wanted.delay)
    most = max(late + NINETY * spread, 0.0)
    logged = boat.setup.command_period if boat.setup else None
    period = wanted.period or min(max(logged or PERIOD, ROVER_PERIOD), PERIOD)
    gains, left = design(name, linear, most + period / 2, wanted.bandwidth, wanted.damping)
    cruise = wanted.speed if wanted.speed is not None else (low + high) / 2
    up, down = (force(identified, speeds, full) for full in (1.0, 0.0))
    theta = draws(identified, wanted.boats, wanted.seed)
    normal = np.random.default_rng([wanted.seed, 1]).standard_normal(len(theta))
    delays = np.maximum(late + spread * normal, 0.0)
    course = [low, cruise, high, low] if low < cruise < high else [low, high, low]
    hold = HOLD * max(float(linear.time_constant.high.max()), 1 / left.crossover[0])

    rover = _rover(forward, speeds, cruise, gains, up, down)
    hold += (high - low) / (SHARES[-1] * min(rover.acceleration, rover.deceleration))

    def loop(law: RoverLaw | MoosLaw, boats: int = wanted.boats) -> list[Step]:
        return steps_of(simulate(identified.ahead(theta[:boats]), delays[:boats], law, course, hold))

    for share in SHARES:  # ArduRover's base is a straight line, and acts before the boat follows
        slower = rover._replace(acceleration=share * rover.acceleration, deceleration=share * rover.deceleration)
        if _overshoot(loop(RoverLaw(slower, period), TRIED)) <= OVERSHOOT:
            break
    rover, moos = slower, Moos.of(gains.proportional, gains.integral, rover.slope, period)
    loops = {"ArduRover": loop(RoverLaw(rover, period)), "MOOS-IvP": loop(MoosLaw(moos))}
    steer = steering(identified if fit is None else fit, speeds, forward.at(speeds), cruise, before, period, moos.tick)
    sailed = [] if isinstance(steer, str) else trials(steer, before, period, moos.tick, wanted.seed)
    return Controller(
        boat, forward, speeds, linear, most, period, gains, left, up, down, rover, moos, loops, steer, sailed
    )


def _overshoot(steps: list[Step]) -> float:
    """The greatest of all steps, of 95 % of the boats."""
    return max(float(np.quantile(step.overshoot, 0.95)) for step in steps)


def _range(name: str, forward: Feedforward, wanted: Wanted) -> tuple[float, float]:
    """The least and the greatest operating speed."""
    if wanted.range is not None:
        low, high = wanted.range
        if not low + LEAST_RANGE <= high:
            raise ConfigError(
                f"--range: found {low:g} {high:g}, expected two speeds, m/s, the lower one first, {LEAST_RANGE:g} apart"
            )
        for speed in wanted.range:
            forward.check(name, "--range", speed)
    else:
        low, high = max(LOWEST * forward.top[0], forward.least[0]), HIGHEST * forward.top[1]
        if not low < high:
            raise ConfigError(
                f"{name}: the greatest speed, {forward.top[0]:.2f} m/s ({forward.top[1]:.2f} … {forward.top[2]:.2f}), "
                "is not known well enough: sail straight ahead at full command for 2 min, and learn from that log, too"
            )
    if wanted.speed is not None:
        forward.check(name, "--speed", wanted.speed)
        if wanted.range is None:
            low, high = min(low, wanted.speed), max(high, wanted.speed)
    return low, high


def _rover(forward: Feedforward, speeds: np.ndarray, cruise: float, gains: Gains, up: Curve, down: Curve) -> Rover:
    throttle = max(1.0, round(100 * float(forward.at(cruise))))
    errors = [np.abs(each - throttle / 100 / cruise * speeds) for each in (forward.at(speeds), *forward.band(speeds))]
    most = min(1.0, max(LEAST_INTEGRAL, math.ceil(100 * SPARE * float(np.max(errors))) / 100))
    ends = (max(LEAST_ACCELERATION, float(np.interp(cruise, speeds, each.low))) for each in (up, down))
    return Rover(cruise, throttle, gains.proportional, gains.integral, most, *ends)


def files(design: Controller) -> dict[str, str]:
    """What is written for the autopilots, by the ends of the files' names."""
    steer, top = design.steering, head(design)
    written = {".param": rover_text(design.ardurover, top), "_pid.moos": design.moos.text(top)}
    if isinstance(steer, str):
        return written
    lines = [f"1\t1\t{name}\t{value:.6g}\t9" for name, value in steer.px4().items()]
    written["_px4.params"] = "\n".join([*(f"# {line}" for line in top), *lines, ""])
    return written | {"_pid.moos": design.moos.text(top, steer.moos)}


def facts(design: Controller) -> dict[str, Any]:
    """As JSON values, with units in the names."""

    def curve(each: Curve) -> dict[str, list[float]]:
        return dict(zip(("value", "low", "high"), np.round(each[1:], 6).tolist(), strict=True))

    forward, left, steer = design.feedforward, design.margins, design.steering
    low, high = forward.band(design.speeds)
    values = {
        "boat": design.boat.name,
        "set": design.boat.path.name,
        "basis": design.boat.identified.basis,
        "lacks": list(design.boat.lacks),
        "feedforward": {
            **dict(zip(("command", "speed_m_s", "low_m_s", "high_m_s"), np.round(forward, 5).tolist(), strict=True)),
            "least_speed_m_s": forward.least[0],
            "top_speed_m_s": dict(zip(("value", "low", "high"), forward.top, strict=True)),
        },
        "operating": {
            "speed_m_s": np.round(design.speeds, 5).tolist(),
            "command": {"value": forward.at(design.speeds).tolist(), "low": low.tolist(), "high": high.tolist()},
            "time_constant_s": curve(design.linear.time_constant),
            "gain_m_s2": curve(design.linear.gain),
            "full_acceleration_m_s2": curve(design.acceleration),
            "coasting_deceleration_m_s2": curve(design.deceleration),
        },
        "delay_s": design.delay,
        "period_s": design.period,
        "gains": {
            "proportional_per_m_s": design.gains.proportional,
            "integral_per_m": design.gains.integral,
            "bandwidth_rad_s": design.gains.bandwidth,
            "damping": design.gains.damping,
        },
        "worst_margins": {
            "gain_db": left.gain,
            "phase_deg": left.phase,
            "delay_s": left.delay,
            "bandwidth_rad_s": left.bandwidth,
            "crossover_rad_s": left.crossover,
        },
        "steering": steer
        if isinstance(steer, str)
        else {
            "speed_m_s": steer.speed,
            "delay_s": steer.delay,
            "moos": steer.moos._asdict(),
            "px4": steer.px4(),
            "heading_rms_deg": {f"{x.autopilot} {x.gains}": float(np.median(x.rms)) for x in design.trials},
        },
        "ardurover": {name: value for name, (value, _) in design.ardurover.items()},
        "moos": design.moos._asdict(),
        "closed_loop": {
            name: [
                {
                    "from_m_s": step.before,
                    "to_m_s": step.after,
                    "boats": len(step.settled),
                    "overshoot_median": float(np.median(step.overshoot)),
                    "overshoot_95": float(np.quantile(step.overshoot, 0.95)),
                    "settled_within_5_percent": int(np.isfinite(step.settled).sum()),
                    "settling_median_s": float(np.median(step.settled)),
                    "settling_95_s": float(np.quantile(step.settled, 0.95, method="higher")),
                    "unstable": int(step.sways.sum()),
                }
                for step in steps
            ]
            for name, steps in design.loops.items()
        },
    }
    return finite(values)


def head(design: Controller) -> list[str]:
    """The lines above the parameters in a file, ASCII only."""
    gains, left, speeds = design.gains, design.margins, design.speeds
    name, file = design.boat.name, design.boat.path.name
    return [
        printable(f"{name}: speed and steering by usvlearn controller, from {file}")
        .encode("ascii", "replace")
        .decode(),
        f"for {speeds[0]:.2f} to {speeds[-1]:.2f} m/s, a loop of {design.period:g} s or faster, and "
        f"{design.late:.2f} s of delay of the commands",
        f"speed: poles at {gains.bandwidth:.2f} rad/s with damping {gains.damping:.2f}; worst margins over the 90 % "
        f"intervals: {_decibels(left.gain)}, {left.phase:.0f} deg",
        *(line for each in design.boat.guessed for line in wrap(each.encode("ascii", "replace").decode(), 90)),
        "throttle or thrust must be in proportion to the command that was learned (ArduRover: MOT_THST_EXPO 0)",
    ]


def parts(design: Controller) -> Iterator[str | Text | Blocks]:
    """All of it, for a terminal: sentences, tables, and lines of files, which are not broken."""
    yield printable(f"{design.boat.name}: speed and steering from {design.boat.path.name}")
    yield from (design.boat.identified.basis, *design.boat.lacks, "")
    yield from _feedforward(design)
    yield ""
    yield from _gains(design)
    yield ""
    yield from _closed_loop(design)
    yield ""
    yield from parts_of_steering(design.steering, design.trials)
    for title, text in zip(TITLES, files(design).values(), strict=False):  # without steering none of PX4
        yield from ("", title)
        yield from (Text(line.expandtabs(2)) for line in text.splitlines() if line[:1] != "#" and line[:2] != "//")


def _feedforward(design: Controller) -> Iterator[str | Blocks]:
    forward, speeds = design.feedforward, design.speeds
    table = Blocks(
        "Feedforward: the command of both sides that holds a speed, straight ahead, in brackets 90 % intervals",
        ["speed, m/s"],
        ["command, %", "ArduRover, %", "time constant, s", "gain, m/s²"],
    )
    low, high = forward.band(speeds)
    T, b = design.linear
    for k in range(0, len(speeds), 2):
        table.add(
            f"{speeds[k]:.2f}", f"{100 * forward.at(speeds[k]):.0f} ({100 * low[k]:.0f} … {100 * high[k]:.0f})",
            f"{100 * design.rover.slope * speeds[k]:.0f}",
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
        for each in (design.acceleration, design.deceleration)
    )
    yield f"Full command accelerates by {accelerates}."
    yield f"Without thrust drag slows by {slows}."


def _gains(design: Controller) -> Iterator[str]:
    gains, left = design.gains, design.margins
    yield "Gains: command = base + P e + I ∫e dt, e = wanted − measured speed in m/s, command 1 = full"
    yield f"P = {gains.proportional:.3f} per m/s    I = {gains.integral:.3f} per m"
    yield f"base = {design.rover.slope:.3f} per m/s × wanted speed (ArduRover)"
    yield (
        f"Poles at {gains.bandwidth:.2f} rad/s with damping {gains.damping:.2f}. Delay of {design.delay:.2f} s: "
        f"{design.late:.2f} s of the commands (upper end of its interval), and half of the loop's period of "
        f"{design.period:g} s. A faster loop is safe."
    )
    if design.period > ROVER_PERIOD:
        yield f"ArduRover's own loop takes {ROVER_PERIOD:g} s: --period {ROVER_PERIOD:g} gives faster gains for it."
    yield (
        f"Worst over the corners of the 90 % intervals: gain margin {_decibels(left.gain)}, phase margin "
        f"{left.phase:.0f}°, {left.delay:.2f} s more delay."
    )
    yield f"Closed-loop bandwidth (−3 dB): {left.bandwidth[0]:.2f} … {left.bandwidth[1]:.2f} rad/s."


def _closed_loop(design: Controller) -> Iterator[str | Blocks]:
    rover = design.loops["ArduRover"]
    count = len(rover[0].settled)
    table = Blocks(
        f"Closed loop on {count} boats drawn from the intervals: median, and in brackets the 95 % quantile",
        ["autopilot", "step, m/s"],
        ["overshoot", "settled to ±5 %", "boats settled", "unstable"],
    )
    for name, steps in design.loops.items():
        for step in steps:
            over, settled = step.overshoot, step.settled
            times = (np.median(settled), np.quantile(settled, 0.95, method="higher"))
            middle, most = (f"{each:.1f} s" if math.isfinite(each) else "–" for each in times)
            table.add(
                name, f"{step.before:.2f} → {step.after:.2f}",
                f"{100 * np.median(over):.0f} % ({100 * np.quantile(over, 0.95):.0f} %)", f"{middle} ({most})",
                f"{np.isfinite(settled).sum()} of {len(settled)}", f"{int(step.sways.sum())}",
            )  # fmt: skip
    yield table
    yield (
        "Overshoot is a share of the step. ArduRover's base acts at once, so that what the integral collects while "
        "the boat speeds up is undone by an overshoot; ATC_ACCEL_MAX and ATC_DECEL_MAX limit it."
    )
    if (worst := _overshoot(rover)) > OVERSHOOT:
        yield (
            f"{100 * worst:.0f} % is more than the {100 * OVERSHOOT:.0f} % that was aimed at: the base is a straight "
            "line, and the boat's curve is not. A narrower --range helps, or a faster loop (--period)."
        )


def _decibels(gain: float) -> str:
    return f"{gain:.1f} dB" if math.isfinite(gain) else "infinite"
