"""Whether the gains of `usvlearn controller` hold on the simulated plants.

python benchmarks/speed_controller.py [--seeds 41 42 43] [--hours 1 4]        writes docs/benchmarks/speed_controller.md

Five plants, three boats of each and seed, with the sensors, currents and thrust tables of `usvlearn/simulate`. The
averaged joint EKF learns each boat from its own missions. A controller is designed from what it has identified. The
plant itself then sails steps between the lowest, the middle and the highest speed of the design, with the lag of its
thrusters, and without current and noise. Beside it: the same steps of 200 boats that the design draws from the
intervals.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from pages import publish

sys.path.insert(0, str(Path(__file__).parent))

from truths import NOMINAL, PLANTS

import usvlearn
from usvlearn import JointEKF
from usvlearn.core.samples import tree_map
from usvlearn.errors import ConfigError
from usvlearn.logs.setup import Setup
from usvlearn.model.controller.autopilots import MoosLaw, RoverLaw
from usvlearn.model.controller.closed_loop import Law, Responses, Step, steps_of
from usvlearn.model.controller.design import controller
from usvlearn.model.read_boats import IdentifiedBoat
from usvlearn.model.surge import SurgeModel
from usvlearn.simulate.fleet import fleet_vessels
from usvlearn.simulate.vessel import Vessel, at_rest, step

N, MISSION, DT, LONGEST = 3, 30.0, 0.4, 0.05  # boats; min; s of a step; s of a plant's step
CHANNELS = {name: {"name": name} for name in ("command_left", "command_right", "heading", "surge")}


class Case(NamedTuple):
    """One boat with one autopilot."""

    plant: str
    autopilot: str
    true: list[Step]  # of the plant
    drawn: list[Step]  # of the boats of the intervals


def sailed(vessel: Vessel, law: Law, course: Sequence[float], hold: float) -> Responses:
    """A plant without batch axes under a controller, with the lag of its thrusters."""
    state, substeps = at_rest((1,)), max(1, round(law.period / LONGEST))
    law.start(1)
    speeds, wanted = [], []
    for target in course:
        for _ in range(round(hold / law.period)):
            command = torch.as_tensor(law.command(target, state.surge.numpy()))[:, None].expand(1, 2)
            for _ in range(substeps):
                state = step(vessel, state, command, law.period / substeps)
                speeds.append(state.surge.numpy())
                wanted.append(target)
    time = law.period / substeps * np.arange(1, len(wanted) + 1)
    return Responses(time, np.array(wanted), np.array(speeds), np.zeros((len(wanted), 1)))


def cases(plant: str, seed: int, hours: float) -> Iterator[Case | str]:
    """The boats of a plant and seed; a sentence where no controller was designed."""
    mass, top = NOMINAL[plant]
    logs = usvlearn.read(data="simulated", hours=hours, plant=plant, seed=seed, n=N, mission_minutes=MISSION)
    averaged = JointEKF(surge_max=top, mass=mass, read_every=600.0, current=0.15, even=0.2, lag=0.3)
    missions = round(60 * hours / MISSION)
    vessels = fleet_vessels(N, 1.0, plant, seed, missions)
    setup = Setup.of({"channels": CHANNELS, "align": {"dt": DT}})
    for element, (name, found) in enumerate(usvlearn.learn(logs, averaged).identified().items()):
        boat = IdentifiedBoat(name, Path(name), found, SurgeModel.of(found), setup, {}, {})
        vessel = tree_map(lambda leaf, element=element: last(leaf, element), vessels)
        try:
            designed = controller(boat)
        except ConfigError as error:
            yield str(error)
            continue
        course = [designed.speeds[0], designed.rover.cruise_speed, designed.speeds[-1], designed.speeds[0]]
        laws = RoverLaw(designed.rover, designed.period), MoosLaw(designed.moos)
        for law, loop in zip(laws, designed.loops, strict=True):
            hold = float(loop.responses.time[-1]) / len(course)
            yield Case(plant, loop.name, steps_of(sailed(vessel, law, course, hold)), loop.steps)


def last(leaf: torch.Tensor, element: int) -> torch.Tensor:
    """A parameter of a boat on its last mission."""
    return leaf[-1, element] if leaf.ndim > 1 else leaf


def row(label: str, found: Sequence[Case]) -> str:
    """A line of the table."""
    true, drawn = [step for each in found for step in each.true], [step for each in found for step in each.drawn]
    over, over_drawn = (np.concatenate([each.overshoot for each in steps]) for steps in (true, drawn))
    settled, settled_drawn = (np.concatenate([each.settled for each in steps]) for steps in (true, drawn))
    sways, never = sum(bool(each.sways.any()) for each in true), int(np.isinf(settled).sum())
    cells = [f"{x:.0%}" for x in (np.median(over), np.quantile(over, 0.9), over.max(), np.quantile(over_drawn, 0.9))]
    cells += [f"{np.median(settled):.1f}", f"{np.median(settled_drawn):.1f}"]
    cells += [f"{never} of {len(settled)}", f"{sways} of {len(true)}"]
    return f"| {label} | " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, nargs="+", default=[41, 42, 43])
    parser.add_argument("--hours", type=float, nargs="+", default=[1.0, 4.0])
    given = parser.parse_args()
    text = [
        "# Speed controllers on simulated boats", "",
        f"Made by `python benchmarks/speed_controller.py --seeds {' '.join(map(str, given.seeds))}`.", "",
        *(__doc__ or "").split("\n\n")[2].strip().splitlines(), "",
        "Overshoot is a share of the step. Settled: s until the speed stays within 5 % of the step. A boat sways if",
        "its speed varies by more than 10 % of the step in the last quarter of the time. No setting was chosen on",
        "these seeds.",
    ]  # fmt: skip
    for hours in given.hours:
        found = [each for plant in PLANTS for seed in given.seeds for each in cases(plant, seed, hours)]
        done = [each for each in found if isinstance(each, Case)]
        text += [
            "", f"## Learned for {hours:g} h", "",
            "| boats | overshoot, median | 90 % below | most | of drawn boats, 90 % below | settled, median "
            "| of drawn boats | not settled | sway |", "|---|--:|--:|--:|--:|--:|--:|--:|--:|",
        ]  # fmt: skip
        for autopilot in ("ArduRover", "MOOS-IvP"):
            for plant in (*PLANTS, "all"):
                own = [each for each in done if each.autopilot == autopilot and plant in (each.plant, "all")]
                if own:
                    text.append(row(f"{plant}, {autopilot}", own))
        refused = [each for each in found if isinstance(each, str)]
        text += ["", f"Designed for {len(done) // 2} of {len(done) // 2 + len(refused)} boats."]
        text += ["", *(f"- refused: {each}" for each in refused)] if refused else []
    publish(__file__, text)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
