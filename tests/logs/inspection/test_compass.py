"""Headings, compasses and yaw rates of strangers' logs: units, what proves them, and what makes them doubtful."""

import math

import numpy as np
import pytest

from tests.support.strangers import concluded, driven, pulses, sail, tell, told


def test_a_declared_unit_of_an_angle_stands_above_its_size():
    boat = sail(6)
    proposal = concluded(
        boat, pwm_left=pulses(boat["l"]), pwm_right=pulses(boat["r"]), yaw_rad=boat["psi"] + 40, u=boat["u"]
    )
    assert proposal.channels["heading"]["unit"] == "rad"


@pytest.mark.parametrize("off", [20, -35, 9])
def test_the_error_of_a_compass_is_proposed_as_its_zero(off):
    boat = sail(6)
    turned = {**boat, "hdg": (boat["hdg"] + off) % 360}
    proposal = driven(turned, speed=boat["u"], lat=boat["lat"], lon=boat["lon"])
    assert proposal.channels["heading"]["zero"] == pytest.approx(off, abs=1.5)
    assert told(proposal)["heading", "zero"][1] == "probable"


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_current_is_no_error_of_the_compass(seed):
    boat = sail(6, seed)
    lat, lon = (boat[name] + way * boat["time"] / 111195 for name, way in (("lat", 0.5), ("lon", -0.4)))
    assert "zero" not in driven(boat, speed=boat["u"], lat=lat, lon=lon).channels["heading"]


def test_the_yaw_of_moos_counts_counter_clockwise_from_north():
    boat = sail()
    proposal = concluded(boat, "MOOS", NAV_YAW=-((boat["psi"] + np.pi) % (2 * np.pi) - np.pi), NAV_SPEED=boat["u"],
                      DESIRED_THRUST_L=100 * boat["l"], DESIRED_THRUST_R=100 * boat["r"])  # fmt: skip
    assert (proposal.channels["heading"]["unit"], proposal.channels["heading"]["span"]) == ("rad", -1)
    assert told(proposal)["command_left", "series"] == ("DESIRED_THRUST_L", "certain")


@pytest.mark.parametrize(("seed", "begin", "sign"), [(1, 0.0, 1), (2, 6.0, 1), (3, -3.0, -1)])
def test_radians_that_count_on_are_radians_or_a_question_that_says_both(seed, begin, sign):
    boat = sail(6, seed)
    columns = {"yaw": sign * boat["psi"] + begin, "speed": boat["u"]}
    proposal = concluded(boat, pwm_left=pulses(boat["l"]), pwm_right=pulses(boat["r"]), **columns)
    unit = next(each for each in proposal.decisions if each[:2] == ("heading", "unit"))
    assert unit.value == "rad" and (unit.certainty == "certain" or {"deg", "enu_rad"} <= {*unit.alternatives})
    steady = concluded(boat, pwm_left=pulses(boat["l"]), pwm_right=pulses(boat["r"]), **columns | {
        "yaw": 40 + 9 * np.sin(boat["time"] / 9)})  # fmt: skip
    assert told(steady)["heading", "unit"] in (("deg", "unsure"), ("rad", "unsure"))


@pytest.mark.parametrize("off", [20.0, -15.0])
@pytest.mark.parametrize("names", [("cog", "sog"), ("course", "speed")])
def test_a_compass_that_is_off_is_told_by_a_course_without_a_position(off, names):
    boat = sail(8, 6)
    along = dict(zip(names, (boat["cog"], boat["sog"]), strict=True))
    proposal = concluded(
        boat, pwm_left=pulses(boat["l"]), pwm_right=pulses(boat["r"]), heading=(boat["hdg"] + off) % 360, **along
    )
    value, sure = told(proposal)["heading", "zero"]
    assert float(value) == pytest.approx(off, abs=2) and sure == "probable"
    assert ("heading", "zero") not in told(driven(boat, **along))


@pytest.mark.parametrize(("off", "certainty"), [(0.0, "certain"), (180.0, "unsure")])
@pytest.mark.parametrize("sense", [1, -1])
def test_a_course_confirms_a_right_heading_and_tells_one_that_points_astern(off, certainty, sense):
    boat = sail(6, lowest=0.0)
    yaw = (off + (boat["hdg"] if sense == 1 else 90 - boat["hdg"])) % 360
    proposal = concluded(boat, left=boat["l"], right=boat["r"], yaw=yaw, sog=boat["sog"], cog=boat["cog"])
    assert told(proposal)["heading", "unit"] == ("deg" if sense == 1 else "enu_deg", certainty)
    assert proposal.channels["heading"].get("zero", 0.0) % 360 == pytest.approx(off % 360, abs=3)


def velocity(boat, names=("vn", "ve"), ways=(0.0, 0.0), factor=1.0):
    """The velocity over ground, with a current, m/s."""
    psi, u, v = boat["psi"], boat["u"], boat["v"]
    north, east = u * np.cos(psi) - v * np.sin(psi) + ways[0], u * np.sin(psi) + v * np.cos(psi) + ways[1]
    return dict(zip(names, (factor * north, factor * east), strict=True))


@pytest.mark.parametrize(
    ("off", "names", "factor", "place"),
    [(90, ("vn", "ve"), 1.0, ()), (-30, ("vel_n", "vel_e"), 1.94, ()), (150, ("VN_kn", "VE_kn"), 1.94, ("x", "y"))],
)
def test_a_compass_that_is_off_is_told_by_velocities_without_a_position(off, names, factor, place):
    boat = sail(6, lowest=-0.2)
    local = dict(zip(place, (boat["n"], boat["e"]), strict=False))
    motion = velocity(boat, names, (0.2, -0.1), factor) | local
    proposal = driven({**boat, "hdg": (boat["hdg"] + off) % 360}, **motion)
    assert proposal.channels["heading"]["zero"] == pytest.approx(off, abs=2)
    assert told(proposal)["heading", "zero"][1] == "probable"
    right = told(driven(boat, **motion))
    assert ("heading", "zero") not in right and right["heading", "series"][1] == "certain"


@pytest.mark.parametrize("names", [("lat", "lon"), ("Breite", "Länge"), ("VN", "VE"), ("velN", "velE")])
def test_a_track_that_may_be_a_mirror_image_proves_no_heading(names):
    boat, sides = sail(6, lowest=-0.2), ("motor_l", "motor_r")
    motors = dict(zip(sides, (boat["l"], boat["r"]), strict=True))
    way = velocity(boat) if names[0].startswith(("V", "v")) else {"n": boat["lat"] - 32, "e": boat["lon"] + 80}
    right = concluded(
        boat, **motors, heading=boat["hdg"], speed=boat["u"], **dict(zip(names, way.values(), strict=True))
    )
    assert told(right)["heading", "unit"] == ("deg", "certain")
    mirrored = dict(zip(names, list(way.values())[::-1], strict=True))
    proposal = concluded(boat, **motors, heading=boat["hdg"], **mirrored)
    assert [proposal.channels[f"command_{side}"]["name"] for side in ("left", "right")] == list(sides)
    north = "velocity_north" if "v" in names[0].lower() else "latitude"
    said = told(proposal)
    assert [said["heading", "unit"], said[north, "series"]] == [("deg", "unsure"), (names[1], "unsure")]


@pytest.mark.parametrize(("noise", "sure"), [(0.0, "probable"), (0.6, "unsure")])
@pytest.mark.parametrize("off", [20.0, -15.0, 100.0])
def test_the_error_of_a_compass_is_unsure_where_it_is_not_exact(noise, sure, off):
    boat, rng = sail(6, lowest=0.0), np.random.default_rng(1)
    place = {x: boat[x] + noise * 1e-5 * rng.normal(size=len(boat["lat"])) for x in ("lat", "lon")}
    proposal = concluded(
        boat, left=boat["l"], right=boat["r"], heading=(boat["hdg"] + off) % 360, speed=boat["u"], **place
    )
    (zero,) = (each for each in proposal.decisions if each[:2] == ("heading", "zero"))
    assert float(zero.value) == pytest.approx(off, abs=4) and zero.certainty == sure and "° ± " in zero.reason


@pytest.mark.parametrize("names", [("lat", "lon"), ("sog", "cog")])
def test_a_heading_that_follows_the_course_loosely_is_not_certain(names):
    boat = sail(6)
    for error, certainty in ((0.0, "certain"), (30 * np.sin(2 * boat["psi"]), "probable")):
        turned = {**boat, "hdg": (boat["hdg"] + error) % 360}
        assert tell(turned, "heading series", speed=boat["u"], **{name: boat[name] for name in names})[1] == certainty


@pytest.mark.parametrize("place", [("lat", "lon"), ()])
@pytest.mark.parametrize("ramp", [False, True])
def test_a_heading_that_is_set_is_no_measured_one(place, ramp):
    boat = sail(6)
    step = np.floor(boat["time"] / 12)
    goal = boat["hdg"][(48 * step).astype(int)]
    if ramp:
        goal = np.interp(boat["time"], [k * 12 + d for k in range(30) for d in (0, 8)], np.repeat(goal[::48], 2)[:60])
    steered, where = {**boat, "hdg": np.round(goal, 3)}, {name: boat[name] for name in place}
    assert tell(steered, "heading series", speed=boat["u"], **where) == ("heading", "unsure")
    assert tell(steered, "heading series", speed=boat["u"], compass=boat["hdg"], **where)[0] == "compass"


@pytest.mark.parametrize(("change", "sure"), [(1, "certain"), (0.8, "unsure"), (1.3, "unsure"), ("early", "unsure")])
@pytest.mark.parametrize("unit", [1, -1, 180 / np.pi])
def test_a_yaw_rate_of_another_scale_or_before_the_turn_is_not_certain(change, sure, unit):
    boat = sail(6)
    rate = np.roll(boat["turn"], -3) if change == "early" else change * boat["turn"]
    assert tell(boat, "yaw_rate series", speed=boat["u"], yaw_rate=unit * rate) == ("yaw_rate", sure)


@pytest.mark.parametrize(
    ("turn", "low", "step"),
    [(256, 0, 1), (256, -128, 1), (400, -200, 0.1), (3600, -1800, 1), (6400, 0, 1), (6400, -3200, 1), (36000, 0, 1),
     (65536, 0, 1), (65536, -32768, 1)],
)  # fmt: skip
@pytest.mark.parametrize("placed", [False, True])
def test_a_heading_that_goes_round_tells_what_a_full_turn_is(turn, low, step, placed):
    boat = sail(4, lowest=0.0)
    raw = (np.round(boat["psi"] / (2 * math.pi) * turn / step) * step - low) % turn + low
    proposal = concluded(
        boat,
        left=boat["l"],
        right=boat["r"],
        heading=raw,
        speed=boat["u"],
        **({"lat": boat["lat"], "lon": boat["lon"]} if placed else {}),
    )
    channel = proposal.channels["heading"]
    assert (channel["unit"], channel.get("span", 1.0)) == ("deg", float(f"{turn / 360:.6g}"))
    assert told(proposal)["heading", "unit"] == ("deg", "certain" if placed else "unsure")


@pytest.mark.parametrize("low", [0, -180])
@pytest.mark.parametrize("noise", [0.0, 0.4])
def test_a_heading_in_whole_degrees_stays_in_degrees(low, noise):
    boat = sail(4)
    raw = np.round((boat["hdg"] - low) % 360 + low) + noise * np.random.default_rng(0).normal(size=len(boat["hdg"]))
    channel = concluded(boat, left=boat["l"], right=boat["r"], heading=raw, speed=boat["u"]).channels["heading"]
    assert (channel["unit"], channel.get("span", 1.0)) == ("deg", 1.0)


@pytest.mark.parametrize("name", ["yaw_enu_rad", "heading_ENU", "att.enu.yaw"])
def test_a_name_tells_that_a_heading_counts_from_east(name):
    boat = sail(4)
    yaw = (math.pi / 2 - boat["psi"] + math.pi) % (2 * math.pi) - math.pi
    proposal = concluded(boat, left=boat["l"], right=boat["r"], speed=boat["u"], **{name: yaw})
    assert told(proposal)["heading", "unit"] == ("enu_rad", "probable")
    assert told(proposal)["command_left", "series"] == ("left", "certain")
