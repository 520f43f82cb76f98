"""Logs whose names, units or senses are wrong or do not tell: what is right cannot or can hardly be found.

An inspection need not be right about them. It must not be sure of what is wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.support.exported import DEG, KNOTS, At, adrift, enu, table, write_alog
from tests.support.shapes import Shape, Truth, of, pair
from tests.support.voyages import Voyage


def plain(at: At, **changed: Any) -> dict[str, Any]:
    """The columns of a plain table with a position, some of them replaced; None leaves one out."""
    columns = {
        "time": at.time, "lat": at.lat, "lon": at.lon, "heading": DEG * at.heading, "speed": at.surge,
        "thrust_left": at.left, "thrust_right": at.right,
    }  # fmt: skip
    return {name: values for name, values in (columns | changed).items() if values is not None}


def columns(voyage: Voyage, **changed: Any) -> dict[str, Any]:
    return plain(At(voyage), **changed)


def trap(changed: Callable[[At], dict[str, Any]], truth: Truth) -> Shape:
    """A plain table of which some columns are changed."""
    return Shape(table("a.csv", lambda at: plain(at, **changed(at))), truth)


def still(at: At) -> dict[str, Any]:
    flat = 0.02 * np.random.default_rng(2).normal(size=len(at.time))
    return NOWHERE | {"heading": 1.3 + flat, "speed": 1 + flat, "thrust_left": 0.4 + 0 * flat,
                      "thrust_right": 0.4 + 0.001 * flat}  # fmt: skip


def newtons_in_moos(folder: Path, voyage: Voyage) -> Path:
    """Thrust in newtons, up to 30, where MOOS has percent."""
    return write_alog(folder / "a.alog", {
        "THRUST_L": (voyage.command_left[0], 30 * voyage.command_left[1]),
        "THRUST_R": (voyage.command_right[0], 30 * voyage.command_right[1]),
        "NAV_HEADING": (voyage.heading[0], DEG * voyage.heading[1]),
        "NAV_SPEED": voyage.surge,
    })  # fmt: skip


def drifting(sway: Callable[[np.ndarray], np.ndarray]) -> Callable[[At], dict[str, Any]]:
    """The position of a boat that drifts, beside a sway."""

    def changed(at: At) -> dict[str, Any]:
        boat = adrift(at.voyage)
        return {"lat": boat["lat"], "lon": boat["lon"], "sway": sway(boat["sway"])}

    return changed


NOWHERE: dict[str, Any] = {"lat": None, "lon": None}
SIDES = pair("thrust_left", "thrust_right", zero=0, span=1)
HEADING = of(heading=("heading", "deg"))
SPEED = of(surge=("speed", "m/s"))
COMMON = SIDES | HEADING | SPEED
TRAPS = {
    # the header says m/s, the numbers are knots
    "lying_unit": trap(lambda at: {"speed": None, "speed (m/s)": KNOTS * at.surge},
                       SIDES | HEADING | of(surge=("speed (m/s)", "knots"))),
    "knots_alone": trap(lambda at: NOWHERE | {"speed": KNOTS * at.surge},  # neither a unit nor a position
                        SIDES | HEADING | of(surge=("speed", "knots"))),
    "swapped_sides": trap(lambda at: {"thrust_left": at.right, "thrust_right": at.left},
                          COMMON | pair("thrust_right", "thrust_left", zero=0, span=1)),
    # a yaw from east, counter-clockwise, and no position; then in degrees, and called heading
    "east_alone": trap(lambda at: NOWHERE | {"heading": None, "yaw": enu(at.heading)},
                       SIDES | SPEED | of(heading=("yaw", "enu_rad"))),
    "east_named_heading": trap(lambda at: NOWHERE | {"heading": DEG * enu(at.heading)},
                               SIDES | SPEED | of(heading=("heading", "enu_deg"))),
    "both_reversed": trap(lambda at: {"thrust_left": -at.left, "thrust_right": -at.right},
                          HEADING | SPEED | pair("thrust_left", "thrust_right", zero=0, span=-1)),
    # the column called speed is the wind's; the boat's is called v
    "wind_called_speed": trap(
        lambda at: {"speed": 4 + np.cumsum(np.random.default_rng(4).normal(0, 0.02, len(at.time))), "v": at.surge},
        SIDES | HEADING | of(surge=("v", "m/s"))),
    # straight ahead at one speed: hardly any evidence
    "still": trap(still, SIDES | SPEED | of(heading=("heading", "rad"))),
    "newtons_in_moos": Shape(newtons_in_moos, pair("THRUST_L", "THRUST_R", zero=0, span=30)
                             | of(heading=("NAV_HEADING", "deg"), surge=("NAV_SPEED", "m/s"))),
    # a yaw rate that is noise
    "dead_gyro": trap(lambda at: {"yaw_rate": np.random.default_rng(1).normal(0, 0.1, len(at.time))},
                      COMMON | of(yaw_rate=None)),
    # one side is logged in shares, reversed, the other one in PWM
    "left_alone": trap(lambda at: {"thrust_left": -at.left, "thrust_right": np.round(1500 + 400 * at.right)},
                       HEADING | SPEED | {"command_left": [{"name": "thrust_left", "zero": 0, "span": -1}],
                                          "command_right": [{"name": "thrust_right", "zero": 1500, "span": 400}]}),
    # percent, of which 50 is stop, 0 full astern and 100 full ahead
    "stop_at_mid_scale": trap(lambda at: {"thrust_left": 50 + 50 * at.left, "thrust_right": 50 + 50 * at.right},
                              HEADING | SPEED | pair("thrust_left", "thrust_right", zero=50, span=50)),
    "centimetres": trap(lambda at: {"speed": np.round(100 * at.surge)},
                        SIDES | HEADING | of(surge=("speed", "cm/s"))),
    "feet": trap(lambda at: {"speed": at.surge / 0.3048},  # ft/s is no unit of a channel
                 SIDES | HEADING | of(surge=("speed", "ft/s"))),
    # a heading in tenths and hundredths of a degree, with 400 to a turn; the second alone with a position
    "tenths": trap(lambda at: NOWHERE | {"heading": np.round(10 * DEG * at.heading % 3600)},
                   SIDES | SPEED | of(heading=("heading", "deg", 10))),
    "hundredths": trap(lambda at: {"heading": np.round(100 * DEG * at.heading % 36000)},
                       SIDES | SPEED | of(heading=("heading", "deg", 100))),
    "gradians": trap(lambda at: NOWHERE | {"heading": DEG * at.heading / 0.9 % 400},
                     SIDES | SPEED | of(heading=("heading", "deg", 1.11111))),
    # the names and senses of an odometry message: metres east and north, a speed that is called a twist
    "odometry": trap(lambda at: NOWHERE | {
        "heading": None, "speed": None, "yaw": enu(at.heading), "pose.position.x": at.east, "pose.position.y": at.north,
        "twist.linear.x": at.surge},
        SIDES | of(heading=("yaw", "enu_rad"), surge=("twist.linear.x", "m/s"), east="pose.position.x",
                   north="pose.position.y")),
    "interchanged": trap(lambda at: {"lat": at.lon, "lon": at.lat},
                         COMMON | of(latitude="lon", longitude="lat")),
    "mirrored_gyro": trap(lambda at: {"yaw_rate": -DEG * at.yaw_rate},  # counts the other way than the heading
                          COMMON | of(yaw_rate=("yaw_rate", "enu_deg/s"))),
    # set points that look like measurements: `u_d`, `psi_d`; the measurements are `u`, `psi`
    "setpoint_first": trap(lambda at: {
        "heading": None, "speed": None, "u_d": np.round(at.voyage.at("surge", at.time + 2), 1),
        "psi_d": np.round(at.voyage.at("heading", at.time + 2), 1), "u": at.surge, "psi": at.heading},
        SIDES | of(heading=("psi", "rad"), surge=("u", "m/s"))),
    # columns vx and vy without a position: north and east, then along the hull and across it
    "vectors_over_ground": trap(lambda at: NOWHERE | {
        "speed": None, "vx": at.surge * np.cos(at.heading), "vy": at.surge * np.sin(at.heading)},
        SIDES | HEADING | of(surge=None, velocity_north="vx", velocity_east="vy")),
    "vectors_of_the_hull": trap(lambda at: NOWHERE | {
        "speed": None, "vx": at.surge, "vy": 0.05 * np.random.default_rng(6).normal(size=len(at.time))},
        SIDES | HEADING | of(surge=("vx", "m/s"), sway=("vy", "m/s", 1))),
    # columns u and v, of which v counts to port, beside a heading from north; then under a plain name with a position
    "sway_to_port": trap(lambda at: NOWHERE | {"speed": None, "u": at.surge, "v": -adrift(at.voyage)["sway"]},
                         SIDES | HEADING | of(surge=("u", "m/s"), sway=("v", "m/s", -1))),
    "sway_to_port_proved": trap(drifting(np.negative), COMMON | of(sway=("sway", "m/s", -1))),
    # a sway that has nothing to do with the position
    "sway_of_another_boat": trap(drifting(np.flip), COMMON | of(sway=None)),
    # local coordinates that are called north and east, and are east and north
    "axes_interchanged": trap(lambda at: NOWHERE | {"north": at.east, "east": at.north},
                              COMMON | of(north="east", east="north")),
    # local coordinates x east and y north, and a yaw from east that is called heading; then x north
    "axes_by_a_wrong_heading": trap(
        lambda at: NOWHERE | {"heading": DEG * enu(at.heading), "x": at.east, "y": at.north},
        SIDES | SPEED | of(heading=("heading", "enu_deg"), north="y", east="x")),
    "unnamed_axes": trap(lambda at: NOWHERE | {"x": at.north, "y": at.east},
                         COMMON | of(north="x", east="y")),
}  # fmt: skip
