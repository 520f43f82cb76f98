"""The speed controller of one identified boat: what is designed, and what is told of it."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.events import NINETY
from usvlearn.errors import ConfigError, check_positive
from usvlearn.estimators.joint.curves import Curve, banded
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.estimators.joint.quantities import SIDES
from usvlearn.logs.setup import Setup
from usvlearn.model.controller.autopilots import Moos, MoosLaw, Rover, RoverLaw
from usvlearn.model.controller.closed_loop import Law, Responses, Step, draws, simulate, steps_of
from usvlearn.model.controller.feedforward import Feedforward
from usvlearn.model.controller.gains import Gains, Linearised, Margins, design, linearised
from usvlearn.model.read_boats import IdentifiedBoat

POINTS, MOST_BOATS = 9, 5000  # operating speeds; boats of the closed loop
LOWEST, HIGHEST = 0.25, 0.9  # of the greatest speed; of the lower end of its interval
SPARE = 1.3  # of the integral's limit, over what the feedforward errs
LEAST_INTEGRAL = 0.1
OVERSHOOT, TRIED = 0.2, 50  # of 95 % of so many boats: ArduRover's limits of acceleration are lowered until then
SHARES = (1.0, 0.7, 0.5, 0.35, 0.25)  # shares of the accelerations that can be held
PERIOD = 0.2  # s, of a loop: ArduRover keeps it easily, and pMarinePID at 45 Hz
LEAST_ACCELERATION = 0.02  # m/s²: 0 would switch the limit off
HOLD = 15.0  # time constants between two steps
BOUNDS = {"speed": (0.01, 50.0), "bandwidth": (0.01, 50.0), "damping": (0.1, 10.0), "period": (0.01, 2.0)}  # m/s … s
LONGEST_DELAY, LEAST_RANGE = 10.0, 0.05  # s; m/s


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


class Loop(NamedTuple):
    """The closed loop over drawn boats under one autopilot."""

    name: str
    responses: Responses
    steps: list[Step]


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
    loops: tuple[Loop, ...]

    @property
    def delay(self) -> float:
        """L, s: of the commands, and half of a period of the loop, for which a command is held."""
        return self.late + self.period / 2


def controller(boat: IdentifiedBoat, wanted: Wanted | None = None) -> Controller:
    """Design it, and sail it on boats drawn from the intervals.

    Args:
        boat: as `usvlearn.model.read_boats.read_boats` returns it.
        wanted: options.

    Raises:
        ConfigError: the boat is not identified well enough, or an option is not legal.
    """
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
    name, found = boat.name, boat.found
    forward = Feedforward.of(name, found)
    low, high = _range(name, forward, wanted)
    speeds = np.linspace(low, high, POINTS)
    linear = linearised(name, found, forward.at(speeds))
    late, spread = _late(name, found, boat.setup, wanted.delay)
    period = PERIOD if wanted.period is None else wanted.period
    gains, left = design(name, linear, max(late + NINETY * spread, 0.0) + period / 2, wanted.bandwidth, wanted.damping)
    cruise = wanted.speed if wanted.speed is not None else (low + high) / 2
    up, down = (_force(found, speeds, full) for full in (1.0, 0.0))
    theta = draws(found, wanted.boats, wanted.seed)
    normal = np.random.default_rng([wanted.seed, 1]).standard_normal(len(theta))
    delays = np.maximum(late + spread * normal, 0.0)
    course = [low, cruise, high, low] if low < cruise < high else [low, high, low]
    hold = HOLD * max(float(linear.time_constant.high.max()), 1 / left.crossover[0])

    rover = _rover(forward, speeds, cruise, gains, up, down)
    hold += (high - low) / (SHARES[-1] * min(rover.acceleration, rover.deceleration))

    def loop(each: str, law: Law, boats: int = wanted.boats) -> Loop:
        responses = simulate(found.ahead(theta[:boats]), delays[:boats], law, course, hold)
        return Loop(each, responses, steps_of(responses))

    for share in SHARES:  # ArduRover's base is a straight line, and acts before the boat follows
        slower = rover._replace(acceleration=share * rover.acceleration, deceleration=share * rover.deceleration)
        tried = loop("ArduRover", RoverLaw(slower, period), TRIED)
        if max(float(np.quantile(step.overshoot, 0.95)) for step in tried.steps) <= OVERSHOOT:
            break
    rover, moos = slower, Moos.of(gains.proportional, gains.integral, rover.slope, period)
    loops = loop("ArduRover", RoverLaw(rover, period)), loop("MOOS-IvP", MoosLaw(moos))
    return Controller(
        boat, forward, speeds, linear, max(late + NINETY * spread, 0.0), period, gains, left, up, down, rover,
        moos, loops,
    )  # fmt: skip


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


def _dt(name: str, setup: Setup | None) -> float:
    if setup is None:
        raise ConfigError(f"{name}: the checkpoint does not tell the step of its samples: give --delay")
    return float(setup.align["dt"])


def _late(name: str, found: Identified, setup: Setup | None, given: float | None) -> tuple[float, float]:
    """How late the commands act, s, and the standard deviation: `delay` of the commands and of the speed, and the
    identified lag.
    """
    if given is not None:
        if not 0 <= given <= LONGEST_DELAY:
            raise ConfigError(f"--delay: found {given!r}, expected 0 to {LONGEST_DELAY:g} s")
        return given, 0.0
    dt = _dt(name, setup)
    assert setup is not None
    aligned = setup.aligned
    before = max(aligned[f"command_{side}"].delay for side in SIDES)
    late, deviation = found.lag(dt)
    return before + late, deviation


def _force(found: Identified, speeds: np.ndarray, command: float) -> Curve:
    """Acceleration at full command, or deceleration with both thrusters off, m/s²."""
    beside = found.beside
    assert beside is not None

    def force(theta: np.ndarray) -> np.ndarray:
        boat = found.ahead(theta[..., None, :])
        if command == 0:
            return boat.drag(speeds)
        return sum(boat.thrust(command, side) for side in SIDES) + boat.lift * command * speeds - boat.drag(speeds)

    return banded(found, beside, "acceleration", speeds, force)


def _rover(forward: Feedforward, speeds: np.ndarray, cruise: float, gains: Gains, up: Curve, down: Curve) -> Rover:
    throttle = max(1.0, round(100 * float(forward.at(cruise))))
    errors = [np.abs(each - throttle / 100 / cruise * speeds) for each in (forward.at(speeds), *forward.band(speeds))]
    most = min(1.0, max(LEAST_INTEGRAL, math.ceil(100 * SPARE * float(np.max(errors))) / 100))
    ends = (max(LEAST_ACCELERATION, float(np.interp(cruise, speeds, each.low))) for each in (up, down))
    return Rover(cruise, throttle, gains.proportional, gains.integral, most, *ends)


def facts(found: Controller) -> dict[str, Any]:
    """As JSON values, with units in the names."""

    def curve(each: Curve) -> dict[str, list[float]]:
        return {name: [round(float(x), 6) for x in getattr(each, name)] for name in ("value", "low", "high")}

    forward, left = found.feedforward, found.margins
    low, high = forward.band(found.speeds)
    return {
        "boat": found.boat.name,
        "set": found.boat.path.name,
        "basis": found.boat.found.basis,
        "lacks": list(found.boat.lacks),
        "feedforward": {
            "command": [round(float(x), 5) for x in forward.command],
            "speed_m_s": [round(float(x), 5) for x in forward.speed],
            "low_m_s": [round(float(x), 5) for x in forward.low],
            "high_m_s": [round(float(x), 5) for x in forward.high],
            "least_speed_m_s": forward.least[0],
            "top_speed_m_s": dict(zip(("value", "low", "high"), forward.top, strict=True)),
        },
        "operating": {
            "speed_m_s": [round(float(x), 5) for x in found.speeds],
            "command": {"value": forward.at(found.speeds).tolist(), "low": low.tolist(), "high": high.tolist()},
            "time_constant_s": curve(found.linear.time_constant),
            "gain_m_s2": curve(found.linear.gain),
            "full_acceleration_m_s2": curve(found.acceleration),
            "coasting_deceleration_m_s2": curve(found.deceleration),
        },
        "delay_s": found.delay,
        "period_s": found.period,
        "gains": {
            "proportional_per_m_s": found.gains.proportional,
            "integral_per_m": found.gains.integral,
            "bandwidth_rad_s": found.gains.bandwidth,
            "damping": found.gains.damping,
        },
        "worst_margins": {
            "gain_db": left.gain if math.isfinite(left.gain) else None,
            "phase_deg": left.phase,
            "delay_s": left.delay,
            "bandwidth_rad_s": list(left.bandwidth),
            "crossover_rad_s": list(left.crossover),
        },
        "ardurover": {name: value for name, (value, _) in found.rover.parameters().items()},
        "moos": found.moos._asdict(),
        "closed_loop": {
            loop.name: [
                {
                    "from_m_s": step.before,
                    "to_m_s": step.after,
                    "boats": len(step.settled),
                    "overshoot_median": float(np.median(step.overshoot)),
                    "overshoot_95": float(np.quantile(step.overshoot, 0.95)),
                    "settled_within_5_percent": int(np.isfinite(step.settled).sum()),
                    "settling_median_s": _finite(np.median(step.settled)),
                    "settling_95_s": _finite(np.quantile(step.settled, 0.95, method="higher")),
                    "unstable": int(step.sways.sum()),
                }
                for step in loop.steps
            ]
            for loop in found.loops
        },
    }


def _finite(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None
