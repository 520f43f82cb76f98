"""A thruster that fails in the simulator: the boat before it is the same, after it the force balance is another."""

import math

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from tests.support import ROOT
from tests.support.recordings import same
from usvlearn.simulate.autopilot import Autopilot
from usvlearn.simulate.fault import Fault, faulty_vessels
from usvlearn.simulate.fleet import fleet, sail
from usvlearn.simulate.plants import plant
from usvlearn.simulate.scenario import Mission

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
