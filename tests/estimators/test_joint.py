"""The joint EKF against a dense textbook filter, finite differences, a simulated boat, and what happens aboard."""

import itertools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from tests.support import each_dtype, few, over
from tests.support.kernel_cases import inflated, mission
from usvlearn import Inputs, JointEKF, Online, Sample, rollout
from usvlearn.core import checkpoint
from usvlearn.core.prepared_samples import DT, LEFT, RIGHT, ROW, YAW_RATE
from usvlearn.core.protocol import clean
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.errors import CheckpointError
from usvlearn.estimators.augmented_ekf import state as augmented
from usvlearn.estimators.axis.state import FAMILY as AXIS
from usvlearn.estimators.joint.kernel import flow as compiled_flow
from usvlearn.estimators.joint.state import AT, SIZES, JointState

SETTINGS = {
    "even": {},
    "odd": {"even": None, "disturbance": 20.0, "outlier": 2.0, "lag": 0.3},
    "loose": {"current": 0.5, "drift_time": 50.0, "disturbance_time": 0.2, "current_time": 5.0, "outlier": None},
}
each_setting = pytest.mark.parametrize("name", SETTINGS)


def tensor(*numbers) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def size(x):
    """|x|, with the slope 1 at 0."""
    return x if x >= 0 else -x


def moved_by(mean, w, b, before, inputs, even):
    """w⁺ of (3) and its gradient to x, by the kernel."""
    row, g = np.zeros(ROW), np.empty(len(mean))
    row[[LEFT, RIGHT, YAW_RATE, DT]] = inputs[0], inputs[1], inputs.yaw_rate, inputs.dt
    moved = compiled_flow(even, mean.numpy(), float(w), float(b), *map(float, before), row, g)
    return tensor(moved)[0], torch.from_numpy(g)


def force(p, w, b, xi, yaw_rate):
    """f of (2) from the parameters, per unit mass, written out."""
    quadratic, linear, cross = p[:3]
    f = quadratic * w * size(w) + linear * w + cross * abs(yaw_rate) * w + b
    for k, x in enumerate(xi):
        alpha, beta, gamma = p[3 + 3 * k : 6 + 3 * k]
        f = f + alpha * x + beta * x * size(x) + gamma * x * size(w) + p[9 + k] * x**3
        if len(p) > 12:
            linear, quadratic, speed = p[12 + 3 * k : 15 + 3 * k]
            f = f + linear * size(x) + quadratic * x**2 + speed * x * w
    return f + p[11] * w**2 if len(p) > 12 else f


def step(x, left, right, before, yaw_rate, h, tau_b, tau_c):
    """x⁺ of (3); derivatives are those of autograd."""
    w, b, north, east, *p = x.unbind()
    xi = [(1 - p[-1]) * u + p[-1] * v for u, v in zip((left, right), before, strict=True)]
    f = force(p, w, b, xi, yaw_rate)
    with torch.enable_grad():
        moving = w.detach().requires_grad_() if not w.requires_grad else w
        slope = torch.func.grad(lambda v: force(p, v, b, xi, yaw_rate))(moving)
    z = (h * slope).clamp(max=1)
    return torch.stack(
        [
            w + h * torch.expm1(z) / z * f,
            b * math.exp(-h / tau_b),
            *(c * math.exp(-h / tau_c) for c in (north, east)),
            *p,
        ]
    )


def dense(joint: JointEKF, samples: Sample):
    """The same filter as a textbook has it: a dense P, its Jacobian by autograd. Yields x, P, σ² and the prediction."""
    clear, number = clean(samples), lambda each: float(each()) if callable(each) else float(each)
    q_b, tau_b, sigma_c, tau_c, T = map(number, (joint.disturbance, joint.disturbance_time, joint.current,
                                                 joint.current_time, joint.drift_time))  # fmt: skip
    m, k = len(joint.names), number(joint.outlier)
    n, prior = m + 4, joint.variance
    x = torch.cat([torch.zeros(4, dtype=torch.float64), joint.prior])
    P = torch.diag(torch.cat([tensor(4, 1e-2, sigma_c**2, sigma_c**2), prior]))
    noise, count, turn, start, before = 0.03**2, 0, 0, None, tensor(0, 0)
    signs = [[4], [5], [6], *([[4, 15], [4, -15]] if joint.even is not None else [])]
    for i in range(len(samples.surge)):
        surge, predicted = float(clear.surge[i]), math.nan
        if clear.starts[i]:
            start = surge
        if clear.steps[i]:
            left, right, heading, yaw_rate, dt = (each[i] for each in clear.inputs)
            h, span = float(dt), min(float(dt), 10) / 0.4
            H = torch.cat(
                [torch.stack([torch.ones_like(heading), heading * 0, heading.cos(), heading.sin()]), 0 * prior]
            )
            if start is not None:
                variance = float(P[1, 1])
                P[:2], P[:, :2] = 0, 0
                P[0, 0], P[1, 1] = 4, variance
                P[2, 2] += 0.05**2
                P[3, 3] += 0.05**2
                x[0], x[1] = start - H[2:4] @ x[2:4], 0
                P = P - torch.outer(P @ H, P @ H) / (H @ P @ H + noise)
                before, start = torch.stack([left, right]), None
            moves = left**2 + right**2 + x[0] ** 2 > 1e-3
            move = lambda y, a=(left, right, before, yaw_rate, h, tau_b, tau_c): step(y, *a)  # noqa: E731
            with torch.enable_grad():
                F = torch.autograd.functional.jacobian(move, x.clone())
            if not moves:
                F[0, 4:] = 0
            x = move(x)
            P = F @ P @ F.T
            P[0, 0] += 0.05 * noise * span
            P[1, 1] += q_b * noise * span
            P[2, 2] += sigma_c**2 * -math.expm1(-2 * h / tau_c)
            P[3, 3] += sigma_c**2 * -math.expm1(-2 * h / tau_c)
            if turn % 4 == 0 and moves:
                place, most = 4 + turn // 4, prior[turn // 4]
                P[place, place] += min(4 * m * most * min(h, 10) / T, max(most - P[place, place], 0))
            turn = (turn + 1) % (4 * m)
            if abs(x[0]) >= 20:  # m/s: "loose" gets there
                x[0] = math.copysign(20, x[0])
                P[0], P[:, 0] = 0, 0
                P[0, 0] = 20**2
            before, predicted = torch.stack([left, right]), float(H @ x)
            if clear.learns[i] and h > 10:
                start = surge
            elif clear.learns[i]:
                error, S = surge - predicted, float(H @ P @ H) + noise
                weighed = error**2 / k**2 if error**2 > k**2 * S else S
                x = x + P @ H * (error / weighed)
                P = P - torch.outer(P @ H, P @ H) / weighed
                count += bool(moves)
                if moves:
                    noise = max(noise * (1 + max(0.005, 1 / (count + 20)) * (min(error**2 / S, 9) - 1)), 1e-8)
                for places in signs:
                    d = torch.zeros(n, dtype=torch.float64)
                    for place in places:
                        d[abs(place)] = math.copysign(1, place)
                    if d @ x > 0:
                        x = x - P @ d * (d @ x) / (d @ P @ d)
                x[-1] = x[-1].clamp(-0.5, 1.5)
        yield x.clone(), P.clone(), noise, predicted


@pytest.mark.thorough
@pytest.mark.parametrize("name", few(SETTINGS, ["even"]))
def test_the_factored_filter_is_the_dense_one(name):
    """Over samples with starts, gaps, outliers, missing speeds and steps of a minute."""
    joint, samples = JointEKF(2.0, 28.0, **SETTINGS[name]), mission(350, seed=5)
    states = ["mean", "factor", "noise"]
    _, predictions, record = rollout(joint, joint.init(), samples, states)
    steps, limited = 0, 0
    for i, (x, P, noise, predicted) in enumerate(dense(joint, samples)):
        factor = record["factor"][i]
        U = torch.tril(factor, -1).T + torch.eye(len(x), dtype=torch.float64)
        full = (U * factor.diagonal()) @ U.T
        scale = P.diagonal().sqrt()
        assert ((record["mean"][i] - x).abs() <= 1e-7 * (x.abs() + scale)).all(), i
        assert ((full - P).abs() <= 1e-7 * torch.outer(scale, scale)).all(), i
        assert abs(record["noise"][i] - noise) <= 1e-8 * noise
        assert (math.isnan(predicted) and predictions[i].isnan()) or abs(predictions[i] - predicted) <= 1e-8
        steps += not math.isnan(predicted)
        limited += bool((x[4:7].abs() < 1e-12).any())
    assert steps > 300 and (samples.inputs.dt > 10).any() and (name == "loose" or limited > 0)


@each_setting
@over("moment", [(1.3, 0.5, -0.2), (-0.8, -0.4, 0.9), (0.02, 0.0, 0.3), (3.0, -1.0, -1.0)])
def test_the_gradient_of_a_step_is_that_of_finite_differences(name, moment):
    (speed, left, right), joint = moment, JointEKF(2.0, **SETTINGS[name])
    generator = torch.Generator().manual_seed(1)
    state, n = joint.init(), SIZES[joint.even is not None]
    mean = state.mean + 0.1 * torch.randn(n, generator=generator, dtype=torch.float64)
    inputs, before = Inputs(*tensor(left, right, 0.7, 0.2, 0.4)), tensor(0.3, -0.6)

    def flow(x):
        return moved_by(x, x[0], x[1], before, inputs, joint.even is not None)

    mean[0], eye, d = speed, torch.eye(n, dtype=torch.float64), 1e-6
    differences = torch.stack([(flow(mean + d * e)[0] - flow(mean - d * e)[0]) / (2 * d) for e in eye])
    torch.testing.assert_close(flow(mean)[1], differences, rtol=1e-7, atol=1e-8)


def test_a_step_is_of_second_order_and_ends_at_the_steady_speed():
    """Against the differential equation; a long step ends where drag and thrust are equal."""
    joint, inputs = JointEKF(2.0, even=None), Inputs(*tensor(0.9, 0.5, 0.0, 0.0, 0.4))
    p = joint.prior.tolist()
    slope = lambda _, v: force(p, v, 0.0, (0.9, 0.5), 0.0)  # noqa: E731
    truth = float(solve_ivp(slope, (0, 0.8), [0.3], rtol=1e-11, atol=1e-12).y[0, -1])
    errors = []
    for parts in (2, 4, 8):
        w, commands = tensor(0.3)[0], tensor(0.9, 0.5)
        for _ in range(parts):
            w, _ = moved_by(joint.init().mean, w, 0 * w, commands, inputs._replace(dt=tensor(0.8 / parts)[0]), False)
        errors.append(abs(float(w) - truth))
    assert errors[0] < 2e-3 and 3.5 < errors[0] / errors[1] < 4.5 and 3.5 < errors[1] / errors[2] < 4.5
    w, _ = moved_by(
        joint.init().mean, tensor(1.39)[0], tensor(0.0)[0], commands, inputs._replace(dt=tensor(5e3)[0]), False
    )
    assert abs(slope(0, float(w))) < 1e-2 * abs(slope(0, 0.0))


def boat(hours: float, noise: float = 0.03, seed: int = 0):
    """A boat of 28 kg that obeys (2), its parameters in newtons, and what its log says; held commands, no current."""
    rng, dt, theta = np.random.default_rng(seed), 0.4, [-4.0, -6.0, -3.0, 20.0, 12.0, -2.0, 16.0, 15.0, -2.0]
    steps = int(hours * 3600 / dt)
    u = np.repeat(rng.uniform(-0.2, 1.0, (steps // 15 + 1, 2)), 15, 0)[:steps]
    yaw_rate, v, surge = 0.3 * (u[:, 0] - u[:, 1]), 0.0, np.empty(steps)
    p = [value / 28.0 for value in theta] + [0.0, 0.0, 0.0]
    for k in range(steps):
        for _ in range(8):
            middle = v + dt / 16 * force(p, v, 0.0, u[k], yaw_rate[k])
            v += dt / 8 * force(p, middle, 0.0, u[k], yaw_rate[k])
        surge[k] = v
    inputs = Inputs(*map(torch.from_numpy, (u[:, 0].copy(), u[:, 1].copy(), np.cumsum(yaw_rate) * dt, yaw_rate)),
                    torch.full((steps,), dt, dtype=torch.float64))  # fmt: skip
    yes = torch.ones(steps, dtype=torch.bool)
    return dict(zip(JointEKF(1.0).names, theta, strict=False)), Sample(
        inputs, torch.from_numpy(surge + noise * rng.standard_normal(steps)), yes, yes
    )


def test_a_mean_of_readings_and_their_covariance():
    """Weights 0.9^age, the first three dropped, against NumPy."""
    joint, samples = JointEKF(2.0, estimate_every=20.0, drift_time=300.0), mission(900, faults=False, seed=2)
    samples = samples._replace(inputs=samples.inputs._replace(dt=torch.full_like(samples.inputs.dt, 0.5)))
    state, _, record = rollout(joint, joint.init(), samples, ["mean"])
    read = record["mean"][39::40, 4:].numpy()
    assert len(read) == 22 == state.readings
    weights = 0.9 ** np.arange(19)[::-1]
    np.testing.assert_allclose(state.reading, np.average(read[3:], axis=0, weights=weights), rtol=1e-10, atol=1e-14)
    spread = np.cov(read[3:], rowvar=False, aweights=weights, ddof=0)
    np.testing.assert_allclose(state.spread, spread, rtol=1e-9, atol=1e-12 * spread.max())
    assert state.weight == pytest.approx(weights.sum())
    few, _, _ = rollout(joint, joint.init(), tree_map(lambda x: x[:130], samples))
    assert few.readings == 3 and few.weight == 0 and (few.spread == 0).all()


def sound(joint, state) -> None:
    """All is finite, D is positive, and no parameter is less known than by its prior."""
    assert all(bool(leaf.isfinite().all()) for _, leaf in named_leaves(state))
    assert (state.factor.diagonal(dim1=-2, dim2=-1) > 0).all()
    assert (state.covariance.diagonal(dim1=-2, dim2=-1)[..., 4:] <= (1 + 1e-5) * joint.variance).all()


@each_dtype
@pytest.mark.parametrize("name", few(["even", "odd"], ["even"], "thorough"))
def test_a_hundred_thousand_steps_at_rest(name, dtype):
    """Nothing is unlearned there, and the noise is not lost: the next hour goes as the first."""
    joint, steps = JointEKF(2.0, 28.0, **SETTINGS[name]).to(dtype), 100_000
    samples = tree_map(lambda x: x.to(dtype) if x.is_floating_point() else x, boat(1.0)[1])
    state, before, _ = rollout(joint, joint.init(), samples)
    zero, yes = torch.zeros(steps, dtype=dtype), torch.ones(steps, dtype=torch.bool)
    still = 0.01 * torch.randn(steps, generator=torch.Generator().manual_seed(3), dtype=torch.float64).to(dtype)
    idle, _, _ = rollout(joint, state, Sample(Inputs(zero, zero, zero, zero, zero + 0.4), still, yes, yes))
    sound(joint, idle)
    assert ((idle.covariance - state.covariance).diagonal()[4:] <= 0.01 * joint.variance).all()
    after = rollout(joint, idle, samples)[1]
    assert (after - samples.surge)[20:].abs().mean() < 1.05 * (before - samples.surge)[20:].abs().mean()


@each_setting
@each_dtype
def test_what_happens_aboard_is_survived(name, dtype):
    """NaN, outliers of 99 m/s, steps of hours, sensors without noise, and most speeds missing."""
    joint, samples = JointEKF(2.0, 28.0, **SETTINGS[name]).to(dtype), mission(4000, seed=7, dtype=dtype)
    sound(joint, rollout(joint, joint.init(), samples)[0])
    dt = samples.inputs.dt.clone()
    dt[::97] = 9999.0
    long = samples._replace(inputs=samples.inputs._replace(dt=dt))
    state, predictions, _ = rollout(joint, joint.init(), long)
    sound(joint, state)
    if SETTINGS[name].get("outlier", 4.0):  # otherwise an outlier of 99 m/s counts as a current
        assert (predictions[predictions.isfinite()].abs() < 25).all()
    rare = samples._replace(measured=samples.measured & (torch.arange(4000) % 30 == 0))
    sound(joint, rollout(joint, joint.init(), rare)[0])
    exact = tree_map(lambda x: x.to(dtype) if x.is_floating_point() else x, boat(0.5, noise=0.0)[1])
    sound(joint, rollout(joint, joint.init(), exact)[0])


def test_the_mass_only_gives_units():
    samples = mission(200, seed=3)
    light, heavy = JointEKF(2.0, 1.0), JointEKF(2.0, 28.0)
    ends = [rollout(each, each.init(), samples) for each in (light, heavy)]
    torch.testing.assert_close(ends[0][1], ends[1][1], rtol=0, atol=0, equal_nan=True)
    small, large = (each.monitor(end[0]) for each, end in zip((light, heavy), ends, strict=True))
    for name in (*light.names[:-1], "disturbance"):
        torch.testing.assert_close(28.0 * small[name], large[name])
    assert small["command_lag"] == large["command_lag"] and small["current_north"] == large["current_north"]


def test_a_prior_in_newtons():
    theta0 = [-3.0, -6.0, 0.0, 20.0, 15.0, -3.0, 16.0, 18.0, -2.0]
    joint = JointEKF(2.0, 28.0, theta0=theta0)
    values = joint.monitor(joint.init())
    assert [round(float(values[name]), 9) for name in joint.names[:9]] == theta0


@pytest.mark.thorough
def test_a_larger_covariance_has_a_limit():
    joint = JointEKF(2.0, 28.0)
    state, _, _ = rollout(joint, joint.init(), mission(100))
    twice = inflated(joint, state, 2.0)
    torch.testing.assert_close(twice.covariance, 2 * state.covariance)
    for _ in range(50):
        twice = inflated(joint, twice, 1e6)
    mean = (twice.covariance.diagonal()[4:] / joint.variance).mean()
    assert mean == pytest.approx(100.0)


def test_a_broken_factor_is_refused(tmp_path):
    leaves, facts = checkpoint.load(Online(JointEKF(2.0)).save(tmp_path / "a.safetensors"))
    factor = leaves["factor"].copy()
    factor[5, 5] = -factor[5, 5]
    path = checkpoint.save(tmp_path / "a.safetensors", leaves | {"factor": factor}, **facts)
    with pytest.raises(
        CheckpointError, match=r"state\.factor: found -0.16\d*, expected .* 1e-30 or more on the diagonal"
    ):
        Online.open(path)


def test_the_covariance_of_a_batch_is_that_of_each_element():
    joint = JointEKF(2.0, 28.0)
    state = joint.init((2, 3))
    factor = torch.rand(state.factor.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    covariance = state._replace(factor=factor).covariance
    assert covariance.shape == factor.shape
    for i, j in itertools.product(range(2), range(3)):
        L = factor[i, j].tril(-1) + torch.eye(factor.shape[-1], dtype=torch.float64)  # Uᵀ
        torch.testing.assert_close(covariance[i, j], L.mT @ torch.diag(factor[i, j].diagonal()) @ L)


def test_the_kernels_that_both_filters_share_find_their_leaves():
    leaves = augmented.FilterState._fields
    assert JointState._fields[: len(leaves)] == leaves == AXIS.at._fields
    assert AT[: len(leaves)] == augmented.AT == AXIS.at
