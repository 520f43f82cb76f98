"""The main job from the command line: what it leaves behind, how it goes on, what it says to bad input."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from tests.support import few
from tests.support.commands import ENVIRONMENT, SEASON, assert_equal_runs, command, predictions, ran, results, run
from usvlearn.core import checkpoint
from usvlearn.estimators.axis.turning_quantities import QUANTITIES as TURNING

NAMES = {
    "aid", "sift_map", "rnn", "persistence", "joint", "joint_quick", "arx", "joint_averaged", "average", "weighted",
    "ensemble", "dynamic_rls",
}  # fmt: skip


def test_results(finished):
    saved = results(finished)
    assert list(saved["boats"]) == ["heron1", "heron2"]
    for rows in saved["boats"].values():
        assert set(rows) == NAMES
        for row in rows.values():
            assert {"mae", "median", "rmse", "skill", "steps"} <= row.keys()
            assert 0 < row["median"] <= row["rmse"] < 5 and row["mae"] <= row["rmse"] and row["steps"] > 450
        assert rows["persistence"]["skill"] == 0
        assert 0.85 < rows["ensemble"]["coverage"] < 0.95 and 0.01 < rows["ensemble"]["halfwidth"] < 0.5
        assert rows["aid"]["skill"] == pytest.approx(1 - rows["aid"]["mae"] / rows["persistence"]["mae"])
    assert saved["rejected"]["heron1"]["surge"]["lost"] > 0
    assert saved["seconds"] > 0
    maes = [rows["ensemble"]["mae"] for rows in saved["boats"].values()]
    assert saved["objective"] == pytest.approx(np.mean(maes))


def test_results_have_what_was_identified(finished):
    saved = results(finished)
    assert list(saved["identified"]) == list(saved["lacks"]) == ["heron1", "heron2"]
    for quantities in saved["identified"].values():
        assert {"thrust_full_left", "drag_linear", "steady_speed_quarter", "time_constant"} <= quantities.keys()
        for name, row in quantities.items():
            known = set() if name in TURNING else {"truth"}  # the boat of this simulator has no yaw dynamics
            assert set(row) == {"value", "low", "high", "unit"} | known
            assert None in row.values() or row["low"] <= row["value"] <= row["high"]
            assert name != "mass"
        assert 1 < quantities["steady_speed_full"]["truth"] < 4 and quantities["thrust_full_left"]["unit"] == "N"
    text = (finished.parent / "output.txt").read_text()
    assert "Identified, with 90 % intervals" in text and "truth" in text and "28 kg, as configured" in text


def test_terminal(finished):
    text = (finished.parent / "output.txt").read_text()
    assert all(name in text for name in (*NAMES, "heron2", "MAE", "median", "RMSE", "skill", "m/s", "surge"))
    *_, fit, _, board, _, toggle, last = text.splitlines()
    assert fit.startswith("fit          ") and toggle.startswith("Of several boats")
    assert last == f"next         python evaluate.py {finished.name}"
    assert board == f"TensorBoard  tensorboard --logdir {finished.name}/tensorboard"


def test_parameter_sets(finished):
    """One each half minute of run time and one at each run's end, complete and told apart."""
    for boat in ("heron1", "heron2"):
        paths = checkpoint.checkpoints(finished / "checkpoints" / boat)
        saved = [(facts["run"], facts["step"]) for facts in (checkpoint.load(path)[1] for path in paths)]
        runs = json.loads((finished / "runs.json").read_text())["boats"][boat]
        assert saved == [(name, k) for name, length, _ in runs for k in (*range(75, length, 75), length)]
        assert len(saved) >= 6
        leaves, facts = checkpoint.load(paths[-1])
        assert facts["boat"] == boat and facts["estimator"] == "Ensemble" and facts["schema"] == 3
        assert facts["configuration"]["estimators"]["rnn"]["neurons"] == 4
        assert facts["time"] == pytest.approx(0.4 * (facts["step"] - 1))
        assert {"members.aid.theta", "members.rnn.weights.w1", "members.rnn.moment2"} <= leaves.keys()


def test_everything_lies_in_the_runs_folder(finished):
    assert sorted(p.name for p in finished.parent.iterdir()) == ["made", "output.txt", "run"]
    files = {"errors.csv", "results.json", "runs.json"}
    assert files | {"checkpoints", "planar", "predictions", "tensorboard", ".hydra"} == {
        p.name for p in finished.iterdir()
    }
    assert "gain: 1.0" in (finished / ".hydra" / "config.yaml").read_text()


def killed_after(sets: int, folder: Path, *arguments: str) -> None:
    """Start a run and kill it, with no chance to clean up, once it has saved some checkpoints."""
    process = subprocess.Popen(command(*arguments), cwd=folder, env=ENVIRONMENT, stdout=subprocess.DEVNULL)
    started = time.monotonic()
    while len(list(folder.glob("run/checkpoints/heron2/*.safetensors"))) < sets and process.poll() is None:
        assert time.monotonic() - started < 300
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()


@pytest.mark.thorough
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
@pytest.mark.parametrize("sets", few([1, 4], [4]))
def test_killed_and_resumed_equals_uninterrupted(finished, tmp_path, sets):
    arguments = [*SEASON, f"hydra.run.dir={tmp_path}/run"]
    killed_after(sets, tmp_path, *arguments)
    assert not (tmp_path / "run" / "results.json").exists()
    refused = run(*arguments, folder=tmp_path)
    assert refused.returncode == 2 and "resume=latest" in refused.stderr
    saved = checkpoint.checkpoints(tmp_path / "run" / "checkpoints" / "heron1")
    for newest in saved[-2:]:  # the disk failed, too; the last one may have no predictions
        newest.write_bytes(newest.read_bytes()[:-7])
    resumed = ran(*arguments, "resume=latest", folder=tmp_path)
    if sets > 1:
        assert "damaged" in resumed.stderr and "resuming after step" in resumed.stdout
    assert_equal_runs(tmp_path / "run", finished)


@pytest.mark.thorough
def test_resume_carries_parameters_to_other_runs(finished, tmp_path):
    """A new season starts from the parameters of the last one."""
    season = [*SEASON, "data.seed=5", f"hydra.run.dir={tmp_path}/run"]
    done = run(*season, f"resume={finished}", folder=tmp_path)
    assert done.returncode == 0 and "from the first run on" in done.stdout, done.stderr
    anew = run(*season[:-1], f"hydra.run.dir={tmp_path}/anew", folder=tmp_path)
    assert anew.returncode == 0
    first = predictions(tmp_path / "run")[0][1:6], predictions(tmp_path / "anew")[0][1:6]
    assert not np.array_equal(*first)
    single = run(*SEASON, "data.n=1", f"resume={max((finished / 'checkpoints' / 'heron2').iterdir())}",
                 f"hydra.run.dir={tmp_path}/one", folder=tmp_path)  # fmt: skip
    assert single.returncode == 0 and "starting from heron2" in single.stdout
