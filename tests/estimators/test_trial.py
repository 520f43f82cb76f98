"""The trial of the joint EKF: what it does on a boat whose truth is known, and that it can be interrupted anywhere."""

import numpy as np
import pytest
import torch

from tests.support import few
from usvlearn import Inputs, JointEKF, Sample, Trial
from usvlearn.core.samples import named_leaves, tree_map
from usvlearn.engine.rollouts import rollout
from usvlearn.estimators.joint.state import TRUSTED

DT, NOISE, LEAD, BOATS = 0.4, 0.02, 600, 4
THETA = np.array([-0.11, -0.21, 0.9, 0.6])  # v|v|, v, u of the left and of the right side: per unit mass


def sail(seed: int, share: float, steps: int = 200) -> tuple[Sample, torch.Tensor]:
    """Samples of boats whose left thruster keeps `share` of its thrust from LEAD on, and their true speeds."""
    rng = np.random.default_rng(seed)
    n = LEAD + steps
    left, right = rng.random((2, -(-n // 10), BOATS)).repeat(10, 1)[:, :n]
    v, speeds = np.zeros(BOATS), np.empty((n, BOATS))
    for k in range(n):
        thrust = THETA[2] * (share if k >= LEAD else 1.0) * left[k] + THETA[3] * right[k]
        v = v + DT * (THETA[0] * abs(v) * v + THETA[1] * v + thrust)
        speeds[k] = v
    surge = torch.from_numpy(speeds + NOISE * rng.standard_normal(speeds.shape))
    zero, yes = torch.zeros_like(surge), torch.ones_like(surge, dtype=torch.bool)
    inputs = Inputs(torch.from_numpy(left), torch.from_numpy(right), zero, zero, zero + DT)
    return Sample(inputs, surge, yes, yes.clone()), torch.from_numpy(speeds)


def joint(**given) -> JointEKF:
    return JointEKF(3.0, current=1e-3, trial=Trial(**given))


def run(estimator, samples, state=None):
    state = estimator.init((BOATS,)) if state is None else state
    return rollout(estimator, state, samples)[:2]


@pytest.mark.parametrize("share", [0.4, 0.0, 1.7])
def test_a_changed_thruster_is_found_within_a_minute_and_its_parameters_are_right(share):
    samples, truth = sail(1, share)
    state, surges = run(joint(), samples)
    assert (state.trial.changes == 1).all()
    assert ((state.trial.since > 20.0) & (state.trial.since <= 80.0 + 1e-6)).all()  # of the 80 s after the event
    error = (surges - truth).abs()[LEAD : LEAD + 100].mean()
    plain = (run(JointEKF(3.0, current=1e-3), samples)[1] - truth).abs()[LEAD : LEAD + 100].mean()
    assert error < 0.6 * plain
    at = 4 + 3  # α of the left side; its β, γ and κ are 0 here, and share what is found at half command
    now, before = (
        x[..., at] + 0.5 * x[..., at + 1] for x in (state.mean, torch.nn.functional.pad(state.trial.before, (4, 0)))
    )
    assert now.allclose(now.new_tensor(THETA[2] * share), atol=0.15)
    assert before.allclose(now.new_tensor(THETA[2]), atol=0.15)


def test_open_loop_simulations_depart_from_the_first_filter_until_the_second_is_trusted():
    samples, _ = sail(1, 0.4)
    one = joint(confirmed=1e6, steps=200)
    state = run(one, tree_map(lambda x: x[:LEAD], samples))[0]
    seen = set()
    for k in range(LEAD, LEAD + 60):
        state = run(one, tree_map(lambda x, k=k: x[k : k + 1], samples), state)[0]
        trial = state.trial
        early = (trial.leads > 0) & (trial.evidence <= TRUSTED)
        assert torch.equal(trial.early > 0, early)
        seen |= {(bool(x), bool(y)) for x, y in zip(trial.leads > 0, early, strict=True)}
    assert seen == {(False, False), (True, True), (True, False)}


def test_a_boat_that_stays_the_same_has_no_change():
    samples, _ = sail(2, 1.0, steps=2000)
    state, surges = run(joint(), samples)
    assert not state.trial.changes.any()
    torch.testing.assert_close(surges, run(JointEKF(3.0, current=1e-3), samples)[1], atol=0.02, rtol=0, equal_nan=True)


@pytest.mark.parametrize("dtype", few([torch.float64, torch.float32], [torch.float64], "thorough"))
def test_a_run_continues_within_a_trial(dtype):
    samples, _ = sail(3, 0.4, steps=40)
    samples = tree_map(lambda x: x.to(dtype) if x.is_floating_point() else x, samples)
    samples.measured[LEAD + 5 : LEAD + 8] = False
    estimator = joint().to(dtype)
    whole, surges = run(estimator, samples)
    head, tail = (tree_map(lambda x, part=part: x[part], samples) for part in (slice(LEAD + 4), slice(LEAD + 4, None)))
    middle, _ = run(estimator, head)
    assert (middle.trial.run > 0).any()
    continued, after = run(estimator, tail, middle)
    torch.testing.assert_close(after, surges[LEAD + 4 :], atol=0, rtol=0, equal_nan=True)
    for (name, one), (_, other) in zip(named_leaves(whole), named_leaves(continued), strict=True):
        assert torch.equal(one, other), name
