"""What functions of one line or two return: cells, names, units, stamps, angles and findings."""

import bz2
from pathlib import Path
from types import SimpleNamespace as Message

import numpy as np
import pytest

from usvlearn.logs.channels import correlations, position_rates, positions, series
from usvlearn.logs.channels.channel import degrees, matching, parse_numbers
from usvlearn.logs.channels.derived_surge import LiveSurge, pair_of
from usvlearn.logs.checks.evidence import spread
from usvlearn.logs.checks.finding import Finding, override, see
from usvlearn.logs.checks.frozen import stretches
from usvlearn.logs.formats.ardupilot import dataflash, servos, tlog
from usvlearn.logs.formats.csv import dialect, rows, stamps, topics
from usvlearn.logs.formats.ros import limits, message_fields

TIME, EIGHT = np.arange(0, 600, 0.5), np.array([60.0, 61, 62, 63, 5, 6, 7, 8])
HEADING = 0.02 * TIME + np.sin(TIME / 9)
WAY = tuple((TIME, np.cumsum(0.5 * (2 * each(HEADING) + 0.4))) for each in (np.cos, np.sin))
ACROSS = tuple(
    (TIME, np.cumsum(each) * 0.5)
    for each in (-np.sin(TIME / 17) * np.sin(HEADING), np.sin(TIME / 17) * np.cos(HEADING))
)
EQUAL, PUSH = (TIME, 2 + 0 * TIME), np.repeat([0.8, -0.8, 0.8, -0.8, 0.8], 8)
TRUE = np.convolve(np.append(np.zeros(7), PUSH), np.full(8, 0.25), "valid")
STAMPED = Message(header=Message(stamp=Message(sec=3, nanosec=500_000_000)))


def moved(factor: float, swap: bool) -> position_rates.Motion:
    north, east = np.cos(0.02 * TIME), np.sin(0.03 * TIME)
    way = [(TIME, factor * np.cumsum(each) * 0.5) for each in (north, east)]
    return position_rates.position_on_velocity(tuple(way[:: -1 if swap else 1]), ((TIME, north), (TIME, east)))


def live() -> list[float | None]:
    one = LiveSurge(("velocity_north", "velocity_east"), held=False)
    return [
        one.push("heading", 0.0, np.pi / 2),
        one.push("velocity_north", 0.1, 0.0),
        one.push("velocity_east", 0.1, 1.5),
    ]


def parts() -> tuple[list[list[float]], list[tuple[int, float]]]:
    found, jumps = series.segments([series.Series("a", None, EIGHT, EIGHT, np.arange(8))])
    return [part[0].time.tolist() for part in found], jumps


def frozen() -> list[float]:
    return [float(each[0]) for each in stretches((TIME, np.where(TIME < 50, np.sin(TIME), 0.5)))]


@pytest.mark.parametrize(("found", "expected"), [
    (lambda: parse_numbers(["1.5", "", "nan", "off", "1_000"]), [1.5, *[np.nan] * 4]),
    (lambda: stamps.parse_cells(["1,5", "1.5", "1.234,5"], ","), [1.5, np.nan, np.nan]),
    (lambda: degrees(np.array([4218.0, -7106.0])), [42.3, -71.1]),
    (lambda: stamps.unwrapped(np.array([4294967000.0, 4294967200.0, 104.0]))[-1], 4294967400.0),
    (lambda: stamps.spread(np.array([0.0, 0, 1, 1, 1, 1, 2]), 5.0)[0], [0, 0.5, 1, 1.25, 1.5, 1.75, 2]),
    (lambda: servos.Limits(1100, 1500, 2000, True).share(np.array([1100.0, 1500, 1750, 0])), [1, 0, -0.5, 0]),
    (lambda: message_fields.yaw(0.0, 0.0, 2.0, 2.0), np.pi / 2),
    (lambda: spread(np.array([1.0, np.nan, 3.0])), 1.0),
    (frozen, [50.0, 599.5, 0.5]),
    (lambda: positions.local(np.radians([60.0, 60.001]), np.radians([179.9995, -179.9995])),
     ([0, 111.4125], [0, 55.7997])),
    (lambda: correlations.heading_rate((np.arange(5.0), np.array([6.0, 6.2, 0.1, 0.3, 0.5])))[1], [0.2, 0.2, 0.2]),
    (lambda: correlations.angle_offset((TIME, np.pi / 2 - 0.1 * TIME), (TIME, 0.1 * TIME))[:3], [np.pi / 2, 1, -1]),
    (lambda: position_rates.compass_error(*WAY, (TIME, HEADING - 0.2), EQUAL)[0], 0.2),
    (lambda: position_rates.sway_on_positions(*ACROSS, (TIME, HEADING), (TIME, -np.sin(TIME / 17))).slope, -1.0),
    (lambda: [moved(1 / 0.3048, False).scale, np.angle(moved(1.0, True).against)], [1 / 0.3048, np.pi / 2]),
    (lambda: [correlations.without_sign(PUSH, PUSH, each).sum() for each in (np.abs(TRUE), TRUE)], [10, 0]),
])  # fmt: skip
def test_numbers(found, expected):
    np.testing.assert_allclose(found(), expected, rtol=0.01, atol=0.01)


@pytest.mark.parametrize(("found", "expected"), [
    (lambda: position_rates.compass_error(*WAY, (TIME, HEADING), EQUAL), None),
    (lambda: [moved(1.0, swap).is_mirrored for swap in (True, False)], [True, False]),
    (live, [None, None, 1.5]),
    (parts, ([[0.0, 1.0, 2.0, 3.0]] * 2, [(4, 58.0)])),
    (lambda: pair_of({"latitude", "longitude", "course"}), ("latitude", "longitude")),
    (lambda: matching("*/odom", ["/a/odom", "/b/odom", "/odometry"]), ["/a/odom", "/b/odom"]),
    (lambda: [*map(dialect.split_unit, ["Speed (km/h)", "yaw [°]", "yaw_rate_rad_s", "left", "v km/u", "fart knop"])],
     [("Speed", "km/h"), ("yaw", "deg"), ("yaw_rate", "rad/s"), ("left", ""), ("v", "km/h"), ("fart knop", "")]),
    (lambda: [*map(dialect.split_unit, ["v, over ground (kn)", "thrust_pct", "x (furlong)", "e_m", "zero_"])],
     [("v, over ground", "knots"), ("thrust", "percent"), ("x", "furlong"), ("e", "m"), ("zero_", "")]),
    (lambda: [*map(dialect.is_value, ["-0,5", "1e-3", "24.07.2025 17:18", "17:18:48.2", "m/s", ""])],
     [True] * 4 + [False] * 2),
    (lambda: [*map(dialect.find_decimal, [["0,5", "1.234,5"], ["1,234.5", "1"], ["1,234"]])],
     [(",", ""), (".", ""), (".", "'1,234', which may be 1.234 or 1234")]),
    (lambda: [*map(topics.several_kinds, [[["L", "R"], ["psi", "v"]], [["L", "R", "v"], ["L", "R", "v", "psi"]]])],
     [True, False]),
    (lambda: stamps.joined(["secs", "nsecs"], [("12", "5000000")]), ["12.005000000"]),
    (lambda: stamps.joined(["Date", "hour", "mm", "s", "ms"], ["A9876"]), ["A 09:08:07.006"]),
    (lambda: [*map(stamps.part_of, ["header.stamp.nsecs", "UTC_Year", "speed"])],
     [(9, ("header", "stamp")), ("year", ("utc",)), (None, ("speed",))]),
    (lambda: rows.quaternions(["qx", "qy", "qz", "qw", "x", "y"]), {"q": (("qx", "qy", "qz", "qw"), "enu_rad")}),
    (lambda: rows.quaternions([f"q[{k}]" for k in range(4)])["q"], (("q[1]", "q[2]", "q[3]", "q[0]"), "rad")),
    (lambda: [dataflash._unit("m/s", 0.01), dataflash._unit("A", 3600.0), dataflash._unit("degheading", 0.0)],
     ["cm/s", "3600 A", "deg"]),
    (lambda: tlog._boots(np.array([2.0, 2.1, 90.0, 90.3])).tolist(), [0, 2]),
    (lambda: [message_fields.stamp_of(STAMPED, received * 10**9, clock) // 10**8
              for received, clock in ((4, "header"), (9, "header"), (4, "receive"))], [35, 90, 40]),
    (lambda: message_fields.default_field("std_msgs/msg/Float64", "command_left[0]"), "data"),
    (lambda: limits.unpack(Path("a.bag"), bz2.compress(bytes(1000)), "bz2", 5000, 1000), (bytes(1000), True)),
    (lambda: override("surge", {"name": "*left", "span": -400.0, "field": None}),
     "'data.channels.surge.name=*left' data.channels.surge.span=-400 data.channels.surge.field=null"),
    (lambda: override("surge", {"name": "Speed (m/s)", "held": True}),
     "'data.channels.surge.name=\"Speed (m/s)\"' data.channels.surge.held=true"),
    (lambda: override("command_left", {"span": [-400, 400.5]}), "'data.channels.command_left.span=[-400,400.5]'"),
    (lambda: Finding("heron", "surge", "at rest", "0 m/s", see("a boat that moves", "surge"), "a=1").sentence(),
     "heron, surge: found 0 m/s, expected a boat that moves (see data.channels.surge.name): set a=1"),
])  # fmt: skip
def test_words(found, expected):
    assert found() == expected
