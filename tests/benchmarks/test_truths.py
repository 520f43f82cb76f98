"""What identified models are compared with: the true quantities of simulated boats."""

import math

import pytest
import torch
from truths import Truths, errors, model_acceleration, truths, vessel_acceleration

from usvlearn.simulate.plants import heron, otter
from usvlearn.simulate.vessel import steady_surge


def test_a_boat_that_the_model_can_represent_is_found_exactly():
    """The Otter ahead is q = 0, T = m/l, and thrust quadratic in the command, but for the table's corners."""
    boat, one = otter(), torch.ones(2, dtype=torch.float64)
    top = float(steady_surge(boat, one))
    true = truths(vessel_acceleration(boat), top)
    full = float(boat.thrust_table[0, -1])
    parameters = {"drag_linear": -77.56, "thrust_quadratic_left": full, "thrust_quadratic_right": full}
    found = truths(model_acceleration(parameters, 85.5), top)
    assert true.steady_speed == pytest.approx(top, rel=1e-9)
    assert true.time_constant == pytest.approx(85.5 / 77.56, rel=1e-6)
    assert found == pytest.approx(true, rel=1e-3)  # the table is linear between its nodes


def test_errors_are_relative_to_the_truth():
    true = truths(vessel_acceleration(heron()), 2.741)
    assert true.drag == pytest.approx((16.45 * 1.3705 + 2.942 * 1.3705**2) / 28.0)
    assert true.time_constant == pytest.approx(28.0 / (16.45 + 2 * 2.942 * 1.3705), rel=1e-6)
    assert errors(Truths(*(1.1 * x for x in true)), true) == pytest.approx((0.1,) * 4)


def test_cubic_thrust_and_models_that_do_not_settle_count():
    cubic = model_acceleration({"drag_linear": -1.0, "thrust_cubic_left": 8.0})
    assert truths(cubic, 4.0).thrust == pytest.approx(1.0)
    runaway = truths(model_acceleration({"drag_linear": 0.1, "thrust_linear_left": 1.0}), 4.0)
    assert runaway.time_constant == math.inf and runaway.steady_speed == pytest.approx(12.0)
