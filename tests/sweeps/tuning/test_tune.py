"""Tuning: batch elements are replays, refinement keeps the best, the gradient is the derivative."""

import itertools
import json
import math

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from tests.support import ROOT, over
from tests.support.commands import ran, results, run
from tests.support.configured import TWO_BOATS, configured, replayed, request
from usvlearn import Estimator, Persistence, Positive, UnitInterval, UsvlearnError
from usvlearn.errors import ConfigError
from usvlearn.logs.recordings import align_fleet
from usvlearn.sweeps.tuning import batches
from usvlearn.sweeps.tuning import tune as tuning
from usvlearn.sweeps.tuning.batches import Evaluation, Hyperparameter, Objective, hyperparameter
from usvlearn.sweeps.tuning.methods import counts, grid

GAIN = Hyperparameter("gain", Positive, 1.0, 0.01, 100.0)


SETTINGS = {
    "aid": [{"gain": 0.1}, {"gain": 3.0}, {"gain": 30.0}],
    "joint": [{"disturbance": 0.1, "current": 0.02}, {"disturbance": 50.0, "current": 0.2}],
    "arx": [{"walk": 1e-5, "scale": 0.1}, {"walk": 1e-3, "scale": 0.4}],
    "rnn": [{"rate": 1e-3, "contraction_rate": 0.95}, {"rate": 1e-4, "contraction_rate": 0.999}],
}


@pytest.mark.parametrize("member", SETTINGS)
def test_elements_are_single_replays(fleet, member, monkeypatch):
    """Also where a batch holds less than all settings, and where errors are added up in short chunks."""
    build, settings = request(f"grid={member}").build, SETTINGS[member]
    expected = [replayed(fleet, build(setting)) for setting in settings]
    for element_limit, chunk in ((4096, 500), (4, 500), (4096, 37)):
        monkeypatch.setattr(batches, "CHUNK_STEPS", chunk)
        evaluated = Objective(build, fleet, elements=element_limit)(settings)
        np.testing.assert_allclose([each.maes for each in evaluated], expected, rtol=1e-12)
        assert [each.setting for each in evaluated] == settings


def test_the_default_is_the_members_own_and_work_is_told(fleet):
    asked, work = request("grid=aid", "estimators.aid.gain=0.3"), []
    assert asked.parameters[0].default == 0.3
    Objective(asked.build, fleet, work.append)([{"gain": 0.3}, {"gain": 1.0}])
    assert sum(work) == pytest.approx(2)


class Explodes(Estimator):
    """Persistence that is not finite where its gain is above 1."""

    def __init__(self, gain=1.0):
        super().__init__()
        self.gain = Positive(gain, "gain")

    def init(self, batch=()):
        return torch.zeros(tuple(batch), dtype=torch.float64)

    def predict(self, state, inputs):
        return state, torch.where(self.gain() > 1.5, math.inf, state)

    def update(self, state, inputs, surge):
        return surge

    def start(self, state, surge):
        return surge


def test_a_element_that_diverges_is_infinite_and_shown(fleet):
    evaluated = Objective(lambda values: Explodes(**values), fleet)([{"gain": 1.0}, {"gain": 2.0}])
    assert [math.isfinite(each.mae) for each in evaluated] == [True, False]
    np.testing.assert_allclose(evaluated[0].maes, replayed(fleet, Persistence()), rtol=1e-12)
    content = tuning.record({"member": "x", "command": "", "evaluations": 1}, fleet.boats, evaluated, evaluated[0])
    assert content["diverged"] == 1 and content["evaluated"][1]["mae"] is None
    assert tuning.ranked(content)[-1]["mae"] is None


@pytest.mark.parametrize("kind, low, high", [(Positive, 1e-3, 1e3), (UnitInterval, 0.01, 0.9999)])
def test_values_are_spaced_on_their_scale(kind, low, high):
    each = Hyperparameter("x", kind, 0.5, low, high)
    values = each.spaced(*each.span, 7)
    assert values[0] == low and values[-1] == high
    scale = np.log(values) if kind is Positive else np.log(values) - np.log1p(-np.array(values))
    np.testing.assert_allclose(np.diff(scale), np.diff(scale).mean(), rtol=2e-3)
    for value in values:
        assert each.from_scale(each.to_scale(value)) == pytest.approx(value, rel=1e-3)


class Bowl:
    """An objective of known minimum, on the logarithm."""

    def __init__(self, **best: float):
        self.best, self.rounds = best, []

    def __call__(self, settings):
        self.rounds.append(settings)
        return [Evaluation(s, (sum(math.log(s[k] / x) ** 2 for k, x in self.best.items()),)) for s in settings]


@pytest.mark.parametrize("evaluations, rounds", [(64, 2), (64, 1), (30, 3), (5, 2), (1, 1), (2, 2)])
@over("best", [{"a": 2.3}, {"a": 0.013, "b": 7.0}, {"a": 99.0, "b": 0.5, "c": 1.0}])
def test_refinement_contains_the_best_and_never_loses_it(evaluations, rounds, best):
    bowl = Bowl(**best)
    evaluated, used, _ = grid(bowl, [Hyperparameter(k, Positive, 1.0, 0.01, 100.0) for k in best], evaluations, rounds)
    assert evaluated[0].setting == dict.fromkeys(best, 1.0)
    assert used == len(evaluated) - 1 <= evaluations
    assert all(0.01 <= value <= 100 for each in evaluated for value in each.setting.values())
    assert len({tuple(each.setting.items()) for each in evaluated}) == len(evaluated)  # nothing twice
    judged = [Bowl(**best)(settings) for settings in bowl.rounds]
    for k in range(1, len(judged)):  # each round lies about the best before it
        centre = min(itertools.chain(*judged[:k]), key=lambda each: each.mae).setting
        for name in best:
            values = sorted(each.setting[name] for each in judged[k])
            edge = centre[name] in (0.01, 100.0)
            assert len(set(values)) < 2 or edge or values[0] <= centre[name] <= values[-1]
    assert min(each.mae for each in evaluated) == min(each.mae for each in itertools.chain(*judged))
    if (evaluations, rounds) == (64, 2) and len(best) == 1:
        coarse = min(each.mae for each in evaluated[:33])
        assert min(each.mae for each in evaluated) < coarse / 4


def test_counts():
    for points, dimensions in itertools.product(range(1, 70), (1, 2, 3)):
        sizes = counts(points, dimensions)
        assert len(sizes) == dimensions and min(sizes) >= 1 and points / 2 < math.prod(sizes) <= points


@pytest.mark.thorough
def test_every_file(tmp_path):
    """A sweep over two members: its table, each job's files, and the experiment that each gives."""
    ranges = "tuning.ranges.arx={walk: [1e-5, 1e-3]}"
    arguments = [*TWO_BOATS, "grid=aid,arx", "tuning.evaluations=12", ranges, "hydra.sweep.dir=sweep"]
    done = ran("-m", *arguments, folder=tmp_path)
    for k, member in enumerate(("aid", "arx")):
        folder = tmp_path / "sweep" / str(k)
        saved = json.loads((folder / "tuning.json").read_text())
        assert saved["member"] == member and saved["way"] == "grid" and saved["seconds"] > 0
        assert f"grid={member}" in saved["command"]
        assert saved["best"]["mae"] == min(each["mae"] for each in saved["evaluated"])
        assert saved["best"]["gain"] == pytest.approx(100 * (1 - saved["best"]["mae"] / saved["default"]["mae"]))
        assert results(folder)["objective"] == saved["best"]["mae"] == np.mean(list(saved["best"]["boats"].values()))
        for boat, mae in saved["persistence"]["boats"].items():
            assert results(folder)["boats"][boat]["persistence"] == {"mae": mae, "skill": 0}
        assert f"{saved['best']['mae']:.5f}" in done.stdout
        best = tuning.label(saved["best"]["setting"])
        assert list((folder / "tensorboard" / best).glob("events*")) and f"best {best}: " in done.stdout
        added = tmp_path / "configs" / "experiment"
        added.mkdir(parents=True, exist_ok=True)
        text = (folder / "experiment.yaml").read_text()
        assert text.startswith("# @package _global_\n# Found by: python train.py")
        (added / f"tuned_{member}.yaml").write_text(text)
    search_path = f"hydra.searchpath=[file://{tmp_path}/configs]"
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        cfg = compose("train", [search_path, "experiment=tuned_arx"])
    assert cfg.estimators.arx.walk == saved["best"]["setting"]["walk"]
    assert cfg.estimators.arx.scale == 0.3  # all else as it was
    assert isinstance(instantiate(cfg.estimators.arx), Estimator)


BAD_INPUT = {
    "unknown member": (["grid=nobody"], ["grid", "nobody", "joint_quick"]),
    "a list": (["grid=[aid]"], ["grid", "aid", "expected"]),
    "empty grid": (["grid={}"], ["grid", "no values"]),
    "empty list": (["grid={aid.gain: []}"], ["aid.gain", "no values"]),
    "two members": (["grid={aid.gain: [1], sift_map.memory: [2]}"], ["aid, sift_map", "one member"]),
    "no path": (["grid={aid: [1]}"], ["aid", "gain"]),
    "words": (["grid={aid.gain: [fast]}"], ["aid.gain", "fast", "numbers"]),
    "not legal": (["grid={aid.gain: [-1, 1]}"], ["aid.gain", "-1", "positive"]),
    "no batch element": (["grid={aid.sigma: [1, 2]}"], ["aid.sigma", "gain"]),
    "unknown path": (["grid={aid.gian: [1, 2]}"], ["aid.gian", "gain"]),
    "illegal range": (["grid=aid", "tuning.ranges.aid.gain=[-1,1]"], ["ranges.aid.gain", "-1", "positive"]),
    "beyond one": (["grid=rnn", "tuning.ranges.rnn.contraction_rate=[0.5,1]"], ["contraction_rate", "between 0 and 1"]),
    "low above high": (["search=aid", "tuning.ranges.aid.gain=[2,1]"], ["ranges.aid.gain", "2", "lower bound first"]),
    "half a range": (["search=aid", "tuning.ranges.aid.gain=[2]"], ["ranges.aid.gain", "[2]", "LOW, HIGH"]),
    "a word in a range": (["search=aid", "tuning.ranges.aid.gain=[1,fast]"], ["ranges.aid.gain", "fast"]),
    "no evaluations": (["grid=aid", "tuning.evaluations=0"], ["tuning.evaluations", "0", "1 or more"]),
    "half evaluations": (["grid=aid", "tuning.evaluations=1.5"], ["tuning.evaluations", "1.5"]),
    "too many rounds": (["grid=aid", "tuning.evaluations=2", "tuning.rounds=3"], ["tuning.rounds", "3"]),
    "two ways": (["grid=aid", "learn=aid"], ["grid and learn", "one"]),
    "persistence": (["learn=persistence"], ["persistence", "no hyperparameter"]),
    "no ranges": (["grid=aid", "~tuning.ranges.aid"], ["tuning.ranges.aid", "gain"]),
    "initial weights": (["grid=rnn", "+tuning.ranges.rnn.initial=[-1,1]"], ["initial", "rate"]),
    "several values": (["grid=aid", "estimators.aid.gain=[[1],[2]]"], ["gain", "2 values"]),
    "no seed": (["search=aid", "tuning.seed=abc"], ["tuning.seed", "abc"]),
    "start": (["learn=aid", "tuning.start=best"], ["tuning.start", "best", "middle"]),
    "too few to learn": (["learn=sift_map", "tuning.evaluations=17"], ["tuning.evaluations", "17", "18 or more"]),
    "threads": (["grid=aid", "threads=0"], ["threads", "positive"]),
}


@pytest.mark.thorough
@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_is_told_in_one_sentence(case, tmp_path):
    overrides, said = BAD_INPUT[case]
    with pytest.raises(UsvlearnError) as caught:
        tuning.tune(configured(*overrides), tmp_path / "run", instantiate, align_fleet)
    sentence = str(caught.value)
    assert "\n" not in sentence and all(word in sentence for word in said), sentence
    assert not (tmp_path / "run").exists()


def test_bad_input_ends_with_code_2_and_another_folder_is_left_alone(tmp_path):
    folder = tmp_path / "run"
    (folder / "checkpoints").mkdir(parents=True)
    done = run("grid=aid", f"hydra.run.dir={folder}", folder=tmp_path)
    assert done.returncode == 2 and "checkpoints" in done.stderr
    (tmp_path / "tuning.json").write_text(json.dumps({"way": "grid", "member": "sift_map"}))
    for way, member in (("grid", "aid"), ("grid", "sift_map"), ("search", "sift_map")):
        with pytest.raises(ConfigError, match="grid=sift_map"):
            tuning.check_folder(tmp_path, way, member)
    (tmp_path / "tuning.json").write_text(json.dumps({"way": "search", "member": "sift_map"}))
    tuning.check_folder(tmp_path, "search", "sift_map")  # which goes on


def test_a_hyperparameter_keeps_its_digits():
    from usvlearn import AID

    assert hyperparameter(AID(gain=0.3), "gain").default == 0.3
    assert GAIN.from_scale(GAIN.to_scale(3.162)) == 3.162
