"""The models' terms, in the paper's form where the boat goes ahead, and their signs where it backs up."""

import torch

from tests.support import random_samples
from usvlearn import SurgeDynamics
from usvlearn.estimators.regressors.layer import quasi_static_regressor, surge_regressor
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


def test_cubic_thrust_stands_behind_the_papers_terms():
    samples, model = random_samples(6, 2), SurgeDynamics(28.0, cubic=True)
    base, phi = model(samples.surge, samples.inputs)
    cubes = torch.stack([samples.inputs.command_left**3, samples.inputs.command_right**3], -1)
    expected = torch.cat([surge_regressor(samples.surge, samples.inputs), cubes], -1)
    torch.testing.assert_close(phi, 0.4 / 28.0 * expected)
    torch.testing.assert_close(base, samples.surge)
    assert phi.shape[-1] == len(model.names) == len(set(model.names)) == len(model.signs) == 11
    assert set(model.names) <= set(UNITS) and model.description() in TERMS
    assert model.signs[9:] == (0, 0)  # physics gives none


def test_signs_are_those_of_a_boat():
    """Each term at its sign slows a boat that goes ahead, or pushes it: drag and the loss of thrust, and thrust."""
    model, samples = SurgeDynamics(28.0), random_samples(50)
    _, phi = model(samples.surge, samples.inputs)
    slows = torch.tensor(["drag" in name or "speed" in name for name in model.names])
    force = phi * torch.tensor(model.signs)
    assert (force[:, slows] <= 0).all() and (force[:, ~slows] >= 0).all() and slows.sum() == 5
