"""RLS: equal to batch least squares; finite where the textbook's form is not; forgetting that pauses."""

import pytest
import torch

from tests.conftest import random_samples
from usvlearn import RLS, QuasiStatic, SurgeDynamics, rollout
from usvlearn.errors import ConfigError
from usvlearn.estimators.regressors import quasi_static_regressor, surge_regressor
from usvlearn.estimators.rls import rls_step


def weighted_least_squares(phi, y, lam, prior):
    """min Σ λ^(N−1−j) (y_j − φ_jᵀθ)² + λ^N θᵀθ/prior, by the normal equations: θ and their inverse."""
    weights = lam ** torch.arange(len(y) - 1, -1, -1.0, dtype=y.dtype)
    information = lam ** len(y) * torch.eye(phi.shape[-1], dtype=y.dtype) / prior + (phi * weights[:, None]).mT @ phi
    return torch.linalg.solve(information, (phi * weights[:, None]).mT @ y), torch.linalg.inv(information)


@pytest.mark.parametrize("lam", [0.95, 0.995])
def test_thruster_map_equals_batch_least_squares(lam):
    samples = random_samples(300)
    rls = RLS(QuasiStatic(), forgetting=lam, covariance=10.0)
    end, _, _ = rollout(rls, rls.init(), samples)
    theta, covariance = weighted_least_squares(quasi_static_regressor(samples.inputs), samples.surge, lam, 10.0)
    torch.testing.assert_close(end.theta, theta, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(end.covariance, covariance, rtol=1e-8, atol=1e-8)


def test_dynamic_rls_equals_batch_least_squares_on_the_increment():
    mass, lam = 28.0, 0.99
    samples = random_samples(300)
    rls = RLS(SurgeDynamics(mass), forgetting=lam, covariance=10.0)
    start = rls.start(rls.init(), samples.surge[0])
    later = samples._replace(
        inputs=type(samples.inputs)(*(x[1:] for x in samples.inputs)),
        surge=samples.surge[1:], fresh=samples.fresh[1:], measured=samples.measured[1:],
    )  # fmt: skip
    end, _, _ = rollout(rls, start, later)
    phi = 0.4 / mass * surge_regressor(samples.surge[:-1], later.inputs)
    theta, covariance = weighted_least_squares(phi, samples.surge.diff(), lam, 10.0 * mass**2)
    torch.testing.assert_close(end.theta, theta, rtol=1e-8, atol=1e-8)
    torch.testing.assert_close(end.covariance, covariance, rtol=1e-8, atol=1e-8)


def test_textbook_covariance_diverges_where_the_square_root_form_does_not():
    """Rounding asymmetry grows by 1/λ a step in P − K φᵀP (theory, section 3)."""
    lam, steps = 0.98, 4000
    phi = torch.randn(steps, 9, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    textbook = 100 * torch.eye(9, dtype=torch.float64)
    theta, factor = torch.zeros(9, dtype=torch.float64), 10 * torch.eye(9, dtype=torch.float64)
    forgetting = torch.tensor(lam, dtype=torch.float64)
    for k in range(steps):
        gain = textbook @ phi[k] / (lam + phi[k] @ textbook @ phi[k])
        textbook = (textbook - torch.outer(gain, textbook @ phi[k])) / lam
        theta, factor = rls_step(theta, factor, phi[k], phi[k].sum() - phi[k] @ theta, forgetting)
    weights = lam ** torch.arange(steps - 1, -1, -1.0, dtype=torch.float64)
    exact = torch.linalg.inv((phi * weights[:, None]).mT @ phi)
    assert not (textbook - exact).abs().max() < 1  # NaN, or far off
    torch.testing.assert_close(factor @ factor.mT, exact, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(theta, torch.ones_like(theta), rtol=1e-9, atol=1e-9)


def test_forgetting_pauses_at_the_limit_of_the_trace():
    rls = RLS(QuasiStatic(), forgetting=0.9, covariance=1.0, trace_growth=5.0)
    samples = random_samples(400)
    idle = samples._replace(
        inputs=type(samples.inputs)(*(torch.zeros_like(x) for x in samples.inputs[:4]), samples.inputs.dt)
    )
    end, _, _ = rollout(rls, rls.init(), idle)
    trace = rls.monitor(end)["covariance_trace"]
    assert 45 * 0.9 <= trace <= 45  # nine parameters, five times the start; without the limit 0.9^-400


def test_lanes_with_their_own_mass_scale_the_parameters_alone():
    samples = random_samples(30, 2)
    same = type(samples.inputs)(*(x[:, :1].expand(-1, 2) for x in samples.inputs))
    samples = samples._replace(inputs=same, surge=samples.surge[:, :1].expand(-1, 2))
    rls = RLS(SurgeDynamics([10.0, 40.0]))
    end, surge, _ = rollout(rls, rls.init((2,)), samples)
    torch.testing.assert_close(surge[:, 0], surge[:, 1], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(end.theta[1], 4 * end.theta[0], rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("wrong", [{"forgetting": 1.0}, {"covariance": 0.0}, {"feedback": "both"}, {"surge_max": -1.0}])
def test_illegal_hyperparameters_are_refused(wrong):
    with pytest.raises(ConfigError, match="expected"):
        RLS(**wrong)
