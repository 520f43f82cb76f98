"""A plan of 5 min tells more than a lawn-mower mission of 10 min, on a boat whose truth is known."""

import math

import pytest
from plan import MAIN, MINUTES, NOTED, Pair, pairs, ratio, width

from usvlearn.model.planning.exchange import derived


@pytest.fixture(scope="module")
def pair() -> Pair:
    return next(pairs(5, ["heron"]))


@pytest.mark.slow
def test_the_plan_reaches_the_intervals_of_a_lawn_mower_in_half_of_its_time(pair):
    after = pair.plan[round(60 * MINUTES / NOTED) - 1]
    names = derived(after)
    assert sum(math.log(width(after, name) / width(pair.mower[-1], name)) for name in names) < 0
    assert sum(ratio(pair, name, pair.plan) <= 0.5 for name in names) > 0.7 * len(names)


@pytest.mark.slow
def test_the_intervals_of_the_plan_hold_the_truth(pair):
    after = pair.plan[-1]
    assert sum(after[name].low <= pair.truth[name] <= after[name].high for name in MAIN) >= 4


@pytest.mark.slow
def test_what_is_planned_is_about_what_comes(pair):
    after = pair.plan[round(60 * MINUTES / NOTED) - 1]
    for name in MAIN:
        assert 0.4 < width(pair.expected, name) / width(after, name) < 1.6
