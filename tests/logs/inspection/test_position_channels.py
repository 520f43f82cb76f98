"""Which of two columns is the latitude: by their names, and by the speed; and what a position tells of a speed."""

import numpy as np
import pytest

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
