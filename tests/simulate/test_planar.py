"""The boat in surge, sway and yaw: against an ODE solver, and what physics tells of it."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from usvlearn.simulate.planar import HERON, courses, planar_runs, rates, simulate_planar


def test_a_trajectory_is_that_of_an_ode_solver():
    rng = np.random.default_rng(0)
    commands = rng.uniform(-1, 1, (20, 2))
    path = simulate_planar(HERON, commands, 0.5, np.array([1.0, 0.1, -0.3]))
    y = np.array([1.0, 0.1, -0.3, 0.0, 0.0])
    for command, state in zip(commands, path, strict=True):

        def slope(_, y, command=command):
            return np.concatenate([rates(HERON, y[:3], y[3:]), (command - y[3:]) / HERON.lag])

        y = solve_ivp(slope, (0, 0.5), y, rtol=1e-9, atol=1e-10, max_step=0.05).y[:, -1]
        assert abs(state - y[:3]).max() < 2e-3  # thrust has a kink where a thruster reverses


def test_port_and_starboard_are_mirror_images():
    commands = courses(np.random.default_rng(1), 300, 0.2)
    path, mirrored = (simulate_planar(HERON, each, 0.2) for each in (commands, commands[:, ::-1]))
    np.testing.assert_allclose(path, mirrored * [1, -1, -1], atol=1e-12)
    assert abs(path[:, 1:]).max() > 0.05


def test_the_coriolis_forces_do_no_work():
    """Without drag and thrust the kinetic energy stays."""
    zero = (0.0, 0.0, 0.0)
    boat = HERON._replace(linear=zero, quadratic=zero, lift=zero)
    path = simulate_planar(boat, np.zeros((50, 2)), 0.05, np.array([1.0, 0.3, 0.5]))
    energy = (path**2 * boat.mass).sum(-1)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-6)
    assert abs(path[-1] - path[0]).max() > 0.1


def test_without_lift_it_does_not_keep_its_course():
    """As the docstring says: a small sway grows at 1 m/s, and with the lift it decays."""
    ahead = np.full((100, 2), 0.35)
    for boat, grows in ((HERON, False), (HERON._replace(lift=(0.0, 0.0, 0.0)), True)):
        straight = simulate_planar(boat, ahead, 0.2)[-1]
        assert straight[0] > 1 and abs(straight[1:]).max() < 1e-9
        disturbed = simulate_planar(boat, ahead, 0.2, straight + np.array([0, 1e-3, 0]))
        assert (abs(disturbed[-1, 1]) > 1e-2) == grows


@pytest.mark.thorough
def test_runs_start_at_rest_with_a_segment_and_noise_as_given():
    samples, true = planar_runs(0, 5.0, 4, noise=(0.1, 0.2, 0.3))
    assert (samples.inputs.dt[0] == 0).all() and (samples.inputs.dt[1:] == 0.2).all() and (true[0] == 0).all()
    np.testing.assert_allclose((samples.velocity - true).std((0, 1)), [0.1, 0.2, 0.3], rtol=0.05)
    turned = true[1:, :, 2].cumsum(0) * 0.2
    np.testing.assert_allclose(samples.inputs.heading[1:], turned, atol=1e-9)
    assert samples.inputs.command_left.shape == (1501, 4) and abs(samples.inputs.command_left).max() <= 1
    again, _ = planar_runs(0, 5.0, 4, noise=(0.1, 0.2, 0.3))
    assert np.array_equal(again.velocity, samples.velocity)
