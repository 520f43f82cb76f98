"""Whether the best setting is told from others, and the files of very many evaluations."""

import json

import numpy as np
import pytest

from usvlearn.core.hyperparameters import Positive
from usvlearn.sweeps.tuning import tune
from usvlearn.sweeps.tuning.batches import Evaluation, Hyperparameter
from usvlearn.sweeps.tuning.landscape import ARRAYS, PICTURE, explore
from usvlearn.sweeps.tuning.methods import grid, product

pytestmark = pytest.mark.thorough  # Matplotlib takes long to be imported
GAIN, TIME = Hyperparameter("gain", Positive, 1.0, 0.01, 100.0), Hyperparameter("time", Positive, 10.0, 1.0, 100.0)


def evaluations(steepness: float, count: int = 9, runs: int = 6) -> list[Evaluation]:
    """The gain matters as much as stated, the time not at all; runs differ by far more."""
    evaluated, index = [], np.arange(runs)[:, None]
    every = product({each.path: each.spaced(*each.span, count) for each in (GAIN, TIME)})
    for k, setting in enumerate([{"gain": 1.0, "time": 10.0}, *every]):
        error = 0.03 + steepness * np.log(setting["gain"]) ** 2
        each = error + 0.02 * index + 1e-5 * (-1.0) ** (k + index)
        evaluated.append(Evaluation(setting, (float(each.mean()),), each.tolist()))
    return evaluated


def test_a_flat_optimum_is_called_flat(tmp_path):
    steep, flat = (explore(tmp_path, [GAIN, TIME], evaluations(x)) for x in (1e-3, 1e-9))
    assert steep["flat"] == ["time"] and flat["flat"] == ["gain", "time"]
    assert steep["ranges"]["gain"] == [1.0, 1.0] and flat["ranges"]["gain"] == [0.01, 100.0]
    assert steep["default_alike"] and flat["default_alike"]
    assert "The optimum is flat in time." in steep["told"] and "The default is one of them." in flat["told"]
    assert steep["left_out"] == pytest.approx(0.08, abs=1e-4)
    json.dumps(steep, allow_nan=False)


def test_few_runs_and_settings_that_diverged(tmp_path):
    assert "alike" not in explore(tmp_path, [GAIN, TIME], evaluations(1e-3, runs=2))
    assert explore(tmp_path, [GAIN], [Evaluation({"gain": 1.0}, (0.1,))])["runs"] == 0
    evaluated = evaluations(1e-3)
    evaluated[0] = evaluated[0]._replace(maes=(np.inf,), runs=[[np.nan]] * 6)
    result = explore(tmp_path, [GAIN, TIME], evaluated)
    assert result["alike"] < len(evaluated) / 3 and not result["default_alike"]
    json.dumps(result, allow_nan=False)


def test_files_of_very_many_evaluations(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(tune, "MANY", 30)
    monkeypatch.setattr(tune, "BEST", 20)
    evaluated, boats = evaluations(1e-3), ["heron"]
    best = min(evaluated, key=lambda each: each.mae)
    evaluated += [best._replace(setting={path: x * (1 + 1e-9) for path, x in best.setting.items()})]
    facts = {"member": "aid", "way": "grid", "command": "", "evaluations": 81, "seconds": 1.0, "ranges": {}}
    content = tune.record(facts, boats, evaluated, Evaluation({}, (0.2,)))
    tune.write(tmp_path, content)
    for parameters in ([GAIN, TIME], [GAIN]):
        explore(tmp_path, parameters, evaluated)
        assert (tmp_path / PICTURE).read_bytes().startswith(b"\x89PNG")
    assert len(content["evaluated"]) == 21  # the default, and the best 20
    assert len({tune.label(each["setting"]) for each in content["evaluated"][1:]}) == 20  # no two that read alike
    assert content["best"]["mae"] == min(each.mae for each in evaluated)
    arrays = np.load(tmp_path / ARRAYS)
    assert arrays["mae"].shape == arrays["gain"].shape == (83,) and arrays["runs"].shape == (83, 6)


def test_a_grid_of_very_many_settings_repeats_none():
    seen = []

    def objective(settings):
        seen.extend(tuple(each.values()) for each in settings)
        return [Evaluation(each, (np.log(each["gain"]) ** 2,)) for each in settings]

    assert grid(objective, [GAIN], 20_000, 2)[1] > 19_900 and len(set(seen)) == len(seen)
