"""10⁵ steps of idle, cruise and excitation leave every default estimator finite and sane."""

import pytest
import torch

from usvlearn import (
    AID,
    RLS,
    RNN,
    Average,
    Ensemble,
    Inputs,
    Persistence,
    RecursiveWeights,
    Sample,
    SurgeDynamics,
    rollout,
)
from usvlearn.estimators.regressors import surge_regressor
from usvlearn.signals import named_leaves

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
@pytest.mark.parametrize(
    "tenfold",
    [pytest.param(False, id="defaults", marks=pytest.mark.slow), pytest.param(True, id="memories_of_a_tenth")],
)
def test_idle_cruise_and_excitation(tenfold, dtype):
    """With memories ten times shorter, 10⁴ steps wind a covariance up as far as 10⁵ do."""
    lam, lam_weights = (0.995**10, 0.999**10) if tenfold else (0.995, 0.999)
    members = {
        "aid": AID(MASS),
        "rls": RLS(forgetting=lam),
        "dynamic_rls": RLS(SurgeDynamics(MASS), forgetting=lam),
        "rnn": RNN(),
        "persistence": Persistence(),
    }
    rules = {"average": Average(), "weighted": RecursiveWeights(forgetting=lam_weights)}
    ensemble = Ensemble(members, rules).to(dtype)
    excited, long = (1000, 3500) if tenfold else (3000, 46_000)
    samples = field_day(excited, idle=long, cruise=long)
    inputs = Inputs(*(x.to(dtype) for x in samples.inputs))
    samples = Sample(inputs, samples.surge.to(dtype), samples.fresh, samples.measured)
    assert len(samples.surge) == (10_000 if tenfold else 101_000)
    with torch.no_grad():
        end, _, published = rollout(ensemble, ensemble.init(), samples, record=lambda s: s.predictions)
    for name, leaf in named_leaves(end):
        assert leaf.isfinite().all(), name
    assert published.isfinite().all()
    error = (published - samples.surge[:, None]).abs()
    names = ensemble.names
    after_idling = slice(excited + long, excited + long + 50)  # 20 s
    # m/s: five hours of noise at standstill move parameters; plain forgetting without a limit errs by 1e3 and more
    for name, worst in {"aid": 1.5, "dynamic_rls": 3.0}.items():
        k = names.index(name)
        assert error[after_idling, k].max() < worst, name
        assert error[-800:, k].mean() < 0.04, name  # the noise of target and start make 0.023
