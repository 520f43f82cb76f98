"""WithMemory: what it hands over, against a plain loop over a log with gaps; where it is missing, an error."""

import math

import pytest
import torch

from tests.support import at, random_samples
from usvlearn import AID, RLS, Robust, Sample, SIFtRLS, SurgeDynamics, WithMemory, rollout
from usvlearn.errors import ShapeError
from usvlearn.estimators.baselines.persistence.layer import Persistence, PersistenceState


class Spy(Persistence):
    """Predicts the speed it was last told, and keeps what it was handed."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def learn(self, state, inputs, surge):
        self.seen.append(inputs)
        return PersistenceState(surge), state.surge

    def predict(self, state, inputs):
        self.seen.append(inputs)
        return state, state.surge


def log(steps: int = 60):
    """Irregular steps; missing speeds, stale steps, and segments that start, with a speed and without."""
    samples = random_samples(steps)
    surge, fresh, measured, dt = (
        x.clone() for x in (samples.surge, samples.fresh, samples.measured, samples.inputs.dt)
    )
    dt[:] = torch.rand(steps, generator=torch.Generator().manual_seed(1), dtype=torch.float64) + 0.2
    dt[0] = 0.0  # the log's first speed
    surge[8:11], measured[8:11] = math.nan, False
    surge[20] = math.nan  # said to be measured
    fresh[25:28], measured[25:28], surge[25:28] = False, False, math.nan
    for k in (35, 36, 50):
        dt[k], fresh[k], measured[k] = 0.0, False, False
    surge[45:48], measured[45:48] = math.nan, False
    fresh[48:50], measured[48:50], surge[48:50] = False, False, math.nan  # then a start after an outage
    return Sample(samples.inputs._replace(dt=dt), surge, fresh, measured)


def by_hand(samples, limit):
    """Acceleration and previous commands of every step, in plain Python."""
    rows, before, speed, since, acceleration = [], None, 0.0, 0.0, 0.0
    for k in range(len(samples.surge)):
        left, right, dt, surge = (
            float(x[k])
            for x in (samples.inputs.command_left, samples.inputs.command_right, samples.inputs.dt, samples.surge)
        )
        if dt == 0:
            before, speed, since, acceleration = None, surge, 0.0, 0.0
        elif samples.fresh[k]:
            rows.append((acceleration, *(before or (left, right))))
            before, since = (left, right), since + dt
            if samples.measured[k] and not math.isnan(surge):
                acceleration = max(-limit, min(limit, (surge - speed) / since))
                speed, since = surge, 0.0
            else:
                acceleration = 0.0  # of the spy's own estimate, which stays what it was
    return torch.tensor(rows, dtype=torch.float64)


@pytest.mark.parametrize("limit", [2.0, 0.5])
def test_hands_over_the_last_acceleration_and_commands(limit):
    """One step at a time: `forward` shows each step to predict first."""
    samples, spy = log(), Spy()
    estimator = WithMemory(spy, surge_dot_max=limit)
    state, found = estimator.init(), []
    for k in range(len(samples.surge)):
        spy.seen.clear()
        state, surge = estimator(state, at(samples, k))
        if not surge.isnan():
            first, second = spy.seen
            assert all(torch.equal(x, y) for x, y in zip(first, second, strict=True))
            assert first.dt == samples.inputs.dt[k] and first.heading == samples.inputs.heading[k]
            found.append(torch.stack(first[5:]))
    expected = by_hand(samples, limit)
    assert (expected[:, 0].abs() == limit).any() and (expected[:, 0].abs() < limit).sum() > 10
    torch.testing.assert_close(torch.stack(found), expected, rtol=1e-12, atol=1e-12)


def test_changes_nothing_for_a_model_without_memory():
    samples = log()
    for inner in (AID(28.0), RLS()):
        wrapped = WithMemory(inner)
        end, surge, _ = rollout(wrapped, wrapped.init(), samples)
        expected, expected_surge, _ = rollout(inner, inner.init(), samples)
        assert torch.equal(surge.nan_to_num(-9.0), expected_surge.nan_to_num(-9.0))
        assert torch.equal(end.inner.theta, expected.theta)


@pytest.mark.parametrize("make", [AID, RLS, SIFtRLS], ids=["aid", "rls", "sift"])
def test_a_model_with_memory_says_what_it_wants(make):
    bare = make(model=SurgeDynamics(28.0, memory=True))
    samples = random_samples(3)
    with pytest.raises(ShapeError, match="WithMemory"):
        rollout(bare, bare.init(), samples)
    wrapped = WithMemory(bare)
    assert rollout(wrapped, wrapped.init(), samples)[1].isfinite().all()


def test_robust_may_stand_inside_or_outside():
    samples = random_samples(30, 2)
    model = SurgeDynamics(28.0, memory=True)
    for estimator in (WithMemory(Robust(SIFtRLS(model))), Robust(WithMemory(SIFtRLS(model)))):
        end, surge, _ = rollout(estimator, estimator.init((2,)), samples)
        assert surge.isfinite().all() and end.inner is not None
    loosened = estimator.inflate_covariance(end, torch.tensor([4.0, 1.0], dtype=torch.float64))
    ratio = loosened.inner.inner.factor / end.inner.inner.factor
    torch.testing.assert_close(ratio[0].nan_to_num(2.0), torch.full_like(ratio[0], 2.0))
    assert torch.equal(loosened.inner.inner.factor[1], end.inner.inner.factor[1])
