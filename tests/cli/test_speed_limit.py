"""All limits of a speed follow from `vehicle.surge_max`, so that a fast boat learns and has errors."""

import numpy as np
import pytest

from usvlearn import AID, learn, read
from usvlearn.composition.configuration import compose_train, ensemble_of, plain


def limits(node) -> list[float]:
    """Every `surge_max` in a part of a configuration."""
    if not isinstance(node, dict):
        return []
    return [x for key, each in node.items() for x in ([each] if key == "surge_max" else limits(each))]


@pytest.mark.parametrize("top, limit", [(2.74, 10.0), (7.7, 10.0), (10.0, 12.5), (14, 17.5)])
def test_one_limit_holds_everywhere(top, limit):
    more = ["+estimator@estimators.dynamic_rls=dynamic_rls"]
    settings = plain(compose_train(more, {"vehicle": {"surge_max": top}}))
    assert settings["align"]["surge_max"] == limit and settings["vehicle"]["surge_max"] == top
    assert {*limits(settings["estimators"]), *limits(settings["combiners"])} == {limit, top}  # of members that scale
    ensemble = ensemble_of(settings)
    assert ensemble.surge_max == ensemble.surge_limit == limit


def test_a_limit_of_ones_own_stays():
    settings = plain(compose_train([], {"vehicle": {"surge_max": 14.0}, "align": {"surge_max": 15.0}}))
    assert settings["align"]["surge_max"] == 15.0


@pytest.mark.parametrize("top", [10.0, 14.0])
def test_a_fast_boat_is_learned_and_scored(top):
    time = 0.2 * np.arange(900)
    thrust = np.where(time % 40 < 30, 1.0, -0.2)
    speed = np.zeros(900)
    for k in range(899):
        speed[k + 1] = speed[k] + 0.2 * 3 * (thrust[k] - speed[k] * abs(speed[k]) / top**2)
    arrays = {"time": time, "command_left": thrust, "command_right": thrust, "heading": 0 * time, "surge": speed}
    logs = read(arrays, mass=300.0, surge_max=1.1 * top, check="off")
    learned = learn(logs, AID(mass=300.0, surge_max=logs.settings["estimators"]["aid"]["surge_max"]))
    row = learned.scores["boat"]["ensemble"]
    assert speed.max() > 0.95 * top and not logs.fleet.rejected.get("boat", {}).get("surge")
    assert row["steps"] > 400 and row["mae"] < 1.0 and row["diverged"] == 0
