"""Logs in many shapes of one simulated voyage, each with the truth about its channels, and how a proposal is scored.

A shape writes a log and says which series is which channel, in which unit. Where several series are right (three
measured speeds, say), the truth names them all.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from tests.support import exported, exported_bags
from tests.support.voyages import Voyage
from usvlearn.logs.inspection.config_writer import KEYS
from usvlearn.logs.inspection.decision import CERTAIN, UNSURE, Decision, least

Truth = dict[str, list[dict[str, Any]]]  # channel -> what is right: arguments of a `Source`


class Shape(NamedTuple):
    """A shape of logs."""

    write: Callable[[Path, Voyage], Path]  # into a folder
    truth: Truth
    options: Mapping[str, Any] = {}  # of the voyage


def pair(left: str, right: str, **keys: Any) -> Truth:
    return {"command_left": [{"name": left, **keys}], "command_right": [{"name": right, **keys}]}


def of(**channels: Any) -> Truth:
    """Each channel's name, or its name, unit and span."""
    each = {channel: said if isinstance(said, tuple) else (said,) for channel, said in channels.items()}
    return {channel: [dict(zip(("name", "unit", "span"), said, strict=False))] for channel, said in each.items()}


PLACES = of(latitude="lat", longitude="lon")

SHAPES = {
    "moos": Shape(exported.moos, pair("DESIRED_THRUST_L", "DESIRED_THRUST_R", zero=0, span=100)
        | of(heading=("NAV_HEADING", "deg"), yaw_rate=None, surge=("NAV_SPEED", "m/s"), north="NAV_Y", east="NAV_X")),
    "pwm": Shape(exported.pwm_table, pair("pwm_left", "pwm_right", zero=1500, span=400) | PLACES
        | of(heading=("heading", "deg"), yaw_rate=("yaw_rate", "deg/s"), surge=("speed", "m/s"))),
    "german": Shape(exported.german_table, pair("Schub links (%)", "Schub rechts (%)", zero=0, span=100)
        | of(heading=("Steuerkurs (°)", "deg"), yaw_rate=None, surge=("Geschwindigkeit (km/h)", "km/h"),
        latitude="Breite", longitude="Länge")),
    "knots": Shape(exported.knots_table, pair("throttle_port", "throttle_starboard", zero=0, span=1)
        | of(heading=("hdg", "rad"), yaw_rate=None, surge=("sog", "knots"), latitude="latitude",
        longitude="longitude")),
    "reversed": Shape(exported.reversed_table,
        {"command_left": [{"name": "thr_left", "zero": 1511, "span": -400}],
        "command_right": [{"name": "thr_right", "zero": 1511, "span": 400}]}
        | of(heading=("yaw", "deg"), yaw_rate=("yaw_rate", "rad/s"), surge=("surge", "m/s"), north="x_ned",
        east="y_ned")),
    "newton": Shape(exported.newton_table, PLACES
        | {"command_left": [{"name": ["thruster_1 (N)", "thruster_3 (N)"], "zero": 0, "span": 30}],
        "command_right": [{"name": ["thruster_2 (N)", "thruster_4 (N)"], "zero": 0, "span": 30}]}
        | of(heading=("heading_deg", "deg"), yaw_rate=None, surge=("speed_mps", "m/s"))),
    "rudder": Shape(exported.rudder_table, pair("thrust", "thrust", zero=0, span=100) | PLACES
        | of(heading=("heading", "deg"), yaw_rate=None, surge=("speed", "m/s"))),
    "positions": Shape(exported.positions_table, pair("Motor_L", "Motor_R", zero=0, span=1)
        | of(heading=("Heading", "deg"), yaw_rate=None, surge=None, latitude="Latitude", longitude="Longitude")),
    "nameless": Shape(exported.nameless_table, pair("c8", "c2", zero=1500, span=400)
        | {"yaw_rate": [{"name": "c6", "unit": "rad/s"}, {"name": None}]}
        | of(heading=("c5", "deg"), surge=("c3", "m/s"))),
    "crowded": Shape(exported.crowded_table, pair("cmd_left", "cmd_right", zero=0, span=1)
        | {"surge": [{"name": "ekf_speed", "unit": "m/s"}, {"name": "gps_speed_kn", "unit": "knots"},
        {"name": "log_speed_kmh", "unit": "km/h"}]}
        | of(heading=("compass_heading", "deg"), yaw_rate=("gyro_z", "rad/s"), latitude="gps_lat",
        longitude="gps_lon")),
    "plain": Shape(exported.plain_table, pair("command_left", "command_right", zero=0, span=1)
        | of(heading=("heading", "deg"), yaw_rate=None, surge=("surge", "m/s"))),
    "east": Shape(exported.east_table, pair("left_motor", "right_motor", zero=0, span=255) | PLACES
        | of(heading=("yaw", "enu_rad"), yaw_rate=("yaw_rate", "enu_rad/s"), surge=("vel", "m/s"))),
    "velocities": Shape(exported.velocities_table, pair("thrust_left", "thrust_right", zero=0, span=100) | PLACES
        | of(heading=("heading", "deg"), yaw_rate=None, surge=None, velocity_north=("vn", "m/s"),
        velocity_east=("ve", "m/s"))),
    "on_change": Shape(exported.on_change,
        {"command_left": [{"name": "THRUST_LEFT", "zero": 0, "span": 100, "held": True}],
        "command_right": [{"name": "THRUST_RIGHT", "zero": 0, "span": 100, "held": True}]}
        | of(heading=("COMPASS_HEADING", "deg"), yaw_rate=None, surge=("GPS_SPEED", "m/s"), latitude="LATITUDE",
        longitude="LONGITUDE"), {"commands": "on_change"}),
    "sway": Shape(exported.sway_table, pair("Schub links (%)", "Schub rechts (%)", zero=0, span=100)
        | of(heading=("Steuerkurs (°)", "deg"), surge=("Geschwindigkeit (kn)", "knots"),
        sway=("Quergeschwindigkeit (kn)", "knots", 1), latitude="Breite", longitude="Länge")),
    "port": Shape(exported.port_table, pair("left_motor", "right_motor", zero=0, span=1)
        | of(heading=("yaw", "enu_rad"), surge=("twist.linear.x", "m/s"), sway=("twist.linear.y", "m/s", -1),
        latitude="latitude", longitude="longitude")),
    "heron": Shape(exported_bags.heron,
        {"command_left": [{"name": "/cmd_drive", "field": "left", "zero": 0, "span": 1}],
        "command_right": [{"name": "/cmd_drive", "field": "right", "zero": 0, "span": 1}],
        "heading": [{"name": "/imu/data", "field": "orientation", "unit": "enu_rad"}],
        "yaw_rate": [{"name": "/imu/data", "field": "angular_velocity.z", "unit": "enu_rad/s"}],
        "surge": [{"name": None}, {"name": "/navsat/vel"}],
        "velocity_north": [{"name": "/navsat/vel", "field": "twist.linear.y", "unit": "m/s"}],
        "velocity_east": [{"name": "/navsat/vel", "field": "twist.linear.x", "unit": "m/s"}],
        "latitude": [{"name": "/navsat/fix", "field": "latitude"}],
        "longitude": [{"name": "/navsat/fix", "field": "longitude"}]}),
    "ros2": Shape(exported_bags.numbers, pair("/boat/left_thruster", "/boat/right_thruster", zero=0, span=36.5)
        | {"heading": [{"name": "/boat/ned_pose", "field": "theta", "unit": "rad"}],
        "yaw_rate": [{"name": "/boat/local_vel", "field": "z", "unit": "rad/s"}],
        "surge": [{"name": "/boat/local_vel", "field": "x", "unit": "m/s"}],
        "north": [{"name": "/boat/ned_pose", "field": "x"}], "east": [{"name": "/boat/ned_pose", "field": "y"}]}
        | of(sway=None)),
}  # fmt: skip


class Score(NamedTuple):
    """How an inspection compares with the truth."""

    right: list[str]  # such as "surge name"
    unsure: list[str]  # wrong or missing, and said to be unsure
    wrong: list[str]  # wrong, although certain or probable


def score(channels: Mapping[str, Mapping[str, Any]], certainty: Callable[[str, str], str], truth: Truth) -> Score:
    """Compare proposed channels with the truth, key by key."""
    scored = Score([], [], [])
    for channel, allowed in truth.items():
        given = channels.get(channel) or {"name": None}
        expected = next((each for each in allowed if _same(given.get("name"), each["name"])), allowed[0])
        for key in expected:
            good = _equal(key, given, expected)
            sure = certainty(channel, key)
            wrong = "" if good else f" {given.get(key)!r}, expected {expected[key]!r} ({sure})"
            text = f"{channel} {key}{wrong}"
            (scored.right if good else scored.unsure if sure == "unsure" else scored.wrong).append(text)
    return scored


def certainties(decisions: Iterable[Decision]) -> Callable[[str, str], str]:
    """The least certainty of what was decided about a channel's key, or about its series where the key has none."""
    sure: dict[tuple[str, str], str] = {}
    for each in decisions:
        place = each.channel, KEYS.get(each.what, each.what)
        sure[place] = least(sure.get(place, CERTAIN), each.certainty)
    return lambda channel, key: sure.get((channel, key), sure.get((channel, "name"), UNSURE))


def _same(given: Any, expected: Any) -> bool:
    lists = isinstance(given, list) and isinstance(expected, list)
    return sorted(given) == sorted(expected) if lists else given == expected


def _equal(key: str, proposed: Mapping[str, Any], expected: Mapping[str, Any]) -> bool:
    """Zero and span within 4 % and 20 % of full scale."""
    value, right = proposed.get(key, 1.0 if key == "span" else None), expected[key]
    if key in ("zero", "span") and isinstance(value, int | float):
        return abs(value - right) <= (0.2 if key == "span" else 0.04) * abs(expected["span"])
    return _same(value, right)
