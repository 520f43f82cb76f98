"""Automatic windows: they follow the rate of each channel, live as in a replay."""

import numpy as np
import pytest

from tests.support.recordings import channel, in_order
from usvlearn.errors import ConfigError
from usvlearn.logs.alignment.align import REQUIRED, Aligner, align
from usvlearn.logs.alignment.mixing import LiveMix, Mix, mix
from usvlearn.logs.alignment.window_kernel import windows_after
from usvlearn.logs.channels.channel import AUTO, CHANNELS, MOST_WINDOW, Source


def stamps(*stretches, jitter=0.0, lost=0.0, seed=0):
    """Times of messages: stretches of (seconds, Hz), one after the other; shifted by a share of their interval."""
    rng, parts, begin = np.random.default_rng(seed), [], 0.0
    for seconds, hz in stretches:
        regular = begin + np.arange(round(seconds * hz)) / hz
        moved = regular + rng.uniform(-jitter, jitter, len(regular)) / hz
        parts.append(moved[rng.random(len(regular)) >= lost])
        begin += seconds
    return np.concatenate(parts)


def boat(times, window=AUTO, **how):
    """A log whose channels have these times; speeds rise, the boat turns."""
    values = {"command_left": 0.5, "command_right": 0.4}
    return in_order({
        name: channel(time, values.get(name, 0.01 * time), window=window, **how) for name, time in times.items()
    })  # fmt: skip


def shares(log, **options):
    """Shares of steps that are fresh, and that are measured, over the measurements that are possible."""
    samples = align(log, **options).samples
    every = np.median(np.diff(log["surge"].time))
    return samples.fresh.mean(), samples.measured.mean() / min(1.0, 0.4 / every)


@pytest.mark.parametrize("hz", [4.9, 4.0, 2.0, 1.0])
@pytest.mark.parametrize("slow", ["heading", "command_left", "surge"])
def test_a_slow_channel_is_used_at_its_own_rate(slow, hz):
    """With a window of 0.2 s, a node learned nothing from a heading of 4 Hz, and said `ok`."""
    times = {name: stamps((120, 10), seed=k) for k, name in enumerate(REQUIRED)}
    times[slow] = stamps((120, hz), jitter=0.05) + 0.013
    fresh, measured = shares(boat(times))
    assert fresh > 0.96 and measured > 0.9
    assert hz > 4 or min(shares(boat(times, 0.2))) < 0.85


@pytest.mark.parametrize("before, after", [(10, 1), (4, 1), (1, 10), (2, 20), (1, 100), (20, 4)])
def test_a_rate_that_changes_is_followed_in_both_directions(before, after):
    times = stamps((60, before), (60, after))
    windows = windows_after(times)
    for hz, until in ((before, 60), (after, 120)):
        assert windows[times < until][-1] == pytest.approx(max(2 / hz, 0.2), abs=0.01)
    settled = times > (65.1 if after < before else 62.1)  # four slow intervals, or thirteen fast ones
    assert windows[settled] == pytest.approx(windows[-1], rel=1e-6)
    every = {name: times for name in REQUIRED}
    samples = align(boat(every)).samples
    assert samples.fresh[-100:].all() and samples.fresh.mean() > 0.95


def test_lost_messages_are_bridged():
    times = {name: stamps((600, 4), jitter=0.1, lost=0.05, seed=k) for k, name in enumerate(REQUIRED)}
    fresh, measured = shares(boat(times))
    assert fresh > 0.97 and measured > 0.95
    assert shares(boat(times, 0.3))[0] < 0.92


def test_a_channel_that_dies_does_not_stretch_its_own_window():
    times = {name: stamps((60, 10)) for name in REQUIRED}
    times["heading"] = stamps((30, 4))
    aligned = align(boat(times))
    assert not aligned.samples.fresh[aligned.time > 31].any() and aligned.samples.fresh[aligned.time < 29.7][1:].all()


def test_pauses_and_outages_are_no_interval():
    times = np.concatenate([stamps((20, 10)), 23 + stamps((20, 10)), 300 + stamps((20, 10)), 10.0 + stamps((20, 10))])
    assert windows_after(times).max() < 0.21


def test_a_burst_is_one_message():
    """Five thrusters that are posted one after the other, four times a second."""
    times = np.sort(np.concatenate([stamps((30, 4)) + 0.002 * k for k in range(5)]))
    assert windows_after(times)[20:].max() < 0.52 and windows_after(times)[20:].min() > 0.48


def test_what_comes_less_often_than_the_longest_window_has_none():
    windows = windows_after(stamps((100, 0.125)))
    assert (windows == 0.2).all()
    assert windows_after(stamps((100, 0.25)))[-1] == MOST_WINDOW


@pytest.mark.parametrize("steps", ["grid", "speed"])
@pytest.mark.parametrize("seed", range(3))
def test_messages_one_by_one_and_at_once_give_the_same_bits(seed, steps):
    rng = np.random.default_rng(seed)
    rates = {name: rng.choice([0.7, 1, 2, 4, 10, 30], 3) for name in CHANNELS}
    times = {name: stamps(*((40, hz) for hz in own), jitter=0.3, lost=0.1, seed=seed) for name, own in rates.items()}
    log = boat(times)
    aligner, pushed = Aligner(log, steps=steps), []
    rows = sorted((order, name, t, v) for name, c in log.items() for t, v, order in zip(*c[:3], strict=True))
    for _, name, time, value in rows:
        pushed += aligner.push(name, time, value)
    pushed += aligner.flush()
    whole = align(log, steps=steps)
    assert whole.rejected == aligner.rejected
    live = np.array([(t, *s.inputs, s.surge, s.fresh, s.measured) for t, s in pushed])
    samples = whole.samples
    np.testing.assert_array_equal(
        live, np.column_stack([whole.time, *samples.inputs, samples.surge, samples.fresh, samples.measured])
    )
    assert 0.3 < whole.samples.fresh.mean() < 1
    for name, (interval, window) in aligner.windows.items():
        assert window == min(max(0.2, 2 * interval), MOST_WINDOW), name


@pytest.mark.parametrize("seed", range(3))
def test_the_parts_of_a_mix_have_windows_of_their_own(seed):
    """Throttle at 1 Hz and steering at 10 Hz, of which messages are lost: live and at once."""
    times = stamps((60, 1), jitter=0.1, lost=0.1, seed=seed), stamps((60, 10), jitter=0.3, lost=0.1, seed=seed + 9)
    log = in_order({str(k): channel(t, np.sin(t + k), window=AUTO) for k, t in enumerate(times)})
    whole, dropped = mix([log["0"], log["1"]], [0.5, 0.5])
    live, sums = LiveMix(Mix.of({"name": ["a", "b"], "window": AUTO})), []
    for _, name, time, value in sorted((o, n, t, v) for n, c in log.items() for t, v, o in zip(*c[:3], strict=True)):
        if (both := live.push(int(name), time, value)) is not None:
            sums.append(both)
    np.testing.assert_array_equal(sums, whole.value)
    assert dropped < 0.1 * len(sums)


def test_a_held_channel_stays_held_and_a_number_stays_a_number():
    times = {name: stamps((30, 10)) for name in REQUIRED}
    log = boat(times)
    log["command_left"] = channel([0.0], 0.5, held=True, window=AUTO)
    assert align(in_order(log)).samples.fresh[1:].all()
    aligner = Aligner({name: Source(name, window=0.37) for name in REQUIRED})
    for k in range(50):
        aligner.push("heading", 1.0 * k, 0.0)
    assert aligner.windows["heading"] == (1.0, 0.37)


@pytest.mark.parametrize("window", ["soon", 0, -1.0, None, [1]])
def test_a_window_that_is_none_is_refused(window):
    with pytest.raises(ConfigError, match=r"window: found .*expected a positive time in s, or auto"):
        Source("a", window=window)
