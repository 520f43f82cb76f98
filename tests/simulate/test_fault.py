"""Faults, gusts and open commands: what they do to a simulated boat, against closed forms; and what is refused."""

import math

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from tests.support import ROOT
from tests.support.recordings import same
from usvlearn.errors import ConfigError
from usvlearn.simulate.autopilot import Autopilot
from usvlearn.simulate.example_logs import example_logs
from usvlearn.simulate.fault import Fault, faulty_vessels
from usvlearn.simulate.fleet import fleet, sail
from usvlearn.simulate.gusts import Gusts
from usvlearn.simulate.planar import HERON, simulate_planar
from usvlearn.simulate.plants import plant
from usvlearn.simulate.scenario import Mission, random_commands
from usvlearn.simulate.sensors import Sensors

SHORT = {"n": 2, "hours": 0.05, "mission_minutes": 1.5, "seed": 4, "aborted_share": 0.0, "paused_share": 0.0}


def test_nothing_differs_before_the_fault_and_all_missions_do_after():
    healthy, faulty = fleet(**SHORT), fleet(**SHORT, fault=Fault(minute=1.0))
    for before, after in zip(healthy, faulty, strict=True):
        both = [r.channels["heading"] for r in (before, after)]
        early = both[0].time < (60.0 if before.run.startswith("001") else 0.0)
        assert np.array_equal(both[0].time, both[1].time)
        assert np.array_equal(both[0].value[early], both[1].value[early])
        assert np.abs(both[0].value - both[1].value)[~early].max() > 0.1
    assert same(healthy, fleet(**SHORT, fault=Fault(minute=60.0)))  # after the season
    assert same(healthy, fleet(**SHORT, fault=Fault(share=1.0, minute=1.0)))


@pytest.mark.parametrize("side", ["left", "right"])
def test_speed_and_turn_settle_where_the_weaker_side_balances_the_drag(side):
    ticks = 400
    course = Mission(np.full(ticks, np.nan), np.full(ticks, 1.0), np.zeros(ticks), np.ones(ticks), np.zeros(ticks))
    zero = torch.zeros((), dtype=torch.float64)
    later = faulty_vessels(Fault(side, 0.4, 50 / 60), plant("heron"), [ticks], 4.0)
    assert list(later) == [200]
    deaf = Autopilot(heading=0.0)
    _, surge, heading, _ = sail(plant("heron"), [[course]], zero, zero, deaf, later)
    rate = 0.6 * (0.4 - 1) * (1 if side == "left" else -1)  # one side full ahead alone: 0.6 rad/s
    assert torch.diff(heading[-8:, 0, 0]).numpy() / (1 / 12) == pytest.approx(np.full(7, rate), abs=1e-6)
    linear = 16.45 + 8.0 * abs(rate)  # of the drag, then the root of 2.942 v² + linear v = thrust
    root = (-linear + math.sqrt(linear**2 + 4 * 2.942 * 1.4 * 33.6)) / (2 * 2.942)
    assert surge[-1].item() == pytest.approx(root, rel=1e-4)
    assert surge[590].item() == pytest.approx(2.741, abs=5e-3)  # before it the maker's top speed


def steady(fault, seconds=200):
    """The speed of a Heron at full ahead, long after a change at second 50; steps of 1/12 s."""
    ticks = 4 * seconds
    course = Mission(np.full(ticks, np.nan), np.full(ticks, 1.0), np.zeros(ticks), np.ones(ticks), np.zeros(ticks))
    zero = torch.zeros((), dtype=torch.float64)
    later = faulty_vessels(fault, plant("heron"), [ticks], 4.0)
    return sail(plant("heron"), [[course]], zero, zero, Autopilot(heading=0.0), later)[1][:, 0, 0].numpy()


def test_a_towed_body_slows_the_boat_to_the_root_of_the_larger_drag():
    root = (-1.5 * 16.45 + math.sqrt((1.5 * 16.45) ** 2 + 4 * 1.5 * 2.942 * 67.2)) / (2 * 1.5 * 2.942)
    assert steady(Fault(share=1.0, minute=50 / 60, drag=1.5))[-1] == pytest.approx(root, rel=1e-6)


def test_a_load_makes_the_boat_as_much_slower_to_start_and_leaves_its_speed():
    light, heavy = steady(Fault(share=1.0, minute=0.0)), steady(Fault(share=1.0, minute=0.0, mass=1.3))
    assert light[12] / heavy[12] == pytest.approx(1.3, rel=0.16)  # drag at 1 s: some 0.6 of 2.3 m/s² · 28 kg
    assert heavy[3] / light[3] == pytest.approx(1 / 1.3, rel=0.03)
    assert heavy[-1] == pytest.approx(2.741, abs=1e-3)


def test_thrust_that_comes_back_and_thrust_of_both_sides():
    gained = next(iter(faulty_vessels(Fault("both", 1.5, 0.0), plant("heron"), [40], 4.0).values()))
    assert gained.thrust_table[0, 0, :, -1].tolist() == pytest.approx([50.4, 50.4])


def test_wear_is_linear_in_time_and_goes_on_in_the_next_mission():
    ticks = [1200, 1200]  # two missions of 5 min; worn from minute 2 to 8
    later = faulty_vessels(Fault("right", 0.4, 2.0, over=6.0), plant("heron"), ticks, 4.0)
    for tick, vessel in later.items():
        for mission in (0, 1):
            gone = min(max((tick / 240 + 5 * mission - 2.0) / 6.0, 0.0), 1.0)
            left, right = vessel.thrust_table[mission, 0, :, -1].tolist()
            assert left == 33.6
            assert right / 33.6 == pytest.approx(1 - 0.6 * gone, abs=0.6 / 20 + 1e-3), (tick, mission)
    assert later[max(later)].thrust_table[1, 0, 1, -1].item() == pytest.approx(0.4 * 33.6)


@pytest.mark.thorough
def test_the_experiment_composes_and_has_its_fault():
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        plain = compose("train")
        cfg = compose("train", ["experiment=thruster_fault"])
        assert compose("train", ["experiment=none"]) == plain
    assert plain.data.fault is None
    assert instantiate(cfg.data.fault) == Fault("left", 0.4, 10.0)
    assert cfg.data.hours == pytest.approx(cfg.data.mission_minutes / 60)
    assert cfg.data.mission_minutes > cfg.data.fault.minute


ZERO = torch.zeros((), dtype=torch.float64)
CALM = {"n": 2, "hours": 0.05, "seed": 4, "aborted_share": 0.0, "paused_share": 0.0}


def blown(gusts, direction, ticks=480, heading=0.0):
    """An Otter, whose drag is linear, without thrust: surge and heading at multiples of 1/12 s."""
    none, zero = np.full(ticks, np.nan), np.zeros(ticks)
    share = np.sin(math.pi * (np.arange(ticks) / 4 / 20).clip(0, 1)) ** 2  # 20 s
    wind = share[:, None] * [math.cos(direction), math.sin(direction)]
    course = Mission(none, zero, none, np.ones(ticks), zero)
    _, surge, turned, _ = sail(plant("otter"), [[course]], ZERO, ZERO, Autopilot(), None, gusts, wind[:, None, None])
    return surge[:, 0, 0].numpy(), turned[:, 0, 0].numpy()


def test_a_gust_from_astern_carries_the_boat_as_far_as_its_impulse_over_the_drag():
    surge, heading = blown(Gusts(push=0.1, turn=0.0), 0.0)
    force = 0.1 * 2 * plant("otter").thrust_table[0, -1].item()
    assert surge.sum() / 12 == pytest.approx(force * 20 / 2 / 77.56, rel=2e-3)  # the mean of sin² is a half
    assert np.abs(heading).max() == 0


def test_a_gust_on_the_beam_turns_the_boat_by_its_yaw_rate_times_half_its_length():
    surge, heading = blown(Gusts(push=0.0, turn=0.01), math.pi / 2)
    assert heading[-1] == pytest.approx(0.01 * 20 / 2, rel=0.01)  # turned by 0.1 rad, its lever is 0.5 % shorter
    assert np.abs(surge).max() == 0


def test_gusts_are_seeded_and_nothing_else_changes():
    calm = fleet(**CALM)
    assert same(calm, fleet(**CALM, gusts=Gusts(per_hour=0.0)))
    assert same(fleet(**CALM, gusts=Gusts(200.0)), fleet(**CALM, gusts=Gusts(200.0)))
    stormy = fleet(**CALM, gusts=Gusts(200.0))
    for before, after in zip(calm, stormy, strict=True):
        assert np.array_equal(before.channels["heading"].time, after.channels["heading"].time)
        assert np.abs(before.channels["surge"].value - after.channels["surge"].value).max() > 0.05


def test_gusts_come_as_often_and_as_hard_as_they_say():
    hours = 200
    wind = Gusts(per_hour=6.0, seconds=(10.0, 10.0)).course(np.random.default_rng(0), hours * 3600, 1.0)
    # a gust of 10 s and of strength ½ in the mean has Σ w = 2.5; Poisson: 1200 ± 35 gusts
    assert np.hypot(*wind.T).sum() == pytest.approx(6 * hours * 2.5, rel=0.1)


def test_open_commands_are_posted_as_drawn_whatever_the_boat_does():
    course = random_commands(np.random.default_rng(3), 400, 4.0)
    commands = [
        sail(plant(name), [[course]], ZERO, ZERO, Autopilot())[3][:, 0, 0].numpy() for name in ("otter", "vtec")
    ]
    assert np.array_equal(*commands)
    drawn = np.stack([course.throttle + course.turn, course.throttle - course.turn], -1) * course.power[:, None]
    np.testing.assert_allclose(commands[0], drawn, atol=0.005 + 1e-9)  # of the resolution
    on = course.power > 0
    assert (
        abs(np.corrcoef(commands[0][on][::16].T)[0, 1]) < 0.6
    )  # 23 draws: |r| of independent ones is below .41 in 95 %


def test_a_speed_that_sticks_repeats_its_last_value_and_goes_on():
    calm, stuck = fleet(**CALM), fleet(**CALM, sensors=Sensors(stuck=(60.0, 20.0)))
    for before, after in zip(calm, stuck, strict=True):
        time, value = after.channels["surge"].time, after.channels["surge"].value
        sticks = (time >= 60) & (time < 80)
        assert len(set(value[sticks])) == 1 and np.ptp(before.channels["surge"].value[sticks]) > 0
        assert np.array_equal(value[~sticks], before.channels["surge"].value[~sticks])


WRONG = (
    (Fault, {"drag": 0.0, "over": -1.0, "side": "bow", "share": 2.5, "minute": -1.0}),
    (fleet, {"hours": 0.0, "plant": "canoe", "missions": ["race"], "current": -1.0}),
    (Gusts, {"per_hour": -1.0, "seconds": (5.0, 1.0), "minute": -1.0}),
    (Sensors, {"commands": "often", "surge_hz": 0, "jitter": 0.2, "lost_share": 2.0, "outage": [3.0, 1.0],
               "stuck": (1.0, -1.0)}),
    *((example_logs, {"minutes": minutes}) for minutes in (0.0, -1.0, float("nan"), 1e9)),
    (lambda dt: simulate_planar(HERON, np.zeros((1, 2)), dt), {"dt": 0.0}),
)  # fmt: skip


@pytest.mark.parametrize(("make", "name", "value"), [(make, *each) for make, wrong in WRONG for each in wrong.items()])
def test_what_is_out_of_range_is_refused_by_name(make, name, value):
    with pytest.raises(ConfigError, match=name):
        make(**{name: value})
