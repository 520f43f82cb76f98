"""The models' terms, in the paper's form where the boat goes ahead, and their signs where it backs up."""

import pytest
import torch

from tests.conftest import random_samples
from usvlearn import QuasiStatic, SurgeDynamics
from usvlearn.errors import ConfigError
from usvlearn.estimators.regressors import quasi_static_regressor, surge_regressor


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


@pytest.mark.parametrize("mass", [0.0, -1.0, float("nan"), "heavy", [28.0, 0.0]])
def test_impossible_masses_are_refused(mass):
    with pytest.raises(ConfigError, match="expected"):
        SurgeDynamics(mass)
