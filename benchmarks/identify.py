"""How true identified parameters are, and how often their intervals hold.

python benchmarks/identify.py [--seed 77]        writes docs/benchmarks/identify.md

Five plants, three boats each, 3 h to learn from and 1 h for open-loop simulations (`benchmarks/truths.py`). The
filter's settings and the widths of its intervals were chosen on seeds 5, 11 and 78 to 80. Seed 77 was only reported,
whenever the filter had changed.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from pages import publish

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(Path(__file__).parent))

from output_error import Fit, fit, free_runs  # noqa: E402
from timing import table  # noqa: E402
from truths import MINUTES, NOMINAL, PLANTS, Boat, Truths, boats, errors, free_run_mae, model_acceleration, truths  # noqa: E402

from usvlearn.core.samples import Sample  # noqa: E402
from usvlearn.engine.backend import arrays_of  # noqa: E402
from usvlearn.engine.rollouts import rollout, tensors  # noqa: E402
from usvlearn.estimators.joint.periodic_estimates import Identified, identify  # noqa: E402
from usvlearn.estimators.joint.quantities import Ahead, sums  # noqa: E402
from usvlearn.estimators.joint.state import NORTH, THETA  # noqa: E402
from usvlearn.simulate.truth import true_parameters, true_quantities  # noqa: E402

HOURS, LATER, N = 3.0, 1.0, 3
AIMS = {"drag": 0.05, "thrust": 0.06, "steady_speed": 0.022, "time_constant": 0.12}
MAIN = ("drag_half_speed", "thrust_full_left", "thrust_full_right", "steady_speed_full", "time_constant")
ERRORS = """\
Median of the relative error over the boats; the quantities are those of `benchmarks/truths.py`. Open-loop simulation:
median ratio of the MAE to that of the batch fit, parameters frozen, over the fourth hour. The batch fit and the
averaged joint EKF take the mean
of their currents over the missions that they have learned; the others know of no current."""
AT = (1, 2, 4, 6, 9, 18)  # missions after which the coverage is noted


class Found(NamedTuple):
    """One method on one boat."""

    errors: Truths  # relative
    free: float  # m/s, MAE of open-loop simulations


def judged(parameters: dict[str, float], lag: float, current: np.ndarray, boat: Boat) -> Found:
    """Errors and open-loop simulations of parameters per mass."""
    model = Fit(parameters, lag, np.asarray(current)[None], 0.0)
    wrong = errors(truths(model_acceleration(parameters), boat.top), boat.truth)
    return Found(wrong, free_run_mae(free_runs(model, boat.later), boat.later))


def members(plant: str) -> dict[str, Any]:
    """The estimators by name, as `train.py` makes them for a plant."""
    mass, top = NOMINAL[plant]
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        given = [f"vehicle.mass={mass}", f"vehicle.surge_max={top}"]
        cfg = compose("train", given)
        return {name: instantiate(cfg.estimators[name]) for name in ("joint_averaged", "aid")}


def ahead(theta: np.ndarray) -> dict[str, float]:
    """Nine parameters and cubic thrust of motion ahead, whose fore-aft asymmetry terms are added; per mass."""
    boat = Ahead(theta)
    found = {name: float(boat.sums[name]) for name in sums(True) if not name.startswith("thrust_full")}
    for side in ("left", "right"):
        cubic = float(boat.cubic[side])
        found[f"thrust_cubic_{side}"] = cubic
        found[f"thrust_linear_{side}"] += 0.4 * cubic
        found[f"thrust_quadratic_{side}"] -= 4 / 3 * cubic
    return found


def learned(estimator: Any, runs: Sequence[Sample]) -> tuple[list[Any], float]:
    """The state after each run of a boat, and the seconds that a step took."""
    state, states, steps = estimator.init(), [], 0
    began = time.perf_counter()
    with torch.no_grad():
        for run in runs:
            state, _, _ = rollout(estimator, state, tensors(run, torch.float64))
            states.append(state)
            steps += len(run.surge)
    return states, (time.perf_counter() - began) / steps


def identified(averaged: Any, state: Any) -> Identified:
    return identify(averaged.description(), arrays_of(state))


def study(
    seed: int, plants=PLANTS
) -> tuple[dict[str, list[Found]], list[tuple[dict[int, Identified], dict[str, float]]]]:
    """Every method on every boat; of each boat what was identified after some missions, and the truth at the end."""
    found: dict[str, list[Found]] = {name: [] for name in ("output error, batch", "joint_averaged", "aid")}
    intervals = []
    for plant in plants:
        mass, top = NOMINAL[plant]
        season = {"n": N, "plant": plant, "hours": HOURS + LATER, "mission_minutes": MINUTES, "seed": seed}
        every = members(plant)
        known = true_parameters(mass, **season)
        truth = true_quantities(mass, known, **season, mission=round(HOURS * 60 / MINUTES) - 1)
        for boat in boats(plant, seed, N, HOURS, LATER):
            best = fit(boat.learned, top)
            batch = judged(best.parameters, best.lag, best.current.mean(0), boat)
            found["output error, batch"].append(batch)
            states, _ = learned(every["joint_averaged"], boat.learned)
            noted = {k: identified(every["joint_averaged"], states[min(k, len(states)) - 1]) for k in AT}
            intervals.append((noted, truth[boat.name]))
            theta = noted[AT[-1]].theta
            flow = np.mean([state.mean[NORTH:THETA].numpy() for state in states], 0)
            found["joint_averaged"].append(judged(ahead(theta), float(theta[-1]), flow, boat))
            state = learned(every["aid"], boat.learned)[0][-1]
            per_mass = dict(zip(every["aid"].model.names, (state.theta / mass).tolist(), strict=True))
            found["aid"].append(judged(per_mass, 0.0, np.zeros(2), boat))
            print(boat.name, *(f"{name} {each[-1].free:.3f}" for name, each in found.items()), flush=True)
    return found, intervals


def covered(intervals, after: int, names=None) -> list[bool]:
    """Whether each interval holds its truth."""
    return [
        each[after][name].low <= truth[name] <= each[after][name].high
        for each, truth in intervals
        for name in names or truth
    ]


def report(seed: int) -> str:
    found, intervals = study(seed)
    batch = [each.free for each in found["output error, batch"]]
    rows = []
    for name, each in found.items():
        wrong = [statistics.median(abs(getattr(one.errors, key)) for one in each) for key in AIMS]
        bias = statistics.median(one.errors.drag for one in each)
        ratio = statistics.median(one.free / other for one, other in zip(each, batch, strict=True))
        rows.append([name, *(f"{x:.1%}" for x in wrong), f"{bias:+.1%}", f"{ratio:.2f}"])
    rows.append(["aim", *(f"{x:.1%}" for x in AIMS.values()), "", "1.02"])
    head = ["", *(key.replace("_", " ") for key in AIMS), "bias of drag", "open-loop simulation/batch"]
    groups = {"five main quantities": MAIN, "all quantities": None}
    held = [[name, *(f"{np.mean(covered(intervals, k, own)):.0%}" for k in AT)] for name, own in groups.items()]
    each = []
    for name in intervals[0][1]:
        at_end = [(one[AT[-1]][name], truth[name]) for one, truth in intervals]
        wide = statistics.median((one.high - one.low) / 2 / abs(true) if true else np.nan for one, true in at_end)
        wrong = statistics.median(abs(one.value - true) / abs(true) if true else np.nan for one, true in at_end)
        shown = [f"{x:.0%}" if np.isfinite(x) and x < 10 else "–" for x in (wide, wrong)]
        each.append([name, f"{np.mean(covered(intervals, AT[-1], [name])):.0%}", *shown])
    opening = (
        f"Made by `python benchmarks/identify.py --seed {seed}`: {len(PLANTS)} plants, {N} boats each, {HOURS:.0f} h "
        f"to learn from, then {LATER:.0f} h of open-loop simulations. Settings and widths were chosen on seeds 5 and "
        "11, those of single coefficients on 78 to 80."
    )
    parts = [
        ["# Identified parameters against the truth"], [opening], ["## Errors"], [ERRORS], table(head, rows),
        ["## Intervals of 90 %"],
        [f"Share of the truths that the intervals hold, over all boats. The main quantities are {', '.join(MAIN)}."],
        table(["after", *(f"{k * MINUTES:.0f} min" for k in AT)], held),
        [f"After {AT[-1] * MINUTES:.0f} min, by quantity, relative to the truth:"],
        table(["quantity", "holds", "half-width", "median error"], each),
    ]  # fmt: skip
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--seed", type=int, default=77)
    chosen = options.parse_args()
    text = report(chosen.seed)
    if chosen.seed == 77:
        publish(__file__, text)
    else:
        print(text)
