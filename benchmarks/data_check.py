"""How often the data check warns of a boat without a mistake, and how often it misses a mistake.

Simulated boats of five plants; each mistake changes channels of the same logs. Writes data_check.md beside this file:

    python benchmarks/data_check.py [SEEDS [HOURS …]]
"""

from __future__ import annotations

import math
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from usvlearn.logs.channel import COMMANDS, METRES, SURGE, Channel, Recording
from usvlearn.logs.checks.finding import WARNING
from usvlearn.logs.data_check import check_data
from usvlearn.logs.recordings import align_fleet
from usvlearn.logs.relations import heading_rate
from usvlearn.simulate.autopilot import Autopilot
from usvlearn.simulate.fault import Fault
from usvlearn.simulate.fleet import fleet

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
    found = check_data(recordings, aligned, ALIGN, TOP[plant], CONFIGURED)
    return [each.kind for each in found if severity in (None, each.severity)]


def boats(plant: str, seed: int, hours: float, fault: Fault | None = None) -> list[Recording]:
    """The logs of one boat; each second seed backs up, too, and its missions are short."""
    autopilot = Autopilot(lowest=-1.0 if seed % 2 else 0.0)
    late = fault and Fault(fault.side, fault.share, 60 * hours * fault.minute)
    return fleet(n=1, plant=plant, seed=seed, hours=hours, mission_minutes=10.0, autopilot=autopilot, fault=late)


def rates(seeds: int, hours: Sequence[float]) -> list[str]:
    """All tables, as Markdown."""
    lines = []
    false: dict[str, Counter] = {}
    runs: Counter = Counter()
    missed: dict[str, list[bool]] = {}
    more: Counter = Counter()
    for length in hours:
        for plant in TOP:
            for seed in range(seeds):
                logs = boats(plant, seed, length)
                for name, change in CLEAN.items():
                    key = f"{name}, {60 * length:.0f} min"
                    runs[key] += 1
                    false.setdefault(key, Counter()).update(set(kinds(changed(logs, change), plant, WARNING)))
                for name, (change, expected) in MISTAKES.items():
                    found = kinds(changed(logs, change), plant)
                    missed.setdefault(f"{name}|{60 * length:.0f}", []).append(not set(found) & set(expected))
                    more[f"{name}|{60 * length:.0f}"] += bool(set(found) - set(expected))
                if seed < max(1, seeds // 2):
                    for fault in FAULTS[1:]:
                        key = f"a thruster with {fault.share:.0%} of its thrust, {60 * length:.0f} min"
                        runs[key] += 1
                        found = set(kinds(boats(plant, seed, length, fault), plant, WARNING))
                        false.setdefault(key, Counter()).update(found)
    lines += ["| boats without a mistake | logs | with a warning of | |", "|---|---|---|---|"]
    for key, counts in false.items():
        told = ", ".join(f"{kind}: {count}" for kind, count in counts.most_common()) or "none"
        lines.append(f"| {key} | {runs[key]} | {told} | {sum(counts.values()) / runs[key]:.1%} |")
    lengths = [f"{60 * length:.0f}" for length in hours]
    heads = " | ".join(f"missed, {length} min | others, {length} min" for length in lengths)
    lines += ["", f"| mistake | {heads} |", "|---" * (1 + 2 * len(lengths)) + "|"]
    for name in MISTAKES:
        cells = [
            f"{sum(row)} of {len(row)} | {more[f'{name}|{length}']}"
            for length in lengths
            for row in [missed[f"{name}|{length}"]]
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def main(arguments: Sequence[str]) -> None:
    seeds = int(arguments[0]) if arguments else 20
    hours = [float(each) for each in arguments[1:]] or [0.1, 1.0]
    began = time.perf_counter()
    lines = rates(seeds, hours)
    print("\n".join(lines))
    print(f"{time.perf_counter() - began:.0f} s")
    Path(sys.argv[0]).with_suffix(".tables.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
