"""The core of the node: what it publishes of each step."""

import io
import math
from itertools import pairwise

import numpy as np
import pytest

from tests.support.live import boat, learned_set, messages
from usvlearn import checkpoint
from usvlearn.errors import ConfigError
from usvlearn.live.health import COMPILING
from usvlearn.live.node import Node
from usvlearn.live.operator_page import WIDTH, page
from usvlearn.live.posts import KINDS, TABLE, of_health, of_step, told
from usvlearn.live.status_line import StatusLine
from usvlearn.logs.align import Aligner
from usvlearn.logs.channel import REQUIRED, Source
from usvlearn.logs.derived_surge import COURSES, VELOCITIES
from usvlearn.logs.setup import Setup
from usvlearn.online import Online
from usvlearn.simulate.fault import Fault
from usvlearn.simulate.fleet import fleet


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    return learned_set(tmp_path_factory.mktemp("start"))


def node(start, channels=None, **options) -> Node:
    setup = Setup.of(checkpoint.load(start)[1]["setup"])
    if channels is not None:
        setup = Setup(channels, setup.align)
    return Node(setup, Online.open(start), **options)


def test_the_next_prediction_is_that_of_the_next_step_where_the_commands_stay(start):
    """With all inputs constant, what is predicted of the next step is what is then predicted of it."""
    one, steps = node(start), []
    for k in range(300):
        values = {"command_left": 0.5, "command_right": 0.5, "heading": 1.0, "surge": 1.0 + 0.02 * (k % 5)}
        for name, value in values.items():
            steps += one.push(name, 5.0 + 0.1 * k, value)
    for before, after in pairwise(steps[20:]):
        assert before.next == pytest.approx(after.speed, abs=1e-12)
        assert (before.next_low, before.next_high) == pytest.approx((after.low, after.high), abs=1e-12)


def test_the_intervals_of_a_simulated_boat_hold(start):
    """90 % intervals of this speed, and of that in 2 s where the commands stay, contain most speeds of a mission."""
    one, log = node(start), boat(1.0, seed=3)
    steps = [step for message in messages(log, 0.0) for step in one.push(*message)]
    seen = [step for step in steps if math.isfinite(step.measured) and math.isfinite(step.low)]
    assert 0.85 < np.mean([step.low <= step.measured <= step.high for step in seen]) < 0.95
    assert one.horizons == (0.4, 1.2, 2.0, 5.2, 10.0, 30.0)
    speed, inside = {round(step.time, 1): step.measured for step in steps}, []
    for step in steps[500:]:
        later = speed.get(round(step.time + 2.0, 1), math.nan)
        if step.forecasts and math.isfinite(later) and stays(log, step.time - 0.2, step.time + 2.0):
            _, low, high = step.forecasts[2.0]
            inside.append(low <= later <= high)
    assert len(inside) > 1000 and 0.85 < np.mean(inside) < 0.97


def stays(log, begin: float, end: float) -> bool:
    """Whether the commands of both sides stay as they are."""
    both = (log.channels[name] for name in ("command_left", "command_right"))
    parts = [each.value[(each.time >= begin) & (each.time <= end)] for each in both]
    return all(len(part) > 0 and np.ptp(part) < 0.05 for part in parts)


def test_a_lost_thruster_is_told_once(start):
    fault = Fault(side="left", share=0.4, minute=10.0)
    log = fleet(
        n=1, hours=25 / 60, mission_minutes=25.0, missions=["lawn_mower"], aborted_share=0.0, paused_share=0.0,
        fault=fault,
    )[0]  # fmt: skip
    one = node(start)
    steps = [step for message in messages(log, 0.0) for step in one.push(*message)]
    told = [(step.time, alarm) for step in steps for alarm in step.alarms]
    assert [alarm.split(" seems")[0] for _, alarm in told] == ["the left thruster"]
    assert 600.0 < told[0][0] < 700.0 and one.alarms == 1 and one.alarm == "left"


def test_commands_of_two_sources_and_velocities_make_the_same_steps(start):
    """Two thrusters a side that run alike, and velocities in place of the speed."""
    recording = boat(0.05)
    plain = node(start)
    expected = [step for message in messages(recording) for step in plain.push(*message)]
    mixed = Setup.of(
        {
            "channels": {
                "command_left": {"name": ["a", "b"], "held": False, "window": 0.5},
                "command_right": {"name": "r", "window": 0.5},
                "heading": {"name": "psi", "window": 0.25},
                "velocity_north": {"name": "vn", "window": 0.3},
                "velocity_east": {"name": "ve", "window": 0.3},
            },
            "align": plain.setup.align,
        }
    )
    one, heading, found = Node(mixed, Online.open(start)), None, []
    for part, stamp, value in messages(recording):
        if part == "command_left":
            found += one.push("command_left[0]", stamp, value) + one.push("command_left[1]", stamp, value)
        elif part == "surge":
            if heading is not None:
                found += one.push("velocity_north", stamp, value * math.cos(heading))
                found += one.push("velocity_east", stamp, value * math.sin(heading))
        else:
            heading = value if part == "heading" else heading
            found += one.push(part, stamp, value)
    assert len(found) >= len(expected) - 3
    speeds = {round(step.time, 3): step.speed for step in expected}
    pairs = [(step.speed, speeds[round(step.time, 3)]) for step in found if round(step.time, 3) in speeds]
    assert len(pairs) > 0.9 * len(expected)
    np.testing.assert_allclose(*np.array(pairs[50:]).T, atol=0.02)


def test_the_surge_is_computed_from_ground_speed_and_course(start):
    channels = {name: Source(name) for name in ("command_left", "command_right", "heading", *COURSES)}
    one = node(start, channels)
    one.push("heading", 10.0, 0.5)
    one.push(COURSES[0], 10.1, 2.0)
    one.push(COURSES[1], 10.1, 0.5 + math.pi / 3)
    assert one.derived == pytest.approx(1.0)
    one.push(VELOCITIES[0] if VELOCITIES[0] in channels else "heading", 10.2, 0.5)
    assert one.derived is None


def test_a_part_that_is_not_known_is_refused(start):
    with pytest.raises(ConfigError, match="part: found 'speed', expected one of command_left"):
        node(start).push("speed", 1.0, 1.0)


def test_what_lies_ahead_is_what_the_next_steps_see():
    """Commands stay in force, a command that was posted takes effect after its delay, the heading turns on."""
    side = {"held": True, "delay": 0.5}
    sources = {name: Source(name, **(side if name.startswith("command") else {})) for name in REQUIRED}
    aligner, samples = Aligner(sources, dt=0.4), []
    for k in range(41):
        left = 0.2 if k < 38 else 0.8
        for name, value in {"command_left": left, "command_right": 0.3, "heading": 0.05 * k, "surge": 1.0}.items():
            samples += aligner.push(name, 0.1 * k, value)
    ahead = aligner.ahead(3)
    after = samples[-1][0]  # 3.6; the left command of 0.8 takes effect at 3.8 + 0.5
    expected = [0.2, 0.2 + 0.6 * (after + 0.8 - 4.3) / 0.4, 0.8]
    np.testing.assert_allclose(ahead.command_left, expected, atol=1e-9)
    np.testing.assert_allclose(ahead.command_right, 0.3)
    np.testing.assert_allclose(ahead.yaw_rate, 0.5, rtol=1e-6)
    np.testing.assert_allclose(np.diff(ahead.heading), 0.2, rtol=1e-6)
    aligner.push("surge", 9.0, 1.0)
    assert np.isnan(aligner.ahead(1).heading[0]), "the last heading is too old"


def test_posts_are_those_of_the_table(start):
    one = node(start)
    steps = [step for message in messages(boat(0.02)) for step in one.push(*message)]
    network = {"contracting": True, "condition": "tight", "rate": 0.9, "time_constant": None, "equilibrium": 0.1}
    found = {"drag_linear": (-1.0, -2.0, 0.0, "kg/s")}
    health = COMPILING._replace(state="ok", identified=found, contraction={"rnn": network})
    posts = of_step(steps[-1]._replace(alarms=("left",)), members=True) + of_health(health)
    assert {post.name for post in posts} == set(KINDS)
    assert all((KINDS[post.name] == "D") == isinstance(post.value, float) for post in posts)
    assert all(len(each.short) <= 10 for each in TABLE)
    first = of_step(steps[0])
    assert not any(isinstance(post.value, float) and not math.isfinite(post.value) for post in first)
    assert "state=ok" in told(health)
    lines = page(health._replace(warnings=("ü" * 200,), sentence="x " * 100), steps[-1])
    assert all(len(line) <= WIDTH and line.isascii() for line in lines)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_the_line_in_a_terminal_is_replaced_and_a_file_has_only_changes(start):
    one = node(start)
    steps = [step for message in messages(boat(0.02)) for step in one.push(*message)]
    health = COMPILING._replace(state="ok", sentence="ok; 12 steps", steps=12, counts={"surge": {"stale": 2}})
    terminal, file = Terminal(), io.StringIO()
    for stream in (terminal, file):
        line = StatusLine("node", stream)
        for _ in range(3):
            line.show(health, steps[-1])
        line.say("an alarm\x1b[2J")
        line.show(health._replace(state="stale", sentence="no surge (V) for 3 s; 12 steps"), None, "no link")
        line.show(health._replace(state="stale", sentence="no surge (V) for 4 s; 12 steps"), None, "no link")
        line.close()
    assert file.getvalue().splitlines() == ["node: ok", r"node: an alarm\x1b[2J", "node: no surge (V); no link"]
    assert terminal.getvalue().count("\r") >= 6 and "predicted" in terminal.getvalue()
    assert terminal.getvalue().endswith("not saved yet\n")
