"""The gradient by differences is that of autograd through the layers of torch; the descent finds the minimum."""

import json
import math

import numpy as np
import pytest
import torch
from hydra.utils import instantiate

from tests.support import few
from tests.support.commands import results
from tests.support.configured import added, configured, replayed, request
from usvlearn import Positive
from usvlearn.core.protocol import clean
from usvlearn.engine.rollouts import rollout, tensors
from usvlearn.logs.recordings import align_fleet
from usvlearn.sweeps.tuning import tune as tuning
from usvlearn.sweeps.tuning.batches import Evaluation, Hyperparameter, Objective
from usvlearn.sweeps.tuning.methods import descend, gradient, updated

SETTINGS = {
    "aid": {"gain": 0.7},
    "rls": {"forgetting": 0.98, "covariance": 30.0},
    "sift_map": {"memory": 20.0, "covariance": 30.0},
}


@pytest.fixture(scope="module")
def short(fleet):
    """Two boats, two missions of 40 s each."""
    cut = [run._replace(time=run.time[:100], samples=type(run.samples)(
        type(run.samples.inputs)(*(x[:100] for x in run.samples.inputs)), *(x[:100] for x in run.samples[1:])))
        for run in fleet.runs[:2]]  # fmt: skip
    return fleet._replace(runs=tuple(cut))


def by_autograd(fleet, estimator, paths) -> np.ndarray:
    """Back through all steps of all runs, by torch."""
    state, total, count = estimator.init((len(fleet.boats),)), 0.0, 0
    for run in fleet.runs:
        samples = tensors(run.samples, torch.float64)
        step = clean(samples, estimator.surge_limit)
        state, predicted, _ = rollout(estimator, state, samples, backend="torch")
        total = total + torch.where(step.learns, (predicted - step.surge).abs(), 0.0).sum(0)
        count = count + step.learns.sum(0)
    leaves = [next(estimator.get_submodule(path).parameters()) for path in paths]
    return np.array([float(x) for x in torch.autograd.grad((total / count).mean(), leaves)])


@pytest.mark.parametrize("member", few(SETTINGS, ["aid"]))
def test_the_gradient_is_that_of_autograd(short, member):
    setting, work = SETTINGS[member], []
    ranges = "{" + ", ".join(f"{path}: [0.01, {1e3 if value > 1 else 0.999}]" for path, value in setting.items()) + "}"
    asked = request(f"learn={member}", *added(member), f"++tuning.ranges.{member}={ranges}")
    parameters = [each for each in asked.parameters if each.path in setting]
    objective = Objective(asked.build, short, work.append)
    evaluation, slope, kink = gradient(objective, parameters, setting)
    estimator = asked.build(setting)
    expected = by_autograd(short, estimator, setting)
    np.testing.assert_allclose(slope, expected, rtol=1e-7)
    np.testing.assert_allclose(evaluation.maes, replayed(short, estimator), rtol=1e-12)
    assert not kink and sum(work) == pytest.approx(4 * len(setting) + 1) and min(abs(expected)) > 1e-7


@pytest.mark.thorough
def test_learning_lowers_the_error_and_stays_legal(short):
    asked = request("learn=sift_map", "tuning.ranges.sift_map.memory=[3,1000]")
    evaluated, used, curve = descend(Objective(asked.build, short), asked.parameters, 40)
    assert evaluated[0].setting == {"memory": 30.0, "covariance": 10.0}
    assert used == 9 * len(evaluated) <= 40 and len(curve) == len(evaluated)
    assert min(each.mae for each in evaluated) < 0.9 * evaluated[0].mae
    for each in evaluated:
        assert 3 <= each.setting["memory"] <= 1000 and 0.01 <= each.setting["covariance"] <= 10000
        np.testing.assert_allclose(each.maes, replayed(short, asked.build(each.setting)), rtol=1e-10)


def test_a_default_outside_the_range_is_judged_and_left(short):
    asked = request("learn=aid", "estimators.aid.gain=0.001")
    evaluated, used, curve = descend(Objective(asked.build, short), asked.parameters, 10)
    assert [each.setting["gain"] for each in evaluated[:2]] == [0.001, 0.01]
    assert used == 5 * len(curve) == 5 * (len(evaluated) - 1)
    np.testing.assert_allclose(evaluated[0].maes, replayed(short, asked.build({})), rtol=1e-10)
    middle, _, _ = descend(Objective(asked.build, short), asked.parameters, 10, "middle")
    assert middle[1].setting["gain"] == pytest.approx(1.0)


class Curved:
    """A narrow valley along no axis, whose minimum is known; or, with a kink, the size of one number."""

    def __init__(self, best, sharp=((1.0, 0.3), (0.3, 0.2))):
        self.best, self.sharp = np.array(best), np.array(sharp)

    def __call__(self, settings):
        return [Evaluation(setting, (self.at(np.log(list(setting.values()))),)) for setting in settings]

    def at(self, place):
        off = place - self.best
        return 0.1 + (off @ self.sharp @ off if len(off) > 1 else float(np.abs(off).sum()))


@pytest.mark.parametrize("best, least", [((1.0, -2.0), (1.0, -2.0)), ((9.0, -2.0), (math.log(100), 4.592))])
def test_the_descent_finds_the_minimum_in_the_range(best, least):
    curved = Curved(best)
    evaluated, used, _ = descend(curved, [Hyperparameter(name, Positive, 1.0, 0.01, 100.0) for name in "ab"], 150)
    reached = min(evaluated, key=lambda each: each.mae)
    assert reached.mae == pytest.approx(curved.at(np.array(least)), rel=1e-3)
    np.testing.assert_allclose(np.log(list(reached.setting.values())), least, atol=0.02)
    assert used <= 150 and all(0.01 <= x <= 100 for each in evaluated for x in each.setting.values())


def test_at_a_kink_a_grid_decides():
    class Kinked(Curved):
        def at(self, place):
            return 0.1 + abs(float(place[0]) - 7e-6)  # beside the start

    parameters = [Hyperparameter("a", Positive, 1.0, 0.01, 100.0)]
    with pytest.warns(UserWarning, match="has a kink here: a grid takes"):
        evaluated, used, curve = descend(Kinked([0.0]), parameters, 20)
    assert len(curve) == 1 and evaluated[0].setting == {"a": 1.0} and len(evaluated) == 1 + used - 5 <= 16


def test_curvature_stays_positive():
    curvature, step = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([0.3, -0.7])
    for change in ([-1.0, 1.0], [0.0, 0.0], [5.0, -1.0]):
        matrix = updated(curvature, step, np.array(change))
        assert (np.linalg.eigvalsh(matrix) > 0).all()
    np.testing.assert_allclose(matrix @ step, change)  # the secant equation


@pytest.mark.thorough
def test_it_is_the_way_of_learn_and_draws_its_curves(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    value = tuning.tune(configured("learn=aid", "tuning.evaluations=15"), tmp_path, instantiate, align_fleet)
    content = json.loads((tmp_path / "tuning.json").read_text())
    assert value == results(tmp_path)["objective"] == content["best"]["mae"] and content["evaluations"] <= 15
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert len(events.Scalars("learn/gain")) == len(events.Scalars("learn/loss")) >= 2
