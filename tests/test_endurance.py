"""10⁵ steps of idle, cruise and excitation leave every default estimator finite and sane."""

from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from usvlearn import Ensemble, Inputs, Sample, rollout
from usvlearn.estimators.regressors import surge_regressor
from usvlearn.signals import named_leaves

ROOT = Path(__file__).parents[1]
MASS = 28.0
TRUTH = torch.tensor([-3.0, -6.0, -4.0, 20.0, 15.0, -3.0, 16.0, 18.0, -2.0], dtype=torch.float64)


def field_day(excited: int, idle: int, cruise: int) -> Sample:
    """Excitation, idling, excitation, constant cruise, excitation: of one boat, noise of 0.02 m/s, 0.4 s a step."""
    generator = torch.Generator().manual_seed(0)

    def uniform(n):
        return torch.rand(n, generator=generator, dtype=torch.float64)

    def excitation():
        return torch.stack([uniform(excited // 10).repeat_interleave(10) for _ in range(2)])

    parts = [excitation(), torch.zeros(2, idle), excitation(), torch.full((2, cruise), 0.6), excitation()]
    left, right = torch.cat([part.double() for part in parts], -1)
    still = torch.cat([torch.full(p.shape[-1:], float(p.shape[-1] == excited)) for p in parts]).double()
    heading = (0.05 * torch.randn(len(left), generator=generator, dtype=torch.float64) * still).cumsum(0)
    yaw_rate = torch.diff(heading, prepend=heading[:1]) / 0.4
    surge = torch.empty_like(left)
    v = torch.zeros((), dtype=torch.float64)
    for k in range(len(left)):
        now = Inputs(left[k], right[k], heading[k], yaw_rate[k], torch.tensor(0.4))
        v = v + 0.4 / MASS * (surge_regressor(v, now) @ TRUTH)
        surge[k] = v
    noise = 0.02 * torch.randn(len(left), generator=generator, dtype=torch.float64)
    yes = torch.ones(len(left), dtype=torch.bool)
    return Sample(
        Inputs(left, right, heading, yaw_rate, torch.full_like(left, 0.4)), surge + noise * (surge > 0), yes, yes
    )


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("long", [pytest.param(46_000, marks=pytest.mark.slow), 700])
def test_idle_cruise_and_excitation(long, dtype):
    """The ensemble of `train.py`, as it is by default."""
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        cfg = compose("train", [f"vehicle.mass={MASS}"])
    ensemble = Ensemble(instantiate(cfg.estimators), instantiate(cfg.combiners, _convert_="all"), cfg.output).to(dtype)
    excited = 3000 if long > 10_000 else 400
    samples = field_day(excited, idle=long, cruise=long)
    inputs = Inputs(*(x.to(dtype) for x in samples.inputs))
    samples = Sample(inputs, samples.surge.to(dtype), samples.fresh, samples.measured)
    with torch.no_grad():
        end, _, published = rollout(ensemble, ensemble.init(), samples, record=lambda s: s.predictions)
    for name, leaf in named_leaves(end):
        assert leaf.isfinite().all(), name
    assert published.isfinite().all()
    error = (published - samples.surge[:, None]).abs()
    names = ensemble.names
    for after in (excited + long, 2 * (excited + long)):  # idling, cruise: plain forgetting errs by 1e3 m/s and more
        for name in ("aid", "dynamic_rls", "steady_rls", "memory_rls", "ensemble"):
            assert error[after : after + 50, names.index(name)].mean() < 0.1, (name, after)
    for name in ("dynamic_rls", "steady_rls", "memory_rls", "ensemble"):
        assert error[-200:, names.index(name)].mean() < 0.035, name  # the noise of target and start make 0.023
