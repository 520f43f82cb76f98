"""Copies of a measured speed: which repeats are taken for copies, what dropping them keeps and what it takes away."""

import math
from pathlib import Path

import numpy as np
import pytest

from tests.support import few
from tests.support.recordings import channel, in_order, log
from usvlearn.errors import ConfigError
from usvlearn.logs.alignment.align import REQUIRED, Aligner, align
from usvlearn.logs.channels.channel import Channel, Source
from usvlearn.logs.channels.repeated_values import find_period
from usvlearn.logs.formats.csv.table import Table
from usvlearn.logs.read import read_recordings

KEY = "data.channels.surge.period"


def polled(seconds: float, sensor_hz: float, log_hz: float, seed: int = 0, jitter: float = 0.005, **how) -> Channel:
    """White speeds about 1 m/s of a sensor, logged with jitter at a rate of its own."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, seconds, 1 / log_hz)
    time = np.maximum(time + rng.normal(0, jitter, len(time)), 0)
    measured = rng.normal(1.0, 0.1, int(seconds * sensor_hz) + 2)
    return channel(time, measured[(time * sensor_hz).astype(int)], **how)


def firsts(copied: Channel) -> Channel:
    """The first message of each run of equal speeds, as a log would hold that has no copies."""
    new = np.append(True, np.diff(copied.value) != 0)
    return copied._replace(time=copied.time[new], value=copied.value[new], order=copied.order[new])


@pytest.mark.parametrize(("sensor", "logged"), [(5, 9), (5, 10), (1, 10), (4, 5.5), (2, 7)])
def test_the_period_of_a_sensor_that_is_logged_too_fast_is_found(sensor, logged):
    for seed in range(5):
        period, share = find_period([polled(100, sensor, logged, seed)])
        assert period == pytest.approx(1 / sensor, rel=0.05)
        assert share == pytest.approx(1 - sensor / logged, abs=0.04)


def test_numbers_that_are_no_speeds_do_not_warn():
    """They are rejected at the alignment."""
    one = polled(100, 5, 9)
    value = one.value.copy()
    value[[100, 101, 200]] = 1.7e308, -1.7e308, 1e305
    assert find_period([one._replace(value=value)])[0] == pytest.approx(0.2, rel=0.05)


def test_short_runs_of_one_boat_are_judged_together():
    runs = [polled(5, 5, 9, seed) for seed in range(6)]
    assert find_period(runs[:1]) == (0.0, 0.0)
    assert find_period(runs)[0] == pytest.approx(0.2, rel=0.05)


def steady(rng) -> np.ndarray:
    return np.round(1.0 + 0.01 * np.cumsum(rng.normal(size=2000)) / 5, 2)


MEASURED_REPEATS = {
    "a coarse sensor at steady speed": lambda rng: np.round(rng.normal(1.0, 0.03, 2000), 1),
    "a coarse sensor and a boat that drifts slowly": steady,
    "a coarse sensor of a boat that speeds up evenly": lambda rng: np.floor(np.arange(2000) / 2) * 0.05 % 3 + 0.1,
    "a boat at rest, then a fine sensor": lambda rng: np.append(np.zeros(1000), rng.normal(1.0, 0.1, 1000)),
    "a speed that is lost and filled with zeros": lambda rng: np.where(np.arange(2000) % 3, 0.0, rng.normal(size=2000)),
    "one speed for ever": lambda rng: np.ones(2000),
    "a sensor that hangs now and then": lambda rng: np.repeat(rng.normal(1.0, 0.1, 2000), rng.geometric(0.5, 2000)),
}


@pytest.mark.parametrize("how", MEASURED_REPEATS)
def test_what_a_sensor_measures_again_is_no_copy(how):
    for seed in range(5):
        values = MEASURED_REPEATS[how](np.random.default_rng(seed))
        assert find_period([channel(np.arange(len(values)) / 10, values)]) == (0.0, 0.0)


@pytest.mark.parametrize("steps", ["grid", "speed"])
def test_dropping_copies_gives_the_samples_of_a_log_without_copies(steps):
    surge = polled(60, 5, 9, period=0.2)
    whole = align(log(60, surge=surge), steps=steps)
    alone = align(log(60, surge=firsts(surge)), steps=steps)
    assert whole.rejected == {"surge": {"copied": len(surge.time) - len(firsts(surge).time)}}
    np.testing.assert_array_equal(whole.time, alone.time)
    for name in ("surge", "measured", "fresh"):
        np.testing.assert_array_equal(getattr(whole.samples, name), getattr(alone.samples, name))
    np.testing.assert_array_equal(whole.samples.inputs, alone.samples.inputs)


def leak(period: float) -> float:
    """How much of the target's noise the aligned command tells: a row's command is −0.2 of its speed."""
    surge = polled(400, 5, 10, jitter=0.0, period=period)
    surge = surge._replace(time=surge.time[1:], value=surge.value[1:])  # each step of 0.4 s ends with a copy
    command = channel(surge.time, np.clip(-0.2 * surge.value, -1, 1))
    channels = in_order({"command_left": command, "command_right": command,
                         "heading": channel(surge.time, 0.0), "surge": surge})  # fmt: skip
    samples = align(channels).samples
    steps = samples.measured
    assert steps.sum() > 990
    return float(np.corrcoef(samples.inputs.command_left[steps], samples.surge[steps])[0, 1])


def test_a_command_beside_a_copy_tells_the_speed_and_without_copies_it_does_not():
    assert leak(0.0) < -0.3
    assert abs(leak(0.2)) < 4 / math.sqrt(990)  # four standard deviations for independent series


@pytest.mark.parametrize("hz", [5, 9, 10, 20])
def test_a_speed_that_stays_is_measured_again_and_cuts_no_segment(hz):
    """At rest every message is a measurement; a coarse sensor's steady speed is one at least every two periods."""
    for speed, least in ((0.0, 1.0), (1.0, 0.85)):
        channels = log(120, hz)
        surge = channels["surge"]._replace(value=np.full(len(channels["surge"].time), speed), period=0.2)
        _, samples, rejected, _ = align({**channels, "surge": surge})
        assert samples.measured[1:].mean() >= least and (samples.inputs.dt == 0).sum() == 1
        assert ("copied" in rejected.get("surge", {})) == (speed > 0)


def test_a_missed_measurement_does_not_cut_the_log():
    surge = polled(60, 5, 9, period=0.2)
    value = surge.value.copy()
    for begin in range(20, len(value) - 9, 20):
        value[begin : begin + 3] = value[begin - 1]  # the sensor misses one, or two
    samples = align(log(60, surge=surge._replace(value=value))).samples
    assert (samples.inputs.dt == 0).sum() == 1 and samples.measured[1:].mean() > 0.9


def table(folder: Path, surge: Channel) -> Path:
    rows = (f"{t},0.5,0.4,90,{v}" for t, v in zip(surge.time, surge.value, strict=True))
    path = folder / "heron.csv"
    path.write_text("\n".join(["t,L,R,psi,v", *rows]))
    return path


def read(path: Path, **how) -> Channel:
    channels = {"command_left": {"name": "L"}, "command_right": {"name": "R"},
                "heading": {"name": "psi", "unit": "deg"}, "surge": {"name": "v", **how}}  # fmt: skip
    (recording,) = read_recordings(path, Table("t"), channels)
    return recording.channels["surge"]


def test_reading_finds_copies_says_so_and_settles_what_is_done(tmp_path):
    copied = table(tmp_path, polled(60, 5, 9))
    text = r"heron: 4\d% of the speeds repeat .* measures every 0.2 s: "
    with pytest.warns(UserWarning, match=text + rf"the copies are dropped \({KEY}=0.2; 0 keeps them\)"):
        assert read(copied, period="auto").period == 0.2
    with pytest.warns(UserWarning, match=text + f"set {KEY}=0.2 to drop"):
        assert read(copied).period == 0.0
    assert read(copied, period=0.25).period == 0.25  # as declared, without a word
    plain = table(tmp_path, polled(60, 9, 9, jitter=0.0))  # has no copies
    assert read(plain, period="auto").period == read(plain).period == 0.0


def test_live_messages_need_a_period_and_only_the_speed_has_one():
    sources = {name: Source(name) for name in REQUIRED}
    with pytest.raises(ConfigError, match=rf"{KEY}: found auto, expected a time in s"):
        Aligner({**sources, "surge": Source("v", period="auto")})
    with pytest.raises(ConfigError, match=r"data.channels.heading.period: found 0.2, expected 0"):
        Aligner({**sources, "heading": Source("psi", period=0.2)})
    with pytest.raises(ConfigError, match=r"period: found .often., expected a time of 0 to 10 s, or auto"):
        Source("v", period="often")


RECORDED = [("dalian", "Speed", 0.2), ("blueboat", "surge", 0.0)]


@pytest.mark.parametrize(("boat", "column", "expected"), few(RECORDED, RECORDED[:1], "thorough"))
def test_the_sensors_of_recorded_boats(boat, column, expected, real_logs):
    time = "DateTime" if boat == "dalian" else "original_timestamp"
    reader = Table(time, time_unit="s" if boat == "dalian" else "ms")
    logs = [reader.read(path, {"surge": Source(column)})[0]["surge"] for path in (real_logs / boat).glob("*.csv")]
    period, share = find_period(logs)
    assert period == expected and share == pytest.approx(0.455 if expected else 0.0, abs=0.001)
