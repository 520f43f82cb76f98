"""Up to 10⁷ steps of idle, cruise and excitation leave every default estimator, rule and monitor finite and sane."""

import pytest
import torch

from tests.support import few
from tests.support.configured import default_ensemble
from usvlearn import ExponentialWeights, FixedWeights, Inputs, Sample, rollout
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.estimators.regressors.layer import surge_regressor

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


@pytest.mark.thorough
@pytest.mark.parametrize("dtype", few([torch.float64, torch.float32], [torch.float64]), ids=["float64", "float32"])
@pytest.mark.parametrize("long", [pytest.param(46_000, marks=pytest.mark.slow), 700])
def test_idle_cruise_and_excitation(long, dtype):
    ensemble = default_ensemble(dtype)
    excited = 3000 if long > 10_000 else 400
    samples = field_day(excited, idle=long, cruise=long)
    samples = tree_map(lambda x: x.to(dtype) if x.is_floating_point() else x, samples)
    with torch.no_grad():
        end, _, published = rollout(ensemble, ensemble.init(), samples, record=lambda s: s.predictions)
    for name, leaf in named_leaves(end):
        assert leaf.isfinite().all(), name
    assert published.isfinite().all()
    error = (published - samples.surge[:, None]).abs()
    names = ensemble.names
    for after in (excited + long, 2 * (excited + long)):  # idling, cruise: plain forgetting errs by 1e3 m/s and more
        for name in ("aid", "joint", "joint_quick", "arx", "joint_averaged", "ensemble"):
            most = 0.3 if name == "joint_quick" else 0.12  # whose large disturbance takes the noise for motion
            assert error[after : after + 50, names.index(name)].mean() < most, (name, after)
    for name in (
        "joint",
        "joint_quick",
        "arx",
        "joint_averaged",
        "ensemble",
    ):  # the noise of target and start make 0.023
        assert error[-200:, names.index(name)].mean() < (0.08 if name == "joint_quick" else 0.035), name


def steered(steps: int, left: float, seed: int) -> Sample:
    """A boat that is steered by its thrusters, of which the left one has this share of its thrust; 0.4 s a step."""
    generator = torch.Generator().manual_seed(seed)
    commands = torch.rand(2, steps // 12 + 1, generator=generator, dtype=torch.float64).repeat_interleave(12, 1)
    yaw_noise, surge_noise = torch.randn(2, steps, generator=generator, dtype=torch.float64)
    yaw_rate, surge, r, v = torch.empty(steps).double(), torch.empty(steps).double(), 0.0, 0.9
    for k, (one, other) in enumerate(commands[:, :steps].T.tolist()):
        push, pull = left * one * one, other * other
        r = 0.5 * r + 0.3 * (push - pull)
        v += 0.4 / MASS * (20 * (push + pull) - 6 * v - 3 * v * abs(v))
        yaw_rate[k], surge[k] = r + 0.05 * yaw_noise[k], v + 0.02 * surge_noise[k]
    heading, yes = 0.4 * yaw_rate.cumsum(0), torch.ones(steps, dtype=torch.bool)
    return Sample(Inputs(*commands[:, :steps], heading, yaw_rate, torch.full_like(surge, 0.4)), surge, yes, yes)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("dtype", "cruise"),
    [
        pytest.param(torch.float32, 1_000_000, id="float32", marks=pytest.mark.slow),
        pytest.param(torch.float64, 200_000, id="float64"),
        pytest.param(torch.float64, 10_000_000, id="float64-long", marks=pytest.mark.slow),
    ],
)
def test_a_thruster_that_fails_after_a_long_steady_cruise_is_seen(dtype, cruise):
    """At constant commands without noise the sums of the thrusters' monitor lose their rank, in float32 by rounding."""
    ensemble = default_ensemble(dtype, exponential=ExponentialWeights(), fixed=FixedWeights({"aid": 0.5, "rnn": 0.5}))
    chunk = 100_000
    constant = [torch.full((chunk,), x, dtype=dtype) for x in (0.6, 0.6, 0.3, 0.0, 0.4, 0.9)]
    yes = torch.ones(chunk, dtype=torch.bool)
    steady, state = Sample(Inputs(*constant[:5]), constant[5], yes, yes), ensemble.init()

    def sail(state, samples):
        single = tree_map(lambda x: x.to(dtype) if x.is_floating_point() else x, samples)
        with torch.no_grad():
            state, predictions, _ = rollout(ensemble, state, single)
        for name, leaf in named_leaves(state):
            assert leaf.isfinite().all(), name
        return state, predictions

    for _ in range(cruise // chunk):
        state, predictions = sail(state, steady)
    assert (predictions - 0.9).abs().max() < 1e-3
    state, _ = sail(state, steered(4500, left=1.0, seed=1))  # half an hour in which the thrusters are learned
    assert state.monitors.thrusters.alarms == 0
    state, _ = sail(state, steered(600, left=0.3, seed=2))
    assert state.monitors.thrusters.raised.tolist() == [1.0, 0.0]
