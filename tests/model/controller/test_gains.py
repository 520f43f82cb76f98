"""Poles are where they are wanted, and margins are what a simulation finds."""

import numpy as np
import pytest

from tests.support.known_boats import known_boat
from usvlearn.errors import ConfigError
from usvlearn.model.controller.gains import GAIN, PHASE, Feedforward, design, linearised, margins, placed, poles

COMMANDS = np.array([0.3, 0.5, 0.7])


def test_the_linearised_boat_is_the_derivative_of_the_simulated_one():
    boat = known_boat()
    linear = linearised("heron", boat.found, COMMANDS)
    speeds, dt, e = boat.model.ahead.steady_speed(COMMANDS), 1e-5, 1e-4

    def force(speed, command):
        return (boat.model.step(speed, command, command, 0.0, dt) - speed) / dt

    a = (force(speeds + e, COMMANDS) - force(speeds - e, COMMANDS)) / (2 * e)
    b = (force(speeds, COMMANDS + e) - force(speeds, COMMANDS - e)) / (2 * e)
    np.testing.assert_allclose(-1 / linear.time_constant.value, a, rtol=1e-3)
    np.testing.assert_allclose(linear.gain.value, b, rtol=1e-3)
    assert (linear.gain.low < b).all() and (b < linear.gain.high).all()


def test_the_closed_loop_has_the_wanted_poles():
    gains = placed(a=-0.6, b=2.4, bandwidth=1.3, damping=0.7)
    loop = np.array([[-0.6 - 2.4 * gains.proportional, 2.4 * gains.integral], [-1.0, 0.0]])  # v and ∫e dt
    found = np.linalg.eigvals(loop)
    np.testing.assert_allclose(found.real, -0.7 * 1.3)
    np.testing.assert_allclose(np.abs(found), 1.3)


def test_gains_without_a_proportional_part_state_the_poles_that_they_have():
    gains = placed(a=-2.0, b=3.0, bandwidth=0.5, damping=0.7)
    assert gains.proportional == 0.0
    found = np.roots([1.0, 3.0 * gains.proportional + 2.0, 3.0 * gains.integral])
    expected = np.roots([1.0, 2 * gains.damping * gains.bandwidth, gains.bandwidth**2])
    np.testing.assert_allclose(np.sort(found), np.sort(expected))


def test_the_default_poles_take_out_the_own_pole_of_a_quick_boat():
    bandwidth, damping = poles(crossover=1.5, time_constant=1.0)
    gains = placed(-1.0, 2.0, bandwidth, damping)
    assert gains.proportional == pytest.approx(1.5 / 2) and gains.proportional / gains.integral == pytest.approx(1.0)


def amplitudes(gains, a, b, delay, dt=0.01, time=90.0) -> tuple[float, float]:
    """The greatest |v| of the loop with a delay, by Euler steps, in the second and in the last sixth of the time."""
    steps, late = int(time / dt), round(delay / dt)
    v, integral, sent, course = 0.2, 0.0, np.zeros(steps + late + 1), np.empty(steps)
    for k in range(steps):
        integral -= v * dt
        sent[k + late] = -gains.proportional * v + gains.integral * integral
        v += dt * (a * v + b * sent[k])
        course[k] = abs(v)
    sixth = steps // 6
    return course[sixth : 2 * sixth].max(), course[-sixth:].max()


@pytest.mark.parametrize("times", [0.93, 1.07])
def test_the_loop_is_unstable_beyond_its_margins_and_stable_within(times):
    a, b, delay = -0.6, 2.4, 0.3
    gains = placed(a, b, 1.0, 1.0)
    left = margins(gains, np.array([a]), np.array([b]), delay)
    louder = gains._replace(
        proportional=gains.proportional * times * 10 ** (left.gain / 20),
        integral=gains.integral * times * 10 ** (left.gain / 20),
    )
    for early, late in (amplitudes(louder, a, b, delay), amplitudes(gains, a, b, delay + times * left.delay)):
        assert (late > early) == (times > 1)


def test_the_worst_corner_counts():
    a, b = np.array([-0.6, -0.6, -0.9]), np.array([2.0, 3.0, 2.0])
    gains = placed(-0.7, 2.2, 1.0, 1.0)
    each = [margins(gains, a[k : k + 1], b[k : k + 1], 0.3) for k in range(3)]
    worst = margins(gains, a, b, 0.3)
    assert worst.gain == min(one.gain for one in each) and worst.phase == min(one.phase for one in each)
    assert len({one.gain for one in each}) == 3


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.4, 3.0])
def test_the_default_gains_keep_the_least_margins_at_all_corners(delay):
    linear = linearised("heron", known_boat().found, COMMANDS)
    gains, left = design("heron", linear, delay)
    assert left.gain >= GAIN and left.phase >= PHASE
    assert gains.proportional > 0 and gains.integral > 0


def test_a_bandwidth_that_is_unstable_at_a_corner_is_refused():
    linear = linearised("heron", known_boat().found, COMMANDS)
    with pytest.raises(ConfigError, match=r"--bandwidth: found 20 rad/s, .* give at most \d"):
        design("heron", linear, 0.4, bandwidth=20.0)


def test_intervals_that_hold_no_thrust_are_refused():
    boat = known_boat(spread=0.6)
    with pytest.raises(ConfigError, match=r"gain of the thrust at \d+ % command, -.* holds 0.*: sail straight ahead"):
        linearised("heron", boat.found, COMMANDS)
    assert Feedforward.of("heron", boat.found).speed[-1] > 0
