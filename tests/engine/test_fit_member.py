"""A batch fit as a member of the forecasts: its motion, what it joins, and what it is worth."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from tests.support.live import planar
from usvlearn import Ensemble, ForecastSettings, JointEKF, Online, Persistence
from usvlearn.core.samples import Inputs, PlanarSample, Sample
from usvlearn.engine.fit_member import with_fit
from usvlearn.engine.validate import read_checkpoint
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.estimators.ensemble.forecasts.fit_layer import FittedForecasts
from usvlearn.estimators.ensemble.forecasts.state import FIT_WEIGHT, LATE, TABLE
from usvlearn.estimators.regressors.terms import LAG
from usvlearn.model.fit.hand_over import table_of
from usvlearn.model.fit.terms import AT, NAMES, TIME_CONSTANT
from usvlearn.model.surge import SurgeModel

MASS, TOP, DT = 28.0, 2.7, 0.4


def theta_of(thrust: float = 1.0) -> np.ndarray:
    """A boat with even terms, curves, and both sides different."""
    theta, rng = np.zeros(len(NAMES)), np.random.default_rng(2)
    theta[AT["drag_quadratic"]], theta[AT["drag_linear"]], theta[AT["drag_cross"]] = -0.08, -0.12, -0.3
    theta[AT["drag_even"]] = 0.02
    for side, share in (("left", 1.0), ("right", 0.8)):
        theta[AT[f"thrust_linear_{side}"]], theta[AT[f"thrust_quadratic_{side}"]] = 0.2 * share, 0.3 * share
        theta[AT[f"thrust_speed_{side}"]], theta[AT[f"thrust_even_speed_{side}"]] = -0.02, 0.01
    nodes = [k for name, k in AT.items() if "_node_" in name]
    theta[nodes] = 0.02 * rng.normal(size=len(nodes))
    theta[[k for name, k in AT.items() if name.startswith("thrust")]] *= thrust
    return theta


def table(theta: np.ndarray, late: float = 0.0) -> list[float]:
    return table_of(SimpleNamespace(fit=SimpleNamespace(theta=theta, top=TOP), identified=SimpleNamespace(late=late)))


def online(**settings) -> Online:
    members = {"joint": JointEKF(surge_max=TOP, mass=MASS), "persistence": Persistence()}
    model = Ensemble(members, forecasts=FittedForecasts(**settings) if settings else ForecastSettings())
    return Online.of({k: np.asarray(x) for k, x in Online(model)._live.leaves.items()},
                     {"estimator": "Ensemble", "kernel": model.description()})  # fmt: skip


def sail(boats: list[Online], steps: int, theta: np.ndarray, seed: int = 0) -> list[np.ndarray]:
    """Estimators learn from the same boat; what each has forecast, `(steps, horizons, columns)`, less the truth."""
    model, rng, v, due = SurgeModel.fitted(theta, TOP, MASS), np.random.default_rng(seed), 0.0, [[] for _ in boats]
    left, right = np.repeat(rng.uniform(-0.3, 1.0, (2, steps // 8 + 1)), 8, 1)
    for k in range(steps):
        v = float(model.step(v, left[k], right[k], 0.1, DT)) if k or seed else 0.0
        sample = Sample(
            Inputs(left[k], right[k], 0.0, 0.1, DT if k or seed else 0.0), v + 0.01 * rng.normal(), True, True
        )
        for each, taken in zip(boats, due, strict=True):
            each.step(sample)
            taken.append(each.leaf("forecasts.predictions") - v)
    return [np.array(each) for each in due]


def test_its_copies_move_as_the_fit_does():
    one, theta = online(), theta_of()
    one.take_fit(table(theta))
    sail([one], 60, theta)
    slot = int(np.argmax(one.leaf("forecasts.elapsed") == 0.0))
    begun = one.leaf("forecasts.frozen.fit.mean")[slot]
    np.testing.assert_array_equal(begun, one.leaf("members.joint.mean"))
    one.step(Sample(Inputs(0.9, 0.5, 0.0, 0.2, DT), 1.0, True, True))
    moved = one.leaf("forecasts.frozen.fit.mean")[slot]
    expected = SurgeModel.fitted(theta, TOP, MASS).step(begun[0], 0.9, 0.5, 0.2, DT) + begun[1] * DT
    assert abs(moved[0] - expected) < 2e-3 * TOP < abs(expected - begun[0])


def test_thrust_follows_a_command_late():
    changes = []
    for late in (0.0, 0.2, 9.0):
        one = online()
        one.take_fit(table(theta_of(), late))
        sail([one], 30, theta_of())
        slot = int(np.argmax(one.leaf("forecasts.elapsed") == 0.0))
        before = one.leaf("forecasts.frozen.fit.mean")[slot, 0]
        one.step(Sample(Inputs(1.2, 1.2, 0.0, 0.0, DT), 1.0, True, True))
        changes.append(one.leaf("forecasts.frozen.fit.mean")[slot, 0] - before)
    assert changes[0] > changes[1] > changes[2] and np.isfinite(changes[2])


def test_its_thrust_is_late_by_all_that_the_fit_has_found():
    theta = theta_of()
    theta[AT[LAG]], theta[AT[TIME_CONSTANT]] = 0.7, 0.4  # the lag is a share of a step of the fit's grid, 0.1 s
    assert table(theta, late=0.3)[LATE] == pytest.approx(0.77)


def test_the_next_steps_and_what_is_under_way_stay_as_they_are():
    one, other, theta = online(), online(), theta_of()
    sail([one, other], 80, theta)
    other.take_fit(table(theta_of(thrust=2.0)))
    assert "fit" not in one.description["forecasts"]
    np.testing.assert_array_equal(other.leaf("forecasts.rule.weights")[:, -1], FIT_WEIGHT)
    first, same = sail([one, other], 20, theta, seed=1)
    np.testing.assert_array_equal(same[:20, 4:, -1], first[:20, 4:, -1])  # 10 and 30 s, from before
    assert not np.array_equal(same[:, 2, -1], first[:, 2, -1], equal_nan=True)
    for name in ("members.joint.mean", "predictions", "halfwidths"):
        np.testing.assert_array_equal(one.leaf(name), other.leaf(name))


def test_a_good_fit_is_used_and_a_bad_one_is_outweighed():
    theta, boats = theta_of(), [online(), online(), online()]
    sail(boats, 50, theta)
    boats[1].take_fit(table(theta))
    boats[2].take_fit(table(theta_of(thrust=-1.5)))
    none, good, bad = sail(boats, 400, theta, seed=1)
    errors = [np.nanmean(np.abs(each[:, 2:5, -1]), 0) for each in (none, good, bad)]  # at 2, 5.2 and 10 s
    assert (errors[1] < errors[0]).all() and (errors[2] < 1.05 * errors[0]).all()
    weights = [each.leaf("forecasts.rule.weights")[2:5, -1] for each in boats[1:]]
    assert (weights[0] > 0.5).all() and (weights[1] < 0.02).all()


def test_it_goes_on_where_it_was_saved_and_a_new_fit_takes_its_place(tmp_path):
    one, theta = online(), theta_of()
    one.take_fit(table(theta))
    sail([one], 40, theta)
    other = Online.open(one.save(tmp_path / "one.safetensors"))
    first, again = sail([one, other], 60, theta, seed=1)
    np.testing.assert_array_equal(first, again)
    weights, new = one.leaf("forecasts.rule.weights"), table(theta_of(thrust=0.9))
    one.take_fit(new)
    assert one.description["forecasts"]["fit"] == {"column": 0, "table": new}
    np.testing.assert_array_equal(one.leaf("forecasts.rule.weights"), weights)
    assert np.isfinite(one.forecast([[0.5, 0.5]] * 75, headings=0.0).surge).all()


def test_a_fit_that_is_doubted_is_inactive_and_the_next_one_begins_anew():
    theta, none, one = theta_of(), online(), online()
    sail([none, one], 60, theta)
    one.take_fit([0.0] * TABLE)
    first, same = sail([none, one], 60, theta, seed=1)
    assert np.isnan(same[..., -3]).all()
    np.testing.assert_allclose(same[..., -1], first[..., -1], atol=0.05)
    one.take_fit(table(theta))
    np.testing.assert_allclose(one.leaf("forecasts.rule.weights")[:, -1], FIT_WEIGHT)
    np.testing.assert_allclose(one.leaf("forecasts.rule.weights").sum(-1), 1.0)
    assert np.isfinite(sail([one], 40, theta, seed=2)[0][5:, 2, -3]).any()


def test_a_replay_with_the_fit_in_its_settings_makes_the_same_forecasts():
    fit = table(theta_of())
    one, other = online(), online(fit=fit)
    one.take_fit(fit)
    assert json.dumps(one.description) == json.dumps(other.description)
    sail([one], 30, theta_of())
    other.state = one.state
    first, again = sail([one, other], 60, theta_of(), seed=1)
    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize("wrong, message", [
    ({"table": [0.0] * 3}, "fit.table: found the shape"),
    ({"table": [float("nan")] * TABLE}, "fit.table: found nan"),
    ({"column": 1}, "fit.column: found 1, expected that of a weighed joint EKF"),
    ({"more": 1}, "found 'more'"),
])  # fmt: skip
def test_a_damaged_fit_is_refused(wrong, message, tmp_path):
    one = online()
    one.take_fit(table(theta_of()))
    one.description["forecasts"]["fit"] |= wrong
    with pytest.raises(CheckpointError, match=message):
        read_checkpoint(one.save(tmp_path / "one.safetensors"))


def test_without_a_joint_ekf_there_is_no_such_member():
    model = Ensemble({"persistence": Persistence()}, forecasts=ForecastSettings())
    assert with_fit({}, model.description(), table(theta_of()))[1] == model.description()
    with pytest.raises(ConfigError, match="expected a joint EKF"):
        Ensemble({"persistence": Persistence()}, forecasts=FittedForecasts(fit=table(theta_of())))
    with pytest.raises(ConfigError, match=f"found 2 numbers, expected {TABLE}"):
        FittedForecasts(fit=[1.0, 2.0])


def test_a_boat_in_the_plane_takes_it_too(tmp_path):
    one = Online.open(Online(planar()).save(tmp_path / "planar.safetensors"))
    one.take_fit(table(theta_of()))
    other = Online.open(one.save(tmp_path / "fitted.safetensors"))
    for k in range(30):
        for each in (one, other):
            sample = Sample(Inputs(0.6, 0.5, 0.01 * k, 0.02, DT * (k > 0)), 0.05 * k, True, True)
            each.step(PlanarSample(sample, 0.01 * k, 0.02, 0.0, 0.3 * k, 0.1 * k))
    tracks = [each.forecast([[0.5, 0.4]] * 20) for each in (one, other)]
    np.testing.assert_array_equal(tracks[0].surge, tracks[1].surge)
    assert np.isfinite(tracks[0].surge).all() and one.leaf("surge.forecasts.rule.weights").shape == (6, 4)
