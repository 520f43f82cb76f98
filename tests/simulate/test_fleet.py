"""Simulated sensors and missions: what the logs hold, by how it was asked for."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from tests.support.recordings import same
from usvlearn.core.samples import tree_map
from usvlearn.logs.alignment.align import align
from usvlearn.simulate.autopilot import Autopilot
from usvlearn.simulate.fleet import fleet, fleet_missions, fleet_vessels, sail, simulate
from usvlearn.simulate.plants import PLANTS, plant
from usvlearn.simulate.scenario import MISSIONS, USUAL, Mission, aborted, paused
from usvlearn.simulate.sensors import Sensors, Truth, measure
from usvlearn.simulate.truth import true_parameters
from usvlearn.simulate.vessel import at_rest, over_ground, steady_surge

pytestmark = pytest.mark.filterwarnings("error")

PERFECT = {"jitter": 0.0, "latency": 0.0, "lost_share": 0.0, "outages_per_hour": 0.0, "outlier_share": 0.0}


def tensor(x):
    return torch.tensor(x, dtype=torch.float64)


def still_truth(minutes=60.0, speed=1.0, dt=0.1):
    """A boat that goes north at a constant speed."""
    steps = round(minutes * 60 / dt)
    commands = np.round(np.random.default_rng(5).random((round(minutes * 240), 2)), 2)
    return Truth(dt, np.full(steps + 1, speed), np.full(steps + 1, 0.3), 0.25, commands)


# ---- the sensors


def test_speed_lies_on_the_grid_and_the_filter_is_finer_below():
    fast = measure(np.random.default_rng(0), still_truth(speed=1.0), Sensors(surge_noise=0.04))[0]["surge"]
    slow = measure(np.random.default_rng(0), still_truth(speed=0.05), Sensors(surge_noise=0.04))[0]["surge"]
    ticks = fast.value / 0.05
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-9)
    assert len(np.unique(np.round(ticks))) > 3
    assert np.mean(np.abs(slow.value / 0.05 - np.round(slow.value / 0.05)) < 1e-6) < 0.01
    # an exponential filter of pole p leaves sqrt((1-p)/(1+p)) of white noise: 0.22 here
    assert np.std(slow.value) == pytest.approx(0.04 * 0.2236, rel=0.15)


def test_stamps_are_asynchronous_jittered_and_ranked_by_arrival():
    sensors = Sensors(lost_share=0.0, outages_per_hour=0.0)
    channels, _ = measure(np.random.default_rng(3), still_truth(20), sensors)
    for name, hz in (("command_left", 4), ("heading", 10), ("surge", 5)):
        period = np.diff(channels[name].time)
        assert period.min() > 0
        assert np.mean(period) == pytest.approx(1 / hz, rel=1e-3)
        assert 0.002 < np.std(period) < 0.012  # jitter within +-0.01 s: sqrt(2)*0.01/sqrt(3) = 0.0082
        assert (np.diff(channels[name].order) > 0).all()
    stamps = [set(channel.time.tolist()) for channel in channels.values()]
    assert len(set.union(*stamps)) == sum(map(len, stamps))
    orders = np.concatenate([channel.order for channel in channels.values()])
    assert np.array_equal(np.sort(orders), np.arange(orders.size))
    times = np.concatenate([channel.time for channel in channels.values()])[np.argsort(orders)]
    assert (np.diff(times) < 0).any()  # latency makes some arrive after younger ones of other channels,
    assert np.diff(times).min() > -0.03  # but never by more than the latency


def test_lost_messages_are_counted_and_outages_leave_gaps():
    truth = still_truth(60)
    whole, none = measure(np.random.default_rng(4), truth, Sensors(**PERFECT))
    some, long = (Sensors(lost_share=0.02, outages_per_hour=0.0), Sensors(lost_share=0.0, outages_per_hour=20.0))
    singles, counted = measure(np.random.default_rng(4), truth, some)
    outages, gone = measure(np.random.default_rng(4), truth, long)
    for name in whole:
        n = whole[name].time.size
        assert none[name] == {"lost": 0, "outage": 0}
        assert counted[name] == {"lost": n - singles[name].time.size, "outage": 0}
        assert counted[name]["lost"] == pytest.approx(0.02 * n, abs=5 * math.sqrt(0.02 * n))
        assert gone[name] == {"lost": 0, "outage": n - outages[name].time.size}
        assert 2.0 < np.diff(outages[name].time).max() < 17.0  # two may overlap
        assert np.diff(singles[name].time).max() < 2.0


def test_outliers_have_a_heavy_tail():
    def errors(share):
        sensors = Sensors(surge_noise=0.04, outlier_share=share)
        return measure(np.random.default_rng(6), still_truth(60), sensors)[0]["surge"].value - 1.0

    def kurtosis(x):
        return np.mean(x**4) / np.mean(x**2) ** 2

    white, real = errors(0.0), errors(0.01)
    assert kurtosis(white) == pytest.approx(3.0, abs=0.3)
    assert kurtosis(real) > 10
    # Gaussian outliers of the same scale would stay below 4 sigma
    assert np.abs(white).max() < 0.25 and np.abs(real).max() > 4 * 0.4
    assert 0.003 < np.mean(np.abs(real) > 0.25) < 0.008  # 1 % times the chance that |t| > 0.6: 0.6


def test_commands_posted_on_change_are_held_and_rebuild_the_course():
    course = np.repeat(np.array([[0.0, 0.1], [0.5, 0.1], [0.2, 0.3], [0.2, 0.0]]), 100, axis=0)
    truth = still_truth(100 / 60)._replace(commands=course)
    channels, _ = measure(np.random.default_rng(0), truth, Sensors(commands="on_change", **PERFECT))
    left, right = channels["command_left"], channels["command_right"]
    assert left.held and right.held and not channels["surge"].held
    assert (left.time.tolist(), left.value.tolist()) == ([0.0, 25.0, 50.0], [0.0, 0.5, 0.2])
    assert (right.time.tolist(), right.value.tolist()) == ([0.0, 50.0, 75.0], [0.1, 0.3, 0.0])
    periodic, _ = measure(np.random.default_rng(0), truth, Sensors(**PERFECT))
    assert not periodic["command_left"].held
    np.testing.assert_array_equal(periodic["command_left"].value, course[:, 0])


def test_heading_is_a_compass():
    truth = still_truth(1)._replace(heading=np.linspace(0, 40, 601))
    heading = measure(np.random.default_rng(0), truth, Sensors(heading_noise=0.0))[0]["heading"]
    assert 0 <= heading.value.min() and heading.value.max() < 2 * math.pi
    np.testing.assert_allclose(
        np.unwrap(heading.value), np.interp(heading.time, np.linspace(0, 60, 601), truth.heading)
    )


# ---- the missions


@pytest.mark.parametrize("kind", MISSIONS)
def test_missions_are_seeded_and_excite(kind):
    first, again, other = (MISSIONS[kind](np.random.default_rng(seed), 3600, 4.0) for seed in (0, 0, 1))
    assert all(np.array_equal(x, y, equal_nan=True) for x, y in zip(first, again, strict=True))
    assert not np.array_equal(first.heading, other.heading)
    assert first.power[0] == first.power[-1] == 0 and set(first.power) == {0.0, 1.0}
    speeds = first.throttle if np.isnan(first.surge).all() else first.surge
    assert np.std(speeds[first.power > 0]) > 0.1
    assert np.ptp(first.turn if np.isnan(first.heading).all() else first.heading) > 0.9


def test_paused_and_aborted():
    ahead = Mission(*np.ones((5, 1000)))
    idle = np.flatnonzero(paused(np.random.default_rng(0), ahead).power == 0)
    assert 100 <= idle.size <= 250 and 250 <= idle[0] and idle[-1] < 999
    short = aborted(np.random.default_rng(0), ahead, 4.0, coast=15.0)
    assert 300 <= short.power.size <= 800 and all(leaf.size == short.power.size for leaf in short)
    assert short.power[-60:].sum() == 0 and short.power[-61] == 1
    assert ahead.power.all()  # the mission itself is left as it was


def test_autopilot_reaches_speed_and_heading():
    ticks = 240
    course = Mission(
        np.full(ticks, 0.6), np.zeros(ticks), np.repeat([0.0, -2.0], ticks // 2), np.ones(ticks), np.zeros(ticks)
    )
    zero = tensor(0.0)
    for name in PLANTS:
        vessel = plant(name)
        _, surge, heading, commands = sail(vessel, [[course]], zero, zero, Autopilot())
        top = steady_surge(vessel, tensor([1.0, 1.0])).item()
        assert surge[-24:].numpy() == pytest.approx(0.6 * top, rel=0.05), name
        assert heading[-24:].numpy() == pytest.approx(-2.0, abs=0.25), name
        assert 0 <= commands.min() and commands.max() <= 1


@pytest.mark.parametrize("name", PLANTS)
def test_compiled_sailing_is_steering_and_stepping_one_after_the_other(name):
    """Two missions of two boats, a current, a plant that changes on the way: against a loop over `simulate`."""
    pilot = Autopilot(lowest=-1.0)
    courses = [[mission(np.random.default_rng(k), 200, pilot.hz) for k in range(2)] for mission in (MISSIONS["convoy"],
               MISSIONS["station_keeping"])]  # fmt: skip
    before = fleet_vessels(2, plant=name, missions=2)
    after = before._replace(mass=2 * before.mass)
    current, direction = tensor([[0.2], [0.3]]), tensor([[0.5], [2.5]])
    dt, surge, heading, commands = sail(before, courses, current, direction, pilot, {120: after})

    reference = torch.from_numpy(np.stack([[np.stack(course) for course in row] for row in courses]))
    leaves = reference.permute(2, 3, 0, 1)  # leaves, ticks, missions, boats
    state, integral = at_rest((2, 2), heading=leaves[2, 0]), torch.zeros(2, 2, dtype=torch.float64)
    top = steady_surge(before, tensor([1.0, 1.0]))
    for k in range(200):
        wanted, throttle, course, power, _ = leaves[:, k]
        over = over_ground(state.surge, state.heading, current, direction)
        error = torch.where(wanted.isnan(), 0.0, wanted - over / top)
        charged = (integral + pilot.integral / pilot.hz * error).clamp(-1, 1)
        integral = torch.where(wanted.isnan(), throttle, charged)
        throttle = (integral + pilot.proportional * error).clamp(-1, 1)
        away = torch.atan2((course - state.heading).sin(), (course - state.heading).cos())
        turn = (pilot.heading * away).clamp(-pilot.turn_max, pilot.turn_max)
        command = (
            torch.stack([throttle + turn, throttle - turn], -1).clamp(-1, 1) * power[..., None] * 100
        ).round() / 100
        assert torch.allclose(commands[k], command, rtol=0, atol=1e-12), k
        for i in range(3):
            assert torch.allclose(
                surge[3 * k + i], over_ground(state.surge, state.heading, current, direction), atol=1e-12
            )
            assert torch.allclose(heading[3 * k + i], state.heading, rtol=0, atol=1e-12)
            states = simulate(before if k < 120 else after, state, command[None], dt)
            state = tree_map(lambda x: x[0], states)


def test_boats_back_up_only_where_they_may():
    course = MISSIONS["station_keeping"](np.random.default_rng(0), 240, 4.0)
    zero = tensor(0.0)
    ahead = sail(plant("heron"), [[course]], zero, zero, Autopilot())[1]
    astern = sail(plant("heron"), [[course]], zero, zero, Autopilot(lowest=-1.0))[1]
    assert ahead.min() >= 0 and astern.min() < -0.2


# ---- the fleet


def test_same_seed_same_bits_and_boats_do_not_depend_on_their_number():
    options = {"hours": 0.04, "mission_minutes": 1.2, "seed": 7}
    four, again = fleet(n=4, **options), fleet(n=4, **options)
    assert same(four, again)
    assert same(four, fleet(n=8, **options)[: len(four)])
    assert not same(four, fleet(n=4, **options | {"seed": 8}))
    assert [r.boat for r in four] == ["heron1"] * 2 + ["heron2"] * 2 + ["heron3"] * 2 + ["heron4"] * 2
    assert [r.run[:3] for r in four[:4]] == ["001", "002", "001", "002"]


def test_drawing_does_not_touch_the_global_generators():
    np_state, torch_state = np.random.get_state()[1].copy(), torch.get_rng_state()
    fleet(n=1, hours=0.02)
    assert np.array_equal(np_state, np.random.get_state()[1])
    assert torch.equal(torch_state, torch.get_rng_state())


@pytest.mark.parametrize("spread", [0.0, 0.5, 1.0])
def test_fleet_spread_stays_within_its_bounds(spread):
    vessels, heron = fleet_vessels(200, spread, "heron", seed=3, missions=5, drift=1.0), plant("heron")
    factors = {
        "mass": (vessels.mass / heron.mass, 1.0, 1 + 0.25 * spread),
        "left": (vessels.thrust_table[:, :, 0, -1] / 33.6, 1 - 0.3 * spread, 1 + 0.3 * spread),
        "right": (vessels.thrust_table[:, :, 1, -1] / 33.6, 1 - 0.3 * spread, 1 + 0.3 * spread),
        "drag": (vessels.drag_linear / heron.drag_linear, 1 - 0.2 * spread, 1 + 0.2 * spread),
    }
    for name, (factor, low, high) in factors.items():
        assert factor.shape == (5, 200)
        assert low - 1e-12 <= factor.min() and factor.max() <= high + 1e-12, name
        assert factor.max() - factor.min() >= 0.9 * (high - low) - 1e-12, name  # and fills them
    moved = (vessels.mass[-1] - vessels.mass[0]).abs().max()
    assert (moved > 1) == (spread > 0)
    torch.testing.assert_close(vessels.mass.diff(dim=0)[0], vessels.mass.diff(dim=0)[-1])  # steadily
    with_less = fleet_vessels(200, spread, "heron", seed=3, missions=5, drift=0.0)
    assert torch.equal(with_less.mass[0], with_less.mass[-1])


def test_current_shows_in_the_speed_over_ground():
    headings = tensor([0.0, math.pi / 2, math.pi])
    seen = over_ground(tensor(1.0), headings, tensor(0.4), tensor(math.pi / 2))
    assert seen.tolist() == pytest.approx([1.0, 1.4, 1.0])
    course = MISSIONS["patrol"](np.random.default_rng(0), 400, 4.0)  # open throttle: no feedback of the speed
    river = tensor([0.0, 0.4])
    _, surge, heading, _ = sail(plant("heron"), [[course, course]], river, tensor(0.7), Autopilot())
    assert torch.equal(heading[..., 0], heading[..., 1]) and heading.std() > 0.3
    torch.testing.assert_close(surge[..., 1] - surge[..., 0], 0.4 * torch.cos(0.7 - heading[:, :, 0]))
    options = {"n": 1, "hours": 0.03, "missions": ["patrol"], "seed": 1}
    logged = [fleet(current=current, **options)[0].channels["surge"].value for current in (0.0, 0.6)]
    assert np.abs(logged[1] - logged[0]).mean() > 0.03


def test_missions_are_dealt_and_convoys_share_their_course():
    names, courses = fleet_missions(3, [400] * 8, 4.0, seed=0, aborted_share=0.0, paused_share=0.0)
    kinds = [name[4:] for name in names]
    assert sorted(kinds) == sorted(2 * list(USUAL))
    for kind, row in zip(kinds, courses, strict=True):
        assert np.array_equal(row[0].heading, row[1].heading) == (kind == "convoy")
    _, all_short = fleet_missions(3, [400] * 4, 4.0, seed=0, aborted_share=1.0)
    assert all(course.power.size <= 320 for row in all_short for course in row)


def test_hours_are_shared_out_and_aborted_missions_are_cut():
    logs = fleet(n=1, hours=0.04, mission_minutes=1.0, aborted_share=0.0)
    last = [log.channels["heading"].time[-1] for log in logs]
    assert last == pytest.approx([60.0, 60.0, 24.0], abs=0.5)
    short = fleet(n=1, hours=1 / 60, mission_minutes=1.0, aborted_share=1.0)[0]
    assert 0.3 * 60 - 1 < short.channels["heading"].time[-1] < 0.8 * 60


@pytest.mark.parametrize("name", PLANTS)
def test_an_hour_of_every_plant_is_finite(name):
    top = steady_surge(plant(name), tensor([1.0, 1.0])).item()
    logs = fleet(n=1, hours=1.0, plant=name, mission_minutes=1.5, sensors=Sensors(outlier_share=0.0))
    assert len(logs) == 40 and {log.boat for log in logs} == {name}
    for log in logs:
        assert all(np.isfinite(column).all() for c in log.channels.values() for column in (c.time, c.value))
    surge = np.concatenate([log.channels["surge"].value for log in logs])
    # up to 1.3 of the thrust, 0.8 of the drag, 0.3 m/s of current, five sigma of noise
    assert -0.3 - 0.2 - 0.025 < surge.min() and 0.6 * top < surge.max() < 1.625 * top + 0.3 + 0.2 + 0.025


@pytest.mark.parametrize("commands", ["periodic", "on_change"])
def test_most_steps_of_a_default_run_are_measured(commands):
    logs = fleet(n=2, hours=0.3, mission_minutes=2.0, sensors=Sensors(commands=commands))
    samples = [align(log.channels, dt=0.4).samples for log in logs]
    assert np.concatenate([s.measured for s in samples]).mean() > 0.93


def test_the_same_boats_sail_another_season():
    first, other = (
        true_parameters(28.0, 3, "heron", hours=1.0, mission_minutes=30.0, seed=seed, fleet_seed=fleet_seed)
        for seed, fleet_seed in ((1, None), (2, 1))
    )
    for boat, parameters in first.items():
        for name, value in parameters.items():  # fits of the same boat, so equal but for rounding
            np.testing.assert_allclose(other[boat][name], value, rtol=1e-9, atol=1e-9)
    logs = [
        fleet(n=1, hours=0.05, seed=seed, fleet_seed=fleet_seed)[0]
        for seed, fleet_seed in ((1, None), (1, 1), (2, 1), (2, None))
    ]
    surges = [log.channels["surge"].value for log in logs]
    assert np.array_equal(surges[0], surges[1])  # the season's own
    assert not np.array_equal(surges[0][:50], surges[2][:50]) and not np.array_equal(surges[2], surges[3])
