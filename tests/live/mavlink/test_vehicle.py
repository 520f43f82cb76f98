"""The shell for MAVLink finds the vehicle, asks for what it needs, and gives the numbers that a log's reader gives."""

import math

import numpy as np
import pytest

pytest.importorskip("pymavlink", reason="needs the package pymavlink")

from tests.support.mavboat import ARDUPILOT, MavBoat, mavlink, turning
from tests.support.mavlab import BASE, RECEIPT, SOURCES, Lab
from usvlearn.core.events import Event
from usvlearn.errors import ConfigError
from usvlearn.live.mavlink.messages import WRAP
from usvlearn.live.node import Step
from usvlearn.live.plan_requests import Point
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.ardupilot.servos import Limits


# ---------------------------------------------------------------- the same numbers as a log
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    "sources",
    [
        SOURCES,
        {
            "command_left": Source("SERVO_OUTPUT_RAW", "servo1_raw", zero=1500, span=400),
            "command_right": Source("SERVO_OUTPUT_RAW@1.1", "servo3_raw", zero=1500, span=400),
            "heading": Source("ATT*TUDE", "yaw", "rad"),
            "surge": Source("LOCAL_POSITION_NED", "vx, vy", "m/s"),
        },
    ],
    ids=["by function", "by column"],
)
def test_live_numbers_and_stamps_are_those_that_a_log_gives(tmp_path, version, sources):
    lab = Lab([MavBoat(version=version, booted=-BASE)], sources)
    lab.sail(20)
    channels, dropped = lab.read_log(tmp_path)
    for part, channel in channels.items():
        time, raw = lab.session.channel(part)
        value = np.array([sources[part].convert(x) for x in raw])
        late = len(channel.value) - len(value)  # what came before the parameters were known
        assert len(value) > 150 and 0 <= late < 50
        np.testing.assert_array_equal(value, channel.value[late:])
        shift = channel.time[late:] - time
        np.testing.assert_allclose(shift, shift[0], rtol=0, atol=2e-6)
    assert all(not causes for causes in dropped.values())


def test_disarmed_commands_are_dropped_and_counted_as_in_a_log(tmp_path):
    lab = Lab()
    lab.sail(5)
    before = len(lab.session.channel("command_left")[0])
    lab.boat.armed = False
    lab.sail(4)
    assert lab.vehicle.condition(RECEIPT + lab.time) == "disarmed"
    lab.boat.armed = True
    lab.sail(4)
    _, dropped = lab.read_log(tmp_path)
    live = lab.session.dropped.count(("command_left", "disarmed"))
    assert live == dropped["command_left"]["disarmed"] and 35 <= live <= 50
    assert before < len(lab.session.channel("command_left")[0])
    assert ("heading", "disarmed") not in lab.session.dropped


def test_commands_are_dropped_until_the_parameters_are_known():
    lab = Lab()
    lab.deaf = True
    lab.sail(2)
    lab.boat.intervals = {36: 0.1, 30: 0.1, 32: 0.1}
    lab.sail(3)
    assert set(lab.session.dropped) == {("command_left", "no_parameters"), ("command_right", "no_parameters")}
    lab.deaf = False
    lab.sail(4)
    assert abs(lab.session.channel("command_left")[1][-1] - turning(lab.time).left) < 0.02


# ---------------------------------------------------------------- requests
def test_messages_are_asked_for_and_asked_again_after_a_reboot_and_a_loss():
    lab = Lab(hz=5.0)
    lab.sail(4)
    assert lab.boat.intervals == pytest.approx(dict.fromkeys((30, 32, 36), 0.2))
    lab.boat.reboot(lab.time)
    lab.sail(8)
    assert lab.session.restarts and lab.boat.intervals == pytest.approx(dict.fromkeys((30, 32, 36), 0.2))
    del lab.boat.intervals[30]
    lab.sail(10)
    assert lab.boat.intervals == pytest.approx(dict.fromkeys((30, 32, 36), 0.2))
    lab.boat.intervals[36] = 2.0  # a ground station has changed it
    lab.sail(10)
    assert lab.boat.intervals[36] == pytest.approx(0.2)


def test_a_message_that_comes_is_not_asked_for_again():
    lab = Lab()
    lab.sail(60)
    asked = [message for message in lab.boat.heard if message.get_type() == "COMMAND_LONG"]
    assert len(asked) == 3
    assert len(lab.boat.asked) <= 16 + 2 * 4 and len(set(lab.boat.asked)) == len(lab.boat.asked)


def test_a_boat_that_never_answers_is_not_flooded():
    lab = Lab()
    lab.boat.sends = {0}
    lab.boat.parameters = {}
    lab.sail(300)
    kinds = [message.get_type() for message in lab.boat.heard]
    assert kinds.count("COMMAND_LONG") < 50 and kinds.count("PARAM_REQUEST_READ") < 16 * 35
    assert any("found no such parameters" in line for line in lab.said)


def test_our_heartbeat_is_that_of_an_onboard_controller():
    lab = Lab([MavBoat(sender=(7, 1))])
    lab.sail(10)
    beats = [message for message in lab.boat.heard if message.get_type() == "HEARTBEAT"]
    assert 9 <= len(beats) <= 10
    assert {(m.get_srcComponent(), m.type, m.autopilot) for m in beats} == {(191, 18, 8)}
    assert beats[-1].get_srcSystem() == 7


# ---------------------------------------------------------------- who speaks
def test_ground_stations_and_other_components_are_no_vehicle():
    lab = Lab()
    link = mavlink.MAVLink(None, 255, 190)
    lab.give(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(link))
    lab.give(mavlink.MAVLink_heartbeat_message(26, 8, 0, 0, 4, 3).pack(mavlink.MAVLink(None, 1, 154)))
    assert lab.vehicle.address is None
    lab.sail(2)
    assert lab.vehicle.address == (1, 1)


def test_of_two_vehicles_the_first_or_the_chosen_one_is_heard():
    boats = [MavBoat(sender=(3, 1)), MavBoat(lambda t: turning(t)._replace(heading=3.0), sender=(4, 1))]
    lab = Lab(boats)
    lab.sail(8)
    assert lab.vehicle.address == (3, 1) and 3.0 not in lab.session.channel("heading")[1]
    assert "--system 4 would choose the other" in " ".join(lab.said)
    assert len([line for line in lab.said if "a second vehicle" in line]) == 1
    boats = [MavBoat(sender=(3, 1)), MavBoat(lambda t: turning(t)._replace(heading=3.0), sender=(4, 1))]
    lab = Lab(boats, system=4)
    lab.sail(8)
    assert lab.vehicle.address == (4, 1) and set(lab.session.channel("heading")[1]) == {3.0}


def test_a_silent_boat_gets_no_numbers_and_no_texts():
    lab = Lab()
    lab.sail(5)
    lab.mute = True
    lab.sail(6)
    before, texts = len(lab.boat.values), len(lab.boat.texts)
    lab.session.state = "stale"
    lab.sail(3)
    assert (len(lab.boat.values), len(lab.boat.texts)) == (before, texts)
    assert lab.vehicle.condition(RECEIPT + lab.time) == "system 1 is silent"
    assert lab.session.ticks > 13  # the session goes on all the same
    lab.mute = False
    lab.session.state = "ok"
    lab.sail(3)
    assert lab.boat.texts[-1][1] == "usvlearn: the session is ok"


def test_changes_of_health_and_alarms_are_told_in_texts():
    lab = Lab()
    lab.sail(5)
    lab.session.state = "stale"
    lab.sail(2)
    assert (4, "usvlearn: the session is stale") in lab.boat.texts
    lab.session.steps = [step(lab, events=(Event(0.0, "loss", "left", 0.4), Event(1.0, "recovery", "left")))]
    lab.sail(2)
    first, second, third, *_ = lab.boat.texts[-4:]
    assert first == (4, "usvlearn: the left thruster gives 40 % of its     ")
    assert second == (4, "thrust")
    assert third == (6, "usvlearn: the left thruster gives its full thrust ")
    values = {name: value for _, name, value in lab.boat.values}
    assert values["USV_PRED"] == 1.25 and values["USV_ERR"] == 0.25
    assert {ms for ms, _, _ in lab.boat.values} == {round(1000 * (7.0 + BASE))}


def test_a_command_answers_an_alarm_and_gets_an_acknowledgement():
    lab = Lab()
    lab.sail(5)
    ground = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    for target, command, first in ((191, 31010, 1), (191, 31010, 2), (191, 31010, 3), (1, 31010, 2), (191, 400, 1)):
        message = mavlink.MAVLink_command_long_message(1, target, command, 0, first, 0, 0, 0, 0, 0, 0)
        lab.give(message.pack(ground))
    assert lab.session.answers == ["acknowledge", "reset", ""]
    lab.sail(1)
    acks = [message for message in lab.boat.heard if message.get_type() == "COMMAND_ACK"]
    assert [(each.command, each.result) for each in acks] == [(31010, 0), (31010, 0), (31010, 2), (400, 2)]
    assert {(each.target_system, each.target_component) for each in acks} == {(255, 190)}


def test_forecasts_and_tracks_are_arrays_and_quantities_named_values():
    lab = Lab()
    lab.sail(5)
    place = Point(3.0, 1.0, 20.0, math.inf, math.inf, math.nan)
    held = {10.0: (1.4, 1.3, 1.5)}
    lab.session.last = step(lab)._replace(if_held=held, places={2.0: place, 10.0: place}, places_if_held={2.0: place})
    lab.session.identified = {"time_constant": (1.5, 1.0, 2.0, "s"), "thrust_ratio": (math.nan, math.nan, math.nan, "")}
    lab.sail(6)
    arrays = {m.name: m.data for m in lab.boat.heard if m.get_type() == "DEBUG_FLOAT_ARRAY"}
    assert list(arrays) == ["USV_FORE", "USV_TRACK", "USV_TRACKH"]
    assert [round(x, 3) for x in arrays["USV_FORE"][:7]] == [10.0, 1.4, 1.2, 1.6, 1.3, 1.5, 0.0]
    assert arrays["USV_TRACK"][7:11] == [10.0, 3.0, 1.0, 20.0] and arrays["USV_TRACKH"][7] == 0.0
    assert sum(m.get_type() == "DEBUG_FLOAT_ARRAY" for m in lab.boat.heard) == 3, "each step once"
    values = {name: value for _, name, value in lab.boat.values}
    assert values["USV_TAU"] == 1.5 and "USV_RATIO" not in values


def step(lab, events=(), speed=1.25):
    return Step(lab.time + BASE, 1.5, speed, 1.0, 1.5, 1.3, 1.1, 1.4, {10.0: (1.4, 1.2, 1.6)}, {}, {}, events)


def test_a_second_sender_of_the_same_id_is_left_out_and_told():
    """Two boats left at the default id 1 on one network."""
    alone, both = Lab(), Lab([MavBoat(booted=-BASE), MavBoat(booted=-40.0)])
    both.places = ["127.0.0.1:5001", "127.0.0.1:5002"]
    for lab in (alone, both):
        lab.sail(20)
    for part in SOURCES:
        for one, other in zip(alone.session.channel(part), both.session.channel(part), strict=True):
            np.testing.assert_allclose(one, other)
    lines = [line for line in both.said if "second sender" in line]
    assert len(lines) == 1 and "127.0.0.1:5002" in lines[0] and "--peer 127.0.0.1:5002" in lines[0]
    assert both.session.dropped.count(("vehicle", "second_sender")) > 500


def test_a_sender_that_changes_is_followed_after_a_silence_and_told():
    lab = Lab()
    lab.places = ["127.0.0.1:5001"]
    lab.sail(10)
    lab.places = ["127.0.0.1:6001"]  # its router was restarted
    lab.sail(3)
    before = len(lab.session.channel("heading")[0])
    lab.sail(10)
    assert len(lab.session.channel("heading")[0]) > before + 60
    assert lab.said[-1] == "system 1 is heard from 127.0.0.1:6001 now, no longer 127.0.0.1:5001"
    assert not [line for line in lab.said if "second sender" in line]  # it is one, that has booted


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["MIN", "TRIM", "MAX", "REVERSED"])
def test_a_servo_parameter_that_is_no_number_is_told(name, bad):
    """No warning of NumPy, which pytest makes an error; no command that is not a number."""
    lab, parameters = Lab(), {f"SERVO1_{name}": bad} | ({"SERVO1_MIN": bad} if name == "TRIM" and bad < 0 else {})
    lab.sail(6)
    for parameter, value in parameters.items():
        message = mavlink.MAVLink_param_value_message(parameter.encode(), value, 9, 24, 1)
        lab.give(lab.boat.packed(message))
    before = len(lab.session.channel("command_left")[0])
    lab.sail(2)
    assert len(lab.session.channel("command_left")[0]) == before > 0
    assert any(f"SERVO1_{name} {bad:g}" in line and "finite numbers" in line for line in lab.said)


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


# ---------------------------------------------------------------- time
def test_a_reboot_and_the_wrap_of_the_clock_begin_a_new_segment():
    lab = Lab([MavBoat(booted=-(WRAP - 5000) / 1000)])  # 5 s before the wrap
    lab.sail(4)
    assert not lab.session.restarts
    lab.sail(10)
    assert len(lab.session.restarts) == 1
    assert lab.session.pushed[-1][1] < 10 < 4e6 < lab.session.pushed[0][1]
    lab.boat.reboot(lab.time)
    lab.sail(4)
    assert len(lab.session.restarts) == 2
    for begin, end in zip([0, *lab.session.restarts], [*lab.session.restarts, None], strict=True):
        stamps = [stamp for _, stamp, _ in lab.session.pushed[begin:end]]
        assert np.all(np.diff(stamps) > -0.5)


def test_one_wrong_stamp_changes_nothing():
    lab = Lab()
    lab.sail(6)
    for ms in (1, 10**9, 2**32 - 1):
        lab.give(lab.boat.packed(mavlink.MAVLink_attitude_message(ms, 0, 0, 3.0, 0, 0, 0)))
        lab.sail(1)
    assert not lab.session.restarts
    assert lab.session.dropped.count(("heading", "no_time")) == 3
    assert 3.0 not in lab.session.channel("heading")[1]


def test_a_clock_that_jumps_ahead_is_followed():
    lab = Lab()
    lab.sail(5)
    lab.boat.booted -= 3600.0
    lab.sail(5)
    assert not lab.session.restarts and lab.session.pushed[-1][1] > 3600


def test_stamps_of_32_bits_in_us_are_continued():
    lab = Lab([MavBoat(booted=-4294.0)])  # 2^32 us are 4294.97 s
    lab.sail(10)
    stamps = lab.session.channel("command_left")[0]
    assert np.all(np.abs(np.diff(stamps) - 0.1) < 1e-3) and abs(stamps[-1] - 4304.0) < 0.2
    assert not lab.session.restarts
