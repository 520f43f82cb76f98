"""How often the data check warns of a boat without a mistake, and how often it misses a mistake.

python benchmarks/data_check.py        writes docs/benchmarks/data_check.md

Simulated boats of five plants, which go astern in every second log. A mistake changes channels of the same logs. Rough:
a current of up to 0.8 m/s, speeds and headings at 1 and 2 Hz, noise of 0.1 m/s. A mistake is missed if no finding,
warning or note, names it; "others" counts logs that have another finding beside it. The thresholds were chosen on
other seeds.
"""

from __future__ import annotations

import math
import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pages import publish

from usvlearn.cli import train
from usvlearn.cli.composition import compose_train
from usvlearn.cli.settings import ensemble_of, instantiate
from usvlearn.logs.channels.channel import COMMANDS, METRES, SURGE, Channel, Recording
from usvlearn.logs.channels.relations import heading_rate
from usvlearn.logs.checks.data_check import check_data
from usvlearn.logs.checks.finding import WARNING
from usvlearn.logs.recordings import align_fleet
from usvlearn.runs.replay import replay
from usvlearn.simulate.autopilot import Autopilot
from usvlearn.simulate.fault import Fault
from usvlearn.simulate.fleet import fleet
from usvlearn.simulate.sensors import Sensors

TOP = {"heron": 2.74, "kingfisher": 1.5, "vtec": 1.5, "otter": 3.1, "wamv": 7.7}  # m/s, vehicle.surge_max
KNOT = 1852 / 3600
SEEDS, HOURS = range(300, 316), (0.1, 0.25, 1.0)
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
    found = check_data(recordings, aligned, ALIGN, TOP[plant], CONFIGURED)
    return [each.kind for each in found if severity in (None, each.severity)]


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


def false_alarms() -> list[str]:
    """A table of warnings of boats without a mistake."""
    told: dict[str, Counter] = {}
    logs: Counter = Counter()
    warned: Counter = Counter()

    def look(name: str, recordings: Sequence[Recording], plant: str) -> None:
        found = set(kinds(recordings, plant, WARNING))
        logs[name] += 1
        warned[name] += bool(found)
        told.setdefault(name, Counter()).update(found)

    for hours in HOURS:
        minutes = f"{60 * hours:.0f} min"
        for plant in TOP:
            for seed in SEEDS:
                recordings = boats(plant, seed, hours)
                for name, change in CLEAN.items():
                    look(f"{name}, {minutes}", changed(recordings, change), plant)
                look(f"rough, {minutes}", boats(plant, seed, hours, rough=True), plant)
            for seed in SEEDS[: len(SEEDS) // 4]:
                for fault in FAULTS[1:]:
                    name = f"a thruster with {fault.share:.0%} of its thrust, {minutes}"
                    look(name, boats(plant, seed, hours, fault), plant)
    lines = ["| boats without a mistake | logs | warned of | kinds |", "|---|---:|---:|---|"]
    for name, counts in told.items():
        listed = ", ".join(f"{kind} {count}" for kind, count in counts.most_common())
        lines.append(f"| {name} | {logs[name]} | {warned[name]} | {listed or 'none'} |")
    return lines


def misses() -> list[str]:
    """A table of the mistakes that were not named."""
    missed: Counter = Counter()
    others: Counter = Counter()
    for hours in HOURS:
        for plant in TOP:
            for seed in SEEDS:
                recordings = boats(plant, seed, hours)
                for name, (change, expected) in MISTAKES.items():
                    found = set(kinds(changed(recordings, change), plant))
                    missed[name, hours] += not found & set(expected)
                    others[name, hours] += bool(found - set(expected))
    count = len(TOP) * len(SEEDS)
    heads = " | ".join(f"missed of {count}, {60 * hours:.0f} min | others" for hours in HOURS)
    lines = [f"| mistake | {heads} |", "|---|" + "---:|" * (2 * len(HOURS))]
    for name in MISTAKES:
        cells = " | ".join(f"{missed[name, hours]} | {others[name, hours]}" for hours in HOURS)
        lines.append(f"| {name} | {cells} |")
    return lines


def cost() -> str:
    """The time of a check as a share of the replay of the same hour."""
    settings = compose_train(["data=simulated", "data.hours=1"])
    recordings, ensemble = instantiate(settings.data), ensemble_of(settings)
    aligned = align_fleet(recordings, **settings.align)

    def replayed() -> None:
        for _ in replay(ensemble, aligned, ensemble.init((1,))):
            pass

    def fastest(work: Callable[[], object]) -> float:
        work()
        seconds = []
        for _ in range(9):
            began = time.perf_counter()
            work()
            seconds.append(time.perf_counter() - began)
        return min(seconds)

    with TemporaryDirectory() as folder:
        train.work(settings, Path(folder, "first"), [], quiet=True)
        began = time.perf_counter()
        train.work(settings, Path(folder, "run"), [], quiet=True)
        whole = time.perf_counter() - began
    check, steps = fastest(lambda: check_data(recordings, aligned, ALIGN, TOP["heron"])), fastest(replayed)
    return (
        f"The check of one hour of one boat takes {check / whole:.1%} of a run of `train.py` over that hour, without\n"
        f"imports and compilation, and {check / steps:.0%} of the steps of the default ensemble alone."
    )


def main() -> None:
    warnings.simplefilter("ignore")
    text = __doc__.strip().split("\n\n")[-1]
    lines = ["# False alarms and misses of the data check", "", text, "", *false_alarms(), "", *misses(), "", cost()]
    publish(__file__, lines)


if __name__ == "__main__":
    main()
