"""The fit of turning against finite differences, and against a boat that its own equations move."""

import numpy as np
import pytest

from tests.support.fitted_boats import MASS, TOP
from tests.support.turning_boat import TRUE, sailed
from usvlearn.core.prepared_samples import HOLD, MODE, ROW, YAW_RATE
from usvlearn.estimators.axis.turning_intervals import HARDLY
from usvlearn.estimators.axis.turning_quantities import QUANTITIES
from usvlearn.model.fit import turning_kernel as at
from usvlearn.model.fit.boat import FittedBoat
from usvlearn.model.fit.choice import Score
from usvlearn.model.fit.fitted import fit_boat
from usvlearn.model.fit.gauss_newton import Missions
from usvlearn.model.fit.logs import turns
from usvlearn.model.fit.turning import MEAN, evaluate, first_fit, fitted, natural, prepared, with_turning


def test_the_gradient_is_that_of_finite_differences():
    """With headings that are missing or wrong, a gyro, a gap, and any parameters."""
    rows, theta = prepared(sailed(steps=400, gyro=True), TOP), MEAN + 0.23
    rows[50:70, at.HEADING], rows[100, at.HEADING], rows[200, MODE], rows[::3, at.RATE] = np.nan, 2.0, HOLD, np.nan
    fit, step = evaluate(theta, [rows[:150], rows[150:]]), 1e-5
    for j in range(at.PARAMETERS):
        up, down = (
            evaluate(theta + step * sign * np.eye(at.PARAMETERS)[j], [rows[:150], rows[150:]]) for sign in (1, -1)
        )
        expected = (up.loss - down.loss) / (2 * step)
        np.testing.assert_allclose(fit.score[:, j], expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max() + 1e-4)
    assert np.isfinite(fit.loss).all() and np.allclose(fit.information, fit.information.transpose(0, 2, 1))


@pytest.mark.parametrize("gyro", [False, True])
def test_the_parameters_of_a_boat_are_found_again(gyro):
    p = natural(fitted([prepared(sailed(seed, gyro=gyro), TOP) for seed in range(2)]).theta)
    for place, allowed in {at.D1: 0.2, at.LATE: 0.3, at.DEAD: 0.15, at.ASTERN: 0.05, at.SIDE: 0.02}.items():
        assert p[place] == pytest.approx(TRUE[place], rel=allowed), place
    assert p[at.D0] == pytest.approx(TRUE[at.D0], rel=0.12)
    assert p[at.K1] + p[at.K2] == pytest.approx(1.2, rel=0.05)
    assert np.sqrt(p[at.COMPASS]) == pytest.approx(0.01, rel=0.1)
    assert not gyro or np.sqrt(p[at.GYRO]) == pytest.approx(0.005, rel=0.2)


def test_where_there_is_no_gyro_the_surge_gets_the_yaw_rate_of_all_headings():
    rows, true = sailed(), sailed(gyro=True)[:, at.RATE]
    filled, _ = first_fit({"a": rows}, TOP)
    error = np.abs(filled["a"][1:, YAW_RATE] - true[1:])
    assert np.median(error) < 0.01 < 0.3 * np.median(np.abs(rows[1:, YAW_RATE] - true[1:]))
    rows[:, at.RATE] = true
    np.testing.assert_array_equal(first_fit({"a": rows}, TOP)[0]["a"], rows)
    assert first_fit({"a": rows[:, :ROW]}, TOP)[1] is None


def surge_of(rows: np.ndarray) -> FittedBoat:
    missions = Missions([rows], TOP)
    scores = {"cubic": Score(np.zeros(1), 0.0, 0.0)}
    return FittedBoat.of(missions, {"cubic": missions.fit("cubic")}, scores, "cubic", MASS, ())


def test_quantities_have_intervals_that_hold_and_a_checkpoint_has_them():
    rows = sailed(1)
    boat = with_turning(surge_of(rows), fitted([prepared(rows, TOP)]), [prepared(rows, TOP)])
    rest, full = boat["yaw_time_constant_rest"], boat["yaw_rate_full"]
    assert rest.low < 1 / TRUE[at.D0] < rest.high and rest.high < 2 * rest.low
    assert 0 < full.low < full.value < full.high < 1.3 * full.low and full.unit == "rad/s"
    again = FittedBoat.read(boat.facts())
    assert again.json() == boat.json() and set(QUANTITIES) <= set(again)
    assert again.turning.explained > 0.9
    for x, y in zip(again.turning, boat.turning, strict=True):
        np.testing.assert_array_equal(x, y)


def test_a_boat_that_hardly_turns_is_told_so():
    rows = sailed(apart=0.0)
    boat = with_turning(surge_of(rows), fitted([prepared(rows, TOP)]))
    assert HARDLY in boat.lacks and all(np.isnan(boat.displayed(name).value) for name in QUANTITIES)


def test_repeated_headings_and_slopes_of_headings_are_no_measurements():
    time, heading = 0.1 * np.arange(5), np.array([6.2, 6.2, 0.1, 0.1, 0.3])
    slope = np.array([np.nan, 0.0, (0.1 - 6.2 + 2 * np.pi) / 0.1, 0.0, 2.0])
    assert np.isnan(turns(np.column_stack([heading, slope]), time)).tolist() == [
        [False, True], [True, True], [False, True], [True, True], [False, True]
    ]  # fmt: skip
    assert np.isfinite(turns(np.column_stack([heading, slope + 0.1]), time)[1:, 1]).all()


@pytest.mark.thorough
def test_the_fit_of_a_boat_has_quantities_of_turning_where_its_missions_have_headings():
    rows = sailed(2)
    values = fit_boat("a", {"1": rows}, MASS, TOP, "nine").quantities
    assert np.isfinite(values["turning_radius_half"].value)
    assert not set(QUANTITIES) & set(fit_boat("a", {"1": rows[:, :ROW]}, MASS, TOP, "nine").quantities)
