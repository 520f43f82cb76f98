"""Logs whose names, units or senses are wrong or do not tell: what is right cannot or can hardly be found.

An inspection need not be right about them. It must not be sure of what is wrong.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tests.support.exported import (
    DEG,
    KNOTS,
    adrift,
    enu,
    rows,
    voyage_latitude,
    voyage_longitude,
    write_alog,
    write_table,
)
from tests.support.shapes import Shape, pair
from tests.support.voyages import Voyage


def columns(voyage: Voyage, **changed: Any) -> dict[str, Any]:
    """The columns of a plain table with a position, some of them replaced; None leaves one out."""
    time = rows(voyage)
    plain = {
        "time": time,
        "lat": voyage_latitude(voyage, time),
        "lon": voyage_longitude(voyage, time),
        "heading": DEG * voyage.at("heading", time),
        "speed": voyage.at("surge", time),
        "thrust_left": voyage.at("command_left", time),
        "thrust_right": voyage.at("command_right", time),
    }
    return {name: values for name, values in (plain | changed).items() if values is not None}


def lying_unit(folder: Path, voyage: Voyage) -> Path:
    """The header says m/s, the numbers are knots."""
    time = rows(voyage)
    return write_table(
        folder / "a.csv", columns(voyage, **{"speed": None, "speed (m/s)": KNOTS * voyage.at("surge", time)})
    )


def knots_alone(folder: Path, voyage: Voyage) -> Path:
    """Knots, and neither a unit nor a position."""
    time = rows(voyage)
    return write_table(folder / "a.csv", columns(voyage, lat=None, lon=None, speed=KNOTS * voyage.at("surge", time)))


def swapped_sides(folder: Path, voyage: Voyage) -> Path:
    """The columns of the sides have each other's name."""
    time = rows(voyage)
    left, right = voyage.at("command_left", time), voyage.at("command_right", time)
    return write_table(folder / "a.csv", columns(voyage, thrust_left=right, thrust_right=left))


def east_alone(folder: Path, voyage: Voyage) -> Path:
    """A yaw from east, counter-clockwise, and no position."""
    time = rows(voyage)
    own = columns(voyage, lat=None, lon=None, heading=None, yaw=enu(voyage.at("heading", time)))
    return write_table(folder / "a.csv", own)


def east_named_heading(folder: Path, voyage: Voyage) -> Path:
    """The same in degrees, and called heading."""
    time = rows(voyage)
    return write_table(
        folder / "a.csv", columns(voyage, lat=None, lon=None, heading=DEG * enu(voyage.at("heading", time)))
    )


def both_reversed(folder: Path, voyage: Voyage) -> Path:
    """Both sides push ahead below zero."""
    time = rows(voyage)
    left, right = -voyage.at("command_left", time), -voyage.at("command_right", time)
    return write_table(folder / "a.csv", columns(voyage, thrust_left=left, thrust_right=right))


def wind_called_speed(folder: Path, voyage: Voyage) -> Path:
    """The column called speed is the wind's; the boat's is called v."""
    time = rows(voyage)
    wind = 4 + np.cumsum(np.random.default_rng(4).normal(0, 0.02, len(time)))
    return write_table(folder / "a.csv", columns(voyage, speed=wind, v=voyage.at("surge", time)))


def still(folder: Path, voyage: Voyage) -> Path:
    """Straight ahead at one speed: hardly any evidence."""
    time = rows(voyage)
    rng = np.random.default_rng(2)
    flat = 0.02 * rng.normal(size=len(time))
    own = columns(voyage, lat=None, lon=None, heading=1.3 + flat, speed=1 + flat, thrust_left=0.4 + 0 * flat)
    own["thrust_right"] = 0.4 + 0.001 * flat
    return write_table(folder / "a.csv", own)


def newtons_in_moos(folder: Path, voyage: Voyage) -> Path:
    """Thrust in newtons, up to 30, where MOOS has percent."""
    return write_alog(folder / "a.alog", {
        "THRUST_L": (voyage.command_left[0], 30 * voyage.command_left[1]),
        "THRUST_R": (voyage.command_right[0], 30 * voyage.command_right[1]),
        "NAV_HEADING": (voyage.heading[0], DEG * voyage.heading[1]),
        "NAV_SPEED": voyage.surge,
    })  # fmt: skip


def dead_gyro(folder: Path, voyage: Voyage) -> Path:
    """A yaw rate that is noise."""
    time = rows(voyage)
    return write_table(folder / "a.csv", columns(voyage, yaw_rate=np.random.default_rng(1).normal(0, 0.1, len(time))))


def left_alone(folder: Path, voyage: Voyage) -> Path:
    """One side is logged in shares, reversed, the other one in PWM."""
    time = rows(voyage)
    right = np.round(1500 + 400 * voyage.at("command_right", time))
    return write_table(
        folder / "a.csv", columns(voyage, thrust_left=-voyage.at("command_left", time), thrust_right=right)
    )


def stop_at_mid_scale(folder: Path, voyage: Voyage) -> Path:
    """Percent, of which 50 is stop, 0 full astern and 100 full ahead."""
    time = rows(voyage)
    left, right = (50 + 50 * voyage.at(f"command_{side}", time) for side in ("left", "right"))
    return write_table(folder / "a.csv", columns(voyage, thrust_left=left, thrust_right=right))


def centimetres(folder: Path, voyage: Voyage) -> Path:
    time = rows(voyage)
    return write_table(folder / "a.csv", columns(voyage, speed=np.round(100 * voyage.at("surge", time))))


def feet(folder: Path, voyage: Voyage) -> Path:
    """A speed in ft/s, which is no unit of a channel."""
    time = rows(voyage)
    return write_table(folder / "a.csv", columns(voyage, speed=voyage.at("surge", time) / 0.3048))


def tenths(folder: Path, voyage: Voyage) -> Path:
    """A heading in tenths of a degree, and no position."""
    time = rows(voyage)
    own = columns(voyage, lat=None, lon=None, heading=np.round(10 * DEG * voyage.at("heading", time) % 3600))
    return write_table(folder / "a.csv", own)


def hundredths(folder: Path, voyage: Voyage) -> Path:
    """A heading in hundredths of a degree, with a position."""
    time = rows(voyage)
    return write_table(
        folder / "a.csv", columns(voyage, heading=np.round(100 * DEG * voyage.at("heading", time) % 36000))
    )


def gradians(folder: Path, voyage: Voyage) -> Path:
    """A heading with 400 to a turn, and no position."""
    time = rows(voyage)
    own = columns(voyage, lat=None, lon=None, heading=DEG * voyage.at("heading", time) / 0.9 % 400)
    return write_table(folder / "a.csv", own)


def odometry(folder: Path, voyage: Voyage) -> Path:
    """The names and senses of an odometry message: metres east and north, a speed that is called a twist."""
    time = rows(voyage)
    own = columns(voyage, lat=None, lon=None, heading=None, speed=None, yaw=enu(voyage.at("heading", time)))
    own |= {"pose.position.x": np.interp(time, *voyage.east), "pose.position.y": np.interp(time, *voyage.north)}
    return write_table(folder / "a.csv", own | {"twist.linear.x": voyage.at("surge", time)})


def interchanged(folder: Path, voyage: Voyage) -> Path:
    """Latitude and longitude have each other's name."""
    own = columns(voyage)
    return write_table(folder / "a.csv", own | {"lat": own["lon"], "lon": own["lat"]})


def mirrored_gyro(folder: Path, voyage: Voyage) -> Path:
    """A yaw rate that counts the other way than the heading."""
    time = rows(voyage)
    return write_table(folder / "a.csv", columns(voyage, yaw_rate=-DEG * voyage.at("yaw_rate", time)))


def setpoint_first(folder: Path, voyage: Voyage) -> Path:
    """Set points that look like measurements: `u_d`, `psi_d`; the measurements are `u`, `psi`."""
    time = rows(voyage)
    return write_table(folder / "a.csv", columns(
        voyage, heading=None, speed=None, u_d=np.round(voyage.at("surge", time + 2), 1),
        psi_d=np.round(voyage.at("heading", time + 2), 1), u=voyage.at("surge", time), psi=voyage.at("heading", time),
    ))  # fmt: skip


def vectors_over_ground(folder: Path, voyage: Voyage) -> Path:
    """Columns vx and vy, which are north and east, and not along the hull; no position."""
    time = rows(voyage)
    speed, heading = voyage.at("surge", time), voyage.at("heading", time)
    own = columns(voyage, lat=None, lon=None, speed=None, vx=speed * np.cos(heading), vy=speed * np.sin(heading))
    return write_table(folder / "a.csv", own)


def vectors_of_the_hull(folder: Path, voyage: Voyage) -> Path:
    """Columns vx and vy along the hull and across it."""
    time = rows(voyage)
    sway = 0.05 * np.random.default_rng(6).normal(size=len(time))
    own = columns(voyage, lat=None, lon=None, speed=None, vx=voyage.at("surge", time), vy=sway)
    return write_table(folder / "a.csv", own)


def sway_to_port(folder: Path, voyage: Voyage) -> Path:
    """Columns u and v, of which v counts to port, beside a heading from north; no position."""
    own = adrift(voyage)
    changed = {"speed": None, "u": voyage.at("surge", own["time"]), "v": -own["sway"]}
    return write_table(folder / "a.csv", columns(voyage, lat=None, lon=None, **changed))


def sway_to_port_proved(folder: Path, voyage: Voyage) -> Path:
    """The same with a position, under a plain name."""
    own = adrift(voyage)
    return write_table(folder / "a.csv", columns(voyage, lat=own["lat"], lon=own["lon"], sway=-own["sway"]))


def sway_of_another_boat(folder: Path, voyage: Voyage) -> Path:
    """A sway that has nothing to do with the position."""
    own = adrift(voyage)
    return write_table(folder / "a.csv", columns(voyage, lat=own["lat"], lon=own["lon"], sway=own["sway"][::-1]))


def axes_interchanged(folder: Path, voyage: Voyage) -> Path:
    """Local coordinates that are called north and east, and are east and north."""
    time = rows(voyage)
    own = columns(voyage, lat=None, lon=None, north=np.interp(time, *voyage.east), east=np.interp(time, *voyage.north))
    return write_table(folder / "a.csv", own)


def unnamed_axes(folder: Path, voyage: Voyage) -> Path:
    """Local coordinates x and y of which x is north."""
    time = rows(voyage)
    own = columns(voyage, lat=None, lon=None, x=np.interp(time, *voyage.north), y=np.interp(time, *voyage.east))
    return write_table(folder / "a.csv", own)


def axes_by_a_wrong_heading(folder: Path, voyage: Voyage) -> Path:
    """Local coordinates x east and y north, and a yaw from east that is called heading."""
    time = rows(voyage)
    own = columns(voyage, lat=None, lon=None, heading=DEG * enu(voyage.at("heading", time)))
    return write_table(
        folder / "a.csv", own | {"x": np.interp(time, *voyage.east), "y": np.interp(time, *voyage.north)}
    )


SIDES = pair("thrust_left", "thrust_right", zero=0, span=1)
HEADING = {"heading": [{"name": "heading", "unit": "deg"}]}
SPEED = {"surge": [{"name": "speed", "unit": "m/s"}]}
COMMON = SIDES | HEADING | SPEED
TRAPS = {
    "lying_unit": Shape(lying_unit, SIDES | HEADING | {"surge": [{"name": "speed (m/s)", "unit": "knots"}]}),
    "knots_alone": Shape(knots_alone, SIDES | HEADING | {"surge": [{"name": "speed", "unit": "knots"}]}),
    "swapped_sides": Shape(swapped_sides, COMMON | pair("thrust_right", "thrust_left", zero=0, span=1)),
    "east_alone": Shape(east_alone, SIDES | SPEED | {"heading": [{"name": "yaw", "unit": "enu_rad"}]}),
    "east_named_heading": Shape(east_named_heading,
                                SIDES | SPEED | {"heading": [{"name": "heading", "unit": "enu_deg"}]}),
    "both_reversed": Shape(both_reversed, HEADING | SPEED | pair("thrust_left", "thrust_right", zero=0, span=-1)),
    "wind_called_speed": Shape(wind_called_speed, SIDES | HEADING | {"surge": [{"name": "v", "unit": "m/s"}]}),
    "still": Shape(still, SIDES | SPEED | {"heading": [{"name": "heading", "unit": "rad"}]}),
    "newtons_in_moos": Shape(newtons_in_moos, pair("THRUST_L", "THRUST_R", zero=0, span=30)
                             | {"heading": [{"name": "NAV_HEADING", "unit": "deg"}]}
                             | {"surge": [{"name": "NAV_SPEED", "unit": "m/s"}]}),
    "dead_gyro": Shape(dead_gyro, COMMON | {"yaw_rate": [{"name": None}]}),
    "left_alone": Shape(left_alone, HEADING | SPEED | {
        "command_left": [{"name": "thrust_left", "zero": 0, "span": -1}],
        "command_right": [{"name": "thrust_right", "zero": 1500, "span": 400}]}),
    "stop_at_mid_scale": Shape(stop_at_mid_scale,
                               HEADING | SPEED | pair("thrust_left", "thrust_right", zero=50, span=50)),
    "centimetres": Shape(centimetres, SIDES | HEADING | {"surge": [{"name": "speed", "unit": "cm/s"}]}),
    "feet": Shape(feet, SIDES | HEADING | {"surge": [{"name": "speed", "unit": "ft/s"}]}),
    "tenths": Shape(tenths, SIDES | SPEED | {"heading": [{"name": "heading", "unit": "deg", "span": 10}]}),
    "hundredths": Shape(hundredths, SIDES | SPEED | {"heading": [{"name": "heading", "unit": "deg", "span": 100}]}),
    "gradians": Shape(gradians, SIDES | SPEED | {"heading": [{"name": "heading", "unit": "deg", "span": 1.11111}]}),
    "odometry": Shape(odometry, SIDES | {"heading": [{"name": "yaw", "unit": "enu_rad"}]}
                      | {"surge": [{"name": "twist.linear.x", "unit": "m/s"}]}
                      | {"east": [{"name": "pose.position.x"}], "north": [{"name": "pose.position.y"}]}),
    "interchanged": Shape(interchanged, COMMON | {"latitude": [{"name": "lon"}], "longitude": [{"name": "lat"}]}),
    "mirrored_gyro": Shape(mirrored_gyro, COMMON | {"yaw_rate": [{"name": "yaw_rate", "unit": "enu_deg/s"}]}),
    "setpoint_first": Shape(setpoint_first, SIDES | {"heading": [{"name": "psi", "unit": "rad"}]}
                            | {"surge": [{"name": "u", "unit": "m/s"}]}),
    "vectors_over_ground": Shape(vectors_over_ground, SIDES | HEADING | {"surge": [{"name": None}]}
                                 | {"velocity_north": [{"name": "vx"}], "velocity_east": [{"name": "vy"}]}),
    "vectors_of_the_hull": Shape(vectors_of_the_hull, SIDES | HEADING | {"surge": [{"name": "vx", "unit": "m/s"}]}
                                 | {"sway": [{"name": "vy", "unit": "m/s", "span": 1}]}),
    "sway_to_port": Shape(sway_to_port, SIDES | HEADING | {"surge": [{"name": "u", "unit": "m/s"}]}
                          | {"sway": [{"name": "v", "unit": "m/s", "span": -1}]}),
    "sway_to_port_proved": Shape(sway_to_port_proved, COMMON | {"sway": [{"name": "sway", "unit": "m/s", "span": -1}]}),
    "sway_of_another_boat": Shape(sway_of_another_boat, COMMON | {"sway": [{"name": None}]}),
    "axes_interchanged": Shape(axes_interchanged, COMMON | {"north": [{"name": "east"}], "east": [{"name": "north"}]}),
    "axes_by_a_wrong_heading": Shape(axes_by_a_wrong_heading, SIDES | SPEED | {
        "heading": [{"name": "heading", "unit": "enu_deg"}], "north": [{"name": "y"}], "east": [{"name": "x"}]}),
    "unnamed_axes": Shape(unnamed_axes, COMMON | {"north": [{"name": "x"}], "east": [{"name": "y"}]}),
}  # fmt: skip
