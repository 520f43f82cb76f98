"""What functions of one line or two return: cells, names, units, stamps, angles and findings."""

import bz2
from pathlib import Path
from types import SimpleNamespace as Message

import numpy as np
import pytest

from usvlearn.logs.channels import positions
from usvlearn.logs.channels.channel import degrees, matching, parse_numbers
from usvlearn.logs.channels.derived_surge import LiveSurge, pair_of
from usvlearn.logs.checks.evidence import spread
from usvlearn.logs.checks.finding import Finding, override, see
from usvlearn.logs.formats.ardupilot import dataflash, servos, tlog
from usvlearn.logs.formats.csv import dialect, rows, stamps, topics
from usvlearn.logs.formats.ros import limits, message_fields

STAMPED = Message(header=Message(stamp=Message(sec=3, nanosec=500_000_000)))


def live() -> list[float | None]:
    one = LiveSurge(("velocity_north", "velocity_east"), held=False)
    return [
        one.push("heading", 0.0, np.pi / 2),
        one.push("velocity_north", 0.1, 0.0),
        one.push("velocity_east", 0.1, 1.5),
    ]


@pytest.mark.parametrize(("found", "expected"), [
    (lambda: parse_numbers(["1.5", "", "nan", "off", "1_000"]), [1.5, *[np.nan] * 4]),
    (lambda: parse_numbers(["\u22121.5", "(2)", "()"]), [-1.5, -2, np.nan]),
    (lambda: stamps.parse_cells(["1,5", "1.5", "1.234,5"], ","), [1.5, np.nan, np.nan]),
    (lambda: degrees(np.array([4218.0, -7106.0])), [42.3, -71.1]),
    (lambda: np.diff(stamps.unwrapped(np.array([4294967000.0, 4294967200.0, 104.0]))), [200, 200]),
    (lambda: stamps.spread(np.array([0.0, 0, 1, 1, 1, 1, 2]), 5.0)[0], [0, 0.5, 1, 1.25, 1.5, 1.75, 2]),
    (lambda: servos.Limits(1100, 1500, 2000, True).share(np.array([1100.0, 1500, 1750, 0])), [1, 0, -0.5, 0]),
    (lambda: message_fields.yaw(0.0, 0.0, 2.0, 2.0), np.pi / 2),
    (lambda: spread(np.array([1.0, np.nan, 3.0])), 1.0),
    (lambda: positions.local(np.radians([60.0, 60.001]), np.radians([179.9995, -179.9995])),
     ([0, 111.41229], [0, 55.80000])),
])  # fmt: skip
def test_numbers(found, expected):
    np.testing.assert_allclose(found(), expected, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize(("found", "expected"), [
    (live, [None, None, 1.5]),
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
