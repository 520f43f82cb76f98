"""Quantities of a boat from its parameters, against closed forms, solvers and a simulated boat."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.support.known_boats import MASS, THETA_ODD
from usvlearn.estimators.joint.quantities import COAST, QUANTITIES, Ahead, gradients, quantities, sums
from usvlearn.estimators.joint.state import names
from usvlearn.simulate.truth import true_parameters, true_quantities


def acceleration(v: float, left: float, right: float) -> float:
    quadratic, linear, _, *sides, left_cubic, right_cubic, _ = THETA_ODD
    push = sum(
        a * x + b * x * abs(x) + c * x * abs(v) + k * x**3
        for x, (a, b, c), k in zip((left, right), (sides[:3], sides[3:]), (left_cubic, right_cubic), strict=True)
    )
    return quadratic * abs(v) * v + linear * v + push


FOUND = {name: float(x) for name, x in quantities(THETA_ODD, MASS, np.zeros(12)).items()}


def test_steady_speeds_balance_drag_and_thrust():
    for name, command in {"full": 1.0, "half": 0.5, "quarter": 0.25}.items():
        assert acceleration(FOUND[f"steady_speed_{name}"], command, command) == pytest.approx(0, abs=1e-12)


def test_time_constant_is_that_of_a_small_departure():
    v, h = FOUND["steady_speed_full"] / 2, 1e-6
    slope = (acceleration(v + h, 0.5, 0.5) - acceleration(v - h, 0.5, 0.5)) / (2 * h)
    assert FOUND["time_constant"] == pytest.approx(-1 / slope, rel=1e-6)


def test_stopping_distance_is_that_of_a_boat_that_coasts():
    top = FOUND["steady_speed_full"]

    def rest(t, y):
        return y[1] - COAST * top

    rest.terminal = True
    done = solve_ivp(
        lambda t, y: [y[1], acceleration(y[1], 0.0, 0.0)], (0, 1000), [0.0, top], events=rest, rtol=1e-10, atol=1e-12
    )
    assert FOUND["stopping_distance"] == pytest.approx(done.y[0, -1], rel=1e-7)


def test_stopping_distance_of_linear_drag_alone():
    theta = np.array([0.0, -0.5, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    values = quantities(theta, 1.0, np.zeros(12))
    assert values["stopping_distance"] == pytest.approx((1 - COAST) * values["steady_speed_full"] / 0.5, rel=1e-6)


def test_thrust_of_two_terms_is_the_best_fit_of_three():
    xi = (np.arange(100_000) + 0.5) / 100_000
    curve = Ahead(THETA_ODD).thrust(xi, "left")
    assert curve == pytest.approx(THETA_ODD[3] * xi + THETA_ODD[4] * xi**2 + THETA_ODD[9] * xi**3)
    alpha, beta = np.linalg.lstsq(np.stack([xi, xi**2], -1), curve, rcond=None)[0]
    assert FOUND["thrust_linear_left"] == pytest.approx(MASS * alpha, rel=1e-6)
    assert FOUND["thrust_quadratic_left"] == pytest.approx(MASS * beta, rel=1e-6)


def test_drag_that_falls_with_speed_has_the_slower_steady_speed_or_none():
    theta = np.array([0.1, -1.0, 0.0, 0.8, 0.0, 0.0, 0.8, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert Ahead(theta).steady_speed(1.0) == pytest.approx(2.0)  # 0.1 v² − v + 1.6 = 0 has the roots 2 and 8
    assert np.isnan(Ahead(theta * [4, 1, *[1] * 10]).steady_speed(1.0))  # no real root
    assert np.isnan(Ahead(theta * [1, -1, *[1] * 10]).steady_speed(1.0))  # both roots astern
    values = quantities(theta, 1.0, np.zeros(12))
    v = np.linspace(2.0 * COAST, 2.0, 100_001)
    assert values["stopping_distance"] == pytest.approx(np.trapezoid(1 / (1.0 - 0.1 * v), v), rel=1e-6)


def test_even_terms_add_ahead():
    theta = dict.fromkeys(names(even=True), 0.0) | {"drag_quadratic": -0.3, "drag_even": 0.1, "thrust_linear_left": 1.0}
    theta |= {"thrust_even_linear_left": 0.2, "thrust_even_quadratic_left": 0.3}
    boat = Ahead(np.array(list(theta.values())))
    assert boat.drag(2.0) == pytest.approx(0.8) and boat.thrust(1.0, "left") == pytest.approx(1.5)


def test_quantities_agree_with_a_simulated_boat_of_the_same_equations():
    """The WAM-V's thrust is linear and its drag has two terms, so nothing is fitted."""
    season = {"n": 1, "plant": "wamv", "hours": 0.5, "mission_minutes": 15.0, "seed": 3}
    known = true_parameters(180.0, **season)
    truth = true_quantities(180.0, known, **season)["wamv"]
    theta = np.array([known["wamv"][name][-1] for name in sums(False) if name in known["wamv"]] + [0.0] * 3) / 180.0
    values = quantities(theta, 180.0, np.zeros(12))
    for name, value in truth.items():
        assert values[name] == pytest.approx(value, rel=2e-4, abs=1e-3), name
    assert set(truth) == set(QUANTITIES) - {"mass"}


def test_gradients_of_sums_are_their_coefficients():
    _, slopes = gradients(lambda each: quantities(each, MASS, np.zeros(12)), THETA_ODD, np.full(12, 1e-4))
    for name, row in sums(False).items():
        assert slopes[name] == pytest.approx(MASS * row, abs=1e-8)
