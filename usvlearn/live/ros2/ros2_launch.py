"""Starts the node: `ros2 launch $(usvlearn live ros2 --launch-file) folder:=/home/boat/usvlearn params:=boat.yaml`.

Also for an own launch file: IncludeLaunchDescription(PythonLaunchDescriptionSource(PATH), launch_arguments={...}).
"""

from __future__ import annotations

import importlib
from typing import Any

ARGUMENTS = {  # name -> default and meaning
    "folder": ("~/usvlearn", "folder of the node: checkpoints, status, records"),
    "params": ("", "file of parameters; `usvlearn live ros2 --example` prints one"),
    "namespace": ("", "namespace of the node; topics with * are looked for below it"),
    "name": ("usvlearn", "name of the node, with which its topics begin"),
    "use_sim_time": ("", "true: the clock is that of /clock; by default as the file of parameters says"),
    "command": ("usvlearn", "the command usvlearn, where it is not on the PATH"),
}


def generate_launch_description() -> Any:
    """What `ros2 launch` calls. The node is started again 5 s after it has failed."""
    actions, launch = (importlib.import_module(name) for name in ("launch.actions", "launch"))
    given = importlib.import_module("launch.substitutions").LaunchConfiguration
    declared = [
        actions.DeclareLaunchArgument(name, default_value=default, description=meaning)
        for name, (default, meaning) in ARGUMENTS.items()
    ]
    return launch.LaunchDescription([*declared, actions.OpaqueFunction(function=_nodes, args=[given])])


def _nodes(context: Any, given: Any) -> list[Any]:
    value = {name: given(name).perform(context) for name in ARGUMENTS}
    parameters: list[Any] = [value["params"]] if value["params"] else []
    if value["use_sim_time"]:
        parameters.append({"use_sim_time": value["use_sim_time"].lower() == "true"})
    node = importlib.import_module("launch_ros.actions").Node(
        executable=value["command"],
        arguments=["live", "ros2", value["folder"]],
        name=value["name"],
        namespace=value["namespace"],
        parameters=parameters,
        output="screen",
        respawn=True,
        respawn_delay=5.0,
    )
    return [node]
