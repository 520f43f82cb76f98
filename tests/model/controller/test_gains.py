"""Poles are where they are wanted, margins what a simulation finds; the feedforward inverts the identified curve."""

import numpy as np
import pytest

from tests.support.known_boats import known_boat
from usvlearn.errors import ConfigError
from usvlearn.model.controller.gains import GAIN, PHASE, Feedforward, design, linearised, margins, placed, poles

COMMANDS = np.array([0.3, 0.5, 0.7])


def test_the_linearised_boat_is_the_derivative_of_the_simulated_one():
    boat = known_boat()
    linear = linearised("heron", boat.identified, COMMANDS)
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
    poles = np.linalg.eigvals(loop)
    np.testing.assert_allclose(poles.real, -0.7 * 1.3)
    np.testing.assert_allclose(np.abs(poles), 1.3)


def test_gains_without_a_proportional_part_state_the_poles_that_they_have():
    gains = placed(a=-2.0, b=3.0, bandwidth=0.5, damping=0.7)
    assert gains.proportional == 0.0
    poles = np.roots([1.0, 3.0 * gains.proportional + 2.0, 3.0 * gains.integral])
    expected = np.roots([1.0, 2 * gains.damping * gains.bandwidth, gains.bandwidth**2])
    np.testing.assert_allclose(np.sort(poles), np.sort(expected))


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
    linear = linearised("heron", known_boat().identified, COMMANDS)
    gains, left = design("heron", linear, delay)
    assert left.gain >= GAIN and left.phase >= PHASE
    assert gains.proportional > 0 and gains.integral > 0


def test_a_bandwidth_that_is_unstable_at_a_corner_is_refused():
    linear = linearised("heron", known_boat().identified, COMMANDS)
    with pytest.raises(ConfigError, match=r"--bandwidth: found 20 rad/s, .* give at most \d"):
        design("heron", linear, 0.4, bandwidth=20.0)


def test_intervals_that_hold_no_thrust_are_refused():
    boat = known_boat(spread=0.6)
    with pytest.raises(ConfigError, match=r"gain of the thrust at \d+ % command, -.* holds 0.*: sail straight ahead"):
        linearised("heron", boat.identified, COMMANDS)
    assert Feedforward.of("heron", boat.identified).speed[-1] > 0


def of(**options) -> Feedforward:
    boat = known_boat(**options)
    return Feedforward.of(boat.name, boat.identified)


def test_the_command_holds_the_speed_in_a_simulation():
    boat, forward = known_boat(), of()
    for speed in (0.4, 1.0, 1.9):
        command = float(forward.at(speed))
        course = boat.model.simulate(0.0, np.full(300, command), command, 0.0, 0.2)
        assert course[-1] == pytest.approx(speed, abs=2e-3)


def test_the_band_holds_the_commands_of_nine_boats_in_ten():
    boat, forward = known_boat(), of()
    low, high = forward.band(1.2)
    assert low < forward.at(1.2) < high
    rng, inside = np.random.default_rng(1), 0
    for _ in range(300):
        theta = rng.multivariate_normal(boat.identified.theta, boat.identified.covariance)
        model = type(boat.model).of(boat.identified, theta)
        commands = np.linspace(0.2, 0.8, 601)
        inside += low <= float(np.interp(1.2, model.ahead.steady_speed(commands), commands)) <= high
    assert 0.85 < inside / 300 < 0.95


def test_a_dead_band_has_a_lowest_speed():
    dead = of(thrust_linear_left=-0.2, thrust_linear_right=-0.2)
    speed, command = dead.least
    assert 0.1 < command < 0.3 and 0 < speed < 0.1
    with pytest.raises(ConfigError, match=rf"--speed: found 0\.001 m/s, .*lowest speed.* {speed:.2f} m/s, at"):
        dead.check("heron", "--speed", 0.001)


def test_a_slight_fall_at_full_command_is_saturation_and_a_deep_one_is_refused():
    bent = of(thrust_cubic_left=-1.25, thrust_cubic_right=-1.25)
    assert bent.command[-1] < 1 and (np.diff(bent.speed) > 0).all()
    with pytest.raises(ConfigError, match=r"heron: the steady speed does not rise .* at \d+ %.*: sail straight ahead"):
        of(thrust_cubic_left=-1.7, thrust_cubic_right=-1.7)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"vague": True, "lacks": ["The speed hardly changed."]}, r"not identified.*The speed hardly changed.*sail "),
        ({"drag_linear": 0.0, "drag_quadratic": 0.0, "thrust_speed_left": 0.0, "thrust_speed_right": 0.0}, "no steady"),
        ({"thrust_quadratic_left": -2.0, "thrust_quadratic_right": -2.0}, "no steady speed ahead.*check the signs"),
    ],
)
def test_a_boat_without_a_curve_is_told_what_to_sail(options, said):
    with pytest.raises(ConfigError, match=said):
        of(**options)


def test_a_speed_beyond_full_command_is_refused():
    with pytest.raises(ConfigError, match=r"--speed: found 9 m/s, and heron reaches .* at full command"):
        of().check("heron", "--speed", 9.0)
