"""The command, its files in the readers of the programs that they are for, and its gains on the true boat."""

import json
import sys
import xml.etree.ElementTree

import numpy as np
import pytest
import torch

import usvlearn
from usvlearn import JointEKF
from usvlearn.__main__ import main
from usvlearn.controller.autopilots import MoosLaw, RoverLaw
from usvlearn.controller.closed_loop import Responses, steps_of
from usvlearn.controller.design import controller
from usvlearn.live.moos.mission import Mission
from usvlearn.model.read_boats import read_boats
from usvlearn.simulate.plants import plant
from usvlearn.simulate.vessel import at_rest, step

BOATS = {"heron": (2.74, 28.0), "otter": (3.1, 85.5), "vtec": (1.5, 32.25)}  # top speed, m/s, and mass, kg


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    """A set of each boat, learned from a simulated hour."""
    found, folder = {}, tmp_path_factory.mktemp("sets")
    for name, (top, mass) in BOATS.items():
        logs = usvlearn.read(data="simulated", hours=1.0, plant=name, seed=3, spread=0.0)
        reader = JointEKF(surge_max=top, mass=mass, read_every=600.0, current=0.15, even=0.2, lag=0.3)
        found[name] = usvlearn.learn(logs, reader).save(folder / f"{name}.safetensors")
    return found


def sailed(name: str, law, course, hold: float, h: float = 0.05) -> Responses:
    """The plant itself under a controller, with the lag of its thrusters."""
    vessel, state, substeps = plant(name), at_rest((1,)), max(1, round(law.period / h))
    law.start(1)
    speeds, wanted = [], []
    for target in course:
        for _ in range(round(hold / law.period)):
            command = torch.as_tensor(law.command(target, state.surge.numpy()))[:, None].expand(1, 2)
            for _ in range(substeps):
                state = step(vessel, state, command, law.period / substeps)
                speeds.append(state.surge.numpy())
                wanted.append(target)
    time = law.period / substeps * np.arange(1, len(wanted) + 1)
    return Responses(time, np.array(wanted), np.array(speeds), np.zeros((len(wanted), 1)))


@pytest.mark.parametrize("name", BOATS)
def test_the_gains_hold_on_the_true_boat(sets, name):
    (boat,) = read_boats(sets[name])
    found = controller(boat)
    course = [found.speeds[0], found.rover.cruise_speed, found.speeds[-1]]
    for law in (RoverLaw(found.rover, found.period), MoosLaw(found.moos)):
        for each in steps_of(sailed(name, law, course, 25.0)):
            assert each.settled[0] < 20 and not each.sways[0], (name, each)
            assert each.overshoot[0] < (0.4 if isinstance(law, RoverLaw) else 0.15), (name, each)


def test_the_files_open_in_the_readers_that_they_are_for(sets, tmp_path, monkeypatch, capsys):
    mavparm = pytest.importorskip("pymavlink.mavparm")
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(sys, "argv", [])
    assert main(["controller", str(sets["heron"]), "--out", str(tmp_path), "--boats", "20"]) == 0
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
    picture = xml.etree.ElementTree.parse(tmp_path / "heron.controller.svg").getroot()
    assert "prefers-color-scheme: dark" in "".join(picture.itertext())
    for ending in (".png", "_dark.png"):
        assert (tmp_path / f"heron.controller{ending}").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--speed", "9"], "reaches"),
        (["--boat", "hero"], "expected heron"),
        (["--bandwidth", "50"], "give at most"),
        (["--out", __file__], "expected a folder"),
    ],
)
def test_bad_input_takes_one_sentence(sets, arguments, said, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [])
    with pytest.raises(SystemExit) as stopped:
        main(["controller", str(sets["heron"]), *arguments])
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
