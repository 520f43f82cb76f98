"""Sweeps: jobs known by their settings, killed ones that go on, failures that are told, launchers, the leaderboard."""

import json
import math
import os
import re
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.experimental.callback import Callback
from hydra.utils import instantiate
from omegaconf import OmegaConf

from tests.support import ROOT, few
from tests.support.commands import (
    ENVIRONMENT,
    QUICK,
    assert_equal_runs,
    command,
    hparams,
    load,
    never,
    results,
    run,
    table,
)
from usvlearn import Ensemble
from usvlearn.display.tensorboard import LONGEST
from usvlearn.errors import ConfigError, MissingExtraError, bad_input
from usvlearn.evaluation.metrics import scores
from usvlearn.sweeps.jobs import Job, digest, jobs, run_job
from usvlearn.sweeps.launchers import check_launcher
from usvlearn.sweeps.leaderboard import leaderboard, write_leaderboard

SWEEPS = sorted(p.stem for p in (ROOT / "configs" / "sweep").glob("*.yaml"))
LAUNCHED = {**ENVIRONMENT, "PYTHONPATH": str(ROOT)}
LAUNCHED.pop("OMP_NUM_THREADS")


def without_seconds(rows: list[dict]) -> list[dict]:
    return [{key: value for key, value in row.items() if key != "seconds"} for row in rows]


GRID = ["sweep=inputs", "align.inputs=mean,last", "estimators.sift_map.memory=5,-1", *QUICK, "hydra.sweep.dir=sweep"]


@pytest.fixture(scope="module")
def swept(tmp_path_factory) -> Path:
    """An uninterrupted sweep, named by its file and started without -m; two of its four jobs are not legal."""
    folder = tmp_path_factory.mktemp("swept")
    done = run(*GRID, folder=folder)
    assert done.returncode == 2 and "Traceback" not in done.stderr, done.stderr
    assert len(re.findall(r"^job \d \(.*\): 0\.\d+ m/s", done.stdout, re.M)) == 2
    assert "2 of 4 done, 2 failed\n" in done.stdout and "results and checkpoints" not in done.stdout
    (folder / "output.txt").write_text(done.stdout)
    return folder


@pytest.mark.thorough
def test_leaderboard_of_a_sweep(swept):
    rows = table(swept / "sweep")
    assert [(row["align.inputs"], row["estimators.sift_map.memory"]) for row in rows[2:]] == [
        ("mean", "-1"),
        ("last", "-1"),
    ]
    assert "data.hours" not in rows[0] and float(rows[0]["objective"]) <= float(rows[1]["objective"])
    for row in rows[:2]:
        saved = results(swept / "sweep" / row["job"])
        for name, each in saved["boats"]["heron"].items():
            assert float(row[f"mae/{name}"]) == each["mae"]
        assert row["measure"] == "sift_map.mae" and row["objective"] == row["mae/sift_map"] != row["mae/ensemble"]
        assert float(row["seconds"]) == saved["seconds"] and row["error"] == ""
    assert all(row["error"] == "estimators.sift_map.memory: found -1.0, expected a positive number" for row in rows[2:])
    again = run("runs=sweep", folder=swept, script="evaluate.py")
    assert again.returncode == 0 and table(swept / "sweep") == rows
    for text in ((swept / "output.txt").read_text(), again.stdout):
        assert "MAE of sift_map, m/s, mean over boats" in text
        assert re.search(r"^job +inputs +memory +MAE +difference +s$", text, re.M)
        assert re.search(r"^2 +last +5 ", text, re.M) and re.search(r"^0 +mean +5 ", text, re.M)
        failed = (
            "failed: job 3, align.inputs=last sift_map.memory=-1: estimators.sift_map.memory: found -1.0, expected a "
        )
        assert f"{failed}positive number" in text


@pytest.mark.thorough
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
def test_a_killed_sweep_goes_on_and_equals_an_uninterrupted_one(swept, tmp_path):
    process = subprocess.Popen(
        command(*GRID), cwd=tmp_path, env=ENVIRONMENT, start_new_session=True, stdout=subprocess.DEVNULL
    )
    sweep, began = tmp_path / "sweep", time.monotonic()
    while len(list(sweep.glob("2/checkpoints/heron/*.safetensors"))) < 2 and process.poll() is None:
        assert time.monotonic() - began < 300
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not (sweep / "2" / "results.json").exists() and not (sweep / "leaderboard.csv").exists()
    stamp = (sweep / "0" / "results.json").stat().st_mtime_ns
    done = run(*GRID, folder=tmp_path)
    assert done.returncode == 2 and "4 jobs, 1 of them finished before: sweep\n" in done.stdout, done.stderr
    assert (sweep / "0" / "results.json").stat().st_mtime_ns == stamp
    for job in ("0", "2"):
        assert_equal_runs(sweep / job, swept / "sweep" / job)
    ours, theirs = (without_seconds(table(folder / "sweep")) for folder in (tmp_path, swept))
    assert ours == theirs
    ours, theirs = (re.sub(r"  +(\d+\.\d|s)\n|─+", "\n", text[text.index("MAE of") :])  # the seconds, and their width
                    for text in (done.stdout, (swept / "output.txt").read_text()))  # fmt: skip
    assert ours == theirs


class Probe(Callback):
    """Notes in a job's folder with how many threads its worker computes, and what it hands to Hydra."""

    def on_job_end(self, config, job_return, **_) -> None:
        facts = {
            "returned": job_return.return_value,
            "torch": torch.get_num_threads(),
            "openblas": os.environ.get("OPENBLAS_NUM_THREADS"),
            "pid": os.getpid(),
        }
        (Path(config.hydra.runtime.output_dir) / "probe.json").write_text(json.dumps(facts))


@pytest.mark.parametrize("launcher", few(["joblib", "submitit_local"], []))
def test_launchers_do_the_same_in_workers_of_one_thread(launcher, swept, tmp_path):
    pytest.importorskip({"joblib": "joblib", "submitit_local": "submitit"}[launcher])
    arguments = [*GRID, "align.inputs=mean", f"hydra/launcher={launcher}"]
    arguments += ["+hydra.callbacks.probe._target_=tests.sweeps.test_jobs.Probe"]
    arguments.remove("align.inputs=mean,last")
    process = subprocess.run(command(*arguments), cwd=tmp_path, env=LAUNCHED, capture_output=True, text=True)
    assert process.returncode == 2 and "Traceback" not in process.stderr, process.stderr
    assert "Warning" not in process.stderr
    assert_equal_runs(tmp_path / "sweep" / "0", swept / "sweep" / "0")
    assert results(tmp_path / "sweep" / "1") == results(swept / "sweep" / "1")
    probe = json.loads((tmp_path / "sweep" / "0" / "probe.json").read_text())
    assert (probe["torch"], probe["openblas"]) == (1, "1")
    assert probe["returned"] == results(tmp_path / "sweep" / "0")["boats"]["heron"]["sift_map"]["mae"]
    assert [row["error"] == "" for row in table(tmp_path / "sweep")] == [True, False]


def test_a_launcher_that_cannot_be_used_is_told_in_one_sentence(monkeypatch, tmp_path):
    done = run("-m", "hydra/launcher=sulrm", folder=tmp_path)
    assert done.returncode == 2 and not list(tmp_path.iterdir())
    assert done.stderr.startswith("error: hydra/launcher: found 'sulrm', expected one of basic, joblib, slurm")
    assert len(done.stderr.splitlines()) == 1
    monkeypatch.setattr("usvlearn.sweeps.launchers.find_spec", lambda name: None)
    for name, extra in {"joblib": "sweep", "slurm": "slurm", "submitit_local": "slurm"}.items():
        with pytest.raises(MissingExtraError, match=rf"hydra/launcher={name} needs .* 'usvlearn\[{extra}\]'"):
            check_launcher([f"hydra/launcher={name}"])
    monkeypatch.setattr("usvlearn.sweeps.launchers.find_spec", lambda name: name)
    monkeypatch.setattr("usvlearn.sweeps.launchers.which", lambda name: None)
    check_launcher(["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"])
    with pytest.raises(ConfigError, match="found no srun and sbatch, expected a Slurm cluster"):
        check_launcher(["hydra/launcher=slurm"])


@pytest.mark.thorough
@pytest.mark.parametrize("name", few(SWEEPS, {"inputs", "none"}, "thorough"))
def test_every_value_of_every_sweep_composes_and_instantiates(name):
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        whole = compose("train", [f"sweep={name}"], return_hydra_config=True)
        params = whole.hydra.sweeper.get("params") or {}
        assert bool(params) == (name != "none") == (OmegaConf.select(whole, "hydra.mode") is not None)
        for key, values in params.items():
            for value in values.split(","):
                cfg = compose("train", [f"{key}={value}"])
                Ensemble(instantiate(cfg.estimators), instantiate(cfg.combiners, _convert_="all"), cfg.output)
                assert str(OmegaConf.select(cfg, key)) == value


SETTINGS = {"dt": 0.4, "resume": None}


def attempt(folder: Path, work, settings=SETTINGS, overrides=("dt=0.4",)) -> float:
    return run_job(folder, settings, overrides, work)


def finish(folder: Path, objective: float = 0.03):
    """What a job does: it notes that it has begun, and what it found."""

    def work(resume):
        (folder / "runs.json").write_text("{}")
        (folder / "results.json").write_text(json.dumps({"boats": {}, "objective": objective, "resumed": resume}))
        return objective

    return work


def test_a_job_is_done_once_and_gone_on_with_if_it_was_begun(tmp_path):
    assert attempt(tmp_path, finish(tmp_path)) == 0.03 and results(tmp_path)["resumed"] is None
    assert attempt(tmp_path, never) == 0.03
    (tmp_path / "results.json").write_text('{"boats": {"heron"')  # the disk was full
    assert attempt(tmp_path, finish(tmp_path)) == 0.03 and results(tmp_path)["resumed"] == str(tmp_path)
    (tmp_path / "results.json").write_text('{"boats": {}, "objective": null}')  # it diverged
    assert np.isnan(attempt(tmp_path, never))


def test_a_finished_tuning_is_not_taken_for_a_job_of_other_settings(tmp_path, capsys):
    """A tuning leaves results, and no file of runs."""

    def tune(resume) -> float:
        content = {"boats": {"heron": {"aid": {"mae": 0.03}}}, "objective": 0.03, "output": "aid"}
        (tmp_path / "results.json").write_text(json.dumps(content))
        return 0.03

    assert attempt(tmp_path, tune) == 0.03 and not (tmp_path / "runs.json").exists()
    assert np.isnan(attempt(tmp_path, never, {"a": 2}, ["a=2"]))
    assert "holds another job" in capsys.readouterr().err


def test_a_failed_job_is_recorded_and_tried_again(tmp_path, capsys):
    def bad(resume):
        raise ConfigError("dt: found -1, expected more")

    def bug(resume):
        raise ZeroDivisionError("of nothing")

    assert np.isnan(attempt(tmp_path, bad)) and results(tmp_path) == {"error": "dt: found -1, expected more"}
    assert not (tmp_path / "traceback.txt").exists()
    assert np.isnan(attempt(tmp_path, bug)) and results(tmp_path)["error"].startswith("ZeroDivisionError: of nothing")
    assert "in bug" in (tmp_path / "traceback.txt").read_text()
    assert "Traceback" not in capsys.readouterr().err
    assert attempt(tmp_path, finish(tmp_path)) == 0.03 and not (tmp_path / "traceback.txt").exists()


def test_a_folder_with_another_job_is_left_as_it_is(tmp_path, capsys):
    job = tmp_path / "3"
    attempt(job, finish(job))
    before = {path: path.read_bytes() for path in job.iterdir()}
    for broken in (False, True):  # finished, or only begun
        if broken:
            (job / "results.json").unlink()
            del before[job / "results.json"]
        assert np.isnan(attempt(job, never, {"dt": 0.2, "resume": None}, ["dt=0.2"]))
        assert f"{job} holds another job, dt=0.4: repeat" in capsys.readouterr().err
        assert {path: path.read_bytes() for path in job.iterdir()} == before
    assert np.isnan(attempt(tmp_path / "4", never, {"dt": 0.2, "resume": "latest"}))
    assert "resume=latest" in capsys.readouterr().err and not (tmp_path / "4").exists()
    notes = job / ".hydra"  # what Hydra writes before a job starts
    notes.mkdir()
    for dt, known in ((0.2, False), (0.4, True)):
        (notes / "overrides.yaml").write_text(f"[dt={dt}]")
        (notes / "config.yaml").write_text(f"{{dt: {dt}, resume: null}}")
        finish(job)(None)
        (only,) = jobs(tmp_path, load)
        assert only.settings == {"dt": str(dt)} and ("boats" in only.results) == known
        assert known or "holds another job, dt=0.4" in only.results["error"]


def test_settings_are_known_by_value_and_order():
    assert digest({"a": 1, "b": 2}) == digest({"a": 1, "b": 2})
    assert len({digest(x) for x in ({"a": 1, "b": 2}, {"b": 2, "a": 1}, {"a": 1.5, "b": 2}, {"a": "1", "b": 2})}) == 4


def test_damaged_and_missing_results_are_told(tmp_path):
    for name, text in {"0": '{"boats": {"her', "10": "", "2": None, "9": "[1]"}.items():
        (tmp_path / name / ".hydra").mkdir(parents=True)
        (tmp_path / name / ".hydra" / "overrides.yaml").write_text("[]")
        if text is not None:
            (tmp_path / name / "results.json").write_text(text)
    listed = jobs(tmp_path, load)
    assert [job.folder.name for job in listed] == ["0", "2", "9", "10"]
    assert all(f"{name}/results.json is damaged" in listed[k].results["error"] for k, name in ((0, 0), (2, 9), (3, 10)))
    write_leaderboard(tmp_path, listed)
    assert ["damaged" in row["error"] for row in table(tmp_path)] == [True, False, True, True]
    assert table(tmp_path)[1]["error"] == "did not finish"
    with pytest.raises(ConfigError, match="found no run"):
        jobs(tmp_path / "none", load)


MALFORMED = [
    {"boats": {"a": {"rnn": {"mae": "x"}}}}, {"boats": [1]}, {"boats": {"a": [1]}}, {"boats": {"a": {"rnn": 3}}},
    {"boats": {}, "forecast": {"a": {"rnn": {"10": 0.1}}}}, {"boats": {}, "free": {"a": 0.1}}, {"boats": {}, "free": 3},
    {"boats": {}, "seconds": "1"}, {"boats": {}, "objective": [0.1]}, {"boats": {}, "measure": "rnn.loud"},
    {"boats": {}, "measure": 3.5}, {"boats": {}, "network": {"a": 3}}, {"boats": {}, "network": {"a": {"rnn": {}}}},
    {"boats": {}, "network": {"a": {"rnn": {"contracting": "yes", "rate": 0.5}}}}, {"boats": {}, "network": []},
]  # fmt: skip


@pytest.mark.parametrize("k", range(len(MALFORMED)))
def test_results_of_others_may_be_of_any_form(k, tmp_path, capsys):
    """A job with results of another form is named; the other one is ranked."""
    good = {"boats": {"a": {"rnn": {"mae": 0.1}}}, "output": "rnn", "objective": 0.1, "seconds": 1.0}
    for name, content in (("0", MALFORMED[k]), ("1", good)):
        (tmp_path / name / ".hydra").mkdir(parents=True)
        (tmp_path / name / ".hydra" / "overrides.yaml").write_text(f"[estimators.rnn.neurons={name}]")
        (tmp_path / name / "results.json").write_text(json.dumps(content))
    (tmp_path / "sweep.json").write_text('{"jobs": "x", "swept": 3, "defaults": [], "objective": {}}')
    (tmp_path / "1" / "errors.csv").write_text("boat,run\n\0")
    (tmp_path / "1" / "job.json").write_text('{"settings": "x"}')
    assert not leaderboard(tmp_path, load)
    rows = {row["job"]: row["error"] for row in table(tmp_path)}
    assert "0/results.json is damaged" in rows["0"] and rows["1"] == ""
    assert "0/results.json is damaged" in capsys.readouterr().out


@pytest.mark.thorough
def test_rows_of_the_hparams_page_have_short_safe_names_and_are_replaced(tmp_path):
    rows = scores(np.array([[1.0, 2.0]]), np.array([1.5]), ["aid", "persistence"])
    good = {"boats": {"heron": rows}, "objective": 0.5, "seconds": 2.0}
    long = "data.path=/a/very/long" + "/path" * 40
    settings = [{"estimators.aid.gain": "0.3", "data.path": "../../x y*"}, {"estimators.aid.gain": "3"},
                {"estimators.aid.gain": "3", "~m": ""}, dict([long.split("=")])]  # fmt: skip
    listed = [Job(tmp_path / f"{k}", each, good if k else {"error": "bad"}) for k, each in enumerate(settings)]
    board = tmp_path / "leaderboard"
    write_leaderboard(tmp_path, listed)
    (board / "notes.txt").write_text("mine")
    write_leaderboard(tmp_path, listed[:3])
    assert (board / "notes.txt").read_text() == "mine"
    assert set(hparams(board)) == {"1 aid.gain=3", "2 aid.gain=3 _m", "3 aid.gain=0.3 data.path=.._.._x y_"}
    write_leaderboard(tmp_path, listed)
    read = hparams(board)
    assert len(read) == 4 and all(len(name) <= LONGEST and "/" not in name for name in read)
    values, numbers = read["1 aid.gain=3"]
    assert values == {"estimators.aid.gain": 3.0}
    assert numbers == pytest.approx({"8 results/1 objective": 0.5, "8 results/2 seconds": 2.0})
    failed = next(each for name, each in read.items() if " aid.gain=0.3" in name)
    assert failed == ({"estimators.aid.gain": pytest.approx(0.3), "data.path": "../../x y*"}, {})


def test_jobs_of_equal_settings_have_rows_of_their_own(tmp_path):
    write_leaderboard(tmp_path, [Job(tmp_path / name, {"align.dt": "0.4"}, {}) for name in ("a", "b")])
    assert set(hparams(tmp_path / "leaderboard")) == {"1 a", "2 b"}


def test_a_leaderboard_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "leaderboard.csv").mkdir()
    with pytest.raises(ConfigError, match="cannot hold the leaderboard") as caught:
        write_leaderboard(tmp_path, [Job(tmp_path / "0", {}, {})])
    assert bad_input(caught.value) is not None


@pytest.mark.parametrize("name", ["leaderboard.csv", "leaderboard.md", "settings.png"])
@pytest.mark.parametrize("link", [False, True], ids=["file", "link"])
def test_a_leaderboard_replaces_and_removes_no_files_of_others(tmp_path, name, link):
    mine, one = tmp_path / "mine", [Job(tmp_path / "sweep" / "0", {}, {})]
    (tmp_path / "sweep").mkdir()
    mine.write_text("mine")
    path = tmp_path / "sweep" / name
    path.symlink_to(mine) if link else path.write_text("mine")
    with pytest.raises(ConfigError, match=f"{name}: found a {'link' if link else 'file of no leaderboard'}"):
        write_leaderboard(tmp_path / "sweep", one)
    assert [each.name for each in (tmp_path / "sweep").iterdir()] == [name] and path.read_text() == "mine"
    path.unlink()
    write_leaderboard(tmp_path / "sweep", one)
    (tmp_path / "sweep" / "settings.png").write_text("an earlier one")
    write_leaderboard(tmp_path / "sweep", one)  # its table says that the folder is a leaderboard's
    assert not (tmp_path / "sweep" / "settings.png").exists()


@pytest.mark.thorough
def test_another_sweep_does_not_take_the_folder(swept):
    before = {path: path.read_bytes() for path in (swept / "sweep").rglob("*") if path.is_file()}
    done = run("-m", "estimators.sift_map.memory=20,30", "data.hours=0.05", "hydra.sweep.dir=sweep", folder=swept)
    assert done.returncode == 2 and "holds the jobs of another sweep" in done.stderr and "Traceback" not in done.stderr
    assert before == {path: path.read_bytes() for path in (swept / "sweep").rglob("*") if path.is_file()}


def test_a_job_whose_folder_is_a_file_does_not_sink_the_rest(tmp_path, capsys):
    (tmp_path / "1").write_text("")
    assert math.isnan(run_job(tmp_path / "1", {"dt": 0.4}, ["dt=0.4"], lambda resume: 0.1))
    assert capsys.readouterr().err.startswith(f"error: {tmp_path / '1'}")
