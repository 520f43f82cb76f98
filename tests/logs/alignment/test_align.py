"""Alignment: what a prediction may see, what is rejected and counted, what a live boat shares with a replay."""

import copy
import math
import pickle

import numpy as np
import pytest

from tests.support import over
from tests.support.recordings import channel, in_order, log
from usvlearn.errors import ConfigError, LogFormatError
from usvlearn.logs.alignment.align import REQUIRED, Aligner, align
from usvlearn.logs.alignment.align_kernel import mean
from usvlearn.logs.channels.channel import CHANNELS, Channel, Source


def test_grid_of_a_clean_log():
    time, samples, rejected, _ = align(log())
    np.testing.assert_allclose(time, 0.4 * np.arange(11), atol=1e-9)
    assert samples.inputs.dt[0] == 0 and not samples.fresh[0]  # the first speed opens the segment
    assert samples.fresh[1:].all() and samples.measured[1:].all()
    np.testing.assert_allclose(samples.surge, 0.1 * time, atol=1e-12)
    np.testing.assert_allclose(samples.inputs.dt[1:], 0.4)
    np.testing.assert_allclose(samples.inputs.command_left[1:], 0.5)
    np.testing.assert_allclose(samples.inputs.yaw_rate[1:], 0.2, atol=1e-9)
    assert rejected == {}


@pytest.mark.parametrize(("inputs", "seen"), [("mean", [0.5, 0.6, 0.7, 0.8]), ("last", [0.5]), ("next", [0.9])])
def test_what_each_mode_sees_of_a_step(inputs, seen):
    """Messages at 0, 0.1 … with values 0.1, 0.2 …: the step from 0.4 to 0.8 s, whose target is stamped 0.8."""
    time = np.arange(9) / 10
    channels = log(0.8, command_left=channel(time, 0.1 * np.arange(1, 10)))
    samples = align(channels, inputs=inputs).samples
    assert samples.inputs.command_left[2] == pytest.approx(np.mean(seen))


def test_mean_is_weighted_by_time_and_carries_the_value_in_force():
    held = np.array([-1.0, 0.1, 0.3]), np.array([1.0, 2.0, 4.0])
    assert mean(*held, 0.0, 0.4) == pytest.approx((0.1 * 1 + 0.2 * 2 + 0.1 * 4) / 0.4)
    assert mean(*held, -2.0, 0.0) == pytest.approx(1.0)  # no value before -1: from there on
    assert math.isnan(mean(*held, -2.0, -1.5))


def closed_loop(inputs: str, seed: int = 0, **options) -> float:
    """How much of the target's noise the aligned command tells: a controller computes each command from the speed
    that it is logged beside, ξ = −v, and v is white noise, so that nothing else can tell it."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, 400, 0.1)
    noise = rng.normal(size=len(time))
    command = channel(time, np.clip(-0.2 * noise, -1, 1))
    channels = in_order({"command_left": command, "command_right": command, "heading": channel(time, 0.0),
                         "surge": channel(time, noise)})  # fmt: skip
    samples = align(channels, inputs=inputs, **options).samples
    steps = samples.measured
    return float(np.corrcoef(samples.inputs.command_left[steps], samples.surge[steps])[0, 1])


def test_nothing_stamped_at_or_after_the_target_reaches_a_prediction():
    bound = 4 / math.sqrt(1000)  # four standard deviations of the correlation of independent series
    assert abs(closed_loop("mean")) < bound
    assert abs(closed_loop("last")) < bound
    assert abs(closed_loop("mean", steps="speed", dt=0.35)) < bound
    assert closed_loop("next") < -0.9  # the paper's form leaks


def test_delayed_inputs_are_seen_later_never_earlier():
    time = np.arange(21) / 10
    ramp = np.arange(21) / 20
    plain = align(log(2.0, command_left=channel(time, ramp))).samples.inputs.command_left
    late = align(log(2.0, command_left=channel(time, ramp, delay=0.2))).samples.inputs.command_left
    np.testing.assert_allclose(late[2:], plain[2:] - 0.1, atol=1e-9)  # 0.2 s of a ramp of 0.5 a second
    for how in ({"delay": 0.2}, {"held": True}):
        with pytest.raises(ConfigError, match=next(iter(how))):
            align(log(surge=channel(time, 0.1, **how)))


def test_stale_steps_are_held_and_the_next_speed_starts_anew():
    time = np.arange(41) / 10
    gap = (time < 1.05) | (time > 1.95)  # no commands from 1.1 to 1.9 s
    _, samples, rejected, _ = align(log(command_left=channel(time[gap], 0.5)))
    # the targets at 1.6 and 2.0 s lie behind more than 0.2 s of silence, the one at 1.2 s does not yet
    assert samples.fresh.tolist() == [False, True, True, True, False, False, *[True] * 5]
    assert (samples.inputs.dt[[4, 5]] == 0).all()  # the speed was there: it opens a segment each time
    np.testing.assert_allclose(samples.surge, 0.1 * 0.4 * np.arange(11), atol=1e-12)
    assert rejected == {"command_left": {"stale": 2}}


def test_held_channels_do_not_go_stale_unless_declared_otherwise():
    once = channel([0.0], 0.5, held=True)
    assert align(log(command_left=once)).samples.fresh[1:].all()
    with_window = align(log(command_left=channel([0.0], 0.5)))
    assert with_window.rejected["command_left"]["stale"] >= 9


def test_missing_speeds_coast_and_count():
    time = np.arange(41) / 10
    few = channel(time[::10], 0.1 * time[::10])  # 1 Hz
    _, samples, rejected, _ = align(log(surge=few))
    assert samples.fresh[1:].all() and 0 < samples.measured.sum() < 6
    assert np.isnan(samples.surge[~samples.measured & samples.fresh]).all()
    assert rejected == {"surge": {"stale": int((~samples.measured).sum() - 1)}}


def test_messages_beyond_the_limits_and_without_numbers_are_counted():
    time = np.arange(41) / 10
    speed, command = 0.1 * time, np.full(41, 0.5)
    speed[5], speed[6], command[7] = 99.0, math.nan, -1.3
    channels = log(surge=channel(time, speed), command_left=channel(time, command),
                   yaw_rate=channel(time, np.where(time == 1.0, 9.0, 0.1)))  # fmt: skip
    _, samples, rejected, _ = align(channels)
    assert rejected == {"surge": {"out_of_range": 1, "not_a_number": 1}, "command_left": {"out_of_range": 1},
                        "yaw_rate": {"out_of_range": 1}}  # fmt: skip
    assert np.nanmax(samples.surge) < 5 and samples.measured[1:].all()


def test_a_heading_that_is_no_angle_is_counted():
    """Less its whole turns, 1e30 is a rounding error. A compass that counts turns is fine."""
    time = np.arange(41) / 10
    turns = np.where(time == 1.0, 1e30, 6283.0 + 0.1 * time)
    _, samples, rejected, _ = align(log(heading=channel(time, turns)))
    assert rejected == {"heading": {"out_of_range": 1}}
    np.testing.assert_allclose(samples.inputs.yaw_rate[2:], 0.1, atol=1e-9)


def test_stamps_that_repeat_or_run_backwards():
    channels = log()
    speed = channels["surge"]
    time, value = speed.time.copy(), speed.value.copy()
    time[11], value[11] = time[10], value[10]  # an exact duplicate
    time[13], value[13] = time[12], 0.7  # one stamp, two values: the later one stands
    time[15] = 0.95  # back by half a second
    _, samples, rejected, _ = align({**channels, "surge": speed._replace(time=time, value=value)})
    assert rejected["surge"] == {"duplicate": 1, "repeated": 1, "backwards": 1}
    assert samples.surge[3] == 0.7 and samples.measured[1:].all()


def test_stray_stamps_from_another_clock_do_not_move_the_grid():
    channels = log()
    time = channels["heading"].time.copy()
    time[20], time[30] = -67301.668, 1e9
    stamps, samples, rejected, _ = align({**channels, "heading": channels["heading"]._replace(time=time)})
    assert rejected["heading"] == {"backwards": 1, "ahead": 1}
    np.testing.assert_allclose(stamps, 0.4 * np.arange(11), atol=1e-9)
    assert samples.measured[1:].all()


def test_a_stray_speed_from_the_future_is_set_aside():
    channels = log()
    time = channels["surge"].time.copy()
    time[22] = 1e9
    stamps, samples, rejected, _ = align({**channels, "surge": channels["surge"]._replace(time=time)})
    assert rejected["surge"] == {"ahead": 1} and stamps[-1] <= 4.0 + 1e-6
    assert samples.measured[1:].all()


def test_one_channel_with_a_late_clock_does_not_reset_the_grid():
    """Only messages of several channels together tell that the clock was set back."""
    channels = log(yaw_rate=channel(np.arange(41) / 10, 0.2))
    skewed = channels["yaw_rate"]._replace(time=channels["yaw_rate"].time - 1.5, order=channels["yaw_rate"].order)
    _, samples, rejected, _ = align({**channels, "yaw_rate": skewed})
    assert rejected["yaw_rate"]["backwards"] > 20 and (samples.inputs.dt == 0).sum() <= 11
    assert len(samples.surge) == 11


def test_what_is_held_stands_through_an_outage():
    first, second = log(4.0), log(4.0)
    both = in_order({
        name: c._replace(time=np.concatenate([c.time, second[name].time + 60]),
                         value=np.concatenate([c.value, second[name].value]))
        for name, c in first.items()
    } | {name: channel([0.0], 0.5, held=True) for name in ("command_left", "command_right")})  # fmt: skip
    _, samples, *_ = align(both)
    assert samples.measured.sum() == 20
    np.testing.assert_array_equal(samples.inputs.command_left[samples.fresh], 0.5)


def test_a_held_heading_is_a_boat_that_goes_straight():
    heading = channel([0.0, 0.5, 1.0], [0.0, 0.2, 0.4], held=True)
    samples = align(log(8.0, heading=heading)).samples
    assert samples.inputs.yaw_rate[3] == pytest.approx(0.4)
    assert samples.fresh[8:].all() and (samples.inputs.yaw_rate[8:] == 0).all()


def test_a_speed_after_long_silence_opens_a_segment():
    """Twenty seconds of drift are not one step to learn from."""
    time = np.arange(301) / 10
    speed = time[(time < 4.05) | (time > 24.0)]
    _, samples, *_ = align(log(30.0, surge=channel(speed, 0.1 * speed)))
    back = int(np.flatnonzero(samples.inputs.dt == 0)[-1])
    assert samples.surge[back] == pytest.approx(2.4, abs=0.05) and not samples.measured[back]
    assert samples.measured[back + 1 :].all() and samples.fresh[11:back].all()


def test_a_clock_that_is_set_back_starts_a_new_segment():
    first, second = log(4.0), log(4.0)
    both = {
        name: Channel(
            np.concatenate([c.time + 5000, second[name].time]),
            np.concatenate([c.value, second[name].value]),
            np.concatenate([c.order, second[name].order + 10_000]),
        )
        for name, c in first.items()
    }
    stamps, samples, *_ = align(both)
    assert samples.measured.sum() >= 2 * 10 - 1
    assert (samples.inputs.dt == 0).sum() == 2 and (np.diff(stamps) < 0).sum() == 1


def live(*messages) -> dict[str, dict[str, int]]:
    """What is rejected of messages `(channel, stamp)`, after a second of every channel at 10 Hz."""
    aligner = Aligner({name: Source(name) for name in REQUIRED})
    for k in range(11):
        for name in REQUIRED:
            aligner.push(name, 100 + 0.1 * k, 0.5)
    for name, stamp in messages:
        aligner.push(name, stamp, 0.5)
    return aligner.rejected


def test_the_third_message_in_a_row_from_far_behind_sets_the_clock_back():
    left, right, heading, _ = REQUIRED
    behind = [(left, 3.0), (right, 3.0), (heading, 3.0)]
    assert live(*behind[:2]) == live(*behind) == {left: {"backwards": 1}, right: {"backwards": 1}}


def test_a_message_on_time_forgets_which_channels_were_behind():
    """One channel that is late three times in a row is no clock that was set back, whoever was late before."""
    left, right, _, surge = REQUIRED
    behind = [(right, 3.0 + k / 10) for k in range(3)]
    assert live((left, 3.0), (surge, 101.1), *behind) == {left: {"backwards": 1}, right: {"backwards": 3}}


def test_an_outage_emits_nothing_and_starts_anew():
    first, second = log(4.0), log(4.0)
    both = in_order({
        name: Channel(
            np.concatenate([c.time, second[name].time + 115]), np.concatenate([c.value, second[name].value]), c.order
        )
        for name, c in first.items()
    })  # fmt: skip
    stamps, samples, *_ = align(both)
    assert len(stamps) == 22 and (samples.inputs.dt == 0).sum() == 2
    assert samples.measured.sum() == 20


def test_bursts_do_not_make_a_wild_yaw_rate():
    """Two headings 0.2 ms apart with 0.01 rad between them are 50 rad/s only to a naive difference."""
    time = np.sort(np.concatenate([np.arange(41) / 10, np.arange(41) / 10 + 2e-4]))
    heading = 0.2 * time + 0.01 * (np.arange(82) % 2)
    _, samples, rejected, _ = align(log(heading=channel(time, heading)))
    assert np.abs(samples.inputs.yaw_rate[1:] - 0.2).max() < 0.05 and "yaw_rate" not in rejected


def test_heading_turns_through_north():
    time = np.arange(41) / 10
    for turn in (1, -1):
        heading = (turn * 0.5 * time) % (2 * math.pi)
        samples = align(log(heading=channel(time, heading))).samples
        np.testing.assert_allclose(samples.inputs.yaw_rate[2:], 0.5 * turn, atol=1e-9)
        assert ((samples.inputs.heading >= 0) & (samples.inputs.heading < 2 * math.pi)).all()


def test_a_heading_that_jumps_about_is_rejected():
    time = np.arange(41) / 10
    random = np.random.default_rng(0).uniform(0, 2 * math.pi, 41)
    _, samples, rejected, _ = align(log(heading=channel(time, random)))
    assert rejected["yaw_rate"]["out_of_range"] > 0
    assert np.abs(samples.inputs.yaw_rate[samples.fresh]).max() <= 3.0


def test_live_messages_make_the_samples_of_the_replay():
    """Pushing message by message, stragglers within the patience included, equals aligning the log."""
    channels = log(20.0)
    whole = align(channels)
    aligner = Aligner(channels)
    messages = sorted(
        (float(t) + (0.06 if name == "heading" else 0.0), name, float(t), float(x))
        for name, c in channels.items()
        for t, x in zip(c.time, c.value, strict=True)
    )
    live = [done for _, name, t, x in messages for done in aligner.push(name, t, x)] + aligner.flush()
    np.testing.assert_allclose([t for t, _ in live], whole.time, atol=1e-9)
    np.testing.assert_allclose([s.surge for _, s in live], whole.samples.surge)
    np.testing.assert_allclose([s.inputs.yaw_rate for _, s in live], whole.samples.inputs.yaw_rate)


@over("patience", [0.0, 1.0, 8.0])
@pytest.mark.parametrize("steps", ["grid", "speed"])
@pytest.mark.parametrize("inputs", ["mean", "last", "next"])
def test_a_boat_that_forgets_makes_the_samples_of_a_whole_log_bit_for_bit(inputs, steps, patience):
    """Late, lost, repeated and stray stamps, outages, a clock set back: however the messages come in pieces."""
    rng = np.random.default_rng(1)
    count = 4000
    stamps = np.cumsum(rng.exponential(0.03, count)) + rng.normal(0, 0.05, count)
    stamps += 40.0 * (np.arange(count) > 1500) - 500.0 * (np.arange(count) > 3000)
    stamps[rng.integers(0, count, 20)] = 1e9
    stamps[rng.integers(1, count, 40)] = stamps[rng.integers(1, count, 40) - 1]
    which, values = rng.integers(0, len(CHANNELS), count), rng.uniform(-0.2, 1.25, count)
    values[which == CHANNELS.index("surge")] = values[which == CHANNELS.index("surge")].round(1)
    channels = {name: channel([], [], held=name == "command_left", delay=0.2 * (name == "yaw_rate"), window=0.5)
                for name in CHANNELS}  # fmt: skip
    channels["surge"] = channels["surge"]._replace(period=0.3)
    whole, live = (Aligner(channels, inputs=inputs, patience=patience, steps=steps) for _ in range(2))
    rows = whole.feed(which, stamps, values, flush=True)
    pushed, came = [], []
    for k, (c, t, x) in enumerate(zip(which, stamps, values, strict=True)):
        pushed += live.push(CHANNELS[c], t, x)
        came += [k] * (len(pushed) - len(came))
    pushed += live.flush()
    came += [count] * (len(pushed) - len(came))
    assert len(rows) > 200 and whole.rejected == live.rejected and len(whole.rejected) == len(CHANNELS)
    assert whole.rejected["surge"]["copied"] > 10
    expected = np.array([(t, *s.inputs, *s[1:], k) for (t, s), k in zip(pushed, came, strict=True)], dtype=float)
    np.testing.assert_array_equal(expected, rows)
    assert live._times.shape[1] < 1000  # it holds seconds, not the log


@pytest.mark.parametrize(
    "wrong",
    [
        {"dt": 0.0},
        {"dt": -0.4},
        {"inputs": "future"},
        {"steps": "own"},
        {"surge_max": math.nan},
        {"patience": -1.0},
        {"outage": 0},
    ],
)
def test_illegal_options_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        align(log(), **wrong)


def test_a_live_message_that_is_no_number_is_counted_and_an_unknown_channel_is_told():
    aligner = Aligner(log())
    for value in (None, "fast", math.nan):
        assert aligner.push("surge", 0.0, value) == []
    assert aligner.rejected["surge"]["not_a_number"] == 3
    assert len(aligner.push("surge", "0.5", "1.5")) == 1
    with pytest.raises(ConfigError, match="'speed', expected one of command_left"):
        aligner.push("speed", 0.0, 1.0)
    with pytest.raises(ConfigError, match="foo"):
        Aligner({**log(), "foo": log()["surge"]})


def test_a_log_without_speed_is_refused():
    channels = log()
    del channels["surge"]
    with pytest.raises(LogFormatError, match="surge"):
        align(channels)


def test_stamps_in_nanoseconds_are_none():
    """At 1.7e18 s the next step would be at the same time as the last."""
    aligner = Aligner({name: Source(name) for name in REQUIRED})
    for k in range(8):
        assert not aligner.push("surge", 1.7e18 + 1e8 * k, 1.0)
    assert aligner.rejected == {"surge": {"not_a_number": 8}}


def test_a_copy_of_an_aligner_goes_its_own_way():
    def feed(aligner, begin, end):
        return [sample for k in range(begin, end) for name in REQUIRED for sample in aligner.push(name, 0.1 * k, k)]

    aligner, whole = (Aligner({name: Source(name) for name in REQUIRED}, surge_max=99.0) for _ in range(2))
    feed(aligner, 0, 6), feed(whole, 0, 6)
    others = copy.copy(aligner), copy.deepcopy(aligner), pickle.loads(pickle.dumps(aligner))
    expected = feed(whole, 6, 30)
    for one in (*others, aligner):
        assert feed(one, 6, 30) == expected and len(expected) > 5
        assert one.rejected == whole.rejected


def test_a_mean_sees_nothing_that_is_stamped_after_the_speed():
    """The speed of the step to 0.4 s is stamped 0.35 s, a new command 0.36 s."""
    speeds = channel([0.0, 0.35, 0.75], [0.0, 0.1, 0.2], window=0.3)
    samples = align(log(0.8, surge=speeds, command_left=channel([0.0, 0.36], [0.0, 1.0], held=True))).samples
    assert samples.measured[1] and samples.inputs.command_left[1] == 0.0


def test_every_step_waits_for_stragglers():
    """Also the steps of a gap, which become due together."""
    aligner, steps = Aligner({name: channel([], []) for name in REQUIRED}, patience=0.2), []
    for time in (0.0, 1.3, 1.45):
        for name in REQUIRED:
            steps += [(at, time) for at, _ in aligner.push(name, time, 0.1)]
    assert max(at for at, _ in steps) == pytest.approx(1.2)
    assert all(at <= newest - 0.2 + 1e-9 for at, newest in steps[1:])
