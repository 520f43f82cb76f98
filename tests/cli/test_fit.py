"""`usvlearn fit`: what it finds of a simulated boat, what it writes, and what it refuses in one sentence."""

import json
import shutil
import sys

import numpy as np
import pytest

from tests.support.commands import SMALL, run
from usvlearn.__main__ import main
from usvlearn.cli.fit import work
from usvlearn.errors import UsvlearnError
from usvlearn.model.fit.terms import SETS
from usvlearn.runs import saved

SCRIPT = "usvlearn/__main__.py"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of two boats, half an hour each, three missions."""
    folder = tmp_path_factory.mktemp("fit")
    left = [f"~estimators.{name}" for name in ("rnn", "joint_quick", "arx")]
    more = ["~combiners.average", "~combiners.weighted", "combiners.ensemble.members=[aid,sift_map,joint]",
            "forecasts.members=[aid,joint]", "data.hours=0.5", "data.mission_minutes=10", "data.n=2"]  # fmt: skip
    done = run(*(each for each in SMALL if "rnn" not in each), *left, *more, "hydra.run.dir=run", folder=folder)
    assert done.returncode == 0, done.stderr
    return folder


def test_it_is_nearer_to_the_truth_than_online_learning_and_says_how_sure_it_is(folder):
    done = run("fit", "run", folder=folder, script=SCRIPT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("(used)") == 2 and done.stdout.count("online") == 2
    truth = json.loads((folder / "run" / "results.json").read_text())["identified"]
    inside, nearer = [], []
    for boat in ("heron1", "heron2"):
        assert f"Written to run/fit/{boat}.fit.json" in done.stdout
        found = json.loads((folder / "run" / "fit" / f"{boat}.fit.json").read_text())
        assert found["missions"] == 3 and set(found["sets"]) == set(SETS) and found["terms"] in SETS
        for name in ("steady_speed_full", "steady_speed_half", "drag_half_speed", "thrust_full_left", "time_constant"):
            true, own = truth[boat][name]["truth"], found["quantities"][name]
            inside.append(own["low"] <= true <= own["high"])
            nearer.append(abs(own["value"] - true) <= abs(truth[boat][name]["value"] - true))
    assert np.mean(inside) >= 0.8 and np.mean(nearer) > 0.5


def test_one_boat_and_one_set_may_be_named(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    work(["run", "--boat", "heron2", "--terms", "nine", "--out", str(tmp_path)])
    assert "nine (used)" in capsys.readouterr().out
    (path,) = tmp_path.iterdir()
    found = json.loads(path.read_text())
    assert path.name == "heron2.fit.json" and found["terms"] == "nine" and len(found["parameters"]) == 9


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["nowhere"], "nowhere"),
        (["run", "--boat", "heron3"], "--boat: found 'heron3', expected one of heron1, heron2"),
        (["run", "--terms", "curve"], "--terms: found 'curve', expected one of nine, cubic"),
        (["run", "data.path=[a"], "data.path: found '[a', expected a value as YAML has them"),
        (["run", "path=logs"], "found 'path=logs', expected data.KEY=VALUE"),
        (["run", "--out", ""], "--out: found ''"),
        (
            ["run", "data.hours=0.01", "data.mission_minutes=0.6"],
            "measured speeds of a boat that moves, expected at least 600",
        ),
        (["run", "data.plant=raft"], "raft"),
    ],
)
def test_bad_input_is_one_sentence_and_writes_nothing(folder, tmp_path, monkeypatch, capsys, arguments, words):
    shutil.copytree(folder / "run", tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "fit", ignore_errors=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["usvlearn", *arguments])
    with pytest.raises(UsvlearnError) as error:
        work(arguments)
    assert words in str(error.value) and "\n" not in str(error.value)
    assert not (tmp_path / "run" / "fit").exists()


def test_logs_that_have_moved_are_named_by_their_key(folder, tmp_path, monkeypatch):
    logs = {"_target_": "usvlearn.logs.read.read", "path": "gone", "channels": {}, "boat": "heron1"}
    monkeypatch.setattr(saved, "configuration", lambda run, before=saved.configuration: {**before(run), "data": logs})
    monkeypatch.chdir(folder)
    with pytest.raises(UsvlearnError, match=r"if the logs have moved, give data.path=FOLDER \(found 'gone'\)"):
        work(["run", "--out", str(tmp_path)])


def test_help_fits_a_screen(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["usvlearn"])
    with pytest.raises(SystemExit) as end:
        main(["fit", "--help"])
    assert end.value.code == 0 and "--terms" in capsys.readouterr().out
