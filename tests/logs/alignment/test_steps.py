"""Steps by the speed's own stamps: how long they are, what they see, and what happens where no speed comes."""

import numpy as np
import pytest

from tests.support.recordings import channel, log
from usvlearn import Ensemble, Persistence
from usvlearn.logs.alignment.align import align
from usvlearn.logs.channels.channel import Recording
from usvlearn.logs.recordings import align_fleet
from usvlearn.runs.replay import replay


def jittered(seconds: float, hz: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.uniform(0.7 / hz, 1.3 / hz, int(seconds * hz * 0.9)))


@pytest.mark.parametrize("hz", [5, 9, 20, 100])
def test_each_step_ends_at_the_first_speed_at_least_dt_later(hz):
    stamps = jittered(60, hz)
    time, samples, rejected, _ = align(log(stamps[-1], surge=channel(stamps, 0.1 * stamps, window=0.3)), steps="speed")
    expected = [stamps[0]]
    while len(later := stamps[stamps >= expected[-1] + 0.4]):
        expected.append(later[0])
    np.testing.assert_array_equal(time, expected)
    np.testing.assert_array_equal(samples.surge, 0.1 * time)
    np.testing.assert_allclose(samples.inputs.dt, np.append(0, np.diff(time)), atol=1e-12)
    assert samples.measured[1:].all() and rejected == {}
    assert 0.4 <= samples.inputs.dt[1:].min() and samples.inputs.dt.max() <= 0.4 + 1.3 / hz


def test_a_mean_covers_exactly_the_time_between_two_speeds():
    speeds = channel([0.0, 0.5, 1.0, 1.5], [0.1, 0.2, 0.3, 0.4])
    ramp = np.arange(16) / 10
    commands = {f"command_{side}": channel(ramp, ramp / 2) for side in ("left", "right")}
    for steps, mean in (("speed", (0.5 + 0.6 + 0.7 + 0.8 + 0.9) / 10), ("grid", (0.4 + 0.5 + 0.6 + 0.7) / 8)):
        _, samples, *_ = align(log(1.5, surge=speeds, **commands), steps=steps)
        assert samples.inputs.command_left[2] == pytest.approx(mean)


def test_where_no_speed_comes_a_step_has_the_length_of_the_grid():
    stamps = np.arange(41) / 10
    there = stamps[(stamps < 1.05) | (stamps > 2.95)]
    time, samples, *_ = align(log(4.0, surge=channel(there, 0.1 * there)), steps="speed")
    np.testing.assert_allclose(np.diff(time), samples.inputs.dt[1:], atol=1e-9)
    missing = samples.fresh & ~samples.measured
    assert missing.sum() >= 3 and np.isnan(samples.surge[missing]).all()
    np.testing.assert_allclose(samples.inputs.dt[missing], 0.4, atol=1e-9)
    assert samples.measured[-1] and (samples.inputs.dt == 0).sum() == 1  # the boat coasts; no segment is cut


def test_a_slow_speed_is_met_exactly_within_its_window():
    stamps = np.arange(30.0)
    time, samples, *_ = align(log(30.0, surge=channel(stamps, 1 + 0.01 * stamps, window=0.4)), steps="speed")
    assert set(np.round(time[samples.measured], 9)) == set(stamps[1:])


def test_boats_of_one_fleet_step_by_their_own_speeds():
    """A row is the k-th step of each boat, not one moment of all boats: each batch element has its own time and dt."""
    recordings = []
    for seed, boat in enumerate("ab"):
        stamps = jittered(20, 9, seed)
        recordings.append(Recording(boat, "run", log(20, surge=channel(stamps, 0.1 * stamps)), {}))
    fleet = align_fleet(recordings, steps="speed")
    (run,) = fleet.runs
    for element, one in enumerate(recordings):
        alone = align(one.channels, steps="speed")
        part = slice(run.lengths[element]), element
        np.testing.assert_array_equal(run.time[part], alone.time - alone.time[0])
        np.testing.assert_array_equal(run.samples.inputs.dt[part], alone.samples.inputs.dt)
    assert (run.samples.inputs.dt[1:30, 0] != run.samples.inputs.dt[1:30, 1]).all()
    model = Ensemble({"persistence": Persistence()})
    (chunk,) = replay(model, fleet, model.init((2,)))
    assert np.isfinite(chunk.published["predictions"][1:30]).all()
