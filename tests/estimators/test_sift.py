"""SIFt-RLS: the information form of Lai and Bernstein, what is forgotten, and what nothing informs."""

import math

import numpy as np
import pytest
import torch

from tests.support import random_samples
from usvlearn import Inputs, SIFtRLS, SurgeDynamics, rollout
from usvlearn.estimators.least_squares.sift import sift_step

TAU = 20.0


def series(steps: int, p: int = 4, seed: int = 0):
    """Regressors, measurements and irregular time steps of a noisy linear model whose parameters are all 1."""
    rng = np.random.default_rng(seed)
    phi = rng.standard_normal((steps, p)) * rng.uniform(0.1, 2.0, p)
    y = phi.sum(-1) + 0.1 * rng.standard_normal(steps)
    return phi, y, np.exp(-rng.uniform(0.05, 2.0, steps) / TAU)


def run(phi, y, lam, factor, theta=None, dtype=torch.float64, step=sift_step):
    """(θ, S) after the rows of φ, from θ = 0."""
    phi, y, lam = (torch.as_tensor(x).to(dtype) for x in (phi, y, lam))
    theta = torch.zeros(phi.shape[1:], dtype=dtype) if theta is None else theta
    for k in range(len(phi)):
        theta, factor = step(theta, factor, phi[k], y[k] - (phi[k] * theta).sum(-1), lam[k])
    return theta, factor


def dense_oracle(phi, y, lam, covariance):
    """The paper's recursion of the information: R̄ = R − (1−λ)Rφφᵀ R/(φᵀRφ), R⁺ = R̄ + φφᵀ, θ⁺ = θ + R⁺⁻¹φe."""
    R, theta = np.linalg.inv(covariance), np.zeros(phi.shape[1])
    for x, target, keep in zip(phi, y, lam, strict=True):
        Rx = R @ x
        R = R - (1 - keep) * np.outer(Rx, Rx) / (x @ Rx) + np.outer(x, x)
        R = (R + R.T) / 2
        theta = theta + np.linalg.solve(R, x * (target - x @ theta))
    return theta, np.linalg.inv(R)


@pytest.mark.thorough
def test_equals_the_information_form():
    phi, y, lam = series(3000)
    theta, factor = run(phi, y, lam, 3.0 * torch.eye(4, dtype=torch.float64))
    expected, covariance = dense_oracle(phi, y, lam, 9.0 * np.eye(4))
    np.testing.assert_allclose(theta, expected, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(factor @ factor.mT, covariance, rtol=1e-10, atol=1e-13)


def test_without_forgetting_it_is_least_squares():
    phi, y, _ = series(200)
    theta, factor = run(phi, y, np.ones(200), 3.0 * torch.eye(4, dtype=torch.float64))
    information = phi.T @ phi + np.eye(4) / 9
    np.testing.assert_allclose(theta, np.linalg.solve(information, phi.T @ y), rtol=1e-11)
    np.testing.assert_allclose(factor @ factor.mT, np.linalg.inv(information), rtol=1e-10)


def test_one_direction_alone_is_forgotten_and_learned():
    """Samples of one direction φ: the variance across it never grows, and from P ∝ I neither it nor θ changes there."""
    phi, y, lam = series(50)
    x = torch.as_tensor(phi[0])
    across = torch.linalg.svd(x[None])[2][1:].mT  # (4, 3), orthonormal, ⟂ φ
    start = 3.0 * torch.eye(4, dtype=torch.float64)
    rows, target, keep = phi[:1].repeat(1000, 0), np.full(1000, 7.0), np.full(1000, 0.95)
    theta, factor = run(rows, target, keep, start)
    torch.testing.assert_close(across.mT @ factor @ factor.mT @ across, 9.0 * torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(across.mT @ theta, torch.zeros(3, dtype=torch.float64), rtol=0, atol=1e-12)
    torch.testing.assert_close((x * theta).sum(), x.new_tensor(7.0))
    # the information along φ, r⁺ = λ r + 1, settles at 1/(1 − λ)
    torch.testing.assert_close(1 / (x @ factor @ factor.mT @ x), x.new_tensor(20.0))
    theta, factor = run(phi, y, lam, start)  # now P is no longer round
    for _ in range(5):
        theta, after = run(rows[:10], target[:10], keep[:10], factor, theta)
        for w in across.mT:
            assert w @ after @ after.mT @ w <= (w @ factor @ factor.mT @ w) * (1 + 1e-9)
        factor = after


def test_irregular_steps_forget_by_the_time_that_passed():
    """Along φ, R⁺ = λ R + φφᵀ, so 1/(φᵀP⁺φ) = λ/(φᵀPφ) + 1 with λ = exp(−dt/τ)."""
    rls = SIFtRLS(SurgeDynamics(28.0), memory=TAU)
    one = torch.ones(1, dtype=torch.float64)
    for dt in (0.1, 0.4, 3.0):
        state = rls.init((1,))
        inputs = Inputs(0 * one, 0 * one, 0 * one, 0 * one, dt * one)
        state = rls.start(state, 2 * one)
        phi = rls.model(state.surge, inputs)[1][0]
        learned = rls.update(state, inputs, 1.9 * one)
        before, after = (1 / (phi @ s.covariance[0] @ phi) for s in (state, learned))
        torch.testing.assert_close(after, math.exp(-dt / TAU) * before + 1)


def test_nothing_changes_below_the_floor():
    rls = SIFtRLS(SurgeDynamics(28.0), floor=0.01)
    samples = random_samples(4, 2)
    state, _, _ = rollout(rls, rls.init((2,)), samples)
    small = torch.tensor([1e-3, 1.0], dtype=torch.float64)  # |φ·m|² = (0.4 · 1e-3)² · 2 in the first batch element
    inputs = Inputs(small, 0 * small, 0 * small, 0 * small, torch.full_like(small, 0.4))
    state = rls.start(state, torch.zeros_like(small))
    after = rls.update(state, inputs, torch.full_like(small, 0.3))
    assert torch.equal(after.theta[0], state.theta[0]) and torch.equal(after.factor[0], state.factor[0])
    assert not torch.equal(after.theta[1], state.theta[1]) and not torch.equal(after.factor[1], state.factor[1])
    assert torch.equal(after.surge, torch.full_like(small, 0.3))
    nothing = SIFtRLS(SurgeDynamics(28.0), floor=0.0)  # even then a regressor of zeros informs nothing
    after = nothing.update(state, inputs._replace(command_left=0 * small), torch.full_like(small, 0.3))
    assert torch.equal(after.theta, state.theta) and torch.equal(after.factor, state.factor)


def day(steps: int, p: int = 6):
    """Idling, cruise with a little noise, and excitation in turn, a sixth each of so many steps."""
    rng = np.random.default_rng(3)
    phi = rng.standard_normal((steps, p))
    part = np.arange(steps) * 6 // steps
    cruise = rng.standard_normal(p)
    phi[part % 3 == 0] = 0.0
    phi[part % 3 == 1] = cruise
    phi[part % 3 == 1] += 1e-3 * rng.standard_normal(((part % 3 == 1).sum(), p))
    return phi, phi.sum(-1) + 0.05 * rng.standard_normal(steps)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("dtype", "steps"),
    [(torch.float64, 4500), pytest.param(torch.float32, 4500, marks=pytest.mark.slow),
     pytest.param(torch.float64, 1_000_000, marks=pytest.mark.slow),
     pytest.param(torch.float32, 1_000_000, marks=pytest.mark.slow)],
)  # fmt: skip
def test_idling_cruise_and_excitation_stay_bounded(dtype, steps):
    """The trace of P never exceeds its start: nothing that was ever known is lost without a sample that replaces it."""
    phi, y = day(steps)
    theta, factor = torch.zeros(6, dtype=dtype), math.sqrt(10.0) * torch.eye(6, dtype=dtype)
    lam, worst = torch.tensor(math.exp(-0.4 / 4.0), dtype=dtype), 0.0
    rows, targets = torch.as_tensor(phi).to(dtype), torch.as_tensor(y).to(dtype)
    for k in range(steps):
        x = rows[k]
        theta, factor = sift_step(theta, factor, x, targets[k] - x @ theta, lam, (x * x).sum() >= 1e-4)
        if k % 100 == 0 or k > steps - 100:
            worst = max(worst, float((factor * factor).sum()))
    assert worst <= 60 * (1 + 1e-4)
    assert float((theta - 1).abs().max()) < 0.1
