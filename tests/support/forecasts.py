"""A small ensemble that forecasts, and samples without faults for it."""

import torch

from tests.support.kernel_cases import mission
from usvlearn import AID, ARX, BOA, Average, Ensemble, ForecastSettings, JointEKF, Persistence, Sample

HORIZONS = (0.4, 2.0, 4.0)  # s


def ensemble(conditional: bool = True, **options) -> Ensemble:
    """Four members and two rules; the options are those of its forecasts."""
    members = {"joint": JointEKF(2.0, 28.0), "arx": ARX(), "aid": AID(28.0), "persistence": Persistence()}
    rules = {"average": Average(), "boa": BOA(["joint", "arx"])}
    forecasts = ForecastSettings(**({"horizons": HORIZONS, "members": list(members)} | options))
    return Ensemble(members, rules, forecasts=forecasts, conditional=conditional)


def plain(steps: int, *batch: int, seed: int = 0) -> Sample:
    """Samples without faults, 0.4 s each."""
    samples = mission(steps, *batch, seed=seed, faults=False)
    return samples._replace(inputs=samples.inputs._replace(dt=torch.full_like(samples.inputs.dt, 0.4)))
