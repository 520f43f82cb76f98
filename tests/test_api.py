"""The few lines of Python from logs to predictions: the same numbers as train.py, tables, saved checkpoints, and
errors.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from hydra import compose, initialize_config_dir

import usvlearn
from tests.support import ROOT
from usvlearn import AID, Ensemble, Inputs, Online, Persistence, Sample
from usvlearn.cli import train
from usvlearn.core import checkpoint
from usvlearn.core.samples import UNITS, html_table, named_leaves, tree_map
from usvlearn.errors import CheckpointError, ConfigError, MissingExtraError, UsvlearnError
from usvlearn.learned import AlignedLogs, Learned

HEAD = "time,L,R,heading,speed"
SEASON = {"n": 2, "hours": 0.0667, "mission_minutes": 2.0}
CHANNELS = {
    name: {"name": column} for name, column in (("command_left", "L"), ("command_right", "R"), ("surge", "speed"))
}


@pytest.fixture(scope="module")
def logs() -> AlignedLogs:
    return usvlearn.read(data="simulated", **SEASON)


@pytest.fixture(scope="module")
def learned(logs) -> Learned:
    return usvlearn.learn(logs)


def test_it_finds_what_the_command_finds(logs, learned, tmp_path):
    """The same ensemble over the same samples: equal scores, predictions and states, bit by bit."""
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        cfg = compose("train", [f"data.{key}={value}" for key, value in SEASON.items()])
    train.work(cfg, tmp_path / "run", [], quiet=True)
    assert json.loads((tmp_path / "run" / "results.json").read_text())["boats"] == json.loads(
        json.dumps(learned.scores)
    )
    files = [np.load(path) for path in sorted((tmp_path / "run" / "predictions").glob("*.npz"))]
    for element, boat in enumerate(learned.boats):
        mine = [run for run in learned.predictions if run.boat == boat]
        lengths = [len(run.time) for run in logs.fleet.runs]
        for key, part in (("predictions", "predicted"), ("halfwidths", "halfwidth")):
            theirs = np.split(np.concatenate([file[key][:, element] for file in files]), np.cumsum(lengths)[:-1])
            for run, whole in zip(mine, theirs, strict=True):
                assert list(getattr(run, part)) == list(learned.ensemble.names)
                ours = np.stack(list(getattr(run, part).values()), -1)
                np.testing.assert_array_equal(ours, whole[: len(run.time)])
        newest = checkpoint.checkpoints(tmp_path / "run" / "checkpoints" / boat)[-1]
        leaves, facts = checkpoint.load(newest)
        path = learned.save(tmp_path / f"{boat}.safetensors", boat)
        arrays, said = checkpoint.load(path)
        assert all(np.array_equal(arrays[name], leaf, equal_nan=True) for name, leaf in leaves.items())
        assert facts["configuration"] == logs.settings | {"resume": None}
        assert said == {key: value for key, value in facts.items() if key != "configuration"}


def test_logs_can_be_looked_at(logs):
    assert logs.boats == ("heron1", "heron2") and [run.boat for run in logs.runs] == [*logs.boats] * 2
    first = logs.runs[0]
    assert first.columns.keys() == UNITS.keys()
    assert all(isinstance(column, np.ndarray) and column.shape == first.time.shape for column in first.columns.values())
    assert first.time[0] == 0 and np.diff(first.time).min() == pytest.approx(0.4)
    assert (
        np.isnan(first.columns["surge"]).any() and (np.isnan(first.columns["surge"]) == ~first.samples.measured).all()
    )
    shown = str(logs)
    assert all(word in shown for word in ("heron2", first.name, "measured", "Rejected", "lost"))
    assert logs.rejected["heron1"]["surge"]["lost"] > 0


def test_predictions_are_time_series_with_intervals(learned):
    inside, steps = 0, 0
    for run in learned.predictions:
        low, high = run.interval()
        counted = np.isfinite(run.measured) & np.isfinite(run.predicted["ensemble"])
        assert run.time.shape == run.measured.shape == low.shape and (low <= high)[counted].all()
        inside += ((low <= run.measured) & (run.measured <= high))[counted].sum()
        steps += counted.sum()
    assert steps > 1000 and 0.85 < inside / steps < 0.95
    assert all(word in str(learned) for word in ("skill", "heron2", "joint", "Rejected"))
    with pytest.raises(ConfigError, match=r"interval: found 'esnemble', expected one of .*did you mean ensemble"):
        learned.predictions[0].interval("esnemble")


def test_a_simulation_is_told_the_speed_where_a_segment_starts_and_no_other(logs, learned):
    deaf = AlignedLogs(logs.fleet._replace(runs=tuple(map(_without_speeds, logs.fleet.runs))), logs.settings)
    free, driven = learned.simulate(deaf), learned.simulate(logs)
    for one, other in zip(free.predictions, driven.predictions, strict=True):
        for name in learned.ensemble.names:
            np.testing.assert_array_equal(one.predicted[name], other.predicted[name])
        assert not other.halfwidth and np.nanmax(abs(other.predicted["joint"])) < 5
    for boat in logs.boats:
        assert driven.scores[boat]["persistence"]["mae"] > 2 * driven.scores[boat]["joint"]["mae"]
    assert "Simulation" in str(driven) and "joint" in str(driven)


def _without_speeds(run):
    surge = np.where(run.samples.inputs.dt == 0, run.samples.surge, 7.0)
    return run._replace(samples=run.samples._replace(surge=surge))


def written(folder: Path) -> Path:
    """Two logs of a boat that accelerates and slows."""
    folder.mkdir()
    for name, phase in (("run_1", 0.0), ("run_2", 1.0)):
        k = np.arange(1200)
        command = 0.5 + 0.4 * np.sin(0.02 * k + phase)
        speed = np.convolve(np.r_[np.zeros(19), command], np.full(20, 0.1), "valid")
        rows = [f"{0.1 * i:.1f},{c:.4f},{c:.4f},90,{v:.4f}" for i, c, v in zip(k, command, speed, strict=True)]
        (folder / f"{name}.csv").write_text("\n".join([HEAD, *rows]))
    return folder


@pytest.mark.thorough
def test_a_saved_set_goes_on_by_learn_and_by_online(tmp_path):
    folder = written(tmp_path / "heron")
    whole = usvlearn.learn(usvlearn.read(folder, channels=CHANNELS))
    first = usvlearn.learn(usvlearn.read(folder / "run_1.csv", channels=CHANNELS, boat="heron"))
    path = first.save(tmp_path / "sets" / "heron.safetensors")
    other = usvlearn.read(str(folder / "run_2.csv"), "csv", channels=CHANNELS)
    for start in (path, path.parent, {"run_2": str(path)}):
        second = usvlearn.learn(other, start=start)
        for name, series in second.predictions[0].predicted.items():
            np.testing.assert_array_equal(series, whole.predictions[1].predicted[name])
    boat = Online.open(path)
    aboard = dict(boat.state)
    assert {name for name, _ in named_leaves(first.state)} == aboard.keys()
    for name, leaf in named_leaves(first.state):
        np.testing.assert_array_equal(leaf[0].numpy(), aboard[name], err_msg=name)
    samples, expected = other.runs[0].samples, second.predictions[0].predicted["ensemble"]
    online = [boat.step(tree_map(lambda leaf, k=k: leaf[k], samples)) for k in range(20)]
    np.testing.assert_array_equal(np.where(np.isnan(expected[:20]), np.nan, online), expected[:20])


def test_boats_are_named_by_a_mapping(tmp_path):
    folder = written(tmp_path / "logs")
    read = usvlearn.read({"anna": folder / "run_1.csv", "bert": folder / "run_2.csv"}, channels=CHANNELS, mass=20.0)
    assert read.boats == ("anna", "bert") and read.settings["estimators"]["aid"]["mass"] == 20.0
    learned = usvlearn.learn(read, AID(mass=20.0))
    assert learned.ensemble.names == ("aid", "persistence", "ensemble")
    for boat in read.boats:
        assert learned.scores[boat]["ensemble"] == learned.scores[boat]["aid"]
        assert learned.scores[boat]["aid"]["skill"] > 0.4
    alone = usvlearn.learn(usvlearn.read(folder / "run_2.csv", channels=CHANNELS), AID(mass=20.0))
    np.testing.assert_array_equal(alone.predictions[0].predicted["aid"], learned.predictions[1].predicted["aid"])


def test_an_ensemble_is_taken_as_it_is(logs):
    ensemble = Ensemble({"slow": AID(gain=0.3)})
    learned = usvlearn.learn(logs, ensemble)
    assert learned.ensemble is ensemble and learned.scores["heron1"]["slow"]["skill"] is None
    assert usvlearn.learn(logs, Persistence()).ensemble.names == ("persistence", "ensemble")


WRONG = {
    "data": (lambda folder: usvlearn.read(folder, "bluebot"), "data: found 'bluebot'.*did you mean blueboat"),
    "path": (lambda folder: usvlearn.read(folder / "none.csv"), r"none\.csv does not exist"),
    "several paths": (lambda folder: usvlearn.read([folder]), r"found list, expected a path, a pattern, a dictionary"),
    "no path": (lambda folder: usvlearn.read(), "data.path is not set"),
    "mass": (lambda folder: usvlearn.read(folder, mass=-1), "mass: found -1, expected a positive number of kg"),
    "top speed": (lambda folder: usvlearn.read(folder, surge_max=0), "surge_max: found 0"),
    "grid": (lambda folder: usvlearn.read(folder, align={"dtt": 1}), "align.dtt: found no such option.*align.dt"),
    "key": (lambda folder: usvlearn.read(folder, chanels={}), "data.chanels: .*did you mean data.channels"),
    "channel": (lambda folder: usvlearn.read(folder, channels={"surg": {}}), "data.channels: found 'surg'.*surge"),
    "value": (lambda folder: usvlearn.read(folder, boat=object()), "boat: "),
    "column": (lambda folder: usvlearn.read(folder), "no channel 'command_left'"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_read_is_told_in_one_sentence(case, tmp_path):
    call, words = WRONG[case]
    (tmp_path / "log.csv").write_text("\n".join([HEAD, *(f"{k / 10},0.5,0.5,90,{k / 100}" for k in range(100))]))
    with pytest.raises(UsvlearnError, match=words) as caught:
        call(tmp_path)
    assert "\n" not in str(caught.value)


def test_what_cannot_be_learned_saved_or_simulated_is_told(logs, learned, tmp_path):
    with pytest.raises(ConfigError, match="estimator: found 3"):
        usvlearn.learn(logs, 3)
    with pytest.raises(ConfigError, match="boat: found none, expected one of heron1, heron2"):
        learned.save(tmp_path / "a.safetensors")
    with pytest.raises(ConfigError, match="boat: found 'anna', of which nothing was learned, expected one of heron1"):
        learned.save(tmp_path / "a.safetensors", "anna")
    with pytest.raises(ConfigError, match="found 'otter', of which nothing was learned"):
        learned.simulate(usvlearn.read(data="simulated", plant="otter", hours=0.05))
    path = learned.save(tmp_path / "a.safetensors", "heron1")
    with pytest.raises(ConfigError, match="start: found nothing for heron2"):
        usvlearn.learn(logs, start={"heron1": path})
    with pytest.raises(CheckpointError, match="does not fit this estimator"):
        usvlearn.learn(logs, AID(), start=path)
    assert not {each.name for each in tmp_path.iterdir()} - {"a.safetensors"}


def test_names_that_nothing_has_are_errors(learned):
    for each in (usvlearn, learned):
        with pytest.raises(AttributeError, match=r"no attribute 'forecasted'$"):
            each.forecasted  # noqa: B018


def test_a_path_is_not_taken_for_logs(learned, tmp_path):
    for call in (usvlearn.learn, learned.simulate):
        with pytest.raises(ConfigError, match=r"logs: found 'a\.csv', expected what usvlearn\.read returns"):
            call("a.csv")


def test_the_only_boat_is_not_saved_under_another_name(tmp_path):
    """Its checkpoint serves logs of any boat in a simulation, but a name that is given must be its own."""
    alone = usvlearn.learn(usvlearn.read(data="simulated", hours=0.05), AID(mass=28.0))
    with pytest.raises(ConfigError, match="boat: found 'herno', of which nothing was learned, expected one of heron"):
        alone.save(tmp_path / "a.safetensors", "herno")
    assert not list(tmp_path.iterdir())
    other = alone.simulate(usvlearn.read(data="simulated", plant="otter", hours=0.05))
    assert other.scores.keys() == {"otter"}


def test_a_real_log(real_logs, tmp_path):
    """One of the BlueBoat's: better than persistence, one step ahead and, in simulation, by far."""
    log = sorted((real_logs / "blueboat").rglob("*.csv"))[0]
    logs = usvlearn.read(log, "blueboat")
    learned = usvlearn.learn(logs)
    (scores,) = learned.scores.values()
    assert scores["ensemble"]["skill"] > 0.1 and 0.85 < scores["ensemble"]["coverage"] < 0.95
    (free,) = learned.simulate(logs).scores.values()
    assert free["joint"]["mae"] < 0.5 * free["persistence"]["mae"]
    assert Online.open(learned.save(tmp_path / "blueboat.safetensors")).names == learned.ensemble.names


def test_logs_become_tables_and_tables_are_learned_from(logs, monkeypatch):
    pandas = pytest.importorskip("pandas", reason="needs the package pandas")
    frame, first = logs.to_pandas(), logs.runs[0].to_pandas()
    assert len(frame) == sum(len(run.time) for run in logs.runs) and frame.groupby(["boat", "run"]).ngroups == 4
    assert first.attrs["units"]["heading"].startswith("rad") and (first["time"] == logs.runs[0].time).all()
    own = first[["time", "command_left", "command_right", "heading", "surge"]]
    again, before = (usvlearn.learn(each, AID(mass=28.0)).predictions[0] for each in (own, logs))
    tables = again.to_pandas(), before.to_pandas()
    one, other = ((each["measured"] - each["aid"]).abs().mean() for each in tables)
    assert one == pytest.approx(other, rel=0.15)  # read as messages, the steps come a step late
    assert (tables[0]["aid"] - tables[0]["aid_halfwidth"]).equals(pandas.Series(again.interval("aid")[0]))
    monkeypatch.setitem(sys.modules, pandas.__name__, None)
    with pytest.raises(MissingExtraError, match=r"usvlearn\[tables\]"):
        logs.to_pandas()


def test_a_notebook_shows_tables_and_escapes_names(learned):
    assert "<pre>" in learned._repr_html_() and "heron2" in learned.logs._repr_html_()
    assert "&lt;b&gt;" in html_table([("<b>", "1")])


NOW = Inputs(command_left=0.5, command_right=0.5, heading=0.0, yaw_rate=0.0, dt=0.4)
SAMPLE = Sample(NOW, surge=1.2, fresh=True, measured=True)
NO_STEP = {
    "dt is 0: the sample starts a segment": SAMPLE._replace(inputs=NOW._replace(dt=0.0)),
    "it has no speed to start from": SAMPLE._replace(inputs=NOW._replace(dt=0.0), surge=np.nan),
    "fresh is False": SAMPLE._replace(fresh=False, measured=False),
    "command_left is nan, expected -100 to 100": SAMPLE._replace(inputs=NOW._replace(command_left=np.nan)),
    "dt is -0.4, expected 0 to 10000": SAMPLE._replace(inputs=NOW._replace(dt=-0.4)),
    "": SAMPLE,
}


@pytest.mark.parametrize("words", NO_STEP)
def test_an_online_says_why_it_predicts_nothing(words):
    boat = Online(AID(mass=28.0))
    assert boat.why == "no step was made yet" and "none yet" in repr(boat)
    boat.step(SAMPLE)
    predicted = boat.step(NO_STEP[words])
    assert np.isfinite(predicted) == (not words) and words in boat.why and bool(words) == bool(boat.why)
    assert (words or "m/s") in repr(boat) and "<th>last step" in boat._repr_html_()


def test_why_of_a_batch_has_an_entry_for_each_boat():
    boats = Online(AID(mass=28.0), batch=(2,))
    boats.step(SAMPLE._replace(inputs=NOW._replace(heading=np.array([0.0, np.inf]))))
    assert boats.why[0] == "" and boats.why[1].startswith("heading is inf")
