"""A run's folder: a stop between two writes, damage, strangers' files never change what a resumed run learns."""

import itertools
import json
import os
import warnings
import zipfile

import numpy as np
import pytest
import torch

from tests.support import few
from tests.support.planar_models import lone_filters
from tests.support.recordings import recording
from tests.support.runs import SETTINGS, assert_same, model, published, session
from usvlearn.core import checkpoint
from usvlearn.core.samples import named_leaves
from usvlearn.errors import CheckpointError, ConfigError
from usvlearn.live.recorder import RECORDED
from usvlearn.logs.recordings import align_fleet
from usvlearn.runs import run_folder
from usvlearn.runs.resuming import other_numbers
from usvlearn.runs.run_folder import RunFolder
from usvlearn.runs.saved import configuration, run_folders


class Killed(Exception):
    pass


def dying(monkeypatch, after: int) -> None:
    """The process dies at a write: the file before it is whole, this one is not there."""
    write, count = checkpoint.write_atomically, iter(range(10_000))

    def dies(path, content):
        if next(count) == after:
            raise Killed
        write(path, content)

    monkeypatch.setattr(checkpoint, "write_atomically", dies)
    monkeypatch.setattr(run_folder, "write_atomically", dies)


STOPS = [(True, True, False), (False, False, False), (False, True, True), (True, False, True)]  # every two once


@pytest.mark.parametrize(("elsewhere", "warm", "tracks"), few(STOPS, STOPS[:1], "thorough"))
def test_a_stop_between_any_two_writes_changes_nothing(tmp_path, fleet, monkeypatch, warm, elsewhere, tracks):
    planar = lone_filters() if tracks else None
    season_before = [recording("a", "x", 5.0), recording("b", "x", 5.0)]
    season = session(tmp_path / "season", align_fleet(season_before), planar=planar)
    first = str(season.path) if warm else None
    whole = session(tmp_path / "whole", fleet, first, planar=planar)
    for after in itertools.count():
        killed = False
        folder = tmp_path / f"{after}"
        with monkeypatch.context() as patch:
            dying(patch, after)
            try:
                session(folder, fleet, first, planar=planar)
            except Killed:
                killed = True
        begun = (folder / "runs.json").exists()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it says which checkpoint is missing
            if elsewhere and begun:
                again = session(tmp_path / f"{after}b", fleet, str(folder), planar=planar)
            else:
                again = session(folder, fleet, "latest" if begun else first, planar=planar)
        assert_same(again, whole)
        if not killed:
            break


@pytest.mark.thorough
@pytest.mark.parametrize("damage", ["cut", "flip", "remove", "foreign", "bomb", "header", "plain"])
def test_damaged_predictions_are_made_anew(tmp_path, fleet, damage):
    whole, folder = session(tmp_path / "whole", fleet), session(tmp_path / "run", fleet)
    paths = sorted((folder.path / "predictions").glob("*.npz"))
    middle, content = paths[2], paths[2].read_bytes()
    if damage == "cut":
        middle.write_bytes(content[: len(content) // 2])
    elif damage == "flip":
        middle.write_bytes(content[:80] + bytes([content[80] ^ 255]) + content[81:])
    elif damage == "remove":
        middle.unlink()
    elif damage == "bomb":  # a few kB that unpack to gigabytes, were they read
        with (
            zipfile.ZipFile(middle, "w", zipfile.ZIP_DEFLATED) as archive,
            archive.open("predictions.npy", "w") as file,
        ):
            np.lib.format.write_array_header_2_0(file, {"descr": "<f8", "fortran_order": False, "shape": (10**7,)})
            for _ in range(80):
                file.write(bytes(10**6))
    elif damage == "header":  # an array that claims to be larger than any memory
        with zipfile.ZipFile(middle, "w") as archive, archive.open("predictions.npy", "w") as file:
            np.lib.format.write_array_header_2_0(file, {"descr": "<f8", "fortran_order": False, "shape": (10**15,)})
    elif damage == "plain":
        with middle.open("wb") as file:
            np.save(file, np.ones(3))
    else:
        (folder.path / "predictions" / "notes.npz").write_bytes(b"x")
        (folder.path / "checkpoints" / "a" / "best.safetensors").write_bytes(b"x")
    if damage == "foreign":
        again = session(folder.path, fleet, "latest")
        (folder.path / "checkpoints" / "a" / "best.safetensors").unlink()
    else:
        words = "unpacks to 80 MB, expected 0" if damage == "bomb" else "resuming from before it"
        with pytest.warns(UserWarning, match=words):
            again = session(folder.path, fleet, "latest")
    assert_same(again, whole)


def test_another_interval_of_saving_resumes_too(tmp_path, fleet):
    whole, folder = session(tmp_path / "whole", fleet), session(tmp_path / "run", fleet, save_every=10)
    newest = max((folder.path / "checkpoints" / "a").iterdir())
    newest.write_bytes(b"")
    with pytest.warns(UserWarning, match="resuming from before it"):
        again = session(folder.path, fleet, "latest", save_every=4)
    for ours, theirs in zip(*(published(f, "thrusters") for f in (again, whole)), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    once_more = session(folder.path, fleet, "latest")
    for ours, theirs in zip(*(published(f, "predictions") for f in (once_more, whole)), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_fit_is_forgotten_where_logs_come(tmp_path, fleet):
    first = fleet._replace(runs=fleet.runs[:1])
    path = session(tmp_path / "run", first).path
    fits = [path / "fit" / each for each in ("a.fit.json", "checkpoints/a/fit.safetensors", "my.txt")]
    for each in fits:
        each.parent.mkdir(parents=True, exist_ok=True)
        each.write_text("{}")
    session(path, first, "latest")
    assert all(each.exists() for each in fits)
    session(path, fleet, "latest")
    assert [each.exists() for each in fits] == [False, False, True]


def test_runs_are_never_mixed(tmp_path, fleet):
    run = session(tmp_path / "run", fleet)
    other = align_fleet([recording("a", "one", 6.0, speed=0.5), recording("b", "one", 9.0)])
    swapped = {"estimators": {"rls": 2, "aid": 1}, "combiners": {}}
    for wrong in ({"fleet": other}, {"fleet": fleet, "configuration": swapped}):
        with pytest.raises(ConfigError, match=r"another hydra\.run\.dir"):
            session(run.path, resume="latest", **wrong)
    busy = session(tmp_path / "busy", other)
    with pytest.raises(ConfigError, match="already holds"):
        session(busy.path, fleet, str(run.path))
    with pytest.raises(ConfigError, match="already holds"):
        session(run.path, fleet)
    with pytest.raises(CheckpointError, match="has no checkpoint of c"):
        session(tmp_path / "new", align_fleet([recording("a", "one", 4.0), recording("c", "one", 4.0)]), str(run.path))


def test_a_new_season_starts_from_the_newest_parameters(tmp_path, fleet):
    run = session(tmp_path / "run", fleet)
    other = align_fleet([recording("a", "new", 6.0, speed=0.5), recording("b", "new", 9.0)])
    folder = RunFolder(tmp_path / "next", other, model(), SETTINGS["configuration"])
    start = folder.begin(model().init((2,)), str(run.path))
    for element, boat in enumerate(("a", "b")):
        newest = checkpoint.load(checkpoint.checkpoints(run.path / "checkpoints" / boat)[-1])[0]
        for name, leaf in named_leaves(start.state):
            assert torch.equal(leaf[element], torch.from_numpy(newest[name])), (boat, name)


def test_a_set_that_tells_nothing_of_its_boat_is_a_start(tmp_path, fleet):
    """As `Online` saves it."""
    path = checkpoint.save(tmp_path / "a.safetensors", model().init(), estimator="Ensemble")
    folder = RunFolder(tmp_path / "next", fleet, model(), SETTINGS["configuration"])
    assert folder.begin(model().init((2,)), str(path)).note == f"starting from a checkpoint, {path}"


def test_a_record_keeps_its_monitors_and_names_the_numbers_that_differ(tmp_path, fleet):
    """Else its replay would give other predictions, without a word."""
    one = model()
    facts = {"estimator": "Ensemble", "run": RECORDED, "kernel": one.description()}
    path = checkpoint.save(tmp_path / "a.safetensors", one.init(), **facts)
    folder = RunFolder(tmp_path / "next", fleet, model(), SETTINGS["configuration"])
    assert folder.begin(model().init((2,)), str(path)).note == f"starting from record, {path}"
    assert other_numbers({**facts, "run": "live", "kernel": {}}, one.description()) == ""
    kernel = {**one.description(), "output": "another", "members": {}}
    told = other_numbers({**facts, "kernel": kernel}, one.description())
    assert told.startswith("; its predictions were made with other numbers (") and "there, " in told


@pytest.mark.parametrize("foreign", [{"configuration": []}, {}], ids=str)
def test_a_set_without_a_configuration_is_passed_over(tmp_path, fleet, foreign):
    run = session(tmp_path / "run", fleet)
    newest = max((run.path / "checkpoints" / "a").iterdir())
    leaves, facts = checkpoint.load(newest)
    checkpoint.save(newest, leaves, **{key: value for key, value in facts.items() if key != "configuration"} | foreign)
    assert configuration(run.path) == SETTINGS["configuration"]


def shuffled(tmp_path, rng) -> None:
    """The clock told anything while all files were written."""
    for path in tmp_path.rglob("*"):
        os.utime(path, (float(rng.uniform(0, 2e9)),) * 2)


def began(folder) -> int:
    return json.loads((folder / "runs.json").read_text())["began"]["number"]


def test_the_latest_run_is_the_one_that_began_last_whatever_the_clock_says(tmp_path, fleet, monkeypatch):
    rng = np.random.default_rng(0)
    for k, name in enumerate("cab"):
        monkeypatch.setattr(run_folder.time, "time", lambda k=k: 2e9 - 1e8 * k)  # set back before each run
        session(tmp_path / name, fleet)
    assert [began(tmp_path / name) for name in "cab"] == [1, 2, 3]
    other = align_fleet([recording("a", "new", 6.0, speed=0.5), recording("b", "new", 9.0)])
    for k in range(5):
        shuffled(tmp_path, rng)
        new = RunFolder(tmp_path / f"new{k}", other, model(), SETTINGS["configuration"])
        assert new._resumption.latest() == tmp_path / ("b" if k == 0 else f"new{k - 1}")
        new.begin(model().init((2,)), "latest")
    assert [path.name for path in run_folders(tmp_path)] == [*"cab", "new0", "new1", "new2", "new3", "new4"]


def test_a_run_that_went_on_is_the_latest(tmp_path, fleet):
    for name in ("first", "second"):
        session(tmp_path / name, fleet)
    session(tmp_path / "first", fleet, "latest")
    assert (began(tmp_path / "first"), began(tmp_path / "second")) == (3, 2)
    shuffled(tmp_path, np.random.default_rng(1))
    assert (
        RunFolder(tmp_path / "next", fleet, model(), SETTINGS["configuration"])._resumption.latest()
        == tmp_path / "first"
    )
    elsewhere = session(tmp_path / "other" / "run", fleet, str(tmp_path / "first"))
    assert began(elsewhere.path) == 4  # later than what it goes on from, wherever that is


def test_runs_without_a_record_of_their_beginning(tmp_path, fleet):
    """Those of an older version: the one with the newest checkpoint, as before, and before any that has the record."""
    for k, name in enumerate(("old", "older")):
        folder = session(tmp_path / name, fleet).path
        content = json.loads((folder / "runs.json").read_text())
        del content["began"]
        (folder / "runs.json").write_text(json.dumps(content))
        for path in folder.rglob("*.*"):
            os.utime(path, (1e9 - k, 1e9 - k))
    latest = RunFolder(tmp_path / "next", fleet, model(), SETTINGS["configuration"])._resumption.latest
    assert latest() == tmp_path / "old"
    for number in ("3", None, True, -1, 1e300, [1]):
        content["began"] = {"number": number}
        (tmp_path / "older" / "runs.json").write_text(json.dumps(content))
        os.utime(tmp_path / "older" / "runs.json", (1e9 - 1, 1e9 - 1))
        assert latest() == tmp_path / "old", number
    session(tmp_path / "new", fleet)
    shuffled(tmp_path, np.random.default_rng(2))
    assert began(tmp_path / "new") == 1 and latest() == tmp_path / "new"


def test_of_two_that_began_at_once_the_one_that_came_further_is_the_latest(tmp_path, fleet):
    for name in ("z", "a"):
        session(tmp_path / name, fleet)
        content = json.loads((tmp_path / name / "runs.json").read_text()) | {"began": {"number": 1}}
        (tmp_path / name / "runs.json").write_text(json.dumps(content))
    for boat in "ab":
        checkpoint.checkpoints(tmp_path / "z" / "checkpoints" / boat)[-1].unlink()
    for seed in range(10):
        shuffled(tmp_path, np.random.default_rng(seed))
        assert (
            RunFolder(tmp_path / "next", fleet, model(), SETTINGS["configuration"])._resumption.latest()
            == tmp_path / "a"
        )
