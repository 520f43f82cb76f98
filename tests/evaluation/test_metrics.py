"""Scores by hand, and how the tables show them."""

import io

import numpy as np
import pytest
from rich.console import Console

from usvlearn import Inputs, Sample
from usvlearn.core.samples import Fleet, Run
from usvlearn.evaluation.comparison import short_keys
from usvlearn.evaluation.horizons import groups_of, horizon_scores, horizon_sums
from usvlearn.evaluation.metrics import fleet_scores, scores
from usvlearn.report.tables import averaged, rejection_table, score_table

SURGE = np.array([1.0, 2.0, np.nan, 4.0, np.nan])
PREDICTIONS = np.array([[1.5, 2.0], [2.0, 4.0], [9.0, 9.0], [3.0, 5.0], [np.nan, np.nan]])


def shown(table) -> str:
    console = Console(file=io.StringIO(), width=120, markup=False)
    console.print(table)
    return console.file.getvalue()


def test_scores_by_hand():
    table = scores(PREDICTIONS, SURGE, ["aid", "persistence"])
    fit = 100 * (1 - np.sqrt(1.25 / (3 * np.nanvar(SURGE))))
    assert table["aid"] == pytest.approx(
        {"mae": 0.5, "median": 0.5, "rmse": np.sqrt(1.25 / 3), "fit": fit, "skill": 1 - 0.5 / (4 / 3), "steps": 3,
         "diverged": 0}
    )  # fmt: skip
    assert table["persistence"]["skill"] == 0 and table["persistence"]["mae"] == pytest.approx(4 / 3)


@pytest.mark.parametrize("missing, known", [(1, True), (2, True), (3, False)])
def test_a_hundredth_of_the_steps_may_be_missing(missing, known):
    """And is told; more than that would let an estimator win by the steps that it made."""
    surge = np.linspace(0.0, 2.0, 200)
    ours = np.stack([surge + 0.5, surge + 1.0], -1)
    ours[40 : 40 + missing, 0] = np.nan
    table = scores(ours, surge, ["aid", "persistence"])
    row = table["aid"]
    assert (row["steps"], row["diverged"]) == (200 - missing, missing)
    assert (row["mae"], row["skill"]) == (pytest.approx((0.5, 0.5)) if known else (None, None))
    one, dt = np.ones((200, 1)), np.full((200, 1), 0.4)
    samples = Sample(Inputs(one, one, 0 * one, 0 * one, dt), surge[:, None], one > 0, one > 0)
    fleet = Fleet(("heron",), (Run(np.cumsum(dt, 0), samples, ("1",), (200,)),), {})
    arrays = {"forecasts": ours[:, None, [0, 1, 1]].reshape(200, 1, 3), "forecast_halfwidths": np.ones((200, 1, 1))}
    sums = horizon_sums(fleet, [(0, 0, arrays)], [0.4], ["aid", "persistence", "ensemble"])
    cell = horizon_scores(sums, fleet.boats)["heron"]["aid"]["0.4"]
    assert (cell["mae"], cell["steps"]) == (pytest.approx(0.5) if known else None, 200 - missing)


def test_forecasts_are_grouped_by_how_far_the_commands_moved():
    one, held = np.ones((4, 1)), np.array([[0.0], [0.1], [0.1], [0.9]])
    samples = Sample(Inputs(held, held, 0 * one, 0 * one, 0.4 * one), one, one > 0, one > 0)
    assert groups_of(samples, [0.4])[..., 0].ravel().tolist() == [0, 1, 0, 2]
    assert groups_of(samples, [0.8])[3].item() == 2


def test_keys_are_shortened_until_they_differ():
    keys = ["estimators.rnn.rate", "estimators.aid.rate", "align.dt"]
    assert short_keys(keys) == ["rnn.rate", "aid.rate", "dt"]


def test_fit_is_that_of_compare():
    """100 (1 − ‖y − ŷ‖ / ‖y − mean(y)‖), over the steps that count; worse than the mean speed is below 0."""
    rng = np.random.default_rng(3)
    y = rng.normal(1.0, 0.5, 200)
    predicted = np.stack([y + rng.normal(0, 0.1, 200), np.full(200, y[:150].mean()), -y], -1)
    known = np.where(np.arange(200) < 150, y, np.nan)
    table = scores(predicted, known, ["good", "mean", "bad"])
    norm = np.linalg.norm
    for k, name in enumerate(table):
        expected = 100 * (1 - norm(y[:150] - predicted[:150, k]) / norm(y[:150] - y[:150].mean()))
        assert table[name]["fit"] == pytest.approx(expected, abs=1e-9)
    assert 70 < table["good"]["fit"] < 90 and table["bad"]["fit"] < 0
    assert scores(np.ones((3, 1)), np.ones(3), ["still"])["still"]["fit"] is None
    assert scores(np.full((1, 1), np.nan), np.ones(1), ["diverged"])["diverged"]["fit"] is None


def test_a_fleets_scores_count_the_steps_that_an_ensemble_learns_from():
    """Not a speed that is no number, not measured, beyond the ensemble's limit, or the start of a segment."""
    surge = np.array([1.0, 2.0, 20.0, np.nan, 4.0, 3.0, 2.0])[:, None]
    left = np.array([0.5, 0.5, 0.5, 0.5, 0.5, np.inf, 0.5])[:, None]
    measured = np.array([0, 1, 1, 1, 0, 1, 1])[:, None] > 0
    dt, one = np.array([0.0, 0.4, 0.4, 0.4, 0.4, 0.4, 0.4])[:, None], np.ones((7, 1))
    samples = Sample(Inputs(left, 0 * one, 0 * one, 0 * one, dt), surge, one > 0, measured)
    fleet = Fleet(("heron",), (Run(np.cumsum(dt, 0), samples, ("1",), (7,)),), {})
    predictions = surge[..., None] + 0.5
    for limit, steps in ((10.0, 2), (50.0, 3)):
        row = fleet_scores(fleet, [(0, 0, {"predictions": predictions})], ["aid"], limit)["heron"]["aid"]
        assert (row["steps"], row["diverged"], row["mae"]) == (steps, 0, 0.5)
    stopped = fleet_scores(fleet, [(0, 0, {"predictions": predictions[:4]})], ["aid"], 10.0)["heron"]["aid"]
    assert stopped["steps"] == 1


INTERVALS = (  # predictions, measured, half-widths; coverage, half-width, MAE, steps
    ([1.5, 2.0], [1.0, 2.5], [0.5, 0.25], (0.5, 0.375, 0.5, 2)),  # an error as large as the interval is inside
    ([9.0, 1.5, 2.0], [1.0, 1.0, 2.5], [np.inf, 0.5, 0.25], (0.5, 0.375, 3.0, 3)),  # one that is infinite yet
    ([1.0], [1.0], [np.inf], (None, None, 0.0, 1)),
    ([1.0, np.nan], [1.0, 1.0], [1.0, 1.0], (1.0, 1.0, None, 1)),  # a step at which nobody has a prediction
)


@pytest.mark.parametrize(("made", "surge", "widths", "expected"), INTERVALS)
def test_intervals_and_steps_without_a_prediction(made, surge, widths, expected):
    row = scores(np.array(made)[:, None], np.array(surge), ["aid"], np.array(widths)[:, None])["aid"]
    assert tuple(row[name] for name in ("coverage", "halfwidth", "mae", "steps")) == expected


def test_diverged_predictions_are_counted_and_missing_persistence_is_told():
    predictions = np.array([[np.inf, 1.0], [np.nan, 2.0], [2.0, 4.0]])
    table = scores(predictions, np.array([1.0, 2.0, 4.0]), ["aid", "rls"])
    assert table["aid"]["diverged"] == 2 and table["aid"]["steps"] == 1 and table["rls"]["mae"] == 0
    assert table["aid"]["mae"] is None and table["rls"]["skill"] is None
    nothing = scores(np.full((2, 1), np.inf), np.ones(2), ["aid"])
    assert nothing["aid"]["mae"] is None and nothing["aid"]["diverged"] == 2


def test_tables_show_units_and_survive_gaps():
    rows = scores(PREDICTIONS, SURGE, ["aid", "persistence"])
    none = scores(np.full((2, 2), np.inf), np.ones(2), ["aid", "persistence"])
    text = shown(score_table({"heron": rows, "broken": none})) + shown(score_table({"": averaged([rows, none])}))
    (diverged,) = {line.split()[-1] for line in text.splitlines() if line.startswith("aid") and line.endswith(" 2")}
    assert diverged == "2" and "diverged" in text.splitlines()[2]
    assert "m/s" in text and "0.5000" in text and "0.625" in text and "–" in text
    assert rejection_table({"heron": {}}) is None
    assert "17" in shown(rejection_table({"heron": {"surge": {"stale": 17}}}))


def test_tables_are_in_the_order_of_the_errors_and_say_what_stands_in_them():
    """The best first, those without an error last; each boat's by its own errors, the fleet's by the mean."""
    boats = {
        "anna": {name: {"mae": mae, "steps": 9} for name, mae in (("map", 0.9), ("rnn", 0.2), ("persistence", 0.3))},
        "bert": {name: {"mae": mae, "steps": 9} for name, mae in (("map", 0.1), ("rnn", 0.4), ("persistence", None))},
    }
    remarks = {"map": "quasi-static map", "persistence": "baseline"}

    def order(table) -> list[str]:
        return [line.partition("  ")[0] for line in shown(table).splitlines()[4:] if "0." in line or "–" in line]

    both = ["rnn", "persistence, baseline", "map, quasi-static map"]
    assert order(score_table(boats, remarks)) == [*both, both[2], both[0], both[1]]
    table = shown(score_table({"": averaged(list(boats.values()))}, remarks))
    assert [each for line in table.splitlines() for each in both if line.startswith(each)] == [
        both[0],
        both[2],
        both[1],
    ]
