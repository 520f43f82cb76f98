"""The axis EKFs of yaw rate and sway at rest and after a jump of time, in torch and compiled."""

import numpy as np
import pytest
import torch

from usvlearn import Inputs, Sample, SwayEKF, YawEKF
from usvlearn.engine.rollouts import rollout
from usvlearn.estimators.axis.state import THETA, Vector
from usvlearn.estimators.axis.turning_quantities import Theta, quantities

KINDS = {"yaw": lambda: YawEKF(2.5), "sway": lambda: SwayEKF(2.5)}
MOVING = 40


def samples(steps: int, moves: bool, seed: int = 0, dt: float = 0.4) -> Sample:
    """Steps of a boat that turns, or of one that lies still with a noisy sensor; `surge` is what the axis measures."""
    rng = np.random.default_rng(seed)
    left, right, other, along = moves * rng.uniform(-0.5, 0.9, (4, steps))
    measured = 0.3 * (left - right) + 0.1 * other + 0.01 * rng.standard_normal(steps)
    told = [torch.from_numpy(x) for x in (left, right, other, along, np.full(steps, dt))]
    yes = torch.ones(steps, dtype=torch.bool)
    return Sample(Inputs(*told), torch.from_numpy(measured), yes, yes.clone())


def run(axis, state, some, backend):
    return rollout(axis, state, some, backend=backend)[:2]


@pytest.fixture(scope="module", params=KINDS)
def learned(request):
    """A filter that has learned for some steps, at the start of a segment at y = 0."""
    axis = KINDS[request.param]()
    state = run(axis, axis.init(), samples(MOVING, True), "torch")[0]
    assert state.updates == MOVING
    mean = state.mean.clone()
    mean[:THETA] = 0.0
    mean[THETA] = 0.0  # the bias, which would turn a boat at rest
    return axis, axis.start(state._replace(mean=mean), 0 * state.noise)


@pytest.mark.parametrize("backend", ["torch", "kernel"])
def test_at_rest_nothing_is_learned_of_the_parameters_and_the_noise(learned, backend):
    axis, state = learned
    after, _ = run(axis, state, samples(20, False, 1, 0.04), backend)
    assert torch.equal(after.mean[THETA:], state.mean[THETA:])
    assert torch.equal(after.noise, state.noise) and after.updates == MOVING
    again, _ = run(axis, state, samples(20, True, 1, 0.04), backend)
    assert again.updates == MOVING + 20 and not torch.equal(again.noise, state.noise)
    assert not torch.isclose(again.mean[THETA:], state.mean[THETA:]).all()


@pytest.mark.parametrize("backend", ["torch", "kernel"])
def test_a_step_of_more_than_ten_seconds_starts_a_segment(learned, backend):
    """Its measured value is where the next step departs from, and nothing is learned from it."""
    axis, state = learned
    long, short = (run(axis, state, samples(1, True, 2, dt), backend)[0] for dt in (10.1, 10.0))
    assert long.started and not short.started and short.updates == MOVING + 1
    assert long.surge == samples(1, True, 2).surge[0] and long.updates == MOVING
    assert torch.equal(long.mean[THETA:], state.mean[THETA:]) and torch.equal(long.noise, state.noise)
    assert not torch.equal(short.mean[THETA:], state.mean[THETA:])
    _, after = run(axis, long, samples(1, True, 3, 1e-6), backend)
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
    found = quantities(Theta(surge, yaw, sway))
    expected = {"yaw_rate_full_difference": 1.0, "yaw_time_constant": 1 / 2.5, "yaw_time_constant_rest": 1 / 2}
    for name, command in (("full", 1.0), ("half", 0.5), ("quarter", 0.25)):
        u = 1.5 * command
        rate = 0.5 * command / (2 + 0.5 * u)
        expected |= {f"yaw_rate_{name}": rate, f"turning_radius_{name}": np.hypot(u, 0.4 * rate) / rate}
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert float(found[name]) == pytest.approx(value, rel=1e-9), name
