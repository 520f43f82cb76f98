"""Seasons of boats whose parameters are known."""

import base64
from pathlib import Path

import numpy as np
import torch

from usvlearn import RLS, Average, Ensemble, Inputs, Sample, SurgeDynamics
from usvlearn.core.samples import tree_map
from usvlearn.engine.rollouts import rollout
from usvlearn.evaluation.season import Season, SeasonRun
from usvlearn.report.viewer import LEVELS

TIME = 0.4 * np.arange(200.0)


def numpied(samples: Sample) -> Sample:
    return tree_map(lambda x: x.numpy(), samples)


def boats(factors: np.ndarray, seed: int = 0) -> tuple[Ensemble, list[Season]]:
    """Boats of the surge dynamics without noise, θ times `factors` `(boats, 9)`; two runs each, a checkpoint after
    each.
    """
    rng = np.random.default_rng(seed)
    truth = torch.tensor([-3.0, -6.0, -2.0, 20.0, 8.0, -2.0, 18.0, 9.0, -2.0]).double() * torch.from_numpy(factors)
    model, n = SurgeDynamics(28.0), len(factors)
    ensemble = Ensemble({"rls": RLS(model, forgetting=0.9999, covariance=1e4)}, {"average": Average()})
    state, runs, states = ensemble.init((n,)), [], []
    for _ in range(2):
        left, right = torch.from_numpy(rng.random((2, 20, n)).repeat(10, 1))
        steps = len(left)
        yaw_rate = torch.from_numpy(0.2 * rng.standard_normal((steps, n)))
        dt = torch.full((steps, n), 0.4).double()
        dt[0] = 0.0
        v, surge = torch.zeros(n).double(), []
        for k in range(steps):
            inputs = Inputs(left[k], right[k], 0 * left[k], yaw_rate[k], dt[k])
            v = v + (model(v, inputs)[1] * truth).sum(-1)
            surge.append(v)
        yes = torch.ones(steps, n, dtype=torch.bool)
        runs.append(Sample(Inputs(left, right, 0 * left, yaw_rate, dt), torch.stack(surge), yes, yes))
        with torch.no_grad():
            state = rollout(ensemble, state, runs[-1])[0]
        states.append(state)
    return ensemble, [
        Season(
            f"boat{k}",
            tuple(SeasonRun(f"{j}", f"{k}{j}", numpied(tree_map(lambda x, k=k: x[:, k], run)), {}, TIME)
                  for j, run in enumerate(runs)),
            tree_map(lambda *x, k=k: torch.stack([each[k] for each in x]), *states),
            (Path("a"), Path(f"{k}")), np.array([0, 1]), np.array([0.02, 0.04]),
        )
        for k in range(n)
    ]  # fmt: skip


def decoded(series) -> np.ndarray:
    """The numbers of `coded`, to half a step."""
    text, low, step = series
    levels = np.frombuffer(base64.b64decode(text), "<i2").astype(float)
    return np.where(levels == -32768, np.nan, low + step * (levels + LEVELS // 2))
