"""The kernel of the batch fit against the identified boat's own simulation, finite differences and a known motion."""

import numpy as np
import pytest

from tests.support.fitted_boats import MASS, TOP, boat, mission, simulated
from usvlearn.core.prepared_samples import COS, DT, HOLD, LEARN, LEFT, MODE, RIGHT, SIN, SURGE, YAW_RATE
from usvlearn.model.fit import motion_kernel as kernel
from usvlearn.model.fit.gauss_newton import Missions
from usvlearn.model.fit.quantities import CurvedAhead, quantities
from usvlearn.model.fit.terms import AT, NAMES, PLACE_LAG, PLACE_TIME, POLYNOMIAL, SETS, prior
from usvlearn.model.surge import WITH_EVEN, SurgeModel


def test_polynomials_move_the_boat_as_the_identified_model_does():
    theta, rows = boat(), mission()
    theta[len(POLYNOMIAL) :] = 0.0
    model = SurgeModel(MASS, {name: MASS * theta[AT[name]] for name in WITH_EVEN})
    expected = model.simulate(0.3, *(rows[1:, place] for place in (LEFT, RIGHT, YAW_RATE, DT)))
    np.testing.assert_allclose(simulated(rows, theta)[1:], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("terms", ["curves, even", "curves, thruster", "nine"])
def test_the_gradient_of_a_step_is_that_of_finite_differences(terms):
    """From a START the speed of a step depends on the parameters by the motion alone."""
    known, theta = prior(terms, TOP), boat()
    theta[np.setdiff1d(np.arange(len(NAMES)), known.active)] = 0.0
    if terms == "curves, thruster":
        theta[PLACE_TIME] = 0.3
    else:
        theta[PLACE_LAG] = 0.2 * (PLACE_LAG in known.active)
    rows, memory = mission(30, start=1.1), np.zeros((3, len(NAMES)))
    for k, (left, right) in ((5, (0.7, 0.3)), (11, (-0.4, 0.9))):
        left_before, right_before = rows[k - 1, LEFT] + 0.1, rows[k - 1, RIGHT] - 0.1

        def speed(at, k=k, left=left, right=right, before=(left_before, right_before)):
            some = [
                kernel.commanded(at, now, old, (old, 0.2), rows[k, DT])
                for now, old in zip((left, right), before, strict=True)
            ]
            return kernel.moved(
                at, TOP, 1.1, (some[0][0], some[1][0]), (some[0][1], some[1][1]), (some[0][2], some[1][2]),
                rows[k, DT], abs(rows[k, YAW_RATE]), memory[0], memory[1], memory[2],
            )[0]  # fmt: skip

        speed(theta)
        gradient, step = memory[2].copy(), 1e-6
        for place in known.active:
            if place == PLACE_TIME:  # the state's own derivative, 0.2 here, moves with it
                continue
            up, down = theta.copy(), theta.copy()
            up[place] += step
            down[place] -= step
            assert gradient[place] == pytest.approx((speed(up) - speed(down)) / (2 * step), rel=1e-5, abs=1e-8), NAMES[
                place
            ]


def test_a_thruster_of_a_time_constant_is_the_exact_mean_of_its_exponential():
    theta, h = np.zeros(len(NAMES)), 0.4
    theta[PLACE_TIME] = tau = 0.25
    xi, late, slow, (a, slope) = kernel.commanded(theta, 0.8, 0.1, (0.1, 0.0), h)
    times = np.linspace(0, h, 20001)
    course = 0.8 + (0.1 - 0.8) * np.exp(-times / tau)
    assert (
        late == 0 and a == pytest.approx(course[-1]) and xi == pytest.approx(np.trapezoid(course, times) / h, rel=1e-8)
    )
    theta[PLACE_TIME] = tau + 1e-6
    more = kernel.commanded(theta, 0.8, 0.1, (0.1, 0.0), h)
    assert slow == pytest.approx((more[0] - xi) / 1e-6, rel=1e-4)
    assert slope == pytest.approx((more[3][0] - a) / 1e-6, rel=1e-4)


@pytest.mark.parametrize("terms", [*SETS])
def test_a_motion_that_the_terms_can_make_is_found_again(terms):
    """Of every set, from measurements with noise of 2 cm/s, in a current that is not told."""
    known, truth = prior(terms, TOP), boat(3)
    truth[np.setdiff1d(np.arange(len(NAMES)), known.active)] = 0.0
    truth[PLACE_LAG], truth[PLACE_TIME] = 0.3 * (PLACE_LAG in known.active), 0.3 * (PLACE_TIME in known.active)
    rng, missions = np.random.default_rng(0), []
    for seed in range(4):
        rows = mission(3000, seed)
        speed, current = simulated(rows, truth, terms), 0.2 * rng.standard_normal(2)
        rows[1:, SURGE] = speed[1:] + rows[1:, COS] * current[0] + rows[1:, SIN] * current[1]
        rows[0, SURGE] = 0.3 + rows[1, COS] * current[0] + rows[1, SIN] * current[1]
        rows[1:, SURGE] += 0.02 * rng.standard_normal(len(rows) - 1)
        rows[1:, MODE] = LEARN
        rows[[700, 1500], MODE] = HOLD
        rows[2000, SURGE] = 7.0  # an outlier
        missions.append(rows)
    fit = Missions(missions, TOP).fit(terms)
    assert fit.deviation == pytest.approx(0.02, rel=0.05)
    found, expected = (quantities(theta, TOP, MASS) for theta in (fit.theta, truth))
    for name in ("steady_speed_full", "steady_speed_half", "drag_half_speed", "thrust_full_left", "time_constant"):
        assert found[name] == pytest.approx(expected[name], rel=0.03), name


def test_curves_are_those_of_their_nodes():
    theta = np.zeros(len(NAMES))
    theta[AT["thrust_node_left_ahead_0.5"]], theta[AT["thrust_node_left_astern_1"]] = 2.0, 3.0
    theta[AT["drag_node_0.4"]] = -1.0
    ahead = CurvedAhead(theta, TOP)
    np.testing.assert_allclose(
        ahead.thrust([0.5, 0.4375, 0.625, -1.0, 0.0], "left"), [2.0, 1.0, 0.0, -3.0, 0.0], atol=1e-12
    )
    assert not ahead.thrust([0.5, -1.0], "right").any()
    np.testing.assert_allclose(ahead.drag(TOP * np.array([0.4, 0.3, 0.6])), [1.0, 0.5, 0.0], atol=1e-12)


def test_a_fit_ends_at_the_same_place_wherever_it_starts():
    rows, theta = mission(3000), boat()
    rows[1:, SURGE] = simulated(rows, theta)[1:] + 0.02 * np.random.default_rng(0).standard_normal(3000)
    rows[1:, MODE] = LEARN
    missions = Missions([rows], TOP)
    found = missions.fit("cubic")
    for start in (theta, found.theta, 30 * theta, theta * np.nan):
        again = missions.fit("cubic", start)
        assert again.total == pytest.approx(found.total, abs=0.5)
        for name in ("steady_speed_full", "time_constant"):
            one, other = (quantities(each.theta, TOP, MASS)[name] for each in (again, found))
            assert one == pytest.approx(other, rel=5e-3), name
