"""AID: its Lyapunov function never rises at any gain, and it learns and leaks by its equations."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import nn

from tests.support import at, random_samples
from usvlearn import AID, Inputs, Sample, rollout
from usvlearn.core.samples import tree_map
from usvlearn.estimators.aid.layer import AIDState
from usvlearn.estimators.regressors.layer import surge_regressor

MASS = 28.0
TRUTH = torch.tensor([-3.0, -6.0, -4.0, 20.0, 15.0, -3.0, 16.0, 18.0, -2.0], dtype=torch.float64)
PRIOR = (-1.0, -8.0, 0.0, 10.0, 10.0, 0.0, 10.0, 10.0, -5.0)
SPREAD = torch.tensor([28.0, 7.0, 5.0, 20.0, 40.0, 2.0, 28.0, 14.0, 3.0], dtype=torch.float64)


def plant(steps: int, *batch: int, seed: int = 0, astern: float = 0.6) -> Sample:
    """Noise-free samples of v⁺ = v + dt·Wᵀθ/m under random commands that change every ten steps, some astern."""
    inputs = random_samples(steps, *batch, seed=seed).inputs
    held = torch.arange(steps) // 10 * 10
    left, right = ((1 + astern) * x[held] - astern for x in (inputs.command_left, inputs.command_right))
    inputs = inputs._replace(command_left=left, command_right=right)
    surge, v = [], torch.zeros(batch, dtype=torch.float64)
    for k in range(steps):
        now = at(inputs, k)
        v = v + 0.4 / MASS * (surge_regressor(v, now) @ TRUTH)
        surge.append(v)
    yes = torch.ones(steps, *batch, dtype=torch.bool)
    return Sample(inputs, torch.stack(surge), yes, yes)


def in_ball(theta, spread=SPREAD) -> float:
    return float(((theta - torch.tensor(PRIOR)) / spread).norm())


@pytest.mark.parametrize(("project", "sigma"), [(True, 0.0), (False, 0.3), (True, 1e3)])
def test_lyapunov_function_never_rises(project, sigma):
    """V = ½ Δθᵀ Γ⁻¹ Δθ falls by at least ½ e²/(1 + φᵀΓφ) a step, for any gain, while it leaks too."""
    gains = [0.01, 1.0, 1e4]  # a batch element each
    samples = plant(400, 3)
    aid = AID(MASS, gains, SPREAD.tolist(), PRIOR, sigma=sigma, bound=in_ball(TRUTH), project=project)
    gamma = torch.tensor(gains, dtype=torch.float64)[:, None] * SPREAD**2
    start = torch.tensor(PRIOR) + aid.bound * SPREAD * torch.sign(TRUTH)  # 3M away
    state = aid.init((3,))._replace(theta=start.clamp(aid.lower, aid.upper).expand(3, -1))
    value = (0.5 * (state.theta - TRUTH) ** 2 / gamma).sum(-1)
    for k in range(400):
        sample = at(samples, k)
        phi = 0.4 / MASS * surge_regressor(state.surge, sample.inputs)
        state, surge = aid(state, sample)
        drop = 0.5 * (surge - sample.surge) ** 2 / (1 + (phi * gamma * phi).sum(-1))
        after = (0.5 * (state.theta - TRUTH) ** 2 / gamma).sum(-1)
        assert (after <= value - drop + 1e-12 * (1 + value)).all()
        value = after


def test_learning_is_the_normalised_gradient_step_of_the_textbook():
    """Without clip and leak: θ − Γφe/(1 + φᵀΓφ), Γ = gain·diag(spread²), from the prior on, in plain NumPy."""
    samples = random_samples(60)
    aid = AID(MASS, 0.7, SPREAD.tolist(), PRIOR, sigma=0.0, project=False)
    end, _, _ = rollout(aid, aid.init(), samples)
    theta, v, gamma = np.array(PRIOR), 0.0, 0.7 * SPREAD.numpy() ** 2
    for k in range(60):
        left, right, _, r, dt = (float(x[k]) for x in samples.inputs)
        a, y = abs(v), float(samples.surge[k])
        W = np.array([a * v, v, abs(r) * v, left, left * abs(left), left * a, right, right * abs(right), right * a])
        phi = dt * W / MASS
        theta = theta - gamma * phi * (v + phi @ theta - y) / (1 + phi @ (gamma * phi))
        v = y
    np.testing.assert_allclose(end.theta.detach(), theta, rtol=1e-11)


def test_a_spread_of_zero_keeps_the_prior():
    aid = AID(MASS, spread=[0.0, *SPREAD.tolist()[1:]], theta0=PRIOR, bound=0.01, sigma=5.0)
    end, _, _ = rollout(aid, aid.init(), random_samples(100))
    assert end.theta[0] == PRIOR[0] and (end.theta[1:] != torch.tensor(PRIOR)[1:]).any()
    assert end.theta.isfinite().all()


@pytest.mark.parametrize("sigma", [0.01, 1.0, 1e6])
@pytest.mark.parametrize("bound", [0.5, 2.0])
def test_leakage_approaches_every_point_of_the_ball_and_leaves_the_ball_alone(sigma, bound):
    """Idle, without noise: nothing but the leak acts. V against random truths inside the ball and on its rim."""
    generator = torch.Generator().manual_seed(0)

    def ball(low: float, high: float) -> torch.Tensor:
        x = torch.randn(2000, 9, generator=generator, dtype=torch.float64)
        radius = low + (high - low) * torch.rand(2000, 1, generator=generator, dtype=torch.float64)
        return radius * bound * x / x.norm(dim=-1, keepdim=True)

    x, truth = ball(0.0, 5.0), torch.cat([ball(0.0, 1.0)[:1000], ball(1.0, 1.0)[1000:]])
    truth[::5] = bound * x[::5] / x[::5].norm(dim=-1, keepdim=True)  # the worst: straight below
    aid = AID(MASS, 1.0, SPREAD.tolist(), PRIOR, sigma=sigma, bound=bound, project=False)
    theta0, zero = aid.theta0, torch.zeros(2000, dtype=torch.float64)
    state = AIDState(theta0 + SPREAD * x, zero)
    leaked = aid.update(state, Inputs(zero, zero, zero, zero, zero + 0.4), zero)
    after, n = (leaked.theta - theta0) / SPREAD, x.norm(dim=-1)
    assert ((after - truth).norm(dim=-1) <= (x - truth).norm(dim=-1) + 1e-12).all()
    assert (n < bound).any() and torch.equal(leaked.theta[n < bound], state.theta[n < bound])
    rate = sigma * ((n - bound) / bound).clamp(0.0, 1.0)  # rises linearly up to σ at 2M
    expected = torch.maximum(n * (-0.4 * rate).exp(), n.clamp(max=bound))
    torch.testing.assert_close(after.norm(dim=-1), expected, rtol=1e-9, atol=1e-9)


def test_signs_of_physics_are_kept():
    aid, samples = AID(MASS, gain=10.0), random_samples(200)  # random speeds that no boat makes
    _, _, theta = rollout(aid, aid.init(), samples, record=lambda s: s.theta)
    signs = torch.tensor(aid.model.signs)
    assert (theta * signs >= 0).all() and (theta == 0).any()


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


def test_parallel_mode_tends_to_the_continuous_identifier():
    """v̂_dot = W(v̂)ᵀθ̂/m + a_m Δv, θ̂_dot = −Γ W Δv/m by an ODE solver; V falls along it; the error is of first order."""
    leak, gamma, mass, truth = 1.5, 2.0 * SPREAD.numpy() ** 2, MASS, TRUTH.numpy()

    def W(v: float, t: float) -> np.ndarray:
        left, right, r = 0.5 + 0.4 * np.sin(t), 0.5 + 0.4 * np.cos(0.7 * t), 0.3 * np.sin(0.3 * t)
        a = abs(v)
        return np.array([a * v, v, abs(r) * v, left, left * left, left * a, right, right * right, right * a])

    def error_equation(t: float, x: np.ndarray) -> np.ndarray:
        v, estimate, theta = x[0], x[1], x[2:]
        delta = estimate - v
        speeds = [W(v, t) @ truth / mass, W(estimate, t) @ theta / mass - leak * delta]
        return np.concatenate([speeds, -gamma * W(estimate, t) * delta / mass])

    seconds, start = 8.0, np.concatenate([[0.0, 0.4], PRIOR])
    exact = solve_ivp(error_equation, (0.0, seconds), start, rtol=1e-9, atol=1e-9, t_eval=np.linspace(0, seconds, 81))
    V = 0.5 * (exact.y[1] - exact.y[0]) ** 2 + 0.5 * ((exact.y[2:].T - truth) ** 2 / gamma).sum(1)
    assert (np.diff(V) <= 1e-9).all() and V[-1] < 0.9 * V[0]

    def discrete(dt: float) -> float:
        steps = round(seconds / dt)
        t = dt * np.arange(steps)
        inputs = Inputs(*(torch.tensor(x) for x in (
            0.5 + 0.4 * np.sin(t), 0.5 + 0.4 * np.cos(0.7 * t), 0 * t, 0.3 * np.sin(0.3 * t), dt + 0 * t)))  # fmt: skip
        v, speeds = 0.0, []
        for tk in t:
            v = v + dt * W(v, tk) @ truth / mass
            speeds.append(v)
        yes = torch.ones(steps, dtype=torch.bool)
        aid = AID(mass, 2.0, SPREAD.tolist(), PRIOR, 0.0, 0.0, feedback="estimate", leak=leak, project=False)
        state = aid.init()._replace(surge=torch.tensor(0.4, dtype=torch.float64))
        end = rollout(aid, state, Sample(inputs, torch.tensor(speeds), yes, yes))[0]
        return float(((end.theta - torch.tensor(exact.y[2:, -1])) / SPREAD).norm())

    coarse, fine = discrete(0.02), discrete(0.01)
    assert fine < 0.02 and 1.7 < coarse / fine < 2.3


@pytest.mark.parametrize("feedback", ["measured", "estimate"])
def test_without_speed_it_coasts_on_the_model(feedback):
    """With the true parameters a coasting AID follows the noise-free boat; θ is held meanwhile."""
    samples = plant(80)
    speed = samples.surge.clone()
    speed[20:70] = math.nan
    blind = samples._replace(surge=speed, measured=speed.isfinite())
    aid = AID(MASS, feedback=feedback)
    _, surge, theta = rollout(aid, AIDState(TRUTH, torch.zeros((), dtype=torch.float64)), blind, lambda s: s.theta)
    torch.testing.assert_close(surge, samples.surge, rtol=0, atol=1e-12)
    assert torch.equal(theta[20], theta[69])


class Sled(nn.Module):
    """Three parameters: drag, thrust, and a push of unknown sign."""

    names, signs, scale = ("drag", "thrust", "push"), (-1, 1, 0), 2.0

    def forward(self, surge, inputs):
        return surge, inputs.dt[..., None] * torch.stack([surge, inputs.command_left, torch.ones_like(surge)], -1)


@pytest.mark.thorough
@pytest.mark.parametrize("push", [-0.3, 0.3])
def test_any_linear_model_is_identified(push):
    inputs = random_samples(1500).inputs
    v, surge = torch.zeros((), dtype=torch.float64), []
    for left in inputs.command_left:
        v = v + 0.4 * (-0.8 * v + 1.2 * left + push)
        surge.append(v)
    yes = torch.ones(1500, dtype=torch.bool)
    aid = AID(model=Sled(), gain=10.0)
    end, _, _ = rollout(
        aid, aid.init((2,)), tree_map(lambda x: x[:, None].expand(-1, 2), Sample(inputs, torch.stack(surge), yes, yes))
    )
    expected = torch.tensor([-0.8, 1.2, push], dtype=torch.float64).expand(2, 3)
    torch.testing.assert_close(end.theta, expected, rtol=0, atol=0.01)
    assert set(aid.monitor(end)) == {"drag", "thrust", "push", "prior_distance"}
