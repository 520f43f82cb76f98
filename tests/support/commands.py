"""The commands as a user starts them, and what they leave behind."""

import csv
import faulthandler
import io
import json
import logging
import os
import runpy
import subprocess
import sys
import warnings
from collections.abc import Iterator
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from tests.support import ROOT
from usvlearn.core import checkpoint

SET = {"OMP_NUM_THREADS": "1", "COLUMNS": "160"}
ENVIRONMENT = {**os.environ, **SET}
LONGEST = 300  # s of a command


SMALL = ["data.hours=0.0667", "data.mission_minutes=2", "estimators.rnn.neurons=4", "save_minutes=0.5"]
LEAST_SQUARES = "+estimator@estimators.dynamic_rls=dynamic_rls"  # whose parameters have a band
SEASON = [*SMALL, "data.n=2", "estimators.joint_averaged.estimate_every=60", LEAST_SQUARES]  # of the fixture `finished`


LEFT_OUT = ["rnn", "joint_quick", "arx", "joint_averaged"]


QUICK = ["data.hours=0.05", "save_minutes=0.5", *(f"~estimators.{name}" for name in LEFT_OUT),
         "~combiners.average", "~combiners.weighted", "combiners.ensemble.members=[aid,sift_map,joint]",
         "forecasts.members=[aid,joint]", "tracks=null"]  # fmt: skip


GOOD = "time,L,R,heading,speed\n" + "".join(f"{0.1 * k},0.5,0.5,90,{0.01 * k}\n" for k in range(100))


def command(*arguments: str, script: str = "train.py") -> list[str]:
    return [sys.executable, str(ROOT / script), *arguments]


def run(*arguments: str, folder: Path, script: str = "train.py", **environment: str) -> subprocess.CompletedProcess:
    """A command's end: in this process, or in one of its own where it needs another environment."""
    started = command(*arguments, script=script)
    if not environment.keys() <= {"COLUMNS"}:
        return subprocess.run(
            started, cwd=folder, env=ENVIRONMENT | environment, capture_output=True, text=True, timeout=LONGEST
        )
    code, out, err = 0, io.StringIO(), io.StringIO()
    with (
        left_as_it_was(), chdir(folder), redirect_stdout(out), redirect_stderr(err), warnings.catch_warnings(),
        patch.object(sys, "argv", started[1:]), patch.object(sys, "path", [*sys.path]),
        patch.dict(os.environ, SET | environment),
    ):  # fmt: skip
        warnings.simplefilter("default")
        warnings.showwarning = lambda *what: print(end=warnings.formatwarning(*what[:4]), file=sys.stderr)
        try:
            runpy.run_path(started[1], run_name="__main__")
        except SystemExit as end:
            code = end.code or 0
            if isinstance(code, str):
                print(code, file=sys.stderr)
                code = 1
    return subprocess.CompletedProcess(started, code, out.getvalue(), err.getvalue())


def ran(*arguments: str, folder: Path, script: str = "train.py", **environment: str) -> subprocess.CompletedProcess:
    """A command's end, which has to be a good one."""
    done = run(*arguments, folder=folder, script=script, **environment)
    assert done.returncode == 0, done.stderr
    return done


@contextmanager
def left_as_it_was() -> Iterator[None]:
    """Put back what a command changes in its process, and end the process if it takes too long."""
    handlers, level, threads = [*logging.root.handlers], logging.root.level, torch.get_num_threads()
    faulthandler.dump_traceback_later(LONGEST, exit=True, file=sys.__stderr__)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        logging.root.handlers[:] = handlers
        logging.root.setLevel(level)
        torch.set_num_threads(threads)


def python(code: str, **environment: str) -> subprocess.CompletedProcess:
    """Run code in a Python of its own, which has to end well."""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done


def called(main, arguments, monkeypatch, capsys) -> tuple[int, str]:
    """A command in this process: its exit code, and what it says on stderr."""
    monkeypatch.setattr(sys, "argv", ["train.py", *arguments])
    code = 0
    try:
        main()
    except SystemExit as end:
        code = end.code
    return code, complaints(capsys.readouterr().err)


def complaints(stderr: str) -> str:
    """What a command says on stderr, without what is said where code was never compiled before."""
    return "".join(line for line in stderr.splitlines(True) if not line.startswith("usvlearn: compiling"))


def results(folder: Path) -> dict:
    return json.loads((folder / "results.json").read_text())


def predictions(folder: Path) -> list[np.ndarray]:
    return [np.load(path)["predictions"] for path in sorted((folder / "predictions").glob("*.npz"))]


def assert_equal_runs(found: Path, expected: Path) -> None:
    """Every saved state and prediction, bit for bit, and the same results."""
    for name in ("checkpoints", "predictions"):
        ours, theirs = (sorted(p.relative_to(f) for p in (f / name).rglob("*.*")) for f in (found, expected))
        assert ours == theirs
    for path in sorted((expected / "checkpoints").rglob("*.safetensors")):
        ours, theirs = (checkpoint.load(f)[0] for f in (found / path.relative_to(expected), path))
        assert all(np.array_equal(ours[name], theirs[name], equal_nan=True) for name in theirs), path.name
    for ours, theirs in zip(predictions(found), predictions(expected), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert results(found)["boats"] == results(expected)["boats"]


def load(path: Path):
    return OmegaConf.to_container(OmegaConf.load(path))


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "leaderboard.csv").open() as file:
        return list(csv.DictReader(file))


def never(resume):
    raise AssertionError("this job must not be done")


def hparams(folder: Path) -> dict[str, tuple[dict, dict]]:
    """Per row of the HPARAMS page its settings and numbers, as TensorBoard reads them."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    rows = {}
    for path in filter(Path.is_dir, folder.iterdir()):
        events = EventAccumulator(str(path))
        events.Reload()
        if "_hparams_/session_start_info" not in events.Tags()["tensors"]:
            continue
        data = HParamsPluginData.FromString(events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content)
        settings = {
            key: getattr(value, value.WhichOneof("kind")) for key, value in data.session_start_info.hparams.items()
        }
        rows[path.name] = settings, {tag: events.Scalars(tag)[0].value for tag in events.Tags()["scalars"]}
    return rows


def sentence(main, arguments, monkeypatch, capsys, before: str = "") -> str:
    """The one sentence with which a command ends, after what another program has said."""
    monkeypatch.setattr(sys, "argv", ["command.py", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    error = complaints(capsys.readouterr().err).removeprefix(before)
    assert end.value.code == 2, error
    assert error.startswith("error: ") and len(error.splitlines()) == 1, error
    return error
