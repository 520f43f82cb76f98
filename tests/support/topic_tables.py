"""A simulated voyage as folders of tables, one file per topic, with the truth about its channels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tests.support.shapes import Shape, of, pair
from tests.support.voyages import Voyage

BEGIN = 1_690_000_000.0  # s since 1970
Columns = Mapping[str, np.ndarray]


def stamps(voyage: Voyage, hz: float, seed: int = 0) -> np.ndarray:
    """Times of messages, s, with jitter."""
    even = np.arange(0.5, voyage.surge[0].max() - 0.5, 1 / hz)
    return even + np.random.default_rng([seed, round(hz)]).normal(0, 0.002, len(even))


def write_topic(path: Path, time: np.ndarray, columns: Columns, stamp: str, unit: float, digits: str = ".0f") -> None:
    """A table whose stamps are numbers of 1/unit s."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [",".join([stamp, *columns])]
    for when, *row in zip(time, *columns.values(), strict=True):
        lines.append(",".join([format((BEGIN + when) * unit, digits), *(repr(round(float(each), 9)) for each in row)]))
    path.write_text("\n".join(lines) + "\n")


def rotation(prefix: str, yaw: np.ndarray, axes: str = "xyzw") -> dict[str, np.ndarray]:
    """The columns of a quaternion."""
    parts = {"x": 0 * yaw, "y": 0 * yaw, "z": np.sin(yaw / 2), "w": np.cos(yaw / 2)}
    return {f"{prefix}{axis}": parts[axis] for axis in axes}


def odometry(voyage: Voyage, time: np.ndarray, prefix: str, dot: str = ".") -> dict[str, np.ndarray]:
    """The numbers of a nav_msgs/Odometry, from east and counter-clockwise."""
    names = {name: f"{prefix}{name.replace('.', dot)}" for name in (
        "pose.pose.position.x", "pose.pose.position.y", "twist.twist.linear.x", "twist.twist.linear.y",
        "twist.twist.angular.z")}  # fmt: skip
    rng = np.random.default_rng(3)
    values = (
        np.interp(time, *voyage.east), np.interp(time, *voyage.north), voyage.at("surge", time),
        rng.normal(0, 0.02, len(time)), -voyage.at("yaw_rate", time),
    )  # fmt: skip
    turned = rotation(f"{prefix}pose{dot}pose{dot}orientation{dot}", math.pi / 2 - voyage.at("heading", time))
    return dict(zip(names.values(), values, strict=True)) | turned


def rostopic(folder: Path, voyage: Voyage) -> Path:
    """`rostopic echo -p`: nanoseconds, `%time` and `field.`."""
    time = stamps(voyage, 10)
    head = {"field.header.seq": np.arange(len(time)), "field.header.stamp": (BEGIN + time) * 1e9}
    drive = {"field.left": voyage.at("command_left", time), "field.right": voyage.at("command_right", time)}
    write_topic(folder / "run" / "cmd_drive.csv", time, head | drive, "%time", 1e9)
    covariance = {f"field.pose.covariance{k}": 0 * time for k in range(36)}
    write_topic(folder / "run" / "odom.csv", time, head | odometry(voyage, time, "field.") | covariance, "%time", 1e9)
    time = stamps(voyage, 20)
    rate = {"field.angular_velocity.z": -voyage.at("yaw_rate", time), "field.linear_acceleration.z": 9.8 + 0 * time}
    turned = rotation("field.orientation.", math.pi / 2 - voyage.at("heading", time))
    write_topic(folder / "run" / "imu.csv", time, turned | rate, "%time", 1e9)
    return folder / "run"


def plotjuggler(folder: Path, voyage: Voyage) -> Path:
    """One table of PlotJuggler, with empty cells where a topic had no message."""
    slow, fast = stamps(voyage, 10), stamps(voyage, 20, 1)
    drive = {f"/cmd_drive/{side}": voyage.at(f"command_{side}", slow) for side in ("left", "right")}
    topics = ((slow, drive), (fast, odometry(voyage, fast, "/odom/", "/")))
    names = [name for _, columns in topics for name in columns]
    rows = []
    for time, columns in topics:
        for when, *values in zip(time, *columns.values(), strict=True):
            cells = dict(zip(columns, values, strict=True))
            rows.append((when, ",".join("" if name not in cells else repr(float(cells[name])) for name in names)))
    lines = [",".join(["__time", *names]), *(f"{BEGIN + when:.6f},{cells}" for when, cells in sorted(rows))]
    (folder / "plot.csv").write_text("\n".join(lines) + "\n")
    return folder / "plot.csv"


def numbers(folder: Path, voyage: Voyage) -> Path:
    """A std_msgs/Float64 for each quantity: all tables have the same columns."""
    for name, source, factor in (("left_thruster", "command_left", 30.0), ("right_thruster", "command_right", 30.0),
                             ("heading", "heading", 180 / math.pi), ("speed", "surge", 1.0)):  # fmt: skip
        time = stamps(voyage, 10, len(name))
        write_topic(
            folder / "run" / f"{name}.csv", time, {"field.data": factor * voyage.at(source, time)}, "%time", 1e9
        )
    return folder / "run"


def px4(folder: Path, voyage: Voyage) -> Path:
    """`ulog2csv`: microseconds, and quaternions that begin with w and count from north."""
    time = stamps(voyage, 10)
    motors = {"control[0]": voyage.at("command_left", time), "control[1]": voyage.at("command_right", time)}
    write_topic(folder / "run" / "log_actuator_motors_0.csv", time, motors, "timestamp", 1e6)
    turned = rotation("", voyage.at("heading", time), "wxyz")
    columns = {f"q[{k}]": value for k, value in enumerate(turned.values())}
    write_topic(folder / "run" / "log_vehicle_attitude_0.csv", time, columns, "timestamp", 1e6)
    time = stamps(voyage, 10, 1)
    speed, heading = voyage.at("surge", time), voyage.at("heading", time)
    local = {"x": np.interp(time, *voyage.north), "y": np.interp(time, *voyage.east),
             "vx": speed * np.cos(heading), "vy": speed * np.sin(heading)}  # fmt: skip
    write_topic(folder / "run" / "log_vehicle_local_position_0.csv", time, local, "timestamp", 1e6)
    return folder / "run"


def ferry(folder: Path, voyage: Voyage) -> Path:
    """The force and the moment of all thrusters, in N and N·m, beside angles of thrusters that turn."""
    time = stamps(voyage, 10)
    left, right = voyage.at("command_left", time), voyage.at("command_right", time)
    wrench = {"tau_x": 400 * (left + right), "tau_y": 0 * time + 5 * np.sin(time), "tau_n": 600 * (left - right)}
    write_topic(folder / "run" / "wrench.csv", time, wrench, "time", 1.0, ".4f")
    turning = {f"azimuth_{k}": np.sin(time / 7 + k) for k in (1, 2)} | {"rpm_1": 500 * left, "rpm_2": 500 * right}
    write_topic(folder / "run" / "thrusters.csv", time, turning, "time", 1.0, ".4f")
    write_topic(folder / "run" / "odometry.csv", time, odometry(voyage, time, ""), "time", 1.0, ".4f")
    return folder / "run"


TOPICS = {
    "rostopic": Shape(rostopic, pair("cmd_drive.field.left", "cmd_drive.field.right", zero=0, span=1)
        | {"heading": [{"name": "imu.field.orientation", "unit": "enu_rad"},
        {"name": "odom.field.pose.pose.orientation", "unit": "enu_rad"}],
        "yaw_rate": [{"name": "imu.field.angular_velocity.z", "unit": "enu_rad/s"},
        {"name": "odom.field.twist.twist.angular.z", "unit": "enu_rad/s"}]}
        | of(surge=("odom.field.twist.twist.linear.x", "m/s"))),
    "plotjuggler": Shape(plotjuggler, pair("/cmd_drive/left", "/cmd_drive/right", zero=0, span=1)
        | of(heading=("/odom/pose/pose/orientation", "enu_rad"),
        yaw_rate=("/odom/twist/twist/angular/z", "enu_rad/s"), surge=("/odom/twist/twist/linear/x", "m/s"))),
    "numbers": Shape(numbers, pair("left_thruster.field.data", "right_thruster.field.data", zero=0, span=30)
        | of(heading=("heading.field.data", "deg"), yaw_rate=None, surge=("speed.field.data", "m/s"))),
    "px4": Shape(px4, pair("log_actuator_motors_0.control[0]", "log_actuator_motors_0.control[1]", zero=0, span=1)
        | of(heading=("log_vehicle_attitude_0.q", "rad"), yaw_rate=None,
        velocity_north=("log_vehicle_local_position_0.vx", "m/s"),
        velocity_east=("log_vehicle_local_position_0.vy", "m/s"))),
    "ferry": Shape(ferry,
        {"command_left": [{"name": ["wrench.tau_x", "wrench.tau_n"], "unit": ["N", "N·m"], "weight": [1.0, 1.0]}],
        "command_right": [{"name": ["wrench.tau_x", "wrench.tau_n"], "unit": ["N", "N·m"], "weight": [1.0, -1.0]}]}
        | of(heading=("odometry.pose.pose.orientation", "enu_rad"),
        yaw_rate=("odometry.twist.twist.angular.z", "enu_rad/s"), surge=("odometry.twist.twist.linear.x", "m/s"))),
}  # fmt: skip
