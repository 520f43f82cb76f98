"""The models' terms, in the paper's form where the boat goes ahead, and their signs where it backs up."""

import math

import pytest
import torch

from tests.support import random_samples
from usvlearn import QuasiStatic, SurgeDynamics
from usvlearn.errors import ConfigError, ShapeError
from usvlearn.estimators.regressors.layer import MemoryInputs, quasi_static_regressor, surge_regressor


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


def test_models_name_their_parameters():
    samples = random_samples(4, 3)
    for model in (SurgeDynamics(28.0), QuasiStatic()):
        base, phi = model(samples.surge, samples.inputs)
        assert base.shape == (4, 3) and phi.shape == (4, 3, len(model.names) == 9 and 9)
        assert len(set(model.names)) == 9
    base, phi = SurgeDynamics(28.0)(samples.surge, samples.inputs)
    torch.testing.assert_close(base, samples.surge)
    torch.testing.assert_close(phi, 0.4 / 28.0 * surge_regressor(samples.surge, samples.inputs))


def remembered(samples):
    x = samples.inputs
    return MemoryInputs(*x, 3 * x.yaw_rate, x.command_right.flip(0), x.command_left.flip(0))


@pytest.mark.parametrize(("memory", "ambient"), [(True, False), (False, True), (True, True)])
def test_further_terms_stand_behind_the_papers(memory, ambient):
    """Memory: the last acceleration and commands; ambient: a bias and a force from a compass direction."""
    samples, mass = random_samples(6, 2), 28.0
    inputs = remembered(samples)
    model = SurgeDynamics(mass, memory, ambient)
    base, phi = model(samples.surge, inputs)
    W = [surge_regressor(samples.surge, samples.inputs)]
    if memory:
        W += [torch.stack([inputs.surge_dot, inputs.command_left_before, inputs.command_right_before], -1)]
    if ambient:
        W += [torch.stack([torch.ones_like(base), inputs.heading.sin(), inputs.heading.cos()], -1)]
    torch.testing.assert_close(phi, 0.4 / mass * torch.cat(W, -1))
    torch.testing.assert_close(base, samples.surge)
    assert phi.shape[-1] == len(model.names) == len(set(model.names)) == len(model.signs) == 9 + 3 * (memory + ambient)
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


@pytest.mark.parametrize("mass", [0.0, -1.0, float("nan"), "heavy", [28.0, 0.0]])
def test_impossible_masses_are_refused(mass):
    with pytest.raises(ConfigError, match="expected"):
        SurgeDynamics(mass)
