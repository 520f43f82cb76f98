"""Logs of strangers: what `usvlearn inspect` concludes of them, and where it asks in place of guessing."""

import numpy as np
import pytest

from tests.support.ardupilot import PARAMETERS, dataflash
from tests.support.strangers import concluded, driven, pulses, sail, tell, told
from usvlearn.logs.channels.series import Series
from usvlearn.logs.inspection.candidate import candidates, missing_values
from usvlearn.logs.inspection.inspected import inspect_logs
from usvlearn.logs.inspection.vocabulary import fit


@pytest.mark.parametrize("names", [("RCOU__C1", "RCOU__C3"), ("output_1", "output_2"), ("servo1", "servo3")])
def test_what_drives_the_speed_alone_is_a_throttle_and_no_side(names):
    boat = sail(6)
    steer, throttle = 1500 + 300 * (boat["l"] - boat["r"]), 1500 + 200 * (boat["l"] + boat["r"])
    proposal = concluded(boat, **dict(zip(names, (steer, throttle), strict=True)), heading=boat["hdg"], speed=boat["u"])
    both = [proposal.channels[f"command_{side}"] for side in ("left", "right")]
    assert both[0] == both[1]
    assert both[0].get("field", both[0]["name"]) == names[1].split("__")[-1]
    assert told(proposal)["command_left", "series"][1] == "unsure"


def test_two_rudders_and_two_motors_with_the_same_commands_are_no_sides():
    boat = sail(6)
    steer, throttle = 1500 + 300 * (boat["l"] - boat["r"]), 1500 + 200 * (boat["l"] + boat["r"])
    outputs = {"RCOU__C1": steer, "RCOU__C2": steer, "RCOU__C3": throttle, "RCOU__C4": throttle}
    proposal = concluded(boat, **outputs, heading=boat["hdg"], speed=boat["u"])
    assert {proposal.channels[f"command_{side}"]["field"] for side in ("left", "right")} == {"C3"}


@pytest.mark.parametrize("steering", [26.0, 73.0])
def test_the_parameters_of_an_autopilot_decide_first(tmp_path, steering):
    path, throttle = tmp_path / "a.bin", 70.0 if steering == 26 else 74.0
    functions = {"SERVO1_FUNCTION": steering, "SERVO3_FUNCTION": throttle}
    path.write_bytes(dataflash(80, PARAMETERS | functions))
    proposal = inspect_logs([str(path)]).proposal
    fields = [proposal.channels[f"command_{side}"]["field"] for side in ("left", "right")]
    assert fields == (["throttle"] * 2 if steering == 26 else ["throttle_left", "throttle_right"])
    assert told(proposal)["command_left", "span"] == ("1", "certain")


def test_the_known_messages_of_a_format_stand_before_backups_and_whole_degrees():
    boat = sail()
    whole, fine = np.round(boat["hdg"]), (boat["psi"] + np.pi) % (2 * np.pi) - np.pi
    north, east = (boat["u"] * each(boat["psi"]) for each in (np.cos, np.sin))
    ways = {"LOCAL_POSITION_NED__vx": north, "LOCAL_POSITION_NED__vy": east, "VFR_HUD__groundspeed": boat["sog"]}
    proposal = concluded(boat, "MAVLink telemetry", AHRS2__yaw=fine, VFR_HUD__heading=whole, ATTITUDE__yaw=fine, **ways,
                      cmd_left=boat["l"], cmd_right=boat["r"])  # fmt: skip
    assert proposal.channels["heading"]["name"] == "ATTITUDE"
    assert [proposal.channels[f"velocity_{way}"]["field"] for way in ("north", "east")] == ["vx", "vy"]
    assert "surge" not in proposal.channels


def test_a_speed_without_a_sign_of_a_boat_that_goes_astern_is_replaced_or_told():
    boat = sail(6)
    alone, placed = driven(boat, sog=boat["sog"]), driven(boat, sog=boat["sog"], lat=boat["lat"], lon=boat["lon"])
    course = driven(boat, sog=boat["sog"], cog=boat["cog"])
    assert told(alone)["surge", "sign"] == ("never astern", "unsure")
    assert told(placed)["surge", "series"] == ("from the position", "probable")
    assert "surge" not in placed.channels
    assert {"ground_speed", "course"} <= course.channels.keys()
    assert driven(boat, sog=boat["sog"], ekf_speed=boat["u"]).channels["surge"]["name"] == "ekf_speed"
    ahead = sail(6, lowest=0.0)
    assert driven(ahead, sog=np.abs(ahead["u"])).channels["surge"]["name"] == "sog"


@pytest.mark.parametrize(("seed", "lowest"), [(2, -0.3), (3, -0.8), (8, -0.3)])
@pytest.mark.parametrize("names", [("sog", "cog"), ("speed_over_ground", "course_over_ground")])
def test_a_boat_that_goes_astern_by_its_course_has_a_speed_by_both(names, seed, lowest):
    """Its commands do not tell: they are astern for too short."""
    boat = sail(4, seed, lowest)
    along = dict(zip(names, (boat["sog"], boat["cog"]), strict=True))
    assert tell(boat, "surge series", **along) == ("from speed and course", "probable")
    assert driven(boat, **along | {names[0]: boat["u"]}).channels["surge"]["name"] == names[0]  # it has its sign


@pytest.mark.parametrize("names", [("r_speed", "y_speed", "e_speed"), ("speed_r", "speed_y", "speed_e")])
def test_the_output_of_a_controller_is_the_speed_not_its_reference(names):
    boat = sail()
    wanted = 1.2 * (boat["u"] > 0.2)
    proposal = driven(boat, **dict(zip(names, (wanted, boat["u"], wanted - boat["u"]), strict=True)))
    assert proposal.channels["surge"]["name"] == names[1]
    assert told(proposal)["surge", "series"][0] == names[1]


def test_of_two_speeds_that_which_follows_the_commands_is_taken():
    boat = sail(6)
    other = 1 + np.cumsum(np.random.default_rng(0).normal(0, 0.05, len(boat["u"]))) / 5
    assert driven(boat, speed=other, vel=boat["u"]).channels["surge"]["name"] == "vel"


@pytest.mark.parametrize("scale", [400, 350])
def test_a_boat_that_turns_on_the_spot_does_not_tell_the_zero(scale):
    """Each side has its own mean then: 1500 is asked, with what it is else."""
    boat, rng = sail(6), np.random.default_rng(0)
    still, off = (boat["l"] == 0) & (boat["r"] == 0), rng.uniform(10, 60, len(boat["l"]))
    left, right = (1500 + np.where(still, sign * off, scale * boat[side]) for side, sign in (("l", -1), ("r", 1)))
    speed = np.where(still, 0.02, boat["u"])
    proposal = concluded(boat, left=left, right=right, heading=boat["hdg"], speed=speed)
    (zero,) = (each for each in proposal.decisions if each[:2] == ("command_left", "zero"))
    assert (zero.value, zero.certainty) == ("1500", "unsure")
    assert 1455 < float(zero.alternatives[0]) < 1475


NEUTRALS = [(7.5, 2, -0.8), (80, 15, -0.8), (0.075, 0.02, -0.8), (2048, 1500, -0.8), (1520, 400, -0.8)]
IDLE = [(1000, 1000, 0.0), (1100, 800, 0.0), (5, 5, 0.0)]


@pytest.mark.parametrize(("zero", "span", "lowest"), [*NEUTRALS, *IDLE])
def test_where_the_boat_stands_decides_the_zero(zero, span, lowest):
    boat = sail(6, 2, lowest)
    left, right = (zero + span * boat[side] for side in "lr")
    proposal = concluded(boat, duty_left=left, duty_right=right, heading=boat["hdg"], speed=boat["u"])
    channel = proposal.channels["command_left"]
    assert channel["zero"] == pytest.approx(zero, rel=1e-3)
    assert channel["span"] == pytest.approx(span, rel=0.03)
    assert told(proposal)["command_left", "zero"][1] == "probable"


def test_a_dead_zone_is_told():
    boat = sail(6)
    idle = 20 * np.random.default_rng(0).uniform(-1, 1, len(boat["l"]))
    left, right = (1500 + np.where(share == 0, idle, 380 * share) for share in (boat["l"], boat["r"]))
    proposal = concluded(boat, pwm_left=left, pwm_right=right, heading=boat["hdg"], speed=boat["u"])
    (why,) = (each.reason for each in proposal.decisions if each[:2] == ("command_left", "zero"))
    assert "14" in why and "15" in why and "a dead zone" in why


@pytest.mark.parametrize("seed", range(4))
def test_commands_of_any_kind_make_no_error(seed):
    rng, boat = np.random.default_rng(seed), sail()
    size = len(boat["l"])
    kinds = [rng.normal(1500, 90, size), rng.integers(0, 2, size), rng.integers(0, 3, size) * 50 + 50, np.arange(size)]
    kinds += [np.full(size, 7.5), np.where(rng.random(size) < 0.5, 1e9, 1.0)]
    for left in kinds:
        for right in kinds:
            concluded(boat, esc_left=left, esc_right=right, heading=boat["hdg"], speed=np.abs(rng.normal(0, 1, size)))


@pytest.mark.parametrize("bow", ["bow_thruster", "stern_tunnel_thruster", "Bugstrahlruder"])
def test_a_thruster_that_pushes_sideways_is_no_throttle(bow):
    boat = sail()
    proposal = concluded(boat, **{bow: 30 * np.sin(boat["time"] / 8)}, main_engine=50 * (boat["l"] + boat["r"]),
                      helm=20 * (boat["l"] - boat["r"]), heading=boat["hdg"], speed=boat["u"])  # fmt: skip
    assert {proposal.channels[f"command_{side}"]["name"] for side in ("left", "right")} == {"main_engine"}


@pytest.mark.parametrize(
    ("throttle", "rudder"),
    [("rev", "δ"), ("n", "delta"), ("rpm", "helm"), ("rps", "delta_cmd"), ("Drehzahl (1/min)", "Ruder (°)")],
)
def test_the_symbols_of_ships_are_known(throttle, rudder):
    boat = sail()
    proposal = concluded(boat, **{throttle: 5 * (boat["l"] + boat["r"]), rudder: boat["l"] - boat["r"]},
                      psi=boat["psi"] % 6.2832, u=boat["u"])  # fmt: skip
    assert proposal.channels["command_left"]["name"] == throttle
    assert "N: the" not in next(each.reason for each in proposal.decisions if each.what == "span")
    assert proposal.channels["surge"]["name"] == "u"


@pytest.mark.parametrize("name", ["Distance (m)", "Bearing", "Energy (Wh)", "range_m", "Peilung"])
def test_what_drives_nothing_is_no_command(name):
    boat = sail()
    proposal = concluded(boat, **{name: np.cumsum(np.abs(boat["u"]))}, heading=boat["hdg"], speed=boat["u"])
    assert {"command_left", "command_right"} <= set(proposal.missing)


def test_a_voltage_is_no_speed():
    boat = sail()
    volt = 16.8 - 0.6 * np.abs(boat["l"] + boat["r"])
    assert "surge" not in driven(boat, V_bat=volt, lat=boat["lat"], lon=boat["lon"]).channels
    assert driven(boat, v_battery=volt).missing == ["surge"]
    assert fit("surge", "v") >= 1


@pytest.mark.parametrize(("name", "factor", "unit"), [("speed_mph", 0.44704, "mph"), ("speed_ft_s", 0.3048, "ft/s")])
def test_english_units_are_known(name, factor, unit, tmp_path):
    boat = sail()
    table = {"time": boat["time"], "pwm_left": pulses(boat["l"]), "pwm_right": pulses(boat["r"]), "yaw": boat["hdg"],
             name: boat["u"] / factor, "rot (deg/min)": 60 * np.degrees(boat["turn"])}  # fmt: skip
    path = tmp_path / "a.csv"
    np.savetxt(path, np.array([*table.values()]).T, "%.5g", ",", header=",".join(table), comments="")
    result = inspect_logs([str(path)])
    units = {name: each.get("unit") for name, each in result.proposal.channels.items()}
    assert (units["surge"], units["yaw_rate"]) == (unit, "deg/min")
    surge = result.recordings[0].channels["surge"]
    assert np.abs(surge.value - np.interp(surge.time, boat["time"], boat["u"])).max() < 0.01


def test_numbers_that_mean_unknown_are_told_and_count_as_none():
    boat = sail()
    bad = np.random.default_rng(0).random(len(boat["u"])) < 0.03
    proposal = concluded(boat, cmd_left=100 * boat["l"], cmd_right=100 * boat["r"], hdt=np.where(bad, 511, boat["hdg"]),
                      sog=np.where(bad, 102.3, boat["u"]))  # fmt: skip
    assert [proposal.channels[name]["missing"] for name in ("heading", "surge")] == [[511.0], [102.3]]
    assert told(proposal)["command_left", "series"][1] == "certain"


@pytest.mark.parametrize("value", [np.arange(400) % 100, np.append(np.arange(50.0), [100.0] * 9), np.ones(99)])
def test_numbers_of_a_measurement_are_not_taken_for_unknown(value):
    assert missing_values(np.asarray(value, float)) == ()


def test_impossible_numbers_within_reach_mean_unknown():
    boat = sail(6)
    lost, no_fix = np.arange(len(boat["time"])) % 40 == 7, boat["time"] < 5
    heading = np.where(lost, -1, np.round(boat["hdg"] % 360, 1))
    lat, lon = (np.where(no_fix, 0, boat[key]) for key in ("lat", "lon"))
    left = np.where(lost, 0, pulses(boat["l"]))
    proposal = concluded(boat, pwm_left=left, pwm_right=pulses(boat["r"]), heading=heading, lat=lat, lon=lon)
    assert proposal.channels["heading"]["missing"] == [-1] and proposal.channels["command_left"]["missing"] == [0]
    assert proposal.channels["latitude"]["missing"] == proposal.channels["longitude"]["missing"] == [0]


def test_a_propeller_at_the_bow_is_no_heading_and_electrical_power_no_command():
    boat = sail(6)
    proposal = driven(boat, helice_proa=30 * np.sin(boat["time"] / 8), speed=boat["u"])
    assert proposal.channels["heading"]["name"] == "heading"
    watts = {f"power_{side}_W": 300 * np.abs(boat[side[0]]) for side in ("left", "right")}
    assert "command_left" in concluded(boat, **watts, heading=boat["hdg"], speed=boat["u"]).missing


def test_full_scale_and_a_wrap_are_not_taken_for_unknown():
    boat = sail()
    left = np.where(boat["l"] > 0.9, 255, 90 * boat["l"])
    heading = np.where(np.arange(len(left)) % 50 < 2, 359, 40 * np.abs(boat["l"]))
    proposal = concluded(boat, motor_left=left, motor_right=90 * boat["r"], heading=heading, speed=boat["u"])
    assert not any("missing" in each for each in proposal.channels.values())


@pytest.mark.parametrize("letters", ["column", "cell"])
def test_degrees_and_minutes_with_their_letters_are_a_position(letters, tmp_path):
    boat, path = sail(), tmp_path / "a.csv"
    head = "time,thr_l,thr_r,heading,sog,lat,lon" + (",ns,ew" if letters == "column" else "")
    lines = [head]
    for k, time in enumerate(boat["time"]):
        places = [abs(boat[name][k]) for name in ("lat", "lon")]
        cells = [f"{int(each) * 100 + each % 1 * 60:.5f}" for each in places]
        cells = [*cells, "N", "W"] if letters == "column" else [cells[0] + "N", cells[1] + "W"]
        numbers = [f"{each:.4f}" for each in (time, boat["l"][k], boat["r"][k], boat["hdg"][k], 1.94384 * boat["u"][k])]
        lines.append(",".join([*numbers, *cells]))
    path.write_text("\n".join(lines))
    result = inspect_logs([str(path)])
    channels = result.recordings[0].channels
    assert np.degrees(channels["latitude"].value[0]) == pytest.approx(boat["lat"][0], abs=1e-6)
    assert np.degrees(channels["longitude"].value[0]) == pytest.approx(boat["lon"][0], abs=1e-6)
    assert result.proposal.channels["surge"]["unit"] == "knots"


@pytest.mark.parametrize(
    "names", [("u_ref", "u_out"), ("v_soll", "v_ist"), ("speed_d", "speed_m"), ("u_cmd", "u_meas")]
)
def test_the_measured_speed_is_taken_beside_its_reference(names):
    boat = sail(6)
    reference = np.where(boat["u"] > 0.2, 1.2, 0) + 0.3 * np.sin(boat["time"] / 30)
    assert tell(boat, "surge series", **dict(zip(names, (reference, boat["u"]), strict=True)))[0] == names[1]


@pytest.mark.parametrize(("name", "unit"), [("speed_m", ""), ("yaw_m", ""), ("depth_m", "m"), ("north_m", "m")])
def test_a_measured_speed_is_not_in_metres(name, unit):
    one = Series(name, None, np.arange(9.0), np.arange(9.0), np.arange(9), "m")
    assert candidates([one])[0].unit == unit


def test_where_no_name_tells_a_speed_those_that_may_be_it_are_named():
    boat = sail(6)
    proposal = driven(boat, w1=boat["u"], w2=20 + np.sin(boat["time"] / 30))
    assert proposal.missing == ["surge"] and proposal.unfit.startswith(
        "'w1' follows the commands: call it speed only if it is measured"
    )


@pytest.mark.parametrize("idle", [800, 650.0])
def test_a_motor_that_idles_has_no_certain_zero(idle):
    boat = sail(4, lowest=0.0)
    rpm = {f"rpm_{side}": np.round(idle + 3000 * boat[side[0]]) for side in ("left", "right")}
    zero = told(concluded(boat, **rpm, heading=boat["hdg"], speed=boat["u"]))["command_left", "zero"]
    assert zero == (f"{idle:g}", "probable") or zero[1] == "unsure"
    moving = {name: np.maximum(value, idle + 40) for name, value in rpm.items()}
    zero = told(concluded(boat, **moving, heading=boat["hdg"]))["command_left", "zero"]
    assert zero[1] == "unsure"


def test_the_setpoint_of_a_speed_is_no_thrust_with_a_zero_of_its_own():
    boat = sail(4, lowest=0.0)
    speed = np.where(boat["time"] < 90, 1.8, 1.0 + 0.9 * (boat["time"] // 12 % 3))
    columns = {"/odom__heading": boat["psi"], "/odom__u": np.where(boat["time"] < 90, 0.0, boat["u"])}
    proposal = concluded(boat, **{"/cmd_vel__linear.x": speed, **columns})
    assert told(proposal)["command_left", "zero"][0] == "0"
    assert any("it names a speed" in each.reason for each in proposal.decisions if each.channel == "command_left")


@pytest.mark.parametrize(("name", "factor"), [("speed_kn", 1.944), ("v_kmh", 3.6), ("speed_mps", 1.0)])
def test_a_declared_unit_that_is_off_is_unsure_with_the_span_that_fits(name, factor):
    boat = sail(6)
    where = {"north": boat["n"], "east": boat["e"]}
    asked = []
    for off in (1.0, 0.92):
        proposal = driven(boat, **where, **{name: boat["u"] * factor * off})
        (unit,) = (each for each in proposal.decisions if each[:2] == ("surge", "unit"))
        asked.append(unit.certainty == "unsure" and "with span" in str(unit.alternatives))
    assert asked == [False, True]


@pytest.mark.parametrize(
    "words", [("forward", "neutral", "reverse"), ("F", "N", "R"), ("vorwärts", "stop", "rückwärts")]
)
@pytest.mark.parametrize("start", [0, 60])
def test_gears_of_text_beside_a_throttle_without_a_sign_are_asked(tmp_path, words, start):
    boat = {name: each[start:] for name, each in sail(4).items()}
    names = {1: words[0], 0: words[1], -1: words[2]}
    lines = ["time,left,gear_left,right,gear_right,heading,sog"]
    for t, left, right, heading, speed in zip(*(boat[x] for x in ("time", "l", "r", "hdg", "sog")), strict=True):
        gears = (names[int(np.sign(each))] for each in (left, right))
        lines.append(f"{t},{abs(left)},{next(gears)},{abs(right)},{next(gears)},{heading},{speed}")
    (path := tmp_path / "log.csv").write_text("\n".join(lines))
    signs = [each for each in inspect_logs([str(path)]).proposal.decisions if each.what == "sign"]
    assert {each.certainty for each in signs} == {"unsure"}
    assert "gear_left, gear_right may tell the sense" in signs[0].reason


@pytest.mark.parametrize(("pause", "away"), [(1500.0, 0.004), (20.0, -0.002), (86400.0, 0.01)])
def test_a_boat_that_was_carried_in_a_pause_has_one_unit_of_its_speed(pause, away):
    boat = sail(6)
    half = np.arange(len(boat["time"])) > 600
    moved = {"time": boat["time"] + pause * half, "lat": boat["lat"] + away * half}
    shifted = {**boat, **moved}
    assert tell(shifted, "surge unit", speed=shifted["u"], lat=shifted["lat"], lon=shifted["lon"]) == ("m/s", "certain")
