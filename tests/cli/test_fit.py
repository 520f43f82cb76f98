"""`usvlearn fit`: what it finds of a simulated boat, what it writes, and what it refuses in one sentence."""

import json
import math
import shutil
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support.commands import QUICK, ran, run
from usvlearn.cli.fit import fit_on_the_way, work
from usvlearn.cli.signals import Stopped
from usvlearn.core.samples import Inputs, Sample
from usvlearn.display import terminal
from usvlearn.engine.online import Online
from usvlearn.errors import UsvlearnError
from usvlearn.live.node_folder import newest
from usvlearn.model.fit.boat import FittedBoat
from usvlearn.model.fit.gauss_newton import Missions
from usvlearn.model.fit.terms import SETS
from usvlearn.model.read_boats import read_boats
from usvlearn.runs import saved

pytestmark = pytest.mark.thorough  # the set-up of its tests takes long

SCRIPT = "usvlearn/__main__.py"
QUICKER = [each for each in QUICK[1:] if each != "~estimators.joint_averaged"]  # which tells the parameters
MISSIONS = [
    "data.hours=0.5",
    "data.mission_minutes=10",
    "data.n=2",
    "hydra.run.dir=run",
    "refit=true",
    "--all",
    *QUICKER,
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run of two boats, half an hour each, three missions, which was fitted at its end."""
    folder = tmp_path_factory.mktemp("fit")
    done = ran(*MISSIONS, folder=folder)
    assert done.stdout.count("(used)") == 2 and "report: " not in done.stdout
    return folder


def test_it_is_nearer_to_the_truth_than_online_learning_and_says_how_sure_it_is(folder):
    done = ran("fit", "run", "--all", folder=folder, script=SCRIPT)
    assert done.stdout.count("(used)") == 2 and done.stdout.count("  online  ") == 2
    truth = json.loads((folder / "run" / "results.json").read_text())["identified"]
    inside, nearer = [], []
    for boat in ("heron1", "heron2"):
        assert f"Written to run/fit/{boat}.fit.json" in done.stdout
        fit = json.loads((folder / "run" / "fit" / f"{boat}.fit.json").read_text())
        assert fit["missions"] == 3 and set(SETS) <= set(fit["sets"]) and fit["terms"] in fit["sets"]
        for name in ("steady_speed_full", "steady_speed_half", "drag_half_speed", "thrust_full_left", "time_constant"):
            true, value = truth[boat][name]["truth"], fit["quantities"][name]
            nearer.append(abs(value["value"] - true) <= abs(truth[boat][name]["value"] - true))
        known = fit["quantities"].keys() & truth[boat].keys()  # those of turning have no truth here
        inside += [
            fit["quantities"][k]["low"] <= truth[boat][k]["truth"] <= fit["quantities"][k]["high"] for k in known
        ]
    assert np.mean(inside) >= 0.8 and np.mean(nearer) > 0.5


def predictions(folder: Path) -> list[dict[str, np.ndarray]]:
    return [dict(np.load(path)) for path in sorted((folder / "predictions").glob("*.npz"))]


@pytest.mark.parametrize("last", ["00000_*", "00001_0000300*"], ids=["where a mission has ended", "under way"])
def test_a_fit_of_the_missions_so_far_forecasts_too_and_a_resumed_run_is_the_same(folder, tmp_path, monkeypatch, last):
    tables = []
    for k in range(3):
        path = max((folder / "run" / "checkpoints" / "heron2").glob(f"{k:05d}_*"))
        tables.append(np.array(Online.open(path).description["forecasts"]["fit"]["table"]))
    assert not tables[0].any() and tables[1].any() and (tables[2] != tables[1]).any()
    whole = predictions(folder / "run")
    forecasts = [each["forecasts"].reshape(*each["forecasts"].shape[:2], 6, -1)[..., -3] for each in whole]
    assert not np.isfinite(forecasts[0]).any() and np.isfinite(forecasts[-1]).any()
    shutil.copytree(folder / "run", tmp_path / "run")
    newest = max((tmp_path / "run" / "predictions").glob(f"{last}.npz"))
    for path in (tmp_path / "run" / "predictions").glob("*.npz"):
        if path.name > newest.name:
            path.unlink()
    monkeypatch.setattr("usvlearn.cli.train.fit_on_the_way", lambda *_: {})  # the last fit is that of the others
    done = run(*MISSIONS, "resume=latest", folder=tmp_path)
    assert done.returncode == 0 and "resuming after" in done.stdout, done.stderr
    for one, other in zip(whole, predictions(tmp_path / "run"), strict=True):
        for name in ("predictions", "forecasts", "forecast_halfwidths"):
            np.testing.assert_array_equal(one[name], other[name])


def test_a_run_is_fitted_on_the_way_of_another_command_which_goes_on_without_a_fit(folder, tmp_path, capsys):
    shutil.copytree(folder / "run", tmp_path / "run")
    fit_on_the_way(tmp_path / "none", terminal.console(quiet=True))
    assert "warning: no fit was made" in capsys.readouterr().err
    fit_on_the_way(tmp_path / "run", terminal.console(quiet=True))
    assert capsys.readouterr().out == ""
    for boat, fit in json.loads((tmp_path / "run" / "results.json").read_text())["fit"].items():
        saved = json.loads((tmp_path / "run" / "fit" / f"{boat}.fit.json").read_text())
        assert fit["quantities"] == saved["quantities"] and fit["doubts"] == saved["doubts"]
        assert fit["use"] == (not fit["doubts"]) and fit["terms"] == saved["terms"]


def test_one_boat_and_one_set_may_be_named(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    work(["run", "--boat", "heron2", "--terms", "nine", "--all", "--out", str(tmp_path)])
    assert [line.startswith("nine") for line in capsys.readouterr().out.splitlines() if "(used)" in line] == [True]
    (path,) = tmp_path.glob("*.json")
    content = json.loads(path.read_text())
    assert path.name == "heron2.fit.json" and content["terms"].startswith("nine") and len(content["parameters"]) == 10


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["nowhere"], "nowhere"),
        (["run", "--boat", "heron3"], "--boat: found 'heron3', expected one of heron1, heron2"),
        (["run", "--terms", "curve"], "--terms: found 'curve', expected one of 'nine', 'cubic'"),
        (["run", "data.hours=[a"], "data.hours: found '[a', expected a value as YAML has them"),
        (["run", "data.path=logs"], "data.path: expected a key of the run's logs: n, plant"),
        (["run", "data._target_=os.system"], "data._target_: expected a key of the run's logs"),
        (["run", "path=logs"], "found 'path=logs', expected data.KEY=VALUE"),
        (["run", "--out", ""], "--out: found ''"),
        (["run", "data.n=3"], "the logs are of heron1, heron2, heron3, and the run has learned heron1, heron2"),
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
    monkeypatch.setattr(
        saved, "configuration", lambda *given, before=saved.configuration: {**before(*given), "data": logs}
    )
    monkeypatch.chdir(folder)
    with pytest.raises(UsvlearnError, match=r"If the logs have moved, give data.path=FOLDER \(found 'gone'\)"):
        work(["run", "--out", str(tmp_path)])


def test_what_it_writes_is_read_by_all_that_read_a_run(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(folder)
    if not Path("run/fit").exists():
        work(["run"])
    before, after = read_boats("run")[0], read_boats("run/fit")[0]
    saved = json.loads(Path("run/fit/heron1.fit.json").read_text())
    assert after.name == "heron1" and isinstance(after.identified, FittedBoat) and after.setup == before.setup
    with pytest.raises(UsvlearnError, match="run/fit: is the folder of a fit: give that of its run, run"):
        work(["run/fit"])
    for name, each in saved["quantities"].items():
        assert after.identified[name][:3] == tuple(math.nan if x is None else x for x in list(each.values())[:3]), name
    tables = after.model.tables
    for side in ("left", "right"):
        full = float(
            np.sum([after.model.coefficients[f"thrust_{kind}_{side}"] for kind in ("linear", "quadratic", "cubic")])
        )
        full += tables.thrust[side][-1] + sum(
            after.model.coefficients.get(f"thrust_even_{kind}_{side}", 0.0) for kind in ("linear", "quadratic")
        )
        assert full == pytest.approx(after.identified[f"thrust_full_{side}"].value, rel=1e-9)
    commands = [
        ["export", "run/fit", "--boat", "heron1", "--to", "json,c,mat"],
        ["controller", "run/fit", "--boat", "heron2", "--boats", "5"],
        ["plan", "run/fit", "--boat", "heron1", "--minutes", "2", "--out", str(tmp_path)],
    ]
    for command in commands:
        ran(*command, folder=folder, script=SCRIPT)
    document = json.loads(Path("run/fit/export/heron1.json").read_text())
    assert (
        document["tables"]["drag_table"]["value"] == [0.0, *tables.drag] and len(document["covariance"]["matrix"]) > 40
    )
    boat = Path("run/fit/checkpoints/heron1")
    online = Online.open(boat)
    fit = after.identified["steady_speed_full"]
    assert online.identified()["steady_speed_full"].value == pytest.approx(fit.value, rel=0.05)
    assert newest(boat)[2].name == "fit.safetensors"  # `live --start`
    assert math.isfinite(online.step(Sample(Inputs(0.5, 0.5, 0.0, 0.0, 0.4), 1.0, True, True)))


def test_it_says_which_open_loop_simulation_to_use(folder, monkeypatch):
    monkeypatch.chdir(folder)
    if not Path("run/fit").exists():
        work(["run"])
    results = json.loads(Path("run/results.json").read_text())
    for boat in ("heron1", "heron2"):
        mode = json.loads(Path(f"run/fit/{boat}.fit.json").read_text())["simulation"]
        assert results["fit"][boat]["simulation"] == mode and results["fit"][boat]["terms"].split(", wear")[0] in SETS
        assert mode["missions"] == 2 and mode["error"] is None and mode["used"] == "ensemble"  # too few to decide
        assert mode["ensemble"] == pytest.approx(results["free"][boat]["ensemble"], rel=1e-9) and mode["fit"] < 0.2


def test_other_logs_than_those_of_the_run_are_used_and_said(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    work(["run", "--boat", "heron1", "--terms", "cubic", "--out", str(tmp_path), "data.seed=5"])
    said = capsys.readouterr()
    assert (
        "heron1: " in said.err
        and "001_" in said.err
        and "the run has not learned these logs as they are now" in said.err
    )
    assert json.loads((tmp_path / "heron1.fit.json").read_text())["simulation"] is None


def test_a_fit_that_is_stopped_keeps_the_sets_that_are_done(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    before = Missions.fit

    def interrupted(self, terms, *started):
        if terms == "thrust curves":
            raise Stopped(signal.SIGINT)
        return before(self, terms, *started)

    monkeypatch.setattr(Missions, "fit", interrupted)
    with pytest.raises(SystemExit) as end:
        work(["run", "--boat", "heron1", "--out", str(tmp_path)])
    assert end.value.code == 130
    assert "Stopped after 3 of 6 sets of terms." in " ".join(capsys.readouterr().out.split())
    assert list(json.loads((tmp_path / "heron1.fit.json").read_text())["sets"])[:3] == ["nine", "cubic", "even"]
