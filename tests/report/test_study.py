"""The study: its stages, that it goes on where it stopped, and the same whether it was stopped or not."""

import json

import pytest
from hydra import compose, initialize_config_dir

from tests.support import ROOT
from tests.support.commands import run
from tests.support.studies import PLAN, STAGES, Recorder, made
from usvlearn.errors import ConfigError


def test_stages_in_order_with_what_tuning_found(tmp_path):
    recorder = Recorder()
    season, commands = made(tmp_path, recorder)
    assert [*recorder.stages] == STAGES and season == tmp_path / "season"
    gained = "estimators.aid.gain=3.0"
    assert recorder.stages == {
        "tune/aid": ["data.n=2", "data.seed=1", "grid=aid", "tuning.evaluations=4"],
        "initial": ["data.n=2", "data.seed=1", gained],
        "season": ["data.n=2", "x=3", gained, f"resume={tmp_path}/initial/best"],
    }
    assert len(commands) == 3 and commands[0].startswith("python train.py data.n=2")


@pytest.mark.parametrize("fails", STAGES)
def test_a_stopped_study_goes_on(tmp_path, fails):
    with pytest.raises(KeyboardInterrupt):
        made(tmp_path, Recorder(fails))
    again, finished = Recorder(), Recorder()
    commands = made(tmp_path, again)
    assert [*again.stages] == STAGES[STAGES.index(fails) :]
    assert [each for each in again.stages[fails] if each.startswith("resume=")] == [f"resume={tmp_path / fails}"]
    assert made(tmp_path, finished) == commands and not finished.stages


def test_a_saved_setting_that_names_code_is_refused(tmp_path):
    made(tmp_path, Recorder())
    path = tmp_path / "tune" / "aid" / "tuning.json"
    path.write_text(json.dumps({"best": {"setting": {"_target_": "os.system"}}}))
    again = Recorder()
    with pytest.raises(ConfigError, match=r"tuning\.json: found the setting '_target_': 'os\.system'"):
        made(tmp_path, again)
    assert not again.stages


@pytest.mark.parametrize("name", ["study.json", "tune/aid/tuning.json"])
def test_a_damaged_file_is_told_and_another_plan_is_not_mixed_in(tmp_path, name):
    made(tmp_path, Recorder())
    with pytest.raises(ConfigError, match="study of another plan"):
        made(tmp_path, Recorder(), {**PLAN, "evaluations": 8})
    (tmp_path / name).write_text("{")
    with pytest.raises(ConfigError, match=rf"{name}: is damaged .* remove it"):
        made(tmp_path, Recorder())


@pytest.mark.thorough
@pytest.mark.parametrize("path", sorted((ROOT / "configs" / "experiment").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_experiment_composes(path):
    """For train.py, or as a study of evaluate.py whose stages are overrides of train.yaml."""
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        if "study:" not in path.read_text():
            assert "study" not in compose("train", [f"experiment={path.stem}"])
            return
        study = compose("evaluate", [f"experiment={path.stem}"]).study
        for season in ("tuning", "season"):
            overrides = [*study.common, *study[season]]
            cfg = compose("train", [*overrides, "grid=aid", f"tuning.evaluations={study.evaluations}"])
            assert set(study.members) <= set(cfg.tuning.ranges) and cfg.data.n > 1
        assert study.tuning != study.season


@pytest.mark.thorough
def test_a_study_is_not_for_train_and_says_what_is_wrong_in_its_plan(tmp_path):
    done = run("experiment=paper_small", folder=tmp_path)
    assert done.returncode == 2 and "python evaluate.py experiment=" in done.stderr
    done = run("experiment=paper_small", "study.evaluations=0", folder=tmp_path, script="evaluate.py")
    assert done.returncode == 2 and "tuning.evaluations: found 0" in done.stderr


TINY = [
    "experiment=paper_small", "study.members=[aid,sift_map]", "study.evaluations=2",
    "study.common=['data.n=2','data.mission_minutes=2','estimators.rnn.neurons=4','save_minutes=0.5','tuning.rounds=1']",
    "study.tuning=['data.seed=1','data.hours=0.0667']", "study.season=['data.seed=2','data.hours=0.0667']",
]  # fmt: skip
