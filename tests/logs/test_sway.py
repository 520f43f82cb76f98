"""Every format of logs gives what tracks need: sway, yaw rate and position of a boat on a circle, in closed form."""

import math
from pathlib import Path

import numpy as np
import pytest

from tests.support.ardupilot import PARAMETERS, SERVOS, frame, logged
from tests.support.ardupilot import header as dataflash_header
from tests.support.exported import DEG, KNOTS, write_alog, write_table
from tests.support.ulogs import header, message, subscribe
from tests.support.voyages import EARTH, START
from usvlearn.errors import ConfigError
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.ardupilot.dataflash import DataFlash
from usvlearn.logs.formats.ardupilot.tlog import Tlog
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.formats.moos.alog import Alog
from usvlearn.logs.formats.px4.ulog import Ulog
from usvlearn.logs.formats.ros.rosbag import Rosbag
from usvlearn.logs.read import read_recordings
from usvlearn.logs.recordings import align_fleet

U, V, R = 1.0, 0.2, 0.1  # m/s, m/s, rad/s
TIME = np.arange(0.0, 20.0, 0.1)
PSI = 3.0 + R * TIME  # it passes south
NORTH = (U * (np.sin(PSI) - np.sin(PSI[0])) + V * (np.cos(PSI) - np.cos(PSI[0]))) / R
EAST = (-U * (np.cos(PSI) - np.cos(PSI[0])) + V * (np.sin(PSI) - np.sin(PSI[0]))) / R
VN, VE = U * np.cos(PSI) - V * np.sin(PSI), U * np.sin(PSI) + V * np.cos(PSI)
ONE = np.ones(len(TIME))
LEFT, RIGHT = 0.5, 0.4
VELOCITIES = "velocity_north", "velocity_east"


def table(folder: Path) -> Path:
    return write_table(folder / "a.csv", {
        "t": TIME, "L": LEFT * ONE, "R": RIGHT * ONE, "psi": DEG * PSI % 360, "r": DEG * R * ONE, "u": U * ONE,
        "v": 100 * V * ONE, "sog": KNOTS * np.hypot(U, V) * ONE, "cog": DEG * (PSI + math.atan2(V, U)) % 360,
        "lat": START[0] + np.degrees(NORTH / EARTH),
        "lon": START[1] + np.degrees(EAST / EARTH / math.cos(math.radians(START[0]))),
    })  # fmt: skip


def alog(folder: Path) -> Path:
    named = {
        "THRUST_L": 100 * LEFT * ONE, "THRUST_R": 100 * RIGHT * ONE, "NAV_HEADING": DEG * PSI % 360,
        "NAV_YAW_RATE": R * ONE, "NAV_SPEED": U * ONE, "NAV_SWAY": V * ONE, "NAV_X": EAST, "NAV_Y": NORTH,
    }  # fmt: skip
    return write_alog(folder / "a.alog", {name: (TIME, value) for name, value in named.items()})


def bag(folder: Path) -> Path:
    """In the axes of ROS: x ahead, y to port, angles from east, counter-clockwise."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    vector, pose = (store.types[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Pose2D"))
    with Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        made = {
            "/thrust": lambda k: vector(x=LEFT, y=RIGHT, z=0.0),
            "/pose": lambda k: pose(x=EAST[k], y=NORTH[k], theta=math.pi / 2 - PSI[k]),
            "/twist": lambda k: vector(x=U, y=-V, z=-R),
        }
        kinds = {topic: make(0).__msgtype__ for topic, make in made.items()}
        opened = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind in kinds.items()}
        for k, t in enumerate(TIME):
            for topic, make in made.items():
                data = store.serialize_cdr(make(k), kinds[topic])
                writer.write(opened[topic], 1_700_000_000_000_000_000 + round(1e9 * t), data)
    return folder / "bag"


def dataflash(folder: Path) -> Path:
    data = dataflash_header() + b"".join(logged("PARM", 0, name, value, 0.0) for name, value in PARAMETERS.items())
    for k, t in enumerate(TIME):
        us = 5_000_000 + round(1e6 * t)
        data += logged("RCOU", us, 1750, 0, 1300, 1500) + logged("ATT", us, 0, float(DEG * PSI[k] % 360))
        data += logged("IMU", us, 0, R, 0) + logged("XKF1", us, 0, VN[k], VE[k], NORTH[k], EAST[k])
    (folder / "a.BIN").write_bytes(data)
    return folder / "a.BIN"


def telemetry(folder: Path) -> Path:
    names = enumerate(PARAMETERS.items())
    data = b"".join(frame("PARAM_VALUE", 0.001 * k, param_id=name.encode(), param_value=each)
                    for k, (name, each) in names)  # fmt: skip
    for k, t in enumerate(TIME):
        ms = 5000 + round(1e3 * t)
        data += frame("HEARTBEAT", t, type=11, autopilot=3, base_mode=128) if k % 10 == 0 else b""
        data += frame("SERVO_OUTPUT_RAW", t, time_usec=1000 * ms, servo1_raw=1750, servo3_raw=1300)
        yaw = math.remainder(PSI[k], 2 * math.pi)
        data += frame("ATTITUDE", t, time_boot_ms=ms, yaw=yaw, yawspeed=R)
        data += frame("LOCAL_POSITION_NED", t, time_boot_ms=ms, vx=VN[k], vy=VE[k], x=NORTH[k], y=EAST[k])
    (folder / "a.tlog").write_bytes(data)
    return folder / "a.tlog"


def ulog(folder: Path) -> Path:
    formats = {
        "actuator_motors": "uint64_t timestamp;float[2] control;",
        "vehicle_angular_velocity": "uint64_t timestamp;float[3] xyz;",
        "vehicle_local_position": "uint64_t timestamp;float x;float y;float vx;float vy;float heading;",
    }
    data = header(formats) + b"".join(subscribe(k, name) for k, name in enumerate(formats))
    for k, t in enumerate(TIME):
        us, yaw = round(1e6 * t), math.remainder(PSI[k], 2 * math.pi)
        data += message(0, us, "2f", LEFT, RIGHT) + message(1, us, "3f", 0.0, 0.0, R)
        data += message(2, us, "5f", NORTH[k], EAST[k], VN[k], VE[k], yaw)
    (folder / "a.ulg").write_bytes(data)
    return folder / "a.ulg"


def of(name: str, fields: dict[str, str]) -> dict[str, Source]:
    return {channel: Source(name, field) for channel, field in fields.items()}


SIDES = {"command_left": Source("L"), "command_right": Source("R")}
TABLE = SIDES | {
    "heading": Source("psi", unit="deg"), "yaw_rate": Source("r", unit="deg/s"),
    "latitude": Source("lat", unit="deg"), "longitude": Source("lon", unit="deg"),
}  # fmt: skip
LOGS = {
    "csv, sway": (table, Table("t"), TABLE | {"surge": Source("u"), "sway": Source("v", unit="cm/s")}),
    "csv, course": (table, Table("t"), TABLE | {"ground_speed": Source("sog", unit="knots"),
                                                "course": Source("cog", unit="deg")}),
    "moos": (alog, Alog(), {
        "command_left": Source("THRUST_L", span=100), "command_right": Source("THRUST_R", span=100),
        "heading": Source("NAV_HEADING", unit="deg"), "yaw_rate": Source("NAV_YAW_RATE"), "surge": Source("NAV_SPEED"),
        "sway": Source("NAV_SWAY"), "north": Source("NAV_Y"), "east": Source("NAV_X")}),
    "ros": (bag, Rosbag(), of("/thrust", {"command_left": "x", "command_right": "y"})
            | of("/pose", {"north": "y", "east": "x"}) | {
        "heading": Source("/pose", "theta", "enu_rad"), "yaw_rate": Source("/twist", "z", "enu_rad/s"),
        "surge": Source("/twist", "x"), "sway": Source("/twist", "y", span=-1)}),
    "dataflash": (dataflash, DataFlash(), SERVOS | {
        "heading": Source("ATT", "Yaw", "deg"), "yaw_rate": Source("IMU[0]", "GyrZ")}
        | of("XKF1", {"velocity_north": "VN", "velocity_east": "VE", "north": "PN", "east": "PE"})),
    "tlog": (telemetry, Tlog(), {
        "command_left": Source("SERVO_OUTPUT_RAW", "throttle_left"),
        "command_right": Source("SERVO_OUTPUT_RAW", "throttle_right")}
        | of("ATTITUDE", {"heading": "yaw", "yaw_rate": "yawspeed"})
        | of("LOCAL_POSITION_NED", {"velocity_north": "vx", "velocity_east": "vy", "north": "x", "east": "y"})),
    "ulog": (ulog, Ulog(), of("actuator_motors", {"command_left": "control[0]", "command_right": "control[1]"})
             | of("vehicle_angular_velocity", {"yaw_rate": "xyz[2]"})
             | of("vehicle_local_position", {"heading": "heading", "velocity_north": "vx", "velocity_east": "vy",
                                             "north": "x", "east": "y"})),
}  # fmt: skip
NEEDS = {"ros": "rosbags", "ulog": "pyulog"}


@pytest.mark.parametrize("name", LOGS)
@pytest.mark.filterwarnings("ignore:.*computed from")
def test_a_format_gives_sway_yaw_rate_and_position(tmp_path, name):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    write, reader, sources = LOGS[name]
    (recording,) = read_recordings(write(tmp_path), reader, sources, "boat")
    channels = recording.channels
    assert set(sources) <= set(channels)
    if "sway" in sources:
        np.testing.assert_allclose(channels["sway"].value, V, atol=1e-6)
    for channel, truth in (*zip(VELOCITIES, (VN, VE), strict=True), ("north", NORTH), ("east", EAST)):
        if channel in sources:
            np.testing.assert_allclose(channels[channel].value, truth, atol=1e-5)
    np.testing.assert_allclose(channels["yaw_rate"].value, R, atol=1e-6)
    (run,) = align_fleet([recording]).runs
    heading, rate, sway, north, east = run.poses[1:, 0].T
    at = TIME[np.argmin(np.abs(np.exp(1j * heading[:, None]) - np.exp(1j * PSI)), axis=1)]
    assert np.abs(np.diff(at) - np.diff(run.time[1:, 0])).max() < 0.15  # a step later, the boat has turned by so much
    np.testing.assert_allclose(rate, R, atol=1e-6)
    np.testing.assert_allclose(sway, V, atol=1e-4)
    moved = np.hypot(np.diff(north), np.diff(east)) / np.diff(run.time[1:, 0])
    np.testing.assert_allclose(moved, math.hypot(U, V), rtol=0.01)  # a chord is shorter than its arc
    truth = [np.interp(at, TIME, each) for each in (NORTH, EAST)]
    for found, expected in zip((north, east), truth, strict=True):
        np.testing.assert_allclose(found - found[0], expected - expected[0], atol=0.2)  # of a fix of 0.1 s before
    assert np.nanmax(np.abs(run.samples.surge - U)) < 1e-3


@pytest.mark.parametrize(("channel", "unit"), [("sway", "deg/s"), ("north", "deg"), ("yaw_rate", "m/s")])
def test_a_unit_that_a_channel_cannot_have_is_refused(tmp_path, channel, unit):
    sources = TABLE | {"surge": Source("u"), channel: Source("v", unit=unit)}
    with pytest.raises(ConfigError, match=rf"{channel}.*{unit}"):
        read_recordings(table(tmp_path), Table("t"), sources, "boat")
