"""Sensors that stand still are found by how often their values repeat otherwise, and nothing is learned from them."""

import math
import time

import numpy as np
import pytest

from tests.support.live import boat, messages, ready
from usvlearn.live.frozen_sensors import FrozenSensors
from usvlearn.live.message_buffer import ABOARD
from usvlearn.logs.channels.channel import COMMANDS, Source
from usvlearn.logs.checks import delivery

SOURCES = {
    "command_left": Source("L", span=100.0),
    "command_right": Source("L", span=100.0),
    "surge": Source("V"),
    "heading": Source("H"),
}


def found(values, command=lambda k: 50.0, rate=10.0):
    """The time at which the speed is first left out, s, and the time from which it is used again; `values` by time."""
    watch, out = FrozenSensors(SOURCES), []
    for k, value in enumerate(values):
        for side in COMMANDS:
            watch.take(side, k / rate, command(k / rate))
        out.append(watch.take("surge", k / rate, value))
    times = np.flatnonzero(out) / rate
    return (times[0], times[-1], watch) if len(times) else (math.nan, math.nan, watch)


def speeds(seconds, scale, rate=10.0, noise=0.05, frozen=math.inf, thaw=math.inf):
    """A wandering speed in steps of a scale; from a time on it stands still."""
    rng, speed, last = np.random.default_rng(1), 1.0, 1.0
    for k in range(round(seconds * rate)):
        speed += noise * rng.normal()
        last = last if frozen <= k / rate < thaw else round(speed / scale) * scale
        yield last


@pytest.mark.parametrize("scale", [1e-9, 0.05, 0.5])
def test_a_sensor_that_stands_still_is_found_within_a_minute_and_used_again(scale):
    begin, end, watch = found(speeds(300, scale, frozen=100, thaw=200), lambda t: 50.0 + 30.0 * (t % 20 > 10))
    assert 110 < begin < 160 and 199 < end <= 200 and watch.warnings["surge"] == ""


@pytest.mark.parametrize("scale", [1e-9, 0.05, 0.5])
def test_a_healthy_sensor_is_never_left_out(scale):
    for command in (lambda t: 50.0, lambda t: 50.0 + 30.0 * (t % 20 > 10), lambda t: 80.0 * (t % 100 > 50)):
        assert math.isnan(found(speeds(1000, scale), command)[0])


def test_a_sensor_with_noise_is_found_under_steady_commands():
    begin, end, _ = found(speeds(300, 1e-9, frozen=100, thaw=200))
    assert 110 < begin < 115 and 199 < end <= 200


def test_a_boat_at_rest_and_one_that_keeps_its_speed_in_a_simulator_are_healthy():
    assert math.isnan(found([0.0] * 3000, lambda t: 0.0)[0])
    legs = [round(1.2 * (1 - math.exp(-(k % 600) / 20)), 4) for k in range(6000)]  # noiseless: it repeats for 40 s
    assert math.isnan(found(legs, lambda t: 50.0 + 30.0 * (t % 120 >= 60))[0])


def test_a_warning_names_the_sensor_and_ends_when_it_is_over():
    *_, watch = found(speeds(130, 1e-9, frozen=100), lambda t: 50.0 + 30.0 * (t % 20 > 10))
    assert watch.warnings == {
        "surge": "surge (V) has stood still for 30 s under way: it is left out until it changes: check its sensor",
        "heading": "",
    }
    assert not watch.take("surge", 130.0, 0.123) and watch.warnings["surge"] == ""


def test_a_node_learns_nothing_from_a_frozen_sensor_and_names_it(tmp_path, start):
    with ready(tmp_path, start) as session:
        last, rows, learned, begin = {}, [], [], time.monotonic()
        for name, stamp, value in messages(boat(0.05), 0.0):
            if stamp > 60 and name in ("surge", "heading"):
                value = last[name]
            last[name] = value
            session.push(name, 1.7e9 + stamp, value)
            if stamp >= len(rows) + 1:
                clock = begin + len(rows)
                session._listening.heard = dict.fromkeys(session._listening.heard, clock)
                health = session.tick(clock=clock)
                rows.append((stamp, health.state, health.sentence, health.warnings))
                learned.append(session._node.learned)
    late = next(row for row in rows if "stood still" in str(row[3]))
    assert late[0] < 120 and {state for at, state, *_ in rows if 5 < at < 60} == {"ok"}
    assert rows[-1][1] == "stale" and "no message can be used of heading (frozen), surge (frozen)" in rows[-1][2]
    assert learned[-1] == learned[round(late[0])]


def test_what_helps_ashore_is_said_otherwise_aboard():
    assert delivery.SORT in ABOARD and not any("row" in aboard or "log" in aboard for aboard in ABOARD.values())
