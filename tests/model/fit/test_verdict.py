"""What logs are good for: the intervals that are expected after more data are those of more data."""

import math

import numpy as np
import pytest

from tests.support.fitted_boats import MASS, TOP, log
from usvlearn.core.prepared_samples import LEFT, RIGHT
from usvlearn.logs.checks.finding import Finding
from usvlearn.model.fit import verdict as at
from usvlearn.model.fit.boat import FittedBoat
from usvlearn.model.fit.fitted import fit_boat
from usvlearn.model.fit.verdict import Expected, verdicts
from usvlearn.model.planning.search import refitted
from usvlearn.report.summary import displayed

NAMES = "thrust_full_left", "thrust_full_right", "steady_speed_half", "time_constant"


def expected(steps: int, noise: float = 0.3, seeds=(1,), same: bool = False) -> Expected:
    rows = {str(seed): log(steps, seed, noise) for seed in seeds}
    for each in rows.values():
        each[:, RIGHT] = each[:, LEFT] if same else each[:, RIGHT]
    return Expected(fit_boat("heron", rows, MASS, TOP, "nine"))


@pytest.fixture(scope="module")
def short():
    return expected(3000)


def test_now_they_are_those_of_the_fit_and_more_data_narrow_them(short):
    now = short.after(0.0)
    for name in NAMES:
        each = short.fitted.quantities[name]
        assert now[name] == pytest.approx((each.high - each.low) / 2 / abs(each.value), rel=0.15)
        assert now[name] >= short.after(0.25)[name] >= short.after(1.0)[name] > 0.01
        assert now[name] > short.after_manoeuvres(1)[name] > short.after_manoeuvres(3)[name] > 0.01


@pytest.mark.thorough
def test_as_much_more_is_as_it_was_expected(short):
    more = short.after(5 * short.hours)
    for seeds in (range(1, 7), range(11, 17)):
        whole = expected(3000, seeds=seeds).after(0.0)
        ratios = [whole[name] / more[name] for name in NAMES]
        assert 0.5 < np.exp(np.mean(np.log(ratios))) < 1.6, ratios


@pytest.mark.thorough
def test_a_refit_is_as_it_was_expected(short):
    found, more = short.fitted.identified, log(6000, 7, 0.3)
    told = refitted(FittedBoat.read(found.facts()), more, 0.1)
    done = fit_boat("heron", {"1": log(3000, 1, 0.3), "7": more}, MASS, TOP, "nine").quantities
    now, expected, then = ([x[name].high - x[name].low for name in NAMES] for x in (found, told, done))
    assert all(0 < x < y for x, y in zip(expected, now, strict=True))
    assert 0.6 < np.exp(np.mean(np.log(then) - np.log(expected))) < 1.6, (now, expected, then)


@pytest.mark.thorough
def test_the_advice_is_an_amount_and_nothing_that_was_done(short):
    first, *rest = at._told(short, {"command_left": {"span": -400}, "heading": {"zero": 7.5}})
    assert first.startswith("good for  ") and len(rest) <= 3
    assert any(each.startswith("found     left reversed, compass +7.5°") for each in rest)
    assert ("min of the test manoeuvre" in rest[-1]) == any(each.startswith("not for") for each in rest)
    alike = expected(3000, same=True)
    boat = alike.fitted.identified
    assert "thrust_ratio" not in displayed(boat) and "drag_half_speed" in displayed(boat)
    assert math.isnan(boat.displayed("thrust_full_left").value)
    one = list(at._told(alike, {}))
    assert "one command for both sides" in "".join(one) and not any("each side" in each for each in one)
    good = list(at._told(expected(6000, 0.01, range(4)), {}))
    assert "thrust of each side" in good[0] and good[1] == "not for   turning (unknown: turns too little)"
    assert good[-1] == "more      10 min of the test manoeuvre; more of such sailing tells too little"


def test_warnings_come_first_and_little_data_is_told(short, monkeypatch):
    class Fleet:
        boats = ("heron",)

    monkeypatch.setattr(at, "align_fleet", lambda *_, **__: Fleet)
    monkeypatch.setattr(at, "missions_of", lambda *_: {"1": None, "2": None})
    monkeypatch.setattr(at, "fit_boat", lambda *_: short.fitted)
    settings = {"data": {}, "vehicle": {"mass": MASS, "surge_max": TOP}}
    wrong = Finding("heron", "surge", "speed unit", "knots\x1b", "m/s")
    asked = {"mass": {"certainty": "unsure"}, "span": {"certainty": "probable"}}
    assert list(verdicts([], settings, [wrong], asked)) == [
        "heron: 0.08 h in 2 runs; data check: 1 finding; unsure: mass",
        r"good for  nothing before this is settled: heron, surge: found knots\x1b, expected m/s",
    ]
    monkeypatch.undo()
    monkeypatch.setattr(at, "align_fleet", lambda *_, **__: Fleet)

    def few(*_, **__):
        raise at.UsvlearnError("found 3 measured speeds")

    monkeypatch.setattr(at, "missions_of", few)
    assert list(verdicts([], settings, [], {})) == ["heron: good for nothing yet: found 3 measured speeds"]
    monkeypatch.setattr(at, "align_fleet", few)
    assert list(verdicts([], settings, [], {})) == ["good for  nothing yet: found 3 measured speeds"]
