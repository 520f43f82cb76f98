"""The models' terms, in the paper's form where the boat goes ahead, and their signs where it backs up."""

import math
from fractions import Fraction

import pytest
import torch
from scipy.integrate import solve_ivp

from tests.support import random_samples
from usvlearn import AID, Inputs, Sample, SurgeDynamics
from usvlearn.engine.rollouts import simulate
from usvlearn.errors import ShapeError
from usvlearn.estimators.regressors import kernel
from usvlearn.estimators.regressors.layer import (
    MemoryInputs,
    force_slope,
    phi1,
    quasi_static_regressor,
    surge_regressor,
)
from usvlearn.estimators.regressors.terms import TERMS, UNITS

THETA = torch.tensor([-3.0, -16.0, -8.0, 20.0, 15.0, -3.0, 16.0, 18.0, -2.0], dtype=torch.float64)


def test_equal_the_papers_terms_ahead():
    samples = random_samples(50)
    v, (L, R, heading, r, _) = samples.surge, samples.inputs
    W = torch.stack([v.abs() * v, v, (r * v).abs(), L, L**2, L * v, R, R**2, R * v], -1)
    Phi = torch.stack([R, R**2, R**3, L, L**2, L**3, heading.sin(), heading.cos(), r.abs()], -1)
    torch.testing.assert_close(surge_regressor(v, samples.inputs), W)
    torch.testing.assert_close(quasi_static_regressor(samples.inputs), Phi)


def test_are_odd_in_the_direction_of_travel():
    """A boat that is its own mirror image fore and aft: reversing speed and commands reverses the force."""
    samples = random_samples(50)
    inputs = samples.inputs
    astern = inputs._replace(command_left=-inputs.command_left, command_right=-inputs.command_right)
    torch.testing.assert_close(surge_regressor(-samples.surge, astern), -surge_regressor(samples.surge, inputs))
    thrust = slice(0, 6)
    torch.testing.assert_close(quasi_static_regressor(astern)[:, thrust], -quasi_static_regressor(inputs)[:, thrust])


def remembered(samples):
    x = samples.inputs
    return MemoryInputs(*x, 3 * x.yaw_rate, x.command_right.flip(0), x.command_left.flip(0))


@pytest.mark.parametrize("cubic", [False, True])
@pytest.mark.parametrize(("memory", "ambient"), [(False, False), (True, False), (False, True), (True, True)])
def test_further_terms_stand_behind_the_papers(memory, ambient, cubic):
    """Cubic thrust; memory: the last acceleration and commands; ambient: a bias, and a force from one direction."""
    samples, mass = random_samples(6, 2), 28.0
    inputs = remembered(samples)
    model = SurgeDynamics(mass, memory, ambient, cubic)
    base, phi = model(samples.surge, inputs)
    W = [surge_regressor(samples.surge, samples.inputs)]
    if cubic:
        W += [torch.stack([inputs.command_left**3, inputs.command_right**3], -1)]
    if memory:
        W += [torch.stack([inputs.surge_dot, inputs.command_left_before, inputs.command_right_before], -1)]
    if ambient:
        W += [torch.stack([torch.ones_like(base), inputs.heading.sin(), inputs.heading.cos()], -1)]
    torch.testing.assert_close(phi, 0.4 / mass * torch.cat(W, -1))
    torch.testing.assert_close(base, samples.surge)
    count = 9 + 2 * cubic + 3 * (memory + ambient)
    assert phi.shape[-1] == len(model.names) == len(set(model.names)) == len(model.signs) == count
    assert set(model.names) <= set(UNITS) and model.description() in TERMS
    assert model.signs[9:] == (0,) * (len(model.signs) - 9)  # physics gives none


def test_an_ambient_force_is_constant_in_the_earths_frame():
    """A steady wind of 5 N towards 1 rad pushes the boat by 5 cos(1 − heading) along its own axis."""
    samples = random_samples(50)
    model = SurgeDynamics(28.0, ambient=True)
    _, phi = model(samples.surge, samples.inputs)
    theta = torch.zeros(12, dtype=torch.float64)
    theta[-2], theta[-1] = 5 * math.sin(1.0), 5 * math.cos(1.0)
    torch.testing.assert_close(28.0 / 0.4 * phi @ theta, 5 * (1.0 - samples.inputs.heading).cos())


def test_signs_are_those_of_a_boat():
    """Each term at its sign slows a boat that goes ahead, or pushes it: drag and the loss of thrust, and thrust."""
    model, samples = SurgeDynamics(28.0), random_samples(50)
    _, phi = model(samples.surge, samples.inputs)
    slows = torch.tensor(["drag" in name or "speed" in name for name in model.names])
    force = phi * torch.tensor(model.signs)
    assert (force[:, slows] <= 0).all() and (force[:, ~slows] >= 0).all() and slows.sum() == 5


def test_memory_terms_want_memory():
    samples = random_samples(2)
    with pytest.raises(ShapeError, match="WithMemory"):
        SurgeDynamics(28.0, memory=True)(samples.surge, samples.inputs)
    _, phi = SurgeDynamics(28.0)(samples.surge, remembered(samples))  # and what need not remember may be handed it
    torch.testing.assert_close(phi, SurgeDynamics(28.0)(samples.surge, samples.inputs)[1])


@pytest.mark.parametrize("z", [-20.0, -3.0, -0.5, -0.126, -0.124, -1e-3, -1e-9, 0.0, 1e-12, 1e-4, 0.12, 0.13, 0.5, 1.0])
@torch.enable_grad()
def test_phi1_and_its_derivative_are_exact_to_rounding(z):
    """Against their series in fractions: φ1 = Σ z^k/(k+1)!, φ1' = Σ (k+1) z^k/(k+2)!."""
    exact = Fraction(z)
    value = sum(exact**k / math.factorial(k + 1) for k in range(120))
    slope = sum((k + 1) * exact**k / math.factorial(k + 2) for k in range(120))
    at = torch.tensor(z, dtype=torch.float64, requires_grad=True)
    found, derivative = phi1(at)
    found.backward()
    assert at.grad is not None
    assert found.item() == pytest.approx(float(value), rel=1e-15)
    compiled = kernel.phi1(z)
    assert compiled[0] == pytest.approx(float(value), rel=1e-15)
    for each in (float(at.grad), derivative.item(), compiled[1]):
        assert each == pytest.approx(float(slope), rel=2e-14)


@torch.enable_grad()
def test_the_slope_of_the_force_is_its_derivative():
    samples = random_samples(50)
    surge = (samples.surge - 1.0).requires_grad_()
    (surge_regressor(surge, samples.inputs) @ THETA).sum().backward()
    torch.testing.assert_close(force_slope(surge.detach(), samples.inputs, THETA), surge.grad)


def stepped(model, surge, dt):
    inputs = Inputs(*(torch.tensor(x, dtype=torch.float64) for x in (0.7, 0.3, 0.0, 0.2, dt)))
    base, phi = model(torch.tensor(surge, dtype=torch.float64), inputs, THETA)
    return float(base + phi @ THETA)


def exactly(surge, dt):
    """The same step by an ODE solver."""

    def surge_dot(_, v):
        W = surge_regressor(torch.as_tensor(v[0]), Inputs(*torch.tensor([0.7, 0.3, 0.0, 0.2, dt], dtype=torch.float64)))
        return [float(W @ THETA) / 28.0]

    return solve_ivp(surge_dot, (0, dt), [surge], rtol=1e-11, atol=1e-13).y[0, -1]


@pytest.mark.parametrize(("exponential", "factor"), [(False, 4), (True, 8)])
def test_the_exponential_step_is_of_second_order(exponential, factor):
    """The error of one step falls as dt² by Euler, and as dt³ by the exponential step, ahead and astern."""
    model = SurgeDynamics(28.0, exponential=exponential)
    for surge in (2.0, -1.0):
        wrong = [abs(stepped(model, surge, dt) - exactly(surge, dt)) for dt in (0.1, 0.05)]
        assert wrong[0] / wrong[1] == pytest.approx(factor, rel=0.15)


def strong(exponential):
    """A hull whose drag settles it in a twentieth of a step; its steady speed is 1 m/s at both commands full."""
    theta = [0.0, -1000.0, 0.0, 500.0, 0.0, 0.0, 500.0, 0.0, 0.0]
    return AID(20.0, theta0=theta, model=SurgeDynamics(20.0, exponential=exponential))


@pytest.mark.parametrize("backend", ["torch", "kernel"])
def test_a_free_run_under_strong_drag_is_stable_where_eulers_diverges(backend):
    steps = 60
    one = torch.ones(steps, dtype=torch.float64)
    dt = torch.where(torch.arange(steps) == 0, 0.0, 0.4 * one)
    samples = Sample(Inputs(one, one, 0 * one, 0 * one, dt), 2 * one, one > 0, one > 0)
    surge = {each: simulate(aid := strong(each), aid.init(), samples, backend=backend)[1] for each in (True, False)}
    exact = 1 + torch.exp(-50.0 * 0.4 * torch.arange(1, steps, dtype=torch.float64))
    torch.testing.assert_close(surge[True][1:], exact, rtol=0, atol=1e-8)
    assert surge[False][-2:].abs().tolist() == [10.0, 10.0]  # from limit to limit


def test_exponential_steps_want_parameters():
    samples = random_samples(2)
    with pytest.raises(ShapeError, match="theta"):
        SurgeDynamics(28.0, exponential=True)(samples.surge, samples.inputs)
