"""Mistyped keys, groups, files, flags and values: one sentence with the full key and the nearest name, and code 2."""

import os
import shlex
import sys

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser

from tests.support import ROOT, few
from tests.support.commands import GOOD, python, sentence
from usvlearn.cli import evaluate, train
from usvlearn.cli.hydra_command import parse
from usvlearn.composition.configuration import instantiate
from usvlearn.composition.errors import in_one_sentence
from usvlearn.errors import ConfigError

MISTAKES = {
    "key": (["estimators.aid.gian=2"], ["estimators.aid.gian", "did you mean estimators.aid.gain?"]),
    "first key": (["aling.dt=0.3"], ["aling.dt", "did you mean align.dt?"]),
    "key of a chosen group": (["data=csv", "data.reader.tiem=t"], ["data.reader.tiem", "data.reader.time?"]),
    "last key alone": (["neurons=3"], ["neurons", "did you mean estimators.rnn.neurons?"]),
    "key of Hydra": (["hydra.run.dri=x"], ["hydra.run.dri", "did you mean hydra.run.dir?"]),
    "removed key": (["~estimators.aidd"], ["estimators.aidd", "did you mean estimators.aid?"]),
    "key that is there": (["+align.dt=0.3"], ["align.dt", "leave out the +"]),
    "member that is there": (["+estimator@estimators.aid=rls"], ["+estimator@estimators.aid", "leave out the +"]),
    "group": (["dat=blueboat"], ["dat", "did you mean data?"]),
    "option": (["data=bluebot"], ["data", "'bluebot'", "did you mean blueboat?"]),
    "option of a package": (["estimator@estimators.aid=adi"], ["'adi'", "did you mean aid?"]),
    "package": (
        ["estimator@estimators.aidd=aid"],
        ["estimator@estimators.aidd", "did you mean estimator@estimators.aid"],
    ),
    "new member": (["+estimator@estimators.x=smoothing"], ["estimator", "'smoothing'", "expected one of"]),
    "number for an option": (["data=3"], ["must be a string"]),
    "experiment": (["experiment=papr"], ["experiment", "'papr'", "did you mean paper?"]),
    "sweep": (["sweep=inputz"], ["sweep", "'inputz'", "did you mean inputs?"]),
    "bracket": (["a=[1"], ["a=[1", "KEY=VALUE"]),
    "no value": (["foo"], ["foo", "KEY=VALUE"]),
    "sweep without -m": (["align.dt=0.3,0.4"], ["align.dt=0.3,0.4", "-m"]),
    "flag": (["--multirnu"], ["--multirnu", "did you mean --multirun?"]),
    "two flags": (["--run", "--multirun"], ["--run, --multirun"]),
    "flag without its value": (["--cfg"], ["--cfg", "expected one argument"]),
    "file": (["--config-name", "trian"], ["--config-name", "'trian'", "did you mean train?"]),
    "folder": (["--config-dir", "nowhere"], ["nowhere", "--config-dir"]),
    "launcher": (["-m", "hydra/launcher=joblb"], ["'joblb'", "did you mean joblib?"]),
    "no section": (["~estimators"], ["estimators", "found nothing"]),
    "no group": (["~data"], ["data", "found nothing"]),
    "a section that is a number": (["align=3"], ["align", "found 3", "align.KEY=VALUE"]),
    "a section that is itself": (["align=${align}"], ["align", "${align}"]),
    "a circle": (["align.dt=${threads}", "threads=${align.dt}"], ["align.dt", "refers to itself"]),
    "a folder that is itself": (["hydra.run.dir=${hydra.run.dir}"], ["hydra.run.dir", "refers to itself"]),
    "a reference to nothing": (["align.dt=${align.dtt}"], ["align.dt", "align.dtt", "does not exist"]),
    "no value yet": (["data=csv", "data.path=???"], ["data.path"]),
    "option of align": (["+align.dtt=3"], ["align.dtt", "did you mean align.dt?"]),
    "level of the check": (["check=of"], ["check: found 'of', expected one of warn, strict, off"]),
}
VALUES = {  # after torch: constructors check these
    "a device": (["data.path=/dev/null"], ["data.path: found '/dev/null', which is a device"]),
    "no path": ([], ["data.path is not set"]),
    "less than nothing": (["estimators.sift_map.memory=-1"], ["estimators.sift_map.memory: found -1"]),
    "a word": (["estimators.sift_map.memory=abc"], ["estimators.sift_map.memory: found 'abc'"]),
    "a key of others": (["vehicle.surge_max=-3", "data.path=log.csv"], ["error: vehicle.surge_max: found -3"]),
    "another": (["vehicle.mass=abc", "data.path=log.csv"], ["error: vehicle.mass: found 'abc'"]),
    "inside wrappers": (["estimators.arx.estimator.walk=-1"], ["estimators.arx.estimator.walk: "]),
    "a choice": (["combiners.ensemble.loss=abs"], ["combiners.ensemble.loss: found 'abs'"]),
    "members": (["combiners.weighted.members=[aidd]"], ["combiners.weighted.members: found aidd"]),
    "argument": (["+estimators.sift_map.memmory=3"], ["sift_map.memmory", "did you mean estimators.sift_map.memory?"]),
    "target": (["estimators.aid._target_=usvlearn.estimators.aid.layer.AIDD"], ["aid._target_", "mean AID?"]),
    "no estimator": (["+estimators.x=3"], ["estimators.x: found 3, expected an estimator"]),
    "align": (["align.dt=-1", "data.path=log.csv"], ["align.dt: found -1"]),
    "a missing value": (["~align.dt", "data.path=log.csv"], ["align.dt: is missing"]),
    "unit": (["data.channels.surge.unit=kn", "data.path=log.csv"], ["data.channels.surge.unit: found 'kn'"]),
    "channel": (["+data.channels.surge.nmae=v", "data.path=log.csv"], ["data.channels.surge", "did you mean name?"]),
    "a grid": (["estimators.aid.gain=[0.1,1]", "data.path=log.csv"], ["estimators.aid.gain: found the shape (2,)"]),
    "simulated": (["data=simulated", "data.sensors.surge_hz=-1"], ["data.sensors.surge_hz: found -1"]),
    "too few numbers": (["data=simulated", "data.sensors.outage=[8]"], ["data.sensors.outage: found [8]"]),
    "a number for options": (["data=simulated", "data.sensors=3"], ["data.sensors: found 3"]),
    "half a boat": (["data=simulated", "data.n=1.5"], ["data.n: found 1.5, expected a whole number"]),
    "a fault": (["data=simulated", "+data.fault={_target_: usvlearn.simulate.fault.Fault, share: 4}"],
                ["data.fault.share: found 4"]),
    "tuning": (["grid=sift_map", "estimators.sift_map.memory=-1"], ["estimators.sift_map.memory: found -1"]),
    "tuning of nobody's data": (["grid=sift_map", "data=simulated", "data.n=0"], ["data.n: found 0"]),
    "inputs": (["align.inputs=future", "data.path=log.csv"], ["inputs", "mean, last, next"]),
    "a boat's name": (["data.boat=../b", "data.path=log.csv"], ["data.boat", "../b"]),
    "no threads": (["threads=0", "data.path=log.csv"], ["threads", "positive"]),
    "minutes": (["save_minutes=null", "data.path=log.csv"], ["save_minutes", "None", "positive"]),
    "a type": (["estimators.rnn.seed=abc", "data.path=log.csv"], ["seed", "abc"]),
    "no reader": (["data.reader=null", "data.path=log.csv"], ["data"]),
    "no checkpoint": (["resume=latest", "data.path=log.csv"], ["resume=latest", "no run"]),
    "resume nowhere": (["resume=nowhere", "data.path=log.csv"], ["nowhere", "does not exist"]),
    "missing file": (["data.path=none.csv"], ["none.csv", "does not exist"]),
    "no such channel": (["data.channels.surge.name=sped", "data.path=log.csv"], ["sped", "surge", "heading"]),
    "no speed": (["data.channels.surge.name=null", "data.path=log.csv"], ["surge"]),
}  # fmt: skip
LOG = GOOD.replace("time,L,R,heading,speed", "time,command_left,command_right,heading,surge")
LOGS = {  # what stands in the log
    "empty": ("", ["log.csv", "empty"]),
    "wrong format": ("\x00\x01\x02", ["log.csv"]),
    "no numbers": (LOG.replace(",90,", ",north,"), ["log.csv", "heading", "numbers"]),
    "a run of one step": ("\n".join(LOG.splitlines()[:9]), ["run log: 1", "at least 3"]),
}


BY_DEFAULT = {  # one of each kind
    "key", "key that is there", "group", "option", "number for an option", "bracket", "no value", "sweep without -m",
    "flag", "two flags", "flag without its value", "file", "folder", "launcher", "a reference to nothing",
    "no value yet", "level of the check", "a key of others", "inside wrappers", "argument", "target", "channel",
}  # fmt: skip


@pytest.mark.parametrize("case", few(MISTAKES, BY_DEFAULT, "thorough"))
def test_a_mistake_is_told_in_one_sentence(case, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments, words = MISTAKES[case]
    error = sentence(train.main, arguments, monkeypatch, capsys)
    assert all(word in error for word in words), error


@pytest.mark.parametrize("case", few(VALUES, BY_DEFAULT, "thorough"))
def test_a_value_is_told_with_the_full_path_of_its_key(case, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").write_text(LOG)
    arguments, words = VALUES[case]
    error = sentence(train.main, ["data=csv", *arguments] if "data=simulated" not in arguments else arguments,
                     monkeypatch, capsys)  # fmt: skip
    assert all(word in error for word in words), error


@pytest.mark.thorough
@pytest.mark.parametrize("case", LOGS)
def test_a_log_that_cannot_be_used_is_told_and_nothing_is_half_written(case, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    content, words = LOGS[case]
    (tmp_path / "log.csv").write_text(content)
    error = sentence(train.main, ["data=csv", "data.path=log.csv", "hydra.run.dir=run"], monkeypatch, capsys)
    assert all(word in error for word in words), error
    assert [path.name for path in (tmp_path / "run").iterdir()] == [".hydra"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["rns=x"], ["rns", "did you mean runs?"]),
        (["data=bluebot"], ["data", "did you mean blueboat?"]),
        (["experiment=papr"], ["experiment", "did you mean paper?"]),
        (["--config-name=evalaute"], ["did you mean evaluate?"]),
        (["runs=${report}", "report=${runs}"], ["refers to itself"]),
        ([], ["runs is not set"]),
        (["runs=3"], ["'3'", "runs"]),
        (["runs=x", "trust=3"], ["trust: found 3, expected a module, or a list"]),
        (["study=3"], ["folder is not set", "experiment=paper_small"]),
        (["runs=[a]"], ["runs: found ['a'], expected a folder"]),
    ],
)
def test_evaluate_tells_the_same(arguments, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    error = sentence(evaluate.main, arguments, monkeypatch, capsys)
    assert all(word in error for word in words), error


def test_a_file_that_is_no_yaml_is_told(tmp_path, monkeypatch, capsys):
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text("# @package _global_\nalign: {dt: 0.4\noutput: x\n")
    error = sentence(train.main, ["--config-dir", str(tmp_path), "experiment=mine"], monkeypatch, capsys)
    assert "mine.yaml:3: is not legal YAML" in error


def test_flags_are_hydras_own():
    parsed = parse(["-m", "align.dt=0.3,0.4", "--config-name", "train"])
    assert parsed.multirun and parsed.overrides == ["align.dt=0.3,0.4"]
    with pytest.raises(ConfigError, match="see the flags by --hydra-help"):
        parse(["-x"])


@pytest.mark.thorough
def test_a_bug_keeps_its_traceback(monkeypatch, tmp_path):
    def bug(cfg):
        raise ZeroDivisionError("of nothing")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train, "check_settings", bug)
    monkeypatch.setattr(sys, "argv", ["train.py"])
    with pytest.raises(ZeroDivisionError):
        train.main()


def test_a_bug_of_a_constructor_keeps_its_traceback(monkeypatch):
    monkeypatch.setattr("usvlearn.errors.check_positive", lambda name, value: {}[name])
    with pytest.raises(KeyError, match="dt"):
        instantiate({"_target_": "usvlearn.errors.check_positive", "name": "dt", "value": 1})


WAITS = f"""
import runpy, sys
for wrong in ("estimators.aid.gian=2", "data=bluebot", "align=${{align}}"):
    sys.argv = ["train.py", wrong]
    try:
        runpy.run_path({str(ROOT / "train.py")!r}, run_name="__main__")
    except SystemExit as end:
        print(end.code, *{{"torch", "numba", "scipy", "tensorboard"}} & sys.modules.keys())
"""


@pytest.mark.thorough
def test_a_mistake_waits_for_nothing_heavy():
    assert python(WAITS, PYTHONPATH=str(ROOT)).stdout == "2\n2\n2\n"


@pytest.mark.thorough
def test_a_cluster_that_cannot_be_reached_is_told(tmp_path, monkeypatch, capsys):
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "far.yaml").write_text(
        "# @package _global_\ndefaults: [{override /hydra/launcher: slurm}]\nhydra: {mode: MULTIRUN}\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    from_file = ["--config-dir", str(tmp_path), "experiment=far"]
    for arguments in (["-m", "hydra/launcher=slurm"], from_file):
        error = sentence(train.main, [*arguments, "hydra.sweep.dir=sweep"], monkeypatch, capsys)
        assert "found no srun and sbatch" in error
    for tool in ("srun", "sbatch"):
        (tmp_path / tool).write_text("#!/bin/sh\necho 'unable to contact the controller' >&2\nexit 1\n")
        (tmp_path / tool).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.defpath}")
    said, arguments = "unable to contact the controller", ["-m", "hydra/launcher=slurm", "hydra.sweep.dir=sweep"]
    error = sentence(train.main, arguments, monkeypatch, capsys, before=f"{said}\n")
    assert said in error and "continue with: python" in error


@pytest.mark.parametrize("name", ["Speed (m/s)", "Speed [km/h]", "Höhe °", 'it\'s "v" (x)', "a\\b (c)"])
def test_the_quoting_that_an_error_advises_gives_the_text(name):
    """As a POSIX shell splits it, and Hydra parses it."""
    parser = OverridesParser.create()
    with pytest.raises(ConfigError) as caught, in_one_sentence():
        parser.parse_overrides([f"data.channels.surge.name={name}"])
    advice = str(caught.value).partition("in quotes: ")[2]
    (word,) = shlex.split(advice)
    assert parser.parse_override(word).value() == name
