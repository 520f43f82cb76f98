"""Gusts, open commands and a speed that sticks: what they do to a simulated boat, against closed forms."""

import math

import numpy as np
import pytest
import torch

from tests.support.recordings import same
from usvlearn.simulate.autopilot import Autopilot
from usvlearn.simulate.fleet import fleet, sail
from usvlearn.simulate.gusts import Gusts
from usvlearn.simulate.plants import plant
from usvlearn.simulate.scenario import Mission, random_commands
from usvlearn.simulate.sensors import Sensors

ZERO = torch.zeros((), dtype=torch.float64)
SHORT = {"n": 2, "hours": 0.05, "seed": 4, "aborted_share": 0.0, "paused_share": 0.0}


def blown(gusts, direction, ticks=480, heading=0.0):
    """An Otter, whose drag is linear, without thrust: surge and heading at multiples of 1/12 s."""
    none, zero = np.full(ticks, np.nan), np.zeros(ticks)
    share = np.sin(math.pi * (np.arange(ticks) / 4 / 20).clip(0, 1)) ** 2  # 20 s
    wind = share[:, None] * [math.cos(direction), math.sin(direction)]
    course = Mission(none, zero, none, np.ones(ticks), zero)
    _, surge, found, _ = sail(plant("otter"), [[course]], ZERO, ZERO, Autopilot(), None, gusts, wind[:, None, None])
    return surge[:, 0, 0].numpy(), found[:, 0, 0].numpy()


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
    calm = fleet(**SHORT)
    assert same(calm, fleet(**SHORT, gusts=Gusts(per_hour=0.0)))
    assert same(fleet(**SHORT, gusts=Gusts(200.0)), fleet(**SHORT, gusts=Gusts(200.0)))
    stormy = fleet(**SHORT, gusts=Gusts(200.0))
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
    calm, stuck = fleet(**SHORT), fleet(**SHORT, sensors=Sensors(stuck=(60.0, 20.0)))
    for before, after in zip(calm, stuck, strict=True):
        time, value = after.channels["surge"].time, after.channels["surge"].value
        sticks = (time >= 60) & (time < 80)
        assert len(set(value[sticks])) == 1 and np.ptp(before.channels["surge"].value[sticks]) > 0
        assert np.array_equal(value[~sticks], before.channels["surge"].value[~sticks])
