"""Which of two columns is the latitude: by their names, and by the speed; and what a position tells of a speed."""

import numpy as np
import pytest

from tests.support.strangers import driven, sail, told
from usvlearn.logs.channels.correlations import Relation
from usvlearn.logs.inspection.candidate import Candidate
from usvlearn.logs.inspection.position_channels import METRES, Places, crossed, find_places
from usvlearn.logs.inspection.speeds import by_other, interchanged, read_speed

TIME = np.arange(0, 600, 0.2)


def sailed(latitude: float, longitude: float, names=("lat", "lon"), seconds: float = 600) -> tuple[Places, Candidate]:
    """A boat that turns and changes its speed, and the speed of its first seconds."""
    speed, course = 1.2 + np.sin(TIME / 7) ** 2, np.sin(TIME / 40) * 3 + TIME / 60
    north, east = (np.cumsum(0.2 * speed * f(course)) for f in (np.cos, np.sin))
    place = latitude + north / METRES, longitude + east / METRES / np.cos(np.radians(latitude))
    pool = [Candidate(name, None, "", "", TIME, value) for name, value in zip(names, place, strict=True)]
    (found,) = find_places(pool)
    kept = seconds > TIME
    return found, Candidate("speed", None, "", "", TIME[kept], speed[kept])


@pytest.mark.parametrize("latitude", [-33.9, 21.0, 48.5, 60.0])
def test_the_speed_tells_latitude_from_longitude(latitude):
    places, speed = sailed(latitude, 9.0)
    assert interchanged(places, [speed]) == (places, False)
    places, speed = sailed(latitude, 9.0, ("lon", "lat"))
    found, doubtful = interchanged(places, [speed])
    assert (found.first.label, found.second.label, doubtful) == ("lon", "lat", False)


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

    found = speed(kind, slope)
    assert (found.unit, found.certainty) == ("m/s", "unsure") and f"but {slope:.3g} × the rate" in found.reason
    assert found.alternatives[-1] == f"m/s, with span: {slope:.3g}" and by_other(found, speed("", 1.0)) == found
    assert (speed(kind, 1.02).unit, speed(kind, 1.02).certainty) == ("m/s", "certain")
    assert (speed("geometry_msgs/msg/Vector3", 1.94).unit, speed("", 1.94).certainty) == ("knots", "certain")


def sources(found):
    return {name: (each.get("unit"), each.get("span", 1.0)) for name, each in found.channels.items()}


@pytest.mark.parametrize(
    ("names", "metres"),
    [(("northing_ft", "easting_ft"), 0.3048), (("Northing (km)", "Easting (km)"), 1e3), (("y_nm", "x_nm"), 1852.0),
     (("pos_north_yards", "pos_east_yards"), 0.9144)],
)  # fmt: skip
@pytest.mark.parametrize("speed", [1.0, 3.2808])
def test_the_name_of_a_position_tells_its_unit(names, metres, speed):
    boat = sail(5, lowest=0.0)
    place = {name: boat[key] / metres for name, key in zip(names, "ne", strict=True)}
    found = driven(boat, speed=speed * boat["u"], **place)
    scale = ("m", float(f"{1 / metres:.6g}"))
    assert (sources(found)["north"], sources(found)["east"]) == (scale, scale)
    (unit,) = (each for each in found.decisions if each[:2] == ("surge", "unit"))
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
        found = driven(boat, speed=boat["u"], **dict(zip(names, (lat, lon), strict=True)))
        kept = [found.channels[each] for each in ("latitude", "longitude")]
        assert [(each["name"], each["unit"]) for each in kept] == [(name, "deg") for name in names]
        assert told(found)["latitude", "series"][1] == ("certain" if names[0] == "lat" else "unsure")
