"""One mission in every format gives the same samples, to the resolution of the format."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from tests.support.ardupilot import PARAMETERS, frame, header, logged
from tests.support.ulogs import boat
from usvlearn.logs.channels.channel import Channel, Recording
from usvlearn.logs.formats.ardupilot.dataflash import DataFlash
from usvlearn.logs.formats.ardupilot.tlog import Tlog
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.formats.moos.alog import Alog
from usvlearn.logs.formats.px4.ulog import Ulog
from usvlearn.logs.formats.ros.rosbag import Rosbag
from usvlearn.logs.read import read_recordings
from usvlearn.logs.recordings import align_fleet

NAMES = ("left", "right", "psi", "speed")
PLAIN = {
    "command_left": {"name": "left"},
    "command_right": {"name": "right"},
    "heading": {"name": "psi", "unit": "deg"},
    "surge": {"name": "speed"},
}
PWM = 400.0  # us of full scale
SERVOS = PARAMETERS | {f"SERVO{n}_{key}": 1500 + each * PWM for n in (1, 3) for key, each in
                       {"MIN": -1, "TRIM": 0, "MAX": 1}.items()} | {"SERVO3_REVERSED": 0.0}  # fmt: skip


def rows() -> Iterator[tuple[float, float, float, float, float]]:
    """Time, s, both commands, heading in deg, speed in m/s: ahead, on a turn through north, and astern."""
    for k in range(600):
        t = k / 10
        yield t, 0.5 * math.sin(t / 9) + 0.1, 0.5 * math.sin(t / 9), (340 + 2 * t) % 360, 1.2 * math.sin(t / 9 - 0.4)


def text(line: Callable[..., str], head: str) -> Callable[[Path], None]:
    return lambda path: path.write_text(head + "".join(line(*row) for row in rows()))  # type: ignore[func-returns-value]


def german(*row: float) -> str:
    return ";".join(f"{x:.4f}" for x in row).replace(".", ",") + "\n"


def posts(t: float, *values: float) -> str:
    return "".join(f"{t:.3f} {name} pApp {x:.6f}\n" for name, x in zip(NAMES, values, strict=True))


def velocities(psi: float, speed: float) -> tuple[float, float]:
    return speed * math.cos(math.radians(psi)), speed * math.sin(math.radians(psi))


def widths(*commands: float) -> list[int]:
    return [round(1500 + PWM * each) for each in commands]


def dataflash(path: Path) -> None:
    found = header() + b"".join(logged("PARM", 0, name, value, 0.0) for name, value in SERVOS.items())
    for t, left, right, psi, speed in rows():
        us, pwm = round(1e6 * (t + 5)), widths(left, right)
        found += logged("RCOU", us, pwm[0], 0, pwm[1], 0) + logged("ATT", us, 0, psi)
        found += logged("XKF1", us, 0, *velocities(psi, speed), 0.0, 0.0)
    path.write_bytes(found + logged("MSG", us, "end"))


def tlog(path: Path) -> None:
    found = b"".join(frame("PARAM_VALUE", 0.0, param_id=name.encode(), param_value=x) for name, x in SERVOS.items())
    found += frame("HEARTBEAT", 0.0, type=11, autopilot=3, base_mode=128)
    for t, left, right, psi, speed in rows():
        ms, pwm, (north, east) = round(1000 * (t + 5)), widths(left, right), velocities(psi, speed)
        yaw = math.remainder(math.radians(psi), 2 * math.pi)
        found += frame("SERVO_OUTPUT_RAW", t, time_usec=1000 * ms, servo1_raw=pwm[0], servo3_raw=pwm[1])
        found += frame("ATTITUDE", t, time_boot_ms=ms, yaw=yaw)
        found += frame("LOCAL_POSITION_NED", t, time_boot_ms=ms, vx=north, vy=east)
    path.write_bytes(found)


def bag(kind: str) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.ROS1_NOETIC if kind == "ROS1" else Stores.ROS2_HUMBLE)
        name, folder = "std_msgs/msg/Float64", path.with_suffix("")
        one: Any = Writer1(path) if kind == "ROS1" else Writer2(folder, version=9, storage_plugin=StoragePlugin[kind])
        pack = store.serialize_ros1 if kind == "ROS1" else store.serialize_cdr
        with one as written:
            connections = [written.add_connection(f"/{each}", name, typestore=store) for each in NAMES]
            for t, *values in rows():
                for connection, value in zip(connections, values, strict=True):
                    written.write(connection, round(1e9 * (1.7e9 + t)), pack(store.types[name](data=value), name))
        if kind != "ROS1":
            next(folder.glob(f"*{path.suffix}")).rename(path)

    return write


class Format(NamedTuple):
    write: Callable[[Path], object]
    suffix: str
    reader: Any
    channels: dict[str, dict]
    tolerance: tuple[float, float, float] = (1e-6, 1e-6, 1e-6)  # of commands, heading (rad), speed (m/s)


EKF = {"velocity_north": {"name": "XKF1", "field": "VN"}, "velocity_east": {"name": "XKF1", "field": "VE"}}
NED = {f"velocity_{axis}": {"name": "LOCAL_POSITION_NED", "field": f"v{x}"} for axis, x in zip(("north", "east"), "xy",
                                                                                          strict=True)}  # fmt: skip
FLOAT = 1e-5  # what 32 bits resolve of 360 deg, in rad
FORMATS = {
    "table": Format(text(lambda *row: ",".join(f"{x:.7f}" for x in row) + "\n", "t,left,right,psi,speed\n"), ".csv",
                    Table("t"), PLAIN),
    "table with decimal commas": Format(text(german, "t;left;right;psi;speed\n"), ".csv", Table("t"), PLAIN,
                                        (1e-4, 1e-4, 1e-4)),
    "MOOS": Format(text(posts, "%% LOGSTART 1.5e9\n"), ".alog", Alog(), PLAIN),
    "ROS 1": Format(bag("ROS1"), ".bag", Rosbag(), PLAIN),
    "ROS 2, mcap": Format(bag("MCAP"), ".mcap", Rosbag(), PLAIN),
    "ROS 2, db3": Format(bag("SQLITE3"), ".db3", Rosbag(), PLAIN),
    "ULog": Format(lambda path: path.write_bytes(boat(rows())), ".ulg", Ulog(), {
        "command_left": {"name": "motors", "field": "control[0]"},
        "command_right": {"name": "motors", "field": "control[1]"},
        "heading": {"name": "motion", "field": "psi", "unit": "deg"},
        "surge": {"name": "motion", "field": "v"},
    }, (1e-6, FLOAT, 1e-6)),
    "ArduPilot": Format(dataflash, ".BIN", DataFlash(), {
        "command_left": {"name": "RCOU", "field": "throttle_left"},
        "command_right": {"name": "RCOU", "field": "throttle_right"},
        "heading": {"name": "ATT", "field": "Yaw", "unit": "deg"},
        **EKF,
    }, (0.5 / PWM + 1e-6, FLOAT, 1e-5)),
    "MAVLink": Format(tlog, ".tlog", Tlog(), {
        "command_left": {"name": "SERVO_OUTPUT_RAW", "field": "throttle_left"},
        "command_right": {"name": "SERVO_OUTPUT_RAW", "field": "throttle_right"},
        "heading": {"name": "ATTITUDE", "field": "yaw"},
        **NED,
    }, (0.5 / PWM + 1e-6, FLOAT, 1e-5)),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*no speed is configured")
@pytest.mark.parametrize("name", FORMATS)
def test_the_samples_are_those_of_the_mission(tmp_path, name):
    if name.startswith("ROS"):
        pytest.importorskip("rosbags", reason="needs the package rosbags")
    if name == "ULog":
        pytest.importorskip("pyulog", reason="needs the package pyulog")
    one = FORMATS[name]
    one.write(path := tmp_path / f"mission{one.suffix}")
    made = align_fleet(read_recordings(path, one.reader, one.channels)).runs[0]
    time, *values = np.array(list(rows())).T
    values[2] = np.radians(values[2])
    channels = {key: Channel(time, x, 4 * np.arange(len(time)) + k) for k, (key, x) in
                enumerate(zip(PLAIN, values, strict=True))}  # fmt: skip
    true = align_fleet([Recording("mission", "1", channels, {})]).runs[0]
    np.testing.assert_allclose(made.time, true.time, atol=1e-5)
    np.testing.assert_array_equal(made.samples.measured, true.samples.measured)
    own, expected = made.samples, true.samples
    command, heading, speed = one.tolerance
    np.testing.assert_allclose(own.inputs.command_left, expected.inputs.command_left, atol=command)
    np.testing.assert_allclose(own.inputs.command_right, expected.inputs.command_right, atol=command)
    turned = np.remainder(own.inputs.heading - expected.inputs.heading + math.pi, 2 * math.pi) - math.pi
    np.testing.assert_allclose(turned, 0, atol=heading)
    np.testing.assert_allclose(own.surge, expected.surge, atol=speed)
    assert made.samples.measured.mean() > 0.99 and np.nanmin(own.surge) < -1
