"""The trial of the joint EKF: each verdict on a trial, and the sums that lead to it."""

import numpy as np
import pytest
import torch

from tests.support.kernel_cases import mission
from usvlearn import Inputs, JointEKF, Sample, Trial
from usvlearn.engine.backend import arrays_of
from usvlearn.engine.program import program_for
from usvlearn.engine.rollouts import rollout
from usvlearn.estimators.joint import change_detection_kernel
from usvlearn.estimators.joint.state import AT_TRIAL, ROOM, THETA, WARM, names


def plain(function):
    """A compiled function as Python runs it."""
    return getattr(function, "py_func", function)


QUIET = {"tried": 0, "run": 0, "leads": 0, "early": 0, "evidence": 0, "best": 0, "changes": 0}
TRIED = {"tried": 3, "run": 9}
SUSPECTED = {"run": 5, "statistic": 100}
# the state before a step; then what it is after the step, in which both filters do equally well
VERDICTS = {
    "nothing": ({}, QUIET),
    "suspected": ({"run": 5, "statistic": 9}, {"tried": 0, "run": 6, "leads": 0}),
    "begins": (SUSPECTED, {"tried": 1, "run": 6, "leads": 0, "best": 0}),
    "begins and leads": (SUSPECTED | {"evidence": 6}, {"tried": 1, "leads": 1, "early": 1, "best": 0, "evidence": 6}),
    "too early": (SUSPECTED | {"updates": WARM - 9}, {"tried": 0, "run": 6}),
    "too late": (SUSPECTED | {"run": 20, "evidence": 6}, QUIET),
    "goes on": (TRIED | {"evidence": 3, "best": 4}, {"tried": 4, "run": 10, "leads": 0, "evidence": 3, "best": 4}),
    "is better": (TRIED | {"evidence": 4.5, "best": 4}, {"tried": 4, "leads": 0, "best": 4.5}),
    "leads": (TRIED | {"evidence": 6}, {"tried": 4, "leads": 1, "early": 1, "best": 6}),
    "is trusted": (TRIED | {"evidence": 101}, {"tried": 4, "leads": 1, "early": 0, "best": 101}),
    "leads on": (TRIED | {"evidence": 6, "leads": 1, "early": 1}, {"tried": 4, "leads": 1, "early": 1}),
    "leads no more": (TRIED | {"evidence": 4, "leads": 1, "early": 1}, {"tried": 4, "leads": 0, "early": 0}),
    "confirmed": (TRIED | {"evidence": 151}, QUIET | {"changes": 1, "since": 0, "readings": 0, "weight": 0}),
    "confirmed in the lead": (TRIED | {"evidence": 151, "leads": 1}, QUIET | {"changes": 1, "since": 0, "learned": 0}),
    "not yet confirmed": (TRIED | {"evidence": 149}, {"tried": 4, "leads": 1, "changes": 0, "readings": 7}),
    "dropped": (TRIED | {"evidence": -2.1}, QUIET | {"readings": 7, "statistic": 0}),
    "not yet dropped": (TRIED | {"evidence": -1.9}, {"tried": 4, "evidence": -1.9, "best": 0}),
    "has fallen": (TRIED | {"evidence": 20, "best": 24.1, "leads": 1}, QUIET),
    "has not fallen": (TRIED | {"evidence": 20, "best": 23.9, "leads": 1}, {"tried": 4, "leads": 1, "best": 23.9}),
    "too long": ({"tried": 76, "run": 80, "evidence": 3}, QUIET),
    "the last step": ({"tried": 75, "run": 80, "evidence": 3}, {"tried": 76, "run": 81}),
}
COUNT = len(VERDICTS)
CROSS = THETA + names(True).index("drag_cross")  # which does not act on a boat that does not turn
FIRST, SECOND = 0.0, -0.3  # of the filter in `mean` before, and of the one in `trial`


def state_before(estimator):
    """A batch of one element for each verdict; the second filter differs in drag that does not act."""
    state = estimator.init((COUNT,))
    rng = np.random.default_rng(0)
    given = {name: torch.tensor([float(before.get(name, 0)) for before, _ in VERDICTS.values()]).double()
             for name in (*QUIET, "statistic")}  # fmt: skip
    updates = torch.tensor([float(before.get("updates", WARM + 9)) for before, _ in VERDICTS.values()]).double()
    m = state.mean.shape[-1] - THETA
    second, past = (torch.from_numpy(rng.standard_normal((COUNT, m))) for _ in range(2))
    trial = state.trial._replace(**given, since=updates, kept=second, before=past, updates=updates + 1)
    trial = trial._replace(mean=trial.mean.clone())
    trial.mean[:, CROSS] = SECOND
    readings = {"readings": 7.0, "weight": 3.0, "learned": 2.0}
    given = {name: torch.full((COUNT,), x).double() for name, x in readings.items()}
    given |= {"reading": second + 1, "spread": torch.ones_like(state.spread)}
    return state._replace(trial=trial, updates=updates, **given)


def samples() -> Sample:
    """One measured step of a boat that stands, as its thrusters push against each other."""
    one = torch.ones(1, COUNT, dtype=torch.float64)
    yes = one > 0
    return Sample(Inputs(0.5 * one, -0.5 * one, 0 * one, 0 * one, 0.4 * one), 0 * one, yes, yes.clone())


@pytest.fixture(scope="module")
def judged():
    estimator = JointEKF(2.5, 28.0, trial=Trial(), estimate_every=600.0)
    before = state_before(estimator)
    return before, rollout(estimator, before, samples())[0]


def test_every_verdict(judged):
    before, state = judged
    for k, (name, (_, expected)) in enumerate(VERDICTS.items()):
        for leaf, value in expected.items():
            number = getattr(state.trial if leaf in state.trial._fields else state, leaf)[k]
            assert float(number) == pytest.approx(value, abs=1e-6), (name, leaf)
        second = expected.get("leads", 0) == 1 or expected.get("changes") == 1  # predicts the next speed
        swapped = second != (VERDICTS[name][0].get("leads", 0) == 1)
        assert float(state.mean[k, CROSS]) == pytest.approx(SECOND if swapped else FIRST, abs=1e-9), name
        if expected.get("changes") == 1:
            torch.testing.assert_close(state.trial.before[k], before.trial.kept[k])
            assert not state.reading[k].any() and not state.spread[k].any()
        else:
            torch.testing.assert_close(state.trial.before[k], before.trial.before[k])
            torch.testing.assert_close(state.reading[k], before.reading[k])


def test_the_sum_of_innovations_is_that_of_page():
    """(8), with the numbers of the docstring."""
    rng = np.random.default_rng(1)
    statistic, usual, run = rng.uniform(0, 30, 400), rng.uniform(0, 2, 400), rng.integers(0, 9, 400)
    last, z = rng.uniform(-7, 7, (2, 400))
    statistic[:40] = rng.uniform(0, 3, 40)
    m = np.minimum(np.minimum(np.abs(z), np.abs(last)) ** 2, 25)
    keeps = z * last > 0
    g = np.maximum(0, statistic + np.where(keeps, m, -m) - 0.5 - 2 * usual)
    after = usual + 0.005 * (np.where(keeps, np.minimum(m, 4), 0) - usual)
    s, node = np.zeros(4), np.arange(4)
    places = AT_TRIAL._replace(usual=0, last=1, statistic=2, run=3)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(change_detection_kernel, "AT_TRIAL", places)
        for k in range(400):
            s[:] = usual[k], last[k], statistic[k], run[k]
            begins = plain(change_detection_kernel.detect)(node, s, z[k])
            expected = [after[k], z[k], g[k], run[k] if g[k] > 2 else 0]
            np.testing.assert_allclose(s, expected, atol=1e-12)
            assert begins == (g[k] > 2 and run[k] == 0)


@pytest.mark.parametrize("even", [False, True])
@pytest.mark.parametrize("side", [0, 1])
def test_the_parameters_of_a_side_are_those_of_its_name(even, side):
    named = names(even)
    expected = [0.0] * THETA + [1.0 if name.endswith(("_left", "_right")[side]) else 0.0 for name in named]
    assert sum(expected) == (7 if even else 4)
    direction = np.full(len(expected), 9.0)
    node = np.full(64, 1 if even else 0)
    plain(change_detection_kernel.side_of)(node, np.ones(len(expected)), side, direction)
    assert direction.tolist() == expected


def test_the_second_filter_begins_with_a_larger_covariance():
    """(9), dense: each side's parameters are in doubt together, and each parameter alone, up to ten times the prior."""
    estimator = JointEKF(2.5, 28.0, trial=Trial())
    state = rollout(estimator, estimator.init(), mission(100))[0]
    trial = state.trial._replace(mean=state.mean, factor=state.factor)
    plan = program_for(estimator.description(), (), np.dtype(np.float64))
    row, n = plan.pack(arrays_of(state._replace(trial=trial))), len(state.mean)
    change_detection_kernel.loosen_sides(plan.program[1], row[0], plan.numbers[0], np.empty(n))
    leaves = plan.unpack(row)
    mean, P, prior = state.mean.numpy(), state.covariance.numpy().copy(), estimator.variance.numpy()
    for ending in ("_left", "_right"):
        d = np.array(
            [0.0] * THETA
            + [x if name.endswith(ending) else 0.0 for name, x in zip(names(True), mean[THETA:], strict=True)]
        )
        P += 0.6**2 * np.outer(d, d)
    for i in range(THETA, n - 1):
        P[i, i] += min((0.3 * mean[i]) ** 2, max(ROOM * prior[i - THETA] - P[i, i], 0.0))
    U = np.tril(leaves["trial.factor"], -1).T + np.eye(n)
    np.testing.assert_allclose((U * leaves["trial.factor"].diagonal()) @ U.T, P, rtol=1e-8, atol=1e-12)
    np.testing.assert_array_equal(leaves["trial.kept"], mean[THETA:])


def test_a_new_segment_forgets_the_sum_but_not_the_trial():
    estimator = JointEKF(2.5, trial=Trial())
    state = estimator.init((2,))
    one = torch.ones(2, dtype=torch.float64)
    trial = state.trial._replace(
        statistic=9 * one, last=2 * one, run=5 * one, usual=0.3 * one, tried=torch.tensor([0.0, 3.0]).double()
    )
    after = estimator.start(state._replace(trial=trial), 0.7 * one).trial
    assert after.statistic.tolist() == after.last.tolist() == [0.0, 0.0]
    assert (
        after.run.tolist() == [0.0, 5.0] and after.tried.tolist() == [0.0, 3.0] and after.usual.tolist() == [0.3, 0.3]
    )
