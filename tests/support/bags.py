"""Bags of ROS 1, whole and without their index, and of ROS 2."""

import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from usvlearn.logs.channels.channel import Source

NS = 10**9
START = 1_700_000_000 * NS
STEPS = 40
SOURCES = {
    "command_left": Source("*left_thruster", span=36.5),
    "command_right": Source("usv/right_thruster"),
    "heading": Source("*right_thruster", unit="deg"),
    "surge": Source("*velocity", field="x, y"),
}


def write_bag(path: Path, compression: str = "none") -> Path:
    """A bag of several chunks; per step four messages received at once, some steps received out of order."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    number, text, vector = (
        store.types[name] for name in ("std_msgs/msg/Float64", "std_msgs/msg/String", "geometry_msgs/msg/Vector3")
    )
    bag, connections = Writer(path), {}
    bag.chunk_threshold = 1500
    if compression != "none":
        bag.set_compression(Writer.CompressionFormat[compression.upper()])
    with bag:
        for k in range(STEPS):
            messages = {
                "/rosout": text(data="talk" * (k % 5)),
                "/usv/right_thruster": number(data=float(k)),
                "/usv/velocity": vector(x=3.0 * k, y=4.0 * k, z=0.0),
                "/usv/left_thruster": number(data=-36.5 * k),
            }
            for topic, message in messages.items():
                if topic == "/usv/left_thruster" and k < STEPS // 4:
                    continue  # its connection begins in the middle of the file
                if topic not in connections:
                    connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=store)
                late = 150_000_000 if k % 7 == 3 else 0
                data = store.serialize_ros1(message, message.__msgtype__)
                bag.write(connections[topic], START + k * NS // 10 + late, data)
    return path


def unindexed(whole: bytes, index: int = 0) -> bytes:
    """The bag as it is before its index is written, or with a wrong place of its index."""
    place = whole.index(b"index_pos=") + len("index_pos=")
    return whole[:place] + struct.pack("<Q", index) + whole[place + 8 :]


def ros2_types() -> dict[str, Any]:
    """Name of a type without its package -> its class."""
    from rosbags.typesys import Stores, get_typestore

    return {name.rpartition("/")[2]: kind for name, kind in get_typestore(Stores.ROS2_HUMBLE).types.items()}


def write_ros2(folder: Path, posts: Iterable[tuple[int, str, Any]], plugin: str = "MCAP") -> Path:
    """A bag of (ns from `START` to the receipt, topic, message), and its file."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store, opened = get_typestore(Stores.ROS2_HUMBLE), dict[str, Any]()
    with Writer(folder, version=9, storage_plugin=StoragePlugin[plugin]) as bag:
        for received, topic, message in posts:
            kind = message.__msgtype__
            opened[topic] = opened.get(topic) or bag.add_connection(topic, kind, typestore=store)
            bag.write(opened[topic], START + received, store.serialize_cdr(message, kind))
    return next(folder.glob("*.[dm][bc]*"))
