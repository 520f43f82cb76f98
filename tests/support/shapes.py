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


PLACES: Truth = {"latitude": [{"name": "lat"}], "longitude": [{"name": "lon"}]}

SHAPES = {
    "moos": Shape(
        exported.moos,
        pair("DESIRED_THRUST_L", "DESIRED_THRUST_R", zero=0, span=100)
        | {"heading": [{"name": "NAV_HEADING", "unit": "deg"}], "yaw_rate": [{"name": None}]}
        | {"surge": [{"name": "NAV_SPEED", "unit": "m/s"}], "north": [{"name": "NAV_Y"}], "east": [{"name": "NAV_X"}]},
    ),
    "pwm": Shape(
        exported.pwm_table,
        pair("pwm_left", "pwm_right", zero=1500, span=400)
        | {"heading": [{"name": "heading", "unit": "deg"}], "yaw_rate": [{"name": "yaw_rate", "unit": "deg/s"}]}
        | {"surge": [{"name": "speed", "unit": "m/s"}], **PLACES},
    ),
    "german": Shape(
        exported.german_table,
        pair("Schub links (%)", "Schub rechts (%)", zero=0, span=100)
        | {"heading": [{"name": "Steuerkurs (°)", "unit": "deg"}], "yaw_rate": [{"name": None}]}
        | {"surge": [{"name": "Geschwindigkeit (km/h)", "unit": "km/h"}]}
        | {"latitude": [{"name": "Breite"}], "longitude": [{"name": "Länge"}]},
    ),
    "knots": Shape(
        exported.knots_table,
        pair("throttle_port", "throttle_starboard", zero=0, span=1)
        | {"heading": [{"name": "hdg", "unit": "rad"}], "yaw_rate": [{"name": None}]}
        | {"surge": [{"name": "sog", "unit": "knots"}]}
        | {"latitude": [{"name": "latitude"}], "longitude": [{"name": "longitude"}]},
    ),
    "reversed": Shape(
        exported.reversed_table,
        {
            "command_left": [{"name": "thr_left", "zero": 1511, "span": -400}],
            "command_right": [{"name": "thr_right", "zero": 1511, "span": 400}],
            "heading": [{"name": "yaw", "unit": "deg"}],
            "yaw_rate": [{"name": "yaw_rate", "unit": "rad/s"}],
            "surge": [{"name": "surge", "unit": "m/s"}],
            "north": [{"name": "x_ned"}],
            "east": [{"name": "y_ned"}],
        },
    ),
    "newton": Shape(
        exported.newton_table,
        {
            "command_left": [{"name": ["thruster_1 (N)", "thruster_3 (N)"], "zero": 0, "span": 30}],
            "command_right": [{"name": ["thruster_2 (N)", "thruster_4 (N)"], "zero": 0, "span": 30}],
            "heading": [{"name": "heading_deg", "unit": "deg"}],
            "yaw_rate": [{"name": None}],
            "surge": [{"name": "speed_mps", "unit": "m/s"}],
            **PLACES,
        },
    ),
    "rudder": Shape(
        exported.rudder_table,
        pair("thrust", "thrust", zero=0, span=100)
        | {"heading": [{"name": "heading", "unit": "deg"}], "yaw_rate": [{"name": None}]}
        | {"surge": [{"name": "speed", "unit": "m/s"}], **PLACES},
    ),
    "positions": Shape(
        exported.positions_table,
        pair("Motor_L", "Motor_R", zero=0, span=1)
        | {"heading": [{"name": "Heading", "unit": "deg"}], "yaw_rate": [{"name": None}], "surge": [{"name": None}]}
        | {"latitude": [{"name": "Latitude"}], "longitude": [{"name": "Longitude"}]},
    ),
    "nameless": Shape(
        exported.nameless_table,
        pair("c8", "c2", zero=1500, span=400)
        | {"command_right": [{"name": "c2", "zero": 1500, "span": 400}]}
        | {"heading": [{"name": "c5", "unit": "deg"}], "yaw_rate": [{"name": "c6", "unit": "rad/s"}, {"name": None}]}
        | {"surge": [{"name": "c3", "unit": "m/s"}]},
    ),
    "crowded": Shape(
        exported.crowded_table,
        pair("cmd_left", "cmd_right", zero=0, span=1)
        | {"heading": [{"name": "compass_heading", "unit": "deg"}], "yaw_rate": [{"name": "gyro_z", "unit": "rad/s"}]}
        | {"surge": [{"name": "ekf_speed", "unit": "m/s"}, {"name": "gps_speed_kn", "unit": "knots"},
                     {"name": "log_speed_kmh", "unit": "km/h"}]}
        | {"latitude": [{"name": "gps_lat"}], "longitude": [{"name": "gps_lon"}]},
    ),
    "plain": Shape(
        exported.plain_table,
        pair("command_left", "command_right", zero=0, span=1)
        | {"heading": [{"name": "heading", "unit": "deg"}], "yaw_rate": [{"name": None}]}
        | {"surge": [{"name": "surge", "unit": "m/s"}]},
    ),
    "east": Shape(
        exported.east_table,
        pair("left_motor", "right_motor", zero=0, span=255)
        | {"heading": [{"name": "yaw", "unit": "enu_rad"}], "yaw_rate": [{"name": "yaw_rate", "unit": "enu_rad/s"}]}
        | {"surge": [{"name": "vel", "unit": "m/s"}], **PLACES},
    ),
    "velocities": Shape(
        exported.velocities_table,
        pair("thrust_left", "thrust_right", zero=0, span=100)
        | {"heading": [{"name": "heading", "unit": "deg"}], "yaw_rate": [{"name": None}], "surge": [{"name": None}]}
        | {"velocity_north": [{"name": "vn", "unit": "m/s"}], "velocity_east": [{"name": "ve", "unit": "m/s"}]}
        | PLACES,
    ),
    "on_change": Shape(
        exported.on_change,
        {
            "command_left": [{"name": "THRUST_LEFT", "zero": 0, "span": 100, "held": True}],
            "command_right": [{"name": "THRUST_RIGHT", "zero": 0, "span": 100, "held": True}],
            "heading": [{"name": "COMPASS_HEADING", "unit": "deg"}],
            "yaw_rate": [{"name": None}],
            "surge": [{"name": "GPS_SPEED", "unit": "m/s"}],
            "latitude": [{"name": "LATITUDE"}],
            "longitude": [{"name": "LONGITUDE"}],
        },
        {"commands": "on_change"},
    ),
    "sway": Shape(
        exported.sway_table,
        pair("Schub links (%)", "Schub rechts (%)", zero=0, span=100)
        | {"heading": [{"name": "Steuerkurs (°)", "unit": "deg"}]}
        | {"surge": [{"name": "Geschwindigkeit (kn)", "unit": "knots"}]}
        | {"sway": [{"name": "Quergeschwindigkeit (kn)", "unit": "knots", "span": 1}]}
        | {"latitude": [{"name": "Breite"}], "longitude": [{"name": "Länge"}]},
    ),
    "port": Shape(
        exported.port_table,
        pair("left_motor", "right_motor", zero=0, span=1)
        | {"heading": [{"name": "yaw", "unit": "enu_rad"}], "surge": [{"name": "twist.linear.x", "unit": "m/s"}]}
        | {"sway": [{"name": "twist.linear.y", "unit": "m/s", "span": -1}]}
        | {"latitude": [{"name": "latitude"}], "longitude": [{"name": "longitude"}]},
    ),
    "heron": Shape(
        exported_bags.heron,
        {
            "command_left": [{"name": "/cmd_drive", "field": "left", "zero": 0, "span": 1}],
            "command_right": [{"name": "/cmd_drive", "field": "right", "zero": 0, "span": 1}],
            "heading": [{"name": "/imu/data", "field": "orientation", "unit": "enu_rad"}],
            "yaw_rate": [{"name": "/imu/data", "field": "angular_velocity.z", "unit": "enu_rad/s"}],
            "surge": [{"name": None}, {"name": "/navsat/vel"}],  # the norm of the velocity is right, too
            "velocity_north": [{"name": "/navsat/vel", "field": "twist.linear.y", "unit": "m/s"}],
            "velocity_east": [{"name": "/navsat/vel", "field": "twist.linear.x", "unit": "m/s"}],
            "latitude": [{"name": "/navsat/fix", "field": "latitude"}],
            "longitude": [{"name": "/navsat/fix", "field": "longitude"}],
        },
    ),
    "ros2": Shape(
        exported_bags.numbers,
        pair("/boat/left_thruster", "/boat/right_thruster", zero=0, span=36.5)
        | {"heading": [{"name": "/boat/ned_pose", "field": "theta", "unit": "rad"}]}
        | {"yaw_rate": [{"name": "/boat/local_vel", "field": "z", "unit": "rad/s"}]}
        | {"surge": [{"name": "/boat/local_vel", "field": "x", "unit": "m/s"}], "sway": [{"name": None}]}
        | {"north": [{"name": "/boat/ned_pose", "field": "x"}], "east": [{"name": "/boat/ned_pose", "field": "y"}]},
    ),
}  # fmt: skip


class Score(NamedTuple):
    """How an inspection compares with the truth."""

    right: list[str]  # such as "surge name"
    unsure: list[str]  # wrong or missing, and said to be unsure
    wrong: list[str]  # wrong, although certain or probable


def score(channels: Mapping[str, Mapping[str, Any]], certainty: Callable[[str, str], str], truth: Truth) -> Score:
    """Compare proposed channels with the truth, key by key."""
    found = Score([], [], [])
    for channel, allowed in truth.items():
        own = channels.get(channel) or {"name": None}
        expected = next((each for each in allowed if _same(own.get("name"), each["name"])), allowed[0])
        for key in expected:
            good = _equal(key, own, expected)
            sure = certainty(channel, key)
            told = (
                f"{channel} {key}" if good else f"{channel} {key} {own.get(key)!r}, expected {expected[key]!r} ({sure})"
            )
            (found.right if good else found.unsure if sure == "unsure" else found.wrong).append(told)
    return found


def certainties(decisions: Iterable[Decision]) -> Callable[[str, str], str]:
    """The least certainty of what was decided about a channel's key, or about its series where the key has none."""
    found: dict[tuple[str, str], str] = {}
    for each in decisions:
        place = each.channel, KEYS.get(each.what, each.what)
        found[place] = least(found.get(place, CERTAIN), each.certainty)
    return lambda channel, key: found.get((channel, key), found.get((channel, "name"), UNSURE))


def _same(own: Any, expected: Any) -> bool:
    return sorted(own) == sorted(expected) if isinstance(own, list) and isinstance(expected, list) else own == expected


def _equal(key: str, own: Mapping[str, Any], expected: Mapping[str, Any]) -> bool:
    """Zero and span within 4 % and 20 % of full scale."""
    value, right = own.get(key, 1.0 if key == "span" else None), expected[key]
    if key in ("zero", "span") and isinstance(value, int | float):
        return abs(value - right) <= (0.2 if key == "span" else 0.04) * abs(expected["span"])
    return _same(value, right)
