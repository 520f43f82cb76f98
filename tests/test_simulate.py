"""The simulator against closed forms, and its logs against what they were asked to hold."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from usvlearn.errors import ConfigError
from usvlearn.logs.align import align
from usvlearn.simulate.autopilot import Autopilot
from usvlearn.simulate.fleet import fleet, fleet_missions, fleet_vessels, sail
from usvlearn.simulate.plants import PLANTS, plant
from usvlearn.simulate.scenario import MISSIONS, Mission, aborted, paused
from usvlearn.simulate.sensors import Sensors, Truth, measure
from usvlearn.simulate.vessel import (
    at_rest,
    drag,
    over_ground,
    simulate,
    static_thrust,
    steady_surge,
    step,
    thrust,
)

pytestmark = pytest.mark.filterwarnings("error")

PERFECT = {"jitter": 0.0, "latency": 0.0, "lost_share": 0.0, "outages_per_hour": 0.0, "outlier_share": 0.0}


def tensor(x):
    return torch.tensor(x, dtype=torch.float64)


def same(x, y):
    """Whether two lists of recordings hold the same bits."""
    return [(r.boat, r.run, r.dropped) for r in x] == [(r.boat, r.run, r.dropped) for r in y] and all(
        np.array_equal(p, q)
        for r, s in zip(x, y, strict=True)
        for name in r.channels
        for p, q in zip(r.channels[name][:3], s.channels[name][:3], strict=True)
    )


def still_truth(minutes=60.0, speed=1.0, dt=0.1):
    """A boat that goes north at a constant speed."""
    steps = round(minutes * 60 / dt)
    commands = np.round(np.random.default_rng(5).random((round(minutes * 240), 2)), 2)
    return Truth(dt, np.full(steps + 1, speed), np.full(steps + 1, 0.3), 0.25, commands)


# ---- the vessel


@pytest.mark.parametrize(
    ("name", "top"),
    [  # maker's and identifiers' figures; for the others the root of the force balance by hand
        ("heron", 2.74),
        ("kingfisher", 1.5),
        ("vtec", (64.55 + math.sqrt(64.55**2 + 4 * 70.92 * 36.5 * 1.78)) / (2 * 70.92)),
        ("otter", 2 * 0.01108 * 103.9**2 / 77.56),
        ("wamv", (-51.3 + math.sqrt(51.3**2 + 4 * 72.4 * 4708)) / (2 * 72.4)),
    ],
)
def test_top_speed(name, top):
    assert steady_surge(plant(name), tensor([1.0, 1.0])).item() == pytest.approx(top, abs=5e-3)


@pytest.mark.parametrize(
    ("name", "surge", "force"),
    [
        ("heron", 2.0, 16.45 * 2 + 2.942 * 4),
        ("heron", -1.0, -(16.45 + 2.942)),
        ("kingfisher", 1.2, 17.26 * 1.44),
        ("vtec", 1.1, 25 * 1.1),
        ("vtec", 1.3, -64.55 * 1.3 + 70.92 * 1.69),
        ("vtec", -1.3, -(-64.55 * 1.3 + 70.92 * 1.69)),
        ("otter", 1.5, 77.56 * 1.5),
        ("wamv", 4.0, 51.3 * 4 + 72.4 * 16),
    ],
)
def test_drag_at_given_speeds(name, surge, force):
    assert drag(plant(name), tensor(surge)).item() == pytest.approx(-force, rel=1e-12)


def test_turning_brakes_ahead_and_astern():
    heron = plant("heron")
    for surge in (1.0, -1.0):
        extra = drag(heron, tensor(surge), tensor(0.5)) - drag(heron, tensor(surge))
        assert extra.item() == pytest.approx(-8.0 * 0.5 * surge)


@pytest.mark.parametrize("name", PLANTS)
def test_steady_speed_is_the_root_of_the_force_balance(name):
    vessel = plant(name)._replace(yaw_gain=tensor(0.0))  # straight ahead, though VTec's sides differ
    both = tensor([[0.5, 0.5], [0.85, 0.85], [1.0, 1.0]])
    reached = simulate(vessel, at_rest((3,)), both.expand(600, 3, 2), 0.1).surge[-1]
    balance = drag(vessel, reached) + thrust(vessel, both, reached).sum(-1)
    assert (abs(balance) < 1e-6 * abs(drag(vessel, reached))).all()
    torch.testing.assert_close(reached, steady_surge(vessel, both), rtol=1e-6, atol=0)


def test_free_decay_equals_the_closed_form():
    vessel, dt = plant("heron"), 0.1
    a, b, m, start = 16.45, 2.942, 28.0, 2.5
    time = torch.arange(1, 201, dtype=torch.float64) * dt
    decay = torch.exp(-a * time / m)
    expected = a * start * decay / (a + b * start * (1 - decay))
    state = at_rest()._replace(surge=tensor(start))
    surge = simulate(vessel, state, torch.zeros(200, 2, dtype=torch.float64), dt).surge
    # local error of RK4 ~ v (rate dt)^5/120, rate = (a + 2 b v)/m = 1.1: 1e-7, damped
    torch.testing.assert_close(surge, expected, rtol=0, atol=1e-6)


def test_thruster_lag_is_exponential():
    vessel = plant("heron")._replace(lag=tensor(0.4))
    shaft = simulate(vessel, at_rest(), tensor([0.8, -0.5]).expand(30, 2), 0.1).shaft
    time = torch.arange(1, 31, dtype=torch.float64) * 0.1
    expected = (1 - torch.exp(-time / 0.4))[:, None] * tensor([0.8, -0.5])
    torch.testing.assert_close(shaft, expected, rtol=1e-12, atol=0)


def test_yaw_rate_and_heading_are_exact_under_a_settled_thrust():
    vessel = plant("heron")
    state = at_rest()._replace(shaft=tensor([1.0, 0.0]))  # one side full ahead: 0.6 rad/s
    states = simulate(vessel, state, tensor([1.0, 0.0]).expand(40, 2), 0.1)
    time = torch.arange(1, 41, dtype=torch.float64) * 0.1
    lead = 1 - torch.exp(-time / 0.5)
    torch.testing.assert_close(states.yaw_rate, 0.6 * lead)
    torch.testing.assert_close(states.heading, 0.6 * (time - 0.5 * lead))


def test_dead_band_and_saturation():
    kingfisher = plant("kingfisher")
    inside = torch.linspace(-0.4, 0.2, 25, dtype=torch.float64)
    assert static_thrust(kingfisher, torch.stack((inside, inside), -1)).abs().max() < 1e-12
    assert static_thrust(kingfisher, tensor([-0.45, 0.25])).tolist() == pytest.approx([-0.5, 0.25])
    assert static_thrust(kingfisher, tensor([-9.0, 9.0])).tolist() == [-4.0, 19.5]


def test_table_is_interpolated_and_the_papers_terms_are_added():
    heron = plant("heron")
    nodes = torch.linspace(-1, 1, 11, dtype=torch.float64)
    both = torch.stack((nodes, nodes), -1)
    torch.testing.assert_close(static_thrust(heron, both), heron.thrust_table.T, rtol=0, atol=1e-12)
    vessel = heron._replace(
        thrust_table=0 * heron.thrust_table,
        thrust_linear=tensor([3.0, 4.0]),
        thrust_quadratic=tensor([5.0, 6.0]),
        thrust_speed=tensor([-1.0, -2.0]),
    )
    got = thrust(vessel, tensor([0.5, -0.5]), tensor(2.0))
    assert got.tolist() == pytest.approx([1.5 + 1.25 - 1.0, -2.0 - 1.5 + 2.0])


def test_gradients_of_the_trajectory_equal_finite_differences():
    rng = torch.Generator().manual_seed(0)
    # away from the table's nodes, where the curve has corners
    commands = (
        0.2 * torch.randint(0, 5, (12, 2), generator=rng) + 0.1 + 0.05 * torch.rand(12, 2, generator=rng)
    )
    fields = ("mass", "drag_quadratic", "drag_linear", "drag_cross", "thrust_table", "lag", "thrust_speed")
    heron = plant("heron")._replace(thrust_speed=tensor([-1.0, -2.0]))

    def trajectory(*leaves):
        vessel = heron._replace(**dict(zip(fields, leaves, strict=True)))
        states = simulate(vessel, at_rest()._replace(surge=tensor(1.0)), commands.double(), 0.2)
        return torch.cat((states.surge, states.heading))

    leaves = [getattr(heron, name).clone().requires_grad_() for name in fields]
    assert torch.autograd.gradcheck(trajectory, leaves, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_a_batch_equals_its_lanes(batch):
    rng = torch.Generator().manual_seed(1)
    heron = plant("heron")
    mass = 28 + 5 * torch.rand(batch, generator=rng, dtype=torch.float64)
    table = heron.thrust_table * (1 + torch.rand((*batch, 2, 1), generator=rng, dtype=torch.float64))
    commands = 2 * torch.rand((40, *batch, 2), generator=rng, dtype=torch.float64) - 1
    together = simulate(heron._replace(mass=mass, thrust_table=table), at_rest(batch), commands, 0.1)
    for lane in np.ndindex(batch):
        vessel = heron._replace(mass=mass[lane], thrust_table=table[lane])
        alone = simulate(vessel, at_rest(), commands[(slice(None), *lane)], 0.1)
        torch.testing.assert_close(together.surge[(slice(None), *lane)], alone.surge, rtol=1e-12, atol=1e-14)
        torch.testing.assert_close(
            together.heading[(slice(None), *lane)], alone.heading, rtol=1e-12, atol=1e-14
        )


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("dt", [0.05, 0.1])
def test_every_plant_is_stable_under_violent_commands(name, dt):
    vessel, rng = plant(name), torch.Generator().manual_seed(2)
    top = steady_surge(vessel, tensor([1.0, 1.0]))
    state, fastest = at_rest(), 0.0
    for _ in range(150):
        state = step(vessel, state, 2 * torch.rand(2, generator=rng, dtype=torch.float64).round() - 1, dt)
        fastest = max(fastest, abs(state.surge.item()))
    assert 0 < fastest <= top.item() * (1 + 1e-9)


# ---- the sensors


def test_speed_lies_on_the_grid_and_the_filter_is_finer_below():
    fast = measure(np.random.default_rng(0), still_truth(speed=1.0), Sensors())[0]["surge"]
    slow = measure(np.random.default_rng(0), still_truth(speed=0.05), Sensors())[0]["surge"]
    ticks = fast.value / 0.05
    np.testing.assert_allclose(ticks, np.round(ticks), atol=1e-9)
    assert len(np.unique(np.round(ticks))) > 3
    assert np.mean(np.abs(slow.value / 0.05 - np.round(slow.value / 0.05)) < 1e-6) < 0.01
    # an exponential filter of pole p leaves sqrt((1-p)/(1+p)) of white noise: 0.22 here
    assert np.std(slow.value) == pytest.approx(0.04 * 0.2236, rel=0.15)


def test_stamps_are_asynchronous_jittered_and_ranked_by_arrival():
    channels, _ = measure(
        np.random.default_rng(3), still_truth(20), Sensors(lost_share=0.0, outages_per_hour=0.0)
    )
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
    singles, counted = measure(
        np.random.default_rng(4), truth, Sensors(lost_share=0.02, outages_per_hour=0.0)
    )
    outages, gone = measure(np.random.default_rng(4), truth, Sensors(lost_share=0.0, outages_per_hour=20.0))
    for name in whole:
        n = whole[name].time.size
        assert none[name] == {"lost": 0, "outage": 0}
        assert counted[name] == {"lost": n - singles[name].time.size, "outage": 0}
        assert counted[name]["lost"] == pytest.approx(0.02 * n, abs=5 * math.sqrt(0.02 * n))
        assert gone[name] == {"lost": 0, "outage": n - outages[name].time.size}
        assert 2.0 < np.diff(outages[name].time).max() < 17.0  # two may overlap
        assert np.diff(singles[name].time).max() < 2.0


def test_outliers_have_a_heavy_tail():
    def kurtosis(share):
        sensors = Sensors(outlier_share=share)
        x = measure(np.random.default_rng(6), still_truth(60), sensors)[0]["surge"].value - 1.0
        return np.mean(x**4) / np.mean(x**2) ** 2

    assert kurtosis(0.0) == pytest.approx(3.0, abs=0.3)
    assert kurtosis(0.01) > 10


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


@pytest.mark.parametrize(
    ("options", "name"),
    [({"commands": "often"}, "commands"), ({"surge_hz": 0}, "surge_hz"), ({"jitter": 0.2}, "jitter"),
     ({"lost_share": 2.0}, "lost_share"), ({"outage": [3.0, 1.0]}, "outage")],
)  # fmt: skip
def test_sensors_out_of_range_are_refused_by_name(options, name):
    with pytest.raises(ConfigError, match=name):
        Sensors(**options)


# ---- the missions


@pytest.mark.parametrize("kind", MISSIONS)
def test_missions_are_seeded_and_excite(kind):
    first, again, other = (MISSIONS[kind](np.random.default_rng(seed), 3600, 4.0) for seed in (0, 0, 1))
    assert all(np.array_equal(x, y, equal_nan=True) for x, y in zip(first, again, strict=True))
    assert not np.array_equal(first.heading, other.heading)
    assert first.power[0] == first.power[-1] == 0 and set(first.power) == {0.0, 1.0}
    speeds = first.throttle if np.isnan(first.surge).all() else first.surge
    assert np.std(speeds[first.power > 0]) > 0.1
    assert np.ptp(first.heading) > 1.0


def test_paused_and_aborted():
    ahead = Mission(*np.ones((4, 1000)))
    idle = np.flatnonzero(paused(np.random.default_rng(0), ahead).power == 0)
    assert 100 <= idle.size <= 250 and 250 <= idle[0] and idle[-1] < 999
    short = aborted(np.random.default_rng(0), ahead, 4.0, coast=15.0)
    assert 300 <= short.power.size <= 800 and all(leaf.size == short.power.size for leaf in short)
    assert short.power[-60:].sum() == 0 and short.power[-61] == 1
    assert ahead.power.all()  # the mission itself is left as it was


def test_autopilot_reaches_speed_and_heading():
    ticks = 240
    course = Mission(np.full(ticks, 0.6), np.zeros(ticks), np.repeat([0.0, -2.0], ticks // 2), np.ones(ticks))
    zero = tensor(0.0)
    for name in PLANTS:
        vessel = plant(name)
        _, surge, heading, commands = sail(vessel, [[course]], zero, zero, Autopilot())
        top = steady_surge(vessel, tensor([1.0, 1.0])).item()
        assert surge[-24:].numpy() == pytest.approx(0.6 * top, rel=0.05), name
        assert heading[-24:].numpy() == pytest.approx(-2.0, abs=0.25), name
        assert 0 <= commands.min() and commands.max() <= 1


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
    assert np.array_equal(np_state, np.random.get_state()[1]) and torch.equal(
        torch_state, torch.get_rng_state()
    )


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
    torch.testing.assert_close(
        vessels.mass[2] - vessels.mass[1], vessels.mass[1] - vessels.mass[0]
    )  # steadily
    with_less = fleet_vessels(200, spread, "heron", seed=3, missions=5, drift=0.0)
    assert torch.equal(with_less.mass[0], with_less.mass[-1])


def test_current_shows_in_the_speed_over_ground():
    headings = tensor([0.0, math.pi / 2, math.pi])
    seen = over_ground(tensor(1.0), headings, tensor(0.4), tensor(math.pi / 2))
    assert seen.tolist() == pytest.approx([1.0, 1.4, 1.0])
    course = MISSIONS["patrol"](
        np.random.default_rng(0), 400, 4.0
    )  # open throttle: does not feel the current
    _, surge, heading, _ = sail(
        plant("heron"), [[course, course]], tensor([0.0, 0.4]), tensor(0.7), Autopilot()
    )
    assert torch.equal(heading[..., 0], heading[..., 1]) and heading.std() > 0.3
    torch.testing.assert_close(surge[..., 1] - surge[..., 0], 0.4 * torch.cos(0.7 - heading[:, :, 0]))
    options = {"n": 1, "hours": 0.03, "missions": ["patrol"], "seed": 1}
    logged = [fleet(current=current, **options)[0].channels["surge"].value for current in (0.0, 0.6)]
    assert np.abs(logged[1] - logged[0]).mean() > 0.03


def test_missions_are_dealt_and_convoys_share_their_course():
    names, courses = fleet_missions(3, [400] * 8, 4.0, seed=0, aborted_share=0.0, paused_share=0.0)
    kinds = [name[4:] for name in names]
    assert sorted(kinds) == sorted(2 * list(MISSIONS))
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


@pytest.mark.parametrize(
    ("options", "name"),
    [({"hours": 0.0}, "hours"), ({"plant": "canoe"}, "plant"), ({"missions": ["race"]}, "missions"),
     ({"current": -1.0}, "current")],
)  # fmt: skip
def test_fleet_refuses_by_name(options, name):
    with pytest.raises(ConfigError, match=name):
        fleet(**options)
