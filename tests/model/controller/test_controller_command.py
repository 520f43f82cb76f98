"""The command, its files in the readers of the programs that they are for, and its gains on the true boat."""

import json
import sys

import numpy as np
import pytest

import usvlearn
from usvlearn import JointEKF
from usvlearn.__main__ import main
from usvlearn.live.moos.block import Mission


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """A checkpoint of a boat that was learned from a simulated hour."""
    logs = usvlearn.read(data="simulated", hours=1.0, seed=3, spread=0.0)
    reader = JointEKF(surge_max=2.74, mass=28.0, read_every=600.0, current=0.15, even=0.2, lag=0.3)
    return usvlearn.learn(logs, reader).save(tmp_path_factory.mktemp("sets") / "heron.safetensors")


@pytest.mark.thorough
def test_the_files_open_in_the_readers_that_they_are_for(learned, tmp_path, monkeypatch, capsys):
    mavparm = pytest.importorskip("pymavlink.mavparm")
    monkeypatch.setattr(sys, "argv", [])
    assert main(["controller", str(learned), "--out", str(tmp_path), "--boats", "20"]) == 0
    said = capsys.readouterr().out
    assert "ATC_SPEED_P" in said and "gain margin" in said and said.count("20 of 20         0") == 6
    facts = json.loads((tmp_path / "heron.controller.json").read_text())
    parameters = mavparm.MAVParmDict()
    assert parameters.load(str(tmp_path / "heron.param"))
    assert dict(parameters) == pytest.approx(facts["ardurover"])
    assert "Invalid line" not in capsys.readouterr().out
    base = parameters["CRUISE_THROTTLE"] / 100
    curve = facts["feedforward"]
    assert base == pytest.approx(np.interp(parameters["CRUISE_SPEED"], curve["speed_m_s"], curve["command"]), abs=0.006)
    assert parameters["ATC_SPEED_FF"] == 0
    block = Mission((tmp_path / "heron_pid.moos").read_text()).block("pMarinePIDV22")
    lines = {name: entry.value for name, entry in block.items()}
    gains, tick = facts["gains"], float(lines["apptick"])
    assert float(lines["speed_pid_kd"]) * tick / 100 == pytest.approx(gains["proportional_per_m_s"], rel=1e-3)
    assert float(lines["speed_pid_kp"]) * tick / 100 == pytest.approx(gains["integral_per_m"], rel=1e-3)
    assert {"speed_factor": "0", "speed_pid_ki": "0", "maxthrust": "100"}.items() <= lines.items()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--speed", "9"], "reaches"),
        (["--boat", "hero"], "expected heron"),
        (["--bandwidth", "50"], "give at most"),
        (["--out", __file__], "expected a folder"),
    ],
)
def test_bad_input_takes_one_sentence(learned, arguments, said, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [])
    with pytest.raises(SystemExit) as stopped:
        main(["controller", str(learned), *arguments])
    told = capsys.readouterr()
    assert stopped.value.code == 2 and said in told.err and told.err.count("\n") == 1 and not told.out


def test_a_log_without_excitation_is_told_what_to_sail(tmp_path, monkeypatch, capsys):
    logs = usvlearn.read(data="simulated", hours=0.008, seed=3)
    path = usvlearn.learn(logs, JointEKF(surge_max=2.74, mass=28.0, read_every=600.0)).save(
        tmp_path / "short.safetensors"
    )
    monkeypatch.setattr(sys, "argv", [])
    with pytest.raises(SystemExit):
        main(["controller", str(path)])
    assert "sail straight ahead" in capsys.readouterr().err
