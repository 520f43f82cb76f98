"""The step of a model with tables is the plain equation, and equals the curves of the fit."""

import numpy as np

from tests.support.fitted_boats import MASS, TOP, boat
from usvlearn.model.fit.quantities import CurvedAhead
from usvlearn.model.fit.terms import AT, NAMES
from usvlearn.model.surge import TABLE_COMMANDS, SurgeModel

MODEL = SurgeModel.fitted(boat(), TOP, MASS)


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
    np.testing.assert_allclose(MODEL.theta, theta, rtol=1e-12, atol=1e-15)
    ahead = CurvedAhead(theta, TOP)
    f, _ = ahead.motion(np.array([0.4, 1.7]), np.array([0.3, 0.9]))
    v = np.array([0.4, 1.7])
    np.testing.assert_allclose((MODEL.step(v, [0.3, 0.9], [0.3, 0.9], 0.0, 1e-7) - v) / 1e-7, f, rtol=1e-5)
    astern = np.zeros(len(NAMES))
    astern[AT["thrust_node_left_astern_1"]] = 3.0
    assert SurgeModel.fitted(astern, TOP, 2.0).tables.thrust["left"][0] == -6.0
