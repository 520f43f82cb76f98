"""Forecasts of held commands aboard: their intervals hold, and those of a foreign set begin anew."""

import json
import math

import numpy as np
import pytest

from tests.support.live import messages, sail
from usvlearn.core import checkpoint
from usvlearn.engine.online import Online
from usvlearn.live.held_command_intervals import HeldIntervals
from usvlearn.live.node import Node
from usvlearn.logs.setup import Setup
from usvlearn.simulate.fleet import fleet


def node(start) -> Node:
    return Node(Setup.of(checkpoint.load(start)[1]["setup"]), Online.open(start))


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "seed"), [("lawn_mower", 31), ("patrol", 32)])
def test_forecasts_of_held_commands_have_intervals_that_hold_whatever_is_commanded(start, kind, seed):
    """The intervals that assume that the commands stay hold half of the speeds 10 s ahead, or less."""
    one, log = node(start), fleet(n=1, hours=1.0, seed=seed, missions=[kind])[0]
    steps = sail(one, messages(log, 0.0))
    speed = {round(step.time, 1): step.measured for step in steps}
    inside, narrow = [], []
    for step in steps[250:]:  # 100 s
        later = speed.get(round(step.time + 10.0, 1), math.nan)
        if step.forecasts and math.isfinite(later):
            inside.append(step.forecasts[10.0][1] <= later <= step.forecasts[10.0][2])
            narrow.append(step.if_held[10.0][1] <= later <= step.if_held[10.0][2])
            assert step.forecasts[10.0][0] == step.if_held[10.0][0]
    assert len(inside) > 1500 and 0.8 < np.mean(inside) < 0.97 and np.mean(narrow) < 0.7
    again = HeldIntervals(one.horizons, one.dt)
    again.load(json.loads(json.dumps(one.held.json())))
    assert all(again.halfwidth(h) == pytest.approx(one.held.halfwidth(h), abs=1e-3) for h in one.horizons)


@pytest.mark.parametrize("given", [None, 3, {"2": [0.9, -1.0]}, {"2": ["a"]}, {"2": [math.nan] * 20}, {"2": [0.1] * 20},
                                   {"2": []}, {"2": [0.9] * 1000}, {"2": [True] * 20}])  # fmt: skip
def test_intervals_of_a_foreign_set_begin_anew(given):
    held = HeldIntervals([2.0], 0.4)
    held.load(given)
    assert held.halfwidth(2.0) == math.inf
