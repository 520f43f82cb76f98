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
    reader = JointEKF(surge_max=2.74, mass=28.0, estimate_every=600.0, current=0.15, even=0.2, lag=0.3)
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
    printed = capsys.readouterr()
    assert stopped.value.code == 2 and said in printed.err and printed.err.count("\n") == 1 and not printed.out


def test_a_log_without_excitation_is_told_what_to_sail(tmp_path, monkeypatch, capsys):
    logs = usvlearn.read(data="simulated", hours=0.008, seed=3)
    path = usvlearn.learn(logs, JointEKF(surge_max=2.74, mass=28.0, estimate_every=600.0)).save(
        tmp_path / "short.safetensors"
    )
    monkeypatch.setattr(sys, "argv", [])
    with pytest.raises(SystemExit):
        main(["controller", str(path)])
    assert "sail straight ahead" in capsys.readouterr().err


@pytest.mark.thorough
def test_a_fit_gives_the_values_and_the_steering_and_its_doubts_are_told(tmp_path, monkeypatch, capsys):
    logs = usvlearn.read(data="planar", hours=0.4, seed=3)
    learned = usvlearn.learn(logs, JointEKF(surge_max=2.74, mass=33.75, estimate_every=600.0))
    fitted = learned.fit("cubic")["planar"]
    learned.save(tmp_path / "checkpoints" / "planar" / "1.safetensors")
    monkeypatch.setattr(sys, "argv", [])
    main(["controller", str(tmp_path), "--boats", "5"])
    said = capsys.readouterr().out
    assert "from 1.safetensors" in said and "no gains. The batch fit tells" in said and "yaw_pid_kp" not in said
    learned.save(tmp_path / "fit" / "checkpoints" / "planar" / "fit.safetensors", fit=fitted)
    for doubts, basis in (([], "fit"), (["It drifts."], "1")):
        (tmp_path / "fit" / "planar.fit.json").write_text(json.dumps({"doubts": doubts}))
        main(["controller", str(tmp_path), "--boats", "5", "--out", str(tmp_path / "out")])
        printed = capsys.readouterr()
        assert f"from {basis}.safetensors" in printed.out and ("has doubts: It drifts." in printed.err) == bool(doubts)
        assert all(x in printed.out for x in ("ATC_STR_RAT_FF,", "yaw_pid_kp = ", "RO_YAW_P"))
    lines = (tmp_path / "out" / "planar_px4.params").read_text().splitlines()
    values = {name: float(value) for *_, name, value, _ in (x.split("\t") for x in lines if x[0] != "#")}
    facts = json.loads((tmp_path / "out" / "planar.controller.json").read_text())
    assert values == pytest.approx(facts["steering"]["px4"], rel=1e-5)
    assert facts["period_s"] == pytest.approx(0.1)  # that of the logged commands
