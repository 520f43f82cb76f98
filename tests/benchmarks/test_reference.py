"""The C reference of the benchmark computes what the estimators compute."""

import pytest
import torch
from reference import compiler, reference
from speed_steps import axis_samples

from tests.support import few
from usvlearn import AID, RLS, RNN, JointEKF, Persistence, SIFtRLS, SurgeDynamics, SwayEKF, YawEKF, rollout
from usvlearn.core.protocol import clean
from usvlearn.core.samples import tree_map
from usvlearn.logs.recordings import align_fleet
from usvlearn.simulate.fleet import fleet

MASS, STEPS, EQUAL, AXES = 28.0, 2000, 1e-9, ("yaw", "sway")
TWINS = {
    "aid": lambda: AID(MASS),
    "leaking_aid": lambda: AID(MASS, gain=30.0, bound=0.5),
    "rls": RLS,
    "dynamic_rls": lambda: RLS(SurgeDynamics(MASS), forgetting=0.98, trace_growth=2.0),
    "sift": SIFtRLS,
    "dynamic_sift": lambda: SIFtRLS(SurgeDynamics(MASS), memory=4.0),
    "ambient_sift": lambda: SIFtRLS(SurgeDynamics(MASS, ambient=True), memory=20.0),
    "rnn": RNN,
    "joint": lambda: JointEKF(2.7, MASS),
    "odd_joint": lambda: JointEKF(2.7, MASS, even=None, disturbance=5.0, outlier=2.0, drift_time=300.0),
    "yaw": lambda: YawEKF(2.7),
    "sway": lambda: SwayEKF(2.7, disturbance=1.0, outlier=2.0, drift_time=300.0),
    "small_rnn": lambda: RNN(7, contraction_rate=0.9, rate=5e-3),
}
THOROUGH = ("dynamic_sift", "rnn", "yaw")


@pytest.fixture(scope="module")
def samples():
    """One boat, what was learned from."""
    (run,) = align_fleet(fleet(n=1, hours=0.5, mission_minutes=30.0)).runs
    every = tree_map(lambda x: torch.as_tensor(x[:, 0]), run.samples)
    learned = tree_map(lambda x: x[clean(every).learns][:STEPS], every)
    assert len(learned.surge) == STEPS
    return learned


@pytest.mark.thorough
@pytest.mark.skipif(compiler() is None, reason="the machine has no C compiler, neither gcc nor cc")
@pytest.mark.parametrize("name", few(TWINS, ("aid", *THOROUGH)))
def test_the_reference_is_the_estimator(name, samples):
    estimator = TWINS[name]()
    if name in AXES:
        every = axis_samples(name, hours=0.06)
        samples = tree_map(lambda x: x[clean(every).learns], every)
        assert len(samples.surge) > 500
    with torch.no_grad():
        state, predictions, _ = rollout(estimator, estimator.init(), samples, backend="torch")
    made = reference(estimator, samples)
    for _ in range(2):  # it starts anew
        assert equal(torch.from_numpy(made.run()), predictions)
    weights = getattr(state, "weights", None)
    for leaf, found in made.state().items():
        expected = getattr(state if hasattr(state, leaf) else weights, leaf)
        assert found.shape == tuple(expected.shape) and equal(torch.as_tensor(found), expected), leaf


def equal(found, expected) -> bool:
    return bool((found - expected).abs().max() <= EQUAL * expected.abs().max()) and bool(expected.abs().max() > 0)


def test_estimators_without_a_reference_have_none(samples):
    assert reference(Persistence(), samples) is None
