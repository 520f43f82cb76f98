"""Draw the test manoeuvre of `docs/controller.md` and a simulated boat that sails it; needs the extra plot.

python docs/manoeuvre_figure.py
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from usvlearn.display.figures import INK, LINE, SIDES, themed
from usvlearn.simulate.fleet import simulate
from usvlearn.simulate.plants import heron
from usvlearn.simulate.vessel import VesselState, at_rest

DT = 0.1  # s
GAIN, TURN_MAX = 0.6, 0.35  # heading controller: share of the command per rad, and at most, as `Autopilot` has them


class Leg(NamedTuple):
    """Commands that are held for some seconds."""

    seconds: float
    left: float  # %
    right: float  # %
    heading: float | None = None  # degrees from A; None: free


def straight(heading: float | None, seconds: float, *commands: float) -> list[Leg]:
    return [Leg(seconds, command, command, heading) for command in commands]


def steps_and_coast(heading: float) -> list[Leg]:
    return [*straight(heading, 15, 25, 50, 75, 100), *straight(heading, 20, 0)]


# The rows of the table: what is tested, and its legs.
ROWS = [
    ("zero", straight(0, 20, 0)),
    ("steps, coast", steps_and_coast(0)),
    ("turn", [Leg(20, 60, 20, 180)]),
    ("steps, coast", steps_and_coast(180)),
    ("turn", [Leg(20, 20, 60, 0)]),
    ("100, 0", straight(0, 10, 100, 0, 100, 0)),
    ("turn", [Leg(20, 60, 20, 180)]),
    ("30, 80", straight(180, 10, 30, 80, 30, 80)),
    ("turning", [Leg(20, *sides) for sides in ((100, 50), (50, 100), (50, 25), (25, 50))]),
    ("one side", [Leg(20, 60, 0), Leg(20, 0, 60), Leg(10, 0, 0)]),
    ("astern", straight(None, 15, -30, -60, 0)),
    ("on the spot", [Leg(15, 50, -50), Leg(15, -50, 50)]),
    ("A + 90°", [*straight(90, 20, 100), *straight(90, 15, 0)]),
    ("A − 90°", straight(-90, 20, 100, 0)),
]


def steered(leg: Leg, heading: float) -> tuple[float, float]:
    """The commands of both sides, share of full: those of the leg, and differences that hold its heading.

    Args:
        heading: of the boat, rad, not wrapped.
    """
    mean, turn = (leg.left + leg.right) / 200, (leg.left - leg.right) / 200
    if leg.heading is not None and mean != 0:
        error = math.radians(leg.heading) - heading
        most = abs(turn) or TURN_MAX  # a turn goes the long way, too; else the nearest
        turn = min(max(GAIN * (error if turn else math.remainder(error, math.tau)), -most), most)
    return min(max(mean + turn, -1), 1), min(max(mean - turn, -1), 1)


def sail() -> tuple[np.ndarray, ...]:
    """Time, s, commands of both sides, share of full, speed, m/s, and heading, degrees from A."""
    boat, state, rows, time = heron(), at_rest(), [], 0.0
    for leg in (leg for _, legs in ROWS for leg in legs):
        for _ in range(round(leg.seconds / DT)):
            command = steered(leg, float(state.heading))
            state = VesselState(*(x[0] for x in simulate(boat, state, torch.from_numpy(np.array([command])), DT)))
            rows.append((time, *command, float(state.surge), math.degrees(float(state.heading))))
            time += DT
    return tuple(np.array(rows).T)


def main() -> None:
    time, left, right, surge, heading = sail()
    starts = np.cumsum([0, *(sum(leg.seconds for leg in legs) for _, legs in ROWS)])
    assert starts[-1] == 600, f"the manoeuvre takes {starts[-1]} s"
    radians = np.radians(heading)
    east, north = np.cumsum(surge * np.sin(radians)) * DT, np.cumsum(surge * np.cos(radians)) * DT
    with themed() as Figure:
        figure = Figure(figsize=(9, 6), dpi=100, layout="constrained", facecolor="white")
        grid = figure.add_gridspec(3, 2, width_ratios=(3, 1))
        panels = [figure.add_subplot(grid[k, 0]) for k in range(3)]
        for panel in panels[:-1]:
            panel.tick_params(labelbottom=False)
        for panel in panels:
            for k, (begin, end) in enumerate(pairwise(starts / 60)):
                if k % 2:
                    panel.axvspan(begin, end, color=LINE, alpha=0.35, linewidth=0)
            panel.set(xlim=(0, 10), xticks=range(11))
            panel.grid(alpha=0.5, axis="y")
        commands, speed, turned = panels
        for (name, colour), side, width in zip(SIDES.items(), (left, right), (3.2, 1.5), strict=True):
            commands.plot(time / 60, 100 * side, color=colour, linewidth=width, label=name, drawstyle="steps-post")
        commands.legend(loc="lower left", ncols=2)
        commands.set(ylabel="command, %", yticks=range(-50, 101, 50))
        for (name, _), middle in zip(ROWS, (starts[:-1] + starts[1:]) / 120, strict=True):
            commands.text(middle, 112, name, rotation=90, ha="center", va="bottom")
        speed.plot(time / 60, surge, color=INK, linewidth=1.4)
        speed.set(ylabel="speed, m/s")
        turned.plot(time / 60, heading, color=INK, linewidth=1.4)
        turned.set(ylabel="heading from A, °", xlabel="time, min", yticks=range(0, 541, 180))
        track = figure.add_subplot(grid[:, 1])
        track.plot(east, north, color=INK, linewidth=1.2)
        track.set(aspect="equal", xlabel="right of A, m", ylabel="along A, m", title="track")
        track.grid(alpha=0.5)
        figure.savefig(Path(__file__).parent / "images" / "manoeuvre.png", metadata={"Software": None})


if __name__ == "__main__":
    main()
