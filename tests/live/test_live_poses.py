"""Poses from messages that come one by one are those of the whole log, bit for bit."""

import math

import numpy as np
import pytest

from tests.support import few
from tests.support.live import turning
from usvlearn.live.live_poses import LivePoses
from usvlearn.logs.alignment.align import Aligner, align
from usvlearn.logs.channels.channel import AUTO, CHANNELS
from usvlearn.logs.channels.poses import poses


def both(channels, **options):
    """Of a log: live, and of the whole; `(steps, 5)` each."""
    rows = [
        (place, name, time, value)
        for name, channel in channels.items()
        for time, value, place in zip(*(x.tolist() for x in channel[:3]), strict=True)
    ]
    aligned = {name: channel for name, channel in channels.items() if name in CHANNELS}
    aligner, live = Aligner(aligned, dt=0.4, **options), LivePoses(channels)
    stepwise, came = [], []
    for place, name, time, value in sorted(rows, key=lambda row: row[0]):
        live.take(name, time, value)
        if name in CHANNELS:
            for at, sample in aligner.push(name, time, value):
                stepwise.append(live.at(at, sample))
                came.append(place)
    for at, sample in aligner.flush():
        stepwise.append(live.at(at, sample))
        came.append(math.inf)
    whole = align(aligned, dt=0.4, **options)
    np.testing.assert_array_equal(whole.came, came)
    return np.array(stepwise), poses(channels, whole.time, whole.samples, whole.came)


def delayed(channels, names, by, rng):
    """The messages of some channels come later than others that are stamped after them."""
    rows = [
        (place + (by if name in names and rng.random() < 0.3 else 0.0) + 1e-3 * rng.random(), name, k)
        for name, channel in channels.items()
        for k, place in enumerate(channel.order.tolist())
    ]
    order = {(name, k): place for place, (_, name, k) in enumerate(sorted(rows))}
    changed = {}
    for name, channel in channels.items():
        orders = np.array([order[name, k] for k in range(len(channel.order))])
        sort = np.argsort(orders)
        changed[name] = channel._replace(time=channel.time[sort], value=channel.value[sort], order=orders[sort])
    return changed


def changed(channels, names, change):
    return {name: change(channel) if name in names or not names else channel for name, channel in channels.items()}


LATE = ("heading", "yaw_rate", "latitude", "velocity_east")
CASES = {
    "as it is": lambda log, rng: log,
    "windows that follow": lambda log, rng: changed(log, (), lambda x: x._replace(window=AUTO)),
    "a little late": lambda log, rng: delayed(log, LATE, 5, rng),
    "later than the patience": lambda log, rng: delayed(log, LATE, 60, rng),
    "without gyro": lambda log, rng: {name: x for name, x in log.items() if name != "yaw_rate"},
    "without fixes": lambda log, rng: {name: x for name, x in log.items() if name != "latitude"},
    "a fix after a minute": lambda log, rng: changed(
        log, ("latitude", "longitude"), lambda x: x._replace(value=np.where(x.time < 60, 0.0, x.value))
    ),
    "no numbers": lambda log, rng: changed(
        log, (), lambda x: x._replace(value=np.where(rng.random(len(x.value)) < 0.2, np.nan, x.value))
    ),
    "stray stamps": lambda log, rng: changed(
        log, (), lambda x: x._replace(time=np.where(x.order % 997 == 0, x.time + 1e6, x.time))
    ),
    "a clock that is set back": lambda log, rng: changed(
        log, (), lambda x: x._replace(time=np.where(x.order > 8000, x.time - 100, x.time))
    ),
    "a clock that jumps": lambda log, rng: changed(
        log, (), lambda x: x._replace(time=np.where(x.order > 8000, x.time + 3600, x.time))
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("steps", few(["grid", "speed"], ["grid"], "thorough"))
def test_live_is_the_whole_log(name, steps):
    channels = CASES[name](turning().channels, np.random.default_rng(0))
    live, whole = both(channels, steps=steps)
    np.testing.assert_array_equal(live, whole)
    assert len(live) > 500 and np.isfinite(live).mean() > 0.85


@pytest.mark.thorough
def test_nothing_after_a_step_is_used():
    """The numbers of a step are the same, whatever comes after it."""
    channels = turning().channels
    live, _ = both(channels)
    cut = {name: each._replace(value=np.where(each.time > 100.0, 9.0, each.value)) for name, each in channels.items()}
    other, _ = both(cut)
    np.testing.assert_array_equal(live[:251], other[:251])
    assert not np.array_equal(live[251:300], other[251:300])
