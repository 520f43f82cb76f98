"""The steering of one identified boat: its turn-rate and heading loops, for ArduRover, MOOS-IvP and PX4.

The commands are base ± steering, and the boat turns as its batch fit says (`usvlearn.model.fit.turning`). At the speed
of the base dr/dt = −r/T + K/T steering, so that the PI controller of the yaw rate r is designed as that of a speed is.
The PID of a heading has it, too: the integral of the yaw rate's error is the heading's, kd is its P, and kp its I.
Equations: `docs/theory/identification.md#steering`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from usvlearn.core.events import NINETY
from usvlearn.display.terminal import Blocks
from usvlearn.estimators.axis.turning_intervals import HARDLY, on_log_scale
from usvlearn.estimators.joint.curves import Curve
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.model.controller.closed_loop import (
    DIFFERENCES,
    Cascade,
    CascadeLaw,
    MoosYaw,
    MoosYawLaw,
    Step,
    simulate,
    steps_of,
)
from usvlearn.model.controller.gains import GRID, Gains, Margins, design, worst
from usvlearn.model.fit import turning_kernel as at
from usvlearn.model.fit.boat import FittedBoat
from usvlearn.model.fit.turning import DEVIATION, STEP, SWAPPED, natural, push, rate

STEERING, GRAVITY = 0.1, 9.81  # share of full command, over which K is taken; m/s²
OWN_TIME, OWN_GAIN = 0.1, 0.05  # own errors of T and K, as of `usvlearn.model.fit.turning`
ASTERN = 0.15  # deviation of the logarithm of the thrust astern, below which it is known
EXPLAINED, WIDEST = 0.5, 4.0  # least share of the turns that the model explains; high over low of K
PHASE, GAIN, SLOWER = 60.0, 6.0, 0.95  # deg, dB: least margins of the heading loop; from one trial to the next
STEEP, SLUGGISH = 2.0, 0.05  # greatest K over that of the feedforward; least gain of the heading, 1/delay
SPARE = 0.8  # of the yaw rate and its change that the steering can hold: the limits
FILTER, HOLDS, MOST = 10.0, 40.0, 20.0  # Hz of ATC_STR_RAT_FLTE; the crossover over ki/kp; % of rudder, of ki
DESIGNED, BOATS = "designed", 50
DEFAULTS = Cascade(0.2, 0.2, 0.2, 2.0, math.radians(120), math.radians(120))  # of ArduRover
QUICKTUNE, AUTO = (0.9, 0.5), 1.0  # FF over 1/K, P and I over FF; default of PSC_VEL_P, 1/s
ALPHA = MoosYaw(1.2, 0.0, 0.3, 0.07)  # of MOOS-IvP's mission s1_alpha
LEGS, LONG = 4, 12.0  # of a lawn mower; a leg over the slowest time


class Yaw(NamedTuple):
    """The turning near some speeds, m/s, with 90 % intervals."""

    time_constant: Curve  # T, s
    gain: Curve  # K, rad/s of full steering
    greatest: Curve  # rad/s that the steering can hold; ahead alone, where thrust astern is not known

    @property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """As of `gains.Linearised`: −1/T and K/T."""
        T, K = self.time_constant, self.gain
        a = -1 / np.concatenate([T.low, T.low, T.high, T.high])
        return a, -a * np.concatenate([K.low, K.high, K.low, K.high])


class Trial(NamedTuple):
    """One autopilot with some gains, on drawn boats."""

    autopilot: str
    gains: str
    step: Step  # of a right angle
    rms: np.ndarray  # (boats,) deg, of the heading on a lawn mower


class Steering(NamedTuple):
    """The steering of a boat."""

    boat: FittedBoat
    yaw: Yaw
    speed: float  # m/s, at which the feedforward is true
    base: float  # command that holds it
    delay: float  # s
    margins: Margins  # of the yaw rate
    heading: Margins
    cascade: Cascade  # of ArduRover and PX4
    moos: MoosYaw

    def ardurover(self) -> dict[str, tuple[float, str]]:
        """Value and comment by name."""
        loop, lateral = self.cascade, self.speed * self.cascade.rate / GRAVITY
        return {
            "ATC_STR_RAT_FF": (round(loop.feedforward, 4), "steering (-1 ... 1) per rad/s"),
            "ATC_STR_RAT_P": (round(loop.proportional, 4), "steering per rad/s of error"),
            "ATC_STR_RAT_I": (round(loop.integral, 4), "steering per rad of error"),
            "ATC_STR_RAT_D": (0.0, "steering per rad/s2"),
            "ATC_STR_RAT_FLTT": (0.0, "Hz; 0: the wanted rate is limited, not filtered"),
            "ATC_STR_RAT_FLTE": (FILTER, "Hz; the default"),
            "ATC_STR_RAT_MAX": (round(math.degrees(loop.rate), 1), "deg/s that the boat holds at the cruise speed"),
            "ATC_STR_ACC_MAX": (round(math.degrees(loop.acceleration), 1), "deg/s2"),
            "ATC_STR_ANG_P": (round(loop.angle, 3), "deg/s per deg of heading"),
            "PSC_VEL_P": (round(loop.angle, 3), "the same in AUTO"),
            "TURN_RADIUS": (round(float(self.yaw.greatest.at[0] / self.yaw.greatest.low[0]), 2), "m, at low speed"),
            "ATC_TURN_MAX_G": (round(lateral, 3), "ATC_STR_RAT_MAX at the cruise speed"),
        }

    def px4(self) -> dict[str, float]:
        """Value by name. RD_WHEEL_TRACK makes the feedforward: boats have none."""
        loop, top = self.cascade, self.boat["steady_speed_full"].value
        rates = dict(zip(("RATE", "ACCEL", "DECEL"), np.degrees([loop.rate, *[loop.acceleration] * 2]), strict=True))
        return {
            "RO_YAW_RATE_P": loop.proportional, "RO_YAW_RATE_I": loop.integral, "RO_YAW_P": loop.angle,
            **{f"RO_YAW_{name}_LIM": float(value) for name, value in rates.items()},
            "RO_MAX_THR_SPEED": top, "RO_YAW_RATE_CORR": 1.0, "RD_WHEEL_TRACK": 2 * loop.feedforward * top,
        }  # fmt: skip


def yaw_of(boat: FittedBoat, speeds: np.ndarray, commands: np.ndarray) -> Yaw:
    """The turning at some speeds, m/s, that commands of both sides hold, `(points,)` each."""
    assert boat.turning is not None
    theta, P, _ = boat.turning
    u, m, steps = speeds / boat.top, at.PARAMETERS, STEP * np.diag(DEVIATION)
    most = np.minimum(1 - commands, 1.0 if P[at.ASTERN, at.ASTERN] < ASTERN**2 else commands)
    p = natural(theta + np.concatenate([np.zeros((1, m)), steps, -steps])).T[..., None]
    T = 1 / (p[at.D0] + p[at.D2] * u)
    slope = (push(p, commands + STEERING, u) - push(p, commands - STEERING, u)) / (2 * STEERING)
    K = T * (slope * (1 + p[at.SIDE]) + 2 * p[at.RUDDER] * u * u)
    held = (rate(p, commands + most, commands - most, u) - rate(p, commands - most, commands + most, u)) / 2
    curves = []
    for values, error in (T, OWN_TIME + SWAPPED * (p[at.LAG, 0] / T[0]) ** 2), (K, OWN_GAIN), (held, OWN_GAIN):
        slopes = (values[1 : m + 1] - values[m + 1 :]) / (2 * steps.diagonal()[:, None])
        errors = np.einsum("mk,mn,nk->k", slopes, P, slopes), np.broadcast_to(error, u.shape)
        ends = [on_log_scale(*each, "")[:3] for each in zip(values[0], *errors, strict=True)]
        curves.append(Curve(speeds, *np.array(ends).T))
    return Yaw(*curves)


def steering(
    fit: Identified, speeds: np.ndarray, commands: np.ndarray, cruise: float, before: float, period: float, tick: int
) -> Steering | str:
    """Design it for speeds, m/s, and the commands that hold them; a sentence where the turning is not known.

    The feedforward is true at `cruise`, m/s. The commands are late by `before`, s, as logged; the loop's period is in
    s, and pMarinePID's AppTick in Hz.
    """
    if not isinstance(fit, FittedBoat):
        return "The batch fit tells how a boat turns: run usvlearn fit RUN, then this command again."
    if fit.turning is None:
        return HARDLY if HARDLY in fit.lacks else "The fit does not tell the turning: run usvlearn fit RUN again."
    if not fit.turning.explained > EXPLAINED:
        return (
            f"The commands explain {100 * fit.turning.explained:.0f} % of the turns, expected "
            f"{100 * EXPLAINED:.0f} % or more: the boat turns by something else, such as a rudder, or sides are wrong."
        )
    yaw = yaw_of(fit, speeds, commands)
    if not all((each.high < WIDEST * each.low).all() for each in yaw[:2]):
        return (
            f"Full steering turns the boat by {yaw.gain.low.min():.2g} … {yaw.gain.high.max():.2g} rad/s within "
            f"{yaw.time_constant.low.min():.2g} … {yaw.time_constant.high.max():.2g} s, which is too uncertain for "
            "gains: learn from a log with more turns at all speeds."
        )
    p, by = natural(fit.turning.theta), np.zeros(at.PARAMETERS)
    by[at.LATE], by[at.LAG] = 1.0, p[at.LAG]
    spread = math.sqrt(by @ fit.turning.covariance @ by)
    late = max(before + float(p[at.LATE] + p[at.LAG]) + NINETY * spread, 0.0)
    delay = late + period / 2 + 1 / (2 * math.pi * FILTER)
    gains, left = design("steering", yaw, delay)
    by_heading, crossed = design("steering", yaw, late + (DIFFERENCES + 1) / 2 / tick)
    curves = commands, yaw.gain.value, yaw.greatest.low, yaw.gain.low / yaw.time_constant.high
    base, K, held, quick = (float(np.interp(cruise, speeds, each)) for each in curves)
    K = max(K, yaw.gain.high.max() / STEEP)
    angle, heading = _heading(yaw, gains, 1 / K, delay)
    if angle * delay < SLUGGISH:
        return "The yaw rate of full steering differs too much between the speeds for one gain: narrow --range."
    cascade = Cascade(
        1 / K, float(gains.proportional), gains.integral, angle, SPARE * held, SPARE * quick * min(base, 1 - base)
    )
    kp, kd = (100 * math.radians(each) for each in (by_heading.integral, by_heading.proportional))
    moos = MoosYaw(kp, kd, kp * crossed.crossover[0] / HOLDS, MOST)
    return Steering(fit, yaw, cruise, base, delay, left, heading, cascade, moos)


def _heading(yaw: Yaw, gains: Gains, feedforward: float, delay: float) -> tuple[float, Margins]:
    """The greatest gain of the heading, 1/s, that leaves `PHASE` and `GAIN` at all corners, and the worst margins."""
    (a, b), s, angle = yaw.corners, 1j * GRID[:, None], 1 / delay
    boat, control = b * np.exp(-s * delay) / (s - a), gains.proportional + gains.integral / s
    loop = (feedforward + control) * boat / (1 + control * boat) / s
    while True:
        left = worst(angle * loop)
        if left.gain >= GAIN and left.phase >= PHASE:
            return angle, left
        angle *= SLOWER


class Turns(NamedTuple):
    """Boats that turn at one speed."""

    p: np.ndarray  # (m, boats) parameters of the kernel
    speed: float  # over the top speed
    base: float  # command


def turning_step(boat: Turns, x: np.ndarray, steering: np.ndarray, h: float) -> np.ndarray:
    """Heading, yaw rate and the thrust of both sides, `(4, boats)`, h s later."""
    p, u, (heading, r) = boat.p, boat.speed, x[:2]
    sides = np.clip(boat.base + np.stack([steering, -steering]), -1.0, 1.0)
    thrust = push(p, sides, u)
    thrust += np.exp(-h / p[at.LAG]) * (x[2:] - thrust)
    more = p[at.D1] * np.abs(r)
    drag = p[at.D0] + more + p[at.D2] * u
    turn = thrust[0] - p[at.SIDE] * thrust[1] + p[at.RUDDER] * u * u * (sides[0] - sides[1]) + p[at.BIAS] - drag * r
    new = r - np.expm1(-h * (drag + more)) / (drag + more) * turn
    return np.concatenate([[heading + h * (r + new) / 2, new], thrust])


def trials(steer: Steering, before: float, period: float, tick: int, seed: int) -> list[Trial]:
    """All autopilots on boats drawn from the intervals; arguments as of `steering`."""
    assert steer.boat.turning is not None
    theta, P, _ = steer.boat.turning
    drawn = natural(np.random.default_rng([seed, 2]).multivariate_normal(theta, P, BOATS, method="eigh")).T
    boat, own, base = Turns(drawn, steer.speed / steer.boat.top, steer.base), steer.cascade, steer.base
    delays, push_of_side = np.maximum(before + drawn[at.LATE], 0.0), push(drawn, np.array(base), boat.speed)
    start = np.stack([np.zeros(BOATS), np.zeros(BOATS), push_of_side, push_of_side])
    ff = QUICKTUNE[0] * own.feedforward
    hand = DEFAULTS._replace(feedforward=ff, proportional=QUICKTUNE[1] * ff, integral=QUICKTUNE[1] * ff)
    rovers = {DESIGNED: own, "defaults": DEFAULTS, "QuickTune": hand}
    laws: list[tuple[str, str, Any]] = [("ArduRover", k, CascadeLaw(x, period, base)) for k, x in rovers.items()]
    laws += [("MOOS-IvP", k, MoosYawLaw(x, tick)) for k, x in {DESIGNED: steer.moos, "s1_alpha": ALPHA}.items()]
    laws += [("PX4", DESIGNED, CascadeLaw(own, period, base, px4=True))]
    hold, tried = LONG / min(own.angle, steer.margins.crossover[0]), []
    for autopilot, gains, law in laws:
        (step,) = steps_of(simulate(boat, delays, law, [0.0, math.pi / 2], hold, turning_step, start))
        law.auto = own.angle if gains == DESIGNED else AUTO
        mower = simulate(boat, delays, law, lawn_mower(own.rate / 2, hold, law.period), law.period, turning_step, start)
        rms = np.degrees(np.sqrt(np.mean((mower.wanted[:, None] - mower.speed) ** 2, 0)))
        tried.append(Trial(autopilot, gains, step, rms))
    return tried


def lawn_mower(turn: float, leg: float, period: float) -> np.ndarray:
    """Wanted headings, rad, of legs of `leg` s and half circles with the yaw rate `turn`, rad/s, to either side."""
    arc, straight = np.arange(0.0, math.pi, turn * period), np.zeros(round(leg / period))
    back = [math.pi + straight, math.pi - arc, straight]
    return np.concatenate([straight, *([arc, *back] * LEGS)[: 2 * LEGS - 2]])


def parts(steer: Steering | str, tried: Sequence[Trial]) -> Iterator[str | Blocks]:
    """For a terminal."""
    if isinstance(steer, str):
        yield f"Steering: no gains. {steer}"
        return
    assert steer.boat.turning is not None
    yaw, left, heading, explained = steer.yaw, steer.margins, steer.heading, steer.boat.turning.explained
    heads = ["time constant, s", "rad/s of full steering", "most, rad/s"]
    table = Blocks("Steering: base ± steering on the sides, in brackets 90 % intervals", ["speed, m/s"], heads)
    for k in range(0, len(yaw.gain.at), 2):
        ends = (f"{each.value[k]:.2f} ({each.low[k]:.2f} … {each.high[k]:.2f})" for each in yaw)
        table.add(f"{yaw.gain.at[k]:.2f}", *ends)
    yield table
    yield (
        f"Delay of {steer.delay:.2f} s. Worst over the corners: yaw rate {left.gain:.1f} dB, {left.phase:.0f}°; "
        f"heading {heading.gain:.1f} dB, {heading.phase:.0f}°. Commands explain {100 * explained:.0f} % of the turns."
    )
    yield ""
    table = Blocks(
        f"Steering of {BOATS} boats drawn from the intervals, at {steer.speed:.2f} m/s: median, in brackets 95 %",
        ["autopilot", "gains"], ["overshoot", "settled to ±5 %", "unstable", "rms on a lawn mower"],
    )  # fmt: skip
    for each in tried:
        over, settled = 100 * each.step.overshoot, each.step.settled
        table.add(
            each.autopilot, each.gains, f"{np.median(over):.0f} % ({np.quantile(over, 0.95):.0f} %)",
            f"{np.median(settled):.1f} s ({np.quantile(settled, 0.95, method='higher'):.1f} s)",
            f"{int(each.step.sways.sum())}", f"{np.median(each.rms):.1f}° ({np.quantile(each.rms, 0.95):.1f}°)",
        )  # fmt: skip
    yield table
    yield (
        f"A turn by 90°, and the heading on a lawn mower with turns of {math.degrees(steer.cascade.rate) / 2:.0f}°/s, "
        "which ArduRover knows, as in AUTO. QuickTune: FF from the boat, P and I half of it. s1_alpha: a mission of "
        "MOOS-IvP. PX4's own defaults do not steer."
    )
