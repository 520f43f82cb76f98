"""Whether a plan reaches the intervals of a lawn-mower mission in half of its time.

python benchmarks/plan.py [--seeds 21 22]        writes docs/benchmarks/plan.md

Five plants, three boats of each and seed, with the sensors, currents and thrust tables of `usvlearn/simulate`. The
averaged joint EKF learns 5 min of a lawn-mower mission, which is what a first run may hold. From there it learns either
10 min more of a lawn-mower mission, each line at a speed of its own, or a plan of 5 min, and then a second plan, made
from what the first one told. A third choice is 10 min of patrol: throttles and turns at random, with coasting, and
without a plan. All boats are steered by the same autopilot; in a plan and on patrol the throttle is open, and headings
are held.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from pages import FOLDER

sys.path.insert(0, str(Path(__file__).parent))

from truths import NOMINAL, PLANTS

from usvlearn import JointEKF
from usvlearn.core.samples import tree_map
from usvlearn.engine.backend import arrays_of
from usvlearn.engine.rollouts import rollout, tensors
from usvlearn.estimators.joint.reading import Identified, identify
from usvlearn.estimators.joint.state import JointState
from usvlearn.logs.channels.channel import Recording
from usvlearn.logs.recordings import align_fleet
from usvlearn.model.planning.course import Limits
from usvlearn.model.planning.exchange import Plan, derived, search, wide
from usvlearn.model.planning.rehearsal import Rehearsal
from usvlearn.simulate.autopilot import Autopilot
from usvlearn.simulate.fleet import fleet_vessels, sail
from usvlearn.simulate.scenario import Mission, lawn_mower, patrol
from usvlearn.simulate.sensors import Sensors, Truth, measure
from usvlearn.simulate.truth import true_parameters, true_quantities
from usvlearn.simulate.vessel import Vessel

N, FIRST, LONG, MINUTES, DT, NOTED = 3, 5.0, 10.0, 5.0, 0.4, 15.0  # boats; min, min, min; s, s
MAIN = ("thrust_full_left", "thrust_full_right", "drag_half_speed", "steady_speed_full", "time_constant")
WIDTHS = """\
Half-widths relative to the truth, medians over the boats. As planned: what is predicted for the first plan. Time: until
an interval of the plans first is as narrow as that at the lawn mower's end, over 10 min; the median over the boats.
Parameters walk in the filter, so that intervals widen again where the boat cruises: the last columns therefore compare
the ends. They have the share of the boats whose interval after 5 min of the plan, or of the patrol, is at most that
after 10 min of the lawn mower. Those missions and patrols end with 15 s of coasting, which tells much of the drag."""


class Sailed(NamedTuple):
    """One mission of one boat."""

    state: JointState
    noted: list[Identified]  # every `NOTED` s


class Pair(NamedTuple):
    """One boat that sailed both."""

    truth: dict[str, float]
    begin: Identified
    mower: list[Identified]
    patrol: list[Identified]
    half_patrol: Identified  # after one of half the time
    plan: list[Identified]
    expected: Identified  # after the first plan, as planned
    seconds: float  # of the search


class Waters:
    """One boat in its current.

    Args:
        vessel: without axes of missions and boats.
        seed: of its current and sensors.
    """

    def __init__(self, vessel: Vessel, plant: str, seed: list[int]):
        self.vessel, self.plant, self.rng = vessel, plant, np.random.default_rng(seed)
        flow = self.rng.uniform(0, 0.3), self.rng.uniform(0, 2 * np.pi)
        self.current = [torch.tensor(x, dtype=torch.float64) for x in flow]
        mass, top = NOMINAL[plant]
        self.averaged = JointEKF(surge_max=top, mass=mass, disturbance=0.05, lag=0.3, cubic=1.0, even=0.2,
                               current=0.15, current_time=600.0, drift_time=5000.0, read_every=600.0)  # fmt: skip

    def sailed(self, state: JointState, mission: Mission) -> Sailed:
        """The averaged joint EKF after a mission."""
        autopilot = Autopilot()
        dt, surge, heading, commands = sail(self.vessel, [[mission]], *self.current, autopilot)
        truth = Truth(dt, surge[:, 0, 0].numpy(), heading[:, 0, 0].numpy(), 1 / autopilot.hz, commands[:, 0, 0].numpy())
        recording = Recording(self.plant, "mission", *measure(self.rng, truth, Sensors()))
        (run,) = align_fleet([recording], dt=DT, patience=1.0).runs
        samples, noted, each = tree_map(lambda x: x[:, 0], run.samples), [], round(NOTED / DT)
        for first in range(0, len(samples.surge), each):
            part = tree_map(lambda x, a=first: x[a : a + each], samples)
            with torch.no_grad():
                state = rollout(self.averaged, state, tensors(part, torch.float64))[0]
            noted.append(self.identified(state))
        return Sailed(state, noted)

    def identified(self, state: JointState) -> Identified:
        return identify(self.averaged.spec(), arrays_of(state))

    def drawn(self, kind: Callable[..., Mission], minutes: float) -> Mission:
        hz = Autopilot().hz
        return kind(self.rng, round(60 * minutes * hz), hz)

    def plan(self, state: JointState, seed: int) -> Plan:
        rehearsal = Rehearsal({"": self.averaged.spec()}, arrays_of(state))
        limits = Limits(MINUTES, area=max(200.0, 60 * NOMINAL[self.plant][1]))
        return search(rehearsal, limits, DT, wide(rehearsal.found) or derived(rehearsal.found), seed)


def mission_of(plan: Plan) -> Mission:
    """A plan for the autopilot: open throttle, headings held."""
    hz = Autopilot().hz
    at = np.minimum((np.arange(round(60 * MINUTES * hz)) / hz / DT).astype(int), len(plan.course.left) - 1)
    none = np.full(len(at), np.nan)
    return Mission(none, plan.course.throttle[at], plan.course.wanted[at], np.ones(len(at)), np.zeros(len(at)))


def one(vessels: Vessel, boat: int) -> Vessel:
    """One boat of a fleet, without axes."""
    own = {"thrust_table": 2, "thrust_linear": 1, "thrust_quadratic": 1, "thrust_speed": 1}
    return Vessel(**{
        name: leaf[0, min(boat, leaf.shape[1] - 1)] if leaf.ndim == own.get(name, 0) + 2 else leaf
        for name, leaf in vessels._asdict().items()
    })  # fmt: skip


def pairs(seed: int, plants: Sequence[str] = PLANTS) -> Iterator[Pair]:
    """Each boat with a lawn-mower mission and with plans."""
    for plant in plants:
        mass = NOMINAL[plant][0]
        season = {"n": N, "plant": plant, "hours": 0.25, "mission_minutes": 15.0, "seed": seed, "drift": 0.0}
        truths = true_quantities(mass, true_parameters(mass, **season), **season)
        vessels = fleet_vessels(N, 1.0, plant, seed, 1, 0.0)
        for k, truth in enumerate(truths.values()):
            waters = Waters(one(vessels, k), plant, [seed, PLANTS.index(plant), k])
            begin = waters.sailed(waters.averaged.init(), waters.drawn(lawn_mower, FIRST))
            mower = waters.sailed(begin.state, waters.drawn(lawn_mower, LONG))
            watch = waters.sailed(begin.state, waters.drawn(patrol, LONG))
            brief = waters.sailed(begin.state, waters.drawn(patrol, MINUTES))
            began = time.perf_counter()
            first = waters.plan(begin.state, seed)
            took = time.perf_counter() - began
            half = waters.sailed(begin.state, mission_of(first))
            second = waters.sailed(half.state, mission_of(waters.plan(half.state, seed + 1)))
            yield Pair(
                truth,
                begin.noted[-1],
                mower.noted,
                watch.noted,
                brief.noted[-1],
                half.noted + second.noted,
                first.expected.found,
                took,
            )


def width(found: Identified, name: str) -> float:
    return found[name].high - found[name].low


def ratio(pair: Pair, name: str, noted: list[Identified]) -> float:
    """The time in which an interval first is that of the lawn mower's end, over the lawn mower's; inf: never."""
    goal = width(pair.mower[-1], name)
    reached = [k for k, found in enumerate(noted, 1) if width(found, name) <= goal]
    return reached[0] * NOTED / (60 * LONG) if reached else np.inf


def ended(pair: Pair, name: str, after: Identified) -> bool:
    """Whether an interval is at most that of the lawn mower's end."""
    return width(after, name) <= width(pair.mower[-1], name)


def holds(found: list[tuple[Identified, dict[str, float]]], names) -> float:
    """The share of the truths that the intervals hold."""
    return float(np.mean([each[name].low <= truth[name] <= each[name].high for each, truth in found for name in names]))


def report(found: list[Pair], seeds: list[int]) -> str:
    names = derived(found[0].begin)
    half = round(60 * MINUTES / NOTED)
    rows = [
        "| quantity | at first | lawn mower, 10 min | patrol, 10 min | plan, 5 min | as planned | two plans, 10 min "
        "| time | plan: in half | patrol: in half |",
        "|---|" + "--:|" * 9,
    ]
    for name in names:

        def wide_of(pick, name=name) -> str:
            each = [width(pick(pair), name) / 2 / abs(pair.truth[name]) for pair in found]
            return f"{statistics.median(each):.0%}"

        middle = statistics.median(ratio(pair, name, pair.plan) for pair in found)
        cells = [
            wide_of(lambda pair: pair.begin), wide_of(lambda pair: pair.mower[-1]),
            wide_of(lambda pair: pair.patrol[-1]), wide_of(lambda pair: pair.plan[half - 1]),
            wide_of(lambda pair: pair.expected), wide_of(lambda pair: pair.plan[-1]),
            f"{middle:.2f}" if np.isfinite(middle) else "> 1",
            f"{np.mean([ended(pair, name, pair.plan[half - 1]) for pair in found]):.0%}",
            f"{np.mean([ended(pair, name, pair.half_patrol) for pair in found]):.0%}",
        ]  # fmt: skip
        rows.append(f"| {name} | " + " | ".join(cells) + " |")
    cases = [(pair, name) for pair in found for name in names]
    first = statistics.median(ratio(pair, name, pair.plan) for pair, name in cases)
    share = np.mean([ended(pair, name, pair.plan[half - 1]) for pair, name in cases])
    wandering = np.mean([ended(pair, name, pair.half_patrol) for pair, name in cases])
    picks: list[Callable[[Pair], Identified]] = [
        lambda pair: pair.begin, lambda pair: pair.mower[-1], lambda pair: pair.patrol[-1],
        lambda pair: pair.plan[half - 1], lambda pair: pair.plan[-1],
    ]  # fmt: skip
    at = [[(pick(pair), pair.truth) for pair in found] for pick in picks]
    coverage = [
        "| quantity | at first | lawn mower, 10 min | patrol, 10 min | plan, 5 min | two plans, 10 min |",
        "|---|" + "--:|" * len(picks),
    ]
    for title, group in (*((name, [name]) for name in names), ("main quantities", MAIN), ("all of these", names)):
        coverage.append(f"| {title} | " + " | ".join(f"{holds(each, group):.0%}" for each in at) + " |")
    slowest = max(pair.seconds for pair in found)
    parts = [
        "# Plans beside lawn-mower missions",
        f"Made by `python benchmarks/plan.py --seeds {' '.join(map(str, seeds))}`: {len(found)} boats.",
        __doc__.strip().split("\n\n")[-1],
        "## Intervals of 90 %",
        WIDTHS,
        "\n".join(rows),
        f"Over all quantities and boats: the median time is {first:.2f}; {share:.0%} of the intervals are reached by "
        f"the end of one plan, in half of the time, and {wandering:.0%} by a patrol. The slowest search took "
        f"{slowest:.0f} s.",
        "## Whether the intervals hold",
        f"Share of the truths that the intervals hold. The main quantities are {', '.join(MAIN)}. "
        "[Identified parameters against the truth](identify.md) has the same for its mixed missions.",
        "\n".join(coverage),
    ]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seeds", type=int, nargs="+", default=[21, 22])
    options.add_argument("--output", type=Path, default=FOLDER / "plan.md")
    chosen = options.parse_args()
    torch.set_num_threads(1)
    made = []
    for each_seed in chosen.seeds:
        for pair in pairs(each_seed):
            made.append(pair)
            print(len(made), *(f"{name} {ratio(pair, name, pair.plan):.2f}" for name in MAIN), flush=True)
    text = report(made, chosen.seeds)
    print(text)
    chosen.output.write_text(text)
