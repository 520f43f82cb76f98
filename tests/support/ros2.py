"""A node of a real rclpy; messages like those of rclpy, where it is missing; and a session that notes its calls."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from usvlearn.live.ros2.messages import message_class

ZERO = {"bool": False, "string": "", "byte": b"\x00", "float32": 0.0, "float64": 0.0}


def rclpy_class(kind: str) -> type:
    """A class of messages as rclpy has it: default values, checked types, and a method that lists the fields."""
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import Stores, get_typestore

    definitions = dict(get_typestore(Stores.ROS2_JAZZY).fielddefs[kind][1])

    def zero(description: Any) -> Any:
        node, inner = description
        if node == Nodetype.BASE:
            return ZERO.get(inner[0], 0)
        if node == Nodetype.NAME:
            return rclpy_class(inner)()
        element, length = inner
        if element[0] == Nodetype.BASE and element[1][0].startswith("float"):
            return np.zeros(length) if node == Nodetype.ARRAY else []
        return [zero(element) for _ in range(length)] if node == Nodetype.ARRAY else []

    class Message:
        def __init__(self, **values: Any):
            unknown = values.keys() - definitions.keys()
            assert not unknown, unknown
            for name, description in definitions.items():
                object.__setattr__(self, name, zero(description))
            for name, value in values.items():
                setattr(self, name, value)

        def __setattr__(self, name: str, value: Any) -> None:
            assert name in definitions, name
            node, inner = definitions[name]
            if node == Nodetype.BASE:  # rclpy refuses an int for a float, and text for bytes
                expected = type(ZERO.get(inner[0], 0))
                assert isinstance(value, expected), (name, value)
            object.__setattr__(self, name, value)

        @classmethod
        def get_fields_and_field_types(cls) -> dict[str, str]:
            return {name: str(description) for name, description in definitions.items()}

    Message.__name__ = kind.rpartition("/")[2]
    return Message


def like_rclpy(message: Any) -> Any:
    """A message of rosbags as rclpy would have given it."""
    copied = rclpy_class(message.__msgtype__)()
    for name in copied.get_fields_and_field_types():
        value = getattr(message, name)
        object.__setattr__(copied, name, like_rclpy(value) if hasattr(value, "__msgtype__") else value)
    return copied


class Peer:
    """A node in a context of its own, as if in another process: DDS lets a topic have one type in each context."""

    def __init__(self, name: str, parameters: Sequence[str] = ()):
        self.context = importlib.import_module("rclpy.context").Context()
        rclpy: Any = importlib.import_module("rclpy")
        rclpy.init(args=["--ros-args", *(word for each in parameters for word in ("-p", each))], context=self.context)
        self.node = rclpy.create_node(name, context=self.context, automatically_declare_parameters_from_overrides=True)
        self.executor = importlib.import_module("rclpy.executors").SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)

    def message(self, kind: str, **values: Any) -> Any:
        return message_class(kind)(**values)

    def publisher(self, topic: str, kind: str, qos: Any = 10) -> Any:
        return self.node.create_publisher(message_class(kind), topic, qos)

    def listen(self, topic: str, kind: str, qos: Any = 10) -> list[Any]:
        """The messages of a topic, as they come."""
        heard: list[Any] = []
        self.node.create_subscription(message_class(kind), topic, heard.append, qos)
        return heard

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()
