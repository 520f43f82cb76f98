"""A fitted boat: what its logs lack, what a checkpoint says of it, and the joint EKFs that go on from it."""

import copy
import json

import numpy as np
import pytest

from tests.support.fitted_boats import MASS, TOP, boat, mission, simulated
from usvlearn import JointEKF, Trial
from usvlearn.core.prepared_samples import COS, LEARN, LEFT, MODE, RIGHT, SIN, SURGE, YAW_RATE
from usvlearn.core.samples import named_leaves
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.estimators.augmented_ekf.state import LAG_MOST
from usvlearn.estimators.joint.periodic_estimates import covariance_of, identify
from usvlearn.estimators.joint.state import THETA, names
from usvlearn.model.fit.boat import FITTED, FittedBoat
from usvlearn.model.fit.choice import choose
from usvlearn.model.fit.fitted import fit_boat
from usvlearn.model.fit.gauss_newton import Missions
from usvlearn.model.fit.hand_over import factored, handed_over
from usvlearn.model.fit.intervals import spread
from usvlearn.model.fit.logs import DT, lacking
from usvlearn.model.fit.terms import AT, PLACE_TIME, TIME_CONSTANT


def rows_of_boat(seed: int = 0, steps: int = 1500) -> np.ndarray:
    rows = mission(steps, seed)
    rows[1:, SURGE] = simulated(rows, boat())[1:] + 0.02 * np.random.default_rng(seed).standard_normal(steps)
    rows[1:, MODE] = LEARN
    return rows


@pytest.fixture(scope="module")
def fitted():
    return fit_boat("heron", {f"{seed}.csv": rows_of_boat(seed) for seed in range(3)}, MASS, TOP)


def test_a_checkpoint_has_the_whole_boat(fitted):
    read = FittedBoat.read(json.loads(json.dumps(fitted.identified.facts(), allow_nan=False)))
    assert read.json() == fitted.identified.json() and read.lacks == fitted.identified.lacks
    assert read.lag(0.4) == fitted.identified.lag(0.4) and read.beside.common == fitted.identified.beside.common
    np.testing.assert_array_equal(read.covariance, fitted.identified.covariance)
    np.testing.assert_array_equal(read.every(read.theta), fitted.fit.theta)
    assert repr(read).splitlines()[1].split()[0] == "drag_quadratic" and "Fitted to 3 missions" in repr(read)


@pytest.mark.parametrize("turns", [True, False])
def test_that_a_boat_hardly_turned_is_said(turns):
    rows = rows_of_boat()
    rows[:, YAW_RATE] *= turns
    sailed = Missions([rows], TOP)
    fits = {"nine": sailed.fit("nine")}
    boat = FittedBoat.of(sailed, fits, choose(sailed, fits)[1], "nine", MASS, (), 0.3)
    assert any("the boat hardly turns" in each for each in boat.lacks) != turns
    lag = fits["nine"].theta[PLACE_TIME]
    assert boat.lag(0.4)[0] == pytest.approx(0.3 + lag) and FittedBoat.read(boat.facts()).late == 0.3


def test_a_fit_of_a_version_whose_sets_had_no_lag_is_read(fitted):
    facts = copy.deepcopy(fitted.identified.facts())
    place = list(facts["theta"]).index(TIME_CONSTANT)
    del facts["theta"][TIME_CONSTANT]
    facts["covariance"] = np.delete(np.delete(facts["covariance"], place, 0), place, 1).tolist()
    boat = FittedBoat.read(facts)
    assert boat.theta[place] == 0.0 == boat.covariance[place, place]
    assert FittedBoat.read(boat.facts())["time_constant"] == boat["time_constant"] == fitted.identified["time_constant"]


@pytest.mark.parametrize(
    "change",
    [
        {"terms": "other"}, {"terms": ["nine"]}, {"top": 0.0}, {"top": None}, {"mass": -1.0}, {"common": -0.1},
        {"theta": {}}, {"theta": [1.0]}, {"covariance": [[1.0]]}, {"covariance": "x"}, {"quantities": {}},
        {"quantities": {"drag_linear": [1.0]}}, {"quantities": 3}, {"lacks": None}, {"top": 1e400},
        {"turning": [[1.0], [[1.0]], 0.5]}, {"turning": 1.0}, {"noise": 0.0},
    ],
)  # fmt: skip
def test_a_damaged_one_is_refused_in_one_sentence(fitted, change):
    with pytest.raises(CheckpointError, match=r"its fit is damaged .*: run usvlearn fit again") as error:
        FittedBoat.read(copy.deepcopy(fitted.identified.facts()) | change)
    assert "\n" not in str(error.value)
    with pytest.raises(CheckpointError):
        FittedBoat.read(None)
    facts = copy.deepcopy(fitted.identified.facts())
    facts["covariance"][0][0] = -1.0
    with pytest.raises(CheckpointError, match="negative variance"):
        FittedBoat.read(facts)


def test_what_the_commands_do_not_show_is_said():
    rows = rows_of_boat()
    assert lacking("heron", [rows]) == ()

    def changed(left=None, right=None):
        new = rows.copy()
        new[:, LEFT] = new[:, LEFT] if left is None else left(new[:, LEFT])
        new[:, RIGHT] = new[:, RIGHT] if right is None else right(new[:, RIGHT])
        return lacking("heron", [new])

    assert changed(right=lambda x: rows[:, LEFT])[0].startswith("Both thrusters always had the same command")
    assert changed(np.abs)[0].startswith("The thrusters hardly ever pushed astern")
    (slow,) = changed(lambda x: x / 2, lambda x: x / 2)
    assert slow == "Commands were hardly ever above 50 %: what is beyond is an extrapolation."
    assert "a dead band would not show" in changed(*[lambda x: x + np.sign(x) * 0.2] * 2)[0]
    straight = rows.copy()
    straight[:, [COS, SIN]] = 0.6, 0.8
    assert lacking("heron", [straight])[-1].startswith("The boat kept one heading, or its opposite")
    moored = rows.copy()
    moored[:, SURGE] = 0.02 * np.random.default_rng(0).standard_normal(len(rows))
    with pytest.raises(ConfigError, match=r"heron: found speeds of -0.0\d to 0.0\d m/s that hardly ever changed"):
        lacking("heron", [moored])
    with pytest.raises(ConfigError, match=r"heron: found commands that hardly ever changed while the boat moved .60 %"):
        changed(*[lambda x: 0.6 + 0 * x] * 2)


def test_joint_filters_go_on_from_the_fit(fitted):
    joint = JointEKF(surge_max=TOP, mass=MASS, estimate_every=600.0, even=None)
    leaves = {name: leaf.detach().numpy() for name, leaf in named_leaves(joint.init())}
    handed, facts = handed_over(leaves, joint.description(), fitted, dt=0.4)
    assert facts == {FITTED: fitted.identified.facts()} and set(handed) == set(leaves)
    assert all(handed[name].shape == leaf.shape and handed[name].dtype == leaf.dtype for name, leaf in leaves.items())
    cubic = fitted.fits["cubic"]
    named = names(even=False)
    expected = np.array([cubic.theta[AT[name]] for name in named])
    expected[-1] = min((expected[-1] * DT + cubic.theta[PLACE_TIME]) / 0.4, LAG_MOST)
    np.testing.assert_allclose(handed["mean"][THETA:], expected, rtol=1e-12)
    np.testing.assert_array_equal(handed["mean"][:THETA], leaves["mean"][:THETA])
    P, before = covariance_of(handed["factor"]), covariance_of(leaves["factor"])
    np.testing.assert_allclose(P[:THETA, :THETA], before[:THETA, :THETA], rtol=1e-9, atol=1e-12)
    assert not P[:THETA, THETA:].any()
    places = [list(cubic.known.active).index(AT[name]) for name in named[:-1]]
    np.testing.assert_allclose(P[THETA:-1, THETA:-1], spread(cubic)[np.ix_(places, places)], rtol=1e-6, atol=1e-12)
    online = identify(joint.description(), handed)
    for name in ("steady_speed_full", "drag_half_speed", "thrust_full_left"):
        each = online[name]
        assert each.low <= fitted.quantities[name].value <= each.high, name


def test_a_filter_that_goes_on_from_a_fit_makes_no_trial(fitted):
    joint = JointEKF(surge_max=TOP, mass=MASS, trial=Trial())
    leaves = {name: leaf.detach().numpy() for name, leaf in named_leaves(joint.init())}
    begun = {name: leaf + 3.0 for name, leaf in leaves.items() if name.startswith("trial.")}
    handed, _ = handed_over(leaves | begun, joint.description(), fitted, dt=0.4)
    for name in ("statistic", "last", "usual", "evidence", "best", "run", "tried", "leads", "early"):
        assert handed[f"trial.{name}"] == 0.0
    for name, source in (("mean", "mean"), ("factor", "factor"), ("kept", "reading"), ("before", "reading")):
        np.testing.assert_array_equal(handed[f"trial.{name}"], handed[source])
    assert (handed["trial.past_mean"] == handed["mean"]).all()


def test_a_covariance_is_factored_and_back():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((9, 9))
    np.testing.assert_allclose(covariance_of(factored(A @ A.T)), A @ A.T, rtol=1e-10, atol=1e-10)
    assert not factored(np.zeros((3, 3))).any()
