"""AID: its Lyapunov function never rises, its parameters converge, any gain is safe."""

import pytest
import torch

from tests.conftest import random_samples
from usvlearn import AID, Inputs, Sample, rollout
from usvlearn.errors import ConfigError
from usvlearn.estimators.aid import AIDState
from usvlearn.estimators.regressors import surge_regressor

MASS = 28.0
TRUTH = torch.tensor([-3.0, -6.0, -4.0, 20.0, 15.0, -3.0, 16.0, 18.0, -2.0], dtype=torch.float64)


def plant(steps: int, *batch: int, seed: int = 0) -> Sample:
    """Noise-free samples of v⁺ = v + dt·Wᵀθ/m under random commands that change every ten steps, some astern."""
    inputs = random_samples(steps, *batch, seed=seed).inputs
    hold = torch.arange(steps) // 10 * 10
    inputs = inputs._replace(
        command_left=1.6 * inputs.command_left[hold] - 0.6, command_right=1.6 * inputs.command_right[hold] - 0.6
    )
    surge, v = [], torch.zeros(batch, dtype=torch.float64)
    for k in range(steps):
        now = Inputs(*(x[k] for x in inputs))
        v = v + 0.4 / MASS * (surge_regressor(v, now) @ TRUTH)
        surge.append(v)
    yes = torch.ones(steps, *batch, dtype=torch.bool)
    return Sample(inputs, torch.stack(surge), yes, yes)


@pytest.mark.parametrize("gain", [0.01, 1.0, 1e4])
@pytest.mark.parametrize("project", [True, False])
def test_lyapunov_function_never_rises(gain, project):
    """V = ½ Δθᵀ Γ⁻¹ Δθ falls by at least ½ e²/(1 + φᵀΓφ) a step, for any gain."""
    samples, ratio = plant(400), (1.0, 2.0, 0.5, 1.0, 3.0, 1.0, 1.0, 0.2, 1.0)
    aid = AID(MASS, gain=gain, gain_ratio=ratio, project=project)
    gamma = gain * MASS**2 * torch.tensor(ratio, dtype=torch.float64)
    state, value = aid.init(), (0.5 * TRUTH**2 / gamma).sum()
    for k in range(400):
        sample = Sample(Inputs(*(x[k] for x in samples.inputs)), *(x[k] for x in samples[1:]))
        phi = 0.4 / MASS * surge_regressor(state.surge, sample.inputs)
        state, surge = aid(state, sample)
        drop = 0.5 * (surge - sample.surge) ** 2 / (1 + (phi * gamma * phi).sum())
        after = (0.5 * (state.theta - TRUTH) ** 2 / gamma).sum()
        assert after <= value - drop + 1e-12 * (1 + value)
        value = after


def test_parameters_converge_under_excitation():
    """Eight lanes, each excited by other commands; the slowest direction decides the tolerance."""
    aid, samples = AID(MASS, gain=10.0), plant(6000, 8)
    end, surge, _ = rollout(aid, aid.init((8,)), samples)
    start = TRUTH.norm()
    assert (end.theta - TRUTH).norm(dim=-1).max() < 0.05 * start
    assert (surge - samples.surge)[-500:].abs().max() < 0.01  # m/s, of speeds up to 2 m/s


def test_signs_of_physics_are_kept():
    aid, samples = AID(MASS, gain=10.0), random_samples(200)  # random speeds that no boat makes
    _, _, theta = rollout(aid, aid.init(), samples, record=lambda s: s.theta)
    signs = torch.tensor(aid.model.signs)
    assert (theta * signs >= 0).all() and (theta == 0).any()


def test_unnormalised_euler_step_diverges_where_this_one_does_not():
    """θ − Γφe alone is unstable once φᵀΓφ > 2 (theory, section 2)."""
    samples, gain = plant(300), 50.0
    aid = AID(MASS, gain=gain, project=False)
    end, surge, _ = rollout(aid, aid.init(), samples)
    theta, v = torch.zeros(9, dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    for k in range(300):
        phi = 0.4 / MASS * surge_regressor(v, Inputs(*(x[k] for x in samples.inputs)))
        theta = theta - gain * MASS**2 * phi * (v + phi @ theta - samples.surge[k])
        v = samples.surge[k]
    assert not theta.abs().max() < 1e6
    assert end.theta.abs().max() < 1e3 and (surge - samples.surge)[-50:].abs().max() < 0.05


def test_dead_zone_learns_nothing_from_small_errors():
    samples = random_samples(1)
    aid = AID(MASS, dead_zone=0.5)
    small = samples._replace(surge=torch.full_like(samples.surge, 0.5))
    large = samples._replace(surge=torch.full_like(samples.surge, 0.7))
    assert rollout(aid, aid.init(), small)[0].theta.abs().max() == 0
    step = rollout(aid, aid.init(), large)[0].theta
    full = rollout(AID(MASS), aid.init(), large._replace(surge=torch.full_like(samples.surge, 0.2)))[0].theta
    torch.testing.assert_close(step, full)  # beyond the zone, the excess alone counts


def test_estimate_is_drawn_to_the_measurement_exactly():
    """Parallel mode without learning: Δv⁺ = Δv exp(a_m dt)."""
    aid = AID(MASS, gain=1e-12, feedback="estimate", leak=2.0)
    samples = random_samples(1)
    state = AIDState(torch.zeros(9, dtype=torch.float64), torch.tensor(1.0, dtype=torch.float64))
    measured = samples._replace(surge=torch.zeros_like(samples.surge))
    end, surge, _ = rollout(aid, state, measured)
    assert surge[0] == 1.0
    torch.testing.assert_close(end.surge, torch.tensor(-0.8, dtype=torch.float64).exp(), rtol=1e-9, atol=0)


def test_mass_scales_the_parameters_and_nothing_else():
    samples = random_samples(100)
    light, heavy = AID(10.0), AID(100.0)
    one, v1, _ = rollout(light, light.init(), samples)
    ten, v10, _ = rollout(heavy, heavy.init(), samples)
    torch.testing.assert_close(v1, v10)
    torch.testing.assert_close(10 * one.theta, ten.theta)


@pytest.mark.parametrize(
    "wrong", [{"mass": 0.0}, {"gain": -1.0}, {"gain_ratio": [1.0]}, {"dead_zone": -1.0}, {"feedback": ""}]
)
def test_illegal_hyperparameters_are_refused(wrong):
    with pytest.raises(ConfigError, match="expected"):
        AID(**wrong)
