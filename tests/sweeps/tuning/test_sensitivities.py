"""The exact gradient: that of the pass in order, over all runs; and the descent along it."""

import itertools
import json

import numpy as np
import pytest
import torch
from hydra.utils import instantiate

from tests.support import few
from tests.support.commands import results
from tests.support.configured import added, configured, replayed, request
from usvlearn import Persistence, Positive
from usvlearn.errors import ConfigError
from usvlearn.logs.recordings import align_fleet
from usvlearn.sweeps.tuning import tune as tuning
from usvlearn.sweeps.tuning.batches import Evaluation, Hyperparameter, Objective, element_errors
from usvlearn.sweeps.tuning.sensitivities import COST, descend, sensitivity, updated


@pytest.fixture(scope="module")
def fleet():
    """Two boats, two missions of 40 s each."""
    cfg = configured()
    fleet = align_fleet(instantiate(cfg["data"]), **cfg["align"])
    cut = [run._replace(time=run.time[:100], samples=type(run.samples)(
        type(run.samples.inputs)(*(x[:100] for x in run.samples.inputs)), *(x[:100] for x in run.samples[1:])))
        for run in fleet.runs[:2]]  # fmt: skip
    assert len(cut) == 2
    return fleet._replace(runs=tuple(cut))


def difference(fleet, estimator, path, h=1e-5) -> float:
    """Central, of the error of the replay of all runs in order."""
    leaf, sides = next(estimator.get_submodule(path).parameters()), []
    for step in (h, -h):
        with torch.no_grad():
            leaf += step
            sides.append(float(element_errors(estimator, fleet).mae.mean()))
            leaf -= step
    return (sides[0] - sides[1]) / (2 * h)


SETTINGS = {
    "aid": {"gain": 0.7},
    "sift_map": {"memory": 20.0, "covariance": 30.0},
    "rnn": {"rate": 1e-3, "contraction_rate": 0.97},
    "joint": {"disturbance": 5.0, "drift_time": 3000.0, "current": 0.1},
    "arx": {"walk": 1e-3, "scale": 0.2},
    "dynamic_rls": {"estimator.memory": 3.0, "estimator.covariance": 10.0},
}


@pytest.mark.thorough
@pytest.mark.parametrize(
    "member", [*few(["dynamic_rls"], (), "thorough"), *few((x for x in SETTINGS if x != "dynamic_rls"), {"aid"})]
)
def test_the_gradient_is_the_difference_of_the_whole_pass(fleet, member):
    asked, setting = request(f"learn={member}", *added(member)), SETTINGS[member]
    parameters = [each for each in asked.parameters if each.path in setting]
    work = []
    found, gradient = sensitivity(Objective(asked.build, fleet, work.append), parameters, setting)
    estimator = asked.build(setting)
    np.testing.assert_allclose(found.maes, replayed(fleet, estimator), rtol=1e-12)
    expected = [difference(fleet, estimator, path) for path in setting]
    np.testing.assert_allclose(gradient, expected, rtol=1e-5)
    assert min(map(abs, expected)) > 1e-7 and sum(work) == pytest.approx(COST * len(setting))
    # What the first run taught reaches the second: without that the gradient is another one.
    alone = [fleet._replace(runs=(run,)) for run in fleet.runs]
    steps = [np.isfinite(run.samples.surge).sum() for run in fleet.runs]
    apart = np.average([[difference(one, estimator, p) for p in setting] for one in alone], axis=0, weights=steps)
    assert np.abs(apart - expected).max() > 1e-3 * np.abs(expected).max()


@pytest.mark.thorough
def test_learning_lowers_the_error_and_stays_legal(fleet):
    asked = request("learn=sift_map", "tuning.ranges.sift_map.memory=[3,1000]")
    found, used, curve = descend(Objective(asked.build, fleet), asked.parameters, 26)
    assert found[0].setting == {"memory": 30.0, "covariance": 10.0}
    assert used == COST * 2 * len(found) <= 26 and len(curve) == len(found)
    assert min(each.mae for each in found) < 0.9 * found[0].mae
    for each in found:
        assert 3 <= each.setting["memory"] <= 1000 and 0.01 <= each.setting["covariance"] <= 10000
        np.testing.assert_allclose(each.maes, replayed(fleet, asked.build(each.setting)), rtol=1e-10)


@pytest.mark.thorough
def test_a_default_outside_the_range_is_judged_and_left(fleet):
    asked = request("learn=aid", "estimators.aid.gain=0.001")
    found, used, curve = descend(Objective(asked.build, fleet), asked.parameters, 6)
    assert [each.setting["gain"] for each in found[:2]] == [0.001, 0.01]
    assert used == COST * len(curve) == COST * (len(found) - 1)
    np.testing.assert_allclose(found[0].maes, replayed(fleet, asked.build({})), rtol=1e-10)
    middle, _, _ = descend(Objective(asked.build, fleet), asked.parameters, 6, "middle")
    assert middle[1].setting["gain"] == pytest.approx(1.0)


class Curved:
    """A narrow valley along no axis: its minimum and gradient are known."""

    def __init__(self, best, sharp):
        self.best, self.sharp = np.array(best), np.array(sharp)

    def __call__(self, settings):
        return [Evaluation(s, (self.at(s)[0],)) for s in settings]

    def at(self, setting):
        off = np.log(list(setting.values())) - self.best
        return 0.1 + off @ self.sharp @ off, torch.tensor(2 * self.sharp @ off)


@pytest.mark.thorough
@pytest.mark.parametrize("best, reached", [((1.0, -2.0), (1.0, -2.0)), ((9.0, -2.0), None)])
def test_the_descent_finds_the_minimum_in_the_range(monkeypatch, best, reached):
    curved = Curved(best, [[1.0, 0.3], [0.3, 0.2]])
    parameters = [Hyperparameter(name, Positive, 1.0, 0.01, 100.0) for name in "ab"]
    monkeypatch.setattr("usvlearn.sweeps.tuning.sensitivities.sensitivity", lambda objective, _, setting: (
        Evaluation(setting, (curved.at(setting)[0],)), curved.at(setting)[1]))  # fmt: skip
    found, used, _ = descend(curved, parameters, 90)
    places = np.log(np.geomspace(0.01, 100, 401))
    least = min(0.1 + (off := np.array(p) - best) @ curved.sharp @ off for p in itertools.product(places, places))
    assert min(each.mae for each in found) == pytest.approx(least, rel=1e-3)
    assert used <= 90 and all(0.01 <= x <= 100 for each in found for x in each.setting.values())
    if reached:
        last = min(found, key=lambda each: each.mae)
        np.testing.assert_allclose(np.log(list(last.setting.values())), reached, atol=0.02)


def test_curvature_stays_positive():
    curvature = torch.tensor([[2.0, 0.5], [0.5, 1.0]], dtype=torch.float64)
    step = torch.tensor([0.3, -0.7], dtype=torch.float64)
    for change in ([-1.0, 1.0], [0.0, 0.0], [5.0, -1.0]):
        found = updated(curvature, step, torch.tensor(change, dtype=torch.float64))
        assert bool((torch.linalg.eigvalsh(found) > 0).all())
    np.testing.assert_allclose(found @ step, change)  # the secant equation


class Cut(torch.autograd.Function):
    """An operation without a forward derivative."""

    @staticmethod
    def forward(ctx, x):
        return x.clone()


class Foreign(Persistence):
    def __init__(self, gain=1.0):
        super().__init__()
        self.gain = Positive(gain, "gain")

    def predict(self, state, inputs):
        return state, Cut.apply(self.gain() * state.surge)


@pytest.mark.thorough
def test_an_estimator_without_forward_derivatives_is_told(fleet):
    objective = Objective(lambda values: Foreign(**values), fleet)
    with pytest.raises(ConfigError, match=r"no forward derivative .*: use grid or search"):
        descend(objective, [Hyperparameter("gain", Positive, 1.0, 0.5, 2.0)], 12)


@pytest.mark.thorough
def test_it_is_the_way_of_learn(tmp_path):
    given = configured("learn=aid", "tuning.evaluations=6")
    made = tuning.tune(given, tmp_path, instantiate, align_fleet)
    found = json.loads((tmp_path / "tuning.json").read_text())
    assert made == results(tmp_path)["objective"] == found["best"]["mae"] and found["evaluations"] == 6
