"""Commands and speeds come from the messages that the vehicle has, by its own parameters."""

import math

import numpy as np
import pytest

pytest.importorskip("pymavlink", reason="needs the package pymavlink")

from tests.support.mavboat import ARDUPILOT, MavBoat, turning
from tests.support.mavlab import Lab
from usvlearn.errors import ConfigError
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.ardupilot.servos import Limits


# ---------------------------------------------------------------- servos
def test_a_throttle_and_a_rudder_give_the_throttle_on_both_sides():
    parameters = {name: 0.0 if name.endswith("_FUNCTION") else value for name, value in ARDUPILOT.items()}
    lab = Lab([MavBoat(parameters=parameters | {"SERVO1_FUNCTION": 70.0, "SERVO3_FUNCTION": 26.0})])
    lab.sail(8)
    for part in ("command_left", "command_right"):
        assert abs(lab.session.channel(part)[1][-1] - turning(lab.time).left) < 0.02
    assert any("no servo has function 73; the throttle, servo 1, is taken" in line for line in lab.said)


def test_limits_that_change_are_used_at_once():
    lab = Lab()
    lab.sail(6)
    lab.boat.parameters["SERVO1_MAX"] = 1800.0
    lab.give(lab.boat.parameter("SERVO1_MAX"))  # as a ground station has set it
    lab.give(lab.boat.packed(lab.boat.message(36, lab.time)))
    pulse = lab.boat.message(36, lab.time).servo1_raw
    expected = float(Limits(1100, 1500, 1800).share(np.array([float(pulse)]))[0])
    assert lab.session.channel("command_left")[1][-1] == expected


@pytest.mark.parametrize("bad", [{"SERVO1_MIN": 1900.0}, {"SERVO1_MIN": math.nan}, {"SERVO1_FUNCTION": math.inf}])
def test_parameters_that_cannot_be_are_told_and_nothing_is_learned(bad):
    lab = Lab([MavBoat(parameters=ARDUPILOT | bad)])
    lab.sail(20)
    assert not len(lab.session.channel("command_left")[0]) and len(lab.session.channel("heading")[0])
    assert any("the vehicle: " in line for line in lab.said)
    assert any("the vehicle: " in text for _, text in lab.boat.texts)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (Source("RCOU", "C1"), "channels.heading.name: found 'RCOU', expected the name of a MAVLink message"),
        (Source("ATTITUDE", "Yaw"), "channels.heading.field: found 'Yaw', expected a field of ATTITUDE among roll"),
        (Source("ATTITUDE"), "channels.heading.field: found '', expected a field of ATTITUDE"),
        (Source("SERVO_OUTPUT_RAW", "servo1_raw", held=True), "channels.heading.held: found true, expected false"),
    ],
)
def test_channels_that_mavlink_cannot_give_are_refused(source, message):
    with pytest.raises(ConfigError) as caught:
        Lab(sources={"heading": source})
    assert str(caught.value).startswith(message)


# ---------------------------------------------------------------- where the speed comes from
def speed(session) -> float:
    (_, north), (_, east) = session.channel("velocity_north"), session.channel("velocity_east")
    return math.hypot(north[-1], east[-1])


def test_other_messages_give_the_velocity_where_the_best_is_missing():
    lab = Lab([MavBoat(sends=(0, 30, 33, 36, 74))])
    lab.sail(40)
    assert "the speed comes from GLOBAL_POSITION_INT now" in lab.said and 74 not in lab.boat.intervals
    assert abs(speed(lab.session) - 1.5) < 0.01  # it is sent in cm/s
    lab.boat.sends, lab.boat.intervals = {0, 30, 36, 74}, {30: 0.1, 36: 0.1}
    lab.sail(40)
    assert "the speed comes from VFR_HUD now" in lab.said
    assert abs(speed(lab.session) - 1.5) < 1e-6
    time, north = lab.session.channel("velocity_north")
    expected = turning(lab.time - 0.1)
    assert abs(north[-1] - expected.surge * math.cos(expected.heading)) < 0.02
    lab.boat.sends = {0, 30, 32, 36, 74}
    lab.sail(70)
    assert lab.said[-1] == "the speed comes from LOCAL_POSITION_NED now"
    assert np.all(np.diff(time) > 0)


def test_the_best_velocity_alone_is_used_while_it_comes():
    lab = Lab()
    lab.boat.intervals = {32: 0.1, 33: 0.1, 74: 0.1}  # a ground station has asked for all
    lab.sail(30)
    assert np.all(np.diff(lab.session.channel("velocity_north")[0]) > 0.05)
    assert not any("speed comes from" in line for line in lab.said)
