"""How two channels hang together: simulated boats, whose truth is known, and real logs, read as configured."""

import math

import numpy as np
import pytest

from tests.support import REAL_LOGS, RECORDED, over
from usvlearn.composition.configuration import recordings_of
from usvlearn.logs.channels import correlations, position_rates
from usvlearn.simulate.autopilot import Autopilot
from usvlearn.simulate.fleet import fleet

SURE = 4.0  # standard errors


def series_of(recordings):
    """All runs of a boat as pairs of time and value, commands at the time of their effect."""
    runs = [{name: (c.time + c.delay, c.value) for name, c in one.channels.items()} for one in recordings]
    return correlations.in_series(runs)


@pytest.fixture(scope="module")
def boats():
    return {
        plant: series_of(fleet(n=1, plant=plant, seed=seed, hours=0.5, autopilot=Autopilot(lowest=lowest)))
        for plant, seed, lowest in (("heron", 0, 0.0), ("kingfisher", 1, 0.0), ("otter", 2, -1.0), ("wamv", 3, 0.0))
    }


def sides(boat):
    return boat["command_left"], boat["command_right"]


def each_side(left, right, response):
    """Relations of a response to either side, over bins of .5 s and lags up to 5 s."""
    edges = correlations.bin_edges(0.5, response)
    commands = (correlations.bin_means(side, edges, held=True) for side in (left, right))
    return correlations.relate_sides(
        *commands, correlations.clipped(correlations.bin_means(response, edges)), 0.5, (0.0, 5.0)
    )


def reversed_of(series):
    return series[0], -series[1]


def test_simulated_boats_turn_to_starboard_by_their_left_thruster(boats):
    for name, boat in boats.items():
        rate = correlations.heading_rate(boat["heading"])
        assert correlations.side_sign(*sides(boat), rate).certainty > SURE, name
        left, right = sides(boat)
        assert correlations.side_sign(right, left, rate).certainty < -SURE, name
        left, right = each_side(left, right, rate)
        assert left.certainty > SURE and right.certainty < -SURE, name
        ahead = each_side(*sides(boat), boat["surge"])
        assert all(each.certainty > SURE for each in ahead), name


def test_one_reversed_side_is_told_from_the_other(boats):
    for name, boat in boats.items():
        left, right = sides(boat)
        rate = correlations.heading_rate(boat["heading"])
        both = each_side(reversed_of(left), right, rate)
        assert both[0].certainty < -SURE and both[1].certainty < -SURE, name
        speeds = each_side(left, reversed_of(right), boat["surge"])
        assert speeds[0].certainty > SURE and speeds[1].certainty < -SURE, name


@over("delay", (0.0, 40.0, 100.0))
def test_the_lag_of_a_speed_is_its_delay_and_the_inertia(delay, boats):
    for name, boat in boats.items():
        time, speed = boat["surge"]
        relation = correlations.speed_on_thrust(*sides(boat), (time + delay, speed), (-150.0, 150.0))
        assert delay <= relation.lag <= delay + 4.0 and relation.certainty > SURE, name


@over("factor", (1.0, 180 / math.pi, math.pi / 180, -1.0))
def test_the_slope_of_a_yaw_rate_is_its_unit(factor, boats):
    """A second heading with noise of its own stands for the gyroscope's."""
    rng = np.random.default_rng(0)
    for name, boat in boats.items():
        time, heading = boat["heading"]
        gyro = correlations.heading_rate((time, heading))
        noisy = np.mod(heading + rng.normal(0, 0.01, len(time)), 2 * np.pi)
        relation = correlations.rate_slope((time, noisy), (gyro[0], factor * gyro[1]))
        assert relation.slope == pytest.approx(factor, rel=0.1) and abs(relation.correlation) > 0.9, name
        circle = correlations.rate_slope((time, noisy * factor), gyro)  # its own circle need not be 2π
        assert circle.slope == pytest.approx(1 / factor, rel=0.1), name


@over("factor", (1.0, 3600 / 1852, 1852 / 3600, 3.6))
def test_the_slope_of_a_speed_over_positions_is_its_unit(factor, boats):
    rng = np.random.default_rng(1)
    for name, boat in boats.items():
        (time, speed), heading = boat["surge"], np.interp(boat["surge"][0], *boat["heading"])
        passed = np.diff(time, prepend=time[0])
        north = np.cumsum(passed * speed * np.cos(heading)) + rng.normal(0, 0.5, len(time))
        east = np.cumsum(passed * speed * np.sin(heading)) + rng.normal(0, 0.5, len(time))
        relation = position_rates.speed_on_positions((time, north), (time, east), (time, factor * speed))
        assert relation.slope == pytest.approx(factor, rel=0.1) and relation.correlation > 0.8, name


def test_unrelated_series_are_seldom_thought_to_be_related():
    """The error is that of the correlation between series that depend on themselves, at a lag that is fixed."""
    certainties = []
    for seed in range(300):
        rng = np.random.default_rng(seed)
        time, slow = np.arange(0, 600, 0.5), np.exp(-np.arange(120) / 20)
        x, y = (np.convolve(rng.normal(size=1320), slow, "valid")[:1200] for _ in range(2))
        certainties.append(correlations.speed_on_thrust((time, x), (time, x), (time, y), (0.0, 0.0)).certainty)
    assert np.std(certainties) < 1.2 and np.mean(np.abs(certainties) > SURE) < 0.01
    assert np.std(certainties) > 0.5  # and they are not all called unknown


def test_gaps_jitter_offsets_and_bad_values_do_not_matter(boats):
    boat, rng = boats["heron"], np.random.default_rng(0)
    pairs = []
    for spoiled in (False, True):
        series = dict(boat)
        for name, (time, value) in boat.items():
            if spoiled:
                time, value = time + 1.7e9, value.copy()
                mask = (time % 300 > 20) & (rng.random(len(time)) > 0.2)
                value[rng.random(len(time)) < 0.05] = np.nan
                place = rng.permutation(np.flatnonzero(mask))
                time, value = np.append(time[place], np.nan), np.append(value[place], 1.0)
            series[name] = time, value
        rate = correlations.heading_rate(series["heading"])
        pairs.append(
            (
                correlations.side_sign(*sides(series), rate),
                correlations.speed_on_thrust(*sides(series), series["surge"]),
            )
        )
    for clean, spoiled in zip(*pairs, strict=True):
        assert spoiled.correlation == pytest.approx(clean.correlation, abs=0.05)
        assert spoiled.lag == pytest.approx(clean.lag, abs=0.5)


def test_too_little_evidence_is_no_relation():
    nothing, few = (np.empty(0), np.empty(0)), (np.arange(4.0), np.ones(4))
    long = np.arange(0.0, 600.0), np.sin(np.arange(600.0))
    flat = long[0], np.zeros(600)
    for series in (nothing, few, flat):
        for relation in (
            correlations.rate_slope(long, series),
            correlations.rate_slope(series, long),
            correlations.side_sign(series, series, long),
            correlations.speed_on_thrust(series, series, long),
            correlations.speed_on_thrust(long, long, series),
            position_rates.speed_on_positions(series, series, long),
            each_side(series, long, long)[0],
        ):
            assert math.isnan(relation.correlation) or series is flat, relation
            assert not abs(relation.certainty) > SURE
    assert correlations.angle_offset(few, long).seconds == 0
    assert correlations.in_series([]) == {} and correlations.in_series([{"surge": nothing}]) == {}


def test_a_span_of_decades_takes_no_memory():
    """A log whose first stamp is of 1969, as some write it."""
    time = np.append(-1.6e9, np.arange(0.0, 600.0, 0.2))
    value = np.random.default_rng(0).uniform(0, 1, 61).repeat(50)[: len(time)]
    relation = correlations.speed_on_thrust((time, value), (time, value), (time, value))
    assert relation.correlation > 0.9 and relation.seconds > 500


@pytest.mark.parametrize("name", RECORDED)
def test_real_boats_as_configured(name):
    if not (REAL_LOGS / name).is_dir():
        pytest.skip(f"the logs of {name} are not here: they are not published with this project")
    boat = series_of(recordings_of(name, {"data": {"path": str(REAL_LOGS / name)}})[0])
    thrust = correlations.speed_on_thrust(*sides(boat), boat["surge"], (-150.0, 150.0))
    assert thrust.correlation > 0.7 and -1.0 <= thrust.lag <= 10.0
    assert all(each.correlation > 0 for each in each_side(*sides(boat), boat["surge"]))
    if "yaw_rate" in boat:
        relation = correlations.rate_slope(boat["heading"], boat["yaw_rate"])
        assert relation.slope == pytest.approx(1.0, rel=0.02) and relation.correlation > 0.99
    rate = boat.get("yaw_rate") or correlations.heading_rate(boat["heading"])
    turns = correlations.side_sign(*sides(boat), rate)
    assert turns.correlation > 0.3
