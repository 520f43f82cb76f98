"""Several logged signals make one command, and a mix is as good as the signal that it replaces."""

import numpy as np
import pytest

from tests.support.files import refused, write
from usvlearn.errors import ConfigError
from usvlearn.logs.alignment.mixing import Mix, mix, sides_of
from usvlearn.logs.channels.channel import Channel
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.read import read_recordings

REST = {"heading": {"name": "psi", "unit": "deg"}, "surge": {"name": "v"}}


def read(tmp_path, header: str, left: dict, right: dict):
    rows = "".join(f"{0.1 * k:.1f},{k % 7},{k % 5},{k % 3},10,1\n" for k in range(40))
    path = write(tmp_path / "a.csv", f"{header}\n{rows}")
    (recording,) = read_recordings(path, Table("t"), {"command_left": left, "command_right": right, **REST})
    return recording


def test_groups_of_thrusters_are_means_of_their_shares(tmp_path):
    left = {"name": ["a", "b"], "zero": [3, 0], "span": [-4, 8]}
    recording = read(tmp_path, "t,a,b,c,psi,v", left, {"name": "c", "span": 3})
    k = np.arange(40)
    np.testing.assert_allclose(
        recording.channels["command_left"].value, ((k % 7 - 3) / -4 + (k % 5) / 8) / 2, atol=1e-15
    )
    np.testing.assert_array_equal(recording.channels["command_left"].time, recording.channels["command_right"].time)


def test_throttle_and_steering_are_mixed_and_limited(tmp_path):
    both = {"name": ["a", "b"], "span": [6, 4]}
    recording = read(tmp_path, "t,a,b,c,psi,v", {**both, "weight": [1, 1]}, {**both, "weight": [1, -1]})
    throttle, steering = np.arange(40) % 7 / 6, np.arange(40) % 5 / 4
    np.testing.assert_allclose(recording.channels["command_left"].value, np.minimum(throttle + steering, 1), atol=1e-15)
    np.testing.assert_allclose(recording.channels["command_right"].value, throttle - steering, atol=1e-15)


def test_one_thruster_with_a_rudder_stands_on_both_sides(tmp_path):
    one = {"name": "a", "span": 6}
    recording = read(tmp_path, "t,a,b,c,psi,v", one, one)
    left, right = (recording.channels[f"command_{side}"] for side in ("left", "right"))
    np.testing.assert_array_equal(left.value, right.value)


def test_nonsense_is_not_limited_so_that_it_is_rejected():
    time, order = np.arange(3.0), np.arange(3)
    parts = [Channel(time, np.array([0.9, 1500.0, -0.9]), order), Channel(time, np.array([0.4, 0.0, -0.4]), order)]
    channel, dropped = mix(parts, [1.0, 1.0])
    np.testing.assert_array_equal(channel.value, [1.0, 1500.0, -1.0])
    assert dropped == 0


@pytest.mark.parametrize(("held", "kept"), [(False, 3), (True, 5)])
def test_a_part_that_is_too_old_drops_the_sum_unless_it_is_held(held, kept):
    often = Channel(np.arange(5) / 10, np.ones(5), 2 * np.arange(5), held)
    once = Channel(np.zeros(1), np.zeros(1), np.array([0]), held)
    channel, dropped = mix([often, once], [0.5, 0.5])
    assert (len(channel.value), dropped) == (kept, 5 - kept)  # the window is 0.2 s


@pytest.mark.parametrize(
    ("left", "words"),
    [
        ({"name": ["a", "b"], "zero": [0]}, "data.channels.command_left.zero: found 1 values, expected one for each"),
        ({"name": ["a", "b"], "span": [1, 0]}, "data.channels.command_left.span: found 0, expected a number other"),
        ({"name": ["a", "b"], "span": [1, "x"]}, "data.channels.command_left.span: found 'x', expected a number"),
        ({"name": ["a", "b"], "weight": 0.5}, "data.channels.command_left.weight: found 0.5, expected a list of 2"),
        ({"name": ["a", "b"], "weight": [1, "x"]}, "data.channels.command_left.weight: found 'x', expected a number"),
        ({"name": "a", "weight": [1]}, "data.channels.command_left.weight: found [1], expected none"),
        ({"name": "a", "zero": [0]}, "data.channels.command_left.zero: found [0], expected a number"),
        ({"name": ["a", "nothing"]}, "data.channels.command_left[1].name: no channel 'nothing'"),
    ],
)
def test_a_bad_mix_is_told(tmp_path, left, words):
    message = refused(Exception, read, tmp_path, "t,a,b,c,psi,v", left, {"name": "c"})
    assert words in message, message


def test_only_commands_are_mixed(tmp_path):
    path = write(tmp_path / "a.csv", "t,a,b\n0,1,1\n")
    channels = {name: {"name": "a"} for name in ("command_left", "command_right", "heading")}
    message = refused(ConfigError, read_recordings, path, Table("t"), {**channels, "surge": {"name": ["a", "b"]}})
    assert message.startswith("data.channels.surge.name: found a list, expected one name")


def test_a_mix_of_sources_is_a_channel_in_python_too(tmp_path):
    given = Mix.of({"name": ["a", "b"], "span": [6, 4]})
    recording = read(tmp_path, "t,a,b,c,psi,v", given, {"name": "c"})
    assert recording.channels["command_left"].value.max() <= 1


def test_throttle_and_steering_are_both_sides():
    both = {"name": ["T", "S"], "span": [1.0, -1.0]}
    assert sides_of({"name": "T"}, {"name": "S", "span": -1.0})["command_right"] == {**both, "weight": [1.0, -1.0]}
    assert sides_of({"name": "T", "unit": "percent"})["command_right"] == {"name": "T", "unit": "percent"}
