"""Members that other code steps: two passes equal stepping all together, to the last bit."""

import math

import numpy as np
import pytest
import torch

from tests.support import at, leaves, random_samples
from usvlearn import (
    AID,
    ARX,
    BOA,
    Ensemble,
    Estimator,
    ForecastSettings,
    JointEKF,
    Online,
    Persistence,
    Planar,
    PlanarSample,
    Sample,
    rollout,
)  # fmt: skip
from usvlearn.engine.rollouts import simulate
from usvlearn.engine.validate import check
from usvlearn.errors import CheckpointError


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
        predicted = state["mean"] + 0.01 * inputs.command_left
        if self.bad is not None and bool((state["count"] >= self.step).any()):
            predicted = self.bad(predicted)
        return state, predicted

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
    model, samples = ensemble(), mission(*batch)
    record = ["predictions", "members.mine.mean"]
    end, surge, recorded = rollout(model, model.init(batch), samples, record, backend="kernel")
    online, state = Online(model, batch), model.init(batch)
    for k in range(6):
        state, by_torch = model(state, at(samples, k))
        torch.testing.assert_close(by_torch, surge[k], rtol=1e-12, atol=1e-12)
    for k in range(60):
        live = online.step(at(samples, k))
        np.testing.assert_array_equal(live, surge[k])
        np.testing.assert_array_equal(online.leaf("predictions"), recorded["predictions"][k])
        np.testing.assert_array_equal(online.leaf("members.mine.mean"), recorded["members.mine.mean"][k])
    for name, leaf in leaves(online.state).items():
        np.testing.assert_array_equal(leaf, leaves(end)[name], name)
    assert (recorded["predictions"][..., 0].isfinite().sum(0) >= 58).all()


def refuse(state):
    raise RuntimeError("no \x1b[1m\n  licence")


BAD = {  # what goes wrong from the ninth step on, and what is said
    "raises": (refuse, "estimators.mine: step 9: RuntimeError: no licence: the run goes on without it"),
    "shape": (lambda x: x[..., None], r"step 9: ShapeError: it predicted the shape \(2, 1\), expected \(2,\)"),
    "nan": (lambda x: x * math.nan, "estimators.mine: step 9: it predicted no finite number"),
}


@pytest.mark.parametrize("name", BAD)
@torch.no_grad()
def test_a_class_that_fails_is_named_with_the_step_and_the_run_goes_on(name):
    bad, words = BAD[name]
    model, samples = ensemble(bad=bad), random_samples(30, 2)
    with pytest.warns(UserWarning, match=words):
        end, surge, recorded = rollout(model, model.init((2,)), samples, ["predictions"])
    predicted = recorded["predictions"][..., 0]
    assert predicted[:8].isfinite().all() and predicted[8:].isnan().all() and surge.isfinite().all()
    if name == "raises":  # it stays away, also from a checkpoint on
        again, online = random_samples(5, 2, seed=1), Online(model, (2,))
        assert rollout(model, end, again, ["predictions"])[2]["predictions"][..., 0].isnan().all()
        online.state = end
        online.step(at(again, 0))
        assert np.isnan(online.leaf("predictions")[..., 0]).all()


def test_an_open_loop_simulation_knows_the_inputs_alone():
    model, samples = ensemble(), random_samples(20, 2)
    with torch.no_grad():
        state, _, _ = rollout(model, model.init((2,)), samples)
        end, _, recorded = simulate(model, state, samples, ["predictions"])
    expected = state.members["mine"]["mean"] + 0.01 * samples.inputs.command_left
    assert torch.equal(recorded["predictions"][..., 0], expected)
    assert torch.equal(end.members["mine"]["count"], state.members["mine"]["count"])


def test_a_checkpoint_goes_on_with_the_class_and_says_what_lacks_without(tmp_path):
    samples, online = mission(), Online(ensemble())
    for k in range(12):
        online.step(at(samples, k))
    path = online.save(tmp_path / "boat.safetensors")
    with pytest.warns(UserWarning, match="mine predicts nothing, unless members="):
        without = Online.open(path)
    given = Online.open(path, members={"mine": Mine()})
    again = Online(ensemble())
    again.restore(path)
    for k in range(12, 20):
        expected = online.step(at(samples, k))
        assert again.step(at(samples, k)) == given.step(at(samples, k)) == expected
        without.step(at(samples, k))
    assert np.isnan(without.leaf("predictions")[0]) and np.isfinite(without.leaf("predictions")[1:]).all()
    ahead, before = given.predict_members(at(samples, 20).inputs), given.leaf("members.mine.mean")
    assert np.isfinite(ahead["mine"][0]) and given.leaf("members.mine.mean") == before
    assert without.save(tmp_path / "later.safetensors")  # what it does not know, it keeps
    assert Online(ensemble()).restore(tmp_path / "later.safetensors")["estimator"] == "Ensemble"


def test_a_boat_in_the_plane_has_such_members():
    planar = Planar(Ensemble({"mine": Mine(), "joint": JointEKF(2.7)}, forecasts=ForecastSettings()), surge_max=2.7)
    assert planar.description()["surge"]["members"]["mine"]["kind"] == "external"
    online, alone, samples = Online(planar), Online(planar.surge), mission()
    for k in range(30):
        assert online.step(PlanarSample(at(samples, k), *[math.nan] * 5)) == pytest.approx(
            alone.step(at(samples, k)), nan_ok=True, abs=1e-12
        )
    assert np.isfinite(online.leaf("surge.predictions")).all()


def test_a_file_cannot_send_a_kernel_beyond_its_row():
    model = ensemble()
    description, state = model.description(), {name: leaf.numpy() for name, leaf in leaves(model.init()).items()}
    check(description, state)
    description["members"]["mine"]["column"] = 3
    with pytest.raises(CheckpointError, match=r"kernel\.members: found \[3\], expected the kind external"):
        check(description, state)
    with pytest.raises(CheckpointError, match=r"kernel\.kind"):
        check({"kind": "external", "size": 0, "numbers": {}, "column": 0}, {})
