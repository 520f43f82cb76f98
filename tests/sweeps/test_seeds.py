"""One seed for everything that is drawn, and several of them as an axis of a sweep."""

import pytest

from usvlearn.errors import ConfigError
from usvlearn.sweeps.seeds import seeded, with_seeds


@pytest.mark.parametrize(
    ("given", "made"),
    [
        (["seeds=1"], ["-m", "seed=range(1)"]),
        (["-m", "a=1,2", "seeds=5"], ["-m", "a=1,2", "seed=range(5)"]),
        (["--multirun", "seeds=5"], ["--multirun", "seed=range(5)"]),
        (["seed=3", "data.seeds=4"], ["seed=3", "data.seeds=4"]),
    ],
)
def test_seeds_are_an_axis(given, made):
    assert with_seeds(given) == made


@pytest.mark.parametrize("value", ["0", "-1", "x", "", "1.5", "1001", "1,2"])
def test_bad_seeds(value):
    with pytest.raises(ConfigError, match=r"seeds: found .*, expected a whole number from 1 to 1000"):
        with_seeds([f"seeds={value}"])


def test_seed_and_seeds():
    for other in ("seed=3", "++seed=7", "+seed=1"):
        with pytest.raises(ConfigError, match="found seed=… too"):
            with_seeds([other, "seeds=2"])


@pytest.mark.parametrize("seed", [-1, 1.5, "1", True, None])
def test_a_bad_seed(seed):
    with pytest.raises(ConfigError, match=r"seed: found .*, expected a whole number, 0 or more"):
        seeded({"seed": seed, "data": {}, "estimators": {}, "tuning": {}})


def test_every_seed_is_moved_and_nothing_else():
    settings = {"seed": 2, "dt": 0.4, "data": {"seed": 5, "fleet_seed": 5, "sensors": {"seed": 1}},
                "estimators": {"rnn": {"seed": 0, "rate": 0.1}, "deep": {"estimator": {"seed": None}}},
                "tuning": {"seed": 0}}  # fmt: skip
    assert seeded(settings) == {
        "seed": 0, "dt": 0.4, "data": {"seed": 7, "fleet_seed": 5, "sensors": {"seed": 3}},
        "estimators": {"rnn": {"seed": 2, "rate": 0.1}, "deep": {"estimator": {"seed": None}}}, "tuning": {"seed": 2},
    }  # fmt: skip
    assert seeded({key: x for key, x in settings.items() if key != "seed"})["data"] == settings["data"]  # an older run
