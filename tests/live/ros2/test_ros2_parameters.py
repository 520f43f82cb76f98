"""The parameters and the command of the ROS 2 node, and what it imports; no rclpy is needed."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.support import ROOT, over
from usvlearn.errors import ConfigError
from usvlearn.live.ros2 import ros2_launch, shell
from usvlearn.live.ros2.messages import DEFAULTS
from usvlearn.live.ros2.shell import OWN, given_by, with_parameters
from usvlearn.live.start import options_of
from usvlearn.logs.read import sources_of


def test_parameters_are_options_or_channels():
    given = given_by({
        "folder": "~/boat", "mass": 36, "record": True, "keep": 5, "clock": "receive", "use_sim_time": True,
        "start": "", "channels.command_left.name": ["/a", "/b"], "channels.command_left.span": [1.0, -1.0],
        "channels.surge.field": "twist.linear.x", "qos_overrides./a.publisher.depth": 4,
    })  # fmt: skip
    assert given.options == {"folder": Path("~/boat").expanduser(), "mass": 36, "record": True, "keep": 5}
    assert given.own == OWN | {"clock": "receive"}
    assert given.channels == {
        "command_left": {"name": ["/a", "/b"], "span": [1.0, -1.0]},
        "surge": {"field": "twist.linear.x"},
    }


@over(
    "wrong",
    [
        ({"masss": 3.0}, "parameter masss: found no such parameter: did you mean mass"),
        ({"mass": "heavy"}, "parameter mass: found 'heavy', expected a number"),
        ({"mass": True}, "parameter mass: found True, expected a number"),
        ({"keep": 5.0}, "parameter keep: found 5.0, expected a whole number"),
        ({"record": "yes"}, "parameter record: found 'yes', expected true or false"),
        ({"clock": "gps"}, "parameter clock: found 'gps', expected one of header, receive"),
        ({"channels.speed.name": "/v"}, "parameter channels.speed.name: found no such parameter"),
        ({"channels.surge.topic": "/v"}, "parameter channels.surge.topic: found no such parameter"),
        ({"channels.surge": "/v"}, "parameter channels.surge: found no such parameter"),
    ],
)
def test_a_wrong_parameter_is_told_in_one_sentence(wrong):
    parameters, sentence = wrong
    with pytest.raises(ConfigError, match=sentence) as caught:
        given_by(parameters)
    assert "\n" not in str(caught.value)


def test_the_example_of_parameters_is_legal_and_so_are_the_defaults():
    (node,) = yaml.safe_load(shell.EXAMPLE.read_text()).values()
    flat: dict = {}

    def flatten(values: dict, prefix: str = "") -> None:
        for name, value in values.items():
            if isinstance(value, dict):
                flatten(value, f"{prefix}{name}.")
            else:
                flat[prefix + name] = value

    flatten(node["ros__parameters"])
    given = given_by(flat)
    assert given.own == OWN and given.options["mass"] == 180.0  # it shows the defaults
    sources = sources_of({name: DEFAULTS[name] | each for name, each in given.channels.items()})
    assert sources.keys() == DEFAULTS.keys() == sources_of(DEFAULTS).keys()
    assert sources["heading"].unit == sources_of(DEFAULTS)["heading"].unit == "enu_rad"


def test_parameters_come_before_the_options_of_the_command_line():
    line = ["boat", "--mass", "28", "--keep", "7", "--channel", "surge=/v", "--channel", "surge.unit=knots"]
    options = options_of(shell.parser().parse_args(line))
    given = given_by({"mass": 36.0, "folder": "other", "channels.surge.name": "/odom", "channels.heading.unit": "rad"})
    merged = with_parameters(options, given)
    assert (merged.mass, merged.keep, merged.folder) == (36.0, 7, Path("other"))
    assert merged.channels == {"surge": {"name": "/odom", "unit": "knots"}, "heading": {"unit": "rad"}}


def test_the_command_prints_its_launch_file_and_its_example(capsys):
    assert shell.main(["--launch-file"]) == shell.main(["--example"]) == 0
    printed = capsys.readouterr().out
    assert printed == f"{shell.LAUNCH}\n{shell.EXAMPLE.read_text()}"


def test_without_rclpy_one_sentence_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(ConfigError, match=r"rclpy cannot be imported.*: source your ROS 2 in this shell"):
        shell.main(["boat", "--ros-args", "-p", "mass:=3.0"])


def test_the_launch_file_is_one_that_ros_2_finds_and_needs_no_usvlearn():
    """ROS loads it with its own Python, which may not have usvlearn."""
    assert shell.LAUNCH == Path(ros2_launch.__file__) and shell.LAUNCH.name.endswith("launch.py")
    imported = [node for node in ast.walk(ast.parse(shell.LAUNCH.read_text())) if isinstance(node, ast.ImportFrom)]
    assert not any((node.module or "").startswith("usvlearn") for node in imported)


def test_nothing_of_ros_torch_or_numba_is_imported_before_it_is_used():
    code = (
        "import sys, usvlearn.live.ros2.shell, usvlearn.live.ros2.ros2_launch\n"
        "print(*sorted({'rclpy', 'torch', 'numba', 'launch', 'yaml', 'hydra', 'rosbags'} & sys.modules.keys()))"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split() == []
