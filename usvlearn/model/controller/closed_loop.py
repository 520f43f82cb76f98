"""The closed loop over boats that are drawn from what was identified: a sampled controller, late commands, saturation.

Each boat has parameters θ ~ N(θ̄, C) and its own delay. It moves straight ahead, by the step of `usvlearn.model.surge`.
The controller has the forms of ArduRover and of MOOS-IvP: their laws, parameters and files.

ArduRover, with w the wanted speed after its limits of acceleration, and s = CRUISE_THROTTLE/100/CRUISE_SPEED:

    throttle = s w + ATC_SPEED_FF w + ATC_SPEED_P e + I,   I ← I + ATC_SPEED_I e dt within ±ATC_SPEED_IMAX      (1)

throttle is −1 … 1. While it is limited, I only shrinks. ATC_SPEED_FF is added to s, and therefore 0.

MOOS-IvP's pMarinePID adds the output of its PID to the last thrust, in % of full thrust, at each of its iterations,
whose period is h = 1/AppTick. The derivative is the mean of the last nine differences:

    thrust ← thrust + speed_pid_kp e + speed_pid_kd (e_k − e_(k−9))/(9 h)                                     (2)

(2) sums up to k_p and k_i of a PI controller with speed_pid_kd = 100 k_p h and speed_pid_kp = 100 k_i h. A speed_pid_ki
would integrate twice, and is 0. With speed_factor > 0 there is no PID: thrust = speed_factor times the wanted speed.

Steering is that of (3) and (4), with the wanted heading ψ_w, the yaw rate r and the errors e of heading and yaw rate.
ArduRover limits r_w and its change; in AUTO it is the path's yaw rate + PSC_VEL_P sin e:

    r_w = ATC_STR_ANG_P e,   steering = ATC_STR_RAT_FF r_w + ATC_STR_RAT_P (r_w − r) + I              (3)
    rudder = yaw_pid_kp e + yaw_pid_kd (e_k − e_(k−9))/(9 h) + I,   I ← I + yaw_pid_ki e h within its limit  (4)

Sources: ArduPilot, AR_AttitudeControl and AC_PID, "Tuning Speed and Throttle" of the Rover's manual; MOOS-IvP,
lib_marine_pid.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from usvlearn.errors import ConfigError
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.estimators.joint.quantities import Ahead

STEP = 0.05  # s, longest of the simulation
BAND = 0.05  # of a step of the wanted speed: settled within it
SWAY = 0.1  # of a step, peak to peak in its last quarter: unstable
TRIALS = 50  # draws for each boat that is wanted


class Responses(NamedTuple):
    """The closed loop over time."""

    time: np.ndarray  # (steps,) s
    wanted: np.ndarray  # (steps,) m/s
    speed: np.ndarray  # (steps, boats) m/s


class Step(NamedTuple):
    """How the boats follow one step of the wanted speed."""

    before: float  # m/s
    after: float
    overshoot: np.ndarray  # (boats,) share of the step
    settled: np.ndarray  # (boats,) s; infinite where the speed is not within `BAND` at the end
    sways: np.ndarray  # (boats,) bool: unstable


def draws(identified: Identified, count: int, seed: int = 0) -> np.ndarray:
    """Parameters of boats, `(count, m)`: the mean, the present estimate, and draws in which drag brakes."""
    beside = identified.beside
    assert beside is not None
    values, vectors = np.linalg.eigh(identified.covariance)
    normal = np.random.default_rng(seed).standard_normal((TRIALS * count, len(identified.theta)))
    every = identified.theta + (normal * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    every = np.concatenate([identified.theta[None], beside.now[None], every])
    boat = identified.ahead(every)
    with np.errstate(invalid="ignore"):
        speeds = boat.steady_speed(1.0)
        real = boat.brakes & np.isfinite(speeds) & (speeds > 0)
    if real.sum() < count:
        raise ConfigError(
            "--boats: found hardly any boat in the intervals, in which drag brakes: learn from a longer log"
        )
    return every[real][:count]


def simulate(
    boat: Any, delay: np.ndarray, law: Any, wanted: Sequence[float] | np.ndarray, hold: float,
    step: Callable[..., np.ndarray] | None = None, start: np.ndarray | float = 0.0,
) -> Responses:  # fmt: skip
    """Boats whose commands act after a delay, s, `(boats,)`, and which are to have some speeds, m/s, or headings, rad.

    Each is wanted for `hold` s. `step` makes the state h s later, of a boat, a state, commands and h. The state is
    `(boats,)`, or `(…, boats)` of which the first row is controlled.
    """
    step = step or ahead_step
    boats = len(delay)
    substeps = math.ceil(law.period / STEP)
    h = law.period / substeps
    late = np.rint(np.clip(delay, 0.0, None) / h).astype(int)
    ticks = math.ceil(hold / law.period)
    law.start(boats)
    total = ticks * len(wanted) * substeps
    time, target = h * np.arange(1, total + 1), np.repeat(np.asarray(wanted, float), ticks * substeps)
    sent, speed, v = np.zeros((total, boats)), np.zeros((total, boats)), np.zeros(boats) + start
    column = np.arange(boats)
    for k in range(total):
        if k % substeps == 0:
            given = law.command(float(target[k]), v)
        sent[k] = given
        place = k - late
        xi = np.where(place >= 0, sent[np.maximum(place, 0), column], 0.0)
        v = step(boat, v, xi, h)
        speed[k] = v if v.ndim == 1 else v[0]
    return Responses(time, target, speed)


def ahead_step(boat: Ahead, v: np.ndarray, xi: np.ndarray, h: float) -> np.ndarray:
    """The speeds h s later, m/s, `(boats,)`, under the same command on both sides, 0 … 1."""
    f, slope = boat.motion(v, xi)
    z = np.minimum(h * slope, 1.0)
    small = np.abs(z) < 1e-8
    return v + h * f * np.where(small, 1.0, np.expm1(z) / np.where(small, 1.0, z))


def steps_of(responses: Responses) -> list[Step]:
    """How the boats follow each step of the wanted speed after the first, which begins at rest."""
    changes = np.flatnonzero(np.diff(responses.wanted)) + 1
    edges = [*changes.tolist(), len(responses.wanted)]
    steps = []
    for begin, end in pairwise(edges):
        before, after = float(responses.wanted[begin - 1]), float(responses.wanted[begin])
        course = (responses.speed[begin:end] - before) / (after - before)  # 0 … 1
        outside = np.abs(course - 1) > BAND
        last = len(course) - 1 - outside[::-1].argmax(0)
        time = responses.time[begin:end] - responses.time[begin - 1]
        settled = np.where(outside.any(0), time[np.minimum(last + 1, len(course) - 1)], 0.0)
        late = course[3 * len(course) // 4 :]
        over, sways = np.maximum(course.max(0) - 1, 0.0), ~(np.ptp(late, axis=0) <= SWAY)
        steps.append(Step(before, after, over, np.where(outside[-1], np.inf, settled), sways))
    return steps


DIFFERENCES = 9  # of (2)
LEAST_TICK, MOST_TICK = 4, 50  # Hz
ROVER_PERIOD = 0.02  # s, of ArduRover's loop


class Rover(NamedTuple):
    """Parameters of ArduRover."""

    cruise_speed: float  # m/s
    cruise_throttle: float  # %, whole
    proportional: float  # per m/s
    integral: float  # per m/s and s
    integral_most: float  # share of full throttle
    acceleration: float  # m/s²
    deceleration: float  # m/s²

    @property
    def slope(self) -> float:
        """s of (1), per m/s."""
        return self.cruise_throttle / 100 / self.cruise_speed

    def parameters(self) -> dict[str, tuple[float, str]]:
        """Value and comment by name, as they are written."""
        return {
            "CRUISE_SPEED": (round(self.cruise_speed, 3), "m/s"),
            "CRUISE_THROTTLE": (self.cruise_throttle, "%: base = CRUISE_THROTTLE/CRUISE_SPEED x wanted speed"),
            "ATC_SPEED_FF": (0.0, "would be added to the base throttle, which does its work"),
            "ATC_SPEED_P": (round(self.proportional, 4), "throttle (-1 ... 1) per m/s of error"),
            "ATC_SPEED_I": (round(self.integral, 4), "throttle per m/s of error and s"),
            "ATC_SPEED_D": (0.0, "throttle per m/s2"),
            "ATC_SPEED_IMAX": (round(self.integral_most, 3), "greatest throttle of the integral, 0 ... 1"),
            "ATC_SPEED_FLTT": (0.0, "Hz; 0: the wanted speed is not filtered"),
            "ATC_SPEED_FLTE": (10.0, "Hz; the default"),
            "ATC_ACCEL_MAX": (round(self.acceleration, 3), "m/s2; what full throttle can hold at the cruise speed"),
            "ATC_DECEL_MAX": (round(self.deceleration, 3), "m/s2; what drag alone can hold at the cruise speed"),
            "ATC_BRAKE": (0.0, "no thrust astern to brake: the controller was designed ahead only"),
        }


def rover_text(parameters: Mapping[str, tuple[float, str]], head: list[str]) -> str:
    """A parameter file, NAME,VALUE lines."""
    lines = [f"{name},{value:g}  # {comment}" for name, (value, comment) in parameters.items()]
    return "\n".join([*(f"# {line}" for line in head), *lines, ""])


class RoverLaw:
    """(1), sampled."""

    def __init__(self, rover: Rover, period: float):  # s
        self.rover, self.period = rover, period

    def start(self, boats: int) -> None:
        self.wanted, self.integral, self.limited = 0.0, np.zeros(boats), np.zeros(boats, bool)

    def command(self, wanted: float, speed: np.ndarray) -> np.ndarray:
        rover, h = self.rover, self.period
        self.wanted += min(max(wanted - self.wanted, -rover.deceleration * h), rover.acceleration * h)
        error = self.wanted - speed
        free = ~self.limited | (self.integral * error < 0)
        most = rover.integral_most
        self.integral = np.where(free, np.clip(self.integral + rover.integral * error * h, -most, most), self.integral)
        throttle = rover.slope * self.wanted + rover.proportional * error + self.integral
        self.limited = (throttle <= 0) | (throttle >= 1)
        return np.clip(throttle, 0.0, 1.0)


class Moos(NamedTuple):
    """Parameters of pMarinePID and pMarinePIDV22."""

    kp: float
    kd: float
    speed_factor: float  # of the alternative without PID, % per m/s
    tick: int  # Hz
    period: float  # s, for which the gains were designed

    @classmethod
    def of(cls, proportional: float, integral: float, slope: float, period: float) -> Moos:
        """From the gains as shares of full command.

        The nine differences are on average four iterations old, and a thrust is held for half an iteration more. The
        tick is such that this is no later than half of the period for which the gains were designed.
        """
        tick = min(max(math.ceil(DIFFERENCES / period), LEAST_TICK), MOST_TICK)
        return cls(100 * integral / tick, 100 * proportional / tick, 100 * slope, tick, period)

    @property
    def late(self) -> float:
        """Mean delay of (2), s."""
        return (DIFFERENCES / 2) / self.tick

    def text(self, head: list[str], yaw: MoosYaw | None = None) -> str:
        """The lines of a configuration block."""
        entries = [
            (f"AppTick = {self.tick}", "Hz; the gains hold for this AppTick only"),
            (f"CommsTick = {self.tick}", ""),
            ("speed_factor = 0", "0: PID. Above 0 there is none, and thrust in"),
            ("", f"% = speed_factor x DESIRED_SPEED; {self.speed_factor:.3g} holds"),
            ("", "the cruise speed"),
            (f"speed_pid_kp = {self.kp:.4g}", "% of thrust per m/s of error, added at each"),
            ("", "iteration: the integral part"),
            (f"speed_pid_kd = {self.kd:.4g}", "% of thrust per m/s2, added at each"),
            ("", "iteration: the proportional part"),
            ("speed_pid_ki = 0", "the thrust is a sum already: this would"),
            ("", "integrate twice"),
            ("speed_pid_integral_limit = 0", "% of thrust, of speed_pid_ki"),
            ("maxthrust = 100", "%: full command on both sides"),
        ]
        if yaw is not None:
            entries += [
                (f"yaw_pid_kp = {yaw.kp:.4g}", "% of rudder per degree"),
                (f"yaw_pid_kd = {yaw.kd:.4g}", "% of rudder per degree/s"),
                (f"yaw_pid_ki = {yaw.ki:.4g}", "% of rudder per degree and s"),
                (f"yaw_pid_integral_limit = {yaw.limit:g}", "% of rudder"),
                ("maxrudder = 100", "%: left = thrust + rudder, right = thrust -"),
                ("", "rudder"),
            ]
        others = "yaw and depth" if yaw is None else "depth"
        lines = [f"  {entry:<30}{'// ' + comment if comment else ''}".rstrip() for entry, comment in entries]
        top = [f"// {line}" for line in head]
        if self.late > self.period / 2 + 1e-9:
            top.append(
                f"// the mean of nine differences is {self.late:.2f} s late, which these gains do not allow for:"
            )
            top.append(f"// design them with --period {2 * self.late:.2g}")
        return "\n".join(
            [*top, "ProcessConfig = pMarinePIDV22", "{", *lines, f"  // keep your own lines for {others}", "}", ""]
        )


class MoosLaw:
    """(2), sampled; a negative thrust is not sent."""

    def __init__(self, moos: Moos):
        self.moos, self.period = moos, 1 / moos.tick

    def start(self, boats: int) -> None:
        self.thrust, self.before, self.begun = np.zeros(boats), np.zeros(boats), False
        self.slopes: list[np.ndarray] = []

    def command(self, wanted: float, speed: np.ndarray) -> np.ndarray:
        error = wanted - speed
        out = np.clip(self.moos.kp * error + self.moos.kd * self.slope(error), -100.0, 100.0)
        self.thrust = np.clip(self.thrust + out, 0.0, 100.0)
        return self.thrust / 100

    def slope(self, error: np.ndarray) -> np.ndarray | float:
        """The mean of the last differences."""
        if self.begun:
            self.slopes = [(error - self.before) / self.period, *self.slopes][:DIFFERENCES]
        self.before, self.begun = error, True
        return np.mean(self.slopes, axis=0) if self.slopes else 0.0


class MoosYaw(NamedTuple):
    """Parameters of the heading's PID of pMarinePIDV22, in % of full rudder."""

    kp: float  # per deg
    kd: float  # per deg/s
    ki: float  # per deg and s
    limit: float  # of the integral


class MoosYawLaw(MoosLaw):
    """(4), sampled."""

    def __init__(self, yaw: MoosYaw, tick: int):
        self.yaw, self.period = yaw, 1 / tick

    def command(self, wanted: float, x: np.ndarray) -> np.ndarray:
        error, yaw = np.degrees(wanted - x[0]), self.yaw
        self.thrust = np.clip(self.thrust + yaw.ki * error * self.period, -yaw.limit, yaw.limit)  # the integral
        return np.clip(yaw.kp * error + yaw.kd * self.slope(error) + self.thrust, -100.0, 100.0) / 100


class Cascade(NamedTuple):
    """A PI controller of the yaw rate inside a P controller of the heading, as ArduRover and PX4 have them."""

    feedforward: float  # share of full steering per rad/s
    proportional: float  # likewise
    integral: float  # per rad
    angle: float  # 1/s
    rate: float  # rad/s, limit
    acceleration: float  # rad/s², limit


class CascadeLaw:
    """(3), sampled each `period`, s, around a base of both sides: where it leaves no more, the integral only shrinks.

    In the form of PX4, the wanted heading changes no faster than the limit of the yaw rate.
    """

    def __init__(self, cascade: Cascade, period: float, base: float, px4: bool = False):
        self.own, self.period, self.base, self.px4 = cascade, period, base, px4
        self.auto: float | None = None  # gain of the heading in AUTO, where the wanted yaw rate is known

    def start(self, boats: int) -> None:
        self.goal, self.turn, self.integral = np.zeros(boats), np.zeros(boats), np.zeros(boats)
        self.limited, self.last = np.zeros(boats, bool), 0.0

    def command(self, wanted: float, x: np.ndarray) -> np.ndarray:
        cascade, h, (heading, r) = self.own, self.period, x[:2]
        goal = self.goal + np.clip(wanted - self.goal, -cascade.rate * h, cascade.rate * h)
        slow = self.px4 & (np.abs(goal - heading) <= np.abs(wanted - heading))
        self.goal = np.where(slow, goal, wanted)
        error = self.goal - heading
        if self.px4:
            turn = np.clip(cascade.angle * error, -cascade.rate, cascade.rate)
        elif self.auto is not None:
            turn = (wanted - self.last) / h + self.auto * np.sin(error)
        else:
            stop = np.sqrt(2 * cascade.acceleration * np.abs(error))
            turn = np.clip(cascade.angle * error, -stop, stop)
        self.last = wanted
        change = np.clip(turn - self.turn, -cascade.acceleration * h, cascade.acceleration * h)
        self.turn = np.clip(self.turn + change, -cascade.rate, cascade.rate)
        error = self.turn - r
        free = ~self.limited | (self.integral * error < 0)
        self.integral = np.where(free, np.clip(self.integral + cascade.integral * error * h, -1, 1), self.integral)
        out = cascade.feedforward * self.turn + cascade.proportional * error + self.integral
        self.limited = ~np.full(out.shape, self.px4) & (np.abs(out) >= 1 - self.base)
        return np.clip(out, -1, 1)
