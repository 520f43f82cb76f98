"""Members that other code steps: two passes equal stepping all together, to the last bit."""

import math

import numpy as np
import pytest
import torch

from tests.support import at, leaves, random_samples
from usvlearn import AID, ARX, BOA, Ensemble, Estimator, ForecastSettings, Online, Persistence, Sample, rollout
from usvlearn.core.samples import tree_map
from usvlearn.engine.external import first_pass
from usvlearn.engine.rollouts import simulate


class Mine(Estimator):
    """A stranger's class: a running mean; it may raise at a step, or return what is wrong."""

    def __init__(self, bad=None, step=8):
        super().__init__()
        self.bad, self.step = bad, step

    def init(self, batch=()):
        zero = torch.zeros(tuple(batch), dtype=torch.float64)
        return {"mean": zero, "count": zero.clone()}

    def start(self, state, surge):
        return {**state, "mean": surge}

    def predict(self, state, inputs):
        found = state["mean"] + 0.01 * inputs.command_left
        if self.bad is not None and bool((state["count"] >= self.step).any()):
            found = self.bad(found)
        return state, found

    def update(self, state, inputs, surge):
        return {"mean": 0.7 * state["mean"] + 0.3 * surge, "count": state["count"] + 1}


def ensemble(*others, **given):
    members = {"mine": Mine(**given), "aid": AID(28.0), "arx": ARX(), "still": Persistence()} | dict(others)
    return Ensemble(members, {"boa": BOA(["mine", "aid", "arx"])}, forecasts=ForecastSettings((0.4, 2.0)))


def mission(*batch):
    samples = random_samples(60, *batch)
    surge, measured, fresh, dt = (
        x.clone() for x in (samples.surge, samples.measured, samples.fresh, samples.inputs.dt)
    )
    measured[20:26], fresh[30] = False, False
    fresh[40], measured[40], dt[40] = False, False, 0.0  # a segment starts
    return Sample(samples.inputs._replace(dt=dt), surge, fresh, measured)


@pytest.mark.parametrize("batch", [(), (3,)])
@torch.no_grad()
def test_two_passes_equal_stepping_together(batch):
    made, samples = ensemble(), mission(*batch)
    record = ["predictions", "members.mine.mean"]
    end, surge, kept = rollout(made, made.init(batch), samples, record, backend="kernel")
    online, state = Online(made, batch), made.init(batch)
    for k in range(60):
        live = online.step(at(samples, k))
        state, by_torch = made(state, at(samples, k))
        np.testing.assert_array_equal(live, surge[k])
        torch.testing.assert_close(by_torch, surge[k], equal_nan=True, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(online.leaf("predictions"), kept["predictions"][k])
        np.testing.assert_array_equal(online.leaf("members.mine.mean"), kept["members.mine.mean"][k])
    for name, leaf in leaves(online.state).items():
        np.testing.assert_array_equal(leaf, leaves(end)[name], name)
    assert (kept["predictions"][..., 0].isfinite().sum(0) >= 58).all()
