"""Identified quantities of turning: closed forms, simulated boats, intervals, and what a log lacks."""

import functools
import math
from typing import Any

import numpy as np
import pytest
import torch

from usvlearn import Ensemble, ForecastSettings, JointEKF
from usvlearn.core.events import NINETY
from usvlearn.core.samples import Inputs, PlanarSample, Run, Sample, named_leaves
from usvlearn.engine.identified import identified
from usvlearn.engine.rollouts import chunked_rollout
from usvlearn.estimators.axis import turning_intervals
from usvlearn.estimators.axis.state import THETA, names
from usvlearn.estimators.axis.turning_intervals import FIRST
from usvlearn.estimators.axis.turning_quantities import INNER, QUANTITIES, Theta, acceleration, quantities, steady_turns
from usvlearn.estimators.joint.periodic_estimates import Identified
from usvlearn.estimators.joint.quantities import COMMANDS
from usvlearn.estimators.planar.layer import Planar
from usvlearn.estimators.planar.state import HEADING, TURN
from usvlearn.evaluation.diagnostics import as_results, identified_boats
from usvlearn.logs.recordings import align_fleet
from usvlearn.simulate import truth as simulated
from usvlearn.simulate.planar import HERON, simulate_planar
from usvlearn.simulate.planar_fleet import planar_boats, planar_fleet

TOP = 2.74


def planar() -> Planar:
    joint = JointEKF(surge_max=TOP, mass=33.75, estimate_every=600.0)
    return Planar(Ensemble({"joint": joint}, forecasts=ForecastSettings(members=["joint"])), surge_max=TOP)


def leaves_of(state) -> dict[str, np.ndarray]:
    return {name: leaf.detach().numpy().copy() for name, leaf in named_leaves(state)}


def heron() -> Theta:
    """A Heron whose thrusters have no more thrust ahead than astern."""
    (m_u, m_v, j), (l_u, l_v, l_r), (q_u, q_v, q_r) = HERON.mass, HERON.linear, HERON.quadratic
    push = HERON.thrust[0]
    surge, sway, yaw = np.zeros(12), np.zeros(12), np.zeros(20)
    surge[[0, 1, 3, 6]] = -q_u / m_u, -l_u / m_u, push / m_u, push / m_u
    sway[[1, 2, 3, 4]] = -l_v / m_v, -q_v / m_v, -HERON.lift[1] / m_v, -m_u / m_v
    yaw[[1, 2, 3, 4]] = -l_r / j, -q_r / j, -HERON.lift[2] / j, (m_u - m_v) / j
    yaw[[7, 13]] = HERON.arm * push / j, -HERON.arm * push / j
    return Theta(surge, yaw, sway)


def test_the_truth_of_a_simulated_boat_follows_from_its_parameters():
    """The surge of these equations has no v r; that changes the speed of a turn by some percent."""
    boat = HERON._replace(thrust=(HERON.thrust[0],) * 2)
    known, values = simulated.true_turning(boat), quantities(heron())
    assert list(known) == list(values) == list(QUANTITIES)
    for name, value in known.items():
        exact = "time_constant" in name or "difference" in name  # but for the step of a finite difference
        assert values[name] == pytest.approx(value, rel=1e-4 if exact else 0.06), name
    assert simulated.INNER == INNER


def test_a_steady_turn_does_not_change():
    theta = heron()
    u, v, r = steady_turns(theta)
    outer = np.array(list(COMMANDS.values()))
    for k, (left, right) in enumerate(((outer, INNER * outer), (INNER * outer, outer))):
        np.testing.assert_allclose(acceleration("yaw", theta.yaw, r[k], v[k], u[k], left, right), 0, atol=1e-9)
        np.testing.assert_allclose(acceleration("sway", theta.sway, v[k], r[k], u[k], left, right), 0, atol=1e-9)
    assert (r[0] > 0).all() and np.allclose(r[1], -r[0]) and (v[0] < 0).all()


def test_without_a_sway_filter_the_boat_does_not_drift():
    u, v, _ = steady_turns(heron()._replace(sway=None))
    assert (v == 0).all() and (u > 0).all()


def test_the_acceleration_is_that_of_the_filter():
    """A short step of the filter in torch has the slope f."""
    rng, h = np.random.default_rng(0), 1e-5
    for kind, axis in (("yaw", planar().yaw.members["yaw"]), ("sway", planar().sway.members["sway"])):
        theta = 0.1 * rng.normal(size=len(names(kind)))
        y, other, u, left, right = rng.normal(size=5)
        state = axis.init(())
        mean = torch.from_numpy(np.concatenate([[y, 0.0], theta]))
        commands = torch.tensor([left, right], dtype=torch.float64)
        inputs = Inputs(*(torch.tensor(x, dtype=torch.float64) for x in (left, right, other, u, h)))
        _, ahead = axis.predict(state._replace(mean=mean, commands=commands), inputs)
        expected = acceleration(kind, theta, y, other, u, left, right)
        assert (float(ahead) - y) / h == pytest.approx(expected, rel=1e-3)


def test_turns_that_no_parameters_allow_are_undefined():
    theta = heron()
    wrong = quantities(theta._replace(yaw=-theta.yaw))
    assert all(math.isnan(wrong[name]) for name in QUANTITIES if name.startswith(("yaw_rate_f", "turning", "yaw_time")))


@functools.cache
def run() -> Run:
    """A mission of 9 min."""
    return align_fleet(planar_fleet(hours=0.15, mission_minutes=9.0, seed=3)).runs[0]


def learned(samples: Sample, poses: np.ndarray) -> tuple[Planar, Any]:
    """The estimators, and their state after a mission of one boat."""
    model = planar()
    ((state, _),) = chunked_rollout(model, model.init((1,)), [PlanarSample(samples, *np.moveaxis(poses, -1, 0))], [])
    return model, state


def sentences(boat: Identified) -> str:
    return " ".join(boat.lacks)


@pytest.fixture(scope="module")
def mission():
    return learned(run().samples, run().poses)


@pytest.mark.thorough
def test_a_mission_tells_the_quantities(mission):
    whole = identified_boats(*mission, ["planar"])["planar"]
    (boat,) = planar_boats(1, seed=3)
    known = simulated.true_turning(boat)
    assert set(QUANTITIES) < set(whole) and "steady_speed_full" in whole
    assert whole.unknown >= QUANTITIES.keys() and FIRST in whole.lacks
    for name in ("yaw_rate_half", "turning_radius_half", "yaw_rate_full_difference"):
        assert whole[name].value == pytest.approx(known[name], rel=0.2), name
        assert whole[name].low < known[name] < whole[name].high, name
    assert "hardly turned" not in sentences(whole)


def test_a_boat_that_went_straight_tells_nothing_of_turning():
    poses, inputs = run().poses.copy(), run().samples.inputs
    poses[..., HEADING], poses[..., TURN] = 1.0, 0.0
    samples = run().samples._replace(inputs=inputs._replace(command_left=inputs.command_right))
    boat = identified_boats(*learned(samples, poses), ["planar"])["planar"]
    assert "hardly turned by its thrusters" in sentences(boat)
    for name in ("yaw_rate_half", "turning_radius_half", "yaw_rate_full_difference"):
        assert boat[name].high > 3 * boat[name].low, name


def test_without_heading_and_yaw_rate_nothing_is_known():
    poses = run().poses.copy()
    poses[..., [HEADING, TURN]] = np.nan
    boat = identified_boats(*learned(run().samples, poses), ["planar"])["planar"]
    assert "Neither heading nor yaw rate was measured" in sentences(boat)
    assert all(math.isnan(boat[name].value) and name in boat.unknown for name in QUANTITIES)
    assert math.isfinite(boat["steady_speed_full"].value)


def test_an_interval_is_that_of_draws_from_the_filters(mission):
    """(1) against the spread of the quantity over the filters' normal distributions; ε is taken out."""
    model, state = mission
    leaves = leaves_of(state)
    boat = identified(model.description(), leaves)[0]
    yaw = leaves["yaw.members.yaw.mean"][0, THETA:]
    sway = leaves["sway.members.sway.mean"][0, THETA:]
    P = turning_intervals.covariance_of(leaves["yaw.members.yaw.factor"][0])[THETA:, THETA:]
    rng = np.random.default_rng(0)
    draws = yaw + rng.multivariate_normal(np.zeros(len(P)), 1e-2 * P, 500)
    some = quantities(Theta(np.tile(boat.theta, (500, 1)), draws, np.tile(sway, (500, 1))))
    name = "yaw_rate_full_difference"  # neither surge nor sway enter it
    ratio = math.log(boat[name].high / boat[name].value) / NINETY
    spread = math.sqrt(ratio**2 - turning_intervals.OWN_ERROR[name] ** 2) * boat[name].value
    assert 10 * some[name].std() == pytest.approx(spread, rel=0.1)


def test_results_have_the_truth(mission):
    boats = identified_boats(*mission, ["planar"])
    truth = simulated.turning_of([{"_target_": "usvlearn.simulate.planar_fleet.planar_fleet", "seed": 3}])
    results = as_results(boats, truth)["identified"]["planar"]
    assert results["turning_radius_half"]["truth"] == truth["planar"]["turning_radius_half"]
    assert results["turning_radius_half"]["unit"] == "m"


def test_a_reversed_simulated_turn_is_the_same_turn():
    """The truth's turn to port, which `true_turning` does not simulate."""
    port = simulate_planar(HERON, np.tile([INNER, 1.0], (240, 1)), 0.5)[-1]
    assert -port[2] == pytest.approx(simulated.true_turning(HERON)["yaw_rate_full"], rel=1e-6)


@pytest.mark.thorough
def test_the_names_of_boats_are_those_of_the_fleet():
    logs = planar_fleet(2, hours=0.02, mission_minutes=1.2)
    known = simulated.turning_of([{"_target_": "x.planar_fleet.planar_fleet", "n": 2}])
    assert list(known) == [log.boat for log in logs]
