"""Errors of least squares without one cause or another: of drag, thrust and time constant.

python benchmarks/bias.py        writes docs/benchmarks/bias.md

`steady_rls` on simulated boats, without one cause or another: five plants, three boats of each, 3 h, seeds 5 and 11.
The median over the boats of the error of drag, thrust and time constant, as `benchmarks/truths.py` defines them.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pages import publish

sys.path.insert(0, str(Path(__file__).parent))

from truths import NOMINAL, PLANTS, Boat, Truths, boats, errors, model_acceleration, truths

from usvlearn import Projected, Robust, SIFtRLS, SurgeDynamics, rollout
from usvlearn.engine.rollouts import tensors
from usvlearn.evaluation.members import unwrapped
from usvlearn.simulate.sensors import Sensors

SEEDS = (5, 11)
QUIET = {"surge_noise": 0.0, "surge_quantum": 1e-6, "outlier_share": 0.0, "heading_noise": 0.0, "surge_filtered": 0.0}
SEASONS: dict[str, dict[str, Any]] = {
    "as simulated": {},
    "exact sensors": {"sensors": Sensors(**QUIET)},
    "no current": {"current": 0.0},
    "no current, exact sensors": {"current": 0.0, "sensors": Sensors(**QUIET)},
}
MODELS: dict[str, dict[str, bool]] = {
    "nine parameters, Euler's step": {},
    "cubic thrust": {"cubic": True},
    "exponential step": {"exponential": True},
    "both": {"cubic": True, "exponential": True},
}


def steady_rls(model: SurgeDynamics) -> Robust:
    """The estimator of `configs/estimator/steady_rls.yaml`, with another model."""
    signs = [-1, -1, -1] + [0] * (len(model.names) - 3)
    inner = Projected(SIFtRLS(model, memory=1000.0, covariance=1000.0), signs)
    return Robust(inner, threshold=8.0, patience=2, inflation=20.0, scale=0.2)


@torch.no_grad()
def wrong(boat: Boat, **options: bool) -> Truths:
    """The errors of what `steady_rls` has learned at the end."""
    mass = NOMINAL[boat.plant][0]
    estimator = steady_rls(SurgeDynamics(mass, **options))
    state = estimator.init()
    for run in boat.learned:
        state = rollout(estimator, state, tensors(run, torch.float64))[0]
    inner, learned = unwrapped(estimator, state)
    parameters = dict(zip(inner.model.names, learned.theta.tolist(), strict=True))
    return errors(truths(model_acceleration(parameters, mass), boat.top), boat.truth)


def table() -> Iterator[str]:
    """Lines of the table."""
    yield "| season | model | drag | thrust | time constant |"
    yield "|---|---|" + "---:|" * 3
    for season, options in SEASONS.items():
        fleet = [boat for seed in SEEDS for plant in PLANTS for boat in boats(plant, seed, **options)]
        for model, choice in MODELS.items():
            found = np.median([wrong(boat, **choice) for boat in fleet], axis=0)
            drag, thrust, _, time_constant = (f"{100 * x:+.0f} %" for x in found)
            yield f"| {season} | {model} | {drag} | {thrust} | {time_constant} |"


def main() -> None:
    torch.set_num_threads(1)
    lines = ["# Why least squares finds drag and thrust too small", "", __doc__.strip().split("\n\n")[-1], "", *table()]
    publish(__file__, lines)


if __name__ == "__main__":
    main()
