"""A folder of the user's own configurations, added by --config-dir."""

import json
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tests.support.commands import GOOD, ran, sentence
from usvlearn.cli import evaluate, train

FILES = {
    "data/my_boat.yaml": """
# @package _global_
defaults: [csv]
vehicle: {mass: 20.0}
data: {channels: {command_left: {name: L}, command_right: {name: R}, surge: {name: speed}}}
""",
    "estimator/quick_aid.yaml": "defaults: [aid]\ngain: 3.0\n",
    "experiment/mine.yaml": """
# @package _global_
defaults: [{/estimator@estimators.quick: quick_aid}, {override /data: my_boat}]
align: {dt: 0.2}
""",
}


@pytest.fixture
def mine(tmp_path) -> Path:
    for name, text in FILES.items():
        path = tmp_path / "mine" / name
        path.parent.mkdir(parents=True)
        path.write_text(text.lstrip())
    (tmp_path / "log.csv").write_text(GOOD)
    return tmp_path


@pytest.mark.thorough
def test_its_data_estimators_and_experiments_are_added(mine):
    ran("--config-dir", "mine", "experiment=mine", "data.path=log.csv", "hydra.run.dir=run", folder=mine)
    rows = json.loads((mine / "run" / "results.json").read_text())["boats"]["log"]
    assert rows["quick"]["mae"] != rows["aid"]["mae"] and rows["quick"]["steps"] == 49  # of 0.2 s
    settings = OmegaConf.load(mine / "run" / ".hydra" / "config.yaml")
    assert settings.estimators.quick.gain == 3.0 and settings.vehicle.mass == 20.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--config-dir", "nowhere"], ["nowhere: found no such folder: correct --config-dir"]),
        (["--config-dir", "log.csv"], ["log.csv: found no such folder: correct --config-dir"]),
        (["--config-dir", "mine", "data=my_baot"], ["data: found 'my_baot'", "did you mean my_boat?"]),
        (
            ["--config-dir", "mine", "data=my_boat", "data.channels.surge.nam=v"],
            ["did you mean data.channels.surge.na"],
        ),
    ],
)
def test_what_is_wrong_with_it_is_told(mine, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(mine)
    for main in (train.main, evaluate.main)[: 2 if "nowhere" in arguments else 1]:
        error = sentence(main, arguments, monkeypatch, capsys)
        assert all(word in error for word in words), error
