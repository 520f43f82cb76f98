"""The model of an identified boat: its step is that of the joint EKF in torch, or of a fit, and its speeds settle."""

import itertools

import numpy as np
import pytest
import torch

from tests.support.fitted_boats import MASS, TOP, boat
from tests.support.surge_models import by_filter, drawn, some
from usvlearn.errors import ConfigError
from usvlearn.model.fit.quantities import CurvedAhead
from usvlearn.model.fit.terms import AT, NAMES
from usvlearn.model.surge import TABLE_COMMANDS, WITHOUT_EVEN, SurgeModel

MODEL = SurgeModel.fitted(boat(), TOP, MASS)  # with tables


@pytest.mark.parametrize("even", [False, True])
def test_a_step_is_that_of_the_joint_filter(even):
    rng = np.random.default_rng(1)
    rows = some(rng, 500)
    for _ in range(5):
        model = drawn(rng, even)
        found, expected = model.step(*rows.T), by_filter(model, torch.tensor(rows)).detach().numpy()
        inside = np.abs(expected) < 20  # the filter limits its speed there
        assert inside.mean() > 0.9
        np.testing.assert_allclose(found[inside], expected[inside], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("tables", [False, True])
def test_a_simulation_is_a_chain_of_steps(tables):
    rng = np.random.default_rng(2)
    model, rows = MODEL if tables else drawn(rng, True), some(rng, 50)
    speed, chain = 0.3, []
    for row in rows:
        speed = float(model.step(speed, *row[1:]))
        chain.append(speed)
    np.testing.assert_array_equal(model.simulate(0.3, *rows[:, 1:].T), chain)


def test_it_settles_at_the_steady_speed():
    drag = {"drag_quadratic": -1.5, "drag_linear": -12.0, "thrust_speed_left": -0.5}
    push = {"thrust_linear_left": 14.0, "thrust_quadratic_right": 18.0, "thrust_cubic_left": 3.0}
    model = SurgeModel(28.0, {**dict.fromkeys(WITHOUT_EVEN, 0.0), **drag, **push})
    for each, command in itertools.product((model, MODEL), (0.25, 0.5, 1.0)):
        speeds = each.simulate(0.0, command, command, 0.0, np.full(300, 0.4))
        assert speeds[-1] == pytest.approx(float(each.ahead.steady_speed(command)), rel=1e-9)


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


def plain(v, left, right, turn, h):
    """Equation (1) and (2) of `usvlearn.model.surge`, one step, with numpy's own interpolation."""
    p, tables = MODEL.coefficients, MODEL.tables
    f = (
        p["drag_quadratic"] * v * abs(v)
        + p["drag_linear"] * v
        + p["drag_cross"] * abs(turn) * v
        + p["drag_even"] * v**2
    )
    J = 2 * p["drag_quadratic"] * abs(v) + p["drag_linear"] + p["drag_cross"] * abs(turn) + 2 * p["drag_even"] * v
    for side, x in (("left", left), ("right", right)):
        f += p[f"thrust_linear_{side}"] * x + p[f"thrust_quadratic_{side}"] * x * abs(x)
        f += p[f"thrust_speed_{side}"] * x * abs(v) + p[f"thrust_cubic_{side}"] * x**3
        f += p[f"thrust_even_linear_{side}"] * abs(x) + p[f"thrust_even_quadratic_{side}"] * x**2
        f += p[f"thrust_even_speed_{side}"] * x * v + np.interp(x, TABLE_COMMANDS, tables.thrust[side])
        J += p[f"thrust_speed_{side}"] * x * np.sign(v) + p[f"thrust_even_speed_{side}"] * x
    speeds, drag = np.append(0, tables.speeds), np.append(0, tables.drag)
    f += np.sign(v) * np.interp(abs(v), speeds, drag)
    k = min(int(abs(v) // speeds[1]), len(speeds) - 2)
    J += (drag[k + 1] - drag[k]) / speeds[1]
    z = h * J / MASS
    return v + h * np.expm1(z) / z * f / MASS


def test_the_step_is_the_plain_equation():
    rng = np.random.default_rng(0)
    rows = np.stack([rng.uniform(-2.9, 2.9, 500), *rng.uniform(-1, 1, (2, 500)), rng.normal(0, 0.3, 500),
                     rng.uniform(0.01, 8.0, 500)], -1)  # fmt: skip
    np.testing.assert_allclose(MODEL.step(*rows.T), [plain(*row) for row in rows], rtol=1e-12, atol=1e-12)


def test_parameters_and_tables_are_the_same():
    theta = boat()
    ahead = CurvedAhead(theta, TOP)
    f, _ = ahead.motion(np.array([0.4, 1.7]), np.array([0.3, 0.9]))
    v = np.array([0.4, 1.7])
    np.testing.assert_allclose((MODEL.step(v, [0.3, 0.9], [0.3, 0.9], 0.0, 1e-7) - v) / 1e-7, f, rtol=1e-5)
    astern = np.zeros(len(NAMES))
    astern[AT["thrust_node_left_astern_1"]] = 3.0
    assert SurgeModel.fitted(astern, TOP, 2.0).tables.thrust["left"][0] == -6.0
