"""Which series is the speed, and how surely; which columns are the position, and what that tells of a speed."""

import math

import numpy as np
import pytest

from tests.support.strangers import driven, sail, tell, told
from usvlearn.logs.channels.correlations import Relation
from usvlearn.logs.channels.position_rates import speed_on_positions
from usvlearn.logs.inspection.candidate import Candidate
from usvlearn.logs.inspection.position_channels import METRES, Places, crossed, find_places
from usvlearn.logs.inspection.speeds import by_other, interchanged, read_speed


def placed(boat, noise=0.0):
    """Degrees of a receiver with so much noise, m."""
    rng, metre = np.random.default_rng(0), 1 / 111195
    north, east = (noise * metre * rng.normal(size=len(boat["lat"])) for _ in range(2))
    return {"lat": boat["lat"] + north, "lon": boat["lon"] + east / np.cos(np.radians(42.3))}


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("factor", [1.0, 0.93, 1.07])
def test_a_scale_that_is_a_little_wrong_is_found_where_the_boat_turns(factor, noise):
    boat = sail(8, lowest=0.0)
    proposal = driven(boat, speed=factor * boat["u"], **placed(boat, noise=noise))
    assert told(proposal)["surge", "unit"] == ("m/s", "certain" if factor == 1 else "unsure")


def steered(seed=0, minutes=6, rate=math.inf):
    """A boat whose speed is controlled, with its setpoint `ref`, that changes by `rate`, m/s², at most."""
    rng, step = np.random.default_rng(seed), 0.25
    goal = np.concatenate([np.full(int(rng.uniform(10, 25) / step), rng.uniform(0.3, 2)) for _ in range(50)])
    turn = np.repeat(rng.uniform(-0.3, 0.3, 600), 20)
    rows, ref, u, psi, n, e, push = [], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(int(minutes * 60 / step)):
        ref += float(np.clip(goal[k] - ref, -rate * step, rate * step))
        push += 0.1 * rng.normal() - 0.1 * push
        thrust = 0.4 * ref + 0.6 * (ref - u)
        u += step * (2.5 * thrust - u + 0.2 * push) / 2.5
        psi += step * turn[k]
        n, e = n + step * u * np.cos(psi), e + step * u * np.sin(psi)
        rows.append((k * step, thrust + turn[k], thrust - turn[k], psi, ref, u + 0.02 * rng.normal(), n, e))
    boat = dict(zip(("time", "l", "r", "psi", "ref", "u", "n", "e"), np.array(rows).T, strict=True))
    boat["hdg"] = np.degrees(boat["psi"]) % 360
    return boat | {"lat": 42.3 + boat["n"] / 111195, "lon": -71.1 + boat["e"] / 111195 / np.cos(np.radians(42.3))}


@pytest.mark.parametrize("rate", [math.inf, 0.2])
@pytest.mark.parametrize("name", ["speed", "vitesse", "v"])
def test_a_setpoint_is_no_speed_beside_a_position(name, rate):
    boat = steered(rate=rate)
    proposal = driven(boat, **{name: boat["ref"]}, **placed(boat))
    assert "surge" not in proposal.channels
    (told_of,) = (each for each in proposal.decisions if each.channel == "surge")
    assert told_of.reason.startswith(f"{name} is constant for long")


@pytest.mark.parametrize("factor", [1.0, 1.944])
def test_a_setpoint_without_a_position_is_asked(factor):
    boat = steered(1)
    assert tell(boat, "surge series", geschwindigkeit=factor * boat["ref"]) == ("geschwindigkeit", "unsure")


@pytest.mark.parametrize(("name", "measured"), [("speed", "v_filt"), ("velocity", "gps_v"), ("spd", "dvl_x")])
def test_what_follows_a_setpoint_is_the_speed_and_both_are_named(name, measured):
    boat = steered(2)
    proposal = driven(boat, **{name: boat["ref"], measured: boat["u"]})
    (series,) = (each for each in proposal.decisions if each[:2] == ("surge", "series"))
    assert (series.value, series.certainty, series.alternatives) == (measured, "unsure", (name,))
    named = driven(boat, **{name: boat["ref"]}, ist_speed=boat["u"])
    assert told(named)["surge", "series"] == ("ist_speed", "probable")


@pytest.mark.parametrize("held", [1, 4, 12])
def test_a_coarse_or_slow_speed_is_no_setpoint(held):
    boat = steered(3)
    speed = np.round(boat["u"][np.arange(len(boat["u"])) // held * held], 1)
    assert tell(boat, "surge series", speed=speed, other_ref=boat["ref"]) == ("speed", "probable")


@pytest.mark.parametrize("factor", [1.0, 1.944, 0.93])
@pytest.mark.parametrize("current", [0.8, 1.0])
def test_the_unit_of_a_speed_over_ground_is_known_in_a_current(current, factor):
    time, rng = np.arange(0, 600, 0.2), np.random.default_rng(0)
    turn = np.repeat(0.4 * rng.choice([-1, 0, 1], 60), 50)
    heading, speed = np.cumsum(0.2 * turn), 1.3 + 0.5 * np.sin(time / 11)
    rate = speed * np.exp(1j * heading) + current
    places = [(time, np.cumsum(0.2 * part)) for part in (rate.real, rate.imag)]
    relation = speed_on_positions(*places, (time, factor * np.abs(rate)), (time, heading))
    assert abs(relation.slope / factor - 1) < 0.02


@pytest.mark.parametrize(
    ("name", "factor", "place"),
    [("speed", -1, ("lat", "lon")), ("stw_kn", -1.944, ("north", "east")), ("fart", -3.6, ("lat", "lon"))],
)
def test_a_speed_that_is_negative_ahead_is_read_with_a_span(name, factor, place):
    boat = sail(6)
    columns = {**boat, "north": boat["n"], "east": boat["e"]}
    track = {each: columns[each] for each in place}
    proposal = driven(boat, **{name: factor * boat["u"]}, **track)
    assert (proposal.channels["surge"]["span"], told(proposal)["surge", "span"]) == (-1, ("-1", "probable"))
    assert told(proposal)["command_left", "sign"] == ("positive ahead", "certain")
    assert "span" not in driven(boat, **{name: -factor * boat["u"]}, **track).channels["surge"]


TIME = np.arange(0, 600, 0.2)


def sailed(latitude: float, longitude: float, names=("lat", "lon"), seconds: float = 600) -> tuple[Places, Candidate]:
    """A boat that turns and changes its speed, and the speed of its first seconds."""
    speed, course = 1.2 + np.sin(TIME / 7) ** 2, np.sin(TIME / 40) * 3 + TIME / 60
    north, east = (np.cumsum(0.2 * speed * f(course)) for f in (np.cos, np.sin))
    place = latitude + north / METRES, longitude + east / METRES / np.cos(np.radians(latitude))
    pool = [Candidate(name, None, "", "", TIME, value) for name, value in zip(names, place, strict=True)]
    (places,) = find_places(pool)
    part = seconds > TIME
    return places, Candidate("speed", None, "", "", TIME[part], speed[part])


@pytest.mark.parametrize("latitude", [-33.9, 21.0, 48.5, 60.0])
def test_the_speed_tells_latitude_from_longitude(latitude):
    places, speed = sailed(latitude, 9.0)
    assert interchanged(places, [speed]) == (places, False)
    places, speed = sailed(latitude, 9.0, ("lon", "lat"))
    right, doubtful = interchanged(places, [speed])
    assert (right.first.label, right.second.label, doubtful) == ("lon", "lat", False)


def test_no_speed_and_one_of_a_few_seconds_cast_no_doubt():
    places, speed = sailed(48.5, 9.0, seconds=30)
    assert interchanged(places, [speed]) == interchanged(places, []) == (places, False)


def test_a_longitude_beyond_90_degrees_is_no_latitude():
    assert crossed(sailed(37.8, -122.4)[0]) is None and crossed(sailed(37.8, -72.4)[0]) is not None


@pytest.mark.parametrize("kind", ["geometry_msgs/msg/TwistStamped", "nav_msgs/msg/Odometry", "geometry_msgs"])
@pytest.mark.parametrize("slope", [1.94, 0.5, 1.4])
def test_a_ros_twist_stays_in_its_unit_and_the_factor_is_said(kind, slope):
    def speed(kind: str, slope: float):
        relation = Relation(slope, 0.98, 0.01, 0.0, 600.0)
        return read_speed(Candidate("v", "x", "", kind, TIME, np.sin(TIME)), relation, "ROS 2 (MCAP)", 3.0)

    read = speed(kind, slope)
    assert (read.unit, read.certainty) == ("m/s", "unsure") and f"but {slope:.3g} × the rate" in read.reason
    assert read.alternatives[-1] == f"m/s, with span: {slope:.3g}" and by_other(read, speed("", 1.0)) == read
    assert (speed(kind, 1.02).unit, speed(kind, 1.02).certainty) == ("m/s", "certain")
    assert (speed("geometry_msgs/msg/Vector3", 1.94).unit, speed("", 1.94).certainty) == ("knots", "certain")


def sources(proposal):
    return {name: (each.get("unit"), each.get("span", 1.0)) for name, each in proposal.channels.items()}


@pytest.mark.parametrize(
    ("names", "metres"),
    [(("northing_ft", "easting_ft"), 0.3048), (("Northing (km)", "Easting (km)"), 1e3), (("y_nm", "x_nm"), 1852.0),
     (("pos_north_yards", "pos_east_yards"), 0.9144)],
)  # fmt: skip
@pytest.mark.parametrize("speed", [1.0, 3.2808])
def test_the_name_of_a_position_tells_its_unit(names, metres, speed):
    boat = sail(5, lowest=0.0)
    place = {name: boat[key] / metres for name, key in zip(names, "ne", strict=True)}
    proposal = driven(boat, speed=speed * boat["u"], **place)
    scale = ("m", float(f"{1 / metres:.6g}"))
    assert (sources(proposal)["north"], sources(proposal)["east"]) == (scale, scale)
    (unit,) = (each for each in proposal.decisions if each[:2] == ("surge", "unit"))
    assert (unit.value, unit.certainty) == (("m/s", "certain") if speed == 1 else ("ft/s", "unsure"))
    assert speed == 1 or unit.alternatives[0] == "km/h"


def test_a_position_in_metres_by_assumption_proves_no_unit():
    boat = sail(5, lowest=0.0)
    feet = {key: boat[key] / 0.3048 for key in "une"}
    place = {"north": feet["n"], "east": feet["e"]}
    assert told(driven(boat, speed=feet["u"], **place))["surge", "unit"] == ("m/s", "probable")
    assert told(driven(boat, speed_mps=boat["u"], north=boat["n"], east=boat["e"]))["surge", "unit"][1] == "certain"
    (north,) = (each for each in driven(boat, **place).decisions if each.channel == "north")
    assert north.certainty == "probable" and "taken as m" in north.reason


@pytest.mark.parametrize("place", [(-33.8, 151.2), (1.3, 103.8), (41.0, -122.3), (-35.0, 100.0)])
def test_a_longitude_beyond_100_degrees_is_no_degrees_and_minutes_and_is_told_where_it_is_called_latitude(place):
    boat = sail(6)
    shrunk = np.cos(np.radians(42.3)) / np.cos(np.radians(place[0]))
    lat, lon = place[0] + boat["lat"] - 42.3, place[1] + (boat["lon"] + 71.1) * shrunk
    for names in (("lat", "lon"), ("lon", "lat")):
        proposal = driven(boat, speed=boat["u"], **dict(zip(names, (lat, lon), strict=True)))
        channels = [proposal.channels[each] for each in ("latitude", "longitude")]
        assert [(each["name"], each["unit"]) for each in channels] == [(name, "deg") for name in names]
        assert told(proposal)["latitude", "series"][1] == ("certain" if names[0] == "lat" else "unsure")
