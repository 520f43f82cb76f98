"""Positions and sway against speed and heading: every mistake is named with the key that corrects it, and no other."""

import math

import numpy as np
import pytest

from tests.support.mistakes import (
    ALIGN,
    TOP,
    boats,
    changed,
    counter_clockwise,
    frozen,
    swapped,
    then,
    times,
    with_positions,
)
from usvlearn.logs.channels.channel import COURSES, DEGREES, METRES, SURGE, SWAY, VELOCITIES
from usvlearn.logs.channels.derived_surge import derived_surge
from usvlearn.logs.checks.data_check import check_data
from usvlearn.simulate.planar_fleet import planar_fleet

KNOT = 1852 / 3600
BOTH = {"command_left": {"name": "left"}, "command_right": {"name": "right"}, "heading": {"name": "psi", "unit": "deg"}}
GPS = {"latitude": {"name": "lat", "unit": "deg"}, "longitude": {"name": "lon", "unit": "deg"}}
LOCAL = {**BOTH, "surge": {"name": "u", "unit": "m/s"}, "north": {"name": "y"}, "east": {"name": "x"}}
GLOBAL = {**BOTH, **GPS, "velocity_north": {"name": "vn"}, "velocity_east": {"name": "ve"}, "yaw_rate": {"name": "r"}}
SIDEWAYS = {**BOTH, **GPS, "surge": {"name": "u"}, "sway": {"name": "v"}, "yaw_rate": {"name": "r"}}


def interchanged(one, other):
    return lambda log: {one: log[other], other: log[one]}


def with_sway(log):
    """The sway over ground by GPS and compass."""
    north, east = (log[name] for name in VELOCITIES)
    heading = np.interp(north.time, log["heading"].time, np.unwrap(log["heading"].value))
    return {SWAY: north._replace(value=east.value * np.cos(heading) - north.value * np.sin(heading))}


def with_course(log):
    """Speed and course over ground in place of the position and the velocities."""
    north, east = (log[name] for name in VELOCITIES)
    size, course = np.hypot(north.value, east.value), np.arctan2(east.value, north.value)
    return dict(zip(COURSES, (north._replace(value=size), north._replace(value=course)), strict=True))


def without_position(log):
    return {name: each for name, each in log.items() if name not in (*DEGREES, *METRES)}


def derived(log):
    """The surge that is computed from velocities as they are."""
    return {SURGE: derived_surge("log", {name: each for name, each in log.items() if name != SURGE})[0]}


def found(recordings, channels, top):
    return [(each.kind, each.about, each.key) for each in check_data(recordings, None, ALIGN, top, channels)]


@pytest.fixture(scope="module")
def local():
    """A boat that logs metres north and east beside its speed."""
    return changed(boats("heron", 0, 0.5), with_positions)


@pytest.fixture(scope="module")
def drifting():
    """A boat in a current that logs latitude, longitude and velocities over ground."""
    return planar_fleet(n=1, hours=0.4, seed=3)


SWAPPED = "data.channels.north.name=x data.channels.east.name=y"
MISTAKES = {
    "feet": (times(1 / 0.3048, *METRES), "position unit", "data.channels.north.span=3.28084"),
    "centimetres": (times(100, *METRES), "position unit", "data.channels.north.span=100 data.channels.east.span=100"),
    "interchanged": (interchanged(*METRES), "position axes", f"{SWAPPED} or data.channels.heading.unit=enu_deg"),
    "north reversed": (times(-1, "north"), "position axes", "data.channels.north.span=-1 or "),
    "east reversed": (times(-1, "east"), "position axes", "data.channels.east.span=-1 or "),
    "both reversed": (times(-1, *METRES), "heading offset", "data.channels.heading.zero="),
    "still": (times(0, *METRES), "position", ""),
    "heading and sides": (then(counter_clockwise, swapped), "position axes", SWAPPED),
    "speed in knots": (times(1 / KNOT, SURGE), "speed unit", "data.channels.surge.unit=knots"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_wrong_position_is_named_with_its_key(name, local):
    change, kind, key = MISTAKES[name]
    ((stated, _, fix),) = found(changed(local, change), LOCAL, TOP["heron"])
    assert stated == kind and fix.startswith(key)
    if kind in ("heading offset", "position axes"):  # nothing tells which of both is wrong
        assert " or data.channels." in fix


@pytest.mark.thorough
def test_a_right_position_is_no_finding(local, drifting):
    assert found(local, LOCAL, TOP["heron"]) == found(drifting, GLOBAL, 2.74) == found(drifting, {}, 2.74) == []


def test_a_wrong_heading_is_not_taken_for_a_wrong_position(local):
    (only,) = found(changed(local, counter_clockwise), LOCAL, TOP["heron"])
    assert only == ("heading sense", "heading", "data.channels.heading.unit=enu_deg")


def test_the_position_of_another_boat_is_told(local):
    others = changed(boats("heron", 7, 0.5), with_positions)
    pairs = zip(local, others, strict=True)
    mixed = [one._replace(channels={**one.channels, **{k: other.channels[k] for k in METRES}}) for one, other in pairs]
    assert [each[:2] for each in found(mixed, LOCAL, TOP["heron"])] == [("position", "north, east")]


@pytest.mark.thorough
def test_a_position_that_freezes_is_told_with_its_time(local, drifting):
    for recordings, channels, name in ((local, LOCAL, "east"), (drifting, GLOBAL, "longitude")):
        findings = check_data(changed(recordings, frozen(name, 200, 320)), None, ALIGN, 2.74, channels)
        (only,) = (each for each in findings if each.kind == "frozen")
        assert only.about == name and "from 20" in only.found and "speed and heading say" in only.found


GEOGRAPHIC = {
    "interchanged": (interchanged(*DEGREES), "position axes", "data.channels.latitude.name=lon"),
    "west is positive": (times(-1, "longitude"), "position axes", "data.channels.longitude.span=-1"),
    "radians as degrees": (times(math.pi / 180, *DEGREES), "position unit", "data.channels.latitude.unit=rad"),
    "parts of 1e-7": (times(1e7, *DEGREES), "position unit", "data.channels.latitude.unit=deg data.channels.latitude."),
    "velocities interchanged": (then(interchanged(*VELOCITIES), derived), "velocity axes",
                                "data.channels.velocity_north.name=ve data.channels.velocity_east.name=vn"),
    "velocity to the west": (then(times(-1, "velocity_east"), derived), "velocity axes",
                             "data.channels.velocity_east.span=-1"),
    "velocities in knots": (then(times(1 / KNOT, *VELOCITIES), derived), "speed unit",
                            "data.channels.velocity_north.unit=knots data.channels.velocity_east.unit=knots"),
}  # fmt: skip


@pytest.mark.parametrize("name", GEOGRAPHIC)
def test_latitude_longitude_and_velocities(name, drifting):
    change, kind, key = GEOGRAPHIC[name]
    findings = found(changed(drifting, change), GLOBAL, 2.74)
    assert [each[0] for each in findings] == [kind] and findings[0][2].startswith(key)


def test_degrees_that_are_read_as_radians_are_told(drifting):
    radians = {**GLOBAL, "latitude": {"name": "lat", "unit": "rad"}, "longitude": {"name": "lon", "unit": "rad"}}
    ((kind, _, key),) = found(changed(drifting, times(180 / math.pi, *DEGREES)), radians, 2.74)
    assert (kind, key) == ("position unit", "data.channels.latitude.unit=deg data.channels.longitude.unit=deg")


def test_a_sway_to_port_or_in_knots_is_told(drifting):
    right = changed(drifting, with_sway)
    assert found(right, SIDEWAYS, 2.74) == []
    findings = found(changed(right, times(-1, SWAY)), SIDEWAYS, 2.74)
    assert findings == [("sway sense", "sway", "data.channels.sway.span=-1")]
    ((kind, _, key),) = found(changed(right, times(1 / KNOT, SWAY)), SIDEWAYS, 2.74)
    assert kind == "sway unit" and abs(float(key.removeprefix("data.channels.sway.span=")) - 1.94) < 0.1


def test_a_heading_is_checked_against_a_logged_course(drifting):
    logs = [one._replace(channels=without_position({**one.channels, **with_course(one.channels)})) for one in drifting]
    channels = {**BOTH, "surge": {"name": "u"}, "ground_speed": {"name": "sog"}, "course": {"name": "cog"}}
    assert found(logs, channels, 2.74) == []
    findings = found(changed(logs, counter_clockwise), channels, 2.74)
    assert ("heading sense", "heading", "data.channels.heading.unit=enu_deg") in findings
    assert not any(kind.startswith("position") for kind, *_ in findings)


def test_short_logs_with_positions_are_left_in_peace():
    for plant in ("kingfisher", "wamv"):
        for seed in range(2):
            assert found(changed(boats(plant, seed, 0.1), with_positions), LOCAL, TOP[plant]) == []
