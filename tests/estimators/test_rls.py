"""RLS: equal to batch least squares; finite where the textbook's form is not; forgetting that pauses."""

import math

import pytest
import torch

from tests.support import at, random_samples
from tests.support.kernel_cases import inflated
from usvlearn import RLS, QuasiStatic, SIFtRLS, SurgeDynamics, rollout
from usvlearn.core.samples import tree_map
from usvlearn.estimators.least_squares.rls import NOISE, NOISE_LEAST, NOISE_SHARE, RLSState, rls_step, spread
from usvlearn.estimators.regressors.layer import quasi_static_regressor, surge_regressor


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


@pytest.mark.thorough
def test_textbook_covariance_diverges_where_the_square_root_form_does_not():
    """Rounding asymmetry grows by 1/λ a step in P − K φᵀP (`docs/theory/estimators.md#rls`)."""
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


def test_excitation_is_the_share_of_the_first_variance_that_the_data_removed():
    rls = RLS(SurgeDynamics(28.0), covariance=10.0)
    state = rls.init()
    values = rls.monitor(state._replace(factor=state.factor / 2))
    assert [values[f"excitation_{name}"].item() for name in rls.model.names] == pytest.approx([0.75] * 9)


def test_elements_with_their_own_mass_scale_the_parameters_alone():
    samples = random_samples(30, 2)
    same = type(samples.inputs)(*(x[:, :1].expand(-1, 2) for x in samples.inputs))
    samples = samples._replace(inputs=same, surge=samples.surge[:, :1].expand(-1, 2))
    rls = RLS(SurgeDynamics([10.0, 40.0]))
    end, surge, _ = rollout(rls, rls.init((2,)), samples)
    torch.testing.assert_close(surge[:, 0], surge[:, 1], rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(end.theta[1], 4 * end.theta[0], rtol=1e-7, atol=1e-7)


class Linear(QuasiStatic):
    """v = φᵀθ with the inputs as regressors."""

    names, signs = ("left", "right", "heading", "yaw_rate"), (0,) * 4

    def forward(self, surge, inputs):
        return torch.zeros_like(surge), torch.stack(inputs[:4], -1)


def linear(steps: int, *batch: int, sigma=0.1):
    samples = random_samples(steps, *batch)
    generator = torch.Generator().manual_seed(7)
    inputs = samples.inputs._replace(heading=samples.inputs.heading - 3.0)
    surge = torch.stack(inputs[:4], -1) @ torch.tensor([0.5, 0.4, 0.1, -0.3], dtype=torch.float64)
    noise = torch.randn(steps, *batch, generator=generator, dtype=torch.float64)
    return samples._replace(inputs=inputs, surge=surge + sigma * noise)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", [lambda: RLS(Linear(), 0.99), lambda: SIFtRLS(Linear(), memory=40.0)])
def test_noise_and_deviation_are_those_of_the_innovations(kind):
    """Standardised by the deviation that was foretold, innovations have variance 1, early and late, in each batch
    element.
    """
    sigma = torch.tensor([0.01, 0.1, 0.5], dtype=torch.float64).repeat_interleave(4)
    samples, rls = linear(1500, 12, sigma=sigma), kind()
    record = lambda s: {"noise": s.noise, "deviation": s.deviation}  # noqa: E731
    _, surge, arrays = rollout(rls, rls.init((12,)), samples, record=record)
    assert (arrays["noise"][1000:].mean(0).sqrt() / sigma - 1).abs().max() < 0.12
    standard = ((samples.surge - surge) / arrays["deviation"]).square().reshape(1500, 3, 4)
    assert (standard[500:].mean((0, 2)).sqrt() - 1).abs().max() < 0.08
    assert standard[5:50].mean() < 4  # few samples, large P: foretold too


def test_deviation_equals_the_formula():
    """σ² (1 + φᵀPφ) of the step that was predicted, before it was learned from (3)."""
    samples, rls = linear(20, 2), RLS(Linear())
    state, _, _ = rollout(rls, rls.init((2,)), samples)
    now = at(samples.inputs, 3)
    phi = torch.stack(now[:4], -1)
    variance = state.noise * (1 + (phi[:, None] @ state.covariance @ phi[..., None])[:, 0, 0])
    for after in (rls.predict(state, now)[0], rls.update(state, now, samples.surge[3])):
        torch.testing.assert_close(after.deviation, variance.sqrt())
    torch.testing.assert_close(spread(state.factor, phi), variance / state.noise)
    innovation = samples.surge[3] - (phi * state.theta).sum(-1)
    seen = innovation**2 * state.noise / variance  # its share that is noise, not the parameters' uncertainty
    assert (seen < 16 * state.noise).all()
    torch.testing.assert_close(after.noise, (1 - NOISE_SHARE) * state.noise + NOISE_SHARE * seen)
    assert rls.monitor(after)["deviation"] is after.deviation


@pytest.mark.thorough
def test_noise_is_moved_little_by_one_outlier_and_comes_back_from_rest():
    samples, rls = linear(400), RLS(Linear())
    state, _, _ = rollout(rls, rls.init(), samples)
    now = at(samples.inputs, 3)
    after = rls.update(state, now, samples.surge[3] + 1e6)
    torch.testing.assert_close(after.noise, (1 + 15 * NOISE_SHARE) * state.noise)
    still = state._replace(theta=torch.zeros(4, dtype=torch.float64))
    rest = tree_map(torch.zeros_like, now)._replace(dt=now.dt)
    for _ in range(2000):
        still = rls.update(still, rest, samples.surge[0] * 0)
    torch.testing.assert_close(still.noise, torch.full_like(still.noise, NOISE_LEAST**2))
    back, _, _ = rollout(rls, still, samples)
    assert float(back.noise.sqrt()) == pytest.approx(0.1, rel=0.3)
    assert NOISE_LEAST < NOISE


@pytest.mark.thorough
@pytest.mark.parametrize("kind", [RLS, SIFtRLS])
def test_inflation_is_of_the_covariance_alone(kind):
    samples, rls = random_samples(20), kind(SurgeDynamics(28.0))
    state, _, _ = rollout(rls, rls.init(), samples)
    loose = inflated(rls, state, 9.0)
    torch.testing.assert_close(loose.covariance, 9 * state.covariance)
    for name in set(RLSState._fields) - {"factor"}:
        assert torch.equal(getattr(loose, name), getattr(state, name))
    wide = state._replace(factor=1e6 * state.factor)  # beyond the limit it is not deflated
    assert torch.equal(inflated(rls, wide, 4.0).factor, wide.factor)


@pytest.mark.parametrize("feedback", ["measured", "estimate"])
@pytest.mark.parametrize("kind", [RLS, SIFtRLS])
def test_learn_is_update_and_predict_also_beyond_the_physical_limit(kind, feedback):
    samples, rls = random_samples(30, 2), kind(SurgeDynamics(28.0), feedback=feedback, surge_max=1.0)
    state = rls.init((2,))
    limited = 0
    for k in range(30):
        inputs = at(samples.inputs, k)
        learned, surge = rls.learn(state, inputs, samples.surge[k])
        updated, (coasted, predicted) = rls.update(state, inputs, samples.surge[k]), rls.predict(state, inputs)
        assert torch.equal(surge, predicted) and torch.equal(surge, coasted.surge)
        for x, y in zip(learned, updated, strict=True):
            assert torch.equal(x, y)
        torch.testing.assert_close(learned.deviation, coasted.deviation)
        assert torch.equal(learned.surge, surge if feedback == "estimate" else samples.surge[k])
        limited += int((surge.abs() == 1.0).sum())
        state = learned
    assert limited > 0 and math.isfinite(float(state.theta.detach().sum()))
