"""Logs of simulated boats with one mistake, and the kinds of finding that name it.

Five plants, which go astern in every second log. Rough: a current of up to 0.8 m/s, speeds and headings at 1 and 2 Hz,
noise of 0.1 m/s.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from usvlearn.logs.channels.channel import COMMANDS, METRES, SURGE, Channel, Recording
from usvlearn.logs.channels.correlations import heading_rate
from usvlearn.logs.checks.data_check import check_data
from usvlearn.logs.recordings import align_fleet
from usvlearn.simulate.autopilot import Autopilot
from usvlearn.simulate.fault import Fault
from usvlearn.simulate.fleet import fleet
from usvlearn.simulate.sensors import Sensors

TOP = {"heron": 2.74, "kingfisher": 1.5, "vtec": 1.5, "otter": 3.1, "wamv": 7.7}  # m/s, vehicle.surge_max
KNOT = 1852 / 3600
ALIGN = {"dt": 0.4, "patience": 1.0}
CONFIGURED = {
    "command_left": {"name": "left"},
    "command_right": {"name": "right"},
    "heading": {"name": "heading", "unit": "deg"},
    "yaw_rate": {"name": "rate", "unit": "rad/s"},
    "surge": {"name": "speed", "unit": "m/s"},
}
Log = dict[str, Channel]


def times(factor: float, *names: str) -> Callable[[Log], Log]:
    """Multiply the values of some channels."""
    return lambda log: {name: log[name]._replace(value=factor * log[name].value) for name in names}


def swapped(log: Log) -> Log:
    return dict(zip(COMMANDS, (log[name] for name in COMMANDS[::-1]), strict=True))


def counter_clockwise(log: Log) -> Log:
    turned = np.mod(math.pi / 2 - log["heading"].value, 2 * math.pi)
    return {"heading": log["heading"]._replace(value=turned)}


def late(log: Log) -> Log:
    return {SURGE: log[SURGE]._replace(time=log[SURGE].time + 100)}


def delayed(log: Log) -> Log:
    return {name: log[name]._replace(delay=100.0) for name in COMMANDS}


def resting(log: Log) -> Log:
    noise = np.random.default_rng(0).normal(0, 0.02, len(log[SURGE].time))
    return {SURGE: log[SURGE]._replace(value=noise)}


def pulses(log: Log) -> Log:
    return {name: log[name]._replace(value=1500 + 400 * log[name].value) for name in COMMANDS}


def on_off(log: Log) -> Log:
    return {name: log[name]._replace(value=(log[name].value > 0.3).astype(float)) for name in COMMANDS}


def with_positions(log: Log) -> Log:
    """A GPS beside the speed: dead reckoning, 1 Hz, with 0.5 m of noise."""
    rng, speed = np.random.default_rng(1), log[SURGE]
    place = np.argsort(log["heading"].time, kind="stable")
    heading = np.interp(speed.time, log["heading"].time[place], np.unwrap(log["heading"].value[place]))
    passed = np.diff(speed.time, prepend=speed.time[:1])
    moved = [np.cumsum(passed * speed.value * each(heading)) for each in (np.cos, np.sin)]
    return {
        name: Channel(speed.time[::5], (each + rng.normal(0, 0.5, len(each)))[::5], speed.order[::5])
        for name, each in zip(METRES, moved, strict=True)
    }


def with_yaw_rate(log: Log) -> Log:
    """A gyroscope beside the heading."""
    rate, rng = heading_rate((log["heading"].time, log["heading"].value)), np.random.default_rng(2)
    smooth = np.convolve(rate[1], np.ones(5) / 5, "same")
    order = np.interp(rate[0], log["heading"].time, log["heading"].order).astype(np.int64)
    return {"yaw_rate": Channel(rate[0], smooth + rng.normal(0, 0.01, len(smooth)), order)}


def frozen(name: str, first: float, last: float, value: float | None = None) -> Callable[[Log], Log]:
    """A channel that stays at its value between two times, s."""

    def change(log: Log) -> Log:
        within = (log[name].time > first) & (log[name].time < last)
        stays = log[name].value[within][0] if value is None else value
        return {name: log[name]._replace(value=np.where(within, stays, log[name].value))}

    return change


def then(*changes: Callable[[Log], Log]) -> Callable[[Log], Log]:
    """One change after the other."""

    def apply(log: Log) -> Log:
        for change in changes:
            log = {**log, **change(log)}
        return log

    return apply


CLEAN: dict[str, Callable[[Log], Log]] = {
    "as simulated": lambda log: {},
    "with positions": with_positions,
    "with a yaw rate": with_yaw_rate,
}
# mistake -> what changes, and the kinds of finding that name it
MISTAKES: dict[str, tuple[Callable[[Log], Log], Sequence[str]]] = {
    "speed in knots as m/s": (times(1 / KNOT, SURGE), ("speed scale",)),
    "speed in knots as m/s, with positions": (then(with_positions, times(1 / KNOT, SURGE)), ("speed unit",)),
    "speed in m/s as knots": (times(KNOT, SURGE), ("speed scale",)),
    "speed in m/s as knots, with positions": (then(with_positions, times(KNOT, SURGE)), ("speed unit",)),
    "speed in km/h as m/s": (times(3.6, SURGE), ("speed scale",)),
    "speed in cm/s as m/s": (times(100, SURGE), ("speed scale",)),
    "heading in radians as degrees": (times(math.pi / 180, "heading"), ("heading unit",)),
    "heading in degrees as radians": (times(180 / math.pi, "heading"), ("heading unit",)),
    "heading counter-clockwise": (counter_clockwise, ("sides or heading",)),
    "heading counter-clockwise, with positions": (
        then(with_positions, counter_clockwise),
        ("heading sense", "sides or heading"),
    ),
    "yaw rate in rad/s as deg/s": (then(with_yaw_rate, times(math.pi / 180, "yaw_rate")), ("yaw rate unit",)),
    "yaw rate in deg/s as rad/s": (then(with_yaw_rate, times(180 / math.pi, "yaw_rate")), ("yaw rate unit",)),
    "yaw rate counter-clockwise": (then(with_yaw_rate, times(-1, "yaw_rate")), ("yaw sense",)),
    "left side reversed": (times(-1, "command_left"), ("side reversed",)),
    "right side reversed": (times(-1, "command_right"), ("side reversed",)),
    "both sides reversed": (times(-1, *COMMANDS), ("side reversed", "sides or heading")),
    "both sides reversed and swapped": (then(swapped, times(-1, *COMMANDS)), ("side reversed",)),
    "sides swapped": (swapped, ("sides or heading",)),
    "sides swapped, with positions": (then(with_positions, swapped), ("sides swapped", "sides or heading")),
    "speed 100 s late": (late, ("delay",)),
    "delay of commands set to 100 s": (delayed, ("delay",)),
    "commands in percent as shares": (times(100, *COMMANDS), ("command scale",)),
    "commands as shares as percent": (times(0.01, *COMMANDS), ("command scale",)),
    "pulses of 1100 to 1900 us as shares": (pulses, ("command scale",)),
    "speeds of zero": (times(0, SURGE), ("constant",)),
    "all zero": (times(0, *COMMANDS, "heading", SURGE), ("constant",)),
    "boat at rest": (resting, ("at rest",)),
    "left thruster never used": (times(0, "command_left"), ("excitation",)),
    "commands on or off alone": (on_off, ("excitation",)),
}
FAULTS = [None, *(Fault(side, share, minute) for side in ("left", "right") for share in (0.0, 0.3, 0.6)
                  for minute in (0.0, 0.5))]  # fmt: skip


def changed(recordings: Sequence[Recording], change: Callable[[Log], Log]) -> list[Recording]:
    """The recordings with changed channels."""
    return [one._replace(channels={**one.channels, **change(one.channels)}) for one in recordings]


def kinds(recordings: Sequence[Recording], plant: str, severity: str | None = None) -> list[str]:
    """The kinds of all findings."""
    try:
        aligned = align_fleet(recordings, **ALIGN)
    except ValueError:  # nothing is left to align: the check runs all the same
        aligned = None
    findings = check_data(recordings, aligned, ALIGN, TOP[plant], CONFIGURED)
    return [each.kind for each in findings if severity in (None, each.severity)]


def boats(plant: str, seed: int, hours: float, fault: Fault | None = None, rough: bool = False) -> list[Recording]:
    """The logs of one boat; each second seed backs up, too."""
    autopilot = Autopilot(lowest=-1.0 if seed % 2 else 0.0)
    struck = fault and Fault(fault.side, fault.share, 60 * hours * fault.minute)
    how: dict = {}
    if rough:
        sensors = Sensors(surge_hz=1.0, heading_hz=2.0, surge_noise=0.1, heading_window=1.0, surge_window=1.0)
        how = {"current": 0.8, "sensors": sensors}
    return fleet(
        n=1, plant=plant, seed=seed, hours=hours, mission_minutes=10.0, autopilot=autopilot, fault=struck, **how
    )
