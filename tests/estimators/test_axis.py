"""The axis EKFs of yaw rate and sway at rest and after a jump of time, and against a dense filter."""

import numpy as np
import pytest
import torch

from usvlearn import Inputs, Sample, SwayEKF, YawEKF
from usvlearn.engine.rollouts import rollout
from usvlearn.estimators.augmented_ekf.state import FIRST_DISTURBANCE, NOISE, NOISE_COUNT, NOISE_SHARE, REST
from usvlearn.estimators.axis.state import CROSS, LINEAR, THETA, Vector
from usvlearn.estimators.axis.turning_quantities import Theta, quantities

KINDS = {"yaw": lambda: YawEKF(2.5), "sway": lambda: SwayEKF(2.5)}
MOVING = 40


def samples(steps: int, moves: bool, seed: int = 0, dt: float = 0.4) -> Sample:
    """Steps of a boat that turns, or of one that lies still with a noisy sensor; `surge` is what the axis measures."""
    rng = np.random.default_rng(seed)
    left, right, other, along = moves * rng.uniform(-0.5, 0.9, (4, steps))
    measured = 0.3 * (left - right) + 0.1 * other + 0.01 * rng.standard_normal(steps)
    columns = [torch.from_numpy(x) for x in (left, right, other, along, np.full(steps, dt))]
    yes = torch.ones(steps, dtype=torch.bool)
    return Sample(Inputs(*columns), torch.from_numpy(measured), yes, yes.clone())


def run(axis, state, some):
    return rollout(axis, state, some)[:2]


def force(kind, theta, y, b, xi, other, along):
    """f of (3) and its derivative to y."""
    bias, linear, quadratic, cross, coupling, other_, surge = theta[:7]
    slope = linear + 2 * quadratic * abs(y) + cross * abs(along)
    f = b + bias + (linear + quadratic * abs(y) + cross * abs(along)) * y
    f += coupling * along * other + other_ * other + surge * along
    for x, part in zip(xi, np.split(theta[7:-1], 2), strict=True):
        terms = [x, x * abs(x), x * abs(along), x**3, abs(x), x**2] if kind == "yaw" else [x, x * abs(x)]
        f += part @ terms
    return f, slope


def dense(axis, some: Sample):
    """The filter as a textbook has it, from y = 0.1 on: dense P, F by differences. Yields x, P, σ², the prediction."""
    prior, T, tau = axis.variance.numpy(), float(axis.drift_time()), float(axis.disturbance_time())
    q_b, k, n = float(axis.disturbance()), float(axis.outlier), len(axis.prior) + THETA
    m, x = n - THETA, np.r_[0.0, 0.0, axis.prior.numpy()]
    P, noise = np.diag(np.r_[NOISE**2, FIRST_DISTURBANCE, prior]), NOISE**2
    count, turn, start = 0, 0, 0.1
    for left, right, other, along, h, y in zip(*(each.tolist() for each in (*some.inputs, some.surge)), strict=True):
        u = np.array([left, right])
        if start is not None:
            x[0], x[1], variance = start, 0.0, P[1, 1]
            P[:2], P[:, :2] = 0, 0
            P[0, 0], P[1, 1], before, start = noise, variance, u, None

        def move(x, u=u, before=before, other=other, along=along, h=h):
            f, slope = force(axis.kind, x[2:], x[0], x[1], (1 - x[-1]) * u + x[-1] * before, other, along)
            z = min(h * slope, 1.0)
            return np.r_[x[0] + h * (np.expm1(z) / z if z else 1.0) * f, x[1] * np.exp(-h / tau), x[2:]]

        F = np.stack([(move(x + 1e-6 * e) - move(x - 1e-6 * e)) / 2e-6 for e in np.eye(n)], -1)
        moves, span = u @ u + along**2 + x[0] ** 2 > REST, min(h, 10) / 0.4
        if not moves:
            F[0, 2:] = 0
        x, P, before = move(x), F @ P @ F.T, u
        P[0, 0] += 0.05 * noise * span
        P[1, 1] += q_b * noise * span
        if turn % 4 == 0 and moves:
            i, most = THETA + turn // 4, prior[turn // 4]
            P[i, i] += min(4 * m * most * min(h, 10) / T, max(most - P[i, i], 0))
        turn, predicted = (turn + 1) % (4 * m), x[0]
        if h > 10:
            start = y
        else:
            error, S = y - predicted, P[0, 0] + noise
            weighed = error**2 / k**2 if error**2 > k**2 * S else S
            x, P = x + P[:, 0] * error / weighed, P - np.outer(P[:, 0], P[:, 0]) / weighed
            count += moves
            if moves:
                noise = max(
                    noise * (1 + max(NOISE_SHARE, 1 / (count + NOISE_COUNT)) * (min(error**2 / S, 9) - 1)), 1e-8
                )
            for i in range(LINEAR, CROSS + 1):  # what brakes must not drive
                if x[i] > 0:
                    x = x - P[:, i] * x[i] / P[i, i]
            x[-1] = np.clip(x[-1], -0.5, 1.5)
        yield x.copy(), P.copy(), noise, predicted


@pytest.mark.parametrize("kind", KINDS)
def test_the_factored_filter_is_the_dense_one(kind):
    axis, some = KINDS[kind](), samples(120, True, 4)
    some.surge[30] += 3.0
    some.inputs.dt[60] = 12.0
    some.inputs.dt[80:] = 1.0
    _, predictions, record = rollout(
        axis, axis.start(axis.init(), torch.tensor(0.1).double()), some, ["mean", "factor", "noise"]
    )
    for i, (x, P, noise, predicted) in enumerate(dense(axis, some)):
        factor, scale = record["factor"][i].numpy(), np.sqrt(P.diagonal())
        U = np.tril(factor, -1).T + np.eye(len(x))
        assert (abs(record["mean"][i].numpy() - x) <= 1e-5 * (abs(x) + scale)).all(), i
        assert (abs((U * factor.diagonal()) @ U.T - P) <= 1e-5 * np.outer(scale, scale)).all(), i
        assert float(record["noise"][i]) == pytest.approx(noise, rel=1e-5)
        assert float(predictions[i]) == pytest.approx(predicted, abs=1e-6)


@pytest.fixture(scope="module", params=KINDS)
def learned(request):
    """A filter that has learned for some steps, at the start of a segment at y = 0."""
    axis = KINDS[request.param]()
    state = run(axis, axis.init(), samples(MOVING, True))[0]
    assert state.updates == MOVING
    mean = state.mean.clone()
    mean[:THETA] = 0.0
    mean[THETA] = 0.0  # the bias, which would turn a boat at rest
    return axis, axis.start(state._replace(mean=mean), 0 * state.noise)


def test_at_rest_nothing_is_learned_of_the_parameters_and_the_noise(learned):
    axis, state = learned
    after, _ = run(axis, state, samples(20, False, 1, 0.04))
    assert torch.equal(after.mean[THETA:], state.mean[THETA:])
    assert torch.equal(after.noise, state.noise) and after.updates == MOVING
    again, _ = run(axis, state, samples(20, True, 1, 0.04))
    assert again.updates == MOVING + 20 and not torch.equal(again.noise, state.noise)
    assert not torch.isclose(again.mean[THETA:], state.mean[THETA:]).all()


def test_a_step_of_more_than_ten_seconds_starts_a_segment(learned):
    """Its measured value is where the next step departs from, and nothing is learned from it."""
    axis, state = learned
    long, short = (run(axis, state, samples(1, True, 2, dt))[0] for dt in (10.1, 10.0))
    assert long.started and not short.started and short.updates == MOVING + 1
    assert long.surge == samples(1, True, 2).surge[0] and long.updates == MOVING
    assert torch.equal(long.mean[THETA:], state.mean[THETA:]) and torch.equal(long.noise, state.noise)
    assert not torch.equal(short.mean[THETA:], state.mean[THETA:])
    _, after = run(axis, long, samples(1, True, 3, 1e-6))
    assert float(after) == pytest.approx(float(long.surge), abs=1e-4)


def test_every_parameter_has_a_prior():
    for make in KINDS.values():
        axis = make()
        parameters = len(axis.names)
        assert axis.prior.shape == axis.variance.shape == (parameters,)
        size = axis.init().mean.shape[-1]
        assert size == THETA + parameters
        assert [vector.length(size) for vector in Vector] == [parameters] * 2


def test_turning_of_linear_drag_is_a_closed_form():
    """Drag of the yaw rate (2 + |u|/2) r, of the surge u/2, of the sway v; thrusts ξ_left − ξ_right and their sum/2."""
    yaw, surge, sway = np.zeros(20), np.zeros(12), np.zeros(12)
    yaw[[1, 3, 7, 13]] = -2.0, -0.5, 1.0, -1.0
    surge[[1, 3, 6]] = -0.5, 0.5, 0.5
    sway[[1, 5]] = -1.0, -0.4  # v = −0.4 r
    values = quantities(Theta(surge, yaw, sway))
    expected = {"yaw_rate_full_difference": 1.0, "yaw_time_constant": 1 / 2.5, "yaw_time_constant_rest": 1 / 2}
    for name, command in (("full", 1.0), ("half", 0.5), ("quarter", 0.25)):
        u = 1.5 * command
        rate = 0.5 * command / (2 + 0.5 * u)
        expected |= {f"yaw_rate_{name}": rate, f"turning_radius_{name}": np.hypot(u, 0.4 * rate) / rate}
    assert values.keys() == expected.keys()
    for name, value in expected.items():
        assert float(values[name]) == pytest.approx(value, rel=1e-9), name
