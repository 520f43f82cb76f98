"""Diagnostics of a fit: numbers by hand, the worst minute, bands that are the intervals', and JSON without NaN."""

import json

import numpy as np
import pytest

from tests.support.fitted_boats import MASS, TOP, mission
from tests.support.saved_fits import missions
from usvlearn.core.prepared_samples import HOLD, LEARN, LEFT, MODE, PREDICT, RIGHT, START, SURGE
from usvlearn.evaluation.metrics import worst_minute
from usvlearn.model.fit.choice import Score
from usvlearn.model.fit.diagnostics import SHOWN, diagnostics
from usvlearn.model.fit.gauss_newton import Missions
from usvlearn.model.fit.intervals import intervals


def array(x) -> np.ndarray:
    return np.array(x, float)


def test_a_mission_in_numbers():
    sailed, fit = missions(2)
    numbers = diagnostics(Missions(sailed.rows, TOP, ["a", "b"]), fit, MASS)
    for row, rows, (speed, current) in zip(numbers["missions"], sailed.rows, sailed.simulate(fit), strict=True):
        error, measured = (speed - rows[:, SURGE])[1:], rows[1:, SURGE]
        assert row["steps"] == 2000 and row["minutes"] == pytest.approx(2000 * 0.2 / 60, rel=0.01)
        assert row["mae"] == pytest.approx(np.abs(error).mean(), rel=1e-4) == pytest.approx(0.04, rel=0.05)
        assert row["bias"] == pytest.approx(error.mean(), abs=1e-6)
        assert row["fit"] == pytest.approx(
            100 * (1 - np.linalg.norm(error) / np.linalg.norm(measured - measured.mean())), rel=1e-4
        )
        np.testing.assert_allclose(row["current"], current, rtol=1e-4)
    assert [row["name"] for row in numbers["missions"]] == ["a", "b"]


def test_errors_of_the_boat_that_made_the_data_are_white_and_those_of_another_are_not():
    sailed, fit = missions()
    numbers = diagnostics(sailed, fit, MASS)
    wrong = fit.theta.copy()
    wrong[fit.known.active] *= 1.4
    other = diagnostics(sailed, sailed.evaluate(fit.terms, wrong, fit.deviation), MASS)

    def beyond(some) -> float:
        return float(np.nanmean(np.abs(array(some["values"])) > array(some["bounds"])))

    parts = [[each["autocorrelation"], each["cross_correlation"]["mean"]] for each in (numbers, other)]
    assert max(map(beyond, parts[0])) < 0.05 and min(map(beyond, parts[1])) > 0.05


def test_the_worst_minute_is_found_and_shown_with_what_is_around_it():
    sailed, fit = missions(SHOWN + 2)
    sailed.rows[2][1001:1301, SURGE] += 0.3  # a minute from 200 s on
    numbers = diagnostics(sailed, fit, MASS)
    assert numbers["missions"][2]["worst"]["start"] == pytest.approx(200, abs=3)
    assert len(numbers["worst"]) == SHOWN
    course = numbers["worst"][0]
    time, error = array(course["time"]), array(course["simulated"]) - array(course["measured"])
    assert course["name"] == "3" and time[0] == pytest.approx(170, abs=4) and time[-1] == pytest.approx(290, abs=4)
    inside = (time > 204) & (time < 256)
    assert error[inside].mean() < -0.1 and abs(np.nanmean(error[time < 195])) < 0.1  # a current takes in a part
    places = np.round(time / 0.2).astype(int)
    np.testing.assert_allclose(array(course["left"]), sailed.rows[2][places, LEFT], atol=0.2)


def test_a_minute_with_few_measurements_is_not_the_worst():
    time, error = 0.1 * np.arange(3000), np.full(3000, 0.1)
    error[1000:2000] = np.nan
    error[1500] = 9.0  # alone in a gap
    error[2100:2700] = 0.2
    assert worst_minute(time, error) == (2100, 2700)
    assert worst_minute(time, np.full(3000, np.nan)) is None
    assert worst_minute(time[:300], error[:300]) == (0, 300)  # shorter than a minute
    slow = np.full(3000, np.nan)
    slow[::10] = np.where(np.arange(300) >= 200, 1.0, 0.1)  # measured once a second
    assert abs(worst_minute(time, slow)[0] - 2000) <= 400


def test_bands_are_the_intervals_of_the_quantities():
    sailed, fit = missions()
    curves = diagnostics(sailed, fit, MASS)["curves"]
    known = intervals({"cubic": fit}, {"cubic": Score(np.zeros(3), 0.0, 0.0)}, "cubic", MASS)
    for side in ("left", "right"):
        curve = curves[f"thrust_{side}"]
        assert curve["at"][-1] == 1.0
        ends = [curve[key][-1] for key in ("value", "low", "high")]
        assert ends == pytest.approx(known[f"thrust_full_{side}"][:3], rel=1e-3)
    assert curves["drag"]["value"][0] == 0 == curves["drag"]["high"][0]


def test_another_fit_widens_the_band():
    sailed, fit = missions()
    theta = fit.theta.copy()
    theta[fit.known.active] *= 1.5
    other = sailed.evaluate(fit.terms, theta, fit.deviation)
    alone, beside = (diagnostics(sailed, fit, MASS, others)["curves"]["drag"] for others in ((), (other,)))
    assert beside["value"] == alone["value"] and (array(beside["high"])[1:] > array(alone["high"])[1:]).all()


def test_seconds_are_those_in_which_the_boat_sailed():
    sailed, fit = missions(2)
    for rows in sailed.rows:
        rows[:, LEFT] = np.abs(rows[:, LEFT])
    numbers = diagnostics(sailed, fit, MASS)
    minutes = sum(row["minutes"] for row in numbers["missions"])
    for each in numbers["sailed"].values():
        assert len(each["edges"]) == len(each["seconds"]) + 1
        assert sum(each["seconds"]) == pytest.approx(60 * minutes, rel=1e-3)
    left = numbers["sailed"]["left"]
    assert not any(s for edge, s in zip(left["edges"], left["seconds"], strict=False) if edge < -0.01)
    assert numbers["sailed"]["speed"]["edges"][-1] == numbers["curves"]["drag"]["at"][-1]


def hold(rows: np.ndarray) -> None:
    rows[150:200, MODE] = HOLD
    rows[200, MODE], rows[200, SURGE] = START, 1.0


def same(rows: np.ndarray) -> None:
    rows[:, RIGHT] = rows[:, LEFT]


def unmeasured(rows: np.ndarray) -> None:
    rows[rows[:, MODE] == LEARN, MODE] = PREDICT


def still(rows: np.ndarray) -> None:
    rows[:, [LEFT, RIGHT, SURGE]] = 0.0


def constant(rows: np.ndarray) -> None:
    rows[:, SURGE] = 1.0


@pytest.mark.parametrize("change", [hold, same, unmeasured, still, constant])
@pytest.mark.parametrize("steps", [300, 2000])
def test_logs_of_all_kinds_are_json(change, steps):
    _, fit = missions(1)
    rows = mission(steps)
    rows[1:, MODE], rows[1:, SURGE] = LEARN, 1 + 0.1 * np.random.default_rng(0).standard_normal(steps)
    change(rows)
    numbers = diagnostics(Missions([rows], TOP), fit, MASS)
    json.dumps(numbers, allow_nan=False)
    (row,) = numbers["missions"]
    assert (row["mae"] is None) == (change in (unmeasured, still)) and (row["fit"] is None) == (
        change in (unmeasured, still, constant)
    )
    if change is same:
        assert set(numbers["cross_correlation"]["difference"]["values"]) == {None}


def test_what_is_saved_is_small():
    sailed, fit = missions(SHOWN)
    assert len(json.dumps(diagnostics(sailed, fit, MASS))) < 110_000  # six courses are most of it
