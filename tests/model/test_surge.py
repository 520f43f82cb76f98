"""The model of an identified boat: its step is that of the joint EKF in torch, and its speeds settle."""

import numpy as np
import pytest
import torch

from tests.support.surge_models import by_torch, drawn, some
from usvlearn.errors import ConfigError
from usvlearn.model.surge import WITHOUT_EVEN, SurgeModel


@pytest.mark.parametrize("even", [False, True])
def test_a_step_is_that_of_the_joint_filter(even):
    rng = np.random.default_rng(1)
    rows = some(rng, 500)
    for _ in range(5):
        model = drawn(rng, even)
        found, expected = model.step(*rows.T), by_torch(model, torch.tensor(rows)).detach().numpy()
        inside = np.abs(expected) < 20  # the filter limits its speed there
        assert inside.mean() > 0.9
        np.testing.assert_allclose(found[inside], expected[inside], rtol=1e-12, atol=1e-12)


def test_a_simulation_is_a_chain_of_steps():
    rng = np.random.default_rng(2)
    model, rows = drawn(rng, True), some(rng, 50)
    speed, chain = 0.3, []
    for row in rows:
        speed = float(model.step(speed, *row[1:]))
        chain.append(speed)
    np.testing.assert_array_equal(model.simulate(0.3, *rows[:, 1:].T), chain)


def test_it_settles_at_the_steady_speed():
    drag = {"drag_quadratic": -1.5, "drag_linear": -12.0, "thrust_speed_left": -0.5}
    push = {"thrust_linear_left": 14.0, "thrust_quadratic_right": 18.0, "thrust_cubic_left": 3.0}
    model = SurgeModel(28.0, {**dict.fromkeys(WITHOUT_EVEN, 0.0), **drag, **push})
    for command in (0.25, 0.5, 1.0):
        speeds = model.simulate(0.0, command, command, 0.0, np.full(300, 0.4))
        assert speeds[-1] == pytest.approx(float(model.ahead.steady_speed(command)), rel=1e-9)


@pytest.mark.parametrize(
    ("mass", "changes", "words"),
    [
        (0.0, {}, "mass: found 0.0, expected a positive number of kg"),
        (float("nan"), {}, "mass: found nan"),
        (28.0, {"drag_linear": float("nan")}, "coefficients.drag_linear: found nan"),
        (28.0, {"drag": 1.0}, "coefficients: found drag_quadratic"),
    ],
)
def test_what_is_no_boat_is_refused(mass, changes, words):
    with pytest.raises(ConfigError, match=words):
        SurgeModel(mass, {**dict.fromkeys(WITHOUT_EVEN, 0.0), **changes})
