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


def test_thrust_that_follows_is_the_exact_mean_of_its_exponential():
    h, tau, step = 0.4, 0.25, 1e-6
    mean, _, slow, (a, _, slope) = kernel.followed(0.8, 0.0, (0.1, 0.0, 0.0), tau, h)
    times = np.linspace(0, h, 20001)
    course = 0.8 + (0.1 - 0.8) * np.exp(-times / tau)
    assert a == pytest.approx(course[-1]) and mean == pytest.approx(np.trapezoid(course, times) / h, rel=1e-8)
    more = kernel.followed(0.8, 0.0, (0.1, 0.0, 0.0), tau + step, h)
    assert slow == pytest.approx((more[0] - mean) / step, rel=1e-4)
    assert slope == pytest.approx((more[3][0] - a) / step, rel=1e-4)


@pytest.mark.parametrize("terms", ["curves, even", "nine"])
def test_the_gradient_is_that_of_finite_differences(terms):
    """Over some steps from a START with a known speed and current, so that the simulation is an open loop."""
    known, theta = prior(terms, TOP), boat()
    theta[np.setdiff1d(np.arange(len(NAMES)), known.active)] = 0.0
    theta[PLACE_TIME], theta[PLACE_LAG] = 0.3 * (PLACE_TIME in known.active), 0.2 * (PLACE_LAG in known.active)
    rows, m = mission(45, start=1.1), len(known.active)

    def loss(at, score):
        memory = np.empty(len(rows)), score, np.zeros((m, m)), np.zeros(4 * len(NAMES) + m + 3)
        arguments = known.active, TOP, 1e8, 1e-9, 4.0
        return kernel.mission(rows, at, *arguments, *memory, np.zeros((4, 3)), np.zeros((3, m)))[0]

    rows[1:, SURGE], rows[-1, MODE] = simulated(rows, theta, terms)[1:] + 1.0, LEARN
    gradient, step = np.zeros(m), 1e-5
    loss(theta, gradient)
    for k, place in enumerate(known.active):
        up, down = theta.copy(), theta.copy()
        up[place] += step
        down[place] -= step
        speeds = [simulated(rows, each, terms)[-1] for each in (up, down)]
        slope = (speeds[0] - speeds[1]) / (2 * step)
        assert -1e8 * gradient[k] == pytest.approx(slope, rel=1e-3, abs=1e-6), NAMES[place]


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
    fit = missions.fit("cubic")
    for start in (theta, fit.theta, 30 * theta, theta * np.nan):
        again = missions.fit("cubic", start)
        assert again.evidence == pytest.approx(fit.evidence, abs=0.5)
        for name in ("steady_speed_full", "time_constant"):
            one, other = (quantities(each.theta, TOP, MASS)[name] for each in (again, fit))
            assert one == pytest.approx(other, rel=5e-3), name
