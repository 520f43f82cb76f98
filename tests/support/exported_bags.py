"""A simulated voyage as bags of ROS 1 and ROS 2, with the topics of a Clearpath Heron and of plain numbers."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from tests.support.voyages import Voyage

NS = 10**9
START = 1_700_000_000 * NS
DRIVE = "std_msgs/Header header\nfloat32 left\nfloat32 right\n"


def heron(folder: Path, voyage: Voyage) -> Path:
    """A ROS 1 bag: `cmd_drive`, the orientation of `imu/data` from east, and velocities to the east and the north."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(DRIVE, "heron_msgs/msg/Drive"))
    types, path = store.types, folder / "heron.bag"
    vector, quaternion, header, when = (
        types[name]
        for name in ("geometry_msgs/msg/Vector3", "geometry_msgs/msg/Quaternion", "std_msgs/msg/Header",
                     "builtin_interfaces/msg/Time")
    )  # fmt: skip

    def head(t: float) -> Any:
        stamp = START + int(t * NS)
        return header(seq=0, stamp=when(sec=stamp // NS, nanosec=stamp % NS), frame_id="base")

    def imu(t: float, heading: float, yaw_rate: float) -> Any:
        yaw = math.pi / 2 - heading
        return types["sensor_msgs/msg/Imu"](
            header=head(t),
            orientation=quaternion(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2)),
            orientation_covariance=np.zeros(9),
            angular_velocity=vector(x=0.01, y=0.02, z=-yaw_rate),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=vector(x=0.1, y=0.0, z=9.8),
            linear_acceleration_covariance=np.zeros(9),
        )

    def velocity(t: float, speed: float, heading: float) -> Any:
        twist = types["geometry_msgs/msg/Twist"](
            linear=vector(x=speed * math.sin(heading), y=speed * math.cos(heading), z=0.0),
            angular=vector(x=0.0, y=0.0, z=0.0),
        )
        return types["geometry_msgs/msg/TwistStamped"](header=head(t), twist=twist)

    def fix(t: float, latitude: float, longitude: float) -> Any:
        status = types["sensor_msgs/msg/NavSatStatus"](status=0, service=1)
        return types["sensor_msgs/msg/NavSatFix"](
            header=head(t),
            status=status,
            latitude=latitude,
            longitude=longitude,
            altitude=100.0,
            position_covariance=np.zeros(9),
            position_covariance_type=0,
        )

    def drive(t: float, left: float, right: float) -> Any:
        return types["heron_msgs/msg/Drive"](header=head(t), left=left, right=right)

    topics: dict[str, tuple[Callable[..., Any], float, tuple[str, str]]] = {
        "/cmd_drive": (drive, 10.0, ("command_left", "command_right")),
        "/imu/data": (imu, 20.0, ("heading", "yaw_rate")),
        "/navsat/vel": (velocity, 5.0, ("surge", "heading")),
        "/navsat/fix": (fix, 5.0, ("latitude", "longitude")),
    }
    with Writer(path) as bag:
        messages = []
        for topic, (make, hz, names) in topics.items():
            stamps = np.arange(0.5, voyage.surge[0].max() - 0.5, 1 / hz)
            values = [voyage.at(name, stamps).tolist() for name in names]
            messages += [(t, topic, make, each) for t, *each in zip(stamps.tolist(), *values, strict=True)]
        connections: dict[str, Any] = {}
        for t, topic, make, each in sorted(messages, key=lambda message: message[0]):
            message = make(t, *each)
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=store)
            data = store.serialize_ros1(message, message.__msgtype__)
            bag.write(connections[topic], START + int(t * NS), data)
    return path


def numbers(folder: Path, voyage: Voyage) -> Path:
    """A ROS 2 folder of plain numbers: thrusts in newtons, odometry in the body's frame."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    types, path = store.types, folder / "ros2"
    number, vector = types["std_msgs/msg/Float64"], types["geometry_msgs/msg/Vector3"]
    pose = types["geometry_msgs/msg/Pose2D"]
    time = np.arange(0.5, voyage.surge[0].max() - 0.5, 0.1)
    value = {name: voyage.at(name, time) for name in Voyage._fields}
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as bag:
        connections: dict[str, Any] = {}
        for k, t in enumerate(time):
            messages = {
                "/boat/left_thruster": number(data=36.5 * value["command_left"][k]),
                "/boat/right_thruster": number(data=36.5 * value["command_right"][k]),
                "/boat/local_vel": vector(x=value["surge"][k], y=0.0, z=value["yaw_rate"][k]),
                "/boat/desired_speed": number(data=round(value["surge"][k])),
            }
            messages["/boat/ned_pose"] = pose(x=value["north"][k], y=value["east"][k], theta=value["heading"][k])
            for topic, message in messages.items():
                if topic not in connections:
                    connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=store)
                data = store.serialize_cdr(message, message.__msgtype__)
                bag.write(connections[topic], START + int(t * NS), data)
    return path
