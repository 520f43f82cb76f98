"""Messages with and without a header are in one time, also where a simulator runs at another rate than the recorder."""

import struct
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

from tests.support.bags import NS, START, ros2_types, write_ros2
from usvlearn.logs.channels.channel import Source
from usvlearn.logs.formats.ros.message_fields import CLOCK, Heard, find_clock
from usvlearn.logs.formats.ros.rosbag import Rosbag

DEFINED = {"Stamped": ("", (("header", None),)), "Number": ("", (("data", None),))}
BAG = SimpleNamespace(is2=True, typestore=SimpleNamespace(fielddefs=DEFINED))
WALL = np.arange(0.0, 60.0, 0.1)  # s of receipt
SIMULATED = 100.0, 0.5


def heard(topic: str, stamps, kind: str = "Stamped", bag=BAG) -> Heard:
    """A topic whose messages were received at `WALL`; `stamps` in s, NaN for none; or (first, rate)."""
    messages = Heard(bag, topic, kind)
    stamps = stamps[0] + stamps[1] * WALL if isinstance(stamps, tuple) else stamps
    for k, (wall, stamp) in enumerate(zip(WALL, np.broadcast_to(stamps, WALL.shape), strict=True)):
        ns = 0 if np.isnan(stamp) else int(stamp * 1e9)
        data = struct.pack("<II", ns // NS, ns % NS)
        messages.add(k, START + int(wall * 1e9), data if kind == CLOCK and not bag.is2 else b"\0\1\0\0" + data)
    return messages


WALL_CLOCK = START / 1e9, 1.0
CASES = {  # topics -> rate and topic of the clock that is found; 1 without a word, -1 with one
    "clock": ({"/clock": SIMULATED, "/x": SIMULATED, "/wall": WALL_CLOCK, "/wall2": WALL_CLOCK}, 0.5, "/clock"),
    "no_clock": ({"/x": SIMULATED, "/cmd": np.nan}, 0.5, "/x"),
    "slow": ({"/x": (7.0, 0.3), "/y": (7.1, 0.3), "/wall": WALL_CLOCK}, 0.3, "/x"),
    "fast": ({"/x": (0.5, 12.0)}, 12, "/x"),
    "from_the_wall_time": ({"/x": (START / 1e9, 0.5)}, 0.5, "/x"),
    "clock_of_the_same_rate": ({"/clock": (5.0, 1.0), "/x": (5.0, 1.0)}, 1, "/clock"),
    "wall": ({"/x": WALL_CLOCK, "/clock": WALL_CLOCK, "/cmd": np.nan}, 1, ""),
    "zeros": ({"/x": 0.0, "/cmd": np.nan}, 1, ""),
    "boot_time": ({"/imu": (33.3, 1.0001), "/cmd": np.nan}, 1, ""),
    "odd_sensor": ({"/imu": (33.3, 0.9), "/gps": WALL_CLOCK}, -1, "/imu"),
    "counter": ({"/x": np.arange(1.0, 1 + len(WALL))}, 1, ""),
    "frozen": ({"/x": 17.5}, 1, ""),
    "random": ({"/x": np.random.default_rng(0).uniform(1, 1e6, len(WALL))}, 1, ""),
    "none": ({}, 1, ""),
}


@pytest.mark.parametrize("name", CASES)
def test_the_clock_of_most_topics_is_found(name):
    topics, rate, topic = CASES[name]
    clock, sentence = find_clock(
        heard(key, stamps, CLOCK if key == "/clock" else "Stamped") for key, stamps in topics.items()
    )
    assert (clock is not None) == (rate > 0 and bool(topic)) and bool(sentence) == bool(topic) and topic in sentence
    if clock:
        assert clock.rate == pytest.approx(rate) and clock.heard.topic == topic and f"advance by {rate:g} s" in sentence
        assert "data.reader.clock=receive" in sentence
        assert heard("/cmd", np.nan).seconds(START, clock, False) == pytest.approx(rate * WALL, abs=1e-6)


def test_a_rate_that_changes_pauses_and_a_restart_are_followed():
    rate = np.where(WALL < 20, 0.5, np.where(WALL < 30, 0.0, 1.5))
    stamps = 50 + np.append(0, np.cumsum(rate * 0.1)[:-1])
    clock, _ = find_clock([heard("/clock", stamps, CLOCK)])
    for each in (heard("/cmd", np.nan), heard("/x", stamps), heard("/odd", np.where(WALL < 9, 0.0, WALL + 9000))):
        np.testing.assert_allclose(each.seconds(START, clock, False), stamps - 50, atol=1e-6)
    again = np.where(WALL < 30, 0.5 * WALL, 0.5 * (WALL - 30)) + 0.01
    clock, _ = find_clock([heard("/clock", again, CLOCK)])
    np.testing.assert_allclose(heard("/cmd", np.nan).seconds(START, clock, False), again - 0.01, atol=1e-6)


def test_stamps_of_ros_1_and_of_another_byte_order():
    old = SimpleNamespace(is2=False, typestore=BAG.typestore)
    assert find_clock([heard("/clock", SIMULATED, CLOCK, old)])[0].rate == pytest.approx(0.5)
    large = Heard(BAG, "/x", "Stamped")
    large.add(0, START, b"\0\0\0\0" + struct.pack(">II", 7, 5))
    large.add(1, START, b"\0\1")  # too short to have a stamp
    assert [each.tolist() for each in large.times()] == [[START, START], [7 * NS + 5, 0]]


@pytest.mark.parametrize(("plugin", "with_clock"), [("MCAP", True), ("SQLITE3", False)])
def test_a_bag_of_a_slow_simulation_is_in_its_time(tmp_path, plugin, with_clock):
    types = ros2_types()
    zero = types["Vector3"](x=0.0, y=0.0, z=0.0)

    def messages(k: int):
        stamp = types["Time"](sec=100 + k // 10, nanosec=k % 10 * NS // 10)
        if with_clock:
            yield "/clock", 0, types["Clock"](clock=stamp)
        yield "/thrust", 1, types["Float64"](data=0.1 * k)
        twist = types["Twist"](linear=types["Vector3"](x=0.2 * k, y=0.0, z=0.0), angular=zero)
        yield "/twist", 2, types["TwistStamped"](header=types["Header"](stamp=stamp, frame_id=""), twist=twist)

    posts = ((k * NS // 5 + late * 10**6, topic, message) for k in range(40) for topic, late, message in messages(k))
    write_ros2(tmp_path / "run", posts, plugin)
    sources = {"command_left": Source("thrust"), "surge": Source("twist")}
    with pytest.warns(
        UserWarning, match=r"advance by 0\.5 s in each second of receipt, as simulated time does"
    ) as caught:
        channels, _ = Rosbag().read(tmp_path / "run", sources)
        alone, _ = Rosbag().read(tmp_path / "run", {"surge": sources["command_left"]})  # another topic tells the time
    for each in (channels["command_left"], channels["surge"], alone["surge"]):
        np.testing.assert_allclose(each.time, 0.1 * np.arange(40), atol=2e-3)
    with warnings.catch_warnings(action="ignore"):
        series = {each.name: each.time for each in Rosbag().survey(tmp_path / "run")}
    np.testing.assert_array_equal(series["/thrust"], channels["command_left"].time)
    assert ("/clock" if with_clock else "/twist") in str(caught[0].message)
    channels, _ = Rosbag(clock="receive").read(tmp_path / "run", sources)
    np.testing.assert_allclose(channels["surge"].time, 0.2 * np.arange(40), atol=3e-3)
