"""The stress benchmark: its scenarios do to the boat what they say, and none of ours is ever not finite."""

import math

import numpy as np
import pytest
import stress
import torch
from peers.online import MODULES, filterpy_kalman, kalman_py, plain_rls

from usvlearn import SurgeDynamics

STEPS = 60
NAMES = ("idle", "cruise", "mixed", "outliers", "nan", "jump", "thruster", "outage")


@pytest.fixture(scope="module")
def cases():
    return stress.scenarios(STEPS, elements=2)


def test_every_scenario_is_there(cases):
    assert tuple(cases) == NAMES


@pytest.fixture(scope="module")
def ours():
    return stress.ours()


@pytest.mark.parametrize("name", NAMES)
def test_ours_stay_finite(cases, ours, name):
    case = cases[name]
    others = ("arx", "joint_ekf", "joint_quick", "ensemble", "persistence")
    assert set(ours) == {*stress.single(stress.MODEL), *others}
    for row, estimator in ours.items():
        result = stress.run_ours(case, estimator)
        assert result.finite and math.isfinite(result.error), row
        assert (result.steps is None) == (case.event is None), row
        assert math.isnan(result.parameters) == (row in others), row


@pytest.mark.parametrize("name", NAMES)
def test_the_boat_follows_the_true_parameters(cases, name):
    """The true model's error is the noise of two speeds: √(2/π) NOISE √(1 + s²), s ≤ 1 the slope of a step."""
    error = stress.true_model(cases[name]).error
    assert 0.7 * math.sqrt(2 / math.pi) * stress.NOISE < error < 1.3 * 2 / math.sqrt(math.pi) * stress.NOISE


def test_scenarios_spoil_what_they_say(cases):
    samples, target, lead = cases["nan"].samples, cases["nan"].target, cases["nan"].lead
    assert samples.surge.isnan().nonzero()[:, 0].unique().tolist() == [lead]
    assert samples.inputs.command_left.isnan().nonzero()[:, 0].unique().tolist() == [lead + 20]
    assert samples.inputs.command_right.isinf().nonzero()[:, 0].unique().tolist() == [lead + 40]
    assert target.isfinite().all()
    wild = cases["outliers"]
    assert 0 < (wild.samples.surge != wild.target).double().mean() < 0.05
    thruster = cases["thruster"].theta[0] / torch.from_numpy(stress.TRUTH)
    torch.testing.assert_close(thruster, torch.tensor([1.0] * 3 + [0.4] * 3 + [1.0] * 3).double())
    silent = cases["outage"].samples
    assert int((~silent.measured[:, 0]).sum()) == STEPS
    assert float(silent.inputs.dt[cases["outage"].event, 0]) == 0.0


def test_plain_rls_is_batch_least_squares():
    """min Σ λ^(n−k) (y_k − φ_kᵀθ)² + λⁿ θᵀθ/10, solved at once."""
    rng = np.random.default_rng(0)
    phi, y, peer = rng.standard_normal((60, stress.P)), rng.standard_normal(60), plain_rls()
    for x, value in zip(phi, y, strict=True):
        peer.learn(x, value)
    weights = stress.LAM ** np.arange(59, -1, -1)
    information = (phi.T * weights) @ phi + stress.LAM**60 / 10 * np.eye(stress.P)
    np.testing.assert_allclose(peer.theta(), np.linalg.solve(information, (phi.T * weights) @ y), rtol=1e-9)


def test_one_nan_stays_in_plain_rls_for_ever(cases):
    assert not stress.run_peer(cases["nan"], plain_rls).finite


@pytest.mark.parametrize("name", MODULES)
def test_peers_learn_what_they_are_shown(name):
    pytest.importorskip(MODULES[name], reason=f"{name} needs the extra bench")
    case = stress.drive([("excited", 400)], 1, 0)
    make = stress.peers(stress.excitation(case))[name]
    persistence = float((case.target[1:] - case.target[:-1]).abs()[200:].mean())
    result = stress.run_peer(case._replace(after=slice(200, None)), make)
    assert result.finite and result.error < 0.8 * persistence


def test_two_libraries_of_kalman_filters_agree():
    pytest.importorskip("filterpy", reason="needs the extra bench")
    pytest.importorskip("kalman_py", reason="needs the extra bench")
    rng = np.random.default_rng(0)
    phi, y = rng.standard_normal((60, stress.P)), rng.standard_normal(60)
    ours, theirs = filterpy_kalman(np.eye(stress.P)), kalman_py(np.eye(stress.P))
    for x, value in zip(phi, y, strict=True):
        assert ours.predict(x) == pytest.approx(theirs.predict(x), rel=1e-9)
        ours.learn(x, value)
        theirs.learn(x, value)
    np.testing.assert_allclose(ours.theta(), theirs.theta(), rtol=1e-9)


def test_recovery_is_counted_to_the_last_step_out_of_bounds(cases):
    case = stress.drive([("excited", 60), ("excited", 60)], 24, 0)._replace(event=60)
    off = torch.full_like(case.target, 0.01)
    off[90:100] = 1.0  # of windows of 240 / 24 steps, those that begin from step 81 to 99 hold some of it
    result = stress.assess(case, case.target + off, None, True)
    assert result.steps == 40


def test_what_never_recovers_is_said_so(cases):
    case = stress.drive([("excited", 60), ("excited", 60)], 24, 0)._replace(event=60)
    off = torch.full_like(case.target, 0.01)
    off[60:] = 1.0
    assert stress.cell(stress.assess(case, case.target + off, None, True)) == "0.5050, never"
    assert stress.cell(stress.assess(case, case.target + off, None, False)) == "**not finite**"


@pytest.mark.thorough
def test_a_pure_regression_is_solved():
    """Without outliers |Δθ| is about NOISE √(p (1 − λ)/2) = 0.003 where the past is forgotten at λ."""
    found = stress.regression(240, elements=2, outliers=0.0)
    for name in ("plain_rls", "rls", "sift_rls"):
        assert found[name] < 0.01, name
    assert abs(found["rls"] - found["plain_rls"]) < 1e-9


def test_regressors_are_those_of_the_model(cases):
    samples = cases["jump"].samples
    phi = stress.regressors(samples)
    inputs = type(samples.inputs)(*(x[7] for x in samples.inputs))
    torch.testing.assert_close(phi[7], SurgeDynamics(1.0)(samples.surge[6], inputs)[1])
