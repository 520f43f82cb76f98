"""Plans that other programs post: their commands as step means, their limits, and the answers in their form."""

import json
from itertools import pairwise

import numpy as np
import pytest

from usvlearn.core.forecasts import Forecast, Track
from usvlearn.errors import ConfigError
from usvlearn.live.plan_requests import MOST_ROWS, answer, identifier, parse_plan, sampled

PLAN = "0.5,0.2,-1; 1.3,1,0.5; 4,-0.4,0"


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("first", [0.0, 0.3, 0.5, 2.0, 4.0, 9.0, -3.0])
def test_commands_of_a_step_are_the_mean_of_what_holds_within_it(side, first):
    """By a fine sum: the commands in force until the first row, each row until the next, the last one on and on."""
    plan, edges = parse_plan(PLAN), first + 0.4 * np.arange(13)
    before = np.linspace(-0.7, 0.6, 12)
    means = sampled(plan, edges, before, side)
    for k, (begin, end) in enumerate(pairwise(edges)):
        times = begin + (end - begin) * (np.arange(4000) + 0.5) / 4000
        row = np.searchsorted(plan.time, times, side="right") - 1
        held = np.where(row < 0, before[k], getattr(plan, side)[np.maximum(row, 0)])
        assert means[k] == pytest.approx(held.mean(), abs=1e-3), k


def test_the_limits_of_a_plan_are_legal_and_what_is_beyond_is_not():
    plan = parse_plan("t,left,right,heading\n0,-1,1,5\n1,1,-1,6")
    assert plan.left.tolist() == [-1, 1] and plan.right.tolist() == [1, -1] and plan.heading.tolist() == [5, 6]
    assert parse_plan("0,1,1").heading is None
    rows = [f"{k},0,0" for k in range(MOST_ROWS + 1)]
    assert len(parse_plan(";".join(rows[:-1])).time) == MOST_ROWS
    for wrong, words in {
        ";".join(rows): "1001 rows", "0,-1.001,0": "found left -1.001", "0,0,1.001": "found right 1.001",
        "0,0,0;0,1,1": "do not rise", "-0.1,0,0": "do not rise", "1,0,0;0.5,0,0": "do not rise",
        '{"t": [0], "left": [0], "right": 0}': "without lists", '{"left": [0], "right": [0]}': "without lists",
    }.items():  # fmt: skip
        with pytest.raises(ConfigError, match=words):
            parse_plan(wrong)


def test_a_forecast_is_answered_in_the_form_of_the_plan():
    ahead = Forecast(*np.array([[0.4, 0.8], [1.0, 1.12345], [0.9, -np.inf], [1.1, np.inf]]))
    assert answer(PLAN, 3.0, ahead) == "0.4=1.000:0.900:1.100,0.8=1.123"
    posted = json.dumps({"id": "A", "t": [0], "left": [0], "right": [0]})
    assert json.loads(answer(posted, 3.00049, ahead)) == {
        "id": "A", "time": 3.0, "t": [0.4, 0.8], "surge": [1.0, 1.123], "low": [0.9, None], "high": [1.1, None],
    }  # fmt: skip
    assert answer(PLAN, 3.0, "no, not now") == "error: no, not now"
    assert json.loads(answer('{"t": []}', 3.0, "no")) == {"error": "no"}


def test_a_track_is_answered_in_the_form_of_the_plan():
    """Degrees from north, and the ellipse that holds 90 %: √(χ²₂(0.9)) = 2.146 deviations."""
    time, one = np.array([2.0, 4.0]), np.ones(2)
    covariance = np.array([np.diag([4.0, 1.0]), np.diag([np.inf, np.inf])])
    place = {"heading": np.radians([90.0, -90.0]), "north": 3 * time, "east": -time, "yaw_rate": 0 * one}
    track = Track(time=time, surge=1.5 * one, sway=-0.1 * one, covariance=covariance, **place)
    assert answer(PLAN, 3.0, track) == "2=6.00:-2.00:90.0:4.29:2.15:0.0,4=12.00:-4.00:270.0"
    assert json.loads(answer('{"id": 5, "t": [0]}', 3.0, track)) == {
        "id": 5, "time": 3.0, "t": [2.0, 4.0], "surge": [1.5, 1.5], "sway": [-0.1, -0.1], "north": [6.0, 12.0],
        "east": [-2.0, -4.0], "heading": [90.0, 270.0], "major": [4.292, None], "minor": [2.146, None],
        "bearing": [0.0, 0.0],
    }  # fmt: skip


def test_an_identifier_is_a_plain_value():
    assert [identifier(json.dumps({"id": x})) for x in ("A", 7, 0.5)] == ["A", 7, 0.5]
    assert identifier('{"id": 1e999}') is None and identifier('{"id": "' + "x" * 101 + '"}') is None
    assert identifier('{"id": "' + "x" * 100 + '"}') == "x" * 100 and identifier('{"id": ["A"]}') is None
    assert identifier("0,1,1") is None and identifier("[1]") is None
