"""The ARX filter against a Kalman filter with a dense covariance, against a ridge regression, and on hard samples."""

import functools
import math

import numpy as np
import pytest
import torch

from tests.support import few, over, random_samples
from tests.support.kernel_cases import inflated, mission
from usvlearn import ARX, Inputs, Sample, rollout
from usvlearn.core.samples import PLAUSIBLE, masks, named_leaves, tree_map
from usvlearn.engine.rollouts import simulate

OPTIONS = {
    "default": {},
    "no_lags": {"lags": 0, "even": False},
    "all_features": {"lags": 2, "turning": True, "thrust_speed": True, "scale": 2.0, "walk": 1e-2},
    "gaussian": {"lags": 1, "degrees": None, "surge_max": 1.0, "project": False},
}


class History:
    """f of a boat, from the lists of all its commands, yaw rates and speeds since the segment's start."""

    def __init__(self, arx: ARX):
        self.arx = arx
        self.start(0.0)

    def start(self, speed):
        self.speeds, self.steps, self.commands, self.yaw_rates = [speed], [], [], []

    def features(self, left, right, yaw_rate):
        arx, limit = self.arx, self.arx.surge_max
        if not self.commands:
            self.commands, self.yaw_rates = [(left, right)] * arx.lags, [yaw_rate]
        self.commands.append((left, right))
        self.yaw_rates.append(yaw_rate)
        v = float(np.clip(self.speeds[-1], -limit, limit))
        rates = [(b - a) / h for a, b, h in zip(self.speeds, self.speeds[1:], self.steps, strict=False)]
        rates = list(np.clip([0.0] * arx.lags + rates, -limit, limit))[::-1][: arx.lags]
        f = [1.0, v, v * abs(v), abs(yaw_rate) * v, *rates]
        for l, r in self.commands[::-1][: arx.lags + 1]:  # noqa: E741
            f += [l + r, l - r, l * abs(l), r * abs(r)]
        if arx.even:
            f += [abs(left) + abs(right), left**2 + right**2, v * v, (left + right) * v]
        if arx.turning:
            f += [yaw_rate, yaw_rate - self.yaw_rates[-2]]
        if arx.thrust_speed:
            f += [left * abs(v), right * abs(v)]
        return np.array(f)


def prior_deviations(arx: ARX) -> np.ndarray:
    scales = [1, 10, 10, 10, *(30 / (1 + j) for j in range(arx.lags)), *[10] * (4 * arx.lags + 4)]
    scales += [1] * 4 * arx.even + [10] * 2 * arx.turning + [10] * 2 * arx.thrust_speed
    return np.array(scales) * float(arx.scale())


def slowed(arx: ARX, theta, P):
    """θ moved, in the metric of P⁻¹, to where drag slows a boat: one sum of weights after the other."""
    quadratic, even = np.eye(len(theta))[2], np.zeros(len(theta))
    if arx.even:
        even[arx.names.index("even_speed_square")] = 1.0
    for a in (np.eye(len(theta))[1], quadratic + even, quadratic - even) if arx.project else ():
        if a @ theta > 0:
            theta = theta - P @ a * (a @ theta) / (a @ P @ a)
    return theta


def textbook(arx: ARX, samples: Sample):
    """Predictions, θ, P and σ² of a Kalman filter whose covariance is one dense matrix; one boat."""
    use, inputs = masks(samples, PLAUSIBLE), tree_map(lambda x: x.numpy(), samples.inputs)
    prior = prior_deviations(arx) ** 2
    P, theta, noise, turn, rest = np.diag(prior), np.zeros(len(prior)), 0.05**2, 0, 0.0
    history, walk = History(arx), float(arx.walk())
    nu = math.inf if arx.degrees is None else float(arx.degrees())
    predictions = np.full(len(samples.surge), np.nan)
    for k, surge in enumerate(samples.surge.numpy()):
        if use.starts[k]:
            history.start(surge)
        if not use.steps[k]:
            continue
        left, right, yaw_rate = inputs.command_left[k], inputs.command_right[k], inputs.yaw_rate[k]
        h, f = min(inputs.dt[k] / 0.4, 25.0), history.features(left, right, yaw_rate)
        estimate = history.speeds[-1] + h * f @ theta
        predictions[k] = np.clip(estimate, -arx.surge_max, arx.surge_max)
        if use.learns[k]:
            rest = rest + inputs.dt[k] if left**2 + right**2 + f[1] ** 2 < 0.01 else 0.0
            if rest <= 60:
                phi, e = h * f, surge - estimate
                S = 1 + phi @ P @ phi
                w = 1.0 if nu == math.inf else (nu + 1) / (nu + e * e / (S * noise))
                K = P @ phi / (1 / w + phi @ P @ phi)
                theta, P = theta + K * e, P - np.outer(K, P @ phi)
                P = (P + P.T) / 2
                theta = slowed(arx, theta, P)
                P[turn, turn] += max(0.0, min(len(f) * h * walk * prior[turn], prior[turn] - P[turn, turn]))
                noise = max(noise + 0.02 * (w * e * e / S - noise), 1e-6)
                turn = (turn + 1) % len(f)
        history.speeds.append(surge if use.learns[k] else predictions[k])
        history.steps.append(h)
    return predictions, theta, P, noise


def covariance(state) -> torch.Tensor:
    U = state.factor.tril(-1).mT + torch.eye(state.factor.shape[-1], dtype=state.factor.dtype)
    return U @ torch.diag_embed(state.factor.diagonal(dim1=-2, dim2=-1)) @ U.mT


def constant(steps: int, left: float, right: float, surge, dt: float = 0.4, dtype=torch.float64) -> Sample:
    """The same commands at every step; a speed, or one for each step."""
    full, yes = [torch.full((steps,), x, dtype=dtype) for x in (left, right, 0.0, 0.0, dt)], torch.ones(steps) > 0
    return Sample(Inputs(*full), torch.as_tensor(surge, dtype=dtype).expand(steps).clone(), yes, yes)


def noise(steps: int, deviation: float = 0.02) -> torch.Tensor:
    return deviation * torch.randn(steps, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


@pytest.mark.thorough
@pytest.mark.parametrize("options", few(OPTIONS, ["default"], "thorough"))
def test_equals_a_dense_kalman_filter(options):
    """Over missing, stale and outlying samples, new segments, rest, and steps of different lengths."""
    arx, samples = ARX(**OPTIONS[options]), mission(600, seed=2)
    assert masks(samples).starts.sum() > 2 and (masks(samples).steps & ~masks(samples).learns).sum() > 10
    state, surge, _ = rollout(arx, arx.init(), samples)
    predictions, theta, P, variance = textbook(arx, samples)
    np.testing.assert_allclose(surge, predictions, atol=1e-7, rtol=1e-7)
    np.testing.assert_allclose(state.theta, theta, atol=1e-6 * abs(theta).max())
    np.testing.assert_allclose(covariance(state), P, atol=1e-6 * P.max())
    np.testing.assert_allclose(state.noise, variance, rtol=1e-6)


def test_without_walk_and_tails_it_is_a_ridge_regression():
    """θ minimises |y − Φθ|² + θᵀP₀⁻¹θ."""
    arx, samples = ARX(lags=2, degrees=None, walk=1e-30, project=False), mission(300, seed=1, faults=False)
    state, _, _ = rollout(arx, arx.init(), samples)
    history, rows, increments = History(arx), [], []
    for left, right, _, yaw_rate, dt, surge in zip(*samples.inputs, samples.surge, strict=True):
        h = float(dt) / 0.4
        rows.append(h * history.features(float(left), float(right), float(yaw_rate)))
        increments.append(float(surge) - history.speeds[-1])
        history.speeds.append(float(surge))
        history.steps.append(h)
    wide = np.vstack([rows, np.diag(1 / prior_deviations(arx))])
    solution = np.linalg.lstsq(wide, np.r_[increments, np.zeros(wide.shape[1])], rcond=None)[0]
    np.testing.assert_allclose(state.theta, solution, atol=1e-8)
    np.testing.assert_allclose(covariance(state), np.linalg.inv(wide.T @ wide), atol=1e-8)


def test_student_weight():
    """The first correction of the bias, P = s², is e s²/(1/w + s²): it grows with e, then falls; Gaussian, it grows."""
    still = tree_map(lambda x: x[0], constant(1, 0.0, 0.0, 0.0).inputs)
    errors = torch.tensor([0.05, 0.5, 5.0, 50.0], dtype=torch.float64)
    thetas = {}
    assert ARX(degrees=math.inf).degrees is None
    for degrees in (3.0, None):
        arx = ARX(degrees=degrees, scale=2.0)
        inputs = tree_map(lambda x: x.expand(4), still)
        thetas[degrees] = arx.update(arx.init((4,)), inputs, errors).theta[:, 0]
        weight = 1.0 if degrees is None else (degrees + 1) / (degrees + errors**2 / (5 * 0.05**2))
        torch.testing.assert_close(thetas[degrees], errors * 4 / (1 / torch.as_tensor(weight) + 4))
    assert thetas[3.0][1] > thetas[3.0][0] and (thetas[3.0].diff() < 0)[1:].all() and (thetas[None].diff() > 0).all()


def test_a_segment_starts_without_memory():
    """Increments before a start count as 0, commands as this step's, whatever came before."""
    arx = ARX(lags=2, turning=True)
    state, _, _ = rollout(arx, arx.init(), mission(200))
    opening = tree_map(torch.clone, random_samples(6, seed=5))
    opening.inputs.dt[0] = 0.0
    other = state._replace(past=state.past + 1.0, surge=state.surge - 0.5)
    pairs = [rollout(arx, each, opening)[1][1:] for each in (state, other)]
    assert torch.equal(*pairs)
    history = History(arx)
    history.start(float(opening.surge[0]))
    f = history.features(*(float(x[1]) for x in (*opening.inputs[:2], opening.inputs.yaw_rate)))
    assert f[4] == f[5] == 0 and f[6] == f[10] == f[14] and f[-1] == 0
    torch.testing.assert_close(pairs[0][0], opening.surge[0] + torch.from_numpy(f) @ state.theta)


def test_free_runs_are_bounded():
    """Weights of increments and of the speed with which the model explodes: the limit holds."""
    arx, samples = ARX(surge_max=3.0), mission(400, faults=False)
    state = arx.init()
    state = state._replace(theta=torch.linspace(2.0, -0.5, len(arx.names), dtype=torch.float64))
    _, surge, _ = simulate(arx, state, samples)
    assert surge.isfinite().all() and surge.abs().max() == 3.0


@over("even", [True, False])
def test_drag_slows(even):
    """A boat whose drag falls with the square of the speed: the weights end on the bound, others take their place."""
    samples, v = mission(2000, faults=False), 0.0
    for k, (left, right, dt) in enumerate(zip(*samples.inputs[:2], samples.inputs.dt, strict=True)):
        v += float(dt / 0.4 * (-0.2 * v + 0.02 * v * abs(v) + 0.15 * (left + right)))
        samples.surge[k] = v
    sums, errors = {}, {}
    for project in (True, False):
        arx = ARX(even=even, project=project)
        state, surge, _ = rollout(arx, arx.init(), samples)
        theta = dict(zip(arx.names, state.theta.tolist(), strict=True))
        other = theta.get("even_speed_square", 0.0)
        sums[project] = max(theta["speed"], theta["speed_square"] + other, theta["speed_square"] - other)
        errors[project] = (surge - samples.surge)[-1000:].abs().mean()
    assert sums[True] < 1e-9 < 1e-2 < sums[False]
    assert errors[False] < errors[True] < 0.02


def test_rest_teaches_for_a_minute():
    arx = ARX()
    state, _, _ = rollout(arx, arx.init(), mission(500, faults=False))
    minute, _, _ = rollout(
        arx, state._replace(surge=torch.zeros_like(state.surge)), constant(150, 0.0, 0.0, noise(150))
    )
    hours, _, _ = rollout(arx, minute, constant(10_000, 0.0, 0.0, noise(10_000)))
    assert not torch.equal(minute.theta, state.theta)
    for leaf in ("theta", "factor", "noise", "turn"):
        assert torch.equal(getattr(hours, leaf), getattr(minute, leaf)), leaf
    moving, _, _ = rollout(arx, hours, constant(1, 0.5, 0.5, 0.1))
    assert not torch.equal(moving.theta, hours.theta) and moving.rest == 0


@functools.cache
def hard(steps: int) -> dict[str, Sample]:
    """Samples that have broken filters."""
    rng = np.random.default_rng(1)
    wild = tree_map(torch.clone, mission(steps, faults=False))
    off = torch.from_numpy(rng.random(steps) < 0.02)
    wild.surge[off] = 99.9 * torch.from_numpy(rng.choice([-1.0, 1.0], steps))[off]
    long, commands = tree_map(torch.clone, mission(steps, faults=False)), tree_map(torch.clone, wild)
    long.inputs.dt[:] = torch.from_numpy(rng.choice([1e-6, 0.4, 60.0], steps))
    commands.inputs.command_left[:] *= 99.0
    silent = tree_map(torch.clone, mission(steps, faults=False))
    silent.measured[steps // 10 :] = False
    missing = tree_map(torch.clone, mission(steps))
    missing.surge[torch.from_numpy(rng.random(steps) < 0.9)] = math.nan
    return {
        "idle": constant(steps, 0.0, 0.0, noise(steps)),
        "idle_exactly": constant(steps, 0.0, 0.0, 0.0),
        "cruise": constant(steps, 0.6, 0.6, 1.2 + noise(steps)),
        "cruise_exactly": constant(steps, 0.6, 0.6, 1.2),
        "a_minute_a_step": constant(steps, 0.6, 0.6, 1.2 + noise(steps), dt=60.0),
        "outliers": wild,
        "steps_of_all_lengths": long,
        "absurd_commands": commands,
        "outage": silent,
        "missing": missing,
    }


@pytest.mark.thorough
@pytest.mark.parametrize("name", hard(20))
@over("dtype", [torch.float64, torch.float32])
@over("options", [{}, {"lags": 5, "scale": 10.0, "walk": 1e-2}])
def test_survives(name, dtype, options):
    """The state stays finite and P keeps its sign; soon after, predictions are those of a filter that began then."""

    def typed(samples):
        return tree_map(lambda x: x.to(dtype) if x.is_floating_point() else x, samples)

    arx = ARX(**options).to(dtype)
    state, predicted, _ = rollout(arx, arx.init(), typed(hard(100_000)[name]))
    assert all(leaf.isfinite().all() for _, leaf in named_leaves(state))
    assert not predicted.isinf().any() and predicted.nan_to_num().abs().max() <= arx.surge_max
    P = covariance(tree_map(lambda x: x.double() if x.is_floating_point() else x, state))
    assert (state.factor.diagonal() > 0).all() and torch.linalg.eigvalsh(P).min() > -1e-12 * P.max()
    assert (P.diagonal() <= (1 + 1e-3) * arx.prior.double()).all()
    if not options:
        after = typed(mission(3000, seed=7, faults=False))
        errors = [(rollout(arx, s, after)[1] - after.surge).abs()[-1000:].mean() for s in (state, arx.init())]
        assert errors[0] < 2 * errors[1]


@pytest.mark.thorough
def test_inflation_has_a_limit():
    arx = ARX()
    state, _, _ = rollout(arx, arx.init(), mission(100, faults=False))
    torch.testing.assert_close(covariance(inflated(arx, state, 2.0)), 2 * covariance(state))
    torch.testing.assert_close(covariance(inflated(arx, state, 1e9)).trace(), 100 * arx.prior.sum())


def test_a_turn_that_is_no_place_reads_no_other_memory():
    """A member of an ensemble that diverged may hold any number, also after it was read from a file."""
    arx, samples = ARX(), mission(3, faults=False)
    state, expected, _ = rollout(arx, arx.init(), samples)
    for turn in (math.nan, math.inf, 1e12, -5.0):
        begin = arx.init()._replace(turn=torch.tensor(turn, dtype=torch.float64))
        end, surge, _ = rollout(arx, begin, samples)
        assert torch.equal(surge, expected) and torch.equal(end.factor, state.factor)
