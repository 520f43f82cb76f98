"""Simulated vessels and plants against closed forms."""

from __future__ import annotations

import math
import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from usvlearn.simulate.fleet import simulate
from usvlearn.simulate.plants import PLANTS, plant
from usvlearn.simulate.vessel import at_rest, drag, static_thrust, steady_surge, thrust

pytestmark = pytest.mark.filterwarnings("error")


def tensor(x):
    return torch.tensor(x, dtype=torch.float64)


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
    boat = plant(name)
    assert drag(boat, tensor(surge)).item() == pytest.approx(-force, rel=1e-12)
    turning = drag(boat, tensor(surge), tensor(0.5)) - drag(boat, tensor(surge))
    assert boat.drag_cross < 0 and turning.item() == pytest.approx(0.5 * boat.drag_cross.item() * surge)


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


def test_momentum_is_the_impulse_of_the_lagging_thrust():
    vessel = plant("wamv")  # thrust is linear in the thruster speed
    none = {name: 0 * getattr(vessel, name) for name in ("drag_quadratic", "drag_linear", "drag_cross")}
    vessel = vessel._replace(lag=tensor(0.4), **none)
    surge = simulate(vessel, at_rest(), tensor([0.5, 0.5]).expand(30, 2), 0.1).surge
    time = torch.arange(1, 31, dtype=torch.float64) * 0.1
    torch.testing.assert_close(surge, 2354 / 180 * (time - 0.4 * (1 - torch.exp(-time / 0.4))))


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
    assert static_thrust(plant("heron"), tensor([-9.0, 9.0])).tolist() == [-19.88, 33.6]


@pytest.mark.parametrize(
    ("name", "command", "left", "right"),
    [
        ("otter", 0.5, 0.01108 * 51.95**2, 0.01108 * 51.95**2),
        ("otter", -1.0, -0.006445 * 101.7**2, -0.006445 * 101.7**2),
        ("vtec", 1.0, 36.5, 0.78 * 36.5),
        ("vtec", -0.5, -15.0, 0.78 * -15.0),
        ("wamv", -0.25, -588.5, -588.5),
    ],
)
def test_thrust_at_given_commands(name, command, left, right):
    got = static_thrust(plant(name), tensor([command, command]))
    assert got.tolist() == pytest.approx([left, right], rel=1e-9)


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


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_a_batch_equals_its_elements(batch):
    rng = torch.Generator().manual_seed(1)
    heron = plant("heron")
    mass = 28 + 5 * torch.rand(batch, generator=rng, dtype=torch.float64)
    table = heron.thrust_table * (1 + torch.rand((*batch, 2, 1), generator=rng, dtype=torch.float64))
    commands = 2 * torch.rand((40, *batch, 2), generator=rng, dtype=torch.float64) - 1
    together = simulate(heron._replace(mass=mass, thrust_table=table), at_rest(batch), commands, 0.1)
    for element in np.ndindex(batch):
        vessel = heron._replace(mass=mass[element], thrust_table=table[element])
        at = (slice(None), *element)
        alone = simulate(vessel, at_rest(), commands[at], 0.1)
        torch.testing.assert_close(together.surge[at], alone.surge, rtol=1e-12, atol=1e-14)
        torch.testing.assert_close(together.heading[at], alone.heading, rtol=1e-12, atol=1e-14)


@pytest.mark.thorough
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc fills memory with what MALLOC_PERTURB_ says")
def test_the_truth_is_the_same_whatever_memory_holds():
    """LAPACK's gelsy reads its pivots before it writes them: what other code left there changed the last digits."""
    code = (
        "from usvlearn.simulate.truth import true_parameters\n"
        "found = true_parameters(28.0, 3, 'heron', hours=0.5, mission_minutes=15.0, seed=1)\n"
        "print({boat: {name: x.tolist() for name, x in made.items()} for boat, made in found.items()})"
    )
    first, other = (
        subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"MALLOC_PERTURB_": fill},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for fill in ("255", "1")  # new memory is all zeros, or never zero
    )
    assert first == other
