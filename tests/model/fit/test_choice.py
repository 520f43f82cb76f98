"""Which terms are used: those that do best on missions that were left out, and what one step leaves out of them."""

import json

import numpy as np
import pytest

from tests.support.fitted_boats import MASS, TOP, boat, mission, simulated
from usvlearn.core.prepared_samples import LEARN, MODE, SURGE
from usvlearn.model.fit import choice
from usvlearn.model.fit.choice import FEWEST, choose, left_out
from usvlearn.model.fit.fitted import fit_boat
from usvlearn.model.fit.gauss_newton import Missions, scored
from usvlearn.model.fit.intervals import intervals, spread
from usvlearn.model.fit.quantities import quantities
from usvlearn.model.fit.terms import NAMES, PLACE_LAG, PLACE_TIME, prior


def missions(terms: str, count: int, noise: float = 0.05) -> tuple[Missions, np.ndarray]:
    """Missions of a boat that a set of terms describes exactly, and its parameters."""
    theta, known, rng = boat(5), prior(terms, TOP), np.random.default_rng(1)
    theta[np.setdiff1d(np.arange(len(NAMES)), known.active)] = 0.0
    theta[PLACE_LAG], theta[PLACE_TIME] = 0.2 * (PLACE_LAG in known.active), 0.2 * (PLACE_TIME in known.active)
    all_rows = []
    for seed in range(count):
        rows = mission(2000, seed)
        rows[1:, SURGE] = simulated(rows, theta, terms)[1:] + noise * rng.standard_normal(len(rows) - 1)
        rows[1:, MODE] = LEARN
        all_rows.append(rows)
    return Missions(all_rows, TOP), theta


@pytest.mark.parametrize("terms", ["nine", "thrust curves"])
@pytest.mark.parametrize("count", [1, 8])
def test_the_terms_that_made_the_data_are_used(terms, count):
    sailed, _ = missions(terms, count, 0.01)
    fits = {name: sailed.fit(name) for name in ("nine", "cubic", "thrust curves")}
    chosen, scores = choose(sailed, fits)
    assert chosen == terms
    assert scores[terms].gain == 0 if count > 1 else np.isnan(scores[terms].gain)
    assert np.isfinite(scores["cubic"].error) == (count >= FEWEST)


@pytest.mark.parametrize("few, tolerance", [(0, 2e-3), (10, 5e-4)])
def test_a_mission_is_left_out_as_by_a_fit_without_it(few, tolerance, monkeypatch):
    """By one step, and where there are few by more."""
    monkeypatch.setattr(choice, "FEW", few)
    sailed, _ = missions("cubic", 5)
    fit = sailed.fit("cubic")
    quick = left_out(sailed, fit, fit.deviation)
    for k in range(5):
        others = Missions([rows for j, rows in enumerate(sailed.rows) if j != k], TOP).fit("cubic")
        assert quick[k] == pytest.approx(sailed.loss(others.theta, fit.deviation, k) / sailed.steps[k], abs=tolerance)


def test_a_boat_at_rest_counts_nowhere_and_absurd_parameters_end_in_an_infinite_loss():
    sailed, _ = missions("nine", 1)
    still = mission(500)
    still[1:, MODE] = LEARN
    still[:, :SURGE] *= 0
    still[:, SURGE] = 0.0
    assert not scored(still).any() and Missions([still], TOP).steps == [0]
    theta = sailed.fit("nine").theta * np.nan
    assert sailed.evaluate("nine", theta, 0.1).loss[0] == np.inf


def test_intervals_hold_and_shrink_with_the_missions():
    widths = []
    for count in (4, 16):
        sailed, theta = missions("cubic", count)
        fits = {"cubic": sailed.fit("cubic")}
        chosen, scores = choose(sailed, fits)
        known, truth = intervals(fits, scores, chosen, MASS), quantities(theta, TOP, MASS)
        inside = [known[name].low <= truth[name] <= known[name].high for name in truth]
        assert np.mean(inside) >= 0.8
        widths.append(np.sqrt(np.diag(spread(fits["cubic"]))))
    assert np.median(widths[1] / widths[0]) < 0.7  # a half, by the square root of four times the missions


def test_what_is_compared_is_the_set_that_is_used():
    sailed, _ = missions("cubic", 4)
    fits = {name: sailed.fit(name) for name in ("nine", "cubic")}
    chosen, scores = choose(sailed, fits, "nine")
    assert chosen == "nine" and scores["nine"].gain == 0 < scores["cubic"].gain


@pytest.mark.parametrize("count", [1, 2])
def test_a_fit_is_saved_as_json_without_nan(count):
    sailed, _ = missions("nine", count)
    short = {name: rows[:800] for name, rows in zip(sailed.names, sailed.rows, strict=True)}  # not cut
    facts = fit_boat("a", short, MASS, TOP, "nine").json()
    json.dumps(facts, allow_nan=False)
    assert facts["terms"] == "nine" and all(each["error"] is None for each in facts["sets"].values())
    assert all(np.isfinite(value) for value in facts["parameters"].values())
