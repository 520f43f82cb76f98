"""Simulated boats whose truth is known, and what an identified model of a boat gets wrong.

A model is told by its acceleration as a function of the speed and of both commands, going straight, without current and
disturbance. This is what surge data identify: every parameter in proportion to the mass. With a(v, ξ_L, ξ_R) in m/s²,
and V the true top speed of the boat:

    drag            −a(V/2, 0, 0)                       m/s²      at half the top speed
    thrust          a(V/2, ½, ½) − a(V/2, 0, 0)         m/s²      of both sides, at half command and half the top speed
    steady_speed    v where a(v, 1, 1) = 0              m/s       both sides at full command
    time_constant   −1/(∂a/∂v)(V/2, ½, ½)               s         at half command and half the top speed

`errors` gives each one relative to its truth. V/2 and ½ are in the middle of what the boats do, so that no quantity is
an extrapolation. Thrust tables and a knee in the drag count as they are: no curve is fitted to the truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from peers.batch import bounded

from usvlearn.core.samples import Sample, masks, tree_map
from usvlearn.logs.recordings import align_fleet
from usvlearn.simulate.fleet import fleet, fleet_vessels
from usvlearn.simulate.vessel import Vessel, drag, steady_surge, thrust

PLANTS = ("heron", "kingfisher", "vtec", "otter", "wamv")
NOMINAL = {"heron": (28.0, 2.74), "kingfisher": (35.0, 1.5), "vtec": (32.25, 1.5), "otter": (85.5, 3.1),
           "wamv": (180.0, 7.7)}  # fmt: skip  # mass, kg, and top speed, m/s, as a user would state them
MINUTES, DT = 10.0, 0.4  # of a mission; s, of a step
Acceleration = Callable[[float, float, float], float]  # of speed, m/s, and both commands: m/s²


class Truths(NamedTuple):
    """Quantities of a boat, or of a model of it."""

    drag: float  # m/s², per mass
    thrust: float  # m/s², per mass
    steady_speed: float  # m/s
    time_constant: float  # s


class Boat(NamedTuple):
    """A simulated boat and its logs, aligned."""

    name: str
    plant: str
    learned: list[Sample]  # runs to learn from, leaves (time,)
    later: list[Sample]  # the runs after them
    top: float  # true top speed, m/s
    truth: Truths  # on the last mission that was learned; parameters drift over the season


def vessel_acceleration(vessel: Vessel) -> Acceleration:
    """That of a true vessel without batch axes."""

    def acceleration(v: float, left: float, right: float) -> float:
        speed, command = torch.tensor(v, dtype=torch.float64), torch.tensor([left, right], dtype=torch.float64)
        return float((drag(vessel, speed) + thrust(vessel, command, speed).sum()) / vessel.mass)

    return acceleration


def model_acceleration(parameters: Mapping[str, float], mass: float = 1.0) -> Acceleration:
    """That of identified parameters by the names of `SurgeDynamics`, and "thrust_cubic_left" and "_right" if any.

    >>> model_acceleration({"drag_linear": -0.5, "thrust_linear_left": 2.0})(2.0, 1.0, 0.0)
    1.0
    """

    def acceleration(v: float, left: float, right: float) -> float:
        force = parameters.get("drag_quadratic", 0.0) * abs(v) * v + parameters.get("drag_linear", 0.0) * v
        for side, xi in (("left", left), ("right", right)):
            terms = {"linear": xi, "quadratic": xi * abs(xi), "speed": xi * abs(v), "cubic": xi**3}
            force += sum(parameters.get(f"thrust_{kind}_{side}", 0.0) * term for kind, term in terms.items())
        return float(force / mass)

    return acceleration


def truths(acceleration: Acceleration, top: float) -> Truths:
    """The quantities of a model, or of the truth; `top` is the true top speed V, m/s.

    A steady speed beyond 3 V counts as 3 V, and a model that does not settle has an infinite time constant.

    >>> linear = model_acceleration({"drag_linear": -0.5, "thrust_linear_left": 1.0, "thrust_linear_right": 1.0})
    >>> truths(linear, top=4.0)
    Truths(drag=1.0, thrust=1.0, steady_speed=4.0, time_constant=2.0)
    """
    half, step = top / 2, 1e-4 * top
    coasting, driven = acceleration(half, 0.0, 0.0), acceleration(half, 0.5, 0.5)
    low, high = 0.0, 3 * top
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if acceleration(middle, 1.0, 1.0) > 0 else (low, middle)
    slope = (acceleration(half + step, 0.5, 0.5) - acceleration(half - step, 0.5, 0.5)) / (2 * step)
    time_constant = -1 / slope if slope < 0 else math.inf
    return Truths(-coasting, driven - coasting, round(high, 9), round(time_constant, 9))


def errors(found: Truths, truth: Truths) -> Truths:
    """Each quantity relative to its truth, less 1.

    >>> errors(Truths(0.9, 1.1, 2.0, 3.0), Truths(1.0, 1.0, 2.0, 2.0)).time_constant
    0.5
    """
    return Truths(*(a / b - 1 for a, b in zip(found, truth, strict=True)))


def boats(plant: str, seed: int, n: int = 3, hours: float = 3.0, later: float = 1.0, **options) -> list[Boat]:
    """`n` boats of a plant: the first `hours` of their season to learn from, and the `later` ones after them."""
    season = {"n": n, "plant": plant, "seed": seed, "hours": hours + later, "mission_minutes": MINUTES, **options}
    aligned = align_fleet(fleet(**season), dt=DT, patience=1.0)
    missions, last = math.ceil((hours + later) * 60 / MINUTES), round(hours * 60 / MINUTES) - 1
    vessels = fleet_vessels(n, season.get("spread", 1.0), plant, seed, missions, season.get("drift", 0.2))
    tops = steady_surge(vessels, torch.ones(2, dtype=torch.float64)).expand(missions, n)
    found = []
    for k, name in enumerate(aligned.boats):
        runs: tuple[list[Sample], list[Sample]] = [], []
        for run in aligned.runs:
            if run.names[k]:
                one = tree_map(lambda x, k=k, end=run.lengths[k]: x[:end, k], run.samples)
                runs[int(run.names[k][:3]) - 1 > last].append(one)
        top = float(tops[last, k])
        truth = truths(vessel_acceleration(_one(vessels, last, k)), top)
        found.append(Boat(name, plant, *runs, top, truth))
    return found


def free_run_mae(predictions: Sequence[np.ndarray], runs: Sequence[Sample]) -> float:
    """The mean absolute error of open-loop simulations, m/s, over all steps whose speed was measured."""
    pairs = zip(predictions, runs, strict=True)
    return float(np.concatenate([bounded(made - run.surge)[masks(run).learns] for made, run in pairs]).mean())


def _one(vessels: Vessel, mission: int, boat: int) -> Vessel:
    """One boat on one mission, without batch axes."""
    sides = {name for name in Vessel._fields if name.startswith("thrust")}

    def cut(name: str, leaf: torch.Tensor) -> torch.Tensor:
        own = (1 if name in sides else 0) + (name == "thrust_table")
        batch = leaf.ndim - own
        return leaf[mission % len(leaf), boat] if batch == 2 else leaf

    return Vessel(**{name: cut(name, leaf) for name, leaf in vessels._asdict().items()})
