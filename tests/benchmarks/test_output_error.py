"""The batch output-error fit: its derivatives, and boats that its model can represent."""

import numpy as np
import output_error as oe
import pytest
from scipy.integrate import solve_ivp

from usvlearn.core.samples import Inputs, Sample

STEPS = 1500


@pytest.fixture
def truth():
    """θ and μ per mass: drag, then thrust linear, quadratic, lost with speed on either side, cubic thrust, lag."""
    return np.array([-0.1, -0.4, -0.2, 0.3, 0.5, -0.02, 0.4, 0.3, -0.01, 0.1, -0.05, 0.2])


def run(seed):
    rng = np.random.default_rng(seed)
    held = np.repeat(rng.uniform(0, 1, (STEPS // 10, 4)), 10, axis=0)
    yes = np.ones(STEPS, bool)
    dt = np.where(np.arange(STEPS) == 0, 0.0, 0.4)
    heading = np.cumsum(held[:, 2] - 0.5)
    return Sample(Inputs(held[:, 0], held[:, 1], heading, held[:, 3] - 0.5, dt), np.zeros(STEPS), yes, yes)


def simulated(runs, theta, current):
    """The runs with the speeds of the model itself."""
    rows = oe.rows_of(runs, restart=False)
    rows[:, oe.SURGE_NOW] = 0.0
    speeds = np.empty(len(rows))
    oe.simulate(rows, theta, current, speeds, np.empty((0, 0)))
    return [one._replace(surge=part) for one, part in zip(runs, np.split(speeds, len(runs)), strict=True)]


@pytest.mark.thorough
def test_the_derivatives_are_those_of_the_step(truth):
    row = np.zeros(13)
    row[:5], row[oe.YAW] = (0.4, 0.7, 0.3, 0.2, 0.6), 0.2
    gradient, unused = np.zeros(oe.SHARED), np.zeros(oe.SHARED)
    for w in (1.3, -0.7):
        through = oe.step(w, truth, row, gradient)[1]
        for k, unit in enumerate(1e-6 * np.eye(oe.SHARED)):
            ahead, behind = (oe.step(w, truth + sign * unit, row, unused)[0] for sign in (1, -1))
            assert gradient[k] == pytest.approx((ahead - behind) / 2e-6, abs=1e-8)
        ahead, behind = (oe.step(w + e, truth, row, unused)[0] for e in (1e-6, -1e-6))
        assert through == pytest.approx((ahead - behind) / 2e-6, abs=1e-8)


def test_the_step_is_that_of_the_differential_equation(truth):
    """Second order: the error of a step falls eightfold where the step is halved."""
    truth[oe.LAG] = 0.0
    wrong = []
    for h in (0.2, 0.1, 0.05):
        row = np.zeros(13)
        row[:3], row[oe.YAW] = (h, 0.7, 0.3), 0.2

        def surge_dot(_, v):
            q, linear, cross, aL, bL, gL, aR, bR, gR, kL, kR = truth[: oe.TERMS]
            left = aL * 0.7 + bL * 0.49 + gL * 0.7 * abs(v) + kL * 0.343
            right = aR * 0.3 + bR * 0.09 + gR * 0.3 * abs(v) + kR * 0.027
            return q * abs(v) * v + linear * v + cross * 0.2 * v + left + right

        exact = solve_ivp(surge_dot, (0, h), [2.0], rtol=1e-12, atol=1e-14).y[0, -1]
        wrong.append(abs(oe.step(2.0, truth, row, np.zeros(oe.SHARED))[0] - exact))
    assert wrong[0] / wrong[1] == pytest.approx(8, rel=0.1) and wrong[1] / wrong[2] == pytest.approx(8, rel=0.1)


@pytest.mark.thorough
def test_a_boat_of_the_model_is_found_exactly(truth):
    flow = np.array([[0.2, -0.1], [0.0, 0.15], [-0.1, 0.0]])
    runs = simulated([run(seed) for seed in range(3)], truth, flow)
    found = oe.fit(runs, top=2.0)
    np.testing.assert_allclose([*found.parameters.values(), found.lag], truth, atol=5e-3)
    np.testing.assert_allclose(found.current, flow, atol=2e-3)  # its prior draws it a little to 0
    nine = oe.fit(runs, top=2.0, cubic=False)
    assert nine.parameters["thrust_cubic_left"] == 0 and nine.residual > 10 * found.residual
    assert oe.fit(runs, top=2.0, current=False).residual > 10 * found.residual
    assert oe.fit(runs, top=2.0, lag=False).lag == 0


def test_free_runs_use_only_the_speeds_with_which_segments_start(truth):
    one = simulated([run(0)], truth, np.zeros((1, 2)))[0]
    found = oe.Fit(dict(zip(oe.NAMES, truth[: oe.TERMS], strict=True)), truth[oe.LAG], np.zeros((1, 2)), 0.0)
    blind = one._replace(surge=np.where(np.arange(STEPS) == 0, one.surge, np.nan), measured=one.measured & False)
    np.testing.assert_allclose(oe.free_runs(found, [blind])[0], one.surge, atol=1e-12)


def test_a_gap_starts_a_segment_of_the_fit_but_not_of_a_free_run():
    gap = run(0)
    gap.fresh[100:120] = False
    starts = [int(oe.rows_of([gap], restart)[:, oe.STARTS].sum()) for restart in (True, False)]
    assert starts == [2, 1]
