"""The command `usvlearn plan RUN`: what to sail next to narrow the confidence intervals."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from usvlearn.cli.plain_command import out_folder, without_key
from usvlearn.errors import ConfigError, printable

if TYPE_CHECKING:
    from usvlearn.estimators.joint.excitation_warnings import Quantity
    from usvlearn.model.planning.course import Limits
    from usvlearn.model.planning.search import BestCourse, Rehearsal
    from usvlearn.model.read_boats import IdentifiedBoat

USAGE = (
    "usage: usvlearn plan RUN [--boat NAME] [--minutes 5] [--area 200] [--command-max 1] [--out FOLDER] …; "
    "all options: usvlearn plan --help"
)
STEP = 0.4  # s, where a checkpoint does not state its step
LEAST_RATE, MOST_RATE = 1.0, 90.0  # degrees/s, of a turn
WALK = (
    "An interval may become wider: the filter lets the parameters walk, and forgets what a mission does not show, as a "
    "lawn mower at one speed does not show the drag."
)
REFIT = "Intervals are those of the batch fit, expected once it is made anew with this mission (usvlearn fit)."


def parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("usvlearn plan", description=__doc__)
    add = parser.add_argument
    add("run", metavar="RUN", type=without_key, help="the folder of a run, a folder of checkpoints, or a checkpoint")
    add("--boat", help="only this one")
    add("--minutes", type=float, default=5.0, help="length of the mission (5)")
    add("--area", type=float, default=200.0, help="side of the square to stay in, m, the start in its middle (200)")
    add("--command-max", type=float, default=1.0, help="largest command, share of full scale (1)")
    add("--command-min", type=float, default=0.0, help="least command: below 0 the boat may go astern (0)")
    add("--segment", type=float, default=15.0, help="s between two changes of throttle or heading (15)")
    add("--heading", type=float, default=0.0, help="first heading and direction of the square, degrees (0)")
    add("--turn-rate", type=float, default=20.0, help="of the boat in a turn, degrees/s (20)")
    add("--seed", type=int, default=0, help="of the search (0)")
    add("--out", metavar="FOLDER", default="plan", help="where the files are written (plan)")
    return parser


def work(arguments: Sequence[str]) -> None:
    """Plan for each boat, print, and write."""
    from usvlearn.display import terminal
    from usvlearn.display.terminal import Activity

    options = parser().parse_args(list(arguments))
    with Activity(terminal.console(), "loading"):
        from usvlearn.model.planning.course import Limits
        from usvlearn.model.read_boats import read_boats
    if not (-360 <= options.heading <= 360 and options.seed >= 0):
        raise ConfigError(
            f"--heading, --seed: found {options.heading} and {options.seed}, expected -360 to 360 degrees, and 0 up"
        )
    if not LEAST_RATE <= options.turn_rate <= MOST_RATE:
        raise ConfigError(
            f"--turn-rate: found {options.turn_rate:g}, expected {LEAST_RATE:g} to {MOST_RATE:g} degrees/s"
        )
    limits = Limits(
        options.minutes, options.area, options.command_min, options.command_max, options.segment,
        math.radians(options.heading), math.radians(options.turn_rate),
    )  # fmt: skip
    folder = out_folder(options.out)
    with Activity(terminal.console(), "searching for what to sail"):
        planned = [_planned(boat, limits, options.seed) for boat in read_boats(options.run, options.boat)]
    folder.mkdir(parents=True, exist_ok=True)
    for each in planned:
        _show(each, limits, folder)


class Planned(NamedTuple):
    """The plan of one boat."""

    boat: IdentifiedBoat
    rehearsal: Rehearsal
    quantities: list[str]  # that the boat's commands can tell
    aims: list[str]  # those that are not well known
    plan: BestCourse
    after: Mapping[str, Quantity]  # what the plan is expected to tell, of RUN/fit by a refit
    mower: Mapping[str, Quantity]  # likewise a lawn mower


def _planned(boat: IdentifiedBoat, limits: Limits, seed: int) -> Planned:
    """Plan for one boat; a ConfigError if its thrust points astern, or no course stays in the area."""
    from usvlearn.model.fit.boat import FittedBoat
    from usvlearn.model.planning.course import lawn_mower
    from usvlearn.model.planning.search import Rehearsal, derived, refitted, search, wide

    boat.check_physical()
    top = boat.identified["steady_speed_full"].value
    if not top > 0:
        raise ConfigError(
            f"{printable(boat.name)}: found a steady speed of {top:.2f} m/s at full command, expected one ahead: "
            f"check by usvlearn inspect whether a side is reversed, and learn anew ({' '.join(boat.identified.lacks)})"
        )
    dt = float(boat.setup.align["dt"]) if boat.setup else STEP
    rehearsal = Rehearsal(boat.members, boat.leaves)
    one_command = boat.setup is not None and boat.setup.one_command
    if one_command:
        limits = replace(limits, steering=0.0)  # a turn is the rudder's
    aims, quantities = wide(rehearsal.identified, one_command), derived(rehearsal.identified, one_command)
    plan = search(rehearsal, limits, dt, aims or quantities, seed)
    mower = lawn_mower(limits, rehearsal.top_speed(limits.most), dt)
    expected: list[Mapping[str, Quantity]] = [plan.expected.identified, rehearsal(mower.rows).identified]
    if isinstance(boat.identified, FittedBoat) and math.isfinite(boat.identified.noise):
        expected = [refitted(boat.identified, each.rows, dt) for each in (plan.course, mower)]
    return Planned(boat, rehearsal, quantities, aims, plan, *expected)


def _show(planned: Planned, limits: Limits, folder: Path) -> None:
    """Write the files of a plan, and print it."""
    from usvlearn.display import terminal

    boat, rehearsal, quantities, aims, plan, after, mower = planned
    console, written = terminal.console(), list(_written(boat, limits, plan, folder))
    for table in (
        _segments(boat, rehearsal, plan, limits, aims or quantities),
        _intervals(boat, mower, after, quantities),
    ):
        console.print(table)
        console.print()
    if not aims:
        terminal.show(*_determined(boat.identified, after, quantities))
    terminal.show(*boat.lacks, WALK if after is plan.expected.identified else REFIT, "", *written)


def _width(identified: Mapping[str, Quantity], name: str) -> float:
    return identified[name].high - identified[name].low


def _segments(boat: IdentifiedBoat, rehearsal: Rehearsal, plan: BestCourse, limits: Limits, aims: list[str]):
    """The table of the segments; `why` names the interval that a segment shrinks most."""
    from usvlearn.display import terminal
    from usvlearn.model.planning.course import steps_of

    course, segment = plan.course, steps_of(limits, plan.course.dt)
    ends = np.append(np.flatnonzero(np.diff(segment)) + 1, len(segment))
    table = terminal.Blocks(
        f"{boat.name}: what to sail for {limits.minutes:g} min", ["time, s"],
        ["left", "right", "heading", "speed, m/s", "why"],
    )  # fmt: skip
    before, first = rehearsal.identified, 0
    for part, last in zip(rehearsal.by_part(course.rows, ends), ends.tolist(), strict=True):
        shrunk = {name: _width(part.identified, name) / _width(before, name) for name in aims}
        name = min(shrunk, key=lambda each: shrunk[each] if shrunk[each] == shrunk[each] else 1.0)
        why = f"{name} {shrunk[name] - 1:+.0%}" if shrunk[name] < 0.995 else "–"
        straight = slice(last - 1, last)
        table.add(
            f"{first * course.dt:.0f}", f"{course.left[straight][0]:.2f}", f"{course.right[straight][0]:.2f}",
            f"{math.degrees(course.wanted[first]) % 360:.0f}", f"{part.speed[-1]:.2f}", why,
        )  # fmt: skip
        before, first = part.identified, last
    return table


def _intervals(
    boat: IdentifiedBoat, mower: Mapping[str, Quantity], after: Mapping[str, Quantity], quantities: list[str]
):
    """The table of the intervals."""
    from usvlearn.display import terminal
    from usvlearn.estimators.joint.periodic_estimates import shown
    from usvlearn.model.planning.course import SURVEY

    table = terminal.Blocks(
        f"Half-widths of 90 % intervals, as expected; a lawn mower is parallel lines at {SURVEY:.0%} throttle",
        ["quantity"],
        ["value", "now", "lawn mower", "this plan", "unit"],
    )  # fmt: skip
    for name in quantities:
        widths = [_width(each, name) / 2 for each in (boat.identified, mower, after)]
        table.add(
            name,
            shown(boat.identified.displayed(name).value),
            *(shown(each) for each in widths),
            boat.identified[name].unit,
        )
    return table


def _determined(now: Mapping[str, Quantity], after: Mapping[str, Quantity], quantities: list[str]) -> Iterator[str]:
    """What is said where nothing is wide."""
    from usvlearn.model.planning.search import WELL

    name = min(quantities, key=lambda each: _width(after, each) / _width(now, each))
    yield (
        f"Every quantity is known to ± {WELL:.0%} or better, so that a mission for the model alone is not needed; "
        f"this one would shrink {name} most, by {1 - _width(after, name) / _width(now, name):.0%}."
    )


def _written(boat: IdentifiedBoat, limits: Limits, plan: BestCourse, folder: Path) -> Iterator[str]:
    """Write the files; what each is."""
    from usvlearn.core.checkpoint import write_atomically
    from usvlearn.model.planning.search import csv_lines

    path = folder / f"{boat.stem}.csv"
    write_atomically(path, "".join(f"{line}\n" for line in csv_lines(plan)).encode())
    yield f"{path}: commands, headings and expected speeds, a row for each change"
    yield (
        f"A controller or a person must hold the headings. Turns are planned with {math.degrees(limits.turn_rate):.0f} "
        f"degrees/s, and the current as the checkpoint has it: keep room beside the {limits.area:g} m."
    )
