"""Launchers of workers: the keys of the one for Slurm, and workers that are killed."""

import os
import re
import signal
import subprocess
import time
from dataclasses import fields

import pytest
from hydra import compose, initialize_config_dir

from tests.support import ROOT
from tests.support.commands import ENVIRONMENT, QUICK, assert_equal_runs, command, load, run, table

SLURM = ROOT / "configs" / "hydra" / "launcher" / "slurm.yaml"
SWEEP = ["-m", "estimators.sift_map.memory=5,9", *QUICK, "data.hours=10", "save_minutes=1", "hydra.sweep.dir=sweep"]


def test_every_key_of_the_slurm_launcher_exists_and_is_documented():
    config = pytest.importorskip("hydra_plugins.hydra_submitit_launcher.config")
    given = load(SLURM)
    del given["defaults"]
    assert set(given) <= {each.name for each in fields(config.SlurmQueueConf)}
    needed = {"partition", "account", "qos", "cpus_per_task", "mem_gb", "timeout_min", "max_num_timeout",
              "array_parallelism", "additional_parameters", "setup"}  # fmt: skip
    assert needed <= set(given)
    whole = re.findall(r"hydra\.launcher\.([\w.]+)=", SLURM.read_text())  # of the examples
    assert whole and {each.partition(".")[0] for each in whole} <= set(given)
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        overrides = ["hydra/launcher=slurm", "+hydra.launcher.additional_parameters.nice=100"]
        composed = compose("train", overrides, return_hydra_config=True).hydra.launcher
    assert composed.additional_parameters == {"requeue": True, "nice": 100} and composed.mem_gb == 2


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="this system has no SIGKILL")
@pytest.mark.parametrize("launcher", ["joblib", "submitit_local"])
def test_a_killed_worker_loses_no_job(launcher, tmp_path):
    """The same command continues it. joblib ends the other workers, too; submitit lets them finish."""
    pytest.importorskip({"joblib": "joblib", "submitit_local": "submitit"}[launcher])
    (whole := tmp_path / "whole").mkdir()
    assert run(*SWEEP, folder=whole).returncode == 0
    arguments, sweep = command(*SWEEP, f"hydra/launcher={launcher}"), tmp_path / "sweep"
    process = subprocess.Popen(arguments, cwd=tmp_path, env=ENVIRONMENT, text=True, stdout=subprocess.DEVNULL,
                               stderr=subprocess.PIPE)  # fmt: skip
    began = time.monotonic()
    while len(sets := sorted(sweep.glob("0/checkpoints/heron/*.safetensors"))) < 3:
        assert process.poll() is None and time.monotonic() - began < 200
        time.sleep(0.01)
    os.kill(int((sweep / "0" / ".lock").read_text()), signal.SIGKILL)
    _, error = process.communicate(timeout=300)
    assert process.returncode == 2 and "Traceback" not in error and "continue with: python" in error, error
    failed = {row["job"]: row["error"] for row in table(sweep)}
    assert failed["0"] == "did not finish"
    if launcher == "submitit_local":
        assert "error: job 0:" in error and failed["1"] == ""
    files = [sets[0], *sweep.glob("1/results.json")]
    stamps = [path.stat().st_mtime_ns for path in files]
    done = subprocess.run(arguments, cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert [path.stat().st_mtime_ns for path in files] == stamps  # what was saved is not made again
    for job in "01":
        assert_equal_runs(sweep / job, whole / "sweep" / job)
