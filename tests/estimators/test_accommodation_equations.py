"""Fault accommodation in one step: what is given to the filters, when, and how the sources are joined."""

import math

import numpy as np
import pytest
import torch

from usvlearn import Ensemble, Inputs, JointEKF, Persistence, Sample, Trial
from usvlearn.engine.rollouts import rollout
from usvlearn.estimators.ensemble.accommodation import kernel
from usvlearn.estimators.joint.state import THETA

LEFT, RIGHT = THETA + 3, THETA + 6  # the linear thrust of each side
ALARM = {"raised": 1.0, "evidence": 30.0, "sums": (-24.0, 37.0, 0.0, 0.0)}  # 1 − 24/(37 + 3) remains
# of the left side before a step, and what it has after it: handed, share (None: see the test)
CASES = {
    "healthy": ({}, 0, 1.0),
    "alarm": (ALARM | {"since": 5.0}, 0, 0.4),
    "alarm of ten seconds": (ALARM | {"since": 10.0}, 1, 0.4),
    "given already": (ALARM | {"since": 20.0, "handed": 1.0, "past": 2.5}, 1, 0.4),
    "alarm has ended, less thrust": ({"handed": 1.0, "past": 2.5}, 1, 0.4),
    "alarm has ended, all thrust": ({"handed": 1.0}, 0, 1.0),
}


@pytest.fixture(scope="module")
def stepped():
    """The states before and after one step, which tells nothing about thrust: the boat stands."""
    one = Ensemble({"joint": JointEKF(2.5, trial=Trial()), "persistence": Persistence()})
    count = len(CASES)
    state = one.init((count,))
    joint = state.members["joint"]
    sure = torch.diag(torch.full((joint.mean.shape[-1],), 1e-8, dtype=torch.float64)).expand(joint.factor.shape).clone()
    past = joint.mean[:, None].repeat(1, 2, 1)
    thrusters = {
        name: getattr(state.monitors.thrusters, name).clone()
        for name in ("raised", "evidence", "sums", "held", "since")
    }
    handed = state.accommodation.handed.clone()
    for k, (given, *_) in enumerate(CASES.values()):
        thrusters["since"][k] = given.get("since", 0.0)
        thrusters["raised"][k, 0], thrusters["evidence"][k, 0] = given.get("raised", 0.0), given.get("evidence", 0.0)
        thrusters["sums"][k, 0] = torch.tensor(given.get("sums", (0.0,) * 4), dtype=torch.float64)
        handed[k, 0] = given.get("handed", 0.0)
        past[k, :, LEFT : LEFT + 3] *= given.get("past", 1.0)
    trial = joint.trial._replace(past_mean=past, past_factor=sure[:, None].repeat(1, 2, 1, 1))
    state = state._replace(
        members={**state.members, "joint": joint._replace(factor=sure, trial=trial)},
        monitors=state.monitors._replace(thrusters=state.monitors.thrusters._replace(**thrusters)),
        accommodation=state.accommodation._replace(handed=handed),
    )
    row = torch.ones(1, count, dtype=torch.float64)
    some = Sample(Inputs(0.3 * row, -0.3 * row, 0 * row, 0 * row, 0.4 * row), 0 * row, row > 0, row > 0)
    return state, rollout(one, state, some)[0]


def test_filters_get_the_effectiveness_ten_seconds_after_an_alarm_until_they_reach_one(stepped):
    before, after = stepped
    now, joint, old = after.accommodation, after.members["joint"], before.members["joint"]
    for k, (name, (given, handed, share)) in enumerate(CASES.items()):
        assert now.handed[k].tolist() == [handed, 0], name
        assert now.share[k, 1] == 1 and now.deviation[k, 1] == 0, name
        assert float(now.share[k, 0]) == pytest.approx(share, abs=0.05), name
        assert (now.deviation[k, 0] > 0) == (share != 1), name
        new = handed > given.get("handed", 0)
        thrust = joint.mean[k, LEFT] / old.trial.past_mean[k, 0, LEFT]
        assert float(thrust) == pytest.approx(share if new or "past" in given else 1.0, abs=0.05), name
        assert joint.mean[k, RIGHT] == pytest.approx(float(old.mean[k, RIGHT]), rel=1e-3), name
        assert bool(joint.started[k]) == (new or handed < given.get("handed", 0)), name


def test_sources_are_joined_by_their_variances():
    """(3); a source that is not finite is unknown."""
    sources = [(0.4, 0.1), (0.6, 0.2), (math.nan, 0.1), (0.5, math.inf), (0.9, 0.0)]
    weigh, sums = getattr(kernel.weigh, "py_func", kernel.weigh), (0.0, 0.0)
    for value, deviation in sources:
        sums = weigh(value, deviation, *sums)
    weights = 1 / 0.1**2, 1 / 0.2**2
    expected = np.average([0.4, 0.6], weights=weights), 1 / math.sqrt(sum(weights))
    assert (sums[1] / sums[0], 1 / math.sqrt(sums[0])) == pytest.approx(expected)
    assert weigh(math.nan, 1.0, 2.0, 3.0) == (2.0, 3.0)
