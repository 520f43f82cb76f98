"""Pieces of missions: one long log tells as much as many short ones; and speeds that are late."""

import numpy as np
import pytest

from tests.support.fitted_boats import TOP, log
from usvlearn.core.prepared_samples import HOLD, LEARN, MODE, START, SURGE
from usvlearn.model.fit.choice import _smallest
from usvlearn.model.fit.gauss_newton import Missions
from usvlearn.model.fit.intervals import spread
from usvlearn.model.fit.pieces import MOST, cut, late, moved


def test_a_long_log_is_cut_and_starts_anew_with_a_measured_speed():
    rows = log(9000)
    rows[4500, MODE] = 2  # not measured
    pieces = cut({"a": rows, "b": log(1000)}, TOP, 0.1)
    assert pieces.names == ["a"] * 6 + ["b"] and pieces.number == 2
    assert pieces.stretches.tolist() == [0, 0, 0, 0, 1, 1, 2]
    first = [each[0, MODE] for each in pieces.rows]
    assert sum(map(len, pieces.rows)) == 10002 and set(first) <= {START, HOLD} and first.count(HOLD) <= 1
    assert rows[1501, MODE] == LEARN  # the logs stay as they are
    assert len(cut({str(k): rows for k in range(100)}, TOP, 0.1).rows) <= 1.5 * MOST


def test_one_long_log_has_the_scatter_of_its_pieces():
    """Without pieces the interval of one log was that of an exact model."""
    rows = log(9000)
    wave = np.repeat(0.1 * np.random.default_rng(1).standard_normal(30), 300)
    rows[1:, SURGE] += wave  # errors that are alike for 30 s
    whole, pieces = Missions([rows], TOP), cut({"a": rows}, TOP, 0.1)
    few, many = (np.sqrt(np.diag(spread(each.fit("nine")))) for each in (whole, pieces))
    assert np.median(many / few) > 2


def test_the_smallest_set_within_one_standard_error_of_the_best_is_used():
    steps, rng = [1] * 9, np.random.default_rng(0)
    best = rng.standard_normal(9)
    noise = np.array([0.1, -0.1, 0.2, -0.2, 0.1, -0.1, 0.0, 0.1, -0.1])
    losses = {"nine": best + 0.5, "cubic": best + 0.02 + noise, "even": best + 0.01, "curves": best}
    assert _smallest(losses, steps) == "cubic"
    assert _smallest({name: losses[name] for name in ("nine", "even", "curves")}, steps) == "curves"


@pytest.mark.parametrize("steps", [0, 6])
def test_speeds_that_are_late_are_moved_back(steps):
    rows = log(3000)
    back, by = late(Missions([moved(rows, -steps)], TOP))
    assert abs(by - steps) <= 1
    np.testing.assert_array_equal(moved(moved(rows, -steps), steps)[10:2900], rows[10:2900])
    assert back.steps[0] > 2900
