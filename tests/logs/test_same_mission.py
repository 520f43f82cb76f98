"""One mission in every format, and by each configuration that needs nothing else, gives the same samples and poses."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.support.ardupilot import PARAMETERS, frame, logged
from tests.support.ardupilot import header as dataflash_header
from tests.support.exported import DEG, KNOTS, write_alog, write_table
from tests.support.files import configured
from tests.support.ulogs import header, message, subscribe
from tests.support.voyages import EARTH, START
from usvlearn.logs.channels.channel import Channel, Recording, Source
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.formats.moos.alog import Alog
from usvlearn.logs.formats.ros.rosbag import Rosbag
from usvlearn.logs.read import read_recordings
from usvlearn.logs.recordings import align_fleet

TIME = np.arange(600) / 10
V, R = 0.2 + 0 * TIME, np.radians(2.0) + 0 * TIME  # m/s to starboard; rad/s
LEFT, RIGHT, U = 0.5 * np.sin(TIME / 9) + 0.1, 0.5 * np.sin(TIME / 9), 1.2 * np.sin(TIME / 9 - 0.4)  # and astern
PSI = np.radians(340.0) + R * TIME  # through north
VN, VE = U * np.cos(PSI) - V * np.sin(PSI), U * np.sin(PSI) + V * np.cos(PSI)
NORTH, EAST = (np.append(0.0, np.cumsum(each[1:] + each[:-1]) / 20) for each in (VN, VE))
YAW = np.remainder(PSI + math.pi, 2 * math.pi) - math.pi
TRUE = {"command_left": LEFT, "command_right": RIGHT, "heading": PSI, "yaw_rate": R, "surge": U, "sway": V,
        "north": NORTH, "east": EAST}  # fmt: skip
PWM = 400.0  # us of full scale
SERVOS = PARAMETERS | {f"SERVO{n}_{key}": 1500 + each * PWM for n in (1, 3) for key, each in
                       {"MIN": -1, "TRIM": 0, "MAX": 1}.items()} | {"SERVO3_REVERSED": 0.0}  # fmt: skip
PULSES = [[round(1500 + PWM * x) for x in each] for each in zip(LEFT, RIGHT, strict=True)]


def table(path: Path, **how) -> None:
    write_table(path, {
        "t": TIME, "L": LEFT, "R": RIGHT, "psi": DEG * PSI % 360, "r": DEG * R, "u": U, "v": 100 * V,
        "sog": KNOTS * np.hypot(U, V), "cog": DEG * np.arctan2(VE, VN) % 360, "lat": START[0] + DEG * NORTH / EARTH,
        "lon": START[1] + DEG * EAST / EARTH / math.cos(math.radians(START[0])),
    }, **how)  # fmt: skip


def german(path: Path) -> None:
    table(path, delimiter=";", comma=True)


def alog(path: Path) -> None:
    named = {"THRUST_L": LEFT, "THRUST_R": RIGHT, "NAV_HEADING": DEG * PSI % 360, "NAV_YAW_RATE": R, "NAV_SPEED": U,
             "NAV_SWAY": V, "NAV_X": EAST, "NAV_Y": NORTH}  # fmt: skip
    write_alog(path, {name: (TIME, value) for name, value in named.items()})


def bag(kind: str) -> Callable[[Path], None]:
    """In the axes of ROS: x ahead, y to port, angles from east, counter-clockwise."""

    def write(path: Path) -> None:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS1_NOETIC if kind == "ROS1" else Stores.ROS2_HUMBLE)
        vector, pose = (store.types[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Pose2D"))
        topics = {
            "/thrust": lambda k: vector(x=LEFT[k], y=RIGHT[k], z=0.0),
            "/pose": lambda k: pose(x=EAST[k], y=NORTH[k], theta=math.pi / 2 - PSI[k]),
            "/twist": lambda k: vector(x=U[k], y=-V[k], z=-R[k]),
        }
        folder = path.with_suffix("")
        pack = store.serialize_ros1 if kind == "ROS1" else store.serialize_cdr
        plugin = None if kind == "ROS1" else StoragePlugin[kind]
        with Writer1(path) if plugin is None else Writer2(folder, version=9, storage_plugin=plugin) as bag:
            kinds = {topic: make(0).__msgtype__ for topic, make in topics.items()}
            opened = {topic: bag.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
            for k, t in enumerate(TIME):
                for topic, make in topics.items():
                    bag.write(opened[topic], round(1e9 * (1.7e9 + t)), pack(make(k), kinds[topic]))
        if kind != "ROS1":
            next(folder.glob(f"*{path.suffix}")).rename(path)

    return write


def dataflash(path: Path) -> None:
    data = dataflash_header() + b"".join(logged("PARM", 0, name, value, 0.0) for name, value in SERVOS.items())
    for k, t in enumerate(TIME):
        us = round(1e6 * (t + 5))
        data += logged("RCOU", us, PULSES[k][0], 0, PULSES[k][1], 0) + logged("ATT", us, 0, float(DEG * PSI[k] % 360))
        data += logged("IMU", us, 0, R[k], 0) + logged("XKF1", us, 0, VN[k], VE[k], NORTH[k], EAST[k])
    path.write_bytes(data + logged("MSG", us, "end"))


def tlog(path: Path) -> None:
    content = b"".join(frame("PARAM_VALUE", 0.0, param_id=name.encode(), param_value=x) for name, x in SERVOS.items())
    content += frame("HEARTBEAT", 0.0, type=11, autopilot=3, base_mode=128)
    for k, t in enumerate(TIME):
        ms = round(1000 * (t + 5))
        content += frame("SERVO_OUTPUT_RAW", t, time_usec=1000 * ms, servo1_raw=PULSES[k][0], servo3_raw=PULSES[k][1])
        content += frame("ATTITUDE", t, time_boot_ms=ms, yaw=YAW[k], yawspeed=R[k])
        content += frame("LOCAL_POSITION_NED", t, time_boot_ms=ms, vx=VN[k], vy=VE[k], x=NORTH[k], y=EAST[k])
    path.write_bytes(content)


def ulog(path: Path) -> None:
    formats = {
        "actuator_motors": "uint64_t timestamp;float[2] control;",
        "vehicle_attitude": "uint64_t timestamp;float[4] q;",
        "vehicle_angular_velocity": "uint64_t timestamp;float[3] xyz;",
        "vehicle_local_position": "uint64_t timestamp;float x;float y;float vx;float vy;",
    }
    data = header(formats) + b"".join(subscribe(k, name) for k, name in enumerate(formats))
    for k, t in enumerate(TIME):
        us, half = round(1e6 * t), PSI[k] / 2
        data += message(0, us, "2f", LEFT[k], RIGHT[k]) + message(1, us, "4f", math.cos(half), 0, 0, math.sin(half))
        data += message(2, us, "3f", 0.0, 0.0, R[k]) + message(3, us, "4f", NORTH[k], EAST[k], VN[k], VE[k])
    path.write_bytes(data)


def of(name: str, fields: dict[str, str]) -> dict[str, Source]:
    return {channel: Source(name, field) for channel, field in fields.items()}


SIDES = {"command_left": Source("L"), "command_right": Source("R"), "heading": Source("psi", unit="deg"),
         "yaw_rate": Source("r", unit="deg/s")}  # fmt: skip
PLACED = SIDES | {"latitude": Source("lat", unit="deg"), "longitude": Source("lon", unit="deg")}
SWAY = PLACED | {"surge": Source("u"), "sway": Source("v", unit="cm/s")}
COURSE = PLACED | {"ground_speed": Source("sog", unit="knots"), "course": Source("cog", unit="deg")}
MOOS = {
    "command_left": Source("THRUST_L"), "command_right": Source("THRUST_R"),
    "heading": Source("NAV_HEADING", unit="deg"), "yaw_rate": Source("NAV_YAW_RATE"),
    "surge": Source("NAV_SPEED"), "sway": Source("NAV_SWAY"),
    "north": Source("NAV_Y"), "east": Source("NAV_X"),
}  # fmt: skip
ROS = of("/thrust", {"command_left": "x", "command_right": "y"}) | of("/pose", {"north": "y", "east": "x"}) | {
    "heading": Source("/pose", "theta", "enu_rad"), "yaw_rate": Source("/twist", "z", "enu_rad/s"),
    "surge": Source("/twist", "x"), "sway": Source("/twist", "y", span=-1)}  # fmt: skip
LOGS = {  # what writes it, suffix, reader and channels, or the name of a configuration; steps of a command
    "csv, sway": (table, ".csv", (Table("t"), SWAY), 0.0),
    "csv, course": (table, ".csv", (Table("t"), COURSE), 0.0),
    "csv with decimal commas": (german, ".csv", (Table("t"), SWAY), 0.0),
    "moos": (alog, ".alog", (Alog(), MOOS), 0.0),
    "ros 1": (bag("ROS1"), ".bag", (Rosbag(), ROS), 0.0),
    "ros 2, mcap": (bag("MCAP"), ".mcap", (Rosbag(), ROS), 0.0),
    "ros 2, db3": (bag("SQLITE3"), ".db3", (Rosbag(), ROS), 0.0),
    "dataflash": (dataflash, ".BIN", "ardupilot", 0.5 / PWM),
    "tlog": (tlog, ".tlog", "tlog", 0.5 / PWM),
    "ulog": (ulog, ".ulg", "ulog", 0.0),
}


@pytest.mark.parametrize("name", LOGS)
@pytest.mark.filterwarnings("ignore:.*computed from")
def test_the_samples_and_poses_are_those_of_the_mission(tmp_path, name):
    write, suffix, how, step = LOGS[name]
    write(path := tmp_path / f"mission{suffix}")
    if isinstance(how, str):
        (recording,) = configured(how, path)
    else:
        (recording,) = read_recordings(path, *how)
    channels = {key: Channel(TIME, x, len(TRUE) * np.arange(len(TIME)) + k) for k, (key, x) in enumerate(TRUE.items())}
    (run,), (true,) = (align_fleet([each]).runs for each in (recording, Recording("mission", "1", channels, {})))
    np.testing.assert_allclose(run.time, true.time, atol=1e-5)
    np.testing.assert_array_equal(run.samples.measured, true.samples.measured)
    samples, expected = run.samples, true.samples
    for side in ("command_left", "command_right"):
        np.testing.assert_allclose(getattr(samples.inputs, side), getattr(expected.inputs, side), atol=step + 1e-5)
    turned = np.exp(1j * (samples.inputs.heading - expected.inputs.heading))
    np.testing.assert_allclose(np.angle(turned), 0, atol=1e-5)  # what 32 bits resolve of 360 deg
    np.testing.assert_allclose(samples.surge, expected.surge, atol=1e-5)
    assert run.samples.measured.mean() > 0.99 and np.nanmin(samples.surge) < -1
    heading, rate, sway, *place = np.moveaxis(run.poses[1:, 0], -1, 0)
    heading_, rate_, sway_, *place_ = np.moveaxis(true.poses[1:, 0], -1, 0)
    np.testing.assert_allclose(np.angle(np.exp(1j * (heading - heading_))), 0, atol=0.01)
    np.testing.assert_allclose((rate, sway), (rate_, sway_), atol=1e-5)
    for way, other in zip(place, place_, strict=True):
        np.testing.assert_allclose(way - way[0], other - other[0], atol=0.2)  # of a fix of 0.1 s before
